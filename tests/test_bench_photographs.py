"""Figures of one photograph against a bracket, and how a set's exposures are read."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from bench.bench_photographs import REFLECTANCE, Row, compare, read_set, summarise, tells

ROUNDING = 1e-5
"""float32 sums over the map."""


def test_a_photograph_that_only_clips_errs_by_clipping_alone() -> None:
    """A lamp 10 times above clipping: the rest is 0, and no scale puts right what has another shape."""
    merged = np.full((64, 128, 3), 0.2, np.float32)
    merged[4:12, 20:40] = 10.0 / REFLECTANCE
    row = compare("lamp", np.minimum(merged, 1.0 / REFLECTANCE), merged, 0.1)
    assert row.rest < ROUNDING
    assert row.error == pytest.approx(row.clipping, abs=ROUNDING)
    assert 0.02 < row.scaled < row.error
    assert row.lower_bound == 0.1


def test_one_scale_is_found() -> None:
    """Light that is half of the bracket's errs by a half, and not after one scale."""
    merged = np.random.default_rng(3).uniform(0.0, 1.0, (64, 128, 3)).astype(np.float32)
    row = compare("half", 0.5 * merged, merged, 0.0)
    assert row.error == pytest.approx(0.5, abs=ROUNDING)
    assert row.scaled < ROUNDING
    assert row.clipping < ROUNDING


def test_exposures_are_told_by_a_file_or_left_to_the_pixels(tmp_path: Path) -> None:
    """Seconds are read in order; ``pixels`` copies pictures to where neither name nor EXIF tells anything."""
    folder, neutral = tmp_path / "room", tmp_path / "neutral"
    folder.mkdir()
    neutral.mkdir()
    for name in ("d_100.png", "d_25.png"):
        cv2.imwrite(str(folder / name), np.zeros((4, 4, 3), np.uint8))
    photos, exposures = read_set(folder, neutral)
    assert [photo.name for photo in photos] == ["d_100.png", "d_25.png"]
    assert exposures is None
    (folder / "exposures.txt").write_text("0.01 0.04\n")
    assert read_set(folder, neutral)[1] == [0.01, 0.04]
    (folder / "exposures.txt").write_text("pixels\n")
    photos, exposures = read_set(folder, neutral)
    assert [photo.name for photo in photos] == ["room_a.png", "room_b.png"]
    assert exposures is None


def test_sets_count_once_each_and_none_is_no_mean() -> None:
    """A set of two photographs and one of one weigh the same; without any photograph there is no mean, and no NaN."""
    rows = {"a": [Row("1", 0.2, 0.1, 0.2, 0.0, 0.0), Row("2", 0.4, 0.1, 0.2, 0.0, 0.0)], "b": [], "c": []}
    rows["c"] = [Row("3", 0.1, 0.1, 0.0, 0.0, 0.0)]
    found = summarise(rows)
    assert set(found["sets"]) == {"a", "c"}
    assert found["error"] == pytest.approx(0.2)
    assert found["clipping"] == pytest.approx(0.1)
    assert summarise({"a": []}) == {"sets": {}} | dict.fromkeys(("error", "scaled", "clipping", "default", "captured"))


def test_the_shortest_photograph_of_a_bracket_is_not_judged() -> None:
    """Its reference clips where it does; that of one two stops longer is four times as bright."""
    merged = np.full((64, 128, 3), 0.2, np.float32)
    merged[4:12, 20:40] = 1.0 / REFLECTANCE
    assert not tells(merged)
    assert tells(4.0 * merged)
