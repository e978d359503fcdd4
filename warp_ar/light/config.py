"""Numbers of the recovery of clipped light: what is assumed, tried and tolerated, each with its unit."""

from __future__ import annotations

import dataclasses
import enum


class Kind(enum.IntEnum):
    """Kind of surface."""

    CARD = 0
    """White paper: its reflectance is known."""
    INK = 1
    """The marker's black cells."""
    PLANE = 2
    """A plane proxy, textured as tables are."""
    FACE = 3
    """One face of a box proxy."""


@dataclasses.dataclass(frozen=True)
class SurfaceConfig:
    """Sampling of surfaces, and priors on them; tuples are by ``Kind``."""

    grid: float = 0.06
    """Metres between points on planes."""
    planes: int = 8
    """Planes that are read: costs grow no further with the scene's number of proxies. Those share"""
    plane_points: int = 2000
    """points,"""
    boxes: int = 16
    """and so many boxes share"""
    box_points: int = 1536
    """points,"""
    face_steps: int = 5
    """at most this many in each of a face's two directions."""
    noise: tuple[float, ...] = (0.02, 0.04, 0.12, 0.04)
    """Relative standard deviation of an equation, by kind, if points scatter by as much or are too few to measure
    it."""
    least_noise: float = 0.015
    """Least relative standard deviation, of an even surface: transport outside the model."""
    scatter_points: int = 12
    """Least number of a surface's points that measure their scatter."""
    scatter_iterations: int = 5
    """Iterations of reweighting that exclude shadows and stains from the scatter."""
    shared: tuple[float, ...] = (4.0, 8.0, 2.0, 3.0)
    """Number of equations, by kind, that share one error of transport outside the model."""
    texture: tuple[float, ...] = (0.0, 0.0, 0.03, 0.03)
    """Metres within which texture varies little, by kind: points that are closer share its error as well."""
    reflectance: tuple[float, ...] = (0.85, 0.045, 0.35, 0.35)
    """Expected reflectance, by kind; the scene knows the card's. Black print: densities of 1 to 1.5."""
    reflectance_spread: tuple[float, ...] = (0.005, 0.3, 0.6, 0.6)
    """Standard deviation of its logarithm. Where the paper clips, ink is what tells the amount of light."""
    hue_spread: tuple[float, ...] = (0.005, 0.1, 0.4, 0.4)
    """Standard deviation of its logarithm about that in another channel: paper is white and ink grey."""
    tie: float = 0.06
    """Relative standard deviation between the reflectances of one box's faces."""
    mirror_trust: float = 0.5
    """Relative standard deviation of light that comes by way of a ball: dents, scratches and dust scatter it."""
    dark: float = 0.005
    """pi times radiance below which a point says nothing: quantisation."""


@dataclasses.dataclass(frozen=True)
class PriorConfig:
    """Priors on light that clips."""

    region: float = 0.12
    """Steradians: a region wider than this (22 degrees across) is split."""
    exponent: float = -0.5
    """Exponent of the solid angle in a component's expected radiance."""
    least_alike: float = 0.05
    """Least of what a component is expected to lack over one in which all channels clip: some light lacks in any."""
    fades: tuple[float, float] = (0.6, 0.7)
    """Radiance beside what clips, over that at clipping, from which its boundary is less and less sharp, to fading."""
    depth: float = 1.0
    """Radians inside a boundary at which light fades from which what it lacks grows no further."""
    spread: float = 0.8
    """Relative standard deviation of components about the common mean."""
    inside: float = 0.7
    """Relative standard deviation of regions about their component's mean."""
    hue: float = 0.5
    """Relative standard deviation of a channel's distribution from that of all channels."""
    least: float = 0.3
    """Radiance below which deviations count as absolute, not relative."""
    surface_recovered: float = 0.5
    """Radiance above clipping (standard deviation) of modelled surfaces."""


@dataclasses.dataclass(frozen=True)
class LeastConfig:
    """Least radiance that is missing where the map alone is known (``priors.least_missing``)."""

    least: float = 1.25
    """Radiance by which what clips in all channels is raised, over the level of clipping, where a steradian clips."""
    exponent: float = 0.25
    """Of the solid angle that clips, in that,"""
    most: float = 1.0
    """and steradians from which it rises no further: a sky that clips in whole may be even, just above clipping."""


@dataclasses.dataclass(frozen=True)
class SearchConfig:
    """Search for emitters."""

    evidence: float = 7.0
    """Fall of the cost (twice a log likelihood) that a candidate must be worth."""
    even: float = 1.6
    """Ratio of how far surfaces scatter to what is expected of them above which they are textured."""
    textured: float = 4.0
    """Exponent of what exceeds it, in the fall that is asked for there."""
    better: float = 0.1
    """Fall of the cost for which a candidate that is being added goes to a neighbouring place."""
    worth_moving: float = 1.0
    """The same for a candidate that was known before: emitters stand still, and what differs from view to view is
    noise.

    With ``better``, an emitter of ``torus`` wanders to where another comes on, a quarter of a metre from the ball.
    """
    most: int = 4
    """Most candidates at a time."""
    every: int = 2
    """Estimates between searches for one more candidate; the first searches for all."""
    later_every: int = 6
    """The same once as many estimates as ``settled`` were made."""
    first: int = 5
    """Estimates in which searches try as many directions as they ever do."""
    candidates: int = 160
    """Directions that are tried for a candidate at first."""
    later_candidates: int = 40
    """Directions that are tried in a later search, others each time."""
    distances: tuple[float, ...] = (2.0, 1.2, 0.8, 0.6, 0.45, 0.35)
    """Metres from the ball that are tried for an emitter, beside infinity."""
    nearest: float = 0.25
    """Metres from the ball within which no emitter is looked for: it would stand in the picture, in front of the
    desk."""
    farthest: float = 3.0
    """Metres beyond which an emitter is taken for a distant one, in how much room there is for it."""
    angle: float = 0.12
    """Radians around a candidate's direction that share its light."""
    stray: float = 0.05
    """Share of the light of a lamp's spot that may clip around it: glare, and cells that the spot just touches."""
    radius_share: float = 0.06
    """Radius of an emitter as a share of its distance: of a disc as wide as a cell."""


