"""Evidence for a mirror ball's rim in a picture: how well each piece of an outline explains the profile across it.

At its rim a mirror reflects the surface behind it, so the step across the outline is often weaker than the reflections
inside it. These are compressed toward the rim in a known way. At t pixels outward from the rim of a ball with a radius
of r pixels, the ray mirrored at t < 0 is deflected by

    q(t) = 2 acos(1 + t / r),

which grows like a square root. Any background is compressed beyond resolution within the first pixel or two, and
further inside changes slowly in q. A profile across the rim is therefore modelled, before the picture's own blur, as

    I(t) = a0 + a1 t  outside,    b0 + b1 q(t) + b2 q(t)^2  inside,

which is linear in its five coefficients. For each shift s of the rim along the normal they are solved for. The residual
C(s) gives the profile's cost (n / 2) log(C(s) + floor): a likelihood with unknown noise. The cost is flat where no rim
is visible. Where a stand or a reflection makes a stronger step, the cost is bounded by ``MOST_COST``, so that other
pieces outvote it.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from warp_ar.kernels.color import decode_table

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

STEP = 0.5
"""Distance in pixels between samples of a profile; finer sampling adds no information."""
SHIFT_STEP = 0.1
"""Distance in pixels between evaluated shifts; costs in between are interpolated."""
MOST_COST = 4.5
"""Bound of a profile's cost above its minimum: 4.5 is three standard deviations."""
STEP_WINDOW = (3.0, 5.0)
"""Range in pixels inside and outside the rim in which steps are searched."""
FINE_WINDOW = (2.0, 3.0)
"""Range in pixels inside and outside the rim for measurement; other reflections are close."""
INNER_BAND, OUTER_BAND = (-0.16, -0.02), (0.03, 0.18)
"""Bands inside and outside a rim, relative to the radius, whose gradients are compared."""
DISC_BANDS = (0.2, 0.4, 0.6, 0.75, 0.87, 0.97)
"""Limits of the bands inside a rim, relative to the radius, in which reflections are compared with a mirror ball's."""
FLAT = 1e-6
"""Squared gradient, per pixel of codes from 0 to 1, below which a picture is uniform."""
NOISE = 1.5 / 255.0
"""Smallest assumed standard deviation of a profile, relative to the range of codes."""


def _bases(t: Array, shifts: Array, radius: float, blur: float) -> Array:
    """Return the model's columns (k, n, 5) at samples ``t`` (n,) for each shift of the rim (k,)."""
    fine = 0.05
    edge = np.abs(t).max() + np.abs(shifts).max() + 4 * blur + 1
    u = np.arange(-edge, edge, fine)
    inside = u < 0
    q = np.where(inside, 2.0 * np.arccos(np.clip(1.0 + np.minimum(u, 0.0) / radius, -1.0, 1.0)), 0.0)
    columns = [inside * 1.0, q, q * q, (~inside) * 1.0, np.where(inside, 0.0, u)]
    kernel = np.exp(-0.5 * (np.arange(-4 * blur, 4 * blur + fine, fine) / blur) ** 2)
    blurred = [np.convolve(column, kernel / kernel.sum(), "same") for column in columns]
    return np.stack([np.stack([np.interp(t - s, u, column) for column in blurred], 1) for s in shifts])


def _left(basis: Array) -> Array:
    """Return the projection (n, n) onto the residuals of columns (n, k), slightly regularised."""
    basis = basis / (np.linalg.norm(basis, axis=0) + 1e-9)
    gram = basis.T @ basis + 1e-6 * np.eye(basis.shape[1])
    return np.asarray(np.eye(len(basis)) - basis @ np.linalg.solve(gram, basis.T))


@functools.lru_cache(maxsize=64)
def _projections(inward: float, outward: float, shift: float, radius: float, blur: float) -> tuple[Array, Array]:
    """Return shifts (k,) and the matrix (n, n) of each that maps a profile to its residual under the model."""
    t = np.arange(-inward, outward + 0.5 * STEP, STEP)
    shifts = np.arange(-shift, shift + 0.5 * SHIFT_STEP, SHIFT_STEP)
    return shifts, np.stack([_left(basis) for basis in _bases(t, shifts, radius, blur)])


