"""The reference of a held frame in the page: it converges, shows how far the picture is from it, and is dropped."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest

from tests.test_path_tracer import ABOVE, boxes, latlong_sky
from tests.viewer_rig import Running, page_scene
from warp_ar.accuracy import path_tracer
from warp_ar.accuracy.path_tracer import FIRST_LIGHT_SAMPLES, PathTracer
from warp_ar.viewer import host, lighting
from warp_ar.viewer.lighting import FULL_SCALE, false_colors

pytestmark = pytest.mark.slow

COARSE_GOAL = 0.3  # relative standard error that a few samples reach


def test_slices_add_up_to_passes(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Samples that were added a few at a time, pass by pass, are those that were added at once, to the bit."""
    monkeypatch.setattr(path_tracer, "FIRST_ROUND", 2)  # pixels get their shares after two passes
    monkeypatch.setattr(path_tracer, "PART", 300)  # five of them are a pass
    frame = np.full((32, 48, 3), 0.5, np.float32)
    given: Any = {"device": device, "light_samples": FIRST_LIGHT_SAMPLES + 2}
    tracers = [PathTracer(boxes(True), latlong_sky(), frame, ABOVE, **given) for _ in range(2)]
    passes = 0
    while passes < 5:
        passes += tracers[0].sample_for(0.0)
    assert tracers[0].samples == 5
    tracers[1].sample(5)
    pictures = [tracer.picture() for tracer in tracers]
    np.testing.assert_array_equal(pictures[0].radiance, pictures[1].radiance)
    np.testing.assert_array_equal(pictures[0].error, pictures[1].error)


def test_colors_say_how_large_a_difference_is() -> None:
    lit = np.full((1, 3, 3), 100, np.uint8)
    reference = lit.copy()
    reference[0, 1, 2] += round(0.5 * 255 * FULL_SCALE)
    reference[0, 2, 0] = 255
    colors = false_colors(lit, reference).astype(int)
    brightness = colors.sum(axis=2)[0]
    assert brightness[0] < 8
    assert brightness[0] < brightness[1] < brightness[2]
    assert (colors[0, 2] >= (250, 250, 150)).all()
    np.testing.assert_array_equal(false_colors(reference, lit), colors)


def test_a_held_frame_converges_to_the_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside the picture, sample by sample; colours of the difference; an edit begins anew, motion ends it."""
    monkeypatch.setattr(lighting, "LIGHT_SAMPLES", FIRST_LIGHT_SAMPLES + 1)
    with Running(page_scene()) as running:
        running.edit(type="compare", other="traced")
        assert running.next().other is None  # frames flow
        running.edit(type="play", on=False)
        first = running.until(lambda: running.frames[-1].other is not None and running.frames[-1])
        assert first.other.shape == first.image.shape
        samples = running.host.state_message()["convergence"]["samples"]
        running.until(lambda: running.host.state_message()["convergence"]["samples"] > samples)
        # The picture beside it stays that of the frame.
        np.testing.assert_array_equal(running.frames[-1].image, first.image)
        shown = len(running.frames)
        running.edit(type="compare", other="difference")
        colors = running.until(lambda: len(running.frames) > shown + 1 and running.frames[-1]).other
        told = running.host.state_message()["convergence"]
        assert told["samples"] >= samples, "another way to look at it lost its samples"
        assert 0.0 < told["difference"] < 50.0
        assert not np.array_equal(colors, first.other)
        running.edit(type="set", part="object", index=0, key="at", value=[0.0, -0.08, 0.03])
        running.until(lambda: running.host.state_message()["convergence"] is None)
        running.until(lambda: running.host.state_message()["convergence"] is not None)
        running.edit(type="play", on=True)
        running.until(lambda: running.host.state_message()["convergence"] is None)
        assert running.next().other is None


def few_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a held frame be done after few samples, whose error is still told."""
    monkeypatch.setattr(lighting, "LEAST_SAMPLES", 2)
    monkeypatch.setattr(lighting, "GOAL", COARSE_GOAL)
    monkeypatch.setattr(lighting, "LIGHT_SAMPLES", FIRST_LIGHT_SAMPLES + 1)


def done(running: Running) -> dict[str, float] | None:
    """What is told of a reference that is done."""
    told = running.host.state_message()["convergence"]
    return told if told is not None and told["done"] else None


def test_at_rest_the_picture_stays_that_of_its_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing lights it anew, by light that came in since; another way to look at it is shown all the same."""
    few_samples(monkeypatch)
    with Running(page_scene()) as running:
        running.edit(type="compare", other="traced")
        running.edit(type="play", on=False)
        running.until(lambda: done(running))
        time.sleep(4.0 * host._STILL_SECONDS)  # the last picture comes a moment after what is told of it
        rest, count = running.frames[-1], len(running.frames)
        time.sleep(4.0 * host._STILL_SECONDS)
        assert len(running.frames) == count, "lit anew at rest"
        running.edit(type="compare", other="difference")
        running.until(lambda: len(running.frames) > count)
        np.testing.assert_array_equal(running.frames[-1].image, rest.image)
        np.testing.assert_array_equal(running.frames[-1].other, false_colors(rest.image, rest.other))


def test_what_cannot_be_traced_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    """A reference that fails is a notice, and the picture goes on; the next edit tries again."""

    def fail(*_: Any, **__: Any) -> None:
        raise RuntimeError("no memory: a mesh is gone")

    few_samples(monkeypatch)
    with Running(page_scene()) as running:
        with monkeypatch.context() as broken:
            broken.setattr(PathTracer, "__init__", fail)
            running.edit(type="compare", other="difference")
            running.edit(type="play", on=False)
            running.until(lambda: any("mesh is gone" in str(message) for message in running.messages))
            assert running.next().other is None
        running.edit(type="set", part="exposure", index=0, key="scale", value=0.5)
        running.until(lambda: done(running))
