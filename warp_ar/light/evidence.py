"""How far the recovered light can be relied on, by solving again with everything a little wrong.

A fit's own error says too little: it takes the surfaces' texture for independent, the camera's response for right, the
card for as white as it is said to be. So the problem is solved some times more, each time with

- surface points weighted at random, by blocks of some centimetres (a Bayesian bootstrap): what a single stain, the
  shadow of clutter or one box says is then missing now and then;
- radiances raised to another power: a response that is not quite the camera's;
- a card, and a ball, that reflect more or less than they are said to.

Paper is at most some thirty times as bright as the ink on it. Where it looks brighter still, the response is steeper
than it is taken to be, as an S-shaped tone curve makes it, and the card is doubted by as much.

Let X be the irradiance, over all directions, that an estimate adds, and D that which is really missing. The estimate is
no worse than nothing as long as |X - D| <= |D|, which for the estimate a X is

    a <= 2 (X . D) / |X|^2.

Each solution is a draw of D. The factor that nearly all draws allow, at most 1, is what the estimate is multiplied by:
where the draws agree nothing is lost; where they do not, less is added; where they have nothing in common, nothing is.

References:
    Rubin, The Bayesian bootstrap, Annals of Statistics 9 (1981).
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from warp_ar.kernels.recovery.recover_cells import CELL_ROWS
from warp_ar.light.config import CONFIG, Kind
from warp_ar.light.fit import Fit, fit_channel
from warp_ar.light.problem import Problem
from warp_ar.light.surfaces import Surfaces

Array = NDArray[np.float64]

HALF_CELL = 0.5 * np.pi / CELL_ROWS
"""Radians within which the direction of light is known."""


@dataclasses.dataclass(frozen=True)
class Interval:
    """Irradiance of surfaces that face along the axes, at the ball's place, with the map's light put right."""

    normals: Array
    """+x, -x, +y, -y, +z, -z, (6, 3)."""
    low: Array
    """19 of 20 times the true irradiance is between this, (6, 3: channels),"""
    value: Array
    """this is the estimate,"""
    high: Array
    """and this."""


def spread_directions(count: int) -> Array:
    """Unit vectors spread evenly over the sphere, (count, 3): a Fibonacci spiral."""
    k = np.arange(count) + 0.5
    z = 1.0 - 2.0 * k / count
    turn = np.pi * (1.0 + 5.0**0.5) * k
    return np.stack([np.sqrt(1.0 - z * z) * np.cos(turn), np.sqrt(1.0 - z * z) * np.sin(turn), z], -1)


def blocks_of(surfaces: Surfaces) -> NDArray[np.int64]:
    """Number of the block of a surface that each point lies in, (n,)."""
    where = np.floor(surfaces.points["position"].astype(float) / CONFIG.evidence.block)
    keys = np.column_stack([surfaces.surface, where])
    return np.asarray(np.unique(keys, axis=0, return_inverse=True)[1].ravel(), np.int64)


def doubt_of(contrast: float) -> float:
    """Standard deviation of the card's logarithm, by the ratio of its paper to its ink."""
    config = CONFIG.evidence
    return float(np.hypot(config.white, config.doubt * np.log(max(contrast / config.usual_contrast, 1.0))))


def irradiance_form(problem: Problem, normals: Array) -> Array:
    """What turns radiance of cells into irradiance at the ball's place, (normals, cells)."""
    return np.asarray(np.maximum(normals @ problem.direction.T, 0.0) * problem.solid_angle)


def draw_missing(problem: Problem, c: int, z: Array, blocks: NDArray[np.int64], doubt: float) -> Array:
    """Radiance that cells lack, by problems that are a little wrong, (draws, cells).

    Args:
        problem: The equations, their candidates chosen.
        c: Channel.
        z: Its solution.
        blocks: From ``blocks_of``.
        doubt: Standard deviation of the card's logarithm.
    """
    config, rng, draws = CONFIG.evidence, np.random.default_rng(CONFIG.evidence.seed), []
    spreads = np.array([config.response, doubt, config.ball])
    for _ in range(config.draws):
        weight = rng.exponential(size=blocks.max(initial=0) + 1)[blocks[problem.index]]
        power, card, ball = np.exp(spreads * rng.standard_normal(3))
        varied = copy.copy(problem)
        varied.shared = problem.shared / np.maximum(weight, 0.02)
        varied.light = np.pi * (problem.light / np.pi) ** power
        varied.light[problem.kind == Kind.CARD] *= card
        radiance = np.maximum(problem.radiance, 0.0) ** power * ball
        varied.captured = problem.transfer @ radiance.astype(np.float32)
        drawn = fit_channel(varied, c, z, CONFIG.solver.warm_iterations).z
        recovered = problem.member @ drawn[: problem.parts]
        for number, candidate in enumerate(problem.candidates):
            recovered += problem.patch(candidate.cell)[:, c] * drawn[problem.parts + number]
        draws.append(recovered * problem.missing[:, c])
    return np.array(draws)