@functools.lru_cache(maxsize=64)
def _window(radius: float, blur: float) -> tuple[Array, Array]:
    """Return matrices (n, n) from a window around the rim to its residuals under the model and a parabola."""
    t = np.arange(-STEP_WINDOW[0], STEP_WINDOW[1] + 0.5 * STEP, STEP)
    return _left(_bases(t, np.zeros(1), radius, blur)[0]), _left(np.stack([np.ones_like(t), t, t * t], 1))


@dataclasses.dataclass(frozen=True)
class RimEvidence:
    """Cost of each piece of an outline as a function of its shift along the outward normal."""

    shifts: Array
    """Shifts in pixels, (k,), evenly spaced about zero."""
    costs: Array
    """Costs, (n, k), above each piece's minimum and at most ``MOST_COST``; zero for pieces outside the picture."""
    known: NDArray[np.bool_]
    """Mask of pieces (n,) inside the picture."""
    least: float = 0.0
    """Mean of the pieces' minimal costs, for comparing blurs."""

    def totals(self, shifts: Array) -> Array:
        """Return mean costs (m,) of the pieces shifted by ``shifts`` (m, n) pixels.

        Outside the window the cost is maximal.
        """
        return self._each(shifts).mean(1) if self.known.any() else np.full(len(shifts), MOST_COST)

    def _each(self, shifts: Array) -> Array:
        """Return the costs of the pieces inside the picture, (m, known)."""
        last = len(self.shifts) - 1
        at = (shifts[:, self.known] - self.shifts[0]) / (self.shifts[1] - self.shifts[0])
        low = np.clip(at.astype(int), 0, last - 1)
        share = np.clip(at - low, 0.0, 1.0)
        costs = self.costs[self.known].ravel()
        place = low + np.arange(at.shape[1]) * (last + 1)
        cost = (1.0 - share) * costs[place] + share * costs[place + 1]
        return np.where((at < 0) | (at > last), MOST_COST, cost)

    def support(self, shift: Array) -> float:
        """Return the share of pieces in view that support the outline; for evidence from ``gather_steps``."""
        return float((self._each(shift[None]) < 0.5 * MOST_COST).mean()) if self.known.any() else 0.0

    def without(self, gone: NDArray[np.bool_]) -> RimEvidence:
        """Return the evidence without some pieces."""
        return dataclasses.replace(self, known=self.known & ~gone)


