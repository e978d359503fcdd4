"""How a plane mirrors, told from one picture of it and the light that a mirror ball beside it shows.

What a point p of a plane sends to the camera is, in each channel,

    I(p) = albedo(p) E(p) / pi + F0 A(p) + B(p) + texture,

with A = mean (1 - s) G L and B = mean s G L over GGX's facets as the camera sees them: L the environment along what a
facet mirrors, s = (1 - cos)^5 Schlick's share, G = G2 / G1 Smith's masking. For a given roughness, and a given distance
of what surrounds the ball, I is linear in F0. The albedo is a polynomial of the place, E the irradiance less what the
ball hides; texture is what remains, and is weighed down where it is large.

Texture can look like a reflection. It knows nothing of the room, though: an environment that is turned about the
plane's normal would explain it as well. So the same fit is made with turned environments, and nothing is said unless
the true one explains more than ``LEAST_ADVANTAGE`` times as much as the best of them. The interval comes from leaving
out one part of the picture after the other, and from what fits nearly as well.

What a table mirrors toward a camera that looks along it is what the ball shows at its rim, where a map is poor: a lamp
that is there five degrees off would make a gloss of 0.06 one of 0.02. Such places are left out (``shown_well``).
"""

from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ALPHAS = (0.0025, 0.01, 0.0225, 0.04, 0.0625, 0.1, 0.15, 0.22, 0.32)
"""Widths of a lobe that are tried: roughness 0.05 to 0.57. Beyond, a lobe is too wide to be told from shading."""
DISTANCES = (25.0, 60.0, math.inf)
"""Distances of the surroundings that are tried, in radii of the ball."""
REACH = 12.0
"""Radii of the ball around it within which the plane is looked at: what lies beyond may be another surface."""
LEAST_OPEN = 0.7
"""Share of the irradiance that the ball must leave a place: its shadow is known less well than its light."""
CELLS = 1800
"""Parts of the picture, about, into whose means it is divided."""
FACETS = 24
"""Rays of a part."""
LEAST_KNOWN = 0.9
"""Share of what a part mirrors that the ball must show well."""
RIM = 0.5
"""Cosine on the ball between its normal and the camera below which it shows little: there a pixel of a ball of 50
pixels covers more than 4 degrees, and half of one is the uncertainty of its outline."""
MOST_CLIPPED = 0.1
"""Share of what a part mirrors that may be a lower bound."""
TURNS = 12
"""Directions of the environment, the true one among them, about the normal."""
LEAST_ADVANTAGE = 1.5
"""Times as much as the best of them that the true one must explain."""
LEAST_SIGNIFICANCE = 3.0
"""Standard deviations that F0 must be from 0."""
NEARLY = 0.7
"""Of what the best fit explains, from which on another width's or distance's F0 belongs to the interval."""
DILUTION = 1.5
"""Upper end of the interval over what the fits say: places and radiance that are not quite true let a reflection look
weaker, not stronger."""
WIDEST = 0.05
"""Width of a lobe from which on shading and texture take part of what is mirrored for theirs: of roughness 0.22."""
PARTS = 12
"""Sectors around the middle of what is seen that are left out in turn."""
LEAST_CELLS = 200


@dataclasses.dataclass(frozen=True)
class View:
    """A picture of a plane z = 0 and of the ball on it, in units of any length."""

    radiance: NDArray[np.float32]
    """(H, W, 3) linear, in camera values; 1 clips."""
    usable: NDArray[np.bool_]
    """(H, W) whether a pixel shows the plane, as far as is known."""
    rays: Array
    """(H, W, 3) directions of pixels in the world."""
    eye: Array
    """(3,) the camera."""
    center: Array
    """(3,) the ball's centre."""
    radius: float
    """Of the ball."""
    reflectance: float
    """Of the ball."""


@dataclasses.dataclass(frozen=True)
class Surroundings:
    """Light at the ball."""

    radiance: NDArray[np.float32]
    """(h, 2 h, 3) latlong."""
    clipped: NDArray[np.float32]
    """(h, 2 h) 0 to 1, the share that is a lower bound."""
    confidence: NDArray[np.float32]
    """(h, 2 h) 0 where nothing was seen."""


