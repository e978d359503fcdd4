"""Recordings of any length of the bundled desk under light that changes, for benchmarks of the farm.

The bundled clip is played forth and back, enlarged, and its light raised and lowered by a stated ramp. Each loop is
encoded once, by all cores, and its packets are repeated: an hour is written in the time of a minute.
"""

from __future__ import annotations

import concurrent.futures
import dataclasses
import fractions
import itertools
import multiprocessing
from pathlib import Path

import cv2
import numpy as np

from warp_ar.device import usable_cores
from warp_ar.farm.part_video import PartSink, join_parts
from warp_ar.scene import Scene, SourceSpec, dumps_scene, load_scene
from warp_ar.sources.sources import open_source

RATE = 30
TICK = fractions.Fraction(1, RATE)
FORTH = 120
"""Frames of the bundled clip."""
LOOP = 2 * (FORTH - 1)
"""Frames of a loop, forth and back: about eight seconds."""
GAINS = (1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.6, 0.7, 0.8, 0.9)
"""Linear gain at the begin of each loop in turn; within a loop it goes evenly to the next."""


def desk_at(size: tuple[int, int]) -> tuple[Scene, int]:
    """The bundled desk for frames of a size, and the columns that are mirrored at each side of a wider picture."""
    scene = load_scene("desk")
    scale = size[1] / scene.camera.height
    inner = round(scene.camera.width * scale)
    side = (size[0] - inner) // 2
    camera = scene.camera.scaled_to(inner, size[1])
    return dataclasses.replace(scene, camera=dataclasses.replace(camera, width=size[0], cx=camera.cx + side)), side


def write_scene(path: Path, size: tuple[int, int]) -> Scene:
    """The desk for frames of a size as a scene file."""
    scene = dataclasses.replace(desk_at(size)[0], source=SourceSpec(path=path.with_name("none.mp4")))
    path.write_text(dumps_scene(scene), encoding="utf-8")
    return scene


def desk_pictures(size: tuple[int, int], first: int, count: int) -> list[np.ndarray]:
    """Frames of the bundled clip at a size, uint8 RGB."""
    source = load_scene("desk").source
    assert source is not None
    assert source.path is not None
    side = desk_at(size)[1]
    with open_source(source.path) as frames:
        images = [frame.image for frame in itertools.islice(frames, first, first + count)]
    inner = (size[0] - 2 * side, size[1])
    return [cv2.copyMakeBorder(cv2.resize(image, inner), 0, 0, side, side, cv2.BORDER_REFLECT) for image in images]


def _brightened(gain: float) -> np.ndarray:
    """Codes of light that is so much stronger, (256,), by sRGB's transfer function."""
    code = np.arange(256) / 255.0
    linear = gain * np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
    raised = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.clip(linear, 0.0, None) ** (1 / 2.4) - 0.055)
    return np.asarray(np.rint(255.0 * np.clip(raised, 0.0, 1.0)), np.uint8)


def _write_stretch(path: Path, size: tuple[int, int], rate: int, loop: int, first: int, end: int) -> Path:
    """Frames ``first`` to ``end`` of one loop; a process of its own writes it."""
    cv2.setNumThreads(1)
    forth = [n if n < FORTH else LOOP - n for n in range(first, end)]
    low = min(forth)
    images = desk_pictures(size, low, max(forth) - low + 1)
    start, stop = GAINS[loop], GAINS[(loop + 1) % len(GAINS)]
    with PartSink(path, list(range(first, end)), fractions.Fraction(1, rate), rate) as sink:
        for number, source in zip(range(first, end), forth, strict=True):
            sink.write(cv2.LUT(images[source - low], _brightened(start + (stop - start) * number / LOOP)))
    return path


def write_recording(path: Path, size: tuple[int, int], frames: int, rate: int = RATE) -> int:
    """Write a recording of so many frames.

    Args:
        path: An MP4.
        size: Width and height in pixels.
        frames: How many; of as many loops as these take no more than ten are encoded.
        rate: Frames a second.

    Returns:
        Frames that were encoded; the others are their packets again.
    """
    quarters = list(itertools.pairwise(round(LOOP * n / 4) for n in range(5)))
    wanted: list[tuple[int, int, int]] = []
    start = 0
    while start < frames:
        loop = start // LOOP % len(GAINS)
        first, end = next(q for q in quarters if q[0] == start % LOOP)
        wanted.append((loop, first, min(end, first + frames - start)))
        start += end - first
    spawn = multiprocessing.get_context("spawn")
    unique = sorted(set(wanted))
    workers = min(len(unique), max(1, usable_cores() // 2))
    with concurrent.futures.ProcessPoolExecutor(workers, mp_context=spawn) as pool:
        names = [path.with_name(f"{path.stem}-{loop}-{first}-{end}.mp4") for loop, first, end in unique]
        loops, firsts, ends = zip(*unique, strict=True)
        list(pool.map(_write_stretch, names, [size] * len(unique), [rate] * len(unique), loops, firsts, ends))
    place = dict(zip(unique, names, strict=True))
    starts = [0, *itertools.accumulate(end - first for _, first, end in wanted)][:-1]
    join_parts([place[piece] for piece in wanted], starts, fractions.Fraction(1, rate), path, recording=None)
    for name in names:
        name.unlink()
    return sum(end - first for _, first, end in unique)
