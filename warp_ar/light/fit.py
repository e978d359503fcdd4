"""The solution of one channel: iteratively reweighted least squares with unknowns that are not negative.

Every deviation is relative to an unknown, a mean or a reflectance. The derivative with respect to that unknown is kept:
without it, the more parts and equations there are, the more all of them would shrink together.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from warp_ar.light.config import CONFIG, Kind
from warp_ar.light.problem import Problem
from warp_ar.light.solver import solve_nonnegative

Array = NDArray[np.float64]
LEAST = CONFIG.priors.least


@dataclasses.dataclass
class Fit:
    """A solution and the quadratic problem that it solves."""

    z: Array
    """Unknowns, in the order that ``Problem`` gives."""
    cost: float
    """Twice a negative log likelihood."""
    rows: NDArray[np.int64]
    """Points that have an equation."""
    matrix: Array
    """Left sides, divided by pi times the radiance shown, (rows, unknowns)."""
    target: Array
    """Right sides, (rows,)."""
    weights: Array
    """Of the last quadratic problem, (rows,)."""
    hessian: Array
    """The same, priors included, (unknowns, unknowns)."""


def fit_channel(
    problem: Problem, c: int, z: Array, iterations: int, centre: Array | None = None, other: Array | None = None
) -> Fit:
    """Solve for one channel from a start.

    Args:
        problem: The equations.
        c: Channel.
        z: Unknowns to start from.
        iterations: Of reweighting.
        centre: Draws parts and candidates to itself instead of to means.
        other: Unknowns of a channel that is known better: surfaces are of about that reflectance.
    """
    return _Channel(problem, c, len(z), centre, other).solve(z, iterations)


class _Channel:
    """One channel's equations and priors, as matrices."""

    def __init__(self, problem: Problem, c: int, unknowns: int, centre: Array | None, other: Array | None) -> None:
        self.problem, self.centre = problem, centre
        parts, mean_at, u_at = problem.parts, problem.first_mean, problem.first_surface
        count = len(problem.kinds)
        self.usable = np.bincount(problem.surface[problem.exact[:, c]], minlength=count) >= 4
        known = problem.kind == Kind.CARD
        self.rows = rows = np.flatnonzero(
            (problem.exact[:, c] & (self.usable[problem.surface] | known))
            | (problem.bound[:, c] & self.usable[problem.surface])
            | (problem.bound[:, c] & known)
        )
        self.surface, self.exact = problem.surface[rows], problem.exact[rows, c]
        light = problem.light[rows, c]
        self.matrix = np.zeros((len(rows), unknowns))
        self.matrix[:, :parts] = problem.columns[c][rows] / light[:, None]
        self.matrix[:, parts:mean_at] = problem.candidate_columns[c][rows] / light[:, None]
        self.matrix[np.arange(len(rows)), u_at + self.surface] = -1.0
        self.target = -problem.captured[rows, c] / light
        surfaces = CONFIG.surfaces
        self.prior_u = np.where(
            problem.kinds == Kind.CARD, 1.0 / problem.white, 1.0 / np.array(surfaces.reflectance)[problem.kinds]
        )
        self.spread_u = np.array(surfaces.reflectance_spread)[problem.kinds]
        if other is not None:
            self.prior_u, self.spread_u = other[-count:], np.array(surfaces.hue_spread)[problem.kinds]
        self.sigma = np.hypot(problem.noise[self.surface], surfaces.mirror_trust * problem.mirrored_share[rows])
        self.shared = problem.shared[rows]
        self._set_priors(unknowns)

    def _set_priors(self, unknowns: int) -> None:
        """Left and right sides of what parts, means and tied reflectances deviate from."""
        problem = self.problem
        mean_at, u_at = problem.first_mean, problem.first_surface
        self.prior = np.zeros((mean_at + problem.components + 1 + len(problem.ties), unknowns))
        self.prior_target = np.zeros(len(self.prior))
        own = np.arange(mean_at + problem.components + 1)
        self.first_tie = len(own)
        self.prior[own, own] = 1.0
        if self.centre is None:
            free = np.flatnonzero(~problem.is_surface)
            self.prior[free, mean_at + problem.component[free]] = -1.0
            self.prior[mean_at : mean_at + problem.components, u_at - 1] = -problem.expected
        else:
            self.prior_target[:mean_at] = self.centre
        for row, (a, b) in enumerate(problem.ties, start=self.first_tie):
            self.prior[row, u_at + a], self.prior[row, u_at + b] = 1.0, -1.0
        self.deviation = np.ones(len(self.prior))

    def solve(self, z: Array, iterations: int) -> Fit:
        """Reweight and solve in turn."""
        u_at = self.problem.first_surface
        z = z.copy()
        if not z[u_at:].any():
            self._guess_reflectances(z)
        hessian, weights = np.zeros((len(z), len(z))), np.zeros(len(self.rows))
        for _ in range(iterations):
            self._set_deviations(z)
            hessian, gradient, weights = self._quadratic(z)
            last, z = z, solve_nonnegative(hessian, gradient, z)
            if np.abs(z - last).max() < CONFIG.solver.converged * np.abs(z).max():
                break
        u = np.maximum(z[u_at:], 1e-3)
        z[u_at:] = u
        relative = (self.matrix @ z - self.target) / (u[self.surface] * self.sigma)
        relative[~self.exact & (relative > 0.0)] = 0.0
        cost = float((4.0 * np.log1p(0.25 * relative**2) / self.shared).sum())
        cost += float((((self.prior @ z - self.prior_target) / self.deviation) ** 2).sum())
        cost += float(((np.log(u / self.prior_u) / self.spread_u) ** 2).sum())
        return Fit(z, cost, self.rows, self.matrix, self.target, weights, hessian)

    def _guess_reflectances(self, z: Array) -> None:
        """What the start's light makes of surfaces that were left open."""
        problem, u_at = self.problem, self.problem.first_surface
        ratio = self.matrix[:, : problem.first_mean] @ z[: problem.first_mean] - self.target
        z[u_at:] = self.prior_u
        for k in np.flatnonzero(self.usable & (problem.kinds != Kind.CARD)):
            z[u_at + k] = max(float(np.median(ratio[self.exact & (self.surface == k)])), 1e-3)

    def _set_deviations(self, z: Array) -> None:
        """Standard deviations of priors about the last estimate."""
        problem, deviation, priors = self.problem, self.deviation, CONFIG.priors
        parts, mean_at, u_at = problem.parts, problem.first_mean, problem.first_surface
        u = np.maximum(z[u_at:], 1e-3)
        if self.centre is None:
            about = np.maximum(z[mean_at : u_at - 1][problem.component], LEAST)
            deviation[:parts] = np.where(problem.is_surface, priors.surface_recovered, priors.inside * about)
            deviation[parts:mean_at] = 10.0 * np.maximum(z[parts:mean_at], LEAST)
        else:
            deviation[:parts] = priors.hue * np.maximum(self.centre[:parts], 0.1)
            deviation[parts:mean_at] = priors.hue * np.maximum(self.centre[parts:], 0.01)
        deviation[mean_at : u_at - 1] = priors.spread * np.maximum(problem.expected * z[u_at - 1], LEAST)
        deviation[u_at - 1] = 3.0 * max(z[u_at - 1], LEAST)
        for row, (a, b) in enumerate(problem.ties, start=self.first_tie):
            deviation[row] = CONFIG.surfaces.tie * 0.5 * (u[a] + u[b])

    def _quadratic(self, z: Array) -> tuple[Array, Array, Array]:
        """Hessian, gradient and the equations' weights about the last estimate."""
        problem, count = self.problem, len(self.problem.kinds)
        mean_at, u_at = problem.first_mean, problem.first_surface
        u = np.maximum(z[u_at:], 1e-3)
        diagonal = np.arange(u_at, len(z))
        scaled = self.prior / self.deviation[:, None]
        hessian = scaled.T @ scaled
        gradient = scaled.T @ (self.prior_target / self.deviation)
        # Log-normal prior of 1 / reflectance, about the last estimate.
        hessian[diagonal, diagonal] += 1.0 / (u * self.spread_u) ** 2
        gradient[u_at:] += np.maximum(1.0 + np.log(self.prior_u / u), 0.2) / (u * self.spread_u**2)
        relative = (self.matrix @ z - self.target) / (u[self.surface] * self.sigma)
        weights = 1.0 / (1.0 + 0.25 * relative**2) / ((u[self.surface] * self.sigma) ** 2 * self.shared)
        weights[~self.exact & (relative > 0.0)] = 0.0
        weighted = weights[:, None] * self.matrix
        hessian += self.matrix.T @ weighted
        gradient += weighted.T @ self.target
        # Deviations are relative: what they are relative to must not shrink for their sake.
        squared = weights * (self.matrix @ z - self.target) ** 2
        gradient[u_at:] += np.bincount(self.surface, squared, minlength=count) / u
        if self.centre is None:
            means = z[mean_at : u_at - 1]
            off = (scaled @ z) ** 2
            about = np.maximum(means[problem.component], LEAST)
            within = np.where(problem.is_surface | (about <= LEAST), 0.0, off[: problem.parts])
            sums = np.bincount(problem.component, within, minlength=problem.components)
            gradient[mean_at : u_at - 1] += sums / np.maximum(means, LEAST)
            wide = problem.expected * z[u_at - 1] > LEAST
            gradient[u_at - 1] += (off[mean_at : u_at - 1] * wide).sum() / max(z[u_at - 1], LEAST)
        return hessian, gradient, weights
