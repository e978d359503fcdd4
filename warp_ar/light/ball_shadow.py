"""Test that recovered light reaches the ball, using the surface around the ball's own shadow.

The card measures how much light is missing, and the shading of other surfaces measures its directions. But light on
these surfaces need not reach the ball: unmodelled clutter may occlude it there, and clipped light in the ball may not
be the light on the card. Light that passes close to the ball falls on the planes next to its shadow, and light that is
occluded at the ball is missing there too. Let e be the captured irradiance, a the irradiance that an estimate adds, and
f the share of a that reaches the ball. A point of a plane then has the radiance L with

    log L = level + log(e + f a) + texture.

Two groups of points determine f. Each is compared with those points of the plane at which hardly any of a passes the
ball:

- **Next to the shadow**, within two radii of the ball: the level is that of the plane elsewhere, where f = 1. These
  points measure whether the light is there at all. An occluder on both sides of the shadow also occludes the ball
  between them, and f is used. If only one side is dark, it is at the edge of another shadow, and the ball may be lit.
- **Across the shadow**, within 3.5 radii: the level is free. These points measure whether the ball casts the estimated
  shadow. If it does not, the light comes from another direction, because the card shows that it exists. Light from a
  direction b instead of a is best approximated, over all normals, by the factor (irradiances max(n . a, 0), max(n . b,
  0))

        mean over b of X . D / |X|^2 = (1 / 4)^2 / (1 / 6) = 3 / 8,

  so that f + 3/8 (1 - f) is used.

Either group is used only if the cost (twice the negative log likelihood) is lower than at f = 1 by the amount that is
required for a new emitter. Reliable light is therefore kept, and without evidence nothing changes. Emitters keep their
distances, because a near emitter lights a plane unevenly, which must not count as a shadow.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from warp_ar.light.config import CONFIG, Kind
from warp_ar.light.problem import Problem

Array = NDArray[np.float64]

ELSEWHERE = 3.0 / 8.0
"""Best factor on light whose direction is wrong."""
SHARES = np.linspace(0.0, 1.0, 41)
"""Values of f that are evaluated."""


@dataclasses.dataclass(frozen=True)
class Ball:
    """Ball in which light was observed."""

    center: Array
    """Centre, metres, (3,)."""
    radius: float
    """Radius, metres; 0: a point without a shadow."""


def passing_shares(problem: Problem, unknowns: Array, ball: Ball, reach: tuple[float, ...]) -> tuple[Array, Array]:
    """Return the share of the light that an estimate adds at each point which passes close to the ball or hits it.

    Args:
        problem: The equations.
        unknowns: Radiance of parts, then power of candidates, (parts + candidates, 3).
        ball: The ball.
        reach: Distances from the ball's centre, in radii, within which a ray passes close to it.

    Returns:
        Shares for each reach, (reaches, n); and the side of the ball on which light passes within the first reach,
        (n,): positive if the ball is on the right as seen from the point toward the light.
    """
    distant, near = problem.distant_radiance(unknowns), problem.near_emitters(unknowns)
    power = (distant * problem.missing).sum(axis=1) * problem.solid_angle
    to_ball = ball.center - problem.points
    close, total, side = np.zeros((len(reach), len(to_ball))), np.zeros(len(to_ball)), np.zeros(len(to_ball))
    across = np.cross(problem.normals, to_ball)

    def add(direction: Array, weight: Array, length: Array | float) -> None:
        """Add rays with directions (n or 1, k, 3), weights (n, k) and lengths."""
        along = (to_ball[:, None] * direction).sum(axis=2)
        # Squared distance of the ball's centre from the ray, in radii.
        off = ((to_ball**2).sum(axis=1)[:, None] - along**2) / ball.radius**2
        ahead = (along > 0.0) & (along < length)
        for k, radii in enumerate(reach):
            close[k] += (weight * (ahead & (off < radii**2))).sum(axis=1)
        sign = np.sign((across[:, None] * direction).sum(axis=2))
        side[:] += (weight * sign * (ahead & (off < reach[0] ** 2))).sum(axis=1)
        total[:] += weight.sum(axis=1)

    cells = np.flatnonzero(power > 0.0)
    if len(cells):
        toward = problem.direction[cells]
        add(toward[None], np.maximum(problem.normals @ toward.T, 0.0) * power[cells], np.inf)
    for place, intensity in near:
        ray = place - problem.points
        away = np.linalg.norm(ray, axis=1, keepdims=True)
        cosine = np.maximum((ray * problem.normals).sum(axis=1, keepdims=True) / away, 0.0)
        add((ray / away)[:, None], cosine * float(intensity.sum()) / away**2, away)
    return close / np.maximum(total, 1e-12), side


def costs(given: Array, scatter: float, level: float, known: float | None) -> Array:
    """Return twice the negative log likelihood of each of ``SHARES``, (shares,).

    Args:
        given: For each point: radiance, captured irradiance, added irradiance, and the number of points with which it
            shares one error, (4, n).
        scatter: Standard deviation of the logarithm of one point's radiance.
        level: Logarithm of radiance divided by irradiance at the plane's other points.
        known: Standard deviation of that level at these points; None: the level is free.
    """
    shown, captured, added, shared = given
    logs = np.log(shown) - level - np.log(np.maximum(captured + SHARES[:, None] * added, 1e-9))
    trusted = np.ones_like(logs)
    prior = 1e-9 if known is None else (scatter / known) ** 2
    for _ in range(CONFIG.shadow.iterations):
        weights = trusted / shared
        offset = (weights * logs).sum(axis=1, keepdims=True) / (weights.sum(axis=1, keepdims=True) + prior)
        squared = ((logs - offset) / scatter) ** 2
        trusted = 1.0 / (1.0 + 0.25 * squared)
    cost = (4.0 * np.log1p(0.25 * squared) / shared).sum(axis=1)
    return np.asarray(cost + prior * (offset[:, 0] / scatter) ** 2, np.float64)


def share_told(cost: Array, sides: Array | None = None) -> float:
    """Return a lower bound of f, the quantile ``believed`` of its likelihood; 1 without sufficient evidence.

    Args:
        cost: Costs from ``costs``, (shares,).
        sides: Costs of the points on each side of the shadow, (2, shares). Each side must give half of the evidence.
    """
    if cost[-1] - cost.min() < CONFIG.search.evidence:
        return 1.0
    if sides is not None and (sides[:, -1] - sides.min(axis=1)).min() < 0.5 * CONFIG.search.evidence:
        return 1.0
    likelihood = np.cumsum(np.exp(-0.5 * (cost - cost.min())))
    return float(SHARES[np.searchsorted(likelihood, CONFIG.shadow.believed * likelihood[-1])])


def reaching_factor(problem: Problem, unknowns: Array, ball: Ball) -> float:
    """Return the factor on an estimate, 0 to 1, that the planes around the ball support.

    Args:
        problem: The equations.
        unknowns: Radiance of parts, then power of candidates, (parts + candidates, 3).
        ball: The ball.
    """
    added = problem.added_irradiance(unknowns).sum(axis=1)
    if ball.radius <= 0.0 or not added.any():
        return 1.0
    config = CONFIG.shadow
    usable = (problem.kind == Kind.PLANE) & problem.exact.all(axis=1)
    if not usable.any():
        return 1.0
    shown, captured = problem.light.sum(axis=1), problem.captured.sum(axis=1)
    # Unusable points have no logarithm; they are not used below.
    ratio = np.full(len(shown), np.nan)
    ratio[usable] = np.log(shown[usable]) - np.log(np.maximum((captured + added)[usable], 1e-9))
    given = np.stack([shown, captured, added, problem.shared])
    near, across, sides = np.zeros(len(SHARES)), np.zeros(len(SHARES)), np.zeros((2, len(SHARES)))
    passing, side = passing_shares(problem, unknowns, ball, (config.near, config.across))
    for surface in np.unique(problem.surface[usable]):
        own = usable & (problem.surface == surface)
        elsewhere, here = own & (passing[0] < config.elsewhere), own & (passing[0] > config.near_share)
        if min(elsewhere.sum(), here.sum()) >= config.points:
            level, scatter = _level(ratio[elsewhere])
            known = float(np.hypot(scatter, config.level))
            told = [costs(given[:, one], scatter, level, known) for one in (here, here & (side < 0), here & (side > 0))]
            near += told[0]
            sides += told[1:]
        elsewhere, here = own & (passing[1] < config.elsewhere), own & (passing[1] > config.elsewhere)
        if min(elsewhere.sum(), here.sum()) >= config.points:
            level, scatter = _level(ratio[elsewhere])
            across += costs(given[:, here], scatter, level, None)
    directed = share_told(across)
    return min(share_told(near, sides), directed + ELSEWHERE * (1.0 - directed))


def _level(ratio: Array) -> tuple[float, float]:
    """Return median and robust standard deviation of logarithms of radiance divided by irradiance, (n,)."""
    level = float(np.median(ratio))
    return level, max(1.4826 * float(np.median(np.abs(ratio - level))), CONFIG.shadow.scatter)
