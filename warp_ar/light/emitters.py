"""Search for emitters within clipped light, such as lamps or the sun, each with a direction, a distance and a power.

Candidates are chosen one by one, among all directions that may miss light and a grid of distances, by their decrease of
the cost to second order, (b' W r)^2 / (b' W b - b' W Z H^-1 Z' W b). The best few are fitted fully, then moved to
neighbouring cells and distances while the cost decreases, and along their direction to the least cost. They are kept if
the cost decreases by more than ``evidence``.

**Channels.** Each channel is fitted separately, with its own power of each candidate. Residuals are nearly the same in
all three: those of two channels correlate by 0.92 to 1.0 on four known desks, and by 0.71 or more where much clips. So
they are three measurements of one error. The place of a candidate is chosen by the mean of the three costs, not by
their sum. Its existence is decided by the median of their decreases, so that two channels must confirm it. If points or
light clip in a channel, its cost hardly decreases; a single channel is outvoted.

**Distances.** The distance of an emitter is determined by the falloff of its light, often weakly: the costs of a lamp
in the clip ``desk`` differ by less than one between 0.3 m and 1.2 m. A prior therefore matters. Emitters may be
anywhere in a room, so their density per volume is taken as constant. An interval of directions and relative distances
has a volume proportional to d^3 at the distance d. Each cost is therefore reduced by

    2 log d^3 = 6 log d

with d at most ``farthest``. If the falloff determines the distance within a tenth, the prior moves it by 3 %.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from warp_ar.light.config import CONFIG
from warp_ar.light.fit import Fits, fit_channels
from warp_ar.light.problem import Candidate, Problem

Array = NDArray[np.float64]


STEP = 1.1
"""Ratio of neighbouring distances in the search along a direction."""
MOST_STEPS = 4
"""Largest number of steps by ``STEP`` from the result of the search on a grid."""


def room(distance: float) -> float:
    """Return 6 log d, the amount by which the prior lowers the cost of an emitter at a distance d in metres."""
    return 6.0 * float(np.log(min(distance, CONFIG.search.farthest)))


class EmitterSearch:
    """Search that adds emitters to a problem's unknowns and moves them, using all channels."""

    def __init__(self, problem: Problem, means: Array) -> None:
        """Prepare a search.

        Args:
            problem: The equations, to which candidates are added.
            means: Common mean of the missing radiance that the card alone implies, per channel, (3,).
        """
        self.problem, self.means = problem, means
        search = CONFIG.search
        self.evidence = search.evidence * max(problem.texture / search.even, 1.0) ** search.textured
        """Smallest decrease of the cost for an emitter. It is larger on textured surfaces, where stains look like
        shadows."""

    def fit_anew(self) -> Fits:
        """Return the solution of all channels, starting from the one that the card alone implies."""
        return fit_channels(self.problem, self.problem.start(self.means), CONFIG.solver.iterations)

    def gains(self, fits: Fits, columns: Array) -> Array:
        """Return the decrease of each channel's cost, to second order, by each of q candidates alone, (3, q).

        Args:
            fits: Solution without the candidates.
            columns: Irradiance of each point per unit power of each candidate, (points, q).
        """
        equations, found = fits.equations, []
        for c in range(3):
            free = fits.z[c] > 0.0
            added = columns[equations.rows] / equations.shown[c][:, None]
            weighted = fits.weights[c][:, None] * added
            pull = -fits.off[c] @ weighted
            overlap = equations.transposed(c, weighted)[free]
            own = (added * weighted).sum(axis=0)
            own -= (overlap * np.linalg.solve(fits.hessian[c][np.ix_(free, free)], overlap)).sum(axis=0)
            found.append(np.where(pull > 0.0, pull**2 / np.maximum(own, 1e-9), 0.0))
        return np.array(found)

    def costs_at(self, places: Sequence[Candidate], fits: Fits) -> Array:
        """Return the channels' mean cost with one more candidate, minus ``room``, for each place of it, (places,)."""
        z = np.insert(fits.z, self.problem.first_mean, 0.0, axis=1)
        tried = np.tile(z, (len(places), 1))
        light, iterations = self.problem.light_of(places), CONFIG.solver.warm_iterations
        cost = fit_channels(self.problem, tried, iterations, light).cost
        return np.asarray(cost.reshape(-1, 3).mean(axis=1) - [room(place.distance) for place in places], np.float64)

    def add_candidate(self, fits: Fits, candidates: Sequence[Candidate], columns: Array) -> Fits | None:
        """Add the best of some candidates, if the cost decreases enough.

        Args:
            fits: Solution without them.
            candidates: Candidates to choose from.
            columns: Irradiance of each point per unit power of each candidate, (points, q).

        Returns:
            Solution with the candidate; None if none was added.
        """
        gain, tried = np.median(self.gains(fits, columns), axis=0), list[Candidate]()
        for place in np.argsort(-gain, kind="stable"):
            one = candidates[place]
            if gain[place] < 0.3 * self.evidence or len(tried) == 5:
                break
            toward = [self.problem.direction[other.cell] for other in tried if other.distance == one.distance]
            if not toward or (np.array(toward) @ self.problem.direction[one.cell]).max() <= 0.95:
                tried.append(one)
        if not tried:
            return None
        best = self._best_of(tried, tried[0], np.inf, fits, 0.0)
        self.problem.push(self.settled(*best, fits, CONFIG.search.better))
        z = np.insert(fits.z, self.problem.first_mean - 1, 0.0, axis=1)
        added = fit_channels(self.problem, z, CONFIG.solver.iterations)
        if np.median(fits.cost - added.cost) < self.evidence:
            self.problem.pop()
            return None
        return added

    def settled(self, candidate: Candidate, cost: float, fits: Fits, least: float) -> Candidate:
        """Return the best place near a candidate.

        Args:
            candidate: The candidate, which is not among the unknowns of ``fits``.
            cost: Cost with the candidate, from ``costs_at``.
            fits: Solution without the candidate.
            least: Decrease of the cost that each step must exceed.
        """
        for _ in range(2):
            around = self.neighbours(candidate)
            gains = self.gains(fits, self.problem.power_columns(around)).mean(axis=0)
            nearby = [around[place] for place in np.argsort(-gains, kind="stable")[:3]]
            better = self._best_of(nearby, candidate, cost, fits, least)
            if better[0] == candidate:
                break
            candidate, cost = better
        others = [Candidate(candidate.cell, distance) for distance in (np.inf, *CONFIG.search.distances)]
        candidate, cost = self._best_of(others, candidate, cost, fits, least)
        # A difference of the cost below one standard deviation does not determine the distance.
        return self._at_its_distance(candidate, cost, fits, max(least, CONFIG.search.worth_moving))

    def _best_of(
        self, places: Sequence[Candidate], candidate: Candidate, cost: float, fits: Fits, least: float
    ) -> tuple[Candidate, float]:
        """Return the best of some places and its cost, or the candidate if none decreases it by more than ``least``."""
        for place, other in zip(places, self.costs_at(places, fits), strict=True):
            if other < cost - least:
                candidate, cost = place, float(other)
        return candidate, cost

    def _at_its_distance(self, candidate: Candidate, cost: float, fits: Fits, least: float) -> Candidate:
        """Return the candidate at the distance of least cost along its direction.

        ``settled`` chooses places by the decrease to second order, which is inaccurate far from a solution with the
        candidate and may prefer wrong distances. Here the cost is computed at each distance. Steps by ``STEP`` are made
        while they decrease the cost by more than ``least``; the result is the minimum of a parabola through the last
        three distances.
        """
        if not np.isfinite(candidate.distance):
            return candidate

        def place(step: float) -> Candidate:
            return Candidate(candidate.cell, candidate.distance * STEP**step)

        def try_steps(*steps: int) -> None:
            far = [step for step in steps if place(step).distance > CONFIG.search.nearest]
            costs.update(dict.fromkeys(steps, np.inf))
            if far:
                costs.update(zip(far, self.costs_at([place(step) for step in far], fits), strict=True))

        costs, best = {0: cost}, 0
        try_steps(-1, 1)
        for way in (-1, 1):
            while abs(best) < MOST_STEPS and costs[best + way] < costs[best] - least:
                best += way
                try_steps(best + way)
            if best:
                break
        low, middle, high = (costs[best + way] for way in (-1, 0, 1))
        bend = low - 2.0 * middle + high
        if not (np.isfinite(bend) and bend > 0.0):
            return place(best)
        between = place(best + float(np.clip(0.5 * (low - high) / bend, -0.5, 0.5)))
        return between if self.costs_at([between], fits)[0] < middle - least else place(best)

    def move_candidate(self) -> None:
        """Move the first candidate to a better place nearby, if there is one; it becomes the last candidate."""
        candidate = self.problem.candidates.pop(0)
        self.problem.candidate_columns = self.problem.candidate_columns[:, :, 1:]
        fits = self.fit_anew()
        cost = float(self.costs_at([candidate], fits)[0])
        self.problem.push(self.settled(candidate, cost, fits, CONFIG.search.worth_moving))

    def neighbours(self, candidate: Candidate) -> list[Candidate]:
        """Return candidates in adjacent cells and at neighbouring distances."""
        close = np.flatnonzero(
            (self.problem.direction @ self.problem.direction[candidate.cell] > np.cos(0.2))
            & self.problem.may_hold_candidate
        )
        found = [Candidate(int(cell), candidate.distance) for cell in close]
        if np.isfinite(candidate.distance):
            nearby = [candidate.distance * factor for factor in (0.83, 0.91, 1.1, 1.2)]
            found += [Candidate(candidate.cell, distance) for distance in nearby if distance > CONFIG.search.nearest]
        return found

    def find_candidates(self, most: int, *, places: int = CONFIG.search.candidates, turn: int = 0) -> None:
        """Add candidates to the problem, one by one.

        Args:
            most: Largest number of candidates to add.
            places: Number of directions to try.
            turn: Number of the search; each number selects other directions.
        """
        cells = np.flatnonzero(self.problem.may_hold_candidate)
        if len(cells) == 0 or most < 1:
            return
        step = -(-len(cells) // places)
        cells = cells[turn % step :: step]
        distances = np.inf, *CONFIG.search.distances
        candidates = [Candidate(int(cell), distance) for distance in distances for cell in cells]
        columns = self.problem.power_columns(candidates)
        fits = self.fit_anew()
        for _ in range(most):
            better = self.add_candidate(fits, candidates, columns)
            if better is None:
                break
            fits = better
