"""A hand, or whatever else, that comes between the camera and a mirror ball: what the ball then shows is no light.

What covers a ball covers the surface beside it in the picture as well, and leaves the light alone. So a ball is taken
to be covered in a frame where, against the frames before,

- points all over the card and the planes show on the median what they showed, within ``QUIET``: the light is the same;
- of points of planes that are seen beside the ball, ``NEAR_SHARE`` have changed by more than ``CHANGED``;
- of the ball's disc in the picture, ``DISC_SHARE`` has.

Points keep their places in the world, the disc's cells their places in the disc: a camera that moves turns what the
ball mirrors, but not what planes show. An emitter that changes is seen in the median, or neither beside the ball. What
stays for longer than ``PATIENCE`` belongs to the scene and is believed. Changes are logarithms per channel, with the
camera's own gain taken out.

Frames of more than 8 bits are read at their depth: a lamp above white that a white hand covers has changed, though the
codes of both are 255.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from warp_ar.kernels.color import decode_table
from warp_ar.scene import Camera, Scene
from warp_ar.scene.geometry import rotation_matrix
from warp_ar.scene.pose import Pose
from warp_ar.sources.deep_frame import Plate
from warp_ar.tracking.drift import codes_around, still_points

Array = NDArray[np.float64]

QUIET = 0.15
"""Logarithm by which the median of all points may have changed: a gain that is followed and a tone curve leave 0.1."""
CHANGED = 0.4
"""Logarithm, in the channel that changed most, from which a point or a cell has changed."""
NEAR_SHARE = 0.15
"""Share of the points beside a ball that have."""
DISC_SHARE = 0.15
"""Share of a ball's cells that have."""
EVERY = 3
"""Of the points all over, one of so many is looked at."""
LEAST_POINTS = 24
"""Points that must be seen again, all over."""
LEAST_NEAR = 8
"""Points that must be seen again beside a ball."""
PATIENCE = 1.5
"""Seconds after which what covers a ball is taken for a part of the scene."""
MEMORY = 0.3
"""Time constant in seconds with which remembered codes follow frames."""
DISC_SECONDS = 0.008
"""Between two looks at the balls' discs: cameras of up to 120 frames a second have each frame looked at. What moves by
a metre in a second goes 8 mm meanwhile."""
LOOK_SECONDS = 0.1
"""Between two looks at the points while no ball's disc changes: they take four times as long as the discs."""
RINGS = (1.2, 1.7, 2.4, 3.4, 5.0)
"""Radii of the circles on planes around a ball on which points lie, over the ball's."""
BESIDE = (1.1, 3.0)
"""Distances in the picture from a ball's centre at which points are beside it, over the radius of its disc."""
CELLS = 16
"""Cells along a ball's disc."""
DARK = 0.02
"""Radiance that is added before the logarithm: below it is noise."""


