"""Crops, and sheets of them."""

from __future__ import annotations

import numpy as np
import pytest

from warp_ar.accuracy import pictures


def test_crops_lie_around_what_is_to_be_seen():
    region = np.zeros((480, 640), bool)
    region[400:470, 600:630] = True
    region[0, 0] = True  # one stray pixel
    rows, columns = pictures.bounding_box(region, region.shape)
    assert rows.start <= 400 <= 470 <= rows.stop <= 480
    assert columns.start <= 600 <= 630 <= columns.stop <= 640
    assert rows.stop - rows.start < 200
    assert pictures.bounding_box(np.zeros((48, 64), bool), (48, 64)) == (slice(0, 48), slice(0, 64))


def test_a_sheet_holds_every_column_and_its_error():
    pytest.importorskip("flip_evaluator")
    box = slice(0, 60), slice(0, 360)
    black, white = np.zeros((60, 360, 3), np.uint8), np.full((60, 360, 3), 255, np.uint8)
    plain = pictures.sheet([black, white], None, box)
    assert plain.shape == (60, 2 * 360 + pictures.GAP, 3)
    assert (plain[:, :360] == 0).all()
    assert (plain[:, 360:] == 255).all()
    with_errors = pictures.sheet([black, white], black, box)
    assert with_errors.shape == (2 * 60 + pictures.GAP, 2 * 360 + pictures.GAP, 3)
    below = with_errors[60 + pictures.GAP :]
    assert below[30, 100].max() < 10  # no error
    assert below[30, 360 + pictures.GAP + 100].max() > 200


def test_halves_are_of_the_box():
    box = slice(10, 30), slice(20, 60)
    first, second = np.zeros((40, 80, 3), np.uint8), np.full((40, 80, 3), 9, np.uint8)
    above = pictures.halves(first, second, box, above=True)
    assert (above[:20] == 0).all()
    assert (above[20:] == 9).all()
    left = pictures.halves(first, second, box, above=False)
    assert (left[:, :40] == 0).all()
    assert (left[:, 40:] == 9).all()
