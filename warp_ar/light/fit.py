"""The solution of one channel: iteratively reweighted least squares with unknowns that are not negative.

Every deviation is relative to an unknown, a mean or a reflectance. The derivative with respect to that unknown is kept:
without it, the more parts and equations there are, the more all of them would shrink together.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import os
import threading
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

from warp_ar.light.config import CONFIG, Kind
from warp_ar.light.problem import Problem

Array = NDArray[np.float64]


@functools.cache
def _blas() -> ThreadpoolController:
    """Find the libraries; that takes as long as four fits."""
    return ThreadpoolController()


_ALONE = threading.Lock()


def _renew_lock() -> None:
    """Let a fork solve although its parent was solving."""
    global _ALONE
    _ALONE = threading.Lock()


os.register_at_fork(after_in_child=_renew_lock)


@contextlib.contextmanager
def one_blas_thread() -> Iterator[None]:
    """Keep NumPy's BLAS to one thread: products here take microseconds, and waking threads for them more.

    The number belongs to the process, so that one solution is made at a time; sums in another order would be another
    picture.
    """
    with _ALONE, _blas().limit(limits=1, user_api="blas"):
        yield


def solve_nonnegative(hessian: Array, gradient: Array, start: Array | None = None) -> Array:
    """Minimise x' H x / 2 - g' x over x >= 0.

    Block pivoting: free unknowns that turn negative are held at zero; once none does, held ones that pull upward are
    let go.

    Args:
        hessian: H, positive definite, (n, n).
        gradient: g, (n,).
        start: Solution of a similar problem: its positive unknowns start free.
    """
    free = np.ones(len(gradient), bool) if start is None else start > 0.0
    x = np.zeros(len(gradient))
    tolerance = 1e-9 * float(np.abs(gradient).max(initial=0.0))
    for _ in range(60):
        x[:] = 0.0
        index = np.flatnonzero(free)
        if len(index) == len(x):
            x[:] = np.linalg.solve(hessian, gradient)
        elif len(index):
            x[index] = np.linalg.solve(hessian[index[:, None], index], gradient[index])
        negative = free & (x < 0.0)
        if negative.any():
            free &= ~negative
            continue
        pulled = ~free & (hessian @ x - gradient < -tolerance)
        if not pulled.any():
            break
        free |= pulled
    return np.maximum(x, 0.0)


LEAST = CONFIG.priors.least


class Equations:
    """Left sides of equations, by what is in them: light, which all have in common, and one surface each.

    An equation is light of parts and candidates less 1 / reflectance of its surface, so that with many surfaces nearly
    all of a matrix would be zeros. What is kept is the light and the number of the surface: products take time in
    proportion to equations, and not to equations times surfaces.
    """

    def __init__(self, light: Array, surface: NDArray[np.int64], first: int, count: int) -> None:
        """Keep both.

        Args:
            light: Of parts and candidates, divided by pi times the radiance shown, (rows, parts and candidates).
            surface: Of each row, ascending, (rows,).
            first: Place of the first surface among the unknowns.
            count: Of surfaces.
        """
        self.light, self.surface, self.first, self.count = light, surface, first, count
        self._present, self._starts = np.unique(surface, return_index=True)

    @property
    def unknowns(self) -> int:
        """Number of unknowns."""
        return self.first + self.count

    def times(self, z: Array) -> Array:
        """Left sides of unknowns ``z``, (rows,)."""
        return np.asarray(self.light @ z[: self.light.shape[1]] - z[self.first + self.surface], np.float64)

    def transposed(self, values: Array) -> Array:
        """Product of the transposed matrix with ``values`` (rows, ...), (unknowns, ...)."""
        product = np.zeros((self.unknowns, *values.shape[1:]))
        if len(values):
            product[: self.light.shape[1]] = self.light.T @ values
            product[self.first + self._present] = -np.add.reduceat(values, self._starts, axis=0)
        return product

    def add_normal(self, hessian: Array, weights: Array) -> None:
        """Add the transposed matrix times ``weights`` (rows,) times the matrix to ``hessian`` (unknowns, unknowns)."""
        if not len(weights):
            return
        bright = self.light.shape[1]
        weighted = weights[:, None] * self.light
        hessian[:bright, :bright] += self.light.T @ weighted
        places = self.first + self._present
        across = np.add.reduceat(weighted, self._starts, axis=0)
        hessian[places, :bright] -= across
        hessian[:bright, places] -= across.T
        hessian[places, places] += np.add.reduceat(weights, self._starts)


@dataclasses.dataclass
class Fit:
    """A solution and the quadratic problem that it solves."""

    z: Array
    """Unknowns, in the order that ``Problem`` gives."""
    cost: float
    """Twice a negative log likelihood."""
    rows: NDArray[np.int64]
    """Points that have an equation."""
    equations: Equations
    """Left sides."""
    target: Array
    """Right sides, (rows,)."""
    weights: Array
    """Weights of the last quadratic problem, (rows,)."""
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
    return _Channel(problem, c, centre, other).solve(z, iterations)


class _Channel:
    """One channel's equations and priors, as matrices."""

    def __init__(self, problem: Problem, c: int, centre: Array | None, other: Array | None) -> None:
        self.problem, self.centre = problem, centre
        u_at, count = problem.first_surface, len(problem.kinds)
        self.usable = np.bincount(problem.surface[problem.exact[:, c]], minlength=count) >= 4
        known = problem.kind == Kind.CARD
        self.rows = rows = np.flatnonzero(
            (problem.exact[:, c] & (self.usable[problem.surface] | known))
            | (problem.bound[:, c] & self.usable[problem.surface])
            | (problem.bound[:, c] & known)
        )
        self.surface, self.exact = problem.surface[rows], problem.exact[rows, c]
        light = problem.light[rows, c]
        sources = np.concatenate([problem.columns[c][rows], problem.candidate_columns[c][rows]], axis=1)
        self.equations = Equations(sources / light[:, None], self.surface, u_at, count)
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
        self.tied = np.concatenate([*problem.ties.T])
        self._set_priors()

    def _set_priors(self) -> None:
        """Left and right sides of what parts and means deviate from."""
        problem = self.problem
        mean_at, u_at = problem.first_mean, problem.first_surface
        self.prior = np.eye(u_at)
        self.prior_target = np.zeros(u_at)
        if self.centre is None:
            free = np.flatnonzero(~problem.is_surface)
            self.prior[free, mean_at + problem.component[free]] = -1.0
            self.prior[mean_at : mean_at + problem.components, u_at - 1] = -problem.expected
        else:
            self.prior_target[:mean_at] = self.centre
        self.deviation = np.ones(u_at)

    def solve(self, z: Array, iterations: int) -> Fit:
        """Reweight and solve in turn."""
        u_at = self.problem.first_surface
        z = z.copy()
        if not z[u_at:].any():
            self._guess_reflectances(z)
        hessian, weights = np.zeros((len(z), len(z))), np.zeros(len(self.rows))
        least = self._cost(z)
        for _ in range(iterations):
            self._set_deviations(z)
            hessian, gradient, weights = self._quadratic(z)
            last, z = z, solve_nonnegative(hessian, gradient, z)
            z, least = self._shortened(last, z, least)
            if np.abs(z - last).max() < CONFIG.solver.converged * np.abs(z).max():
                break
        z[u_at:] = np.maximum(z[u_at:], 1e-3)
        return Fit(z, self._cost(z), self.rows, self.equations, self.target, weights, hessian)

    def _shortened(self, last: Array, z: Array, least: float) -> tuple[Array, float]:
        """A step halved until it does not raise the cost above the least so far; and the least cost now.

        Each quadratic problem has deviations about the last unknowns. Where the card clips, little more than priors of
        reflectances bounds the light as a whole, and whole steps may lead ever farther from the least cost.
        """
        cost = self._cost(z)
        for _ in range(CONFIG.solver.halvings):
            if cost <= least:
                break
            z = 0.5 * (last + z)
            cost = self._cost(z)
        return z, min(cost, least)

    def _cost(self, z: Array) -> float:
        """Twice a negative log likelihood, deviations about these unknowns."""
        self._set_deviations(z)
        u_at = self.problem.first_surface
        u = np.maximum(z[u_at:], 1e-3)
        relative = (self.equations.times(z) - self.target) / (u[self.surface] * self.sigma)
        relative[~self.exact & (relative > 0.0)] = 0.0
        cost = float((4.0 * np.log1p(0.25 * relative**2) / self.shared).sum())
        cost += float((((self.prior @ z[:u_at] - self.prior_target) / self.deviation) ** 2).sum())
        a, b = self.problem.ties.T
        cost += float((self.tie_weight * (u[a] - u[b]) ** 2).sum())
        return cost + float(((np.log(u / self.prior_u) / self.spread_u) ** 2).sum())

    def _guess_reflectances(self, z: Array) -> None:
        """Set the reflectances of surfaces that were left open by the start's light."""
        problem, u_at = self.problem, self.problem.first_surface
        ratio = self.equations.light @ z[: problem.first_mean] - self.target
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
        a, b = problem.ties.T
        self.tie_weight = 1.0 / (CONFIG.surfaces.tie * 0.5 * (u[a] + u[b])) ** 2

    def _quadratic(self, z: Array) -> tuple[Array, Array, Array]:
        """Hessian, gradient and the equations' weights about the last estimate."""
        problem, count = self.problem, len(self.problem.kinds)
        mean_at, u_at = problem.first_mean, problem.first_surface
        u = np.maximum(z[u_at:], 1e-3)
        diagonal = np.arange(u_at, len(z))
        hessian, gradient = np.zeros((len(z), len(z))), np.zeros(len(z))
        scaled = self.prior / self.deviation[:, None]
        hessian[:u_at, :u_at] = scaled.T @ scaled
        gradient[:u_at] = scaled.T @ (self.prior_target / self.deviation)
        a, b = u_at + problem.ties.T
        hessian[a, b] = hessian[b, a] = -self.tie_weight
        both = np.concatenate([self.tie_weight, self.tie_weight])
        hessian[diagonal, diagonal] = np.bincount(self.tied, both, minlength=count)
        # Log-normal prior of 1 / reflectance, about the last estimate.
        hessian[diagonal, diagonal] += 1.0 / (u * self.spread_u) ** 2
        gradient[u_at:] += np.maximum(1.0 + np.log(self.prior_u / u), 0.2) / (u * self.spread_u**2)
        off = self.equations.times(z) - self.target
        relative = off / (u[self.surface] * self.sigma)
        weights = 1.0 / (1.0 + 0.25 * relative**2) / ((u[self.surface] * self.sigma) ** 2 * self.shared)
        weights[~self.exact & (relative > 0.0)] = 0.0
        self.equations.add_normal(hessian, weights)
        gradient += self.equations.transposed(weights * self.target)
        # Deviations are relative: what they are relative to must not shrink for their sake.
        gradient[u_at:] += np.bincount(self.surface, weights * off**2, minlength=count) / u
        if self.centre is None:
            means = z[mean_at : u_at - 1]
            strayed = (scaled @ z[:u_at]) ** 2
            about = np.maximum(means[problem.component], LEAST)
            within = np.where(problem.is_surface | (about <= LEAST), 0.0, strayed[: problem.parts])
            sums = np.bincount(problem.component, within, minlength=problem.components)
            gradient[mean_at : u_at - 1] += sums / np.maximum(means, LEAST)
            wide = problem.expected * z[u_at - 1] > LEAST
            gradient[u_at - 1] += (strayed[mean_at : u_at - 1] * wide).sum() / max(z[u_at - 1], LEAST)
        return hessian, gradient, weights
