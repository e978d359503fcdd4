"""What a quality loses against path tracing in the same light, and what both lose against the truth.

    python -m bench.judge SCENE ... [--quality high,medium] [--frame N] [--samples N] [--error E] [--width N]
        [--light FILE]

SCENE is a bundled scene, or the scene file of a case of truth (``scene_VERSION.toml`` beside ``VERSION/NNNN.png``). The
frames up to N run through the pipeline; its picture of that frame, averaged down, is compared with the reference that
follows paths in the light that the pipeline had. One JSON line per scene and quality:

  nothing    root mean square difference of the camera's frame to the reference, in codes, where the latter differs
  lost       the same of the pipeline's picture
  kept       lost / nothing
  flip_*     nothing and lost as mean FLIP; flip_half between two halves of the reference's samples: its noise
  truth_*    kept of the difference to the truth, by the pipeline and by the reference; ``truth_flip_*`` the same as
             mean FLIP where the truth differs from the camera's frame
  taken      samples of the reference: those that were asked for, or fewer where ``--error`` ended them
  unsure     share of those blocks that are left out: noise of the reference may or may not clip there

Differences are those of means over blocks of BLOCK x BLOCK pixels in linear light, encoded. Noise of the reference is
taken out of them: of a difference d1 to one half of its samples and d2 to the other, the mean of d1 d2 is that of the
square of the difference to what both converge to. Pixels are clipped as the camera does, at its size: averaged down
before, a mirrored lamp of a few pixels is brighter than the camera ever shows it. Where noise reaches clipping, clipped
means are too dark, and such blocks do not judge.
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
"""After a part in so many of the samples their error is looked at."""
BLOCK = 3
"""Pixels to each side of a block."""
CHANGED = 2.0
"""Codes from which on a block differs from the camera's frame."""
NEAR_CLIPPING = 2.0
"""Standard errors within which a pixel may or may not clip."""


def averaged(image: Image, size: tuple[int, int]) -> Image:
    """A picture at another size."""
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def truth_of(scene: Scene, frame: int) -> Image | None:
    """What the camera would have seen, if the scene is a case of truth that has this frame."""
    if scene.path is None or not scene.path.stem.startswith("scene_"):
        return None
    path = scene.path.parent / scene.path.stem.removeprefix("scene_") / f"{frame:04d}.png"
    image = cv2.imread(str(path))
    return None if image is None else np.asarray(image[..., ::-1], np.uint8)


def blocks_of(radiance: npt.NDArray[np.float32], known: KnownFrame) -> npt.NDArray[np.float64]:
    """Means over blocks in linear light as the camera clips it, in codes, not rounded."""
    table = decode_table(known.scene.camera.transfer).astype(np.float64)
    rows, columns = (side // BLOCK for side in radiance.shape[:2])
    cut = np.clip(radiance[: rows * BLOCK, : columns * BLOCK].astype(np.float64), 0.0, 1.0)
    mean = cut.reshape(rows, BLOCK, columns, BLOCK, 3).mean(axis=(1, 3))
    return np.stack([np.interp(mean[..., c], table[:, c], np.arange(256.0)) for c in range(3)], axis=-1)


def decoded(image: Image, known: KnownFrame) -> npt.NDArray[np.float32]:
    """Linear radiance of codes."""
    table = decode_table(known.scene.camera.transfer)
    return np.stack([table[image[..., c], c] for c in range(3)], axis=-1)


def difference(
    test: npt.NDArray[np.float64], halves: list[npt.NDArray[np.float64]], where: npt.NDArray[np.bool_]
) -> float:
    """Root mean square difference to what two halves converge to, in codes."""
    product = ((test - halves[0]) * (test - halves[-1]))[where]
    return float(np.sqrt(max(product.mean(), 0.0)))


def unsure_blocks(halves: list[TracedPicture]) -> npt.NDArray[np.bool_]:
    """Blocks with a pixel whose standard error reaches across clipping."""
    rows, columns = (side // BLOCK for side in halves[0].radiance.shape[:2])
    unsure = np.zeros(halves[0].radiance.shape[:2], bool)
    for half in halves:
        unsure |= (np.abs(half.radiance - 1.0) < NEAR_CLIPPING * half.error).any(axis=2)
    cut = unsure[: rows * BLOCK, : columns * BLOCK]
    return cut.reshape(rows, BLOCK, columns, BLOCK).any(axis=(1, 3))


def render_half(tracer: PathTracer, samples: int, error: float | None) -> TracedPicture:
    """One of two pictures whose mean has so many samples, or fewer where its relative standard error is ``error``."""
    of_half = None if error is None else error * math.sqrt(2.0)
    *_, picture = tracer.render(max(samples // 2, 1), error=of_half, step=max(samples // STEPS, 16))
    return picture


def judge(
    known: KnownFrame, truth: Image | None, width: int | None, samples: int, device: str, error: float | None = None
) -> dict[str, Any]:
    """Errors of one quality on one scene, by samples until their relative standard error is ``error``."""
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
    """Codes of linear radiance by the camera's transfer."""
    return encoded_by(radiance, decode_table(known.scene.camera.transfer))


def encoded_by(radiance: npt.NDArray[np.float32], table: npt.NDArray[np.float32]) -> Image:
    """Codes of linear radiance by a transfer's table."""
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
