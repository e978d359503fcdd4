"""What a frame does not need is left out of it, and pictures are those of a pipeline that leaves nothing out."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from tests.hard_cases.rig import SIZE, look_at, make_quality, make_scene
from tests.recover_rig import solve_here
from warp_ar.engine.pipeline import Pipeline, Result
from warp_ar.light.estimate import Estimate
from warp_ar.light.recovery import Recovery
from warp_ar.scene import Exposure, Light, Scene
from warp_ar.stages.quality import PRESETS
from warp_ar.stages.request import Estimates

pytestmark = pytest.mark.slow


# --- Pictures ---------------------------------------------------------------------------------------------------------

POSES = {
    "near": look_at((0.02, -0.3, 0.35)),
    "aside": look_at((0.25, -0.35, 0.3), (-0.2, 0.1, 0.0)),
    "away": look_at((0.0, 0.0, 1.0), (5.0, 0.0, 1.0)),
}
"""Everything is in the picture; the ball and less; nothing is."""
QUALITIES = {
    "paper": dataclasses.replace(PRESETS["paper"], environment_height=16),
    "emitters": dataclasses.replace(PRESETS["low"].with_methods(recover="shading"), environment_height=16),
    "every": make_quality(),
}
"""The least that stands on the environment; recovery that only objects and lights need; what balls show, too."""
FAR = (4.0, 0.0, 0.3)
"""Metres: where nothing of it is in any picture."""


def scene_of(objects: bool, lights: str, scale: float = 0.7) -> Scene:
    """One of the scenes between which a path switches: they differ in numbers alone.

    Args:
        objects: Whether virtual objects stand where they can be seen.
        lights: ``on``, ``off`` (no power), ``one`` (the others have none) or ``aside`` (a spot misses the picture, the
            others have no power).
        scale: Of the exposure.
    """
    base = make_scene(exposure=Exposure(scale))
    sent = base.lights
    if lights != "on":
        sent = tuple(dataclasses.replace(light, intensity=0.0) for light in base.lights)
    if lights in ("one", "aside"):
        target = (0.0, 0.0, 0.0) if lights == "one" else (0.45, -0.45, 0.0)
        spot: Light = dataclasses.replace(base.lights[1], target=target, inner_angle=3.0, outer_angle=6.0)
        sent = (sent[0], spot, sent[2])
    moved = base.objects
    if not objects:
        moved = tuple(dataclasses.replace(item, at=FAR) for item in base.objects)
    return dataclasses.replace(base, lights=sent, objects=moved)


@functools.cache
def pictures() -> tuple[np.ndarray, ...]:
    """A bright receiver around a dark ball, as the first pose sees them, and a light that clips in the ball.

    Two pictures of two lights, and two that hardly differ from the first: by those the environment moves less than its
    readers are told of.
    """
    random = np.random.default_rng(3)
    found = []
    for mean, place in ((190, 0), (120, 2)):
        picture = random.normal(mean, 12, (SIZE[1], SIZE[0], 3))
        picture[9:20, 9:20] *= 0.2
        picture[12:15, 12 + place : 15 + place] = 255
        found.append(picture.clip(0, 255).astype(np.uint8))
    for share in (0.2, 0.6):
        brighter = (random.random(found[0].shape) < share) & (found[0] < 250)
        found.append(np.where(brighter, found[0] + 1, found[0]).astype(np.uint8))
    return tuple(found)


Frame = tuple[str, bool, str, int, float]


def run(
    path: Sequence[Frame], device: str, preset: str, *, culling: bool, estimates: Estimates = "synchronous"
) -> list[Result]:
    """A pipeline over a path of frames, its pictures read."""
    results, now = [], 0.0
    with Pipeline(
        scene_of(True, "on"),
        device=device,
        quality=QUALITIES[preset],
        bands=2,
        estimates=estimates,
        culling=culling,
    ) as pipeline:
        for pose, objects, lights, picture, step in path:
            pipeline.update(scene_of(objects, lights))
            now += step
            result = pipeline(pictures()[picture], time_seconds=now, pose=POSES[pose])
            assert result.image is not None
            results.append(result)
    return results


def assert_equal(path: Sequence[Frame], device: str, preset: str, **more: Any) -> list[Result]:
    """Pictures with and without culling have the same bits; returns the results with."""
    whole = run(path, device, preset, culling=False, **more)
    culled = run(path, device, preset, culling=True, **more)
    for index, (one, other) in enumerate(zip(whole, culled, strict=True)):
        assert not any(timing.left_out for timing in one.stages.values())
        differing = int((one.image != other.image).any(-1).sum())
        assert differing == 0, f"frame {index} of {path}: {differing} pixels differ"
    return culled


SHORT = 1 / 30
LONG = 0.15
SHOWN, BARE = ("near", True, "on"), ("near", False, "off")
PATHS: dict[str, tuple[Frame, ...]] = {
    "light": (*[(*SHOWN, 0, SHORT)] * 2, *[("near", True, "off", 1, SHORT)] * 3, *[(*SHOWN, 1, SHORT)] * 2),
    "spot": (*[("near", True, "one", 0, SHORT)] * 2, *[("near", True, "aside", 1, SHORT)] * 3, (*SHOWN, 1, SHORT)),
    "object": (*[(*SHOWN, 0, SHORT)] * 2, *[("near", False, "on", 1, SHORT)] * 3, *[(*SHOWN, 1, SHORT)] * 2),
    "view": (*[(*SHOWN, 0, SHORT)] * 2, *[("away", True, "on", 1, SHORT)] * 3, *[(*SHOWN, 1, SHORT)] * 2),
    "from nothing": (*[(*BARE, 0, SHORT)] * 3, *[(*SHOWN, 0, SHORT)] * 2),
    "drift": (*[(*SHOWN, 0, SHORT)] * 3, *[(*BARE, 1, SHORT)] * 8, *[(*SHOWN, 1, SHORT)] * 4),
    "half": (*[(*SHOWN, 0, SHORT)] * 3, *[("near", False, "on", 2, SHORT)] * 5, *[(*SHOWN, 2, SHORT)] * 2),
    "half for long": (*[(*SHOWN, 0, SHORT)] * 3, *[("near", False, "on", 1, SHORT)] * 14, *[(*SHOWN, 1, SHORT)] * 2),
    "long": (*[(*SHOWN, 0, SHORT)] * 2, *[(*BARE, 1, LONG)] * 9, *[(*SHOWN, 1, SHORT)] * 6),
}
"""What is left out of some frames comes back: every reason; light that moves on meanwhile, read by nothing or by half
of what reads it, a little and for long."""


def number_estimates(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a solver's n-th estimate, from 1 on, put n / 16 into every cell: how often it was asked shows."""

    def update(self: Any, cells: Any, *_: Any) -> Estimate:
        self.asked = getattr(self, "asked", 0) + 1
        return Estimate(np.full((*cells.shape, 3), self.asked / 16.0, np.float32), (False,) * 3)

    monkeypatch.setattr(Recovery, "update", update)
    monkeypatch.setattr(Recovery, "rests", lambda *_: False)
    solve_here(monkeypatch)


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize(("preset", "estimates"), [("paper", "synchronous"), ("emitters", "delayed")])
def test_what_comes_back_is_fresh(
    monkeypatch: pytest.MonkeyPatch, device: str, preset: str, estimates: Estimates, path: str
) -> None:
    number_estimates(monkeypatch)
    results = assert_equal(PATHS[path], device, preset, estimates=estimates)
    assert any(timing.left_out for result in results for timing in result.stages.values())


def test_reasons_are_those_of_the_frame() -> None:
    view, *_, last = run(PATHS["view"][:4], "cpu", "every", culling=True)
    assert not any(timing.left_out for timing in view.stages.values())
    reasons = {name: timing.left_out for name, timing in last.stages.items() if timing.left_out}
    assert reasons["shade"] == "no virtual object is in the picture"
    assert reasons["relight"] == "virtual light falls on nothing in the picture"
    assert reasons["mirror_ball"] == "no mirror ball is in the picture"
    assert reasons["irradiance"] == "nothing reads its irradiance_map in this frame"
    assert {"unwrap", "accumulate", "expose"}.isdisjoint(reasons)
    off = run(PATHS["light"][:4], "cpu", "every", culling=True)[-1]
    assert off.stages["relight"].left_out == "no virtual light has any power"
    assert off.stages["shade"].left_out is None
