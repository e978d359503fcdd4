"""Detection of a hand or another object between the camera and a mirror ball, whose pixels then show no light.

An occluder covers the surface next to the ball in the picture as well, and does not change the light. A ball therefore
counts as covered in a frame if, compared with the frames before,

- the median change of points all over the card and the planes is below ``QUIET``: the light is the same;
- the share ``NEAR_SHARE`` of the plane points next to the ball in the picture has changed by more than ``CHANGED``;
- the share ``DISC_SHARE`` of the ball's disc in the picture has changed.

Points have fixed places in the world, and cells have fixed places in the ball's disc: a moving camera changes the
reflections in the ball, but not the planes. An emitter that changes affects the median, or does not affect the points
next to the ball. An occluder that stays longer than ``PATIENCE`` counts as part of the scene. Changes are logarithms
per channel, corrected for the camera's gain.

Frames with more than 8 bits are read at full depth: a white hand in front of a lamp above white is a change, though
both have code 255.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warp_ar.kernels.color import decode_table
from warp_ar.scene import Camera, Scene
from warp_ar.scene.geometry import rotation_matrix
from warp_ar.scene.pixel_rays import project
from warp_ar.scene.pose import Pose
from warp_ar.sources.deep_frame import DeepFrame
from warp_ar.tracking.drift import codes_around, still_points, under_boxes

Array = NDArray[np.float64]

QUIET = 0.15
"""Largest median change of all points, as a logarithm, under unchanged light; errors of gain and tone curve are 0.1."""
CHANGED = 0.4
"""Logarithm, in the channel with the largest change, from which a point or a cell counts as changed."""
NEAR_SHARE = 0.15
"""Share of changed points next to a ball from which it may be covered."""
DISC_SHARE = 0.15
"""Share of changed cells of a ball's disc from which it may be covered."""
EVERY = 3
"""Stride through the points on the card and on planes that do not move."""
LEAST_POINTS = 24
"""Smallest number of points that this frame and an earlier one must both show, for a test."""
LEAST_NEAR = 8
"""Smallest number of points next to a ball that this frame and an earlier one must both show."""
PATIENCE = 1.5
"""Seconds after which an occluder counts as part of the scene."""
MEMORY = 0.3
"""Time constant in seconds with which remembered codes follow frames."""
DISC_SECONDS = 0.008
"""Shortest time in seconds between two tests of the balls' discs: every frame up to 120 frames a second. An object at 1
m/s moves 8 mm meanwhile."""
LOOK_SECONDS = 0.1
"""Shortest time in seconds between two tests of the points while no disc changes; they take four times as long as the
discs."""
RINGS = (1.2, 1.7, 2.4, 3.4, 5.0)
"""Radii of the circles of points on planes around a ball, relative to the ball's radius."""
SURROUNDINGS = (1.1, 3.0)
"""Range of distances in the picture from a ball's centre of points next to it, relative to the radius of its disc."""
CELLS = 16
"""Number of cells along a ball's disc."""
DARK = 0.02
"""Radiance added before the logarithm, because darker values are noise."""


