"""A worker decodes, lights and encodes at once: a step that waits for others to go on is not waited for in vain."""

from __future__ import annotations

import threading

from tests.farm_rig import make_jobs, write_recording
from warp_ar.farm.jobs import Context, Job
from warp_ar.farm.video import PartSink
from warp_ar.farm.work import Work
from warp_ar.sources import video_file
from warp_ar.sources.sources import open_source

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
    convert, store, write = video_file.rgb_from_video, PartSink._store, PartSink.write

    def noted_convert(*arguments):
        decoded.release()
        return convert(*arguments)

    def slow_store(self, index, image):
        if not index:
            waited.extend(decoded.acquire(timeout=PATIENCE) for _ in range(2 * AHEAD))
            waited.extend(lit.acquire(timeout=PATIENCE) for _ in range(AHEAD - 1))
        store(self, index, image)

    def noted_write(self, image):
        write(self, image)
        lit.release()

    with Work(Context(jobs, tmp_path / "run", "cpu")) as work:
        assert work.do(Job("survey")).state == "done"
        monkeypatch.setattr(video_file, "rgb_from_video", noted_convert)
        monkeypatch.setattr(PartSink, "_store", slow_store)
        monkeypatch.setattr(PartSink, "write", noted_write)
        outcome = work.do(Job("segment", 0, 0, 0, COUNT))
    assert outcome.state == "done", outcome.reason
    assert waited == [True] * (3 * AHEAD - 1)


def test_pictures_that_are_converted_beside_are_those_of_one_thread(tmp_path):
    write_recording(tmp_path / "a.mp4", COUNT)
    with open_source(tmp_path / "a.mp4") as source:
        alone = [(frame.time, frame.image.tobytes()) for frame in source]
        source._converters = 3
        assert [(frame.time, frame.image.tobytes()) for frame in source] == alone
    assert len({image for _, image in alone}) > 1


def test_frames_before_damage_come_before_its_error():
    class Picture:
        def __init__(self, number):
            self.time = number

    def pictures():
        yield from map(Picture, range(5))
        raise video_file.SourceError("damaged")

    came = []
    try:
        for number in video_file._convert_beside(pictures(), 3, lambda _, picture: picture.time):
            came.append(number)
    except video_file.SourceError as error:
        came.append(str(error))
    assert came == [*range(5), "damaged"]