class BallCover:
    """Tells, frame after frame, whether something covers a ball."""

    def __init__(self, scene: Scene, camera: Camera) -> None:
        """Choose points.

        Args:
            scene: With a marker and a ball.
            camera: Of the frames.
        """
        self.watches = (camera, scene.marker, scene.proxies, scene.probes)
        """What frames are of: the same frames tell those that watch the same, the same."""
        self._camera = camera
        self._table = decode_table(camera.transfer).astype(np.float64)
        self._points = np.concatenate([still_points(scene)[0][::EVERY], _points_around(scene)])
        # A cell is the mean of four codes, of which there are so few that all are looked up.
        means: Array = 0.25 * np.arange(4 * 255 + 1, dtype=np.float64)
        self._of_sums = np.stack([self._radiance(means, c) for c in range(3)]).ravel()
        self._logarithms: Array = np.zeros(0)
        self._gain: Array | None = None
        self._cell_row, self._cell_column = _cells_in_disc()
        # Of four samples of each cell, the place among all of a disc's, (4, cells).
        side = 2 * CELLS
        first = 2 * self._cell_row * side + 2 * self._cell_column
        self._samples = first + np.array([[0], [side], [1], [side + 1]])
        self.forget()

    def forget(self) -> None:
        """Take the next frame for the first."""
        self._shown: Array | None = None
        self._discs: list[Array] = []
        self._last = self._looked = self._since = 0.0
        self._covered = False

    def rests(self, seconds: float) -> bool:
        """Whether the last look was so short a time ago that what it found still holds.

        Args:
            seconds: When the frame was taken.
        """
        return self._shown is not None and 0.0 < abs(seconds - self._last) < DISC_SECONDS

    @property
    def is_covered(self) -> bool:
        """Whether a ball was covered at the last look."""
        return self._covered

    def observe(
        self,
        image: NDArray[np.uint8],
        discs: Sequence[tuple[float, float, float]],
        pose: Pose,
        seconds: float,
        gain: Array,
        plate: Plate | None = None,
    ) -> bool:
        """Look at a frame.

        Args:
            image: uint8 RGB (height, width, 3).
            discs: Centre x, y and radius of each ball in the picture, pixels.
            pose: ``camera_from_world``.
            seconds: When it was taken.
            gain: Of the camera, RGB.
            plate: The frame at its full depth, read in the place of ``image`` where there is one.

        Returns:
            Whether a ball is covered.
        """
        own = [self._cells(image, disc, gain, plate) for disc in discs]
        known = self._shown is not None and len(own) == len(self._discs)
        changes = list(map(np.subtract, own, self._discs)) if known else []
        rests = known and not self._covered and not any(map(_has_changed, changes))
        if rests and abs(seconds - self._looked) < LOOK_SECONDS:
            self._follow_discs(own, changes, seconds)
            return False
        shown = self._logarithm(codes_around(image, self._camera, pose, self._points, plate), gain)
        if not known:
            self._shown, self._discs, self._covered = shown, own, False
            self._last = self._looked = seconds
            return False
        was = self._covered
        self._covered = not rests and self._is_covered(shown, changes, discs, pose)
        if self._covered and not was:
            self._since = seconds
        if self._covered and abs(seconds - self._since) > PATIENCE:
            self._shown, self._discs, self._covered = shown, own, False
        if not self._covered:
            assert self._shown is not None
            self._shown = _follow(self._shown, shown, shown - self._shown, _rate(seconds - self._looked))
            changes = list(map(np.subtract, own, self._discs))
            self._follow_discs(own, changes, seconds)
        self._last = self._looked = seconds
        return self._covered

    def _follow_discs(self, own: list[Array], changes: list[Array], seconds: float) -> None:
        rate = _rate(seconds - self._last)
        self._discs = [_follow(*disc, rate) for disc in zip(self._discs, own, changes, strict=True)]
        self._last = seconds

    def _is_covered(
        self, shown: Array, changes: list[Array], discs: Sequence[tuple[float, float, float]], pose: Pose
    ) -> bool:
        """Whether a ball is, by what points show now and are remembered to show, and what of discs has changed."""
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
        local = self._points[seen] @ pose.rotation.T + pose.translation
        zero = np.zeros(3)
        at = cv2.projectPoints(local, zero, zero, self._camera.matrix(), np.array(self._camera.distortion))[0][:, 0]
        for (x, y, radius), of_disc in zip(discs, changes, strict=True):
            away = np.hypot(at[:, 0] - x, at[:, 1] - y) / radius
            near = (away > BESIDE[0]) & (away < BESIDE[1])
            if near.sum() < LEAST_NEAR or is_other[near].mean() < NEAR_SHARE:
                continue
            if _has_changed(of_disc):
                return True
        return False

    def _cells(
        self, image: NDArray[np.uint8], disc: tuple[float, float, float], gain: Array, plate: Plate | None = None
    ) -> Array:
        """Logarithm of what a disc's cells show, four samples of each, NaN beyond the picture, (3, cells)."""
        picture: NDArray[Any] = image if plate is None else plate.picture
        x, y, radius = disc
        radius = max(radius, 1.0)
        if not (abs(x) < 1e5 and abs(y) < 1e5 and radius < 1e4):
            return np.full((3, len(self._cell_row)), np.nan)
        # Half a cell of blur by sampling four places in each.
        corner = np.array([[x - radius], [y - radius]])
        columns, rows = np.rint(corner + 2.0 * radius / CELLS * _STEPS).astype(np.int64)
        height, width = picture.shape[:2]
        seen = None
        if rows[0] < 0 or columns[0] < 0 or rows[-1] >= height or columns[-1] >= width:
            seen = _pairs((rows >= 0) & (rows < height))[self._cell_row]
            seen &= _pairs((columns >= 0) & (columns < width))[self._cell_column]
            rows, columns = rows.clip(0, height - 1), columns.clip(0, width - 1)
        at = ((3 * width * rows)[:, None] + 3 * columns).take(self._samples)
        samples = picture.reshape(-1).take(at + _CHANNEL)
        if samples.dtype.kind == "f":
            samples = samples.astype(np.float64)
            sums: NDArray[Any] = (samples[:, 0] + samples[:, 1]) + (samples[:, 2] + samples[:, 3])
        else:
            sums = samples.sum(axis=1, dtype=np.int64)
        if plate is None:
            found: Array = self._table_of_sums(gain).take(sums + _CHANNELS)
        elif picture.dtype == np.uint16:
            found = self._logarithm(sums.T / (4.0 * 257.0), gain).T
        else:
            found = np.log(np.maximum(0.25 * sums.T, 0.0) / gain + DARK).T
        if seen is not None:
            found[:, ~seen] = np.nan
        return found

    def _table_of_sums(self, gain: Array) -> Array:
        """Logarithm of the radiance of all sums of four codes at a gain, channel after channel."""
        if self._gain is None or (self._gain != gain).any():
            self._gain = np.array(gain)
            self._logarithms = np.log(self._of_sums.reshape(3, -1) / self._gain[:, None] + DARK).ravel()
        return self._logarithms

    def _radiance(self, codes: Array, channel: int) -> Array:
        return np.asarray(np.interp(codes, np.arange(256), self._table[:, channel]))

    def _logarithm(self, codes: Array, gain: Array) -> Array:
        """Of the radiance that codes stand for at gain 1, (n, 3)."""
        values = np.stack([self._radiance(codes[:, c], c) for c in range(3)], -1)
        return np.asarray(np.log(values / gain + DARK))


