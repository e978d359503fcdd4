"""Cases of truth by path tracing in their true light: what is left when light, pose and transport are right.

    python -m bench.truth_score CASE ... [--versions object,light,both] [--frames 0,6,11] [--samples N] [--error E]
        [--places] [--device D]

CASE is a folder with ``case.json``, ``camera``, ``env`` and a folder and a scene file of each version. The pictures
have the frames' own size, for the truth was clipped there: a highlight that clips is dimmer after averaging down. One
JSON line per case and version; ``kept`` is the mean FLIP to the truth where the truth differs from the camera's frame,
over that of the frame itself. Half of the samples have another seed, which tells the noise: ``kept_half`` is the same
by one half, ``noise`` the difference between both, ``error`` the relative standard error where the picture changes.
Samples go to pixels within MARGIN of those that count. With ``--error E`` they end earlier where ``error`` is E;
``taken`` is how many there were. With ``--keep FILE`` lines of single frames are kept there, and what it holds at these
samples is not rendered again. With ``--places`` the distances of the light's emitters are looked for in the frame
(``accuracy/light_places.py``); without it all light is distant, as it was where lamps stand near.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from bench.common import KeptLines, commit
from bench.judge import encoded_by, render_half
from warp_ar.accuracy.light_places import place_emitters
from warp_ar.accuracy.metrics import changed_region, flip_map
from warp_ar.accuracy.path_tracer import PathTracer
from warp_ar.kernels.color import decode_table
from warp_ar.scene import Pose, load_scene

Image = npt.NDArray[np.uint8]

MARGIN = 16
"""Pixels around the region that counts: as far as FLIP filters, and some."""
OVERHEAD = (0.0, -1e4)
"""Of a ray on the camera's plane at a distance of 1, y downward."""


def read_image(path: Path) -> Image | None:
    """An RGB picture, if it is there."""
    image = cv2.imread(str(path))
    return None if image is None else np.ascontiguousarray(image[..., ::-1])


def leave_alone(tracer: PathTracer, pixels: npt.NDArray[np.bool_]) -> None:
    """Let pixels keep the frame, at the cost of one ray: theirs go over the camera's head, and meet nothing there."""
    tracer.prepare()
    picture = tracer._local.picture
    rays = picture.rays.numpy()
    rays[pixels] = OVERHEAD
    picture.rays.assign(rays)


def score(
    case: Path,
    version: str,
    frame: int,
    samples: int,
    device: str,
    error: float | None = None,
    *,
    places: bool = False,
) -> dict[str, float] | None:
    """Errors of one frame by so many samples, or fewer for a standard error of ``error``; None: no such frame."""
    truth = read_image(case / version / f"{frame:04d}.png")
    camera = read_image(case / "camera" / f"{frame:04d}.png")
    if truth is None or camera is None:
        return None
    scene = load_scene(case / f"scene_{version}.toml")
    about = json.loads((case / "case.json").read_text())
    entry = about["poses"][frame]
    light = np.maximum(np.load(case / "env" / f"{frame:04d}.npy").astype(np.float32), 0.0)
    pose = Pose(np.array(entry["R"]), np.array(entry["t"]))
    rate = scene.source.fps if scene.source is not None and scene.source.fps is not None else 30.0
    if places:
        light = place_emitters(light, scene, camera, pose, device=device, seconds=frame / rate)
    region = changed_region(camera, truth)
    aside = ~cv2.dilate(region.astype(np.uint8), np.ones((2 * MARGIN + 1,) * 2)).astype(bool)
    halves = []
    for seed in (0, 1):
        tracer = PathTracer(scene, light, camera, pose, device=device, seconds=frame / rate, seed=seed)
        leave_alone(tracer, aside)
        halves.append(render_half(tracer, samples, error))
    table = decode_table(scene.camera.transfer)
    first, second = (half.radiance for half in halves)
    images = [encoded_by(radiance, table) for radiance in (0.5 * (first + second), first, second)]
    nothing = float(flip_map(truth, camera)[region].mean())
    kept, kept_half = (float(flip_map(truth, image)[region].mean()) / nothing for image in images[:2])
    return {
        "nothing": nothing,
        "kept": kept,
        "kept_half": kept_half,
        "noise": float(flip_map(images[1], images[2])[region].mean()) / nothing,
        "error": float(np.hypot(*(half.relative_error for half in halves))) / 2.0,
        "taken": sum(half.samples for half in halves),
    }


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m bench.truth_score", description="Truth against the reference.")
    parser.add_argument("cases", nargs="+", metavar="CASE")
    parser.add_argument("--versions", default="object,light,both")
    parser.add_argument("--frames", default="0,6,11")
    parser.add_argument("--samples", type=int, default=512)
    parser.add_argument("--error", type=float, help="relative standard error at which samples end (default: none)")
    parser.add_argument("--places", action="store_true", help="look for the distances of the light's emitters")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--keep", type=Path, metavar="FILE", help="JSON lines: go on where a run was ended")
    options = parser.parse_args()
    lines = KeptLines(options.keep)
    for name in options.cases:
        for version in options.versions.split(","):
            start = time.perf_counter()
            frames = [int(number) for number in options.frames.split(",")]
            key = {"case": Path(name).name, "version": version, "samples": options.samples, "until": options.error}
            key |= {"places": options.places}
            rows = []
            for frame in frames:
                if not lines.has(**key, frame=frame):
                    row = score(
                        Path(name), version, frame, options.samples, options.device, options.error,
                        places=options.places,
                    )  # fmt: skip
                    if row is not None:
                        lines.add({**key, "frame": frame, **row, "commit": commit()})
                rows += [record for record in lines.records if record | key | {"frame": frame} == record]
            if not rows:
                continue
            names = ("nothing", "kept", "kept_half", "noise", "error", "taken")
            means: dict[str, Any] = {own: round(float(np.mean([row[own] for row in rows])), 4) for own in names}
            about = {**key, **means, "frames": len(rows)}
            about |= {"seconds": round(time.perf_counter() - start, 1), "commit": commit()}
            print(json.dumps(about), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
