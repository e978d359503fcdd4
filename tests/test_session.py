"""A session whose scene and quality change while its frames flow."""

from __future__ import annotations

import dataclasses
import itertools
import os
import signal

import numpy as np
import pytest

from tests.test_pipeline import make_scene
from warp_ar import session as session_module
from warp_ar.engine.pipeline import Pipeline
from warp_ar.errors import SceneError, SourceError, UsageError
from warp_ar.scene import Camera, Light, SourceSpec
from warp_ar.session import Session
from warp_ar.stages.quality import PRESETS

pytestmark = pytest.mark.slow


def scene(**changes: object):
    return make_scene(source=SourceSpec(synthetic="card"), **changes)


def test_frames_after_a_change_are_those_of_the_new_scene_and_quality() -> None:
    dark = scene(lights=(), objects=())
    with Session(scene(), device="cpu", quality="low") as session:
        frames = iter(session)
        frame, result = next(frames)
        first = session.pipeline
        held = result
        # Numbers alone change in place.
        session.change(scene=scene(lights=(Light("point", 2.0, at=(0.05, -0.1, 0.2)),)))
        assert session.pipeline is first
        session.change(scene=dark, quality="paper")
        assert isinstance(session.pipeline, Pipeline)
        assert session.pipeline.quality == PRESETS["paper"]
        times = [frame.time]
        for _ in range(3):  # the next one was under way already
            frame, result = next(frames)
            times.append(frame.time)
        assert times == sorted(times)
        assert "shade" not in result.stages
        np.testing.assert_array_equal(held.image.shape, result.image.shape)


def test_the_first_frame_is_handed_out_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """From the second on the next one is begun before; all come in order, each once."""
    with Session(scene(), device="cpu", quality="low") as session:
        begun: list[float] = []
        submit = session.pipeline.submit

        def noted(image: object, *, time_seconds: float, **more: object):
            begun.append(time_seconds)
            return submit(image, time_seconds=time_seconds, **more)

        monkeypatch.setattr(session.pipeline, "submit", noted)
        handed_out, under_way = [], []
        for frame, _ in itertools.islice(session, 4):
            handed_out.append(frame.time)
            under_way.append(len(begun))
    assert under_way == [1, 3, 4, 5]
    assert handed_out == begun[:4]


def test_what_cannot_be_shown_changes_nothing() -> None:
    with Session(scene(), device="cpu", quality="low") as session:
        frames = iter(session)
        next(frames)
        before = session.scene
        with pytest.raises(UsageError, match="no preset"):
            session.change(quality="best")
        with pytest.raises(UsageError, match=r"scene = .*: expected Scene"):
            session.change(scene="desk")
        camera = dataclasses.replace(scene().camera, width=320, height=200)
        assert isinstance(camera, Camera)
        with pytest.raises(SceneError):
            session.change(scene=scene(camera=camera))
        assert session.scene == before
        next(frames)
        session.change(quality="paper")
        assert session.pipeline.quality.name == "paper"


@pytest.mark.parametrize(
    ("live", "quality", "expected"),
    [
        (False, "low", "synchronous"),
        (True, "low", "real_time"),
        (False, "auto", "delayed"),
        (True, "auto", "real_time"),
    ],
)
def test_no_frame_of_a_camera_waits_for_an_estimate(
    monkeypatch: pytest.MonkeyPatch, live: bool, quality: str, expected: str
) -> None:
    open_it = session_module.open_scene_source

    def opened(*arguments, **options):
        source = open_it(*arguments, **options)
        source.live = live
        return source

    monkeypatch.setattr(session_module, "open_scene_source", opened)
    with Session(scene(), device="cpu", quality=quality) as session:
        assert session.pipeline.plan.request.estimates == expected
        if quality == "auto":
            with pytest.raises(UsageError, match="chooses its methods itself"):
                session.change(quality="low")


def test_threads_end_though_the_source_cannot_be_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> None:
        raise SourceError("the device has gone")

    session = Session(scene(), device="cpu", quality="low")
    pipeline = session.pipeline
    monkeypatch.setattr(session.source, "close", fail)
    with pytest.raises(SourceError):
        session.close()
    with pytest.raises(UsageError, match="closed"):
        pipeline.warm_up()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_a_fork_of_a_session_that_iterates_is_told() -> None:
    """Neither its next frame nor its end waits for a thread of the parent, which goes on."""
    with Session(scene(), device="cpu", quality="paper") as session:
        frames = iter(session)
        next(frames)
        read, write = os.pipe()
        if (child := os.fork()) == 0:
            signal.alarm(20)
            try:
                next(frames)
            except UsageError as error:
                session.close()
                os.write(write, str(error).encode())
            finally:
                os._exit(0)
        os.close(write)
        with os.fdopen(read, "rb") as told:
            assert b"start processes by spawn" in told.read()
        os.waitpid(child, 0)
        assert next(frames)[1].image.any()
