"""Parameters of the recovery of clipped light: assumptions, search ranges and tolerances, with their units.

The module ``recovery`` explains the terms. A region is a part of the clipped light in the environment map. A component
is a connected set of clipped cells, which is split into regions. A candidate is an emitter that may be within it.
"""

from __future__ import annotations

import dataclasses
import enum


class Kind(enum.IntEnum):
    """Kind of surface."""

    CARD = 0
    """White paper, of known reflectance."""
    INK = 1
    """Black cells of the marker."""
    PLANE = 2
    """Plane proxy, which may be textured like a table."""
    FACE = 3
    """Face of a box proxy."""


@dataclasses.dataclass(frozen=True)
class SurfaceConfig:
    """Sampling of surfaces, and priors on them; tuples are indexed by ``Kind``."""

    grid: float = 0.06
    """Distance in metres between points on planes."""
    planes: int = 8
    """Largest number of planes with points, which bounds the cost for scenes of many proxies."""
    plane_points: int = 2000
    """Largest number of points on all planes together."""
    boxes: int = 16
    """Largest number of boxes with points."""
    box_points: int = 1536
    """Largest number of points on all boxes together."""
    face_steps: int = 5
    """Largest number of points along either side of a box's face."""
    noise: tuple[float, ...] = (0.02, 0.04, 0.12, 0.04)
    """Largest relative standard deviation of an equation, by kind. It is used for surfaces whose points scatter as
    much, or are too few to measure the scatter."""
    least_noise: float = 0.015
    """Smallest relative standard deviation of an equation, for an even surface: the error of the transport model."""
    scatter_points: int = 12
    """Smallest number of a surface's points for a measurement of their scatter."""
    scatter_iterations: int = 5
    """Number of iterations of reweighting, which exclude shadows and stains from the scatter."""
    shared: tuple[float, ...] = (4.0, 8.0, 2.0, 3.0)
    """Number of equations, by kind, that share one error of the transport model."""
    texture: tuple[float, ...] = (0.0, 0.0, 0.03, 0.03)
    """Distance in metres within which texture varies little, by kind; closer points share the error by texture."""
    reflectance: tuple[float, ...] = (0.85, 0.045, 0.35, 0.35)
    """Expected reflectance, by kind; a scene states that of the card. Black print has optical densities of 1 to 1.5."""
    reflectance_spread: tuple[float, ...] = (0.005, 0.3, 0.6, 0.6)
    """Standard deviation of the logarithm of reflectance, by kind. Ink has one because it measures light where paper
    clips."""
    hue_spread: tuple[float, ...] = (0.005, 0.1, 0.4, 0.4)
    """Standard deviation of the logarithm of the ratio between two channels' reflectances, by kind: paper and ink are
    nearly neutral."""
    tie: float = 0.06
    """Relative standard deviation between the reflectances of a box's faces."""
    mirror_trust: float = 0.5
    """Relative standard deviation of light that a ball reflects onto surfaces, because dents, scratches and dust
    scatter it."""
    dark: float = 0.005
    """Value of pi times radiance below which a point is not used, because of quantisation."""


@dataclasses.dataclass(frozen=True)
class PriorConfig:
    """Priors on light that clips."""

    region: float = 0.12
    """Largest solid angle of a region in steradians, which is 22 degrees wide; a larger component is split."""
    exponent: float = -0.5
    """Exponent of the solid angle in a component's expected missing radiance."""
    least_alike: float = 0.05
    """Smallest expected missing radiance of a component, relative to a component that clips in all channels."""
    fades: tuple[float, float] = (0.6, 0.7)
    """Radiance of cells next to clipped ones, relative to the clipping level: a boundary is sharp below the first
    number, and fading above the second."""
    depth: float = 1.0
    """Angle in radians from a fading boundary up to which missing radiance grows."""
    spread: float = 0.8
    """Relative standard deviation of a component's mean from the common mean."""
    inside: float = 0.7
    """Relative standard deviation of regions from their component's mean."""
    hue: float = 0.5
    """Relative standard deviation of a channel's distribution over regions from that of all channels."""
    least: float = 0.3
    """Radiance below which standard deviations are absolute, not relative."""
    surface_recovered: float = 0.5
    """Standard deviation of the missing radiance of modelled surfaces that clip."""