def _profiles(
    image: Image,
    table: NDArray[np.float32],
    points: Array,
    normals: Array,
    inward: float,
    outward: float,
    *,
    whole: bool = True,
) -> tuple[Array, NDArray[np.bool_]]:
    """Return profiles across an outline, (m, channels, samples), of the pieces inside the picture, and their mask (n,).

    ``table`` (256,) gives the value of each code. With ``whole``, a piece counts as inside only if its profile does.
    Otherwise only the piece itself must be inside, and the picture's border is replicated.
    """
    height, width = image.shape[:2]
    t = np.arange(-inward, outward + 0.5 * STEP, STEP)
    at = points[:, None] + t[None, :, None] * normals[:, None]
    asked = at if whole else points[:, None]
    known = np.asarray(((asked >= 0) & (asked <= (width - 1, height - 1))).all((1, 2)))
    if not known.any():
        return np.zeros((0, image.shape[2], len(t))), known
    low = np.clip(np.floor(at[known].min((0, 1))).astype(int) - 2, 0, (width - 1, height - 1))
    high = np.maximum(np.ceil(at[known].max((0, 1))).astype(int) + 3, low + 1)
    part = table[image[low[1] : high[1], low[0] : high[0]]]
    x, y = np.moveaxis((at[known] - low).astype(np.float32), 2, 0)
    found = cv2.remap(part, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.moveaxis(found.reshape(*x.shape, -1), 2, 1).astype(float), known


def gather_steps(
    image: Image, points: Array, normals: Array, radius: float, *, shift: float, blur: float = 0.8
) -> RimEvidence:
    """Return evidence for steps: how much better the model explains a window around each shift than a smooth curve.

    A piece of the outline has the cost ``MOST_COST`` without a step and 0 with a certain step, independent of its
    contrast: the rim is the circle on which most pieces have one.
    """
    inward, outward = STEP_WINDOW
    profiles, known = _profiles(image, _CODES, points, normals, inward + shift, outward + shift, whole=False)
    shifts = np.arange(-shift, shift + 0.5 * STEP, STEP)
    costs = np.zeros((len(points), len(shifts)))
    if not known.any():
        return RimEvidence(shifts, costs, known)
    step, smooth = _window(float(f"{radius:.2g}"), blur)
    size = len(step)
    flat = profiles.reshape(-1, profiles.shape[2])
    count = profiles.shape[2] - size + 1
    gain, floor = np.empty((len(flat), count)), NOISE**2 * size
    for k in range(count):
        window = flat[:, k : k + size]
        plain, rest = ((window @ smooth) ** 2).sum(1), ((window @ step) ** 2).sum(1)
        gain[:, k] = 0.5 * STEP * size * np.log((plain + floor) / (rest + floor))
    gain = gain.reshape(-1, 3, count).max(1) - 1.0
    gain = np.clip(gain, 0.0, MOST_COST)
    costs[known] = MOST_COST - gain
    return RimEvidence(shifts, costs, known)


def gather_evidence(
    image: Image, points: Array, normals: Array, radius: float, *, shift: float, blur: float
) -> RimEvidence:
    """Return the cost, a negative log likelihood, of each piece of an outline that is accurate to ``shift`` pixels.

    Args:
        image: uint8 RGB (height, width, 3).
        points: Outline (n, 2), pixels.
        normals: Outward unit normals (n, 2).
        radius: Radius of the ball in pixels.
        shift: Largest error of the outline in pixels.
        blur: Standard deviation of the picture's blur in pixels.
    """
    inward, outward = FINE_WINDOW[0] + shift, FINE_WINDOW[1] + shift
    # Blur is linear in radiance, and codecs blur chroma.
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    profiles, known = _profiles(gray[..., None], _LIGHT, points, normals, inward, outward)
    shifts, left = _projections(inward, outward, round(shift, 1), float(f"{radius:.2g}"), round(blur, 2))
    costs = np.zeros((len(points), len(shifts)))
    if not known.any():
        return RimEvidence(shifts, costs, known)
    light = profiles[:, 0] / (profiles[:, 0].mean(1, keepdims=True) + 0.03)
    size = left.shape[1]
    rest = np.stack([((light @ matrix) ** 2).sum(1) for matrix in left], 1)
    # Neighbouring samples share pixels: a profile counts as one sample per pixel of its length.
    told = 0.5 * size * STEP * np.log(rest / size + NOISE**2)
    best = told.min(1, keepdims=True)
    costs[known] = np.minimum(told - best, MOST_COST)
    return RimEvidence(shifts, costs, known, float(best.mean()))


_CODES = (np.arange(256) / 255.0).astype(np.float32)
_LIGHT = decode_table("srgb")[:, 1].astype(np.float32)


def gradients(image: Image) -> NDArray[np.float32]:
    """Return derivatives of a picture's brightness (codes from 0 to 1) along x and y, (height, width, 2)."""
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255.0
    return np.dstack([cv2.Sobel(gray, cv2.CV_32F, *way, scale=1 / 8) for way in ((1, 0), (0, 1))])


def radial_compression(slopes: NDArray[np.float32], points: Array, normals: Array, radii: Array) -> Array:
    """Return how much stronger radial gradients are just inside outlines than just outside.

    A ball compresses its reflections along the radius, not along the rim, because q'(t) is unbounded there. Gradients
    inside the rim are therefore radial, and gradients outside are independent of the ball. A concentrically mirrored
    edge, such as a table's, has radial gradients on both sides.

    Args:
        slopes: Result of ``gradients``.
        points: Outlines (m, n, 2), pixels.
        normals: Outward unit normals (m, n, 2).
        radii: Radii of the balls in pixels, (m,).

    Returns:
        Mean logarithm of radial over tangential energy inside, minus the same outside, (m,): 2 to 3 at a rim, below 0
        inside it.
    """
    bands = np.concatenate([np.linspace(low, high, 6) for low, high in (INNER_BAND, OUTER_BAND)])
    radial, tangential = _energies(slopes, points, normals, radii[:, None] * bands)
    ratio = np.clip(np.log(radial / tangential), -3.0, 3.0).mean(1)
    return np.asarray(ratio[:, :6].mean(1) - ratio[:, 6:].mean(1))


def mirror_misfit(slopes: NDArray[np.float32], points: Array, normals: Array, radius: float) -> float:
    """Return the root mean square by which the compression inside an outline differs from a mirror ball's.

    At s radii from the centre, a ball compresses its reflections 1 / (1 - s^2) times as strongly along the radius as
    along the rim. Blur and edges of finite length leave the square root of the ratio of energies, with the logarithm

        -ln(1 - s^2).

    A wheel's spokes, a coin's or a saucer's rings, and a print on a flat disc differ.

    Args:
        slopes: Result of ``gradients``.
        points: Outline (n, 2), pixels.
        normals: Outward unit normals (n, 2).
        radius: Radius of the outline in pixels.
    """
    s = np.concatenate([np.linspace(low, high, 6) for low, high in itertools.pairwise(DISC_BANDS)])
    energies = _energies(slopes, points[None], normals[None], radius * (s[None] - 1.0))
    radial, tangential = (one[0].reshape(len(one[0]), -1, 6).mean(2) for one in energies)
    ratio = np.clip(np.log(radial / tangential), -3.0, 3.0).mean(0)
    off = ratio + np.log(1.0 - s * s).reshape(-1, 6).mean(1)
    return float(np.sqrt((off * off).mean()))


def _energies(slopes: NDArray[np.float32], points: Array, normals: Array, reach: Array) -> tuple[Array, Array]:
    """Return radial and tangential energies, (m, n / 8, k), at ``reach`` (m, k) pixels outward from outlines."""
    reach = reach[:, None]
    nx, ny = normals[..., 0, None], normals[..., 1, None]
    shape = (len(points), points.shape[1], reach.shape[2])
    x, y = ((points[..., k, None] + reach * n).astype(np.float32).reshape(-1, shape[2]) for k, n in ((0, nx), (1, ny)))
    slope = cv2.remap(slopes, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    dx, dy = slope[..., 0].reshape(shape), slope[..., 1].reshape(shape)
    pieces = shape[1] // 8

    def energy(v: Array) -> Array:
        return np.asarray((v * v)[:, : 8 * pieces].reshape(shape[0], pieces, 8, -1).mean(2) + FLAT)

    return energy(dx * nx + dy * ny), energy(dy * nx - dx * ny)


def descend(costs: Callable[[Array], Array], start: Array, step: float, least: float) -> tuple[Array, float]:
    """Minimise a function of few unknowns by pattern search, which needs no derivatives of interpolated costs.

    Args:
        costs: Function from positions (m, n) to costs (m,).
        start: Initial position, (n,).
        step: First step length.
        least: Last step length.
    """
    best, value = start.copy(), float(costs(start[None])[0])
    size = len(start)
    # Steps along each axis and along the diagonals of all: a circle's position and radius are correlated.
    axes = [sign * axis for axis in np.eye(size) for sign in (1.0, -1.0)]
    moves = np.array([*axes, *np.stack(np.meshgrid(*[(-1.0, 1.0)] * size), -1).reshape(-1, size)])
    while step >= least:
        values = costs(best + step * moves)
        k = int(np.argmin(values))
        if values[k] < value - 1e-12:
            best, value = best + step * moves[k], float(values[k])
        else:
            step *= 0.5
    return best, value