_STEPS = np.arange(2 * CELLS) * 0.5 + 0.25
"""Where samples lie along a disc, in cells."""
_CHANNEL = np.arange(3)[:, None, None]
"""Where a channel's code lies in a pixel."""
_CHANNELS = np.arange(3)[:, None] * (4 * 255 + 1)
"""Where a channel's sums begin in a table of all."""


def _cells_in_disc() -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns of those cells of a square that lie in the disc."""
    middle = 2.0 * (np.arange(CELLS) + 0.5) / CELLS - 1.0
    row, column = np.nonzero(np.hypot(middle, middle[:, None]) < 0.9)
    return row, column


def _pairs(inside: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether both samples of a cell are inside, along one side."""
    return np.asarray(inside[::2] & inside[1::2])


def _rate(seconds: float) -> float:
    """Share by which what is remembered follows within so long."""
    return float(1.0 - np.exp(-abs(seconds) / MEMORY))


def _has_changed(change: Array) -> bool:
    """Whether a ball's disc shows something else, (3, cells); a cell that is not seen in both is as it was."""
    most = np.abs(change).max(axis=0)
    return bool(np.count_nonzero(most > CHANGED) / len(most) >= DISC_SHARE)


def _follow(before: Array, now: Array, change: Array, rate: float) -> Array:
    """What is remembered, drawn toward what is seen now, where that is seen; ``change`` is ``now - before``."""
    followed = before + rate * change
    if np.isnan(followed).any():
        followed = np.where(np.isnan(before), now, followed)
        followed = np.where(np.isnan(followed), before, followed)
    return np.asarray(followed)


def _points_around(scene: Scene) -> Array:
    """Points of planes around balls, none under a box, (n, 3)."""
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
            for box in scene.proxies:
                if box.shape == "box" and box.marker is None:
                    within = (points - np.array(box.at)) @ rotation_matrix(box.rotate)
                    points = points[~(np.abs(within) < 0.5 * np.array(box.size) + 0.01).all(axis=1)]
            found.append(points)
    return np.concatenate(found)
