"""The path tracer against Mitsuba's in the same light: z-scores of means over blocks of 16 x 16 pixels.

    python -m bench.check_reference [SCENE ...] [--samples N] [--size WxH] [--device D] [--modes whole,known]

SCENE is a bundled scene or the scene file of a case of truth; none: all bundled scenes. Its camera, pose, objects,
lights and proxies are used, with one reflectance for each proxy. The light is the case's true environment, else what
the pipeline finds, all of it distant. One JSON line per scene and mode:

  whole   the whole scene by path tracing, reflectances given
  known   Mitsuba's picture of the scene without virtual objects and lights is the frame, by which reflectance is found
  z_rms   root mean square of the z-scores of all blocks and channels; 1 where nothing but noise is left
  z_max   the largest; of n scores of noise about 3 (n = 36) to 4 (n = 900)
  beyond  share of scores beyond 3 standard errors
  ratio   mean of ours over mean of theirs, all blocks

With ``--keep FILE`` lines are kept there, and what it holds at these samples, size and device is not rendered again.

Mitsuba's noise is that of the means of RUNS pictures, ours what the picture says of itself. In the mode ``known`` only
pixels count whose neighbours show the same proxy, for elsewhere a frame's pixel is a mean over surfaces. Where vertex
normals are smooth both renderers treat directions below the surface in their own ways: silhouettes of meshes differ.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.common import KeptLines, commit
from warp_ar.accuracy.known_frame import light_up_to
from warp_ar.accuracy.path_tracer import PathTracer
from warp_ar.device import resolve_device
from warp_ar.errors import UsageError
from warp_ar.scene import Pose, Scene, bundled_scenes, load_scene

BLOCK = 16
"""Pixels to each side of a block."""
RUNS = 16
"""Pictures of Mitsuba's whose spread is its noise."""
FRAME_SHARE = 4
"""Times as many samples for the picture that is the frame."""
REFLECTANCES = ((0.45, 0.38, 0.3), (0.2, 0.35, 0.5), (0.6, 0.6, 0.55))
"""Of proxies, in turn."""

Float = npt.NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Case:
    """A scene in a light."""

    scene: Scene
    light: npt.NDArray[np.float32]
    pose: Pose
    seconds: float


def open_case(name: str, size: tuple[int, int] | None, device: str) -> Case:
    """A scene with its camera at a size; the height follows the scene's aspect."""
    scene = load_scene(Path(name) if "/" in name else name)
    about = None if scene.path is None else scene.path.parent / "case.json"
    if about is not None and about.exists():
        entry = json.loads(about.read_text())["poses"][0]
        pose = Pose(np.array(entry["R"]), np.array(entry["t"]))
        light, seconds = np.load(about.parent / "env/0000.npy").astype(np.float32), 0.0
    else:
        known = light_up_to(scene, 6, quality="medium", device=device)
        scene, pose, light, seconds = known.scene, known.pose, known.light.radiance, known.seconds
    scene = dataclasses.replace(scene, camera=dataclasses.replace(scene.camera, distortion=()))
    if size is not None:
        width, height = size[0], round(size[0] * scene.camera.height / scene.camera.width)
        scene = dataclasses.replace(scene, camera=scene.camera.scaled_to(width, height))
    return Case(scene, np.maximum(light, 0.0), pose, seconds)


def reflectances_of(scene: Scene) -> list[tuple[float, float, float]]:
    """RGB of each proxy."""
    return [REFLECTANCES[k % len(REFLECTANCES)] for k in range(len(scene.proxies))]