@dataclasses.dataclass(frozen=True)
class SolverConfig:
    """When a solution is good enough, and when none is asked for."""

    iterations: int = 6
    """Iterations of reweighting from a distant start."""
    warm_iterations: int = 3
    """The same from a solution of nearly the same problem."""
    halvings: int = 4
    """Most of one step, while it leads to a higher cost."""
    converged: float = 1.0e-3
    """Relative change of the largest unknown, in one reweighting, from which on nothing more is gained."""
    settled: int = 10
    """Estimates, from several views, after which emitters are taken for found, and light that stays as it is for
    known."""
    still: float = 0.02
    """Relative change, of surfaces or of the environment, below which the light is the same."""
    remembered: int = 12
    """Estimates that count in a mean while the light is the same."""
    sudden: float = 0.25
    """Relative change that is solved for at once; what changes less may wait for one more estimate."""


@dataclasses.dataclass(frozen=True)
class CardConfig:
    """Tests that a card must pass before its white is believed."""

    least_cells: int = 4
    """White cells, and ink cells, that must be seen."""
    least_contrast: float = 2.5
    """Median ratio of paper to ink: print has 10 to 30, blur and veiling glare lower it."""
    darker: float = 1.6
    """Ratio from which an ink cell is darker than the paper beside it."""
    least_share: float = 0.75
    """Share of ink cells that must be."""
    held: int = 15
    """Estimates, of some five a second, for which light that was found holds while a hand or an object hides it."""


@dataclasses.dataclass(frozen=True)
class EvidenceConfig:
    """Errors of what an estimate rests on, and the share of it that they leave."""

    directions: int = 32
    """In which irradiance counts."""
    lever: float = 2.0
    """Most light that may be missing from all directions, over that which is missing at the card, as shares: light
    that hardly reaches the card is hardly known by it."""
    response: float = 0.016
    """Standard deviation of the logarithm of the response's exponent."""
    white: float = 0.016
    """The same of the card's reflectance."""
    ball: float = 0.016
    """The same of the ball's."""
    usual_contrast: float = 30.0
    """Ratio of paper to ink above which no print is known: the response is steeper than it is taken to be."""
    doubt: float = 2.0
    """Standard deviation of the card's logarithm per logarithm of contrast beyond that."""
    found: float = 0.75
    """Relative error of the light that was found, either way."""
    capture: float = 0.35
    """Relative error of the irradiance as captured, downward: the ball's reflectance, the unseen cone, the
    response. This, the next and ``clipped`` hold in 19 of 20 of the tables of ``bench_never_worse``."""
    overlooked: float = 2.0
    """The same upward: emitters that are too small for the ball's pixels, or saturate unnoticed."""
    clipped: float = 250.0
    """Radiance that what clips may have on average where nothing tells: 19 of 20 rooms have less."""


@dataclasses.dataclass(frozen=True)
class ShadowConfig:
    """Test that recovered light reaches the ball (``ball_shadow.py``)."""

    beside: float = 2.0
    """Radii within which light passes the ball whose absence beside the shadow is the ball's own,"""
    beside_share: float = 0.5
    """and least share of what is added at a point that does."""
    across: float = 3.5
    """The same of points that show the shadow's contrast."""
    elsewhere: float = 0.1
    """Greatest share at points that say how bright the plane is elsewhere."""
    points: int = 8
    """Least number of points, here and elsewhere."""
    believed: float = 0.1
    """Share of the likelihood that lies below the share of light that is taken."""
    scatter: float = 0.05
    """Least standard deviation of a point's logarithm: transport that the model leaves out.

    With 0.03 to 0.08 the same of the tables of ``bench_never_worse`` that are worse without this are not with it."""
    level: float = 0.05
    """The same of a plane's level from place to place, beside how far its points scatter."""
    iterations: int = 8
    """Iterations of reweighting."""


@dataclasses.dataclass(frozen=True)
class RecoveryConfig:
    """All numbers of the recovery."""

    surfaces: SurfaceConfig = SurfaceConfig()
    """Settings of surfaces."""
    priors: PriorConfig = PriorConfig()
    """Priors of clipped light."""
    least: LeastConfig = LeastConfig()
    """Prior of clipped light without any other evidence."""
    search: SearchConfig = SearchConfig()
    """Settings of the search for emitters."""
    card: CardConfig = CardConfig()
    """Settings of the card."""
    evidence: EvidenceConfig = EvidenceConfig()
    """Settings of the evidence for an estimate."""
    shadow: ShadowConfig = ShadowConfig()
    """Settings of the ball's own shadow."""
    solver: SolverConfig = SolverConfig()
    """Settings of the solver."""


CONFIG = RecoveryConfig()
"""Configuration of the program."""
