"""Job files: what they say, and what they are told where they are wrong."""

from __future__ import annotations

import pathlib

import pytest

from tests.farm_rig import CLIPS, make_jobs
from warp_ar.errors import SceneError
from warp_ar.farm.dataset import JobsError
from warp_ar.farm.jobs import Job, job_of_clip, jobs_of_clip, parse_jobs, read_jobs

BALL = '[[dataset.object]]\nshape = "sphere"\nradius = 0.02\n'


def read(folder: pathlib.Path, text: str):
    path = folder / "jobs.toml"
    path.write_text(text, encoding="utf-8")
    return parse_jobs(read_jobs(path), str(path))


def test_segments_cover_every_frame_once(tmp_path):
    jobs = make_jobs(tmp_path, [{"frames": [3, 50]}], run={"segment_frames": 10})
    count = jobs_of_clip(jobs, 0, 120)
    parts = [job_of_clip(jobs, 0, number, 120) for number in range(count)]
    assert [frame for part in parts for frame in range(part.first, part.end)] == list(range(3, 50))
    assert len({part.key(jobs) for part in parts}) == len({part.place(jobs) for part in parts}) == count == 5
    # A clip may be shorter than its range says.
    assert job_of_clip(jobs, 0, 1, 15).end == 15
    assert jobs_of_clip(jobs, 0, 15) == 2


def test_a_clip_without_segments_is_one_job(tmp_path):
    jobs = make_jobs(tmp_path, [{}])
    assert jobs_of_clip(jobs, 0, 120) == 1
    assert job_of_clip(jobs, 0, 0, 120) == Job("segment", 0, 0, 0, 120)


def test_a_pattern_stands_for_every_file_that_it_matches(tmp_path):
    for name in ("b.mp4", "a.mp4", "c d.mp4"):
        (tmp_path / name).write_bytes((CLIPS / "desk.mp4").read_bytes())
    jobs = read(tmp_path, 'schema = 1\n[[clip]]\nscene = "torus"\npath = "*.mp4"\n[[clip]]\npath = "a.mp4"\n')
    assert [clip.name for clip in jobs.clips] == ["a", "b", "c-d", "a-2"]
    assert jobs.clips[0].source == tmp_path / "a.mp4"


