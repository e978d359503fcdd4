"""Segments and variations are bit for bit what one run gives, whatever was lit before them."""

from __future__ import annotations

import dataclasses
import hashlib
import weakref

import cv2
import numpy as np
import pytest

from tests.farm_rig import TICK, desk_frames, make_jobs, write_recording
from warp_ar.engine.pipeline import Pipeline
from warp_ar.errors import SourceError, UsageError
from warp_ar.farm import codes as device_video
from warp_ar.farm.jobs import Context, Job, job_of_clip, jobs_of_clip
from warp_ar.farm.lighting import PIPELINES, Lighter
from warp_ar.farm.survey import Survey, lit_scene
from warp_ar.farm.video import PartSink
from warp_ar.farm.work import Work
from warp_ar.kernels.picture.video_color import rgb_factors
from warp_ar.scene import Animation, Object, dumps_scene, load_scene
from warp_ar.session import Session
from warp_ar.sources.sources import open_source

COUNT = 10
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


@pytest.mark.parametrize("light", ["follow", "fixed"])
def test_segments_are_bit_equal_to_one_run_where_light_is_given(folder, light):
    jobs, run = surveyed(folder, light=light)
    whole = lit_whole(jobs, run)
    with Lighter(jobs, run, "cpu") as lighter:
        parts = {first: lit(lighter, first, min(first + 4, COUNT)) for first in (8, 0, 4)}
    for first, images in parts.items():
        for number, image in enumerate(images, first):
            np.testing.assert_array_equal(image, whole[number], err_msg=f"frame {number}")
    assert np.abs(whole[0].astype(int) - whole[-1]).max() > 20, "the clip must show something that changes"


def encoded(pictures, path):
    """Bytes of a segment's file."""
    ticks = [25 * n for n in range(COUNT)]
    with PartSink(path, ticks, TICK, 24.0) as sink:
        for picture in pictures:
            sink.write(picture)
    return path.read_bytes()


@pytest.mark.parametrize("decode", ["cpu", "gpu"])
def test_what_the_device_converts_is_what_the_host_does(folder, tmp_path, decode, device):
    _, run = surveyed(folder, light="follow")
    jobs = make_jobs(folder, [{"scene": "scene.toml", "path": "a.mp4"}], run={"quality": "low", "decode": decode})
    with Lighter(jobs, run, device) as lighter:
        whole = lit(lighter, 0, COUNT)
    with open_source(folder / "a.mp4") as source:
        whole[4] = list(source)[4].image
    with Lighter(jobs, run, device, device_converts=True) as lighter:
        lighter.survey(0).poses[4] = np.nan  # without a marker a picture passes as it came
        coded = list(lighter_codes(lighter, keep_rgb=True))
        assert len(coded) == COUNT
        for number, (_, image) in enumerate(coded):
            np.testing.assert_array_equal(image, whole[number], err_msg=f"frame {number}")
        ours = encoded((picture for picture, _ in lighter_codes(lighter)), tmp_path / "device.mp4")
    assert ours == encoded(whole, tmp_path / "host.mp4")


def lighter_codes(lighter, **how):
    """Codes and, where it is asked for, RGB of the clip's pictures."""
    for lit in lighter.light(Job("segment", 0, 0, 0, COUNT), coded=True, **how):
        assert lit.coded is not None
        if not how:
            with pytest.raises(UsageError, match="keep_rgb"):
                _ = lit.image
        yield lit.coded, lit.image if how else None


def test_pictures_that_the_device_would_convert_in_another_way_go_to_the_host(folder, monkeypatch):
    jobs, run = surveyed(folder, light="follow")
    whole = lit_whole(jobs, run)
    monkeypatch.setattr(device_video, "rgb_factors", lambda matrix, full_range: rgb_factors("bt601", full_range=True))
    with Lighter(jobs, run, "cpu", device_converts=True) as lighter:
        for number, lit in enumerate(lighter.light(Job("segment", 0, 0, 0, COUNT), coded=True)):
            assert lit.coded is None
            np.testing.assert_array_equal(lit.image, whole[number])