def allowed_factor(added: Array, missing: Array) -> float:
    """What an estimate is to be multiplied by, 0 to 1.

    Args:
        added: Irradiance that it adds, (directions,).
        missing: Draws of that which is missing, (draws, directions).
    """
    squared = float(added @ added)
    if squared <= 0.0:
        return 0.0
    config = CONFIG.evidence
    return float(np.clip(config.safety * np.quantile(2.0 * (missing @ added) / squared, config.share), 0.0, 1.0))


def most_by_card(captured: Array, added: Array, share: float) -> float:
    """What an estimate may be multiplied by, 0 to 1, for its share of all light to be in keeping with the card's.

    Light from the side, or from below, hardly lights the card; surfaces that say it is there are textured and of
    unknown reflectance. Where the card shows little missing, it is little elsewhere, within ``lever``.

    Args:
        captured: Irradiance as captured, (directions,).
        added: Irradiance that the estimate adds, (directions,).
        share: Of the card's irradiance that is missing.
    """
    most = CONFIG.evidence.lever * share
    size = float(np.linalg.norm(added))
    if most >= 1.0 or size <= 0.0:
        return 1.0
    return min(most / (1.0 - most) * float(np.linalg.norm(captured)) / size, 1.0)


def card_error(doubt: float) -> float:
    """Standard deviation of the logarithm of the card's irradiance against that of the map: white, response and ball.

    Args:
        doubt: Standard deviation of the card's logarithm.
    """
    return float(np.linalg.norm([doubt, CONFIG.evidence.response, CONFIG.evidence.ball]))


def share_by_card(cosine: Array, doubt: float) -> Array:
    """Share of light, by how it meets the card, that is known by the card.

    Shading may say that light comes from where the card hardly sees it, from the horizon or below: a box's face that is
    brighter than the light elsewhere has it. How much that is, nothing of known reflectance tells. With the card's
    irradiance E known within s E, light that meets it at the cosine c, E / c by the card, is known within s E / c; what
    is expected of it beforehand deviates by about E. The best mean of both gives the first the weight

        c^2 / (c^2 + s^2).

    A cosine is itself known within half a cell, a, which adds a E / c: s^2 + a^2 stand in the place of s^2.

    Args:
        cosine: Of the angle between light and the card's normal, any shape.
        doubt: Standard deviation of the card's logarithm.
    """
    squared = np.maximum(cosine, 0.0) ** 2
    return np.asarray(squared / (squared + card_error(doubt) ** 2 + HALF_CELL**2), np.float64)


def held_to_card(
    problem: Problem, solution: Array, by_card: Array, cosines: tuple[Array, Array], doubt: float
) -> tuple[Array, Array]:
    """What was found, without more light from where the card hardly sees it than some share of what the card shows.

    Args:
        problem: The equations, their candidates chosen.
        solution: Radiance of parts, then power of candidates, (parts + candidates, 3).
        by_card: Radiance that cells lack as the card alone has it, (m, 3).
        cosines: From ``card_cosines``.
        doubt: Standard deviation of the card's logarithm.

    Returns:
        Radiance that cells lack by parts, (m, 3), and power of candidates, (candidates, 3).
    """
    recovered, powers = problem.member @ solution[: problem.parts], solution[problem.parts :]
    unknown = [(1.0 - share_by_card(cosine, doubt))[:, None] for cosine in cosines]
    beyond, own = unknown[0] * np.maximum(recovered - by_card, 0.0), unknown[1] * powers
    total = problem.solid_angle @ (beyond * problem.missing) + own.sum(axis=0)
    most = CONFIG.evidence.unseen * problem.card_irradiance()
    less = 1.0 - np.minimum(most / np.maximum(total, 1e-9), 1.0)
    return recovered - less * beyond, powers - less * own


def lever(problem: Problem, recovered: Array) -> float:
    """Light from all directions over what of it the card receives; infinite where that is nothing, 0 of no light.

    Args:
        problem: The equations.
        recovered: Radiance that cells lack, (m, 3).
    """
    power = (recovered * problem.missing).sum(axis=1) * problem.solid_angle
    on_card = float(power @ np.maximum(problem.direction[:, 2], 0.0))
    total = float(power.sum())
    return total / on_card if on_card > 0.0 else np.inf if total > 0.0 else 0.0


