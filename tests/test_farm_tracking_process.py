"""Frames and tracks of another process are those of this one; whoever dies, the other does not wait for it."""

from __future__ import annotations

import subprocess
import sys
import textwrap
import time
import weakref
from pathlib import Path

import numpy as np
import pytest

from tests.farm_rig import SIZE, write_recording
from warp_ar.errors import SourceError
from warp_ar.farm.frames import index_frames, open_part
from warp_ar.farm.tracking_process import Reading, TrackingProcess, can_share
from warp_ar.scene import load_scene
from warp_ar.tracking.tracking import Tracker

COUNT = 14
SLOTS = 4
PATIENCE = 60.0
"""Seconds within which a process that shall end has ended."""

pytestmark = pytest.mark.skipif(not can_share(), reason="needs memory that goes with the last process that uses it")


def reading_of(path, first=0, end=COUNT):
    scene = load_scene("desk")
    camera = scene.camera.scaled_to(*SIZE)
    return Reading(path, index_frames(path, None), first, end, None, None, 2, scene.marker, camera, SLOTS)


def told(track):
    pose = None if track.pose is None else (track.pose.rotation.tobytes(), track.pose.translation.tobytes())
    return pose, track.state, track.quality, track.reprojection_error


@pytest.mark.parametrize(("first", "end"), [(0, COUNT), (3, 11), (5, 6)])
def test_frames_and_tracks_are_those_of_this_process(tmp_path, first, end):
    path = tmp_path / "a.mp4"
    write_recording(path, COUNT)
    reading, held = reading_of(path, first, end), 2
    tracker, shown = Tracker(reading.marker, reading.camera), []
    with (
        open_part(path, reading.index, first, end, None) as source,
        TrackingProcess(reading, held=held) as beside,
    ):
        for own, (frame, track) in zip(source, beside, strict=True):
            shown.append((own.image, frame.image))
            assert (frame.index, frame.time) == (own.index, own.time)
            assert told(track) == told(tracker.track(own.image, own.time))
            for expected, image in shown[-held:]:
                np.testing.assert_array_equal(image, expected)
    assert len({image.tobytes() for image, _ in shown}) > 1 or len(shown) == 1


def test_no_more_pictures_come_than_there_is_room_for(tmp_path):
    path = tmp_path / "a.mp4"
    write_recording(path, COUNT)
    with TrackingProcess(reading_of(path), held=2) as beside:
        frames = iter(beside)
        kept = [next(frames)[0] for _ in range(2)]
        before = [frame.image.copy() for frame in kept]
        time.sleep(1.0)  # in which the other process would have gone on
        for frame, image in zip(kept, before, strict=True):
            np.testing.assert_array_equal(frame.image, image)
        assert sum(1 for _ in frames) == COUNT - 2


def test_what_goes_wrong_there_is_told_here_after_the_frames_before_it(tmp_path):
    path, short = tmp_path / "a.mp4", COUNT - 4
    write_recording(path, COUNT)
    reading = reading_of(path, 1)
    write_recording(path, short)
    came = []
    with TrackingProcess(reading, held=2) as beside, pytest.raises(SourceError, match=rf"ends before frame {short}"):
        came.extend(frame.index for frame, _ in beside)
    assert came == list(range(1, short))


def test_a_process_that_dies_is_an_error_here(tmp_path):
    path = tmp_path / "a.mp4"
    write_recording(path, COUNT)
    with TrackingProcess(reading_of(path), held=2) as beside:
        frames = iter(beside)
        next(frames)
        beside._process.kill()
        with pytest.raises(EOFError, match="gone"):
            list(frames)


def test_it_ends_with_the_process_that_started_it(tmp_path):
    path = tmp_path / "a.mp4"
    write_recording(path, COUNT)
    code = f"""
        import os, sys
        sys.path.insert(0, {str(Path(__file__).parents[1])!r})
        from pathlib import Path
        from tests.test_farm_tracking_process import TrackingProcess, reading_of
        beside = TrackingProcess(reading_of(Path({str(path)!r})), held=2)
        next(iter(beside))
        print(beside._process.pid, flush=True)
        os.kill(os.getpid(), 9)
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], stdout=subprocess.PIPE, check=False)
    pid = int(done.stdout)
    deadline = time.monotonic() + PATIENCE
    while _lives(pid):
        assert time.monotonic() < deadline, "it goes on without anybody who asks"
        time.sleep(0.05)


def _lives(pid: int) -> bool:
    """Whether a process is there and has not ended; one that has may wait for somebody to hear of it."""
    try:
        return "\nState:\tZ" not in Path(f"/proc/{pid}/status").read_text(encoding="ascii")
    except OSError:
        return False


def test_where_memory_cannot_be_shared_it_is_said(monkeypatch):
    def refuse(_):
        raise OSError("not here")

    monkeypatch.setattr("os.memfd_create", refuse)
    assert not can_share()
    monkeypatch.delattr("os.memfd_create")
    assert not can_share()


def test_memory_goes_with_the_last_picture(tmp_path):
    path = tmp_path / "a.mp4"
    write_recording(path, COUNT)
    with TrackingProcess(reading_of(path), held=2) as beside:
        image = next(iter(beside))[0].image
    memory = weakref.ref(beside._memory)
    del beside
    assert image.mean() > 1.0, "a picture outlives the process"
    del image
    assert memory() is None
