"""Recordings of more than 8 bits stay so: read, surveyed, lit, encoded in segments and joined."""

from __future__ import annotations

import hashlib
import json
import os
import pathlib
import subprocess
import sys
from typing import Any

import av
import numpy as np
import pytest

from tests.farm_rig import desk_frames, make_jobs
from warp_ar.engine.layers import RADIANCE
from warp_ar.farm.dataset import JobsError
from warp_ar.farm.jobs import Context, Job, job_of_clip, jobs_of_clip
from warp_ar.farm.lighting import Lighter
from warp_ar.farm.work import Work
from warp_ar.kernels.color import decode_codes
from warp_ar.output.sinks import open_sink
from warp_ar.signals import REC_709, REC_2020, converted, hlg_of_light
from warp_ar.sources.sources import open_source

pytestmark = pytest.mark.slow

COUNT = 6
RATE = 24
PEAK = 2.0
"""Of the recordings' light, over that of the bundled clip."""
LOSS = 6.0 / 876.0
"""Mean error of a signal by two encodings at a constant rate factor of 18, and chroma of half the size."""


def write_deep(path: pathlib.Path, coding: str) -> None:
    """The bundled desk as light, some of it above white."""
    with open_sink(path, fps=RATE, coding=coding) as sink:
        for image in desk_frames(COUNT):
            light = decode_codes("srgb", image.reshape(-1) / 255.0)[:, 0].reshape(image.shape)
            sink.write((PEAK * light).astype(np.float32))


def run_all(folder: pathlib.Path, name: str, **run: Any) -> tuple[Any, pathlib.Path]:
    """Survey the clip, light its segments and join them; the job file and the run's folder."""
    jobs = make_jobs(folder, [{"scene": "torus", "path": "a.mp4"}], run={"quality": "low", **run})
    with Work(Context(jobs, folder / name, "cpu")) as work:
        todo = [Job("survey")]
        for job in todo:
            outcome = work.do(job)
            assert outcome.state == "done", outcome.reason
            if job.kind == "survey":
                count = jobs_of_clip(jobs, 0, COUNT)
                todo += [job_of_clip(jobs, 0, number, COUNT) for number in range(count)]
                todo.append(Job("join"))
    return jobs, folder / name


def signal(radiance: np.ndarray) -> np.ndarray:
    return hlg_of_light(converted(radiance, REC_709, REC_2020))


def deep_frames(path: pathlib.Path) -> list[np.ndarray]:
    with open_source(path) as source:
        source.keeps_depth = True
        return [frame.deep.radiance("srgb") for frame in source]


def tags(path: pathlib.Path) -> tuple[str, ...]:
    keys = "codec_name,codec_tag_string,pix_fmt,color_transfer,color_primaries,color_space"
    try:
        command = ["ffprobe", "-v", "error", "-select_streams", "v", "-show_entries", f"stream={keys}", "-of", "json"]
        said = subprocess.run([*command, str(path)], capture_output=True, check=True, timeout=60).stdout
    except FileNotFoundError:
        pytest.skip("ffprobe is not installed")
    (stream,) = json.loads(said)["streams"]
    return tuple(stream.get(key, "") for key in keys.split(","))


def test_segments_of_a_deep_recording_are_joined_as_deep_as_it_came(tmp_path: pathlib.Path) -> None:
    write_deep(tmp_path / "a.mp4", "hlg")
    jobs, parts = run_all(tmp_path, "parts", segment_frames=3, digests=True)
    _, whole = run_all(tmp_path, "whole")
    with Lighter(jobs, parts, "cpu") as lighter:

        def lit(first: int, end: int) -> list[np.ndarray]:
            job = Job("segment", 0, 0, first, end)
            return [item.radiance.copy() for item in lighter.light(job, outputs=(RADIANCE,))]

        one = lit(0, COUNT)
        for first in (3, 0):
            for number, picture in enumerate(lit(first, first + 3), first):
                np.testing.assert_array_equal(picture, one[number], err_msg=f"frame {number}")
    joined, alone, before = deep_frames(parts / "a.mp4"), deep_frames(whole / "a.mp4"), deep_frames(tmp_path / "a.mp4")
    assert len(joined) == COUNT
    for a, b, picture in zip(joined, alone, one, strict=True):
        for got in (a, b):
            assert np.abs(signal(got) - signal(picture)).mean() < LOSS
    assert (parts / "a.sha256").read_text().split() == [
        hashlib.sha256(picture.tobytes()).hexdigest() for picture in one
    ]
    # What nothing virtual touches keeps its depth: steps that 8 bits do not have, and light above white.
    same = np.abs(one[0] - before[0]).max(-1) == 0.0
    assert same.mean() > 0.3
    assert len(np.unique(signal(one[0][same])[:, 1].round(5))) > 300
    assert one[0].max() > 1.5
    assert tags(parts / "a.mp4") == ("hevc", "hvc1", "yuv420p10le", "arib-std-b67", "bt2020", "bt2020nc")
    with av.open(str(parts / "a.mp4")) as container:
        stamps = [packet.pts * packet.time_base for packet in container.demux(video=0) if packet.size]
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert stamps == sorted(p.pts * p.time_base for p in container.demux(video=0) if p.size)


def test_a_run_says_what_is_written(tmp_path: pathlib.Path) -> None:
    write_deep(tmp_path / "a.mp4", "pq")
    _, run = run_all(tmp_path, "run", coding="8bit")
    assert tags(run / "a.mp4")[::2] == ("h264", "yuv420p", "bt709")
    with pytest.raises(JobsError, match=r'run\.coding = "9bit": expected one of "recorded", "8bit", "10bit"'):
        run_all(tmp_path, "bad", coding="9bit")


ENCODE = """
import hashlib, sys
from fractions import Fraction
from pathlib import Path
from tests.farm_rig import desk_frames
from warp_ar.farm.video import open_part_sink
from warp_ar.kernels.color import decode_codes
for coding in ("8bit", "10bit"):
    with open_part_sink(Path(sys.argv[1]), Fraction(1, 600), 24.0, coding, "srgb") as sink:
        for number, image in enumerate(desk_frames(4)):
            codes = decode_codes("srgb", image.reshape(-1) / 255.0)[:, 0].reshape(image.shape).astype("float32")
            sink.write_at(image if coding == "8bit" else codes, number / 24.0)
    print(hashlib.sha256(open(sys.argv[1], "rb").read()).hexdigest())
"""


def test_bytes_do_not_depend_on_what_memory_held(tmp_path: pathlib.Path) -> None:
    """glibc fills what it hands out: an encoder that reads what it never wrote gives other bytes then."""
    made = set()
    for fill in ("0", "170"):
        command = [sys.executable, "-c", ENCODE, str(tmp_path / "a.mp4")]
        environment = {**os.environ, "MALLOC_PERTURB_": fill}
        root = pathlib.Path(__file__).resolve().parents[1]
        made.add(subprocess.run(command, env=environment, cwd=root, capture_output=True, check=True).stdout)
    assert len(made) == 1