@dataclasses.dataclass(frozen=True)
class FoundGloss:
    """What was found; ``reflectance`` is None where the evidence does not hold."""

    reflectance: float | None
    """F0."""
    reflectance_low: float
    """Lower end of an interval: two standard deviations about all that fit nearly as well; 0 where nothing is found."""
    reflectance_high: float
    """Upper end."""
    roughness: float
    """Perceptual, as glTF has it."""
    roughness_low: float
    """Least of the widths that parts of the picture ask for."""
    roughness_high: float
    """Largest of them."""
    advantage: float
    """How many times as much the true environment explains as the best turned one."""
    words: str
    """One sentence that says so."""


def _halton(count: int, base: int) -> Array:
    out = np.zeros(count)
    for k in range(count):
        f, n = 1.0, k + 1
        while n:
            f /= base
            out[k] += f * (n % base)
            n //= base
    return out


def _look_up(image: NDArray[np.float32], directions: Array, turn: float) -> Array:
    """Bilinear samples (n, k, C) of a latlong map whose surroundings are turned by an angle about z."""
    h = image.shape[0]
    phi = np.arctan2(directions[..., 1], directions[..., 0]) - turn
    theta = np.arccos(np.clip(directions[..., 2], -1.0, 1.0))
    x = np.mod((phi / (2.0 * math.pi) + 0.5) * 2 * h - 0.5, 2 * h)
    y = np.clip(theta / math.pi * h - 0.5, 0.0, h - 1.0)
    wide = np.concatenate([image, image[:, :1]], axis=1)
    out = cv2.remap(wide, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR)
    return np.asarray(out, float)


@dataclasses.dataclass(frozen=True)
class _Cells:
    """Means over parts of the picture."""

    shown: Array  # (n, 3)
    point: Array  # (n, 3)
    wo: Array  # (n, 3)
    basis: Array  # (n, k) polynomials times the open irradiance
    sector: NDArray[np.int64]  # (n,) for leaving out


def _divide(view: View, light: Surroundings) -> _Cells:
    """Parts of the picture that show the plane near the ball, unclipped and out of the ball's shadow."""
    down = view.rays[..., 2] < -1e-3
    t = np.where(down, -view.eye[2] / np.where(down, view.rays[..., 2], -1.0), 0.0)
    place = view.eye + t[..., None] * view.rays
    apart = np.hypot(place[..., 0] - view.center[0], place[..., 1] - view.center[1])
    good = view.usable & down & (t > 0.0) & (apart < REACH * view.radius) & (view.radiance.max(-1) < 0.95)
    good &= ~_meets(np.broadcast_to(view.eye, view.rays.shape), view.rays, view.center, 1.05 * view.radius)
    side = max(1, round(math.sqrt(max(int(good.sum()), 1) / CELLS)))
    h, w = (n - n % side for n in good.shape)

    def mean(values: NDArray[np.generic]) -> Array:
        shape = (h // side, side, w // side, side, -1)
        return np.asarray(values[:h, :w].reshape(shape).astype(float).mean((1, 3)))

    whole = mean(good)[..., 0] > 0.999
    shown, point = mean(view.radiance)[whole], mean(place)[whole]
    wo = view.eye - point
    wo /= np.linalg.norm(wo, axis=-1, keepdims=True)
    openness = _openness(view, light, point)
    keep = openness.min(-1) > LEAST_OPEN if len(point) else np.zeros(0, bool)
    shown, point, wo, openness = shown[keep], point[keep], wo[keep], openness[keep]
    if not len(point):
        return _Cells(shown, point, wo, np.zeros((0, 6, 3)), np.zeros(0, np.int64))
    x, y = ((point[:, k] - point[:, k].mean()) / (REACH * view.radius) for k in range(2))
    polynomials = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], -1)
    around = np.arctan2(y - np.median(y), x - np.median(x))
    order = np.argsort(np.argsort(around))
    return _Cells(shown, point, wo, polynomials[:, :, None] * openness[:, None, :], order * PARTS // len(order))


def _meets(origin: Array, direction: Array, center: Array, radius: float) -> NDArray[np.bool_]:
    """Whether rays meet a sphere."""
    o = origin - center
    b = (o * direction).sum(-1) / np.linalg.norm(direction, axis=-1)
    return np.asarray((b < 0) & (b * b > (o * o).sum(-1) - radius**2))


def _openness(view: View, light: Surroundings, point: Array) -> Array:
    """Share of the irradiance that the ball leaves, (n, 3)."""
    small = cv2.resize(light.radiance, (32, 16), interpolation=cv2.INTER_AREA)[:8].astype(float)
    theta, phi = (np.arange(8) + 0.5) * math.pi / 16, (np.arange(32) + 0.5) * math.pi / 16 - math.pi
    t, p = np.meshgrid(theta, phi, indexing="ij")
    d = np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], -1).reshape(-1, 3)
    flux = small.reshape(-1, 3) * (np.cos(t) * np.sin(t)).reshape(-1, 1)
    free = ~_meets(point[:, None], d[None], view.center, view.radius)
    return np.asarray(free @ flux / np.maximum(flux.sum(0), 1e-12))


