"""A worker decodes, lights and encodes at once: a step that waits for others to go on is not waited for in vain."""

from __future__ import annotations

import threading

import pytest

from tests.farm_rig import make_jobs, write_recording
from warp_ar.farm.jobs import Context, Job
from warp_ar.farm.work import Work
from warp_ar.output.video_sink import VideoSink
from warp_ar.sources import video_file

pytestmark = pytest.mark.slow

COUNT = 12
AHEAD = 4
"""Frames by which the first one's encoding lets others be ahead."""
PATIENCE = 60.0
"""Seconds within which a step that runs beside another comes."""


def test_frames_are_decoded_and_lit_while_one_is_encoded(tmp_path, monkeypatch):
    write_recording(tmp_path / "a.mp4", COUNT)
    jobs = make_jobs(tmp_path, [{"scene": "torus", "path": "a.mp4"}])
    decoded, lit = threading.Semaphore(0), threading.Semaphore(0)
    waited = []
    convert, store, write = video_file.rgb_from_video, VideoSink._store, VideoSink.write

    def noted_convert(*arguments):
        decoded.release()
        return convert(*arguments)

    def slow_store(self, index, image):
        if not index:
            waited.extend(decoded.acquire(timeout=PATIENCE) for _ in range(AHEAD))
            waited.extend(lit.acquire(timeout=PATIENCE) for _ in range(AHEAD - 1))
        store(self, index, image)

    def noted_write(self, image):
        write(self, image)
        lit.release()

    with Work(Context(jobs, tmp_path / "run", "cpu")) as work:
        assert work.do(Job("survey")).state == "done"
        monkeypatch.setattr(video_file, "rgb_from_video", noted_convert)
        monkeypatch.setattr(VideoSink, "_store", slow_store)
        monkeypatch.setattr(VideoSink, "write", noted_write)
        outcome = work.do(Job("segment", 0, 0, 0, COUNT))
    assert outcome.state == "done", outcome.reason
    assert waited == [True] * (2 * AHEAD - 1)
