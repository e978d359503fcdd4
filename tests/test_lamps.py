"""Lamps at their places: irradiance away from the ball."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from warp_ar.kernels.lamps import MAX_GAIN, add_nearness
from warp_ar.kernels.structs import RoomLamp

CENTER = np.array([-0.12, 0.03, 0.035])
FLOAT = 1e-5
"""float32, some ten operations."""


def beside(x, y, z):
    return CENTER + np.array([x, y, z])


@wp.kernel(enable_backward=False)
def evaluate_kernel(
    # In:
    irradiance: wp.vec3,
    lamps: wp.array[RoomLamp],
    points: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    # Out:
    irradiance_out: wp.array[wp.vec3],
):
    i = wp.tid()
    irradiance_out[i] = add_nearness(irradiance, lamps, points[i], normals[i])


def evaluate(device, irradiance, lamps, points, normals):
    records = np.zeros(len(lamps), np.dtype(RoomLamp.numpy_dtype()))
    for record, (direction, distance, power) in zip(records, lamps, strict=True):
        record["origin"], record["direction"] = CENTER, direction
        record["distance"], record["power"] = distance, power
    out = wp.zeros(len(points), dtype=wp.vec3, device=device)
    inputs = [wp.array(records, dtype=RoomLamp, device=device)]
    inputs += [wp.array(np.array(a, np.float32), dtype=wp.vec3, device=device) for a in (points, normals)]
    wp.launch(evaluate_kernel, len(points), [wp.vec3(*irradiance), *inputs], [out], device=device)
    return out.numpy()


def test_at_the_ball_nothing_changes(device):
    lamps = [((0.0, 0.6, 0.8), 0.4, (3.0, 2.0, 1.0))]
    normals = [(0, 0, 1), (0, 1, 0), (0, 0, -1)]
    got = evaluate(device, (5.0, 5.0, 5.0), lamps, [CENTER] * 3, normals)
    assert got == pytest.approx(5.0, rel=FLOAT)


def test_inverse_squares(device):
    """Straight under a lamp and beside it, the distant light taken away."""
    power, distance = np.array([3.0, 2.0, 1.0]), 0.5
    lamp = beside(0.0, 0.0, distance)
    points = np.array([beside(0.0, 0.0, -0.2), beside(0.3, 0.0, 0.0), beside(0.0, 0.0, 0.3)])
    got = evaluate(device, power, [((0.0, 0.0, 1.0), distance, power)], points, [(0, 0, 1)] * 3)
    away = lamp - points
    square = (away**2).sum(axis=1)
    expected = power * (distance**2 * away[:, 2] / square**1.5)[:, None]
    assert got == pytest.approx(expected, rel=FLOAT)


def test_distant_lamps_and_none_change_nothing(device):
    lamps = [((0.0, 0.0, 1.0), np.inf, (9.0, 9.0, 9.0)), ((0.0, 0.0, 0.0), 0.0, (0.0, 0.0, 0.0))]
    got = evaluate(device, (1.0, 2.0, 3.0), lamps, [CENTER + 0.5], [(0, 0, 1)])
    assert got == pytest.approx(np.array([[1.0, 2.0, 3.0]]))


def test_bounded_and_never_negative(device):
    """In the lamp itself, and where the environment held less than the lamp is thought to give."""
    lamps = [((0.0, 0.0, 1.0), 0.3, (1.0, 1.0, 1.0))]
    points = [beside(0.0, 0.0, 0.3), beside(0.0, 0.0, 0.2999), beside(0.0, 0.0, 0.5)]
    got = evaluate(device, (1.0, 1.0, 1.0), lamps, points, [(0, 0, 1)] * 3)
    assert np.isfinite(got).all()
    assert got.max() == pytest.approx(MAX_GAIN, rel=FLOAT)
    assert (evaluate(device, (0.1, 0.1, 0.1), lamps, points[2:], [(0, 0, 1)]) == 0.0).all()
