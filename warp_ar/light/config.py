"""Parameters of the recovery of clipped light: assumptions, search ranges and tolerances, with their units."""

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
    """Sampling of surfaces, and priors on them; tuples are indexed by ``Kind``."""

    grid: float = 0.06
    """Metres between points on planes."""
    planes: int = 8
    """Largest number of planes in use, which bounds the cost for scenes of many proxies."""
    plane_points: int = 2000
    """Largest number of points on all planes."""
    boxes: int = 16
    """Largest number of boxes in use."""
    box_points: int = 1536
    """Largest number of points on all boxes."""
    face_steps: int = 5
    """Largest number of points along either side of a box's face."""
    noise: tuple[float, ...] = (0.02, 0.04, 0.12, 0.04)
    """Relative standard deviation of an equation, by kind, for surfaces whose points scatter by at least as much, or
    are too few to measure the scatter."""
    least_noise: float = 0.015
    """Least relative standard deviation, for an even surface: error of the transport model."""
    scatter_points: int = 12
    """Least number of a surface's points for a measurement of their scatter."""
    scatter_iterations: int = 5
    """Iterations of reweighting, which exclude shadows and stains from the scatter."""
    shared: tuple[float, ...] = (4.0, 8.0, 2.0, 3.0)
    """Number of equations, by kind, that share one error of the transport model."""
    texture: tuple[float, ...] = (0.0, 0.0, 0.03, 0.03)
    """Distance in metres within which texture varies little, by kind; closer points share its error as well."""
    reflectance: tuple[float, ...] = (0.85, 0.045, 0.35, 0.35)
    """Expected reflectance, by kind; a scene states the card's. Black print has densities of 1 to 1.5."""
    reflectance_spread: tuple[float, ...] = (0.005, 0.3, 0.6, 0.6)
    """Standard deviation of the reflectance's logarithm, by kind. Where paper clips, ink measures light."""
    hue_spread: tuple[float, ...] = (0.005, 0.1, 0.4, 0.4)
    """Standard deviation of the logarithm of the ratio of two channels' reflectances: paper is white and ink grey."""
    tie: float = 0.06
    """Relative standard deviation between the reflectances of one box's faces."""
    mirror_trust: float = 0.5
    """Relative standard deviation of light reflected by a ball: dents, scratches and dust scatter it."""
    dark: float = 0.005
    """pi times radiance below which a point is not used, because of quantisation."""


@dataclasses.dataclass(frozen=True)
class PriorConfig:
    """Priors on light that clips."""

    region: float = 0.12
    """Solid angle in steradians above which a region is split; this one is 22 degrees wide."""
    exponent: float = -0.5
    """Exponent of the solid angle in a component's expected radiance."""
    least_alike: float = 0.05
    """Least expected missing light of a component, relative to a component that clips in all channels."""
    fades: tuple[float, float] = (0.6, 0.7)
    """Radiance next to clipped cells over clipping: boundaries are sharp below the first, faded at the second."""
    depth: float = 1.0
    """Radians inside a fading boundary up to which missing radiance grows."""
    spread: float = 0.8
    """Relative standard deviation of components from the common mean."""
    inside: float = 0.7
    """Relative standard deviation of regions from their component's mean."""
    hue: float = 0.5
    """Relative standard deviation of a channel's distribution from that of all channels."""
    least: float = 0.3
    """Radiance below which deviations count as absolute, not relative."""
    surface_recovered: float = 0.5
    """Standard deviation of the radiance above clipping on modelled surfaces."""


@dataclasses.dataclass(frozen=True)
class LeastConfig:
    """Parameters of the least missing radiance, when only the map is known (``priors.least_missing``)."""

    least: float = 1.25
    """Added radiance of light clipped in all channels, over the clipping level, if one steradian clips."""
    exponent: float = 0.25
    """Exponent of the clipped solid angle in the added radiance."""
    most: float = 1.0
    """Steradians of clipping from which the added radiance is constant: a wholly clipped sky may be even."""


@dataclasses.dataclass(frozen=True)
class SearchConfig:
    """Search for emitters."""

    evidence: float = 7.0
    """Least decrease of the cost (twice a negative log likelihood) for an added candidate."""
    even: float = 1.6
    """Ratio of the surfaces' scatter to the expected scatter, above which they count as textured."""
    textured: float = 4.0
    """Exponent of that ratio over ``even`` in the least decrease on textured surfaces."""
    better: float = 0.1
    """Least decrease of the cost for moving a new candidate to a neighbouring place."""
    worth_moving: float = 1.0
    """Least decrease of the cost for moving a known candidate: emitters do not move, and views differ by noise.

    With the value of ``better``, an emitter of ``torus`` moves to the place of another that is switched on, 0.25 m from
    the ball.
    """
    most: int = 4
    """Largest number of candidates at a time."""
    every: int = 2
    """Estimates between searches for one more candidate; the first estimate searches for all."""
    later_every: int = 6
    """Estimates between searches after ``settled`` estimates."""
    candidates: int = 160
    """Directions tried for a candidate in the first estimate."""
    later_candidates: int = 40
    """Directions tried in a later search, different ones in each."""
    distances: tuple[float, ...] = (2.0, 1.2, 0.8, 0.6, 0.45, 0.35)
    """Distances of an emitter from the ball to try, metres, besides infinity."""
    nearest: float = 0.25
    """Least distance of an emitter from the ball, metres; a closer one would be visible in the picture."""
    farthest: float = 3.0
    """Distance, metres, at which the prior on an emitter's distance stops growing."""
    angle: float = 0.12
    """Radians around a candidate's direction within which cells share its light."""
    stray: float = 0.05
    """Largest share of a spot's clipped light around it: glare, and cells at its edge."""
    radius_share: float = 0.06
    """Radius of an emitter over its distance: a disc as wide as a cell."""


