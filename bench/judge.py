"""Error of a quality's picture relative to path tracing in the same light, and errors of both relative to the truth.

    python -m bench.judge SCENE ... [--quality high,medium] [--frame N] [--samples N] [--error E] [--width N]
        [--light FILE]

SCENE is a bundled scene, or the scene file of a case with truth (``scene_VERSION.toml`` next to ``VERSION/NNNN.png``).
The pipeline lights the frames up to N. Its picture of frame N is compared with the reference, a path-traced picture in
the light that the pipeline found. One JSON line per scene and quality:

  nothing    root mean square difference between the camera's frame and the reference, in codes, where they differ
  lost       root mean square difference between the pipeline's picture and the reference, in these places
  kept       lost / nothing
  flip_*     nothing and lost as mean FLIP; flip_half is that between two halves of the reference's samples, its noise
  truth_*    differences of the pipeline's picture and of the reference to the truth, divided by that of the camera's
             frame; ``truth_flip_*`` are ratios of mean FLIP, where the truth differs from the camera's frame
  taken      number of samples of the reference, which is smaller than requested if ``--error`` was reached
  unsure     share of blocks that are left out, because noise of the reference may or may not clip there

Differences are those of means over blocks of BLOCK x BLOCK pixels, computed in linear light and then encoded. The noise
of the reference does not contribute to them: let d1 and d2 be the differences to the two halves of its samples. The
mean of d1 d2 is the mean squared difference to the picture to which both halves converge. Pixels are clipped at the
camera's size, as in the camera: if the picture were reduced first, a mirrored lamp of a few pixels would be brighter
than the camera shows it. Where noise reaches clipping, clipped means are too dark; such blocks are left out.
"""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from bench.common import KeptLines, commit
from warp_ar.accuracy.known_frame import KnownFrame, light_up_to
from warp_ar.accuracy.metrics import changed_region, flip_map
from warp_ar.accuracy.path_tracer import PathTracer, TracedPicture
from warp_ar.kernels.color import decode_table
from warp_ar.scene import Scene, load_scene
from warp_ar.session import with_light

Image = npt.NDArray[np.uint8]

STEPS = 64
"""Number of parts of the samples, after each of which their error is compared with ``--error``."""
BLOCK = 3
"""Side of a block in pixels."""
CHANGED = 2.0
"""Difference in codes above which a block counts as different from the camera's frame."""
NEAR_CLIPPING = 2.0
"""Distance from clipping in standard errors within which a pixel may or may not clip."""


def averaged(image: Image, size: tuple[int, int]) -> Image:
    """Return a picture averaged to another size."""
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def truth_of(scene: Scene, frame: int) -> Image | None:
    """Return the true picture of a frame; None if the scene is not a case with truth for this frame."""
    if scene.path is None or not scene.path.stem.startswith("scene_"):
        return None
    path = scene.path.parent / scene.path.stem.removeprefix("scene_") / f"{frame:04d}.png"
    image = cv2.imread(str(path))
    return None if image is None else np.asarray(image[..., ::-1], np.uint8)


