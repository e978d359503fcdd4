"""A survey, whose steps run side by side, is to the bit what frames one after another tell."""

from __future__ import annotations

import time

import numpy as np
import pytest

from tests.farm_rig import desk_frames, make_jobs
from warp_ar.engine.pipeline import Pipeline
from warp_ar.farm import survey
from warp_ar.farm.jobs import Context, Job, scene_of
from warp_ar.farm.survey import Survey
from warp_ar.farm.work import Work
from warp_ar.output.sinks import open_sink
from warp_ar.sources.sources import open_source

pytestmark = pytest.mark.slow

LIT, DARK = 8, 7
"""Frames with light that changes, and without any between them: long enough for the marker to be lost."""
RATE = 24
LATE = 0.05
"""Seconds after which a frame's light is asked for: others have been rendered by then."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A recording that loses its marker in the middle."""
    folder = tmp_path_factory.mktemp("survey")
    images = [np.minimum(image, np.uint8(255 - 10 * n)) for n, image in enumerate(desk_frames(2 * LIT))]
    shown = [*images[:LIT], *([np.full_like(images[0], 40)] * DARK), *images[LIT:]]
    with open_sink(folder / "a.mp4", fps=RATE) as sink:
        for image in shown:
            sink.write(image)
    return folder


def surveyed(jobs, run):
    with Work(Context(jobs, run, "cpu")) as work:
        outcome = work.do(Job("survey"))
    assert outcome.state == "done", outcome.reason
    return Survey(run / Job("survey").place(jobs))


def one_after_another(jobs):
    """Poses, keys with their light, and saturation, each frame looked at when the one before is done with."""
    poses, keys, lights = [], [], []
    options = {"outputs": ("pose", "environment"), "estimates": "synchronous", "follows_camera": False}
    quality = jobs.settings.quality
    with (
        open_source(jobs.clips[0].source) as source,
        Pipeline(scene_of(jobs, 0), device="cpu", quality=quality, size=source.size, **options) as pipeline,
    ):
        for frame in source:
            result = pipeline(frame.image, time_seconds=frame.time)
            poses.append(np.full(12, np.nan))
            if result.pose is None:
                continue
            poses[-1][:] = (*result.pose.rotation.ravel(), *result.pose.translation)
            light = np.array(pipeline.arrays["environment"].numpy())
            emitters = pipeline.arrays["emitters"].numpy().tobytes()
            if keys:
                moved = np.abs(light - lights[-1][0]) > survey.CHANGE_FLOOR + survey.CHANGE_SHARE * np.abs(
                    lights[-1][0]
                )
                if emitters == lights[-1][1] and not moved.any():
                    continue
            keys.append(frame.index)
            lights.append((survey._rounded(light), emitters))
        return np.array(poses), keys, lights, pipeline.inputs.saturation.levels


def test_a_survey_is_that_of_frames_one_after_another(folder, tmp_path, monkeypatch):
    take = survey._Look.take

    def take_late(self, *arguments):
        time.sleep(LATE)
        take(self, *arguments)

    monkeypatch.setattr(survey._Look, "take", take_late)
    jobs = make_jobs(folder, [{"scene": "desk", "path": "a.mp4"}])
    found = surveyed(jobs, tmp_path / "run")
    poses, keys, lights, saturation = one_after_another(jobs)
    np.testing.assert_array_equal(found.poses, poses)
    assert np.isnan(poses[LIT + DARK - 1, 0]), "the marker must be lost"
    assert found.keys.tolist() == keys
    assert len(keys) > LIT, "the light must change"
    for key, (light, emitters) in enumerate(lights):
        own, places = found.light(key)
        np.testing.assert_array_equal(own, light)
        assert places.tobytes() == emitters
    np.testing.assert_array_equal(found.saturation, saturation)


def test_fixed_light_is_that_of_the_last_frame_with_a_marker(folder, tmp_path):
    jobs = make_jobs(folder, [{"scene": "desk", "path": "a.mp4", "frames": [0, LIT + DARK]}], run={"light": "fixed"})
    found = surveyed(jobs, tmp_path / "run")
    assert found.keys.tolist() == [0]
    jobs = make_jobs(folder, [{"scene": "desk", "path": "a.mp4", "frames": [0, LIT + DARK]}])
    followed = surveyed(jobs, tmp_path / "followed")
    last = len(followed.keys) - 1
    np.testing.assert_array_equal(found.light(0)[0], followed.light(last)[0])
    assert not np.array_equal(found.light(0)[0], followed.light(0)[0])


def test_what_goes_wrong_beside_fails_the_survey(folder, tmp_path, monkeypatch):
    """In the last frame, too: nobody waits for its light unless it is kept."""

    def fail(self, frame, result):
        if frame == 2 * LIT + DARK - 1:
            raise OSError("no room")

    monkeypatch.setattr(survey._Look, "take", fail)
    jobs = make_jobs(folder, [{"scene": "desk", "path": "a.mp4"}])
    with Work(Context(jobs, tmp_path / "run", "cpu")) as work:
        outcome = work.do(Job("survey"))
    assert outcome.state == "failed"
    assert "no room" in outcome.reason
