"""Fitting of poses to a marker's printed edges by Gauss-Newton, in NumPy.

The module ``tracking`` derives the equations. The reach of an edge point is half the width in pixels of the window,
across the edge, over which the picture is sampled.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from warp_ar.kernels.color import decode_table
from warp_ar.scene import Camera, Pose
from warp_ar.tracking.markers import Pattern

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Box = tuple[slice, slice]
"""Rows and columns of a part of a picture."""

NOISE_FLOOR: Final = 0.03
"""Smallest standard deviation in pixels that is assumed for an edge point (sampling, lens model, print)."""
CORRELATED: Final = 2.0
"""Number of neighbouring edge points that count as one independent measurement, because they share pixels."""
_TAPS: Final = np.linspace(-1.0, 1.0, 9)
"""Positions across an edge at which the picture is sampled, relative to the reach."""
_WEIGHTS: Final = np.array([0.125, *([0.25] * 7), 0.125])
"""Weights of the trapezoid rule for the positions ``_TAPS``."""
_CLEARANCE: Final = 0.45
"""Largest reach, as a share of the distance to the nearest parallel edge."""
_MIN_REACH: Final = 1.0
"""Smallest reach in pixels. An edge whose reach would be smaller is not measured, because the blur of neighbouring
edges overlaps it."""
_CONTRAST: Final = 0.3
"""Smallest contrast of an edge, relative to the median contrast."""
_LEAST_CONTRAST: Final = 1e-4
"""Smallest contrast of an edge in linear radiance."""
_MIN_EDGES: Final = 16
"""Smallest number of measured edge points: nine unknowns, and redundancy for the rejection of outliers."""
_DONE: Final = 0.05
"""Displacement of edges in pixels below which a Gauss-Newton step is the last. Another step would move the edges about
a tenth as far."""
_PRIOR: Final = np.diag([0.0] * 6 + [1.0] * 3)
"""Regularisation of the least squares: the squares of the three shift parameters, in pixels, are added to the sum of
squared residuals. Otherwise shift and distance of a print without inner edges could not be separated."""
_TUKEY: Final = 4.7
"""Residual in standard deviations beyond which an edge has weight 0, for example a covered edge or a reflection."""
_MIN_CELLS: Final = 8
"""Smallest number of visible cells for the correlation of their brightness with the print."""
_NEAR: Final = 1e-6
"""Smallest z of a point in the camera's frame, metres."""


@dataclasses.dataclass(frozen=True)
class Fit:
    """Pose measured in one frame, with its uncertainty."""

    pose: Pose
    """``camera_from_world``."""
    information: Array
    """Inverse covariance, (6, 6), of rotation vector and translation around the pose."""
    error: float
    """Root mean square residual in pixels, weighted."""
    support: float
    """Share of the printed edges that agree with the pose, 0 to 1: the sum of the weights per edge point."""
    cost: float
    """Mean squared residual in pixels squared; for edges, each square is at most 1."""
    pattern: float
    """Correlation of the cells' brightness with the print, -1 to 1."""
    edges: bool = True
    """True if the pose is fitted to edges; False if only to detected corners."""


@dataclasses.dataclass(frozen=True)
class _Solution:
    """Solution of the edge points' equations by reweighted least squares."""

    step: Array
    """Update of rotation vector and translation, (6,)."""
    information: Array
    """Inverse covariance of the update, (6, 6), with the shift parameters eliminated."""
    residuals: Array
    """Residuals of the equations in pixels, (n,)."""
    weights: Array
    """Weights of the equations, 0 to 1, (n,)."""