@dataclasses.dataclass(frozen=True)
class SolverConfig:
    """Numbers of iterations, and conditions for a new solution."""

    iterations: int = 6
    """Iterations of reweighting from a start that is not a solution."""
    warm_iterations: int = 3
    """Iterations of reweighting from the solution of a similar problem."""
    halvings: int = 4
    """Largest number of halvings of a step that increases the cost."""
    settled: int = 10
    """Number of estimates, from several views, after which emitters and constant light count as known."""
    still: float = 0.02
    """Relative change of surfaces or environment below which the light counts as unchanged."""
    remembered: int = 12
    """Largest number of estimates in a mean while the light is unchanged."""
    sudden: float = 0.25
    """Relative change that starts a new solution at once; smaller changes wait for one more estimate."""


@dataclasses.dataclass(frozen=True)
class CardConfig:
    """Conditions for using a card's white."""

    least_cells: int = 4
    """Least number of visible white cells, and of ink cells."""
    least_contrast: float = 2.5
    """Least median ratio of paper to ink: print has 10 to 30, and blur and veiling glare reduce it."""
    darker: float = 1.6
    """Ratio from which an ink cell counts as darker than the adjacent paper."""
    least_share: float = 0.75
    """Least share of ink cells that are darker."""
    held: int = 15
    """Number of estimates, about five a second, for which recovered light is kept while the card is hidden."""


@dataclasses.dataclass(frozen=True)
class EvidenceConfig:
    """Errors of the evidence for an estimate, and resulting limits on its use."""

    directions: int = 32
    """Number of directions in which irradiance is compared."""
    lever: float = 2.0
    """Largest ratio of the missing share in the light from all directions to that at the card, which measures light at
    grazing angles poorly."""
    response: float = 0.016
    """Standard deviation of the logarithm of the response's exponent."""
    white: float = 0.016
    """Standard deviation of the logarithm of the card's reflectance."""
    ball: float = 0.016
    """Standard deviation of the logarithm of the ball's reflectance."""
    usual_contrast: float = 30.0
    """Largest paper to ink ratio of known prints; a larger one shows that the response is steeper than assumed."""
    doubt: float = 2.0
    """Standard deviation of the logarithm of the card's radiance, per unit of log contrast above ``usual_contrast``."""
    found: float = 0.75
    """Relative error of the recovered light, in both directions."""
    capture: float = 0.35
    """Relative error of captured irradiance, downward: reflectance of the ball, the unseen cone, response. This bound,
    ``overlooked`` and ``clipped`` hold in 19 of 20 tables of ``bench_never_worse``."""
    overlooked: float = 2.0
    """Relative error of captured irradiance, upward: emitters smaller than the ball's pixels, or clipping unnoticed."""
    clipped: float = 250.0
    """Largest mean radiance of clipped light without other evidence; 19 of 20 rooms have less."""


@dataclasses.dataclass(frozen=True)
class ShadowConfig:
    """Parameters of the test that recovered light reaches the ball (``ball_shadow.py``)."""

    near: float = 2.0
    """Distance in radii within which a ray passes close to the ball, for points next to the ball's shadow."""
    near_share: float = 0.5
    """Least share of rays within ``near`` in the light added at a tested point."""
    across: float = 3.5
    """Distance in radii within which a ray passes the ball, for points that measure the shadow's contrast."""
    elsewhere: float = 0.1
    """Largest share of rays within ``near`` or ``across`` at points outside the shadow, which measure its plane."""
    points: int = 8
    """Least number of points next to the shadow, and of those outside it."""
    believed: float = 0.1
    """Quantile of the likelihood from which the share of light is taken."""
    scatter: float = 0.05
    """Least standard deviation of the logarithm of a point's radiance: error of the transport model.

    With values from 0.03 to 0.08 the same tables of ``bench_never_worse`` improve by this test."""
    level: float = 0.05
    """Least standard deviation of the logarithm of a plane's level between places, besides its points' scatter."""
    iterations: int = 8
    """Iterations of reweighting."""


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
