"""Float64 twin of ``warp_ar/scene/node_animation.py``: the same curves by other formulas."""

from __future__ import annotations

import itertools

import numpy as np


def lerp(times, values, seconds):
    """Piecewise linear, column by column."""
    return np.array([np.interp(seconds, times, column) for column in np.asarray(values, float).T])


def step(times, values, seconds):
    """The last key that has come, or the first."""
    come = [value for time, value in zip(times, values, strict=True) if time <= seconds]
    return np.array(come[-1] if come else values[0], float)


def spline(times, values, seconds):
    """Cubic Bezier curve by De Casteljau: inner control points lie a third of a tangent off their ends."""
    values = np.asarray(values, float)
    if seconds <= times[0]:
        return values[0, 1]
    if seconds >= times[-1]:
        return values[-1, 1]
    k = max(index for index, time in enumerate(times) if time <= seconds)
    length = times[k + 1] - times[k]
    s = (seconds - times[k]) / length
    points = [
        values[k, 1],
        values[k, 1] + length / 3.0 * values[k, 2],
        values[k + 1, 1] - length / 3.0 * values[k + 1, 0],
        values[k + 1, 1],
    ]
    while len(points) > 1:
        points = [(1.0 - s) * a + s * b for a, b in itertools.pairwise(points)]
    return points[0]


def product(a, b):
    """Of quaternions, x first."""
    u, v = np.asarray(a[:3]), np.asarray(b[:3])
    return np.concatenate([a[3] * v + b[3] * u + np.cross(u, v), [a[3] * b[3] - u @ v]])


def turn(times, values, seconds):
    """Rotation matrix between keys: the first key's, then a part of the rotation that leads to the second, about its
    axis (Rodrigues)."""
    values = np.asarray(values, float) / np.linalg.norm(values, axis=1, keepdims=True)
    if seconds <= times[0] or seconds >= times[-1]:
        return matrix(values[0] if seconds <= times[0] else values[-1])
    k = max(index for index, time in enumerate(times) if time <= seconds)
    s = (seconds - times[k]) / (times[k + 1] - times[k])
    first, second = matrix(values[k]), matrix(values[k + 1])
    between = second @ first.T
    axis = np.array([between[2, 1] - between[1, 2], between[0, 2] - between[2, 0], between[1, 0] - between[0, 1]])
    angle = np.arctan2(np.linalg.norm(axis), np.trace(between) - 1.0)
    if np.linalg.norm(axis) == 0.0:
        return first
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return (np.eye(3) + np.sin(s * angle) * cross + (1.0 - np.cos(s * angle)) * cross @ cross) @ first


def matrix(quaternion):
    """Rotation as q v q* of the three axes."""
    q = np.asarray(quaternion, float) / np.linalg.norm(quaternion)
    back = np.array([-q[0], -q[1], -q[2], q[3]])
    columns = [product(product(q, np.append(axis, 0.0)), back)[:3] for axis in np.eye(3)]
    return np.stack(columns, axis=1)
