"""The pipeline as a whole: what goes in, what comes out, what is spared, what stays the same."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import os
import re
import signal
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from warp_ar.engine.pipeline import Pipeline, Result
from warp_ar.errors import SceneError, UpdateError, UsageError
from warp_ar.scene import (
    Camera,
    Exposure,
    LambertMaterial,
    Light,
    Marker,
    MetallicRoughnessMaterial,
    Object,
    Probe,
    Proxy,
    Scene,
)
from warp_ar.sources.synthetic import Synthetic
from warp_ar.stages.quality import PRESETS
from warp_ar.tracking.tracking import Tracker, TrackState

pytestmark = pytest.mark.slow

SIZE = (320, 240)
# Codes by which a picture may lag where its light moved too little for readers to run again; when that is, differs.
SPARED = 1
# Mean over the seen part of a map whose border moves by half a texel of 32 rows.
RESAMPLED = 0.05
Frames = list[npt.NDArray[np.uint8]]


@pytest.fixture(scope="module")
def frames() -> Frames:
    with Synthetic("card", size=SIZE) as card:
        return [frame.image.copy() for frame, _ in zip(card, range(4), strict=False)]


def make_scene(**changes: object) -> Scene:
    """A scene with every effect."""
    with Synthetic("card", size=SIZE) as card:
        k = card.camera_matrix
    scene = Scene(
        camera=Camera(*SIZE, k[0, 0], k[1, 1], k[0, 2], k[1, 2]),
        marker=Marker(size=Synthetic.MARKER_SIZE),
        probes=(Probe((-0.1, 0.03, 0.03), 0.03),),
        proxies=(Proxy("plane", size=(1.0, 1.0)), Proxy("box", at=(0.0, 0.15, 0.03), size=(0.1, 0.05, 0.06))),
        objects=(
            Object("sphere", radius=0.03, at=(0.1, 0.0, 0.03), material=LambertMaterial((0.5, 0.4, 0.3))),
            Object(
                "torus",
                major_radius=0.03,
                minor_radius=0.01,
                at=(0.05, 0.08, 0.02),
                material=MetallicRoughnessMaterial((0.9, 0.8, 0.4), 1.0, 0.3),
            ),
        ),
        lights=(Light("point", 0.3, at=(0.0, -0.1, 0.3)),),
        exposure=Exposure(0.7),
    )
    return dataclasses.replace(scene, **changes)


def run(pipeline: Pipeline, images: Frames) -> list[Result]:
    results = []
    for index, image in enumerate(images):
        result = pipeline(image, time_seconds=index / 30)
        _ = result.image, result.environment  # taken now: arrays are valid until the next call
        results.append(result)
    return results


def test_a_track_of_the_callers_is_that_of_the_pipelines_own(frames: Frames, device: str) -> None:
    """One in which the marker is lost, too: the frame passes as it came."""
    scene = make_scene()
    shown = [*frames, np.full_like(frames[0], 90), frames[0]]
    times = [0.1 * n for n in range(len(frames))] + [2.0, 2.1]
    with (
        Pipeline(scene, device=device, quality="low", outputs=("image", "pose")) as first,
        Pipeline(scene, device=device, quality="low", outputs=("image", "pose")) as second,
    ):
        tracker = Tracker(second.scene.marker, second.camera)
        states = set()
        for image, now in zip(shown, times, strict=True):
            own = first(image, time_seconds=now)
            given = second.submit(image, time_seconds=now, pose=tracker.track(image, now))
            np.testing.assert_array_equal(given.image, own.image)
            assert given.state == own.state
            assert (given.pose is None) == (own.pose is None)
            states.add(own.state)
    assert states == {TrackState.TRACKED, TrackState.LOST}


def test_submitted_frames_may_be_written_anew(frames: Frames, device: str) -> None:
    outputs = ("image", "environment")
    with (
        Pipeline(make_scene(), device=device, quality="low", outputs=outputs) as first,
        Pipeline(make_scene(), device=device, quality="low", outputs=outputs) as second,
    ):
        expected = run(first, frames)
        ahead, buffer = [], np.empty_like(frames[0])
        for index, image in enumerate(frames):
            np.copyto(buffer, image)
            ahead.append(second.submit(buffer, time_seconds=index / 30))
        for result, wanted in zip(ahead, expected, strict=True):
            np.testing.assert_array_equal(result.image, wanted.image)
            assert result.stages.keys() == wanted.stages.keys()
            if device == "cpu":
                np.testing.assert_array_equal(result.environment, wanted.environment)


def test_calls_updates_and_hand_overs_wait_for_what_was_submitted(frames: Frames, device: str) -> None:
    scene = make_scene()
    with contextlib.ExitStack() as stack:
        plain, ahead, heir, expected_heir = (
            stack.enter_context(Pipeline(scene, device=device, quality="low")) for _ in range(4)
        )
        first, second = run(plain, frames[:2])
        submitted = ahead.submit(frames[0], time_seconds=0.0)
        np.testing.assert_array_equal(ahead(frames[1], time_seconds=1 / 30).image, second.image)
        np.testing.assert_array_equal(submitted.image, first.image)
        for pipeline in (plain, ahead):
            pipeline.submit(frames[2], time_seconds=2 / 30)
            pipeline.update(edited(scene))
            pipeline.submit(frames[3], time_seconds=3 / 30)
        heir.continue_from(ahead)
        expected_heir.continue_from(plain)
        np.testing.assert_array_equal(heir(frames[0]).image, expected_heir(frames[0]).image)


def test_a_closed_pipeline_says_so(frames: Frames) -> None:
    pipeline = Pipeline(make_scene(), device="cpu", quality="low", size=SIZE)
    run(pipeline, frames[:1])
    pipeline.close()
    pipeline.close()
    calls = (
        lambda: pipeline(frames[0]),
        lambda: pipeline.submit(frames[0]),
        lambda: pipeline.update(make_scene()),
        pipeline.warm_up,
    )
    for call in calls:
        with pytest.raises(UsageError, match="the pipeline is closed; make another one"):
            call()


def test_threads_that_call_one_pipeline_take_turns(frames: Frames, device: str) -> None:
    results: list[Any] = []
    with Pipeline(make_scene(), device=device, quality="low", size=SIZE) as pipeline:

        def light(calls: int) -> None:
            results.extend(pipeline(frames[call % len(frames)]).image.shape for call in range(calls))

        threads = [threading.Thread(target=light, args=(8,), daemon=True) for _ in range(3)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(60.0)
        assert not any(thread.is_alive() for thread in threads)
    assert results == [(SIZE[1], SIZE[0], 3)] * 24


def hold(pipeline: Pipeline, held: threading.Event, forked: threading.Event) -> None:
    with pipeline._turn:
        held.set()
        forked.wait()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_a_forked_child_is_told_at_once(frames: Frames) -> None:
    with Pipeline(make_scene(), device="cpu", quality="low", size=SIZE) as pipeline:
        run(pipeline, frames[:1])
        read, write = os.pipe()
        held, forked = threading.Event(), threading.Event()
        thread = threading.Thread(target=lambda: hold(pipeline, held, forked))
        thread.start()  # the fork has the lock, and not the thread that would release it
        held.wait()
        if (child := os.fork()) == 0:
            signal.alarm(20)
            try:
                pipeline.close()
                pipeline(frames[0])
            except UsageError as error:
                os.write(write, str(error).encode())
            try:
                Pipeline(make_scene(), device="cpu", quality="low", size=SIZE)
            except UsageError as error:
                os.write(write, b"; another: " + str(error).encode())
            finally:
                os._exit(0)
        forked.set()
        thread.join()
        os.close(write)
        with os.fdopen(read, "rb") as told:
            first, another = told.read().split(b"; another: ")
        for text in (first, another):
            assert b"fork" in text
            assert b"start processes by spawn" in text
        os.waitpid(child, 0)
        run(pipeline, frames[1:2])  # the parent goes on


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({"time_seconds": math.nan}, "time_seconds = nan"),
        ({"time_seconds": math.inf}, "time_seconds = inf"),
        ({"time_seconds": "now"}, "time_seconds = 'now'"),
        ({"exposure_time": math.nan}, "exposure_time = nan: expected a finite number of seconds above 0"),
        ({"exposure_time": 0.0}, "exposure_time = 0.0"),
        ({"exposure_time": -1.0}, "exposure_time = -1.0"),
    ],
)
def test_impossible_numbers_are_refused_and_the_next_frame_works(
    arguments: dict[str, object], expected: str, frames: Frames
) -> None:
    with Pipeline(make_scene(), device="cpu", quality="low", size=SIZE, exposures=(0.02, 0.002)) as pipeline:
        for call in (pipeline, pipeline.submit):
            with pytest.raises(UsageError, match=re.escape(expected)):
                call(frames[0], **arguments)
        assert run(pipeline, frames[:1])[0].state is TrackState.TRACKED


def test_poses_and_scenes_that_are_none_are_refused_by_name(frames: Frames) -> None:
    with Pipeline(make_scene(), device="cpu", quality="paper") as pipeline:
        for pose, given in (((np.eye(3), np.zeros(3)), "tuple"), (np.eye(4), "ndarray"), ("desk", "str")):
            with pytest.raises(UsageError, match=rf"pose is {given}; expected a Pose\(R, t\)"):
                pipeline(frames[0], pose=pose)  # type: ignore[arg-type]
        with pytest.raises(UsageError, match=r"scene = .*: expected Scene"):
            pipeline.update("desk")  # type: ignore[arg-type]
        assert pipeline(frames[0]).image.any()


def test_impossible_exposures_are_refused() -> None:
    for scale in (math.nan, math.inf, -1.0, "dark"):
        with pytest.raises(SceneError, match="Exposure: scale = "):
            Exposure(scale)  # type: ignore[arg-type]
    for exposures in ((math.nan, 0.01), (0.01, 0.0), (0.01, -0.02)):
        with pytest.raises(UsageError, match="exposures = "):
            Pipeline(make_scene(), device="cpu", quality="low", size=SIZE, exposures=exposures)


def test_captured_graph_equals_eager(frames: Frames, device: str) -> None:
    """On CUDA the scheduler replays graphs; the same stages launched one by one must give the same bits."""
    with (
        Pipeline(make_scene(), device=device, quality="low") as replayed,
        Pipeline(make_scene(), device=device, quality="low") as eager,
    ):
        scheduler = eager._scheduler
        scheduler._run_captured = scheduler._run_side_by_side = scheduler._run_eager  # type: ignore[method-assign]
        for one, other in zip(run(replayed, frames * 2), run(eager, frames * 2), strict=True):
            np.testing.assert_array_equal(one.image, other.image)


def edited(scene: Scene) -> Scene:
    """Other numbers everywhere, the same structure."""
    sphere, torus = scene.objects
    return dataclasses.replace(
        scene,
        objects=(
            dataclasses.replace(sphere, at=(0.07, 0.04, 0.04), radius=0.04, material=LambertMaterial((0.1, 0.9, 0.2))),
            dataclasses.replace(
                torus, rotate=(40.0, 0.0, 0.0), material=MetallicRoughnessMaterial((0.9, 0.9, 0.9), 1.0, 0.1)
            ),
        ),
        lights=(dataclasses.replace(scene.lights[0], at=(0.1, 0.1, 0.2), color=(1.0, 0.2, 0.1)),),
        exposure=Exposure(0.5),
    )


def test_update_equals_a_new_pipeline(frames: Frames, device: str) -> None:
    """After numbers are edited in place, the picture is the one that a pipeline built for them gives, bit for bit."""
    scene = make_scene()
    with (
        Pipeline(scene, device=device, quality="low") as live,
        Pipeline(edited(scene), device=device, quality="low") as new,
    ):
        before, expected = run(live, frames[:2]), run(new, frames[:2])
        assert (before[1].image != expected[1].image).any()
        live.update(edited(scene))
        np.testing.assert_array_equal(live(frames[2], time_seconds=0.1).image, new(frames[2], time_seconds=0.1).image)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"lights": ()}, "the number of lights differs"),
        ({"objects": ()}, "the number of objects differs"),
        ({"probes": ()}, "probes differs"),
        ({"exposure": Exposure(1.0)}, "other work of .*expose"),
        ({"lights": (Light("directional", 1.0, direction=(0.0, 0.0, -1.0)),)}, r"lights\[0\].kind differs"),
        ({"marker": Marker(size=0.05)}, "marker differs"),
        ({"camera": dataclasses.replace(make_scene().camera, fx=123.0)}, "camera differs"),
    ],
)
def test_update_says_why_it_cannot(changes: dict[str, object], told: str, frames: Frames) -> None:
    with Pipeline(make_scene(), device="cpu", quality="low") as pipeline:
        before = pipeline(frames[0], time_seconds=0.0).image
        with pytest.raises(UpdateError, match=told):
            pipeline.update(make_scene(**changes))
        np.testing.assert_array_equal(pipeline(frames[0], time_seconds=0.0).image, before)


def dimmed(frames: Frames) -> Frames:
    """The frames again and again, darker and brighter: light, and what clips of it, keeps changing."""
    return [np.uint8(image * gain) for gain in (1.0, 0.5, 0.8, 0.4) for image in frames]


def test_handing_over_between_equals_shows_nothing(frames: Frames, device: str) -> None:
    """One pipeline, and two that take turns: light, recovered lamps, exposure and clock go along."""
    quality = PRESETS["low"].with_methods(recover="shading", expose="ball")
    scene = make_scene(exposure=Exposure("auto"), lights=(Light("point", 3.0, at=(0.0, -0.1, 0.3)),))
    outputs = ("image", "environment")
    with contextlib.ExitStack() as stack:
        alone, one, other = (
            stack.enter_context(Pipeline(scene, device=device, quality=quality, outputs=outputs)) for _ in range(3)
        )
        one.warm_up()
        for index, image in enumerate(dimmed(frames)):
            expected = alone(image, time_seconds=index / 30)
            if index > 0:
                one.continue_from(other)
            result = one(image, time_seconds=index / 30)
            np.testing.assert_array_equal(result.environment, expected.environment)
            assert np.abs(result.image.astype(int) - expected.image).max() <= SPARED
            one, other = other, one
        assert 0.0 < other.arrays["expose_scale"].numpy()[0] < 1.0


def test_light_is_kept_at_another_size(frames: Frames, device: str) -> None:
    with contextlib.ExitStack() as stack:
        small, large = (
            stack.enter_context(Pipeline(make_scene(), device=device, quality=quality))
            for quality in (dataclasses.replace(PRESETS["medium"], environment_height=32), PRESETS["medium"])
        )
        run(small, frames)
        for old, new in ((small, large), (large, small)):
            before = old.arrays["environment_radiance"].numpy()
            new.continue_from(old)
            after = new.arrays["environment_radiance"].numpy()
            assert after.shape != before.shape
            seen = old.arrays["environment_confidence"].numpy() > 0.5
            assert after[new.arrays["environment_confidence"].numpy() > 0.5].mean() == pytest.approx(
                before[seen].mean(), rel=RESAMPLED
            )


def test_an_error_while_rendering_is_raised_with_its_result(frames: Frames) -> None:
    with Pipeline(make_scene(), device="cpu", quality="low") as pipeline:

        def fail(receive: Callable[[], None]) -> None:
            raise RuntimeError("broken stage")

        pipeline._scheduler.run = fail  # type: ignore[assignment]
        result = pipeline.submit(frames[0])
        with pytest.raises(RuntimeError, match="broken stage"):
            _ = result.image


def test_a_still_picture_runs_only_what_time_moves(frames: Frames) -> None:
    scene = make_scene(lights=(), exposure=Exposure(1.0))
    with Pipeline(scene, device="cpu", quality="low") as pipeline:
        skipped = []
        for index in range(60):  # the light settles, the tracker too
            result = pipeline(frames[0], time_seconds=index / 30)
            skipped.append({name for name, timing in result.stages.items() if timing.skipped})
    still = ["visibility" in one for one in skipped[50:]]
    assert all(still), "the pose had not changed"
    assert "accumulate" not in skipped[-1], "accumulation follows the clock"