def rendered(mi: Any, case: Case, samples: int, *, virtual: bool, seed: int) -> Float:
    """RUNS pictures of Mitsuba's, (RUNS, H, W, 3)."""
    from bench.mitsuba_scene import mitsuba_scene

    scene = mitsuba_scene(
        case.scene, case.light, case.pose, reflectances_of(case.scene), virtual=virtual, seconds=case.seconds
    )
    each = max(samples // RUNS, 1)
    return np.stack([np.array(mi.render(scene, spp=each, seed=seed + k), np.float64) for k in range(RUNS)])


def even_pixels(shown: npt.NDArray[np.int32]) -> npt.NDArray[np.bool_]:
    """Pixels whose neighbours show what they show."""
    same = np.ones(shown.shape, bool)
    for axis in (0, 1):
        for step in (-1, 1):
            same &= np.roll(shown, step, axis=axis) == shown
    same[[0, -1]] = same[:, [0, -1]] = False
    return same


def z_scores(ours: Float, error: Float, theirs: Float, where: npt.NDArray[np.bool_]) -> Float:
    """(blocks, 3): differences of means over blocks in their standard errors."""
    scores = []
    height, width = ours.shape[:2]
    for row in range(0, height - BLOCK + 1, BLOCK):
        for column in range(0, width - BLOCK + 1, BLOCK):
            block = np.s_[row : row + BLOCK, column : column + BLOCK]
            inside = where[block]
            if inside.sum() < BLOCK:
                continue
            means = theirs[:, *block][:, inside].mean(axis=1)
            own = np.sqrt((error[block][inside] ** 2).sum(axis=0)) / inside.sum()
            noise = np.hypot(own, means.std(axis=0, ddof=1) / np.sqrt(len(means)))
            off = ours[block][inside].mean(axis=0) - means.mean(axis=0)
            scores.append(np.where(np.abs(off) < 1e-6, 0.0, off / np.maximum(noise, 1e-9)))
    return np.array(scores)


def check(mi: Any, case: Case, mode: str, samples: int, device: str) -> dict[str, Any]:
    """Compare the two renderers."""
    start = time.perf_counter()
    theirs = rendered(mi, case, samples, virtual=True, seed=1)
    shape = theirs.shape[1:3]
    where, frame, scale = np.ones(shape, bool), None, np.zeros(theirs.shape[1:])
    more: dict[str, Any] = {"reflectances": tuple(reflectances_of(case.scene))}
    if mode == "known":
        runs = rendered(mi, case, samples * FRAME_SHARE, virtual=False, seed=1001)
        frame = runs.mean(axis=0).astype(np.float32)
        # Of the frame's noise a receiver keeps what its light keeps.
        scale = runs.std(axis=0, ddof=1) / np.sqrt(RUNS) * theirs.mean(axis=0) / np.maximum(frame, 1e-6)
        more = {}
    tracer = PathTracer(case.scene, case.light, frame, case.pose, device=device, seconds=case.seconds, **more)
    tracer.sample(samples)
    picture = tracer.picture()
    if mode == "known":
        where = even_pixels(tracer.shown())
    error = np.hypot(picture.error.astype(np.float64), scale)
    ours = picture.radiance.astype(np.float64)
    scores = z_scores(ours, error, theirs, where)
    return {
        "z_rms": round(float(np.sqrt((scores**2).mean())), 2),
        "z_max": round(float(np.abs(scores).max()), 2),
        "beyond": round(float((np.abs(scores) > 3.0).mean()), 4),
        "scores": scores.size,
        "ratio": [round(float(r), 4) for r in ours[where].mean(axis=0) / theirs.mean(axis=0)[where].mean(axis=0)],
        "relative_error": round(picture.relative_error, 4),
        "seconds": round(time.perf_counter() - start, 1),
    }


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m bench.check_reference", description="Path tracers compared.")
    parser.add_argument("scenes", nargs="*", metavar="SCENE")
    parser.add_argument("--samples", type=int, default=4096)
    parser.add_argument("--size", default="160x120", help="of the pictures; the height follows the camera")
    parser.add_argument("--modes", default="whole,known")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--keep", type=Path, metavar="FILE", help="JSON lines: go on where a run was ended")
    options = parser.parse_args()
    import mitsuba as mi

    device = str(resolve_device(options.device))
    mi.set_variant("cuda_ad_rgb" if device.startswith("cuda") else "llvm_ad_rgb")
    width, height = (int(side) for side in options.size.split("x"))
    lines = KeptLines(options.keep)
    more = {"samples": options.samples, "size": options.size, "device": device}
    for name in options.scenes or sorted(bundled_scenes()):
        about = {"scene": name if "/" not in name else "/".join(Path(name).parts[-2:])}
        modes = [mode for mode in options.modes.split(",") if not lines.has(**about, mode=mode, **more)]
        try:
            if not modes:
                continue
            case = open_case(name, (width, height), device)
            for mode in modes:
                row = check(mi, case, mode, options.samples, device)
                lines.add({**about, "mode": mode, **row, **more, "commit": commit()})
        except UsageError as error:
            print(json.dumps({**about, "left_out": str(error)}), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