def test_pictures_of_a_folder_have_no_codes_for_the_device(folder):
    (folder / "pictures").mkdir()
    for number, image in enumerate(desk_frames(3)):
        cv2.imwrite(str(folder / f"pictures/{number}.png"), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    jobs = make_jobs(folder, [{"scene": "scene.toml", "path": "pictures"}])
    assert do_survey(jobs, folder / "of-pictures").state == "done"
    with Lighter(jobs, folder / "of-pictures", "cpu", device_converts=True) as lighter:
        coded = list(lighter.light(Job("segment", 0, 0, 0, 3), coded=True))
        plain = [lit.image.copy() for lit in lighter.light(Job("segment", 0, 0, 0, 3))]
        assert [lit.coded for lit in coded] == [None] * 3
        np.testing.assert_array_equal(coded[-1].image, plain[-1])


@pytest.mark.parametrize("quality", ["low", "medium"])
def test_a_surveyed_clip_is_lit_as_a_live_one(folder, quality):
    jobs, run = surveyed(folder, quality=quality)
    whole = lit_whole(jobs, run)
    with Session(folder / "scene.toml", source=folder / "a.mp4", quality=quality, device="cpu") as session:
        live = [result.image for _, result in session]
    for a, b in zip(whole, live, strict=True):
        assert np.abs(a.astype(int) - b).max() <= MOST_CODES


@pytest.mark.parametrize("light", ["follow", "fixed"])
def test_digests_are_those_of_pictures_before_they_are_encoded(folder, light):
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
        for number, image in enumerate(lit(lighter, 6, COUNT), 6):
            np.testing.assert_array_equal(image, live[number])


def test_pipelines_of_scenes_that_have_gone_are_let_go(folder):
    jobs, run = surveyed(folder, light="fixed")
    kept = []
    with Lighter(jobs, run, "cpu") as lighter:
        base = lit_scene(jobs, 0, lighter.survey(0))
        for count in range(1, PIPELINES + 3):
            balls = tuple(Object("sphere", radius=0.02, at=(0.05 * n - 0.2, -0.1, 0.02)) for n in range(count))
            scene = dataclasses.replace(base, objects=balls, lights=())
            kept.append(weakref.ref(list(lighter.light(Job("variation", 0, count, 0, 2), scene))[-1].pipeline))
            assert kept[-1]() is not None
        assert [ref() is not None for ref in kept] == [False] * 2 + [True] * PIPELINES


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


def test_a_clock_is_started_before_the_first_frame():
    image = np.zeros((480, 640, 3), np.uint8)
    with Pipeline("torus", quality="low", device="cpu") as pipeline:
        pipeline.start_clock(1.0)
        pipeline(image, time_seconds=3.0)
        with pytest.raises(UsageError, match="start_clock comes before the first frame"):
            pipeline.start_clock(1.0)


def test_restart_and_take_light_say_what_they_need():
    with Pipeline("torus", quality="low", device="cpu") as pipeline:
        with pytest.raises(UsageError, match="restart needs a captured light"):
            pipeline.restart()
        with pytest.raises(UsageError, match="take_light needs a scene with a captured light"):
            pipeline.take_light(np.zeros((64, 128, 3), np.float32))


def test_light_of_another_size_is_refused(folder):
    jobs, run = surveyed(folder, light="fixed")
    with Lighter(jobs, run, "cpu") as lighter:
        pipeline = list(lighter.light(Job("segment", 0, 0, 0, 2)))[-1].pipeline
        with pytest.raises(UsageError, match=r"light is \(2, 4, 3\); this pipeline's environment is \(64, 128, 3\)"):
            pipeline.take_light(np.zeros((2, 4, 3), np.float32))
