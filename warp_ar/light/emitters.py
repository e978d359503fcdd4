"""The search for emitters: emitters or a sun within what clips, each with a direction, a distance and a power.

They are chosen one by one, among all directions that may lack light and a grid of distances, by how far they lower the
cost to second order, (b' W r)^2 / (b' W b - b' W Z H^-1 Z' W b); the best few are fitted in earnest, then moved to
neighbouring cells and distances while that helps, and along their direction to where the cost is least. They are kept
if the cost falls by more than ``evidence``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from warp_ar.light.config import CONFIG
from warp_ar.light.fit import Fit, fit_channel
from warp_ar.light.problem import Candidate, Problem

Array = NDArray[np.float64]

STEP = 1.1
"""Ratio of neighbouring distances that are tried."""
MOST_STEPS = 4
"""From where a search has ended."""


class EmitterSearch:
    """Adds emitters to a problem's unknowns and moves them, by one channel."""

    def __init__(self, problem: Problem, c: int) -> None:
        """Look for emitters of ``problem`` in channel ``c``."""
        self.problem, self.c = problem, c
        search = CONFIG.search
        self.evidence = search.evidence * max(problem.texture / search.even, 1.0) ** search.textured
        """Fall of the cost that an emitter must be worth here: on textured surfaces stains look like shadows."""

    def fit(self, z: Array, iterations: int) -> Fit:
        """Fit of the channel that is searched by."""
        return fit_channel(self.problem, self.c, z, iterations)

    def gains(self, fit: Fit, columns: Array) -> Array:
        """Fall of the cost, to second order, if each of ``columns`` (points, q) were added as a free unknown, (q,)."""
        free = fit.z > 0.0
        added = columns[fit.rows] / self.problem.light[fit.rows, self.c][:, None]
        weighted = fit.weights[:, None] * added
        pull = weighted.T @ (fit.target - fit.equations.times(fit.z))
        overlap = fit.equations.transposed(weighted)[free]
        own = (added * weighted).sum(axis=0)
        own -= (overlap * np.linalg.solve(fit.hessian[np.ix_(free, free)], overlap)).sum(axis=0)
        return np.asarray(np.where(pull > 0.0, pull**2 / np.maximum(own, 1e-9), 0.0), np.float64)

    def tried(self, candidate: Candidate, z: Array, iterations: int) -> Fit:
        """Fit with one candidate more, starting from unknowns without it."""
        self.problem.push(candidate)
        fit = self.fit(self.problem.with_candidate(z), iterations)
        self.problem.pop()
        return fit

    def add_candidate(self, fit: Fit, candidates: Sequence[Candidate], columns: Array) -> Fit | None:
        """Add the best candidate if it is worth it; returns the new fit, or None."""
        gain = self.gains(fit, columns)
        best: tuple[Candidate, float] | None = None
        seen: list[Candidate] = []
        for place in np.argsort(-gain, kind="stable"):
            candidate = candidates[place]
            if gain[place] < 0.5 * self.evidence or len(seen) == 5:
                break
            if any(
                candidate.distance == s.distance
                and self.problem.direction[candidate.cell] @ self.problem.direction[s.cell] > 0.95
                for s in seen
            ):
                continue
            seen.append(candidate)
            cost = self.tried(candidate, fit.z, 4).cost
            if best is None or cost < best[1]:
                best = (candidate, cost)
        if best is None or best[1] > fit.cost - self.evidence:
            return None
        self.problem.push(self.settled(*best, fit, CONFIG.search.better))
        return self.fit(self.problem.with_candidate(fit.z), CONFIG.solver.iterations)

    def settled(self, candidate: Candidate, cost: float, fit: Fit, least: float) -> Candidate:
        """Where a candidate that is not among the unknowns of ``fit``, and would lead to ``cost``, does best.

        A step must lower the cost by more than ``least``.
        """
        for _ in range(2):
            around = self.neighbours(candidate)
            moved = False
            for place in np.argsort(-self.gains(fit, self.problem.power_columns(around)), kind="stable")[:3]:
                other = self.tried(around[place], fit.z, 4).cost
                if other < cost - least:
                    candidate, cost, moved = around[place], other, True
            if not moved:
                break
        # Costs that differ by less than one standard deviation tell no distance.
        return self._at_its_distance(candidate, cost, fit, max(least, CONFIG.search.worth_moving))

    def _at_its_distance(self, candidate: Candidate, cost: float, fit: Fit, least: float) -> Candidate:
        """The candidate where, along its direction, the cost is least.

        The second order, by which ``settled`` chooses what it tries, is taken far from a solution with the candidate:
        of distances it may name the wrong ones. Here every place is tried: steps of ``STEP`` downhill while they gain
        more than ``least``, then the bottom of the parabola through the last three.
        """
        if self.problem.trace is None or not np.isfinite(candidate.distance):
            return candidate
        costs = {0: cost}

        def at(step: int) -> float:
            place = Candidate(candidate.cell, candidate.distance * STEP**step)
            if step not in costs:
                near = place.distance <= CONFIG.search.nearest
                costs[step] = np.inf if near else self.tried(place, fit.z, 4).cost
            return costs[step]

        best = 0
        for way in (-1, 1):
            while abs(best) < MOST_STEPS and at(best + way) < at(best) - least:
                best += way
            if best:
                break
        low, middle, high = at(best - 1), at(best), at(best + 1)
        bend = low - 2.0 * middle + high
        found = Candidate(candidate.cell, candidate.distance * STEP**best)
        if not (np.isfinite(bend) and bend > 0.0):
            return found
        place = best + float(np.clip(0.5 * (low - high) / bend, -0.5, 0.5))
        between = Candidate(candidate.cell, candidate.distance * STEP**place)
        return between if self.tried(between, fit.z, 4).cost < middle - least else found

    def move_candidate(self, mean: float) -> None:
        """Move the first candidate to where it does better, if that is nearby; it becomes the last."""
        candidate = self.problem.candidates.pop(0)
        self.problem.candidate_columns = self.problem.candidate_columns[:, :, 1:]
        fit = self.fit(self.problem.start(mean), CONFIG.solver.iterations)
        self.problem.push(
            self.settled(candidate, self.tried(candidate, fit.z, 4).cost, fit, CONFIG.search.worth_moving)
        )

    def neighbours(self, candidate: Candidate) -> list[Candidate]:
        """Candidates in cells nearby, and at distances nearby."""
        close = np.flatnonzero(
            (self.problem.direction @ self.problem.direction[candidate.cell] > np.cos(0.2))
            & self.problem.may_hold_candidate
        )
        found = [Candidate(int(cell), candidate.distance) for cell in close]
        if np.isfinite(candidate.distance):
            nearby = [candidate.distance * factor for factor in (0.83, 0.91, 1.1, 1.2)]
            found += [Candidate(candidate.cell, distance) for distance in nearby if distance > CONFIG.search.nearest]
        return found

    def find_candidates(self, z: Array, most: int, *, places: int = CONFIG.search.candidates, turn: int = 0) -> Array:
        """Add up to ``most`` candidates; returns the unknowns. Each ``turn`` tries other directions."""
        fit = self.fit(z, CONFIG.solver.iterations)
        cells = np.flatnonzero(self.problem.may_hold_candidate)
        if len(cells) == 0 or most < 1:
            return fit.z
        step = -(-len(cells) // places)
        cells = cells[turn % step :: step]
        distances = [np.inf, *CONFIG.search.distances] if self.problem.trace is not None else [np.inf]
        candidates = [Candidate(int(cell), float(distance)) for distance in distances for cell in cells]
        columns = self.problem.power_columns(candidates)
        for _ in range(most):
            better = self.add_candidate(fit, candidates, columns)
            if better is None:
                break
            fit = better
        return fit.z
