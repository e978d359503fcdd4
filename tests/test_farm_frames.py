"""Parts of recordings: the same frames, at the same times, whichever part they are read in."""

from __future__ import annotations

import fractions

import cv2
import numpy as np
import pytest

from tests.farm_rig import CLIPS, TICK, desk_frames, write_recording
from warp_ar.errors import SourceError
from warp_ar.farm.frames import index_frames, open_part, shown_ticks

pytestmark = pytest.mark.slow

UNEVEN = [7, 30, 41, 100, 101, 150, 203, 260, 261, 300, 390, 391]
"""Time stamps of a variable rate, the first not 0."""


def read(path, first, end, fps=None):
    with open_part(path, index_frames(path, fps), first, end, fps) as source:
        return list(source)


@pytest.mark.parametrize("bframes", [0, 2])
@pytest.mark.parametrize("fps", [None, 12.0])
def test_parts_are_the_whole(tmp_path, bframes, fps):
    write_recording(tmp_path / "a.mp4", 12, ticks=UNEVEN, bframes=bframes)
    whole = read(tmp_path / "a.mp4", 0, 12, fps)
    parts = [
        frame for first, end in ((0, 3), (3, 4), (4, 9), (9, 12)) for frame in read(tmp_path / "a.mp4", first, end, fps)
    ]
    assert [frame.index for frame in parts] == list(range(12))
    for a, b in zip(whole, parts, strict=True):
        assert (a.index, a.time) == (b.index, b.time)
        np.testing.assert_array_equal(a.image, b.image)
    expected = [n / 12.0 for n in range(12)] if fps else [float((t - UNEVEN[0]) * TICK) for t in UNEVEN]
    assert [frame.time for frame in whole] == pytest.approx(expected, abs=1e-12)


def test_an_index_is_read_from_packets_alone(tmp_path):
    write_recording(tmp_path / "a.mp4", 12, ticks=UNEVEN)
    index = index_frames(tmp_path / "a.mp4", None)
    assert index.length == 12
    assert [int(t) * index.tick for t in index.ticks - index.ticks[0]] == [(t - UNEVEN[0]) * TICK for t in UNEVEN]
    ticks, tick = shown_ticks(index, None)
    assert ticks is index.ticks
    assert tick == index.tick
    ticks, tick = shown_ticks(index, 24.0)
    assert (list(ticks[:3]), tick) == ([0, 1, 2], fractions.Fraction(1, 24))


def test_a_folder_of_pictures_has_parts_too(tmp_path):
    for number, image in enumerate(desk_frames(5)):
        cv2.imwrite(str(tmp_path / f"{number}.png"), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    assert index_frames(tmp_path, 10.0).length == 5
    frames = read(tmp_path, 2, 4, 10.0)
    assert [(frame.index, frame.time) for frame in frames] == [(2, 0.2), (3, 0.3)]
    np.testing.assert_array_equal(frames[0].image, desk_frames(5)[2])


def test_a_recording_that_is_cut_off_fails_where_it_ends(tmp_path):
    data = (CLIPS / "desk.mp4").read_bytes()
    (tmp_path / "cut.mp4").write_bytes(data[: len(data) // 2])
    with pytest.raises(SourceError, match=r"cut\.mp4"):
        read(tmp_path / "cut.mp4", 0, 120)


def test_pictures_that_alternate_between_exposures_are_refused(tmp_path):
    for number, image in enumerate(desk_frames(2)):
        cv2.imwrite(str(tmp_path / f"{number}.png"), image)
    (tmp_path / "exposures.json").write_text("[0.01, 0.001]")
    with pytest.raises(SourceError, match="alternate between exposures, which a farm does not light"):
        index_frames(tmp_path, None)


def test_where_no_gpu_decodes_the_processor_does(tmp_path):
    write_recording(tmp_path / "a.mp4", 8)
    index = index_frames(tmp_path / "a.mp4", None)

    def pictures(gpu):
        with open_part(tmp_path / "a.mp4", index, 2, 6, None, gpu) as source:
            return [(frame.index, frame.image.tobytes()) for frame in source]

    assert pictures(999) == pictures(None)
