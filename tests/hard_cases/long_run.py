"""Sequences of frames, run for long: no drift, no growth of memory, the same after a loop as after one.

Plain test runs take 240 frames, ``--long`` 10,000.
"""

from __future__ import annotations

import dataclasses
import itertools
import pathlib
from collections.abc import Iterator

import numpy as np
import warp as wp

from tests.hard_cases import generators
from tests.hard_cases.rig import SIZE, Rig
from warp_ar.scene import Animation, Light, Pose, load_scene
from warp_ar.sources.sources import open_source

DRIFT = 1.0
"""Codes: the light settles exponentially toward its loop, and the last bit of a code may go either way."""
GROWTH = 0.01
"""Share of the memory after warm-up."""
LOOP = 24
"""Frames after which a synthetic sequence starts again."""


@dataclasses.dataclass(frozen=True)
class Report:
    """What a long run showed."""

    drift: float
    """Largest difference, in 8-bit codes, between pictures of the last loop and those of an early one."""
    finite: bool
    growth: float
    """Of resident or device memory since warm-up, whichever grew more."""


def resident_bytes() -> int:
    """Memory of this process that lies in RAM; 0 where the system does not tell."""
    status = pathlib.Path("/proc/self/statm")
    return int(status.read_text().split()[1]) * 4096 if status.exists() else 0


def device_bytes(device: str) -> int:
    """Memory in use on a CUDA device; 0 on the CPU."""
    found = wp.get_device(device)
    return found.total_memory - found.free_memory if found.is_cuda else 0


def looped_clip(rig: Rig, count: int) -> Iterator[np.ndarray]:
    """The bundled clip's first frames in a loop, cut to size."""
    spec = load_scene("desk").source
    assert spec is not None
    assert spec.path is not None
    with open_source(spec.path) as source:
        clip = [frame.image[::13, ::13][: SIZE[1], : SIZE[0]].copy() for frame in itertools.islice(source, LOOP)]
    yield from itertools.islice(itertools.cycle(clip), count)


def switching_lights(rig: Rig, count: int) -> Iterator[np.ndarray]:
    """The environment and the virtual ones on and off every frame, and the virtual ones moving."""
    frames = generators.frames(SIZE[1], SIZE[0])
    scene = rig.pipeline.scene
    dark = dataclasses.replace(scene, lights=tuple(dataclasses.replace(light, intensity=0.0) for light in scene.lights))
    for index in range(count):
        rig.pipeline.update(scene if index % 2 else dark)  # raises if switching a light needed more
        yield frames["white" if index % 2 else "black"]


def lost_and_found(rig: Rig, count: int) -> Iterator[np.ndarray]:
    """The marker out of sight for a third of every loop."""
    frames = list(generators.frames(SIZE[1], SIZE[0]).values())
    seen: Pose | None = rig.tracker.pose
    for index in range(count):
        rig.tracker.pose = None if index % LOOP > 2 * LOOP // 3 else seen
        yield frames[index % LOOP % 4]


def corrupt_frames(rig: Rig, count: int) -> Iterator[np.ndarray]:
    """One frame of garbage in a hundred."""
    frames = generators.frames(SIZE[1], SIZE[0])
    for index in range(count):
        yield frames["torn"] if index % 100 == 50 else frames["ramp"]


CASES = {
    "looped clip": (looped_clip, LOOP),
    "lights switching each frame": (switching_lights, LOOP),
    "tracking lost and found": (lost_and_found, LOOP),
    "one corrupt frame in a hundred": (corrupt_frames, 100),
    "looped clip, best recovery": (looped_clip, 3 * LOOP),
}
"""Sequences, and after how many frames their pictures come again."""
SEARCHES = "looped clip, best recovery"
"""Recovery by shading looks for lamps in turns, and comes back to the same turn at every third loop; it needs the first
dozen loops to settle, so that only a long run says anything."""


def run(case: str, *, frames: int, device: str) -> Report:
    """Run one case; the first pictures to compare with are taken once the light has settled."""
    sequence, loop = CASES[case]
    early_at = 5 * loop if 5 * loop <= frames // 2 else loop
    sway = Animation(sway=(0.02, 0.0, 0.0), period=loop / 30.0)
    lights = (Light("point", 0.1, at=(0.0, -0.1, 0.3), animate=sway),)
    rig = Rig(device, "recover", "shading" if case == SEARCHES else "white_card", bands=2, lights=lights)
    early: dict[int, np.ndarray] = {}
    drift, warm, finite = 0.0, (0, 0), True
    last_loop = (frames // loop - 1) * loop
    with rig:
        for index, image in enumerate(sequence(rig, frames)):
            picture = rig.frame(image).astype(np.int16)
            if index == min(frames // 2, 1000):
                warm = resident_bytes(), device_bytes(device)
            if early_at <= index < early_at + loop:
                early[index % loop] = picture
            if last_loop <= index < last_loop + loop:
                drift = max(drift, float(np.abs(picture - early[index % loop]).max()))
        for name in ("environment", "environment_radiance", "environment_confidence"):
            finite &= bool(np.isfinite(rig.get(name)).all())
        used = resident_bytes(), device_bytes(device)
    growth = max((now - before) / before if before else 0.0 for now, before in zip(used, warm, strict=True))
    return Report(drift, finite, growth)
