"""The paper's figures that compare methods, redone: the plain way, the paper's, ours, and the truth."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from warp_ar.accuracy.cases import Image, load_case, open_scene, read_truth, truth_folders
from warp_ar.accuracy.cost_table import light_only, turn
from warp_ar.accuracy.metrics import clipped_region
from warp_ar.accuracy.progress import Advance, ignore
from warp_ar.accuracy.runs import BASE, Clock, LightBefore, run
from warp_ar.accuracy.sweep import region_of
from warp_ar.scene import load_scene


@dataclasses.dataclass(frozen=True)
class Figure:
    """One of the paper's figures, redone."""

    title: str
    text: str
    columns: tuple[tuple[str, Image], ...]
    reference: Image | None
    """What the columns are compared with, where it is known."""
    region: npt.NDArray[np.bool_] | None
    """What to look at."""


_FIGURES = (
    (
        "Figure 7",
        "darken",
        ("dark_25", "dark_50"),
        "expose",
        ("plain", "paper", "ball"),
        "A shorter exposure, simulated: what clips in the frame must not just turn grey. Plain scaling; the paper's "
        "box filter, which lets clipped pixels darken less where their surroundings clip too; ours, which estimates "
        "what the clipped pixels had from the glow around them and from the mirror ball's view of the same emitters.",
    ),
    (
        "Figure 8",
        "wire_coincident",
        (),
        "relight",
        ("flat", "paper", "reflectance"),
        "A virtual spotlight from where the environment's own light comes, over wires that no model knows. Flat light; "
        "the paper's blend, which takes the frame's brightness for relief; ours, which divides the frame by the light "
        "that falls there and lights the reflectance that remains.",
    ),
    (
        "Figure 9",
        "wire_opposing",
        ("light",),
        "relight",
        ("flat", "paper", "reflectance"),
        "The same against the environment's light: what the frame shows bright now lies in shadow.",
    ),
)
"""Title, bundled scene, versions of cases that show the same with its truth, setting, its plain, paper's and best
method."""


def _versions_of(truth: Path | None, versions: Sequence[str]) -> Iterator[tuple[Path, str]]:
    """Cases that have one of the versions, and which."""
    for folder in truth_folders(truth) if truth is not None else ():
        version = next((name for name in versions if (folder / f"scene_{name}.toml").is_file()), None)
        if version is not None:
            yield folder, version


def figure_units(truth: Path | None) -> float:
    """Units of work, in runs at a usual method, that ``make_figures`` will report as done."""
    cases = ((methods, 1 + sum(1 for _ in _versions_of(truth, versions))) for _, _, versions, _, methods, _ in _FIGURES)
    return float(sum(len(methods) * count for methods, count in cases))


def make_figures(
    device: str,
    count: int,
    truth: Path | None,
    times: int = 1,
    clock: Clock = time.perf_counter,
    advance: Advance = ignore,
) -> Iterator[Figure]:
    """Figures 7, 8 and 9 of the paper: plain, the paper's way, ours, each against the truth where that is known."""
    for title, bundled, versions, setting, methods, text in _FIGURES:
        cases = [(f"{title}: {bundled.replace('_', ' ')}", open_scene(bundled, count, times))]
        for folder, version in _versions_of(truth, versions):
            scene = load_scene(folder / f"scene_{version}.toml")
            case = load_case(folder.name, scene, count, read_truth(folder / version), times)
            cases.append((f"{title} again: {folder.name.replace('_', ' ')}, {version.replace('_', ' ')}", case))
        for number, (name, case) in enumerate(cases):
            index = case.shown[-1]
            camera = case.frames[index].image
            outcomes = []
            with LightBefore() as before:
                for method in methods:
                    turned = turn(BASE, {setting: method})
                    between = light_only(turned)
                    outcomes.append(run(case, turned, device, between=between, timed=1, clock=clock, before=before))
                    advance(f"{name}: {method}", 1.0)
            images = [outcome.images[index] for outcome in outcomes]
            reference = case.truth.get(index)
            labels = (f"plain ({methods[0]})", f"the paper ({methods[1]})", f"ours ({methods[2]})")
            columns = (("camera", camera), *zip(labels, images, strict=True))
            if reference is not None:
                columns = (*columns, ("truth", reference))
            region = clipped_region(camera) if setting == "expose" else region_of(case, index, images[-1])
            yield Figure(name, text if number == 0 else "", columns, reference, region)
