"""The reference of a held frame in the page: it converges, shows how far the picture is from it, and is dropped."""

from __future__ import annotations

import numpy as np
import pytest

from tests.test_path_tracer import ABOVE, RHO, boxes, latlong_sky
from tests.viewer_rig import Running, page_scene
from warp_ar.accuracy.path_tracer import FIRST_LIGHT_SAMPLES, PathTracer
from warp_ar.viewer.convergence import FULL_SCALE, false_colors


@pytest.mark.parametrize("known", [False, True], ids=["whole", "difference"])
def test_slices_add_up_to_passes(known: bool, device: str) -> None:
    """Samples that were added a few rows at a time are those that were added at once, to the bit."""
    frame = np.full((32, 48, 3), 0.5, np.float32) if known else None
    light_samples = FIRST_LIGHT_SAMPLES + 2
    more = {"light_samples": light_samples} if known else {"reflectances": RHO}
    tracers = [PathTracer(boxes(True), latlong_sky(), frame, ABOVE, device=device, **more) for _ in range(2)]
    passes = 0
    while passes < 3:
        passes += tracers[0].sample_for(0.0)
    assert tracers[0].samples == 3
    tracers[1].sample(3)
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


def test_a_held_frame_converges_to_the_reference() -> None:
    """Beside the picture, sample by sample; colours of the difference; an edit begins anew, motion ends it."""
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


def test_a_frame_that_is_held_at_once_gets_a_reference_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Played and held again before the next frame is lit: nothing flowed, and yet another frame is held."""
    with Running(page_scene()) as running:
        loop = running.host._loop
        running.edit(type="compare", other="difference")
        running.edit(type="play", on=False)
        first = running.until(lambda: running.frames[-1].other is not None and running.frames[-1])
        pace = loop._pace

        def hold_next(due: float, step: float) -> float:
            due = pace(due, step)
            running.edit(type="play", on=False)
            return due

        monkeypatch.setattr(loop, "_pace", hold_next)
        running.edit(type="play", on=True)
        held = running.until(lambda: not np.array_equal(running.frames[-1].image, first.image) and running.frames[-1])
        assert held.other is None, "the reference of another frame stands beside this one"
        running.until(lambda: running.frames[-1].other is not None)
        np.testing.assert_array_equal(running.frames[-1].image, held.image)
        assert running.host.state_message()["convergence"]["samples"] >= 1


def test_frames_stay_short_while_it_converges() -> None:
    """A slice ends soon after its time: what viewers ask for meanwhile is done between two slices."""
    tracer = PathTracer(boxes(True), latlong_sky(), None, ABOVE, device="cpu", reflectances=RHO, size=(480, 320))
    tracer.sample_for(0.0)
    ended = [tracer.sample_for(0.0) for _ in range(4)]
    assert not any(ended), "a slice of no time traced the whole picture"
