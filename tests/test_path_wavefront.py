"""Paths side by side: what one thread per path finds, to the bit on a CPU, however many slots there are."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from tests.test_path_tracer import ABOVE, RHO, boxes, latlong_sky, polish
from warp_ar.accuracy import path_tracer
from warp_ar.accuracy.path_tracer import PathTracer, TracedPicture
from warp_ar.kernels.reference.path_wavefront import make_wave
from warp_ar.scene import Light, Scene

# Pixels get their shares anew after 16 samples: rounds before and after differ.
SAMPLES = 20
FRAME = np.full((32, 48, 3), 0.5, np.float32)


def draw(scene: Scene, device: str, slots: int | None, monkeypatch: pytest.MonkeyPatch, **more: Any) -> Any:
    """A picture and its rays with so many slots; None: each path by a thread of its own."""
    with monkeypatch.context() as patch:
        patch.setattr(PathTracer, "_make_wave", lambda self, count: None)
        tracer = PathTracer(scene, latlong_sky(), more.pop("frame", None), ABOVE, device=device, **more)
        if slots is not None:
            # One part: on a CPU threads would share the slots.
            patch.setattr(path_tracer, "PART", 1 << 30)
            tracer._wave = make_wave(slots, len(scene.lights), tracer.device)
        tracer.sample(SAMPLES)
        return tracer.picture(), tracer.rays()


def scenes() -> dict[str, tuple[Scene, dict[str, Any]]]:
    lamp = Light("spot", 0.3, at=(0.1, -0.1, 0.35), target=(0.05, 0.05, 0.0), inner_angle=15.0, outer_angle=25.0)
    return {
        "whole": (boxes(True), {"reflectances": RHO}),
        "difference": (boxes(True), {"frame": FRAME}),
        "polished": (polish(boxes(True), 0.3, 0.4), {"frame": FRAME}),
        "followed light": (dataclasses.replace(boxes(True), lights=(lamp, *boxes(True).lights[1:])), {"frame": FRAME}),
        "no light": (dataclasses.replace(boxes(True), lights=()), {"frame": FRAME}),
    }


def assert_alike(first: TracedPicture, second: TracedPicture) -> None:
    """The same paths, but for roundings: all but a few pixels are equal to a hundredth of their error."""
    off = np.abs(first.radiance - second.radiance) / np.maximum(first.error, 1e-4)
    assert np.quantile(off, 0.98) < 0.01
    assert off.mean() < 0.05


@pytest.mark.parametrize("name", scenes())
def test_slots_find_what_threads_find(name: str, device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, more = scenes()[name]
    expected, rays = draw(scene, device, None, monkeypatch, **more)
    picture, found = draw(scene, device, 500, monkeypatch, **more)
    if device == "cpu":
        np.testing.assert_array_equal(picture.radiance, expected.radiance)
        np.testing.assert_array_equal(picture.error, expected.error)
        assert found == rays
    else:
        assert_alike(picture, expected)
        assert found == pytest.approx(rays, rel=1e-3)


def test_it_does_not_matter_how_many_slots_there_are(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor which of them is free first: one that waits for another, and more than there are samples."""
    scene, more = scenes()["polished"]
    pictures = [draw(scene, device, slots, monkeypatch, **more) for slots in (1 << 12, 333, 1 << 17)]
    for picture, rays in pictures[1:]:
        np.testing.assert_array_equal(picture.radiance, pictures[0][0].radiance)
        np.testing.assert_array_equal(picture.error, pictures[0][0].error)
        assert rays == pictures[0][1]
