"""Where what clips is taken to stand: a lamp that stands alone has one direction, a window's cells their own."""

from __future__ import annotations

import numpy as np
import pytest

from tests.reference import recover as reference
from warp_ar.kernels.recovery.recover_cells import CELL_COLUMNS, CELL_ROWS, Cell
from warp_ar.light.problem import candidate_directions

FINE = 8
"""Texels of a map along a cell."""
SHAPE = CELL_ROWS, CELL_COLUMNS


def clipping(*discs):
    """Cells of an environment in which discs clip, each of a direction and a radius in radians."""
    rows, columns = FINE * CELL_ROWS, FINE * CELL_COLUMNS
    d, area = (np.asarray(side) for side in reference.cell_directions(rows, columns))
    d, area = d.reshape(rows, columns, 3), area.reshape(rows, columns)
    lost = np.zeros((rows, columns))
    for direction, radius in discs:
        lost[d @ (np.array(direction) / np.linalg.norm(direction)) > np.cos(radius)] = 1.0

    def summed(values):
        return values.reshape(CELL_ROWS, FINE, CELL_COLUMNS, FINE, -1).sum((1, 3))

    cells = np.zeros(SHAPE, np.dtype(Cell.numpy_dtype()))
    solid_angle, weight = summed(area)[..., 0], summed(area * lost)[..., 0]
    cells["solid_angle"] = solid_angle
    cells["clipped"] = cells["missing"] = (weight / solid_angle)[..., None] * np.ones(3)
    toward = np.where(weight[..., None] > 0.0, summed((area * lost)[..., None] * d), summed(area[..., None] * d))
    cells["middle"] = cells["direction"] = toward / np.linalg.norm(toward, axis=2, keepdims=True)
    return cells


@pytest.mark.parametrize("direction", [(-0.48, 0.5, 0.72), (0.7, -0.1, 0.2), (0.02, 0.03, 1.0)])
def test_a_lamp_that_stands_alone_is_where_its_middle_is(direction):
    """Some four degrees to each side of it, over several cells."""
    cells = clipping((direction, 0.065))
    lit = np.flatnonzero(cells["missing"].max(axis=2).ravel() > 0.0)
    assert len(lit) > 2
    middle = np.array(direction) / np.linalg.norm(direction)
    found = candidate_directions(cells)[lit]
    # Half a texel; those of single cells are up to a radius off.
    assert np.arccos(np.clip(found @ middle, -1.0, 1.0)).max() < 0.5 * np.pi / (FINE * CELL_ROWS)
    own = cells["direction"].reshape(-1, 3)[lit].astype(float)
    assert np.arccos(np.clip(own @ middle, -1.0, 1.0)).max() > 0.03


@pytest.mark.parametrize(
    "discs",
    [(((-0.5, 0.5, 0.7), 0.4),), (((-0.5, 0.5, 0.7), 0.05), ((-0.5, 0.72, 0.62), 0.05))],
    ids=["window", "two lamps"],
)
def test_what_clips_beside_others_keeps_its_own(discs):
    cells = clipping(*discs)
    assert candidate_directions(cells) == pytest.approx(cells["direction"].reshape(-1, 3).astype(float))


def test_what_is_modelled_or_not_seen_is_no_lamp():
    cells = clipping(((-0.48, 0.5, 0.72), 0.065))
    cells["modelled"] = 1.0
    assert candidate_directions(cells) == pytest.approx(cells["direction"].reshape(-1, 3).astype(float))
    cells["modelled"], cells["hidden"] = 0.0, 0.5
    assert candidate_directions(cells) == pytest.approx(cells["direction"].reshape(-1, 3).astype(float))
    nothing = clipping()
    assert candidate_directions(nothing) == pytest.approx(nothing["direction"].reshape(-1, 3).astype(float))