@dataclasses.dataclass(frozen=True)
class LeastConfig:
    """Parameters of the radiance that is added if only the map is known (``priors.least_missing``)."""

    least: float = 1.25
    """Radiance added to light that clips in all channels, relative to the clipping level, if one steradian clips."""
    exponent: float = 0.25
    """Exponent of the clipped solid angle in the added radiance."""
    most: float = 1.0
    """Clipped solid angle in steradians above which the added radiance does not grow, because a wholly clipped sky may
    be hardly brighter than clipping."""


@dataclasses.dataclass(frozen=True)
class SearchConfig:
    """Parameters of the search for emitters."""

    evidence: float = 7.0
    """Smallest decrease of the cost (twice the negative log likelihood) for which a candidate is added."""
    even: float = 1.6
    """Ratio of the surfaces' scatter to the expected scatter, above which the surfaces count as textured."""
    textured: float = 4.0
    """Exponent on textured surfaces: ``evidence`` is multiplied by (ratio / ``even``) to this power."""
    better: float = 0.1
    """Smallest decrease of the cost for which a new candidate is moved to a neighbouring place."""
    worth_moving: float = 1.0
    """Smallest decrease of the cost for which a known candidate is moved: emitters do not move, and views differ by
    noise.

    With the value of ``better``, an emitter of the clip ``torus`` would move to another one that is switched on, 0.25 m
    from the ball.
    """
    most: int = 4
    """Largest number of candidates at a time."""
    every: int = 2
    """Number of estimates between searches for one more candidate; the first estimate searches for all."""
    later_every: int = 6
    """Number of estimates between searches after the first ``SolverConfig.settled`` estimates."""
    candidates: int = 160
    """Number of directions in which a candidate is tried in the first estimate."""
    later_candidates: int = 40
    """Number of directions that a later search tries; each search tries others."""
    distances: tuple[float, ...] = (2.0, 1.2, 0.8, 0.6, 0.45, 0.35)
    """Distances of an emitter from the ball that are tried, metres, in addition to infinity."""
    nearest: float = 0.25
    """Smallest distance of an emitter from the ball, metres; a closer one would be visible in the picture."""
    farthest: float = 3.0
    """Distance in metres at which the prior on an emitter's distance stops growing."""
    angle: float = 0.12
    """Angle in radians around a candidate's direction within which cells share its light."""
    stray: float = 0.05
    """Largest clipped light around a spot, relative to that of the spot, caused by glare and cells at its edge."""
    radius_share: float = 0.06
    """Radius of an emitter relative to its distance: a disc as wide as a cell."""


@dataclasses.dataclass(frozen=True)
class SolverConfig:
    """Numbers of iterations, and conditions for a new solution."""

    iterations: int = 6
    """Number of iterations of reweighting from a start that is not a solution."""
    warm_iterations: int = 3
    """Number of iterations of reweighting from the solution of a similar problem."""
    halvings: int = 4
    """Largest number of halvings of a step that increases the cost."""
    settled: int = 10
    """Number of estimates after which emitters count as known, and estimates are left out while light is constant."""
    still: float = 0.02
    """Relative change of surfaces or environment below which the light counts as unchanged."""
    remembered: int = 12
    """Largest number of estimates in a mean while the light is unchanged."""
    sudden: float = 0.25
    """Relative change from which a new solution starts at once; smaller changes wait for one more turn."""


@dataclasses.dataclass(frozen=True)
class CardConfig:
    """Conditions under which the card's paper is used."""

    least_cells: int = 4
    """Smallest number of visible white cells, and of visible ink cells."""
    least_contrast: float = 2.5
    """Smallest median ratio of paper to ink. Print has 10 to 30; blur and veiling glare reduce it."""
    darker: float = 1.6
    """Ratio of paper to ink from which an ink cell counts as darker than the adjacent paper."""
    least_share: float = 0.75
    """Smallest share of ink cells that must be darker than the adjacent paper."""
    held: int = 15
    """Number of estimates, about five a second, for which recovered light is kept while the card is hidden."""