def _facet_rays(wo: Array, alpha: float) -> tuple[Array, Array, Array]:
    """What ``FACETS`` facets mirror toward ``wo``, (n, k, 3); Schlick's share s and the masking G, (n, k).

    By visible normals: Dupuy and Benyoub 2023, Sampling Visible GGX Normals with Spherical Caps.
    """
    rng = np.random.default_rng(0)
    shift = rng.random((2, len(wo), 1))
    u, v = (np.mod(_halton(FACETS, base) + shift[k], 1.0) for k, base in enumerate((2, 3)))
    stretched = wo * [alpha, alpha, 1.0]
    stretched /= np.linalg.norm(stretched, axis=-1, keepdims=True)
    z = (1.0 - v) * (1.0 + stretched[:, None, 2]) - stretched[:, None, 2]
    sine = np.sqrt(np.clip(1.0 - z * z, 0.0, 1.0))
    half = np.stack([sine * np.cos(2 * math.pi * u), sine * np.sin(2 * math.pi * u), z], -1) + stretched[:, None]
    half = half * [alpha, alpha, 1.0]
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    cos_d = (half * wo[:, None]).sum(-1)
    wi = 2.0 * cos_d[..., None] * half - wo[:, None]

    def smith(cosine: Array) -> Array:
        tan2 = 1.0 / np.maximum(cosine, 1e-4) ** 2 - 1.0
        return np.asarray(0.5 * (np.sqrt(1.0 + alpha**2 * tan2) - 1.0))

    out = smith(wo[:, None, 2])
    masking = np.where(wi[..., 2] > 0.0, (1.0 + out) / (1.0 + out + smith(wi[..., 2])), 0.0)
    return wi, np.clip(1.0 - cos_d, 0.0, 1.0) ** 5, masking


