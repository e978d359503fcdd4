"""One photograph of a mirror ball against the merged bracket that it is from, over a folder of one's own brackets.

    python -m bench photographs --folder=FOLDER    # FOLDER/NAME/*.jpg: a bracket each, the ball in every picture

Each photograph is captured alone and compared with all of its folder, in its own camera values: relative error of
irradiance over all directions, as it is and after one scale. The bracket clipped at the photograph's white level tells
what clipping alone takes; what is left is the response, noise and the ball's outline. Where names or EXIF contradict
each other, ``exposures.txt`` beside the pictures holds their seconds, in order of their names; the word ``pixels`` in
it leaves them to the pixels. One JSON line in all.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.bench_never_worse import irradiance
from bench.table_world import latlong_directions
from warp_ar import PRESETS, Pipeline
from warp_ar.ball.ball_finder import BallOutline
from warp_ar.capture import make_scene
from warp_ar.errors import WarpArError
from warp_ar.photo_capture import Capture, capture_light
from warp_ar.photographs.support import Support, plane_from_contact
from warp_ar.scene import Camera, Probe
from warp_ar.stages.quality import DEFAULT_PRESET

Array = NDArray[np.float64]
REFLECTANCE = 0.85
"""Of the ball, as ``capture`` takes it: radiance of 1 / REFLECTANCE clips."""
BRIGHTER = 1.25
"""Times a photograph's level of clipping that its bracket must show to tell what it lacks."""
BALL = 0.04
"""Its radius, metres: a guess, which no light depends on."""
CONTACT = 0.93
"""Radii below a ball's middle at which it is taken to touch its support."""
SUFFIXES = (".jpg", ".jpeg", ".png")


@dataclasses.dataclass(frozen=True)
class Row:
    """One photograph."""

    name: str
    error: float
    """Relative error of irradiance of the light that it alone gives."""
    scaled: float
    """The same after one scale."""
    clipping: float
    """The same of the bracket's light, clipped where this photograph clips."""
    rest: float
    """Of the photograph's light against that."""
    lower_bound: float
    """Share of the bracket's light that is a lower bound."""
    default: float = 0.0
    """Of the light that the program's default quality makes of the photograph."""
    captured: float = 0.0
    """Of the light that it has without recovery."""


def support_below(outline: BallOutline, camera: Camera) -> Support:
    """The plane that a ball is taken to stand on."""
    x, y = outline.center
    return plane_from_contact(outline.sphere, camera, (x, y + CONTACT * outline.radius), BALL)


def run_program(found: Capture, device: str, **methods: str) -> NDArray[Any]:
    """Light at the ball in a scene that shows the photograph and claims a card, (h, 2 h, 3)."""
    assert found.support is not None
    pose = found.support.pose
    x, y, z = (float(v) for v in pose.inverse().apply(BALL * np.array(found.outline.sphere)))
    probe = Probe((x, y, z), BALL, (REFLECTANCE,) * 3)
    scene = make_scene(found, Path("light.exr"))
    scene = dataclasses.replace(scene, captured=None, source=None, probes=(probe,), has_marker=True)
    quality = PRESETS[DEFAULT_PRESET].with_methods(**methods) if methods else PRESETS[DEFAULT_PRESET]
    pipeline = Pipeline(scene, device=device, quality=quality, outputs=("environment",))
    try:
        environment = pipeline(found.picture, time_seconds=0.0, pose=pose).environment
        assert environment is not None
        return environment
    finally:
        pipeline.close()


def relative_error(found: Array, truth: Array) -> float:
    """Of irradiance, over directions and channels."""
    return float(np.linalg.norm(found - truth) / max(float(np.linalg.norm(truth)), 1e-12))


def compare(name: str, single: NDArray[Any], merged: NDArray[Any], lower_bound: float) -> Row:
    """Figures of one photograph, from two maps (h, 2 h, 3) in its camera values."""
    normals = latlong_directions(24, 48)[0].reshape(-1, 3)
    clipped = np.minimum(merged, 1.0 / REFLECTANCE)
    found, truth, limit = (irradiance(one, normals) for one in (single, merged, clipped))
    scale = float((found * truth).sum() / max(float((found * found).sum()), 1e-12))
    return Row(
        name,
        relative_error(found, truth),
        relative_error(scale * found, truth),
        relative_error(limit, truth),
        relative_error(found, limit),
        lower_bound,
    )