class EdgeFitter:
    """Fitter of one print's pose to pictures of one camera.

    ``gray`` holds the current picture in grey. It has the size of the whole picture, but only the part given to
    ``show`` is valid.
    """

    def __init__(self, pattern: Pattern, camera: Camera) -> None:
        """Allocate arrays.

        Args:
            pattern: The printed pattern.
            camera: Camera of the pictures.
        """
        self._pattern = pattern
        self.matrix = np.asarray(camera.matrix(), float)
        self.distortion = np.asarray(camera.distortion, float).ravel()
        self._linear = decode_table(camera.transfer).mean(1).astype(np.float32)
        self.gray: Image = np.zeros((camera.height, camera.width), np.uint8)
        self._box: Box = slice(0, camera.height), slice(0, camera.width)

    def show(self, image: Image, box: Box) -> Image:
        """Set the picture, and the part of it that is used for fitting.

        Args:
            image: uint8 (height, width, 3) RGB, or (height, width) grey.
            box: Rows and columns of the part.

        Returns:
            The part in grey; valid until the next call.
        """
        part = self.gray[box]
        if image.ndim == 2:
            part[...] = image[box]
        else:
            cv2.cvtColor(image[box], cv2.COLOR_RGB2GRAY, dst=part)
        self._box = box
        return part

    def project(self, points: Array) -> tuple[Array, Array]:
        """Return the pixels, (n, 2), of points in the camera's frame, (n, 3), and their derivatives, (n, 2, 3)."""
        # With identity pose, OpenCV's derivative by the translation equals the derivative by the point.
        zero = np.zeros(3)
        pixels, jacobian = cv2.projectPoints(points, zero, zero, self.matrix, self.distortion)
        return pixels.reshape(-1, 2), np.asarray(jacobian)[:, 3:6].reshape(-1, 2, 3)

    def fit(self, pose: Pose, reaches: Sequence[float]) -> Fit | None:
        """Fit a pose to the edges in the part given to ``show``; None if too few edges are visible.

        Args:
            pose: Initial ``camera_from_world``.
            reaches: Largest reach in pixels of each Gauss-Newton step, in decreasing order.
        """
        solved: _Solution | None = None
        for reach in reaches:
            measured = self._measure(pose, reach)
            solved = None if measured is None else _solve(*measured)
            if measured is None or solved is None:
                return None
            step = solved.step
            pose = Pose(cv2.Rodrigues(step[:3])[0] @ pose.rotation, pose.translation + step[3:])
            moved = float(np.abs(measured[0][:, :6] @ step).max())
            if reach == reaches[-1] or (reach <= reaches[1] and moved < _DONE):
                break
        is_behind = pose.apply(self._pattern.outline)[:, 2].min() <= 0.0
        if solved is None or is_behind or pose.rotation[:, 2] @ pose.translation >= 0.0:
            return None
        squares, kept = solved.residuals**2, float(solved.weights.sum())
        return Fit(
            pose,
            solved.information,
            error=float(np.sqrt((solved.weights * squares).sum() / kept)),
            support=kept / len(self._pattern.points),
            cost=float(np.minimum(squares, 1.0).mean()),
            pattern=self.correlate(pose),
        )

    def correlate(self, pose: Pose) -> float:
        """Return the correlation, -1 to 1, of the brightness at the cells' centres with the print under a pose.

        The result is 0 if too few cells are visible.
        """
        points = pose.apply(self._pattern.cells)
        if points[:, 2].min() <= _NEAR:
            return 0.0
        at = self.project(points)[0]
        inside = self._holds(at, at)
        if inside.sum() < _MIN_CELLS:
            return 0.0
        values = self._sample(at[inside])
        # Clamping to percentiles limits the influence of lamps' reflections.
        values = np.clip(values, *np.percentile(values, (5, 95)))
        white = self._pattern.white[inside]
        a, b = values - values.mean(), white - white.mean()
        scale = float(np.sqrt((a @ a) * (b @ b)))
        return float(a @ b) / scale if scale > 1e-9 else 0.0

    def _holds(self, low: Array, high: Array) -> NDArray[np.bool_]:
        """Return a mask, (n,), of pixel pairs whose bounding box lies in the part given to ``show``.

        Args:
            low: One pixel of each pair, (n, 2).
            high: The other pixel of each pair, (n, 2).
        """
        rows, columns = self._box
        begins, ends = (columns.start, rows.start), (columns.stop - 1, rows.stop - 1)
        return np.asarray((low >= begins).all(axis=-1) & (high <= ends).all(axis=-1))

    def _sample(self, at: Array) -> Array:
        """Return bilinear samples of linear radiance, (...,), at positions (..., 2) inside the picture."""
        height, width = self.gray.shape
        corner = np.floor(at)
        right, below = (at - corner).astype(np.float32).transpose(-1, *range(at.ndim - 1))
        left, top = corner.astype(np.intp).transpose(-1, *range(at.ndim - 1))
        first = top * width + left
        beside = np.minimum(left + 1, width - 1) - left
        under = (np.minimum(top + 1, height - 1) - top) * width
        a, b, c, d = (self._linear[self.gray.ravel()[first + more]] for more in (0, beside, under, beside + under))
        upper, lower = a + right * (b - a), c + right * (d - c)
        return np.asarray(upper + below * (lower - upper), np.float64)

    def _measure(self, pose: Pose, reach: float) -> tuple[Array, Array] | None:
        """Return a linear equation for each visible edge point; None if too few are visible.

        Args:
            pose: ``camera_from_world`` from which the edges are measured.
            reach: Largest reach in pixels.

        Returns:
            Coefficients of rotation vector, translation and the three shift parameters, (n, 9); and the offset of each
            measured edge from its predicted place toward the white side, pixels, (n,).
        """
        pattern, turn = self._pattern, pose.rotation.T
        arm = pattern.points @ turn
        points = arm + pose.translation
        if points[:, 2].min() <= _NEAR:
            return None
        at, jacobian = self.project(points)
        along = np.einsum("nij,nj->ni", jacobian, pattern.tangents @ turn)
        normal = np.stack([-along[:, 1], along[:, 0]], -1) / np.maximum(np.linalg.norm(along, axis=1), 1e-9)[:, None]
        pull = np.einsum("ni,nij->nj", normal, jacobian)
        width = (pull * (pattern.normals @ turn)).sum(axis=1)
        half = np.minimum(_CLEARANCE * np.abs(width) * pattern.clearances, reach)
        way = half[:, None] * np.abs(normal)
        inside = (half >= _MIN_REACH) & self._holds(at - way, at + way)
        if inside.sum() < _MIN_EDGES:
            return None
        toward_white = np.where(width < 0.0, -1.0, 1.0)[inside, None]
        at, half, arm = at[inside], half[inside], arm[inside]
        normal, pull = toward_white * normal[inside], toward_white * pull[inside]
        values = self._sample(at[:, None] + (half[:, None] * _TAPS)[..., None] * normal[:, None])
        # The level at each end is the mean of its two outermost samples.
        black, white = 0.5 * (values[:, 0] + values[:, 1]), 0.5 * (values[:, -2] + values[:, -1])
        contrast = white - black
        seen = contrast > max(_CONTRAST * float(np.median(contrast)), _LEAST_CONTRAST)
        if seen.sum() < _MIN_EDGES:
            return None
        half, pull = half[seen], pull[seen]
        area = (2.0 * white - values @ _WEIGHTS)[seen] / contrast[seen]
        x, y = normal[seen].T
        shift = np.stack([np.ones_like(x), x * x - y * y, 2.0 * x * y], axis=1)
        design = np.hstack([np.cross(arm[seen], pull), pull, shift])
        return design, np.clip(half * (area - 1.0), -half, half)


def _solve(design: Array, offsets: Array) -> _Solution | None:
    """Return the solution by least squares with Tukey's weights, updated three times; None if there is none.

    Args:
        design: Coefficients of the equations, (n, 9).
        offsets: Right sides of the equations, pixels, (n,).
    """
    weights = np.ones(len(design))
    for _ in range(3):
        weighted = weights[:, None] * design
        try:
            solution = np.linalg.solve(weighted.T @ design + _PRIOR, weighted.T @ offsets)
        except np.linalg.LinAlgError:
            return None
        residuals = offsets - design @ solution
        ranked = np.sort(np.abs(residuals))
        spread = max(1.4826 * float(ranked[len(ranked) // 2]), NOISE_FLOOR)
        weights = np.maximum(1.0 - (residuals / (_TUKEY * spread)) ** 2, 0.0) ** 2
    if not np.isfinite(solution).all():
        return None
    normal = (weights[:, None] * design).T @ design + _PRIOR
    shared = normal[:6, 6:] @ np.linalg.solve(normal[6:, 6:], normal[6:, :6])
    information = (normal[:6, :6] - shared) / (CORRELATED * spread**2)
    return _Solution(*(np.asarray(values, float) for values in (solution[:6], information, residuals, weights)))