@dataclasses.dataclass(frozen=True)
class EvidenceConfig:
    """Errors of the evidence for an estimate, and resulting limits on its use."""

    directions: int = 32
    """Number of directions in which irradiance is compared."""
    lever: float = 2.0
    """Largest ratio of the share that is missing in the light from all directions to the share that is missing at the
    card. The two differ because the card measures light at grazing angles poorly."""
    response: float = 0.016
    """Standard deviation of the logarithm of the exponent of the camera's response."""
    white: float = 0.016
    """Standard deviation of the logarithm of the card's reflectance."""
    ball: float = 0.016
    """Standard deviation of the logarithm of the ball's reflectance."""
    usual_contrast: float = 30.0
    """Largest ratio of paper to ink of known prints; a larger one shows that the response is steeper than assumed."""
    doubt: float = 2.0
    """Standard deviation of the logarithm of the card's radiance, per unit of the logarithm of the contrast's ratio to
    ``usual_contrast``, if that is above 1."""
    found: float = 0.75
    """Relative error of the recovered light, in both directions."""
    capture: float = 0.35
    """Largest relative excess of captured irradiance over the truth, by the ball's reflectance, the directions that the
    ball does not show, and the response. This bound, ``overlooked`` and ``clipped`` hold in 19 of 20 tables of
    ``bench_never_worse``."""
    overlooked: float = 2.0
    """Largest relative amount by which captured irradiance is too low, because emitters are smaller than the ball's
    pixels or clip unnoticed."""
    clipped: float = 250.0
    """Largest mean radiance of clipped light without other evidence; 19 of 20 environments have less."""


@dataclasses.dataclass(frozen=True)
class ShadowConfig:
    """Parameters of the test that recovered light reaches the ball (``ball_shadow.py``)."""

    near: float = 2.0
    """Distance from the ball's centre, in radii, within which a ray passes close to the ball, for points next to its
    shadow."""
    near_share: float = 0.5
    """Smallest share of the added light that passes within ``near``, at points next to the shadow."""
    across: float = 3.5
    """Distance from the ball's centre, in radii, within which a ray passes the ball, for points that measure the
    shadow's contrast."""
    elsewhere: float = 0.1
    """Largest share of the added light that passes within ``near`` or ``across``, at the points outside the shadow with
    which others are compared."""
    points: int = 8
    """Smallest number of points next to the shadow, and of points outside it."""
    believed: float = 0.1
    """Quantile of the likelihood that is used as the share of light reaching the ball."""
    scatter: float = 0.05
    """Smallest standard deviation of the logarithm of a point's radiance: the error of the transport model.

    With values from 0.03 to 0.08, the test improves the same tables of ``bench_never_worse``."""
    level: float = 0.05
    """Standard deviation of the logarithm of a plane's reflectance between places, in addition to its points'
    scatter."""
    iterations: int = 8
    """Number of iterations of reweighting."""


@dataclasses.dataclass(frozen=True)
class RecoveryConfig:
    """All parameters of the recovery."""

    surfaces: SurfaceConfig = SurfaceConfig()
    """Parameters of surfaces."""
    priors: PriorConfig = PriorConfig()
    """Priors on clipped light."""
    least: LeastConfig = LeastConfig()
    """Prior on clipped light without any other evidence."""
    search: SearchConfig = SearchConfig()
    """Parameters of the search for emitters."""
    card: CardConfig = CardConfig()
    """Parameters of the card's test."""
    evidence: EvidenceConfig = EvidenceConfig()
    """Parameters of the evidence for an estimate."""
    shadow: ShadowConfig = ShadowConfig()
    """Parameters of the test by the ball's shadow."""
    solver: SolverConfig = SolverConfig()
    """Parameters of the solver."""


CONFIG = RecoveryConfig()
"""Configuration in use."""
