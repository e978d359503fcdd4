"""Solution of the equations: iteratively reweighted least squares with non-negative unknowns.

A fit is the solution for one channel and, in a search, for one tried candidate. All fits are computed at once, because
the matrix products of one take microseconds, about as long as a call of NumPy. The first axis of an array is the index
of the fit; its channel is that index modulo 3.

Standard deviations are proportional to unknowns: means and reflectances. The gradient includes the derivative by these
scales. Without it, all scales would shrink together, the more so the more parts and equations there are.
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
    """Return the controller of the BLAS libraries, which is kept because finding them takes as long as four fits."""
    return ThreadpoolController()


_ALONE = threading.Lock()


def _renew_lock() -> None:
    """Replace the lock in a forked process, in which no thread would release it if the parent held it."""
    global _ALONE
    _ALONE = threading.Lock()


os.register_at_fork(after_in_child=_renew_lock)


@contextlib.contextmanager
def one_blas_thread() -> Iterator[None]:
    """Context in which NumPy's BLAS has one thread: products here take microseconds, and waking threads takes longer.

    The limit applies to the process, so only one thread at a time is in this context. The number of threads is fixed,
    because another order of summation would give another picture.
    """
    with _ALONE, _blas().limit(limits=1, user_api="blas"):
        yield


def solve_nonnegative(hessian: Array, gradient: Array, start: Array | None = None) -> Array:
    """Return the x >= 0 that minimises x' H x / 2 - g' x, (problems, n), for several problems at once.

    Method: block pivoting. Free unknowns that become negative are fixed at zero; when none does, fixed unknowns with an
        upward gradient are freed.

    Args:
        hessian: H, positive definite, (problems, n, n).
        gradient: g, (problems, n).
        start: Solutions of similar problems; their positive unknowns start free.
    """
    free = np.ones(gradient.shape, bool) if start is None else start > 0.0
    tolerance = 1e-9 * np.abs(gradient).max(axis=1, initial=0.0, keepdims=True)
    x, left, diagonal = np.zeros_like(gradient), np.arange(len(gradient)), np.arange(gradient.shape[1])
    for _ in range(60):
        own, h, g = free[left], hessian[left], gradient[left]
        held = np.where(own[:, :, None] & own[:, None], h, 0.0)
        held[:, diagonal, diagonal] += ~own
        x[left] = now = np.linalg.solve(held, np.where(own, g, 0.0)[..., None])[..., 0]
        negative = own & (now < 0.0)
        pulled = ~own & ((h @ now[..., None])[..., 0] - g < -tolerance[left]) & ~negative.any(axis=1, keepdims=True)
        free[left] = own & ~negative | pulled
        left = left[(negative | pulled).any(axis=1)]
        if not len(left):
            break
    return np.maximum(x, 0.0)


LEAST = CONFIG.priors.least
"""Radiance below which standard deviations of priors are absolute, not relative."""


@dataclasses.dataclass
class Fits:
    """Solutions of several fits, with the quadratic problems that they solve."""

    z: Array
    """Unknowns, in the order of ``Problem``, (fits, unknowns)."""
    cost: Array
    """Twice the negative log likelihood, (fits,)."""
    equations: Equations
    """Equations that were solved."""
    off: Array
    """Residuals, left side minus right side, of each equation, (fits, rows)."""
    weights: Array
    """Weights of the last quadratic problem, (fits, rows)."""
    hessian: Array
    """Hessian of the last quadratic problem, priors included, (fits, unknowns, unknowns)."""


@dataclasses.dataclass
class _State:
    """Unknowns, with residuals, deviations and cost at them."""

    z: Array
    """Unknowns, (fits, unknowns)."""
    u: Array
    """Reciprocal reflectance of surfaces, (fits, surfaces)."""
    off: Array
    """Residuals, (fits, rows)."""
    relative: Array
    """Residuals divided by their standard deviations, (fits, rows); 0 where a clipped point may be as bright as
    predicted."""
    deviation: Array
    """Standard deviations of priors, (fits, priors)."""
    strayed: Array
    """Deviations from priors divided by their standard deviations, (fits, priors)."""
    cost: Array
    """Twice the negative log likelihood, (fits,)."""


class Equations:
    """Equations and priors of all channels, in a compact form of matrices.

    An equation contains the light of all parts and candidates, and the reciprocal reflectance of one surface. A full
    matrix would consist mostly of zeros if there are many surfaces. Only the light and the surface's index are stored,
    so that the time of products does not grow with the number of surfaces.
    """

    def __init__(
        self,
        problem: Problem,
        added: Array | None = None,
        centre: Array | None = None,
        known: tuple[Array, NDArray[np.bool_]] | None = None,
    ) -> None:
        """Set up the equations and the priors.

        Args:
            problem: The equations.
            added: Irradiance per unit power of candidates, (3, points, q). Each is tried alone, in addition to the
                problem's own candidates.
            centre: Means of the priors on parts and candidates, (3, parts + candidates); None: those of components.
            known: Reciprocal reflectances in the channel that is measured best, (surfaces,), and a mask, (3,), of the
                channels to whose priors they apply; None: the usual priors.
        """
        self.problem, self.centre, count = problem, centre, len(problem.kinds)
        card, exact = problem.kind == Kind.CARD, problem.exact.T
        self.usable = np.stack([np.bincount(problem.surface[own], minlength=count) >= 4 for own in exact])
        used = (exact | problem.bound.T) & (self.usable[:, problem.surface] | card)
        self.rows = rows = np.flatnonzero(used.any(axis=0))
        used, self.surface, tries = used[:, rows], problem.surface[rows], 1 if added is None else added.shape[2]
        self.shown = np.where(used, problem.light[rows].T, 1.0)
        light = np.concatenate([problem.columns, problem.candidate_columns], axis=2)[:, rows]
        if added is not None:
            tried = np.moveaxis(added[:, rows], 2, 0)[..., None]
            light = np.concatenate([np.broadcast_to(light, (tries, *light.shape)), tried], axis=3)
        self.light = (light / self.shown[..., None]).reshape(3 * tries, len(rows), -1)
        self.target = np.tile(-problem.captured[rows].T / self.shown, (tries, 1))
        self.weigh = np.tile(used / problem.shared[rows], (tries, 1))
        self.one_sided = np.tile(~exact[:, rows], (tries, 1))
        surfaces = CONFIG.surfaces
        self.sigma = np.hypot(problem.noise[self.surface], surfaces.mirror_trust * problem.mirrored_share[rows])
        usual = np.where(problem.kinds == Kind.CARD, problem.white, np.array(surfaces.reflectance)[problem.kinds])
        self.prior_u = np.tile(1.0 / usual, (3 * tries, 1))
        self.spread_u = np.tile(np.array(surfaces.reflectance_spread)[problem.kinds], (3 * tries, 1))
        if known is not None:
            self.prior_u[known[1]], self.spread_u[known[1]] = known[0], np.array(surfaces.hue_spread)[problem.kinds]
        self.present, self.starts = np.unique(self.surface, return_index=True)
        self.mean_at = self.light.shape[2]
        self.surface_at = self.mean_at + problem.components + 1
        self._set_priors()

    def _set_priors(self) -> None:
        """Set up the matrices of the priors on parts, means and reflectances."""
        problem, mean_at, at = self.problem, self.mean_at, self.surface_at
        self.prior = np.zeros((at + len(problem.ties), at + len(problem.kinds)))
        self.prior[:at, :at] = np.eye(at)
        self.target_prior = np.zeros((len(self.light), len(self.prior)))
        if self.centre is None:
            free = np.flatnonzero(~problem.is_surface)
            self.prior[free, mean_at + problem.component[free]] = -1.0
            self.prior[mean_at : at - 1, at - 1] = -problem.expected
        else:
            self.target_prior[:, :mean_at] = self.centre
        ties = at + np.arange(len(problem.ties))
        self.prior[ties, at + problem.ties[:, 0]], self.prior[ties, at + problem.ties[:, 1]] = 1.0, -1.0

    def guess_reflectances(self, z: Array) -> None:
        """Set the reflectance of each surface to the median over its points, in the light of the unknowns."""
        ratio = self._sum(z) - self.target
        z[:, self.surface_at :] = self.prior_u
        for c in range(3):
            own = np.flatnonzero(~self.one_sided[c] & (self.problem.kinds != Kind.CARD)[self.surface])
            order = own[np.lexsort((ratio[c, own], self.surface[own]))]
            found, first, count = np.unique(self.surface[order], return_index=True, return_counts=True)
            middle = 0.5 * (ratio[c, order[first + (count - 1) // 2]] + ratio[c, order[first + count // 2]])
            told = self.usable[c, found]
            z[c, self.surface_at + found[told]] = np.maximum(middle[told], 1e-3)

    def solve(self, z: Array, iterations: int) -> Fits:
        """Return the solution, by alternately computing weights and solving a quadratic problem.

        The quadratic problem is valid near the last unknowns only. Where the card clips, hardly anything but the priors
        on reflectances limits the total light, and full steps may diverge. A step is therefore halved while it raises
        the cost above the least cost so far.

        Args:
            z: Unknowns to start from, (fits, unknowns).
            iterations: Number of iterations of reweighting.
        """
        state = self._at(z)
        least = state.cost
        for _ in range(iterations):
            hessian, gradient, weights = self._quadratic(state)
            last, state = state.z, self._at(solve_nonnegative(hessian, gradient, state.z))
            for _ in range(CONFIG.solver.halvings):
                worse = state.cost > least
                if not worse.any():
                    break
                state = self._at(np.where(worse[:, None], 0.5 * (last + state.z), state.z))
            least = np.minimum(state.cost, least)
        z = np.concatenate([state.z[:, : self.surface_at], state.u], axis=1)
        return Fits(z, state.cost, self, state.off, weights, hessian)

    def _sum(self, z: Array) -> Array:
        """Return the irradiance from parts and candidates in each equation, (fits, rows)."""
        return np.asarray((self.light @ z[:, : self.mean_at, None])[..., 0], np.float64)

    def _at(self, z: Array) -> _State:
        """Return the state at unknowns z, (fits, unknowns)."""
        u, mean = np.maximum(z[:, self.surface_at :], 1e-3), z[:, self.surface_at - 1, None]
        off = self._sum(z) - u[:, self.surface] - self.target
        relative = off / (u[:, self.surface] * self.sigma)
        relative = np.where(self.one_sided & (relative > 0.0), 0.0, relative)
        deviation = self._deviations(z, u, mean)
        strayed = (z @ self.prior.T - self.target_prior) / deviation
        cost = (4.0 * np.log1p(0.25 * relative**2) * self.weigh).sum(axis=1) + (strayed**2).sum(axis=1)
        cost += ((np.log(u / self.prior_u) / self.spread_u) ** 2).sum(axis=1)
        return _State(z, u, off, relative, deviation, strayed, cost)

    def _deviations(self, z: Array, u: Array, mean: Array) -> Array:
        """Return the standard deviations of the priors, (fits, priors), which depend on the unknowns.

        Args:
            z: Unknowns, (fits, unknowns).
            u: Reciprocal reflectance of surfaces, (fits, surfaces).
            mean: Common mean, (fits, 1).
        """
        problem, priors, parts, mean_at = self.problem, CONFIG.priors, self.problem.parts, self.mean_at
        if self.centre is None:
            about = np.maximum(z[:, mean_at : self.surface_at - 1][:, problem.component], LEAST)
            of_parts = np.where(problem.is_surface, priors.surface_recovered, priors.inside * about)
            of_candidates = 10.0 * np.maximum(z[:, parts:mean_at], LEAST)
        else:
            of_parts = priors.hue * np.maximum(self.centre[:, :parts], 0.1)
            of_candidates = priors.hue * np.maximum(self.centre[:, parts:], 0.01)
        of_means = priors.spread * np.maximum(problem.expected * mean, LEAST)
        of_ties = CONFIG.surfaces.tie * 0.5 * u[:, problem.ties].sum(axis=2)
        return np.concatenate([of_parts, of_candidates, of_means, 3.0 * np.maximum(mean, LEAST), of_ties], axis=1)

    def _quadratic(self, state: _State) -> tuple[Array, Array, Array]:
        """Return Hessian, gradient and the equations' weights of the quadratic problem about a state."""
        problem, mean_at, at = self.problem, self.mean_at, self.surface_at
        z, u, places = state.z, state.u, at + self.present
        weights = self.weigh / (1.0 + 0.25 * state.relative**2) / (u[:, self.surface] * self.sigma) ** 2
        weights[self.one_sided & (state.off > 0.0)] = 0.0
        scaled = self.prior.T / state.deviation[:, None] ** 2
        hessian = scaled @ self.prior
        gradient = (scaled @ self.target_prior[..., None])[..., 0]
        # The prior on 1 / reflectance is log-normal; it is linearised about the state.
        diagonal = np.arange(at, z.shape[1])
        hessian[:, diagonal, diagonal] += 1.0 / (u * self.spread_u) ** 2
        gradient[:, at:] += np.maximum(1.0 + np.log(self.prior_u / u), 0.2) / (u * self.spread_u**2)
        weighted = weights[..., None] * self.light
        hessian[:, :mean_at, :mean_at] += self.light.transpose(0, 2, 1) @ weighted
        across = self.by_surface(weighted)
        hessian[:, places, :mean_at] -= across
        hessian[:, :mean_at, places] -= across.transpose(0, 2, 1)
        hessian[:, places, places] += self.by_surface(weights)
        gradient[:, :mean_at] += (self.target[:, None] @ weighted)[:, 0]
        # Residuals are relative to reflectance; the first term is the derivative by this scale.
        gradient[:, places] += self.by_surface(weights * (state.off**2 / u[:, self.surface] - self.target))
        if self.centre is None:
            means, mean, strayed = z[:, mean_at : at - 1], z[:, at - 1], state.strayed[:, :at] ** 2
            within = strayed[:, : problem.parts] @ -self.prior[: problem.parts, mean_at : at - 1]
            gradient[:, mean_at : at - 1] += np.where(means > LEAST, within / np.maximum(means, LEAST), 0.0)
            wide = problem.expected * mean[:, None] > LEAST
            gradient[:, at - 1] += (strayed[:, mean_at : at - 1] * wide).sum(axis=1) / np.maximum(mean, LEAST)
        return hessian, gradient, weights

    def transposed(self, c: int, values: Array) -> Array:
        """Return the product, (unknowns, q), of the transposed matrix of channel c and values (rows, q)."""
        product = np.zeros((self.prior.shape[1], values.shape[1]))
        product[: self.mean_at] = self.light[c].T @ values
        product[self.surface_at + self.present] = -self.by_surface(values[None])[0]
        return product

    def by_surface(self, values: Array) -> Array:
        """Return sums of equations' values (fits, rows, ...) for each surface with equations, (fits, surfaces, ...)."""
        return np.add.reduceat(values, self.starts, axis=1) if len(self.starts) else values


def fit_channels(
    problem: Problem,
    z: Array,
    iterations: int,
    added: Array | None = None,
    centre: Array | None = None,
    known: tuple[Array, NDArray[np.bool_]] | None = None,
) -> Fits:
    """Return the solution of the equations of all channels.

    Args:
        problem: The equations.
        z: Unknowns to start from, (fits, unknowns); reflectances of 0 are guessed from the light.
        iterations: Number of iterations of reweighting.
        added: Irradiance per unit power of candidates, of which each is tried in a fit per channel, (3, points, q).
        centre: Means of the priors on parts and candidates, (3, parts + candidates); None: those of components.
        known: Reciprocal reflectances, and a mask of the channels to whose priors they apply (see `Equations`).
    """
    equations, z = Equations(problem, added, centre, known), z.copy()
    if not z[:, equations.surface_at :].any():
        equations.guess_reflectances(z)
    return equations.solve(z, iterations)