def _predict(view: View, light: Surroundings, cells: _Cells, alpha: float, distance: float, turn: float) -> Array:
    """A and B, and whether a part may be used, (n, 7)."""
    wi, share, masking = _facet_rays(cells.wo, alpha)
    origin = np.broadcast_to(cells.point[:, None] - view.center, wi.shape)
    b = (origin * wi).sum(-1)
    c = (origin * origin).sum(-1)
    toward, factor = wi, np.ones_like(b)
    hit = (b < 0) & (b * b > c - view.radius**2)
    if math.isfinite(distance):
        reach = distance * view.radius
        t = -b + np.sqrt(np.maximum(b * b - c + reach * reach, 0.0))
        toward = origin + t[..., None] * wi
        toward = toward / np.linalg.norm(toward, axis=-1, keepdims=True)
    if hit.any():
        t = -b[hit] - np.sqrt(b[hit] ** 2 - c[hit] + view.radius**2)
        normal = (origin[hit] + t[:, None] * wi[hit]) / view.radius
        away = wi[hit] - 2.0 * (wi[hit] * normal).sum(-1, keepdims=True) * normal
        toward = toward.copy()
        toward[hit], factor[hit] = away, view.reflectance
    radiance = _look_up(light.radiance, toward, turn) * (factor * masking)[..., None]
    known = _look_up(np.stack([light.clipped, light.confidence], -1), toward, turn)
    lacking = (radiance.sum(-1) * known[..., 0]).mean(-1) > MOST_CLIPPED * np.maximum(radiance.sum(-1).mean(-1), 1e-9)
    usable = ~lacking & (known[..., 1].mean(-1) > LEAST_KNOWN)
    a, b_term = ((weight[..., None] * radiance).mean(1) for weight in (1.0 - share, share))
    return np.concatenate([a, b_term, usable[:, None]], -1)


@dataclasses.dataclass(frozen=True)
class _Fit:
    """The best F0 of one prediction."""

    f0: float
    gain: float  # by how much it lowers the cost of a matt plane


def _residuals(values: Array, basis: Array, weight: Array) -> Array:
    """What weighted polynomials leave of each channel, (n, 3)."""
    out = np.empty_like(values)
    for k in range(3):
        own = basis[:, :, k]
        left = own.T * weight
        solution = np.linalg.solve(left @ own + 1e-9 * np.trace(left @ own) * np.eye(own.shape[1]), left @ values[:, k])
        out[:, k] = values[:, k] - own @ solution
    return out


def _robust_weight(residual: Array) -> tuple[Array, float]:
    """Cauchy's weights of parts, and their scale."""
    size = np.sqrt((residual**2).sum(-1))
    scale = max(float(np.median(size)), 1e-6)
    return 1.0 / (1.0 + (size / (2.0 * scale)) ** 2), scale


def _cost(residual: Array, scale: float) -> float:
    return float(np.log1p((residual**2).sum(-1) / (2.0 * scale) ** 2).sum())


def _fit(cells: _Cells, prediction: Array, keep: NDArray[np.bool_]) -> _Fit:
    """F0 by iterated weights; the cost is that of the same parts without any reflection."""
    shown, basis = cells.shown[keep], cells.basis[keep]
    a, b = prediction[keep, :3], prediction[keep, 3:6]
    weight = np.ones(len(shown))
    for _ in range(4):
        plain = _residuals(shown, basis, weight)
        weight, scale = _robust_weight(plain)
    matt = _cost(plain, scale)
    f0 = 0.0
    for _ in range(4):
        left, moved = _residuals(shown - b, basis, weight), _residuals(a, basis, weight)
        f0 = float((weight[:, None] * left * moved).sum() / max((weight[:, None] * moved**2).sum(), 1e-12))
        weight, _ = _robust_weight(left - f0 * moved)
    return _Fit(f0, matt - _cost(left - f0 * moved, scale))


def shown_well(view: View, confidence: NDArray[np.float32]) -> NDArray[np.float32]:
    """Confidence of a map without what the ball shows at its rim, (h, 2 h)."""
    h = confidence.shape[0]
    theta = (np.arange(h) + 0.5)[:, None] * math.pi / h
    phi = (np.arange(2 * h) + 0.5) * math.pi / h - math.pi
    d = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0.0 * phi], -1)
    back = view.eye - view.center
    back /= np.linalg.norm(back)
    # The normal lies half way between the camera and the direction: cos^2 of half the angle is (1 + cos) / 2.
    return np.where(0.5 * (1.0 + d @ back) > RIM * RIM, confidence, 0.0).astype(np.float32)


def _nothing(words: str, advantage: float = 0.0) -> FoundGloss:
    return FoundGloss(None, 0.0, 1.0, 1.0, 0.0, 1.0, advantage, f"the plane's gloss is not told: {words}")