def test_paths_are_relative_to_the_job_file_and_survive_a_resume(tmp_path):
    (tmp_path / "here").mkdir()
    (tmp_path / "here/a.mp4").write_bytes((CLIPS / "desk.mp4").read_bytes())
    path = tmp_path / "here/jobs.toml"
    path.write_text('schema = 1\n[[clip]]\npath = "a.mp4"\n')
    data = read_jobs(path)
    assert parse_jobs(data, "run.json").clips[0].source == tmp_path / "here/a.mp4"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("schema = 2\n[[clip]]\n", "schema = 2: expected 1"),
        ("schema = 1\n", "[[clip]] is missing"),
        ("schema = 1\n[[clip]]\nscen = 1\n", 'clip[0].scen: unknown key; did you mean "scene"?'),
        ('schema = 1\n[[clip]]\npath = "no.mp4"\n', 'clip[0].path = "no.mp4": there is no file or folder'),
        ("schema = 1\n[[clip]]\nframes = [5, 2]\n", "clip[0].frames = [5, 2]: expected two whole numbers"),
        ('schema = 1\n[[clip]]\nname = "a/b"\n', 'clip[0].name = "a/b": expected letters'),
        ('schema = 1\n[run]\nquality = "best"\n[[clip]]\n', 'run.quality = "best": expected one of "paper", "low"'),
        ("schema = 1\n[run]\ndigests = 1\n[[clip]]\n", "run.digests = 1: expected True or False"),
        (
            f"schema = 1\n[run]\ndigests = true\n[[clip]]\n[dataset]\n{BALL}",
            "run.digests = true: the manifest has a digest of",
        ),
        ("schema = 1\n[[clip]]\n[dataset]\n", "dataset.objects is missing: expected at least one [[dataset.object]]"),
        (f"schema = 1\n[[clip]]\n[dataset]\nlights = [1, 1]\n{BALL}", "dataset.lights = [1, 1]: expected at least one"),
        (
            f"schema = 1\n[[clip]]\n[dataset]\nregion = [0.1, 0, 0, 1]\n{BALL}",
            "dataset.region = [0.1, 0, 0, 1]: expected [x0, y0, x1, y1]",
        ),
        (
            'schema = 1\n[[clip]]\n[dataset]\n[[dataset.object]]\nshape = "mesh"\nfile = "no.ply"\n',
            'dataset.object[0].file = "no.ply"',
        ),
        (
            'schema = 1\n[[clip]]\n[dataset]\n[[dataset.object]]\nshape = "sphere"\nradius = [0.1, 0.2]\n',
            "expected one value: what is labelled alike has one size",
        ),
        (".".join("a" * 500) + " = 1\n", "a key of more than 16 parts"),
        (f"schema = 1\n[[clip]]\n[dataset]\n{BALL}weight = 0\n", "every weight is 0"),
        (
            f'schema = 1\n[[clip]]\n[dataset]\n{BALL}material = {{ model = "wood" }}\n',
            'model = "wood": expected one of "phong"',
        ),
        (
            f'schema = 1\n[[clip]]\n[dataset]\n{BALL}[[dataset.light]]\nkind = "spot"\n',
            "dataset.light[0].at is missing: expected 3 numbers",
        ),
        (
            f'schema = 1\n[run]\nlight = "preroll"\n[[clip]]\n[dataset]\n{BALL}',
            "a data set needs light that is captured once",
        ),
    ],
)
def test_what_is_wrong_is_told_in_one_line_with_key_and_value(tmp_path, text, told):
    with pytest.raises(JobsError) as caught:
        read(tmp_path, text)
    assert told in str(caught.value)
    assert str(tmp_path / "jobs.toml") in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_mesh_of_a_scene_is_told_before_anything_is_done(tmp_path):
    (tmp_path / "scene.toml").write_text(
        'schema = 1\n[camera]\nfield_of_view = 60\n[source]\npath = "a.mp4"\n[marker]\nsize = 0.08\n'
        '[[object]]\nshape = "mesh"\nfile = "gone.ply"\n'
    )
    with pytest.raises(SceneError, match=r"gone\.ply"):
        read(tmp_path, 'schema = 1\n[[clip]]\nscene = "scene.toml"\n')


def test_a_scene_of_a_camera_is_no_clip(tmp_path):
    (tmp_path / "scene.toml").write_text(
        "schema = 1\n[camera]\nfield_of_view = 60\n[source]\ncamera = 0\n[marker]\nsize = 0.08\n"
    )
    with pytest.raises(JobsError, match="names no recording; give the clip a path"):
        read(tmp_path, 'schema = 1\n[[clip]]\nscene = "scene.toml"\n')


SCENE = """
schema = 1
[camera]
field_of_view = 60
[source]
path = "a.mp4"
{source}
[marker]
size = 0.08
[probe]
center = [-0.12, 0.03, 0.035]
radius = 0.035
{rest}
"""
AUTOMATIC = SCENE.format(source='metering = "automatic"', rest="")
ADAPTING = SCENE.format(source="", rest='[exposure]\nscale = "auto"')


@pytest.mark.parametrize(
    ("scene", "run", "told"),
    [
        (AUTOMATIC, "", 'says source.metering = "automatic", whose drift is measured from all earlier frames'),
        (AUTOMATIC, 'light = "preroll"\nsegment_frames = 4', 'expected run.light = "preroll" without segment_frames'),
        (AUTOMATIC, 'light = "preroll"', None),
        (ADAPTING, "segment_frames = 4", 'says exposure.scale = "auto", which adapts from frame to frame; expected no'),
        (ADAPTING, "", None),
        (ADAPTING, 'light = "preroll"\nsegment_frames = 4', None),
    ],
)
def test_exposures_that_depend_on_frames_before_are_refused_where_a_job_does_not_see_those(tmp_path, scene, run, told):
    (tmp_path / "a.mp4").write_bytes(b"0")
    (tmp_path / "scene.toml").write_text(scene)
    text = f'schema = 1\n[run]\n{run}\n[[clip]]\nscene = "scene.toml"\n'
    if told is None:
        assert read(tmp_path, text).clips[0].name == "scene"
        return
    with pytest.raises(JobsError) as caught:
        read(tmp_path, text)
    assert told in str(caught.value)
    assert "clip scene: " in str(caught.value)
    assert "\n" not in str(caught.value)
