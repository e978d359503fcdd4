"""What many GPUs would take, of a few figures: the arithmetic, the errors, and the tables of the documentation."""

from __future__ import annotations

import dataclasses
import pathlib

import pytest

from warp_ar.errors import UsageError
from warp_ar.farm.cli import main
from warp_ar.farm.plan import Plan
from warp_ar.farm.scale import Figures, Task, read_figures, scale_task

ROOT = pathlib.Path(__file__).resolve().parents[1]
FIGURES = ROOT / "docs" / "examples" / "figures.toml"
PLAIN = (
    "kernel_ms = 1\nprocessor_ms = 40\nsurvey_ms = 10\nsurvey_processor_ms = 12\njob_s = 2\n"
    "frame_bytes = 1e5\ncores = 16\nworkers = 10\n"
)
TASK = "[[work]]\nclips = 1\nframes = 6000\nsegment_frames = 100\n"


def figures(**changes: float) -> Figures:
    values = {"kernel_ms": 1, "processor_ms": 40, "survey_ms": 10, "job_s": 2, "frame_bytes": 1e5, "cores": 16}
    return Figures(**{"workers": 10, "survey_processor_ms": 12, **values, **changes})


def task(clips: int = 1, frames: int = 6000, variations: int = 0, segment: int = 100, **changes: float) -> Task:
    return Task("", clips, frames, variations, segment, figures(**changes))


def test_a_row_by_hand():
    """16 cores at 40 ms: 400 frames a second of ten workers, 40 each; a job of 100 frames takes 2 + 2.5 s."""
    row = scale_task(task(), 1)
    assert (row.bound, row.survey_s) == ("cores", 60.0)
    assert row.lighting_s == pytest.approx(6 * 4.5)  # 60 jobs on ten workers
    assert row.frames_per_s == pytest.approx(6000 / 27.0)
    assert row.bytes_per_s == pytest.approx(6000 / 27.0 * 1e5)
    assert row.jobs_per_s == pytest.approx(60 / 27.0)
    # Seven GPUs have 70 workers for 60 jobs: one round, and no more GPUs help.
    assert scale_task(task(), 7).lighting_s == scale_task(task(), 100).lighting_s == pytest.approx(4.5)
    assert scale_task(task(), 100).bound == "rounds"
    assert scale_task(task(processor_ms=10), 1).bound == "GPU"


def test_variations_are_a_job_each_and_surveys_run_side_by_side():
    row = scale_task(task(clips=40, frames=8, variations=5), 2)
    assert row.survey_s == pytest.approx(2 * 8 * 0.01)  # 40 clips on 20 workers
    assert row.lighting_s == pytest.approx(10 * (2.0 + 8 / 40.0))
    # Ten surveys at once at 32 ms of processor time each keep 16 cores busy for 20 ms a frame of each.
    assert scale_task(task(clips=40, frames=8, survey_processor_ms=32), 2).survey_s == pytest.approx(2 * 8 * 0.02)
    assert scale_task(task(clips=4, frames=8, survey_processor_ms=32), 2).survey_s == pytest.approx(8 * 0.01)


def test_a_plan_has_a_clip_surveyed_by_one_worker_and_a_job_done_by_one():
    """2 clips and 3 jobs: of more workers the others have nothing to do."""
    plan = Plan(2, 3, 100, 200, survey_ms=10, clip_ms=1000, frame_ms=20, job_ms=500, bytes=0, survey_bytes=0)
    assert plan.seconds(1) == pytest.approx(2.0 + 2.0 + 2.0 + 1.5)
    assert plan.seconds(8) == pytest.approx(4.0 / 2 + 3.5 / 3)
    assert dataclasses.replace(plan, surveyed=0).seconds(1) == pytest.approx(3.5)


def test_the_documented_tables_are_those_of_the_command(capsys):
    assert main(["plan", "--figures", str(FIGURES)]) == 0
    told = capsys.readouterr().out.strip()
    assert told in (ROOT / "docs" / "farm.md").read_text(encoding="utf-8")
    assert main(["plan", "--figures", str(FIGURES), "--gpus", "3"]) == 0
    assert "\n| 3 |" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (PLAIN, r"\[\[work\]\] is missing: name at least one"),
        (PLAIN.replace("cores = 16\n", "") + TASK, "cores is missing; expected a positive number"),
        (PLAIN.replace("= 40", "= -1") + TASK, "processor_ms = -1: expected a positive number"),
        (PLAIN + TASK + "clip = 3\n", r"work\[0\]: clip is unknown; expected kernel_ms"),
        (PLAIN + "[[work]]\nclips = 1\n", r"work\[0\]: frames is missing"),
    ],
)
def test_wrong_figures_get_one_line(tmp_path, text, line):
    (tmp_path / "figures.toml").write_text(text)
    with pytest.raises(UsageError, match=line):
        read_figures(tmp_path / "figures.toml")


def test_wrong_commands_get_one_line(capsys):
    for arguments, line in (
        (["plan"], "name a job file, or --figures FILE"),
        (["plan", "--figures", str(FIGURES), "--gpus", "1,x"], "--gpus 1,x: expected numbers from 1 on"),
    ):
        assert main(arguments) == 2
        assert line in capsys.readouterr().err
