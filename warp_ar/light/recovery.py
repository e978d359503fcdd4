"""Light that clipping lost in the ball, found again from surfaces that the same light falls on.

**Unknowns.** Cells of the environment that clip (``kernels/recovery/recover_cells.py``) are grouped to regions:
connected ones, split where they are wider than some steradians. Region r lacks the radiance s_r >= 0, per channel, on
top of what the ball shows. Beside regions stand *candidates*: emitters or a sun within a region, or where no ball sees,
each with its power p_j >= 0 (radiance times solid angle, as seen from the ball), a direction and a distance. A surface
k has the unknown reflectance 1 / u_k; the card's is known.

**Equations.** A surface point x that shows the radiance L receives

    pi L(x) u_k = e(x) + sum_r a_r(x) s_r + sum_j b_j(x) p_j,     e = T radiance,  a_r = T clipped over the cells of r,

linear in the unknowns, none of which is negative. Divided by pi L and by u's last estimate a residual is a relative
error: the surface's texture, transport that the model leaves out; how large it is, points of a surface say by how far
they scatter (``measured_noise``). Points that clip bind from one side only: they count
while the prediction is under what they show. Where the card clips in whole, the sum of the energy has a lower bound
only, and the estimate says so; ink, a twentieth as bright, and surfaces in shadow then carry it as far as priors on
their reflectances allow.

**Priors** decide what surfaces do not see. A region's s_r scatters about the mean of its connected component, that
about one mean of all: less where channels clip apart from each other, and growing inward where it fades
(``light/priors.py``). The common mean is free; where nothing but the
card is used it is what makes the card right, and that alone is the method ``white_card``. Clipped pixels that show a
modelled surface (the card in the ball, a box) are lit, not lights: they stay close to clipping. Channels share their
distribution: a second pass draws each to the mean of all three, in the hue of their totals.

**Emitter candidates** are chosen one by one, among all directions that may lack light and a grid of distances, by how
far they lower the cost to second order, (b' W r)^2 / (b' W b - b' W Z H^-1 Z' W b); the best few are fitted in earnest,
then moved to neighbouring cells and distances while that helps, and kept if the costs of two channels fall by more than
``evidence``. An emitter at the distance D lights x by cos D^2 / |p - x|^2: its shadows and the falling off of its light
tell D. D counts from where the ball mirrors the emitter to the camera, which may lie a ball's radius beside its middle.
An emitter that is known moves only for a larger gain: emitters stand still.

Every deviation is relative to an unknown, a mean or a reflectance. The derivative with respect to that unknown is kept:
without it, the more parts and equations there are, the more all of them would shrink together.

**Solution.** Iteratively reweighted least squares with Cauchy weights; each quadratic problem with non-negative
unknowns is solved by an active set that starts from the last solution. Some 400 equations and 60 unknowns. Equal input
gives equal output.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Final

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

METHODS: Final = ("clipped", "white_card", "shading")


class Recovery:
    """Estimates what clipping took, frame by frame; keeps the emitters that it found."""

    def __init__(
        self, surfaces: Surfaces, white: float, center: Sequence[float], *, radius: float = 0.0, method: str = "shading"
    ) -> None:
        """Prepare.

        Args:
            surfaces: From ``find_surfaces``.
            white: Reflectance of the card's paper.
            center: Centre of the ball, metres.
            radius: Of the ball, metres: emitters are seen from its surface. 0: from its centre.
            method: ``white_card`` or ``shading``.

        Raises:
            ValueError: There is no such method.
        """
        if method not in METHODS[1:]:
            raise ValueError(f"recover: no method {method!r} to estimate; expected {' or '.join(METHODS[1:])}")
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
        """Return whether the last estimate still holds, as far as the light tells: then there is nothing to solve for.

        Takes note of what it is given, unless it holds.

        Args:
            cells: As for ``update``.
            observations: As for ``update``.
        """
        return self._stillness.holds(cells, observations, settled=self._frames >= CONFIG.solver.settled)

    def update(
        self,
        cells: NDArray[Any],
        transfer: NDArray[Any],
        mirrored: NDArray[Any],
        observations: NDArray[Any],
        trace: Trace | None = None,
        camera: Array | None = None,
    ) -> Estimate:
        """Estimate from one frame.

        Args:
            cells: Records of ``kernels.recover_cells.Cell``, (rows, columns).
            transfer: From ``trace_transfer``, straight, (n, rows * columns).
            mirrored: From ``trace_transfer``, by way of balls, (n, rows * columns).
            observations: Records of ``Observation``, (n,).
            trace: Traces emitters at finite distances; None: all light is distant.
            camera: Where the camera stands, metres, (3,); None: emitters are as seen from the ball's centre.
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
        """``update``, by the thread that asks for it alone."""
        self._frames += 1
        card = check_card(problem.points, problem.kind, problem.light)
        if not card.holds:
            return self._without_card(problem, card)
        self._solved += 1
        self._unseen = 0
        problem.leave_out(covered_card(problem.points, problem.kind, problem.light))
        means, bounds, radiance_by_card = _by_card(problem)
        by_card = problem.member @ radiance_by_card
        if self.method == "white_card" or not (problem.parts or problem.may_hold_candidate.any()):
            factor = problem.card_factor(bounds, doubt_of(card.contrast))
            self._held = self._estimate(problem, by_card, bounds, "white_card", factor, card)
            return self._held
        means = np.maximum(means, 0.05)
        best = choose_channel(problem)
        self._search(problem, means)
        problem.share_by_depth()
        means, bounds, _ = _by_card(problem)
        means = np.maximum(means, 0.05)
        solution = _solve_channels(problem, best, means, bounds)
        recovered, powers = problem.member @ solution[: problem.parts], solution[problem.parts :]
        # An emitter that gives nothing in any channel has gone out, or never was.
        self._candidates = [
            candidate for candidate, power in zip(problem.candidates, powers, strict=True) if power.any()
        ]
        emitters = []
        for candidate, power in zip(problem.candidates, powers, strict=True):
            recovered += problem.patch(candidate.cell) * power
            emitters.append(
                FoundEmitter(
                    problem.origin[candidate.cell],
                    problem.aim[candidate.cell],
                    candidate.distance,
                    power,
                    candidate.cell,
                )
            )
        emitters.sort(key=lambda emitter: -float(emitter.power.sum()))
        factor = min(
            most_by_card(problem, recovered, bounds, doubt_of(card.contrast)),
            reaching_factor(problem, solution, Ball(self._center, self._radius)),
        )
        self._held = self._estimate(problem, recovered, bounds, "shading", factor, card, tuple(emitters))
        return self._held

    def _without_card(self, problem: Problem, card: CardCheck) -> Estimate:
        """Return the last estimate while the card is hidden for a while, else what nearly every place lacks at least.

        Without a surface of known reflectance only the shape of shadows tells how bright an emitter is, and texture,
        gloss and clutter look like shadows.
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
        """Try candidates of former frames, one of them moved, and new ones where it is their turn to be looked for."""
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
        """The share ``factor`` of a solution, and between which bounds that leaves irradiance."""
        if factor == 0.0:
            method, emitters = "clipped", ()
        emitters = tuple(dataclasses.replace(emitter, power=factor * emitter.power) for emitter in emitters)
        known = method == "shading"
        interval = irradiance_interval(problem, recovered, factor, bounds, known=known, contrast=card.contrast)
        cells = (factor * recovered * problem.profile).reshape(*problem.shape, 3).astype(np.float32)
        r, g, b = (0.0 if bounds[c] or factor == 0.0 else problem.card_share(c, is_bound=False) for c in range(3))
        return Estimate(cells, bounds, emitters, method, factor, card, (r, g, b), interval)


def _by_card(problem: Problem) -> tuple[Array, tuple[bool, bool, bool], Array]:
    """Return ``card_means``, and the radiance that parts lack for the card to be right, (parts, 3)."""
    means, bounds = problem.card_means()
    return means, bounds, problem.expected[problem.component][:, None] * means


def _solve_channels(problem: Problem, best: int, means: Array, bounds: tuple[bool, bool, bool]) -> Array:
    """Radiance of parts and power of candidates in all channels, (parts + candidates, 3).

    Args:
        problem: The equations, its candidates chosen.
        best: The channel that surfaces show best.
        means: What the card alone has it, per channel.
        bounds: Channels in which the card does not tell.
    """
    bright, start = problem.first_mean, problem.start(means)
    # Where the card does not tell, reflectances in a channel in which it does are worth more than guesses.
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
    """The channel that surfaces show best; green of equals.

    Args:
        problem: The equations.
    """
    points = problem.exact.sum(axis=0) - problem.bound.sum(axis=0)
    return int(np.argmax(points + np.array([0.0, 0.5, 0.0])))