def blocks_of(radiance: npt.NDArray[np.float32], known: KnownFrame) -> npt.NDArray[np.float64]:
    """Return means of clipped radiance over blocks, encoded as codes without rounding, (rows, columns, 3)."""
    table = decode_table(known.scene.camera.transfer).astype(np.float64)
    rows, columns = (side // BLOCK for side in radiance.shape[:2])
    cut = np.clip(radiance[: rows * BLOCK, : columns * BLOCK].astype(np.float64), 0.0, 1.0)
    mean = cut.reshape(rows, BLOCK, columns, BLOCK, 3).mean(axis=(1, 3))
    return np.stack([np.interp(mean[..., c], table[:, c], np.arange(256.0)) for c in range(3)], axis=-1)


def decoded(image: Image, known: KnownFrame) -> npt.NDArray[np.float32]:
    """Return the linear radiance of a picture's codes."""
    table = decode_table(known.scene.camera.transfer)
    return np.stack([table[image[..., c], c] for c in range(3)], axis=-1)


def difference(
    test: npt.NDArray[np.float64], halves: list[npt.NDArray[np.float64]], where: npt.NDArray[np.bool_]
) -> float:
    """Return the root mean square difference between a picture and the limit of two halves of samples, in codes.

    Args:
        test: Blocks of the picture.
        halves: Blocks of each half.
        where: Mask of the blocks to use.
    """
    product = ((test - halves[0]) * (test - halves[-1]))[where]
    return float(np.sqrt(max(product.mean(), 0.0)))


def unsure_blocks(halves: list[TracedPicture]) -> npt.NDArray[np.bool_]:
    """Return a mask of the blocks with a pixel that may or may not clip, by its standard error."""
    rows, columns = (side // BLOCK for side in halves[0].radiance.shape[:2])
    unsure = np.zeros(halves[0].radiance.shape[:2], bool)
    for half in halves:
        unsure |= (np.abs(half.radiance - 1.0) < NEAR_CLIPPING * half.error).any(axis=2)
    cut = unsure[: rows * BLOCK, : columns * BLOCK]
    return cut.reshape(rows, BLOCK, columns, BLOCK).any(axis=(1, 3))


def render_half(tracer: PathTracer, samples: int, error: float | None) -> TracedPicture:
    """Return one of two pictures whose mean has ``samples`` per pixel, or the relative standard error ``error``."""
    of_half = None if error is None else error * math.sqrt(2.0)
    *_, picture = tracer.render(max(samples // 2, 1), error=of_half, step=max(samples // STEPS, 16))
    return picture


def judge(
    known: KnownFrame, truth: Image | None, width: int | None, samples: int, device: str, error: float | None = None
) -> dict[str, Any]:
    """Return the errors of one quality on one scene, by the names that the module lists.

    Args:
        known: The frame, as the pipeline lit it.
        truth: True picture of the frame, or None.
        width: Width of the compared pictures; None: the camera's.
        samples: Largest number of samples per pixel.
        device: Device of the path tracer.
        error: Relative standard error at which sampling ends earlier.
    """
    camera = known.scene.camera
    width = camera.width if width is None else width
    size = (width, width * camera.height // camera.width)
    frame, lit = averaged(known.image, size), averaged(known.lit, size)
    halves = []
    for seed in (0, 1):
        tracer = known.tracer(device=device, size=size, seed=seed)
        halves.append(render_half(tracer, samples, error))
    linear = 0.5 * (halves[0].radiance + halves[1].radiance)
    reference = encoded(linear, known)
    region = changed_region(frame, reference)
    nothing, lost = (float(flip_map(reference, image)[region].mean()) for image in (frame, lit))
    traced = [blocks_of(half.radiance, known) for half in halves]
    seen, shown = (blocks_of(decoded(image, known), known) for image in (frame, lit))
    unsure = unsure_blocks(halves)
    apart = np.abs(seen - 0.5 * (traced[0] + traced[1])).max(axis=2) > CHANGED
    left_out = float((unsure & apart).sum() / max(apart.sum(), 1))
    apart &= ~unsure
    before = difference(seen, traced, apart)
    after = difference(shown, traced, apart)
    row: dict[str, Any] = {
        "nothing": round(before, 2),
        "lost": round(after, 2),
        "kept": round(after / before, 3),
        "flip_nothing": round(nothing, 4),
        "flip_lost": round(lost, 4),
        "flip_half": round(float(flip_map(halves[0].image, halves[1].image)[region].mean()), 4),
        "unsure": round(left_out, 4),
        "taken": sum(half.samples for half in halves),
        "seconds": round(sum(half.seconds for half in halves), 1),
        "pipeline_ms": round(known.milliseconds, 1),
    }
    if truth is not None:
        true = blocks_of(decoded(averaged(truth, size), known), known)
        changed = (np.abs(seen - true).max(axis=2) > CHANGED) & ~unsure
        before = difference(seen, [true], changed)
        row["truth_pipeline"] = round(difference(shown, [true], changed) / before, 3)
        row["truth_reference"] = round(difference(true, traced, changed) / before, 3)
        true_image = averaged(truth, size)
        region = changed_region(frame, true_image)
        flips = [float(flip_map(true_image, image)[region].mean()) for image in (frame, lit, reference)]
        row["truth_flip_pipeline"], row["truth_flip_reference"] = (round(flip / flips[0], 4) for flip in flips[1:])
    return row


def encoded(radiance: npt.NDArray[np.float32], known: KnownFrame) -> Image:
    """Return the codes of linear radiance by the camera's transfer function."""
    return encoded_by(radiance, decode_table(known.scene.camera.transfer))


def encoded_by(radiance: npt.NDArray[np.float32], table: npt.NDArray[np.float32]) -> Image:
    """Return the codes of linear radiance by a table of linear values of codes, (256, 3)."""
    edges = 0.5 * (table[:-1] + table[1:])
    codes = [np.searchsorted(edges[:, c], radiance[..., c], side="right") for c in range(3)]
    return np.stack(codes, axis=-1).astype(np.uint8)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m bench.judge", description="Qualities judged by path tracing.")
    parser.add_argument("scenes", nargs="+", metavar="SCENE")
    parser.add_argument("--quality", default="high,medium", help="several are separated by commas")
    parser.add_argument("--frame", type=int, default=6)
    parser.add_argument("--samples", type=int, default=512)
    parser.add_argument("--error", type=float, help="relative standard error at which samples end (default: none)")
    parser.add_argument("--width", type=int, help="of the pictures that are compared (default: the camera's)")
    parser.add_argument("--light", help="captured light instead of the ball's")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--keep", type=Path, metavar="FILE", help="JSON lines: go on where a run was ended")
    options = parser.parse_args()
    lines = KeptLines(options.keep)
    for name in options.scenes:
        scene = load_scene(Path(name) if "/" in name else name)
        key = {"scene": "/".join(Path(name).parts[-2:]), "frame": options.frame, "samples": options.samples}
        key |= {"until": options.error, "width": options.width, "light": "given" if options.light else "own"}
        if options.light is not None:
            scene = with_light(scene, options.light)
        for quality in options.quality.split(","):
            if lines.has(**key, quality=quality):
                continue
            known = light_up_to(scene, options.frame, quality=quality, device=options.device)
            truth = truth_of(scene, options.frame)
            row = judge(known, truth, options.width, options.samples, options.device, options.error)
            lines.add({**key, "quality": quality, **row, "commit": commit()})
    return 0


if __name__ == "__main__":
    sys.exit(main())
