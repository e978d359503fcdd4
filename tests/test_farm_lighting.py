"""Segments and variations are bit for bit what one run gives, whatever was lit before them."""

from __future__ import annotations

import dataclasses
import hashlib

import cv2
import numpy as np
import pytest

from tests.farm_rig import make_jobs, write_recording
from warp_ar.engine.pipeline import Pipeline
from warp_ar.errors import SourceError, UsageError
from warp_ar.farm.jobs import Context, Job, job_of_clip, jobs_of_clip
from warp_ar.farm.lighting import Lighter
from warp_ar.farm.survey import Survey
from warp_ar.farm.work import Work
from warp_ar.scene import Animation, dumps_scene, load_scene
from warp_ar.session import Session

pytestmark = pytest.mark.slow

COUNT = 6
MOST_CODES = 2
"""By which a surveyed clip may differ from a live one: one for the light's tolerance (one 8-bit step of a texel), one
for rounding in a picture that both compose."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A clip, and the desk with a teapot that turns."""
    folder = tmp_path_factory.mktemp("farm")
    write_recording(folder / "a.mp4", COUNT)
    desk = load_scene("desk")
    turning = tuple(dataclasses.replace(item, animate=Animation(turn=(0.0, 0.0, 90.0))) for item in desk.objects)
    scene = dataclasses.replace(desk, objects=turning, source=None)
    (folder / "scene.toml").write_text(dumps_scene(scene), encoding="utf-8")
    return folder


def do_survey(jobs, run_folder):
    with Work(Context(jobs, run_folder, "cpu")) as work:
        return work.do(Job("survey"))


def surveyed(folder, **run):
    """Job file and run folder of the clip, surveyed."""
    jobs = make_jobs(folder, [{"scene": "scene.toml", "path": "a.mp4"}], run={"quality": "low", **run})
    name = "-".join(f"{key}-{value}" for key, value in run.items()) or "default"
    run_folder = folder / name
    if not run_folder.exists():
        outcome = do_survey(jobs, run_folder)
        assert outcome.state == "done", outcome.reason
        assert outcome.values["length"] == COUNT
    return jobs, run_folder


def lit(lighter, first, end):
    return [lit.image.copy() for lit in lighter.light(Job("segment", 0, 0, first, end))]


def lit_whole(jobs, run):
    with Lighter(jobs, run, "cpu") as lighter:
        return lit(lighter, 0, COUNT)


def test_a_surveyed_clip_is_lit_as_a_live_one(folder):
    jobs, run = surveyed(folder, quality="medium")
    whole = lit_whole(jobs, run)
    with Session(folder / "scene.toml", source=folder / "a.mp4", quality="medium", device="cpu") as session:
        live = [result.image for _, result in session]
    for a, b in zip(whole, live, strict=True):
        assert np.abs(a.astype(int) - b).max() <= MOST_CODES


def test_digests_are_those_of_pictures_before_they_are_encoded(folder):
    light = "follow"
    _, plain = surveyed(folder, light=light)
    texts = []
    for size in (4, COUNT):
        jobs = make_jobs(
            folder,
            [{"scene": "scene.toml", "path": "a.mp4"}],
            run={"quality": "low", "light": light, "digests": True, "segment_frames": size},
        )
        run = folder / f"digests-{light}-{size}"
        with Work(Context(jobs, run, "cpu")) as work:
            segments = [job_of_clip(jobs, 0, number, COUNT) for number in range(jobs_of_clip(jobs, 0, COUNT))]
            for job in (Job("survey"), *reversed(segments), Job("join")):
                outcome = work.do(job)
                assert outcome.state == "done", outcome.reason
        texts.append((run / "a.sha256").read_text())
    assert texts[0] == texts[1]
    jobs, run = surveyed(folder, light=light)
    assert texts[0].split() == [hashlib.sha256(image.tobytes()).hexdigest() for image in lit_whole(jobs, plain)]
    assert len(set(texts[0].split())) == COUNT


def test_a_preroll_over_all_frames_is_the_live_run(folder):
    jobs, run = surveyed(folder, light="preroll", preroll=COUNT)
    with Session(folder / "scene.toml", source=folder / "a.mp4", quality="low", device="cpu") as session:
        live = [result.image for _, result in session]
    with Lighter(jobs, run, "cpu") as lighter:
        for number, image in enumerate(lit(lighter, 3, COUNT), 3):
            np.testing.assert_array_equal(image, live[number])


def test_a_clip_without_a_marker_fails_with_its_reason(folder):
    (folder / "blank").mkdir()
    for number in range(3):
        cv2.imwrite(str(folder / f"blank/{number}.png"), np.full((240, 320, 3), 90, np.uint8))
    jobs = make_jobs(folder, [{"scene": "torus", "path": "blank"}])
    outcome = do_survey(jobs, folder / "none")
    assert outcome.state == "failed"
    assert "no marker was found in frames 0 to 2" in outcome.reason
    assert "no marker was found" in (folder / "none/log/blank/survey.log").read_text()
    assert not list((folder / "none/.aside").iterdir())


def test_the_survey_is_the_same_bytes_again_and_says_what_is_damaged(folder):
    jobs, run = surveyed(folder, light="follow")
    again = folder / "again"
    do_survey(jobs, again)
    place = Job("survey").place(jobs)
    assert (run / place / "survey.npz").read_bytes() == (again / place / "survey.npz").read_bytes()
    data = (again / place / "survey.npz").read_bytes()
    (again / place / "survey.npz").write_bytes(data[: len(data) // 2])
    with pytest.raises(SourceError, match=r"survey\.npz cannot be read"):
        Survey(again / place)


def test_a_survey_holds_light_until_it_moves(folder):
    jobs, run = surveyed(folder, light="follow")
    survey = Survey(run / Job("survey").place(jobs))
    assert survey.keys[0] == 0
    assert survey.key_of(int(survey.keys[-1])) == len(survey.keys) - 1
    radiance, emitters = survey.light(0)
    assert radiance.shape == (64, 128, 3)
    assert emitters is not None, "quality low finds places of emitters"
    assert survey.pose(0) is not None
    jobs, run = surveyed(folder, quality="paper")
    _, emitters = Survey(run / Job("survey").place(jobs)).light(0)
    assert emitters is None, "quality paper does not"


def test_restart_and_take_light_say_what_they_need():
    with Pipeline("torus", quality="low", device="cpu") as pipeline:
        with pytest.raises(UsageError, match="restart needs a captured light"):
            pipeline.restart()
        with pytest.raises(UsageError, match="take_light needs a scene with a captured light"):
            pipeline.take_light(np.zeros((64, 128, 3), np.float32))