def known_share(problem: Problem, recovered: Array, by_card: Array, bounds: tuple[bool, bool, bool]) -> float:
    """Share of a solution that is taken for what neither equations nor draws know, 0 to 1.

    - What lights the card may come from where nothing is seen, in proportion to how much of the card's sky that is.
    - How flatly light meets the card, surfaces of unknown reflectance tell. Flat light is more light for the same
      effect on the card: no more than ``flatter`` times as much as light as the card alone has it.
    - Paper is at most so many times as bright as ink. Where it clips, ink says how much light there is at most.

    Args:
        problem: The equations, their candidates chosen.
        recovered: Radiance that cells lack, (m, 3).
        by_card: The same as the card alone has it, (m, 3).
        bounds: Channels in which the card clips.
    """
    upward = np.maximum(problem.direction[:, 2], 0.0) * problem.solid_angle
    share = 1.0 - float(upward @ problem.hidden / upward.sum())
    levers = lever(problem, by_card), lever(problem, recovered)
    if np.isfinite(levers[1]) and 0.0 < levers[0] < levers[1]:
        share *= min(CONFIG.evidence.flatter * levers[0] / levers[1], 1.0)
    return share * most_by_ink(problem, recovered, bounds)


def most_by_ink(problem: Problem, recovered: Array, bounds: tuple[bool, bool, bool]) -> float:
    """What a solution may be multiplied by, 0 to 1, for clipped paper to be no brighter beside ink than print is.

    Args:
        problem: The equations.
        recovered: Radiance that cells lack, (m, 3).
        bounds: Channels in which the card clips.
    """
    card, ink = problem.kind == Kind.CARD, problem.kind == Kind.INK
    factors = []
    for c in np.flatnonzero(bounds):
        use = ink & problem.exact[:, c]
        if not (card.any() and use.any()):
            continue
        added = problem.transfer[card] @ (recovered[:, c] * problem.missing[:, c])
        captured = float(np.median(problem.captured[card, c]))
        most = float(np.median(problem.light[use, c])) * CONFIG.evidence.most_contrast / problem.white - captured
        factors.append(np.clip(most / max(float(np.median(added)), 1e-9), 0.0, 1.0))
    return float(np.mean(factors)) if factors else 1.0


def fitting_share(fits: Sequence[Fit]) -> float:
    """Share of a solution that is taken for how badly the equations of its worst channel are met, 0 to 1.

    Where light is as modelled, robust costs come to ``fitted`` per equation. What exceeds it is light, or a surface,
    that is not modelled: it lies in the solution as well as in what is left over.

    Args:
        fits: Of the channels.
    """
    config, cost = CONFIG.evidence, max(fit.cost / max(len(fit.rows), 1) for fit in fits)
    return 1.0 / (1.0 + config.misfit * max(cost - config.fitted, 0.0))


def likely_gain(added: Array, missing: Array) -> float:
    """By how much an estimate lowers the squared error of irradiance in nearly all draws."""
    gain = (missing**2).sum(axis=1) - ((missing - added) ** 2).sum(axis=1)
    return float(np.quantile(gain, CONFIG.evidence.share))


def greyer(contrast: float, white: float) -> float:
    """How much brighter light may be than the card says, for paper that is greyer than it is said to be: at least 1.

    Paper over ink is their contrast; print is usually of so much reflectance.

    Args:
        contrast: Of paper that does not clip to the ink beside it.
        white: Reflectance that the paper is said to have.
    """
    return max(white / (contrast * CONFIG.surfaces.reflectance[Kind.INK]), 1.0) if contrast > 0.0 else 1.0


def irradiance_interval(
    problem: Problem,
    recovered: Array,
    factor: float,
    bounds: tuple[bool, bool, bool],
    spread: float | None,
    contrast: float = 0.0,
) -> Interval:
    """Between which bounds the irradiance at the ball's place lies.

    What the ball shows errs by ``capture`` to one side and ``overlooked`` to the other. What an estimate found scatters
    as its draws do, and where part of it was held back the whole of it, and as much again, may be there. Paper may be
    greyer than it is said to be (``greyer``). Where no draws were made, or the card only bounds what is missing, all
    that clips may be as bright as ``clipped``.

    Args:
        problem: The equations.
        recovered: An estimate's solution, (cells, 3).
        factor: Share of it that is taken, 0 to 1.
        bounds: Channels in which it is a lower bound.
        spread: Of the draws; None: there are none.
        contrast: Of the card's print; 0: no card is seen.
    """
    config = CONFIG.evidence
    normals = np.array([[s if k == axis else 0.0 for k in range(3)] for axis in range(3) for s in (1.0, -1.0)])
    form = irradiance_form(problem, normals)
    captured, found = form @ problem.radiance, form @ (recovered * problem.missing)
    most = form @ (config.clipped * problem.missing)
    reach = config.interval * np.hypot(0.0 if spread is None else spread, config.found)
    low = (1.0 - config.capture) * captured + factor * np.maximum(1.0 - reach, 0.0) * found
    high = (1.0 + config.overlooked) * captured + (2.0 - factor) * (1.0 + reach) * found
    is_open = np.array(bounds) | (spread is None)
    high *= greyer(contrast, problem.white)
    high = np.where(is_open, np.maximum(high, (1.0 + config.overlooked) * captured + most), high)
    return Interval(normals, low, captured + factor * found, high)
