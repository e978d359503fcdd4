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

import numpy as np
from numpy.typing import NDArray

from warp_ar.kernels.color import decode_table
from warp_ar.scene import Camera, Scene
from warp_ar.scene.geometry import rotation_matrix
from warp_ar.scene.pixel_rays import project
from warp_ar.scene.pose import Pose
from warp_ar.sources.deep_frame import Plate
from warp_ar.tracking.drift import codes_around, still_points, under_boxes

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
"""Stride through the scene's still points."""
LEAST_POINTS = 24
"""Points that must be seen again, all over."""
LEAST_NEAR = 8
"""Points that must be seen again beside a ball."""
PATIENCE = 1.5
"""Seconds after which what covers a ball is taken for a part of the scene."""
MEMORY = 0.3
"""Time constant in seconds with which remembered codes follow frames."""
DISC_SECONDS = 0.008
"""Least seconds between two tests of the balls' discs: every frame up to 120 frames a second. An object at 1 m/s
moves 8 mm meanwhile."""
LOOK_SECONDS = 0.1
"""Least seconds between two tests of the points while no disc changes; they take four times as long as the discs."""
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
        """Things that frames are of: the same frames tell those that watch the same, the same."""
        self._camera = camera
        self._table = decode_table(camera.transfer).astype(np.float64)
        self._points = np.concatenate([still_points(scene)[0][::EVERY], _points_around(scene)])
        self.forget()

    def forget(self) -> None:
        """Take the next frame for the first."""
        self._shown: Array | None = None
        self._discs: list[Array] = []
        self._last = self._looked = self._since = 0.0
        self._covered = False

    def rests(self, seconds: float) -> bool:
        """Return whether the last look was so short a time ago that what it found still holds.

        Args:
            seconds: When the frame was taken.
        """
        return self._shown is not None and 0.0 < abs(seconds - self._last) < DISC_SECONDS

    @property
    def is_covered(self) -> bool:
        """Return whether a ball was covered at the last look."""
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
        changed = [known and _has_changed(now - before) for now, before in zip(own, self._discs, strict=False)]
        rests = known and not self._covered and not any(changed)
        if not rests or abs(seconds - self._looked) >= LOOK_SECONDS:
            shown = self._logarithm(codes_around(image, self._camera, pose, self._points, plate), gain)
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
        """Return whether a ball is covered, by what points show now and showed before, and which discs changed."""
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
            near = (away > BESIDE[0]) & (away < BESIDE[1])
            if has_changed and near.sum() >= LEAST_NEAR and is_other[near].mean() >= NEAR_SHARE:
                return True
        return False

    def _cells(
        self, image: NDArray[np.uint8], disc: tuple[float, float, float], gain: Array, plate: Plate | None = None
    ) -> Array:
        """Logarithm of what a disc's cells show, four samples of each, NaN beyond the picture, (cells, 3)."""
        picture: NDArray[Any] = image if plate is None else plate.picture
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
        """Of the radiance that codes stand for at gain 1, (n, 3)."""
        values = np.stack([np.interp(codes[:, c], np.arange(256), self._table[:, c]) for c in range(3)], -1)
        return np.asarray(np.log(values / gain + DARK))


def _samples_in_disc() -> Array:
    """Four places of each cell of a square that lies in the disc, (4, cells, 2) in radii: half a cell of blur."""
    middle = 2.0 * (np.arange(CELLS) + 0.5) / CELLS - 1.0
    row, column = np.nonzero(np.hypot(middle, middle[:, None]) < 0.9)
    around = np.array([[-0.5, -0.5], [0.5, -0.5], [-0.5, 0.5], [0.5, 0.5]]) / CELLS
    return np.stack([middle[column], middle[row]], -1) + around[:, None]


_SAMPLES = _samples_in_disc()


def _has_changed(change: Array) -> bool:
    """Return whether enough cells of a ball's disc changed, (cells, 3); cells hidden in either frame did not."""
    return bool((np.abs(change) > CHANGED).any(axis=1).mean() >= DISC_SHARE)


def _follow(before: Array, now: Array, seconds: float) -> Array:
    """Return the memory ``before``, moved toward the seen cells of ``now`` by the time constant ``MEMORY``."""
    followed = before + (1.0 - np.exp(-abs(seconds) / MEMORY)) * (now - before)
    followed = np.where(np.isnan(before), now, followed)
    return np.asarray(np.where(np.isnan(followed), before, followed))


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
            found.append(points[~under_boxes(scene, points)])
    return np.concatenate(found)