def tells(merged: NDArray[Any]) -> bool:
    """Return whether a bracket's light, (h, 2 h, 3) in a photograph's camera values, is above where that clips."""
    return float(merged.max()) > BRIGHTER / REFLECTANCE


def read_set(folder: Path, neutral: Path) -> tuple[list[Path], list[float] | None]:
    """Photographs of a set, and their exposures where a file tells them.

    Args:
        folder: Of the set.
        neutral: Where copies without names and EXIF may lie.
    """
    photos = sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)
    told = folder / "exposures.txt"
    words = told.read_text().split() if told.is_file() else []
    if words != ["pixels"]:
        return photos, [float(word) for word in words] or None
    copies = []
    for index, path in enumerate(photos):
        copies.append(neutral / f"{folder.name}_{'abcdefghijklmnop'[index]}.png")
        cv2.imwrite(str(copies[-1]), np.asarray(cv2.imread(str(path))))
    return copies, None


def measure_set(folder: Path, device: str) -> list[Row]:
    """All photographs of a set, each against the bracket."""
    rows = []
    with tempfile.TemporaryDirectory() as neutral:
        photos, exposures = read_set(folder, Path(neutral))
        for index, photo in enumerate(photos):
            name = f"{folder.name}/{photo.name}"
            try:
                known: dict[str, Any] = {"support": support_below, "device": device, "height": 64}
                merged = capture_light(photos, shown=index, exposures=exposures, **known).light
                alone = capture_light([photo], **known)
            except WarpArError as error:
                print(f"{name}: {error}", flush=True)
                continue
            if not tells(merged.radiance):
                print(f"{name}: left out, the bracket shows nothing brighter", flush=True)
                continue
            row = compare(name, alone.light.radiance, merged.radiance, merged.lower_bound)
            normals = latlong_directions(24, 48)[0].reshape(-1, 3)
            truth = irradiance(merged.radiance, normals)
            default, captured = (
                relative_error(irradiance(run_program(alone, device, **methods), normals), truth)
                for methods in ({}, {"recover": "clipped"})
            )
            rows.append(dataclasses.replace(row, default=default, captured=captured))
            print(
                f"{name}: {row.error:.1%}, after one scale {row.scaled:.1%}; by clipping {row.clipping:.1%}, "
                f"the rest {row.rest:.1%}; the bracket's lower bound {row.lower_bound:.1%}; "
                f"default {default:.1%}, without recovery {captured:.1%}",
                flush=True,
            )
    return rows


def summarise(sets: Mapping[str, Sequence[Row]]) -> dict[str, Any]:
    """Means of each set over its photographs, and of all sets, each counting once; a set without any is left out.

    Args:
        sets: Figures by a set's name.

    Returns:
        ``sets``, a dict of means each; then the means over them, None where there are none.
    """
    keys = ("error", "scaled", "clipping", "default", "captured")
    means = {
        name: {key: float(np.mean([getattr(row, key) for row in rows])) for key in keys}
        for name, rows in sets.items()
        if rows
    }
    every = {key: float(np.mean([own[key] for own in means.values()])) if means else None for key in keys}
    return {"sets": means, **every}


def main(device: str, arguments: Sequence[str] = ()) -> None:
    """Measure all sets of a folder and print figures of each and of all."""
    parser = argparse.ArgumentParser(prog="python -m bench photographs", description=__doc__.splitlines()[0])
    parser.add_argument("--folder", type=Path, help="a folder of brackets, a folder each")
    options = parser.parse_args(list(arguments))
    if options.folder is None or not options.folder.is_dir():
        print("bench photographs: expected a folder that holds a folder of photographs for each bracket")
        return
    sets = {path.name: measure_set(path, device) for path in sorted(options.folder.iterdir()) if path.is_dir()}
    print(json.dumps({"bench": "photographs", **summarise(sets)}))