def _best_turned(view: View, light: Surroundings, cells: _Cells, distance: float, keep: NDArray[np.bool_]) -> float:
    """The most that turned surroundings explain, with every other width."""
    best = 0.0
    for k in range(1, TURNS):
        for alpha in ALPHAS[1::2]:
            fit = _fit(cells, _predict(view, light, cells, alpha, distance, 2.0 * math.pi * k / TURNS), keep)
            best = max(best, fit.gain if fit.f0 > 0.0 else 0.0)
    return best


def estimate_gloss(view: View, light: Surroundings) -> FoundGloss:
    """How a plane mirrors, with an interval, or why that is not told.

    Args:
        view: Picture of the plane z = 0 and of the ball on it.
        light: At the ball, in the world's axes.
    """
    cells = _divide(view, light)
    if len(cells.shown) < LEAST_CELLS:
        return _nothing("too little of it is seen beside the ball")
    grid = [(alpha, distance) for alpha in ALPHAS for distance in DISTANCES]
    predictions: list[Array] = []
    keep = np.ones(len(cells.shown), bool)
    for one in reversed(grid):
        predictions.insert(0, _predict(view, light, cells, *one, 0.0))
        keep &= predictions[0][:, 6] > 0.5
        if keep.sum() < LEAST_CELLS:
            return _nothing("most of what it would mirror clips, or is not seen well in the ball")
    fits = [_fit(cells, one, keep) for one in predictions]
    best = max(range(len(grid)), key=lambda k: fits[k].gain if 0.0 < fits[k].f0 < 1.0 else -math.inf)
    if not 0.0 < fits[best].f0 < 1.0:
        return _nothing("no reflection of the surroundings explains any of it")
    advantage = fits[best].gain / max(_best_turned(view, light, cells, grid[best][1], keep), 1e-9)
    alike = [k for k in range(len(grid)) if grid[k][1] == grid[best][1]]
    parts = [{k: _fit(cells, predictions[k], keep & (cells.sector != part)) for k in alike} for part in range(PARTS)]
    chosen = [max(own, key=lambda k, own=own: own[k].gain) for own in parts]  # type: ignore[misc]
    f0s = np.array([own[k].f0 for own, k in zip(parts, chosen, strict=True)])
    deviation = math.sqrt((PARTS - 1) / PARTS * float(((f0s - f0s.mean()) ** 2).sum()))
    return _judge(grid, fits, best, advantage, deviation, [grid[k][0] for k in chosen])


def _judge(
    grid: list[tuple[float, float]],
    fits: list[_Fit],
    best: int,
    advantage: float,
    deviation: float,
    alphas: list[float],
) -> FoundGloss:
    """Whether what fits best is evidence."""
    f0, gain, alpha = fits[best].f0, fits[best].gain, grid[best][0]
    if gain <= 0.0 or advantage < LEAST_ADVANTAGE:
        return _nothing(
            "other surroundings would explain as much of its texture as those that the ball shows", advantage
        )
    if f0 < LEAST_SIGNIFICANCE * deviation:
        return _nothing(f"its parts disagree (reflectance {f0:.3f} +/- {deviation:.3f})", advantage)
    if alpha > WIDEST:
        return _nothing("what it mirrors is too blurred to be told from its shading", advantage)
    alike = [one.f0 for one in fits if one.gain >= NEARLY * gain and one.f0 > 0.0]
    span = 2.0 * deviation
    least, most = max(min(alike) - span, 0.0), DILUTION * (max(alike) + span)
    at = ALPHAS.index(alpha)
    low = math.sqrt(min(min(alphas), ALPHAS[max(at - 2, 0)]))
    high = math.sqrt(max(max(alphas), ALPHAS[min(at + 2, len(ALPHAS) - 1)]))
    roughness = math.sqrt(alpha)
    words = (
        f"the plane mirrors: reflectance {f0:.3f} ({least:.3f} to {most:.3f}), "
        f"roughness {roughness:.2f} ({low:.2f} to {high:.2f})"
    )
    return FoundGloss(f0, least, most, roughness, low, high, advantage, words)