class BallOcclusion:
    """Detector of occluded mirror balls over the frames."""

    def __init__(self, scene: Scene, camera: Camera) -> None:
        """Choose the points on the card and on planes that are compared between frames.

        Args:
            scene: Scene with a marker and a ball.
            camera: Camera of the frames.
        """
        self.watches = (camera, scene.marker, scene.proxies, scene.probes)
        """Inputs that determine the result for given frames; equal values allow one instance to be shared."""
        self._camera = camera
        self._table = decode_table(camera.transfer).astype(np.float64)
        self._points = np.concatenate([still_points(scene)[0][::EVERY], _points_around(scene)])
        self.forget()

    def forget(self) -> None:
        """Treat the next frame as the first."""
        self._shown: Array | None = None
        self._discs: list[Array] = []
        self._last = self._looked = self._since = 0.0
        self._covered = False

    def rests(self, seconds: float) -> bool:
        """Return True if the last test is recent enough to be still valid.

        Args:
            seconds: Time of the present frame.
        """
        return self._shown is not None and 0.0 < abs(seconds - self._last) < DISC_SECONDS

    @property
    def is_covered(self) -> bool:
        """Return True if a ball was covered at the last test."""
        return self._covered

    def observe(
        self,
        image: NDArray[np.uint8],
        discs: Sequence[tuple[float, float, float]],
        pose: Pose,
        seconds: float,
        gain: Array,
        deep: DeepFrame | None = None,
    ) -> bool:
        """Test whether an object covers a ball in a frame, and remember the frame.

        Args:
            image: uint8 RGB (height, width, 3).
            discs: Centre x, y and radius of each ball in the picture, pixels.
            pose: ``camera_from_world``.
            seconds: Time of the frame.
            gain: Gain of the camera, RGB.
            deep: The frame at full depth, used instead of ``image`` if given.

        Returns:
            True if a ball is covered.
        """
        own = [self._cells(image, disc, gain, deep) for disc in discs]
        known = self._shown is not None and len(own) == len(self._discs)
        changed = [known and _has_changed(now - before) for now, before in zip(own, self._discs, strict=False)]
        rests = known and not self._covered and not any(changed)
        if not rests or abs(seconds - self._looked) >= LOOK_SECONDS:
            shown = self._logarithm(codes_around(image, self._camera, pose, self._points, deep), gain)
            covered = known and not rests and self._is_covered(shown, changed, discs, pose)
            if covered and not self._covered:
                self._since = seconds
            stays = covered and abs(seconds - self._since) > PATIENCE
            if stays or not known:
                self._shown, self._discs = shown, own
            self._covered = covered and not stays
            if not self._covered:
                assert self._shown is not None
                self._shown = _follow(self._shown, shown, seconds - self._looked)
            self._looked = seconds
        if not self._covered:
            self._discs = [_follow(*disc, seconds - self._last) for disc in zip(self._discs, own, strict=True)]
        self._last = seconds
        return self._covered

    def _is_covered(
        self, shown: Array, changed: list[bool], discs: Sequence[tuple[float, float, float]], pose: Pose
    ) -> bool:
        """Return True if a ball is covered, by the present and remembered codes of points and the changed discs."""
        assert self._shown is not None
        change = shown - self._shown
        seen = ~np.isnan(change).any(axis=1)
        if seen.sum() < LEAST_POINTS:
            return False
        median = np.median(change[seen], axis=0)
        if np.abs(median).max() > QUIET:
            return False
        is_other = np.abs(change[seen] - median).max(axis=1) > CHANGED
        if not is_other.any():
            return False
        at = project(self._camera, pose.apply(self._points[seen]))
        for (x, y, radius), has_changed in zip(discs, changed, strict=True):
            away = np.hypot(at[:, 0] - x, at[:, 1] - y) / radius
            near = (away > SURROUNDINGS[0]) & (away < SURROUNDINGS[1])
            if has_changed and near.sum() >= LEAST_NEAR and is_other[near].mean() >= NEAR_SHARE:
                return True
        return False

    def _cells(
        self, image: NDArray[np.uint8], disc: tuple[float, float, float], gain: Array, deep: DeepFrame | None = None
    ) -> Array:
        """Return the logarithm of a disc's cells, four samples of each, (cells, 3); NaN outside the picture."""
        picture: NDArray[Any] = image if deep is None else deep.picture
        x, y, radius = disc
        radius = max(radius, 1.0)
        if not (abs(x) < 1e5 and abs(y) < 1e5 and radius < 1e4):
            return np.full((_SAMPLES.shape[1], 3), np.nan)
        at = np.rint(np.array([x, y]) + radius * _SAMPLES).astype(np.int64)
        last = np.array(picture.shape[1::-1]) - 1
        beyond = ((at < 0) | (at > last)).any((0, 2))
        columns, rows = np.moveaxis(at.clip(0, last), 2, 0)
        values = picture[rows, columns].astype(np.float64).mean(0)
        if picture.dtype.kind == "f":
            found = np.log(np.maximum(values, 0.0) / gain + DARK)
        else:
            found = self._logarithm(values if picture.dtype == np.uint8 else values / 257.0, gain)
        found[beyond] = np.nan
        return np.asarray(found)

    def _logarithm(self, codes: Array, gain: Array) -> Array:
        """Return the logarithm of the radiance of codes at gain 1, (n, 3)."""
        values = np.stack([np.interp(codes[:, c], np.arange(256), self._table[:, c]) for c in range(3)], -1)
        return np.asarray(np.log(values / gain + DARK))


def _samples_in_disc() -> Array:
    """Return four sample positions in each cell inside the disc, (4, cells, 2) in radii.

    They average over half a cell.
    """
    middle = 2.0 * (np.arange(CELLS) + 0.5) / CELLS - 1.0
    row, column = np.nonzero(np.hypot(middle, middle[:, None]) < 0.9)
    around = np.array([[-0.5, -0.5], [0.5, -0.5], [-0.5, 0.5], [0.5, 0.5]]) / CELLS
    return np.stack([middle[column], middle[row]], -1) + around[:, None]


_SAMPLES = _samples_in_disc()


def _has_changed(change: Array) -> bool:
    """Return True if enough cells of a ball's disc changed, (cells, 3); cells hidden in either frame do not count."""
    return bool((np.abs(change) > CHANGED).any(axis=1).mean() >= DISC_SHARE)


def _follow(before: Array, now: Array, seconds: float) -> Array:
    """Return the memory ``before``, moved toward the visible cells of ``now`` with the time constant ``MEMORY``."""
    followed = before + (1.0 - np.exp(-abs(seconds) / MEMORY)) * (now - before)
    followed = np.where(np.isnan(before), now, followed)
    return np.asarray(np.where(np.isnan(followed), before, followed))


def _points_around(scene: Scene) -> Array:
    """Return points of planes around balls, without those under a box, (n, 3)."""
    turn = np.arange(24) * np.pi / 12
    circle = np.stack([np.cos(turn), np.sin(turn)], -1)
    found = [np.zeros((0, 3))]
    for plane in scene.proxies:
        if plane.shape != "plane" or plane.marker is not None:
            continue
        rotation, at = rotation_matrix(plane.rotate), np.array(plane.at)
        for probe in scene.probes:
            if probe.marker is not None:
                continue
            middle = (rotation.T @ (np.array(probe.center) - at))[:2]
            local = np.concatenate([middle + ratio * probe.radius * circle for ratio in RINGS])
            local = local[(np.abs(local) < 0.5 * np.array(plane.size)).all(axis=1)]
            points = at + np.column_stack([local, np.zeros(len(local))]) @ rotation.T
            found.append(points[~under_boxes(scene, points)])
    return np.concatenate(found)
