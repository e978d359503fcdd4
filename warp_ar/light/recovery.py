"""Recovery of light that clips in the ball, from surfaces that receive the same light.

**Unknowns.** Clipped cells of the environment (``kernels/recovery/recover_cells.py``) are grouped into regions:
connected components, split if they are wider than a given solid angle. Region r misses the radiance s_r >= 0, per
channel, in addition to the ball's. Further unknowns are *candidates*: emitters or a sun within a region or in
directions unseen by the ball, each with a power p_j >= 0 (radiance times solid angle, as seen from the ball), a
direction and a distance. A surface k has the unknown reflectance 1 / u_k; the card's is known.

**Equations.** A surface point x with the radiance L receives

    pi L(x) u_k = e(x) + sum_r a_r(x) s_r + sum_j b_j(x) p_j

where e, a_r and b_j are the irradiance at x from the captured map, from region r per unit of missing radiance, and from
candidate j per unit power. The equations are linear in the non-negative unknowns. Divided by pi L and by the last
estimate of u, a residual is a relative error: the surface's texture and the error of the transport model. Its size is
measured by the scatter of a surface's points (``measured_noise``). Clipped points are one-sided: they count only while
the prediction is below the clipping level. If the whole card clips, it gives only a lower bound on the total light,
which the estimate states. Ink, which is a twentieth as bright, and shadowed surfaces then determine the total, as far
as the priors on their reflectances allow.

**Priors** determine the light from directions that surfaces do not measure. The s_r of a region deviates from the mean
of its connected component, and that mean from a common mean. The expected mean is lower if channels clip separately,
and radiance grows inward if the boundary fades (``light/priors.py``). The common mean is free. If only the card is
used, this mean makes the card's radiance right, which is the method ``white_card``. Clipped pixels of a modelled
surface (the card in the ball, a box) are reflected light and stay close to clipping. Channels have similar
distributions over regions: a second pass draws each channel to the mean of all three, scaled to the channel's total.

**Emitter candidates** are chosen one by one, among all directions that may miss light and a grid of distances, by their
decrease of the cost to second order (``light/emitters.py``). The best few are fitted fully, then moved to neighbouring
cells and distances while the cost decreases, and kept if the costs of two channels decrease by more than ``evidence``.
An emitter at position p and distance D lights x by cos D^2 / |p - x|^2; its shadows and the falloff of its light
determine D. D is measured from the point where the ball reflects the emitter to the camera, which is up to a radius
from the ball's centre. A known emitter is moved only for a larger decrease, because emitters do not move.

**Solution.** The equations are solved by iteratively reweighted least squares with Cauchy weights (``light/fit.py``).
Each quadratic problem has non-negative unknowns and is solved by an active-set method from the last solution. There are
about 400 equations and 60 unknowns. Equal input gives equal output.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warp_ar.light.ball_shadow import Ball, reaching_factor
from warp_ar.light.config import CONFIG
from warp_ar.light.emitters import EmitterSearch
from warp_ar.light.estimate import Estimate, FoundEmitter, Seen, Steadiness, Stillness
from warp_ar.light.evidence import CardCheck, check_card, covered_card, doubt_of, irradiance_interval, most_by_card
from warp_ar.light.fit import fit_channels, one_blas_thread
from warp_ar.light.priors import least_missing
from warp_ar.light.problem import Candidate, Problem, Trace, emitter_directions, mirroring_points
from warp_ar.light.surfaces import Surfaces

Array = NDArray[np.float64]
"""Methods: clipped light as captured, raised by the card alone, or by the shading of all surfaces."""


class Recovery:
    """Estimator of clipped light, frame by frame, which keeps the emitters that it has found."""

    def __init__(
        self, surfaces: Surfaces, white: float, center: Sequence[float], *, radius: float = 0.0, method: str = "shading"
    ) -> None:
        """Prepare the solver for a scene's surfaces.

        Args:
            surfaces: Surface points from ``find_surfaces``.
            white: Reflectance of the card's paper.
            center: Centre of the ball, metres.
            radius: Radius of the ball, metres: emitters are seen from its surface. 0: from its centre.
            method: ``white_card`` or ``shading``.
        """
        self.surfaces, self.method = surfaces, method
        self._white, self._center, self._radius = white, np.array(center, float), radius
        self._candidates: list[Candidate] = []
        self._frames = 0
        self._solved = 0
        self._stillness = Stillness()
        self._held: Estimate | None = None
        self._unseen = 0
        self._steadiness = Steadiness()

    def rests(self, cells: NDArray[Any], observations: NDArray[Any]) -> bool:
        """Return True if the light has not changed, so that the last estimate stays valid and nothing is solved.

        If it has changed, the given light is stored as that of the next estimate.

        Args:
            cells: Records of ``kernels.recover_cells.Cell``, (rows, columns).
            observations: Records of ``Observation``, (n,).
        """
        return self._stillness.holds(cells, observations, settled=self._frames >= CONFIG.solver.settled)

    def update(
        self,
        cells: NDArray[Any],
        transfer: NDArray[Any],
        mirrored: NDArray[Any],
        observations: NDArray[Any],
        trace: Trace,
        camera: Array | None = None,
    ) -> Estimate:
        """Return the estimate from one frame, averaged with former ones while the light is unchanged.

        Args:
            cells: Records of ``kernels.recover_cells.Cell``, (rows, columns).
            transfer: Direct transfer from ``trace_transfer``, (n, rows * columns).
            mirrored: Transfer by reflection in balls from ``trace_transfer``, (n, rows * columns).
            observations: Records of ``Observation``, (n,).
            trace: Function that traces emitters at finite distances.
            camera: Position of the camera, metres, (3,); None: emitters are seen from the ball's centre.
        """
        with one_blas_thread():
            aim = emitter_directions(cells)
            origin = mirroring_points(aim, self._center, self._radius, camera)
            problem = Problem(cells, transfer, mirrored, observations, self.surfaces, self._white, trace, aim, origin)
            view = np.zeros(3) if camera is None else (camera - self._center) / np.linalg.norm(camera - self._center)
            estimate = self._solve(problem)
        if self._unseen == 0:
            self._held = estimate = self._steadiness.follow(estimate, Seen.of(cells, observations), view)
        elif self._held is None:
            self._steadiness = Steadiness()
        return estimate

    def _solve(self, problem: Problem) -> Estimate:
        """Return the solution of the equations, not averaged; ``update`` calls this while BLAS has one thread."""
        self._frames += 1
        card = check_card(problem.points, problem.kind, problem.light)
        if not card.holds:
            return self._without_card(problem, card)
        self._solved += 1
        self._unseen = 0
        problem.leave_out(covered_card(problem.points, problem.kind, problem.light))
        means, bounds = problem.card_means()
        by_card = problem.member @ (problem.expected[problem.component][:, None] * means)
        if self.method == "white_card" or not (problem.parts or problem.may_hold_candidate.any()):
            factor = problem.card_factor(bounds, doubt_of(card.contrast))
            self._held = self._estimate(problem, by_card, bounds, "white_card", factor, card)
            return self._held
        means = np.maximum(means, 0.05)
        best = choose_channel(problem)
        self._search(problem, means)
        problem.share_by_depth()
        means, bounds = problem.card_means()
        means = np.maximum(means, 0.05)
        solution = _solve_channels(problem, best, means, bounds)
        recovered, powers = problem.member @ solution[: problem.parts], solution[problem.parts :]
        # An emitter without power in any channel has been switched off, or was never there.
        self._candidates = [
            candidate for candidate, power in zip(problem.candidates, powers, strict=True) if power.any()
        ]
        emitters = []
        for candidate, power in zip(problem.candidates, powers, strict=True):
            cell = candidate.cell
            recovered += problem.patch(cell) * power
            emitters.append(FoundEmitter(problem.origin[cell], problem.aim[cell], candidate.distance, power, cell))
        emitters.sort(key=lambda emitter: -float(emitter.power.sum()))
        factor = min(
            most_by_card(problem, recovered, bounds, doubt_of(card.contrast)),
            reaching_factor(problem, solution, Ball(self._center, self._radius)),
        )
        self._held = self._estimate(problem, recovered, bounds, "shading", factor, card, tuple(emitters))
        return self._held

    def _without_card(self, problem: Problem, card: CardCheck) -> Estimate:
        """Return the estimate for a frame without the card: for a short time the last one, then ``least_missing``.

        Without a surface of known reflectance, only the shape of shadows measures an emitter's brightness, and texture,
        gloss and clutter look like shadows. Other surfaces are therefore not used.
        """
        self._unseen += 1
        if self._held is not None and self._unseen <= CONFIG.card.held:
            return self._held
        self._held, self._candidates = None, []
        rows, columns = problem.shape
        maps = (side.reshape(rows, columns, 3) for side in (problem.radiance, problem.lost))
        is_light = ~problem.modelled & (problem.hidden <= 0.0)
        by_cell = (part.reshape(rows, columns) for part in (problem.solid_angle, is_light))
        least = least_missing(*maps, *by_cell).reshape(-1, 3)
        return self._estimate(problem, least, (True, True, True), "least", float(least.any()), card)

    def _search(self, problem: Problem, means: Array) -> None:
        """Add the candidates of former frames to the problem, move one of them, and at times search for new ones."""
        config = CONFIG.search
        for candidate in self._candidates:
            if problem.may_hold_candidate[candidate.cell]:
                problem.push(candidate)
        search = EmitterSearch(problem, means)
        before = self._solved - 1
        settled = before >= CONFIG.solver.settled
        if before and problem.candidates and (not settled or before % 2 == 0):
            search.move_candidate()
        left = config.most - len(problem.candidates)
        if before == 0:
            search.find_candidates(left)
        elif before % (config.later_every if settled else config.every) == 1:
            search.find_candidates(min(left, 1), places=config.later_candidates, turn=before // config.every)

    def _estimate(
        self,
        problem: Problem,
        recovered: Array,
        bounds: tuple[bool, bool, bool],
        method: str,
        factor: float,
        card: CardCheck,
        emitters: tuple[FoundEmitter, ...] = (),
    ) -> Estimate:
        """Return an estimate with the interval of the irradiance.

        Args:
            problem: The equations.
            recovered: Missing radiance of cells, (cells, 3).
            bounds: Channels in which it is a lower bound.
            method: Method of the solution.
            factor: Share of the solution that is applied.
            card: Evidence of the card.
            emitters: Emitters of the solution.
        """
        if factor == 0.0:
            method, emitters = "clipped", ()
        emitters = tuple(dataclasses.replace(emitter, power=factor * emitter.power) for emitter in emitters)
        known = method == "shading"
        interval = irradiance_interval(problem, recovered, factor, bounds, known=known, contrast=card.contrast)
        cells = (factor * recovered * problem.profile).reshape(*problem.shape, 3).astype(np.float32)
        r, g, b = (0.0 if bounds[c] or factor == 0.0 else problem.card_share(c, is_bound=False) for c in range(3))
        return Estimate(cells, bounds, emitters, method, factor, card, (r, g, b), interval)


def _solve_channels(problem: Problem, best: int, means: Array, bounds: tuple[bool, bool, bool]) -> Array:
    """Return radiance of parts and power of candidates in all channels, (parts + candidates, 3).

    Args:
        problem: The equations, with their candidates chosen.
        best: Channel that most surface points measure.
        means: Common means by the card alone, per channel.
        bounds: Channels in which the card gives a lower bound only.
    """
    bright, start = problem.first_mean, problem.start(means)
    # In channels in which the card clips, reflectances from another channel are better than their priors.
    told = min(range(3), key=lambda c: (bounds[c], c != best))
    known, follows = None, np.array(bounds) & (np.arange(3) != told)
    first = fit_channels(problem, start, CONFIG.solver.iterations).z
    if follows.any():
        known = first[told, problem.first_surface :], follows
        first = fit_channels(problem, start, CONFIG.solver.iterations, known=known).z
    if bright:
        solid = np.ones(bright)
        solid[: problem.parts] = (problem.solid_angle * problem.missing.max(axis=1)) @ problem.member
        total = first[:, :bright] @ solid + 1e-9
        centre = total[:, None] * first[:, :bright].sum(axis=0) / total.sum()
        first = fit_channels(problem, first, CONFIG.solver.warm_iterations, centre=centre, known=known).z
    return first[:, :bright].T


def choose_channel(problem: Problem) -> int:
    """Return the channel that surfaces measure best: that with most unclipped points; green if several are equal.

    Args:
        problem: The equations.
    """
    points = problem.exact.sum(axis=0) - problem.bound.sum(axis=0)
    return int(np.argmax(points + np.array([0.0, 0.5, 0.0])))
