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
    """Raise of light clipped in all channels, over the level of clipping, if one steradian clips."""
    exponent: float = 0.25
    """Exponent of the clipped solid angle in the raised radiance."""
    most: float = 1.0
    """Steradians from which it rises no further: a wholly clipped sky may be even, just above clipping."""


@dataclasses.dataclass(frozen=True)
class SearchConfig:
    """Search for emitters."""

    evidence: float = 7.0
    """Least fall of the cost (twice a log likelihood) by an added candidate."""
    even: float = 1.6
    """Ratio of surfaces' scatter to the expected one above which they count as textured."""
    textured: float = 4.0
    """Exponent of the ratio above ``even`` in the least fall for textured surfaces."""
    better: float = 0.1
    """Least fall of the cost for moving a new candidate to a neighbouring place."""
    worth_moving: float = 1.0
    """The same for a known candidate: emitters stand still, and differences between views are noise.

    With ``better``, an emitter of ``torus`` wanders to where another comes on, a quarter of a metre from the ball.
    """
    most: int = 4
    """Largest number of candidates at a time."""
    every: int = 2
    """Estimates between searches for one more candidate; the first searches for all."""
    later_every: int = 6
    """The same after ``settled`` estimates."""
    candidates: int = 160
    """Directions tried for a candidate in the first estimate."""
    later_candidates: int = 40
    """Directions tried in a later search, different ones each time."""
    distances: tuple[float, ...] = (2.0, 1.2, 0.8, 0.6, 0.45, 0.35)
    """Distances of an emitter from the ball that are tried, metres, besides infinity."""
    nearest: float = 0.25
    """Least distance of an emitter from the ball, metres; a closer one would be in the picture, before the desk."""
    farthest: float = 3.0
    """Distance, metres, at which the prior on an emitter's distance stops growing."""
    angle: float = 0.12
    """Radians around a candidate's direction that share its light."""
    stray: float = 0.05
    """Largest share of a spot's light that may clip around it: glare, and cells that it just touches."""
    radius_share: float = 0.06
    """Radius of an emitter over its distance: a disc as wide as a cell."""


@dataclasses.dataclass(frozen=True)
class SolverConfig:
    """Limits of iteration, and conditions of a new solution."""

    iterations: int = 6
    """Iterations of reweighting from a distant start."""
    warm_iterations: int = 3
    """The same from a solution of nearly the same problem."""
    halvings: int = 4
    """Largest number of halvings of a step that raises the cost."""
    settled: int = 10
    """Number of estimates, from several views, after which emitters and steady light count as known."""
    still: float = 0.02
    """Relative change of surfaces or environment below which the light counts as unchanged."""
    remembered: int = 12
    """Largest number of estimates in a mean while the light is unchanged."""
    sudden: float = 0.25
    """Relative change that starts a new solution at once; smaller ones wait for one more estimate."""


@dataclasses.dataclass(frozen=True)
class CardConfig:
    """Tests that a card must pass before its white is used."""

    least_cells: int = 4
    """Least number of visible white cells, and of ink cells."""
    least_contrast: float = 2.5
    """Median ratio of paper to ink: print has 10 to 30, blur and veiling glare lower it."""
    darker: float = 1.6
    """Ratio from which an ink cell is darker than the paper beside it."""
    least_share: float = 0.75
    """Least share of such ink cells."""
    held: int = 15
    """Number of estimates, about five a second, for which found light is kept while something hides the card."""


@dataclasses.dataclass(frozen=True)
class EvidenceConfig:
    """Errors of an estimate's evidence, and the share of the estimate that is kept under them."""

    directions: int = 32
    """Number of directions of irradiance."""
    lever: float = 2.0
    """Largest share of light missing from all directions, over the share missing at the card, which measures light
    at grazing angles poorly."""
    response: float = 0.016
    """Standard deviation of the logarithm of the response's exponent."""
    white: float = 0.016
    """The same of the card's reflectance."""
    ball: float = 0.016
    """The same of the ball's."""
    usual_contrast: float = 30.0
    """Largest ratio of paper to ink of known prints; a larger one shows that the response is steeper than assumed."""
    doubt: float = 2.0
    """Standard deviation of the card's logarithm per logarithm of contrast beyond that."""
    found: float = 0.75
    """Relative error of the recovered light, in both directions."""
    capture: float = 0.35
    """Relative error of the irradiance as captured, downward: the ball's reflectance, the unseen cone, the
    response. This, the next and ``clipped`` hold in 19 of 20 of the tables of ``bench_never_worse``."""
    overlooked: float = 2.0
    """The same upward: emitters that are too small for the ball's pixels, or saturate unnoticed."""
    clipped: float = 250.0
    """Bound of the mean radiance of clipped light without other evidence; 19 of 20 rooms have less."""


@dataclasses.dataclass(frozen=True)
class ShadowConfig:
    """Test that recovered light reaches the ball (``ball_shadow.py``)."""

    beside: float = 2.0
    """Distance in radii within which light that passes the ball tests for the ball's own shadow."""
    beside_share: float = 0.5
    """Least share of such light in the light added at a tested point."""
    across: float = 3.5
    """Distance in radii of light for points that measure the shadow's contrast."""
    elsewhere: float = 0.1
    """Largest share of such light at points that measure the plane's brightness outside the shadow."""
    points: int = 8
    """Least number of points, here and elsewhere."""
    believed: float = 0.1
    """Quantile of the likelihood at which the share of light is taken."""
    scatter: float = 0.05
    """Least standard deviation of a point's logarithm: transport outside the model.

    With 0.03 to 0.08 the same of the tables of ``bench_never_worse`` that are worse without this are not with it."""
    level: float = 0.05
    """The same for a plane's level from place to place, in addition to its points' scatter."""
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
