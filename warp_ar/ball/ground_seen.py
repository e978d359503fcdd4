"""Test if the receiver is visible where a mirror ball should stand, as cheap evidence that there is no ball.

A flat surface looks the same from all sides after projection to its plane. A ball does not: its mirror image is at
another height, and moves relative to the receiver with the viewpoint. The receiver points that the ball would hide are
therefore looked up in frames from different sides. If their codes correlate, the receiver itself is visible. Without
texture, or with all frames from one side, the test gives no result.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from warp_ar.scene import Camera, Pose, Probe
from warp_ar.scene.pixel_rays import project

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
View = tuple[Image, Pose]

ACROSS: Final = 41
"""Points along each side of the tested part of the receiver."""
APART: Final = math.radians(12.0)
"""Angle between two viewpoints, seen from the ball, at which a mirror image moves by a sixth of its radius."""
PAIRS: Final = 6
"""Number of compared pairs of frames, beginning with those farthest apart."""
LEAST_POINTS: Final = 200
"""Smallest number of points that the ball would hide from both viewpoints."""
TEXTURE: Final = 0.01
"""Least contrast (standard deviation over mean of codes) for a verdict; the card's thin rings have 0.02 to 0.03."""
ALIKE: Final = 0.8
"""Smallest median correlation of the pairs at which the receiver is visible: 0.91 to 0.97 for a bare card, -0.4 to 0
for a ball."""


def ground_is_seen(views: Sequence[View], camera: Camera, probe: Probe, ground: float) -> bool:
    """Return True if frames show the receiver where a ball would hide it; False also if that is uncertain.

    Args:
        views: RGB uint8 frames with ``camera_from_world``.
        camera: The camera.
        probe: The ball at its supposed position.
        ground: Height in metres of the horizontal plane below it.
    """
    correlations = ground_correlations(views, camera, probe, ground)
    return bool(correlations) and float(np.median(correlations)) > ALIKE


def ground_correlations(views: Sequence[View], camera: Camera, probe: Probe, ground: float) -> list[float]:
    """Return correlations, between frames from different sides, of the receiver that a ball would hide.

    Args:
        views: 8-bit RGB frames and ``camera_from_world`` of each.
        camera: Camera of the frames.
        probe: The ball at its supposed position, metres.
        ground: Height of the receiver in metres.

    Returns:
        A correlation, -1 to 1, for each usable pair of frames; empty without one.
    """
    line = np.linspace(-1.2, 1.2, ACROSS) * probe.radius
    x, y = (value.ravel() for value in np.meshgrid(line, line))
    points = np.array([probe.center[0], probe.center[1], ground]) + np.column_stack([x, y, np.zeros_like(x)])
    seen = [_look_up(view, camera, points, probe) for view in views]
    eyes = [pose.inverse().translation - np.array(probe.center) for _, pose in views]
    eyes = [eye / np.linalg.norm(eye) for eye in eyes]
    pairs = sorted(itertools.combinations(range(len(views)), 2), key=lambda pair: float(eyes[pair[0]] @ eyes[pair[1]]))
    found = []
    for a, b in pairs[:PAIRS]:
        both = seen[a][1] & seen[b][1]
        if eyes[a] @ eyes[b] > math.cos(APART) or both.sum() < LEAST_POINTS:
            continue
        one, other = seen[a][0][both], seen[b][0][both]
        if min(one.std() / max(one.mean(), 1.0), other.std() / max(other.mean(), 1.0)) > TEXTURE:
            found.append(float(np.corrcoef(one, other)[0, 1]))
    return found


def _look_up(view: View, camera: Camera, points: Array, probe: Probe) -> tuple[Array, NDArray[np.bool_]]:
    """Return codes of points (n, 3) in a frame, (n,), and a mask of points in the frame and behind the ball."""
    image, pose = view
    eye = pose.inverse().translation
    away = points - eye
    distance = np.linalg.norm(away, axis=1)
    away /= distance[:, None]
    from_ball = eye - np.array(probe.center)
    along = away @ from_ball
    gap = np.sqrt(np.maximum(from_ball @ from_ball - along**2, 0.0))
    hidden = (gap < 0.9 * probe.radius) & (-along < distance)
    pixels = project(camera, pose.apply(points))
    inside = np.all((pixels >= 1) & (pixels <= (camera.width - 2, camera.height - 2)), axis=1)
    gray = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), (0, 0), 1.0)
    at = np.where(inside[:, None], pixels, 0.0).astype(np.float32)
    codes = cv2.remap(gray, at[None, :, 0], at[None, :, 1], cv2.INTER_LINEAR)[0]
    return np.asarray(codes, np.float64), hidden & inside
