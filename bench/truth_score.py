"""Error of path tracing on cases with truth: the error that remains if light, pose and transport are right.

    python -m bench.truth_score CASE ... [--versions object,light,both] [--frames 0,6,11] [--samples N] [--error E]
        [--places] [--device D]

CASE is a folder with ``case.json``, ``camera``, ``env``, and a folder and a scene file of each version. Pictures have
the size of the frames, because the truth was clipped at that size: a clipped highlight becomes dimmer if the picture is
reduced. One JSON line per case and version:

  nothing    mean FLIP between the camera's frame and the truth, where they differ
  kept       mean FLIP between the path-traced picture and the truth in these places, divided by ``nothing``
  kept_half  ``kept`` of a picture with half of the samples; the other half has another seed
  noise      mean FLIP between the pictures of both halves, divided by ``nothing``
  error      relative standard error of the picture, where virtual content changes it
  taken      number of samples, which is smaller than requested if ``--error E`` was reached

Only pixels within MARGIN of the compared ones are sampled. With ``--keep FILE``, the lines of single frames are stored
in a file, and frames in it are not rendered again. With ``--places``, the distances of the light's emitters are
estimated from the frame (``accuracy/light_places.py``); otherwise all light is distant, even that of near lamps.
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
"""Distance in pixels around the compared region within which pixels are sampled; FLIP's filters reach less far."""
OVERHEAD = (0.0, -1e4)
"""Intersection (x, y down) of a ray that goes straight up with the camera's plane z = 1."""


def read_image(path: Path) -> Image | None:
    """Return an RGB picture; None if it does not exist."""
    image = cv2.imread(str(path))
    return None if image is None else np.ascontiguousarray(image[..., ::-1])


def leave_alone(tracer: PathTracer, pixels: npt.NDArray[np.bool_]) -> None:
    """Let some pixels keep the frame: their rays go straight up from the camera, where they meet nothing.

    Args:
        tracer: The path tracer.
        pixels: Mask of the pixels, (H, W).
    """
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
    """Return the errors of one frame, by the names that the module lists; None if there is no such frame.

    Args:
        case: Folder of the case.
        version: Version of the case.
        frame: Index of the frame.
        samples: Largest number of samples per pixel.
        device: Device of the path tracer.
        error: Relative standard error at which sampling ends earlier.
        places: True to estimate the distances of emitters.
    """
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
