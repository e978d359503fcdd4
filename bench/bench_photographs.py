"""Error of light captured from one photograph of a mirror ball, compared with the bracket that contains it.

    python -m bench photographs --folder=FOLDER    # FOLDER/NAME/*.jpg: a bracket each, the ball in every picture

Light is captured from each photograph alone and from the whole bracket, in the photograph's camera values. The error is
the relative difference of irradiance over all directions, as it is and after scaling by the best common factor. The
bracket's light, clipped at the photograph's white level, gives the part of the error that is due to clipping; the rest
is due to the response, noise and the ball's outline. If exposures in names and EXIF contradict each other,
``exposures.txt`` in the folder states them in seconds, in the order of the names; the word ``pixels`` in it means that
they are estimated from the pixels. The last line is JSON.
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
"""Reflectance of the ball that ``capture`` assumes: light of radiance 1 / REFLECTANCE clips in it."""
BRIGHTER = 1.25
"""Smallest ratio of the bracket's brightest light to a photograph's clipping level, for the photograph to be used."""
BALL = 0.04
"""Assumed radius of the ball, metres; the light does not depend on it."""
CONTACT = 0.93
"""Distance in the picture of the assumed point of contact below the ball's centre, in radii."""
SUFFIXES = (".jpg", ".jpeg", ".png")


@dataclasses.dataclass(frozen=True)
class Row:
    """Relative errors of irradiance for one photograph."""

    name: str
    """Name of its folder and file."""
    error: float
    """Error of the light from the photograph alone."""
    scaled: float
    """Error of the light from the photograph alone, after scaling by the best common factor."""
    clipping: float
    """Error of the bracket's light, clipped where this photograph clips."""
    rest: float
    """Difference between the photograph's light and the clipped light of the bracket."""
    lower_bound: float
    """Share of the bracket's light that is a lower bound."""
    default: float = 0.0
    """Error of the light that a pipeline of the default quality finds in the photograph."""
    captured: float = 0.0
    """Error of the light that a pipeline without recovery finds in the photograph."""


def support_below(outline: BallOutline, camera: Camera) -> Support:
    """Return the plane on which a ball is assumed to stand."""
    x, y = outline.center
    return plane_from_contact(outline.sphere, camera, (x, y + CONTACT * outline.radius), BALL)


def run_program(found: Capture, device: str, **methods: str) -> NDArray[Any]:
    """Return the light that a pipeline finds in a photograph, (h, 2 h, 3).

    Args:
        found: Capture from the photograph. The scene made from it states that there is a card, which is not visible.
        device: Device of the pipeline.
        methods: Methods that replace those of the default quality.
    """
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
    """Return the relative error of irradiance over directions and channels."""
    return float(np.linalg.norm(found - truth) / max(float(np.linalg.norm(truth)), 1e-12))


def compare(name: str, single: NDArray[Any], merged: NDArray[Any], lower_bound: float) -> Row:
    """Return the errors of one photograph.

    Args:
        name: Name of the photograph.
        single: Light from it alone, (h, 2 h, 3), in its camera values.
        merged: Light from the bracket, in the photograph's camera values.
        lower_bound: Share of the bracket's light that is a lower bound.
    """
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
    """Return True if a bracket's light is clearly brighter than a photograph's clipping level.

    Args:
        merged: Light from the bracket, (h, 2 h, 3), in the photograph's camera values.
    """
    return float(merged.max()) > BRIGHTER / REFLECTANCE


def read_set(folder: Path, neutral: Path) -> tuple[list[Path], list[float] | None]:
    """Return the photographs of a set, and their exposures in seconds if ``exposures.txt`` states them.

    Args:
        folder: Folder of the set.
        neutral: Folder for copies without meaningful names and EXIF, which are made if the file says ``pixels``.
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
    """Return the errors of all photographs of a set, compared with the bracket."""
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
    """Return mean errors of each set of photographs, and the means over all sets.

    Args:
        sets: Errors of the photographs of each set, by the set's name; sets without photographs are left out.

    Returns:
        ``sets``: means of each set, by its name and by the error's. The other keys are the names of errors, with the
        mean over the sets' means; None if there are no sets.
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
    """Measure all sets of a folder and print the figures of each and of all."""
    parser = argparse.ArgumentParser(prog="python -m bench photographs", description=__doc__.splitlines()[0])
    parser.add_argument("--folder", type=Path, help="a folder of brackets, a folder each")
    options = parser.parse_args(list(arguments))
    if options.folder is None or not options.folder.is_dir():
        print("bench photographs: expected a folder that holds a folder of photographs for each bracket")
        return
    sets = {path.name: measure_set(path, device) for path in sorted(options.folder.iterdir()) if path.is_dir()}
    print(json.dumps({"bench": "photographs", **summarise(sets)}))
