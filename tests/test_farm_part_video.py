"""Segments joined without encoding again: packets, times, sound and metadata."""

from __future__ import annotations

import fractions
import itertools

import av
import numpy as np
import pytest

from tests.farm_rig import TICK, desk_frames, write_recording
from warp_ar.errors import SourceError
from warp_ar.farm.video import join_parts, open_part_sink

pytestmark = pytest.mark.slow

UNEVEN = [7, 30, 41, 100, 101, 150, 203, 260, 261, 300, 390, 391]


def write_parts(folder, ticks, cuts, tick=TICK):
    parts, starts = [], []
    for number, (first, end) in enumerate(itertools.pairwise(cuts)):
        parts.append(folder / f"part-{number}.mp4")
        starts.append(ticks[first])
        with open_part_sink(parts[-1], tick, 24.0, "8bit", "srgb") as sink:
            for image, stamp in zip(desk_frames(len(ticks))[first:end], ticks[first:end], strict=True):
                sink.write_at(image, float((stamp - ticks[first]) * tick))
    return parts, starts


def stamps(path):
    with av.open(str(path)) as container:
        return [p.pts * p.time_base for p in container.demux(video=0) if p.size]


def decoded(path):
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def payloads(path, kind="video"):
    with av.open(str(path)) as container:
        stream = getattr(container.streams, kind)[0]
        return [(p.pts * p.time_base, bytes(p)) for p in container.demux(stream) if p.size]


def test_packets_are_those_of_the_parts_at_the_times_of_the_recording(tmp_path):
    write_recording(tmp_path / "a.mp4", 12, ticks=UNEVEN, sound=True)
    parts, starts = write_parts(tmp_path, UNEVEN, [0, 5, 6, 12])
    count = join_parts(parts, starts, TICK, tmp_path / "out.mp4", recording=tmp_path / "a.mp4")
    assert count == 12
    assert stamps(tmp_path / "out.mp4") == [t * TICK for t in UNEVEN]
    assert [data for _, data in payloads(tmp_path / "out.mp4")] == [d for part in parts for _, d in payloads(part)]
    whole = [image for part in parts for image in decoded(part)]
    for a, b in zip(whole, decoded(tmp_path / "out.mp4"), strict=True):
        np.testing.assert_array_equal(a, b)


def test_sound_and_metadata_are_the_recordings(tmp_path):
    write_recording(tmp_path / "a.mp4", 12, sound=True)
    parts, starts = write_parts(tmp_path, [25 * n for n in range(12)], [0, 6, 12])
    join_parts(parts, starts, TICK, tmp_path / "out.mp4", recording=tmp_path / "a.mp4")
    assert payloads(tmp_path / "out.mp4", "audio") == payloads(tmp_path / "a.mp4", "audio")
    with av.open(str(tmp_path / "out.mp4")) as container:
        assert container.metadata["title"] == "A desk"
        assert container.metadata["comment"] == "warp_ar"
        assert container.streams.audio[0].metadata["language"] == "deu"


def test_sound_of_a_part_of_a_recording_begins_and_ends_with_it(tmp_path):
    ticks = write_recording(tmp_path / "a.mp4", 12, sound=True)
    parts, _ = write_parts(tmp_path, ticks[4:8], [0, 4])
    until = float(ticks[8] * TICK)
    join_parts(parts, [ticks[4]], TICK, tmp_path / "out.mp4", recording=tmp_path / "a.mp4", zero=ticks[4], until=until)
    assert stamps(tmp_path / "out.mp4")[0] == 0
    begin, end = float(ticks[4] * TICK), until
    kept = [(float(t) - begin, d) for t, d in payloads(tmp_path / "a.mp4", "audio") if begin <= float(t) < end]
    made = [(float(t), d) for t, d in payloads(tmp_path / "out.mp4", "audio")]
    assert [d for _, d in made] == [d for _, d in kept]
    assert [t for t, _ in made] == pytest.approx([t for t, _ in kept], abs=0.1 / 48000)


def test_a_recording_without_sound_or_none_at_all(tmp_path):
    write_recording(tmp_path / "a.mp4", 4)
    parts, starts = write_parts(tmp_path, [0, 25, 50, 75], [0, 2, 4])
    for recording in (tmp_path / "a.mp4", None):
        assert join_parts(parts, starts, TICK, tmp_path / "out.mp4", recording=recording) == 4
        with av.open(str(tmp_path / "out.mp4")) as container:
            assert not container.streams.audio


def test_a_part_of_another_time_base_is_refused(tmp_path):
    parts, starts = write_parts(tmp_path, [0, 25, 50, 75], [0, 4])
    with pytest.raises(SourceError, match="is none of its recording"):
        join_parts(parts, starts, fractions.Fraction(1, 7), tmp_path / "out.mp4", recording=None)


def test_bytes_do_not_depend_on_when_they_are_written(tmp_path):
    one, _ = write_parts(tmp_path, [0, 25, 50, 75], [0, 4])
    first = one[0].read_bytes()
    write_parts(tmp_path, [0, 25, 50, 75], [0, 4])
    assert one[0].read_bytes() == first
