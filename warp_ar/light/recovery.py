"""Light that clipping lost in the ball, found again from surfaces that the same light falls on.

**Unknowns.** Cells of the environment that clip (``kernels/recover.py``) are grouped to regions: connected ones, split
where they are wider than ``REGION`` steradians. Region r lacks the radiance s_r >= 0, per channel, on top of what the
ball shows. Beside regions stand *peaks*: lamps or a sun within a region, or where no ball sees, each with its power p_j
>= 0 (radiance times solid angle, as seen from the ball), a direction and a distance. A surface k has the unknown
reflectance 1 / u_k; the card's is known.

**Equations.** A surface point x that shows the radiance L receives

    pi L(x) u_k = e(x) + sum_r a_r(x) s_r + sum_j b_j(x) p_j,     e = T radiance,  a_r = T clipped over the cells of r,

linear in the unknowns, none of which is negative. Divided by pi L and by u's last estimate a residual is a relative
error: the surface's texture, transport that the model leaves out; how large it is, points of a surface say by how far
they scatter (``measured_noise``). Points that clip bind from one side only: they count
while the prediction is under what they show. Where the card clips in whole, the sum of the energy has a lower bound
only, and the estimate says so; ink, a twentieth as bright, and surfaces in shadow then carry it as far as priors on
their reflectances allow.

**Priors** decide what surfaces do not see. A region's s_r scatters about the mean of its connected component, that
about one mean of all, times (solid angle)^-1/2: halfway between lamps of equal radiance and lamps of equal power, for
what is small and still clips tends to be brighter than what is wide. The common mean is free; where nothing but the
card is used it is what makes the card right, and that alone is the method ``white_card``. Clipped pixels that show a
modelled surface (the card in the ball, a box) are lit, not lights: they stay close to clipping. Channels share their
distribution: a second pass draws each to the mean of all three, in the hue of their totals.

**Peaks** are chosen one by one, among all directions that may lack light and a grid of distances, by how far they
lower the cost to second order, (b' W r)^2 / (b' W b - b' W Z H^-1 Z' W b); the best few are fitted in earnest, then
moved to neighbouring cells and distances while that helps, and kept if the cost falls by more than ``EVIDENCE``. A
lamp at the distance D lights x by cos D^2 / |p - x|^2: its shadows and the falling off of its light tell D. D counts
from where the ball mirrors the lamp to the camera, which may lie a ball's radius beside its middle. A lamp that is
known moves only for a larger gain: lamps stand still.

Every deviation is relative to an unknown, a mean or a reflectance. The derivative with respect to that unknown is kept:
without it, the more parts and equations there are, the more all of them would shrink together.

**Solution.** Iteratively reweighted least squares with Cauchy weights; each quadratic problem with non-negative
unknowns is solved by an active set that starts from the last solution. Some 400 equations and 60 unknowns. Equal input
gives equal output.
"""

from __future__ import annotations

import dataclasses
import enum
import functools
import threading
from collections.abc import Callable, Sequence
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

from warp_ar.input.marker_pattern import printed_cells
from warp_ar.kernels.recover import LOST, SurfacePoint
from warp_ar.scene import Scene
from warp_ar.scene.geometry import rotation_matrix

Array = NDArray[np.float64]

METHODS: Final = ("clipped", "white_card", "shading")

REGION: Final = 0.12
"""Steradians: a region wider than this (22 degrees across) is split."""
EXPONENT: Final = -0.5
"""Of the solid angle, in the radiance that a component is expected to have."""
SPREAD: Final = 0.8
"""Relative standard deviation of components about the common mean."""
INSIDE: Final = 0.7
"""Relative standard deviation of regions about their component's mean."""
HUE: Final = 0.5
"""Relative standard deviation of one channel's distribution about that of all."""
LEAST: Final = 0.3
"""Radiance below which relative deviations are no longer relative."""
SURFACE_EXCESS: Final = 0.5
"""Radiance above clipping (standard deviation) of modelled surfaces."""
TIE: Final = 0.06
"""Relative standard deviation between the reflectances of one box's faces."""
EVIDENCE: Final = 7.0
"""Fall of the cost (twice a log likelihood) that a peak must be worth."""
BETTER: Final = 0.1
"""Fall of the cost for which a peak that is being added goes to a neighbouring place."""
WORTH_MOVING: Final = 1.0
"""The same for a peak that was known before: lamps stand still, and what differs from view to view is noise.

With ``BETTER``, a lamp of ``torus`` wanders to where another comes on, a quarter of a metre from the ball.
"""
PEAKS: Final = 4
"""Most peaks at a time."""
SEARCH_EVERY: Final = 2
"""Estimates between searches for one more peak; the first searches for all."""
LATER_EVERY: Final = 6
"""The same once as many estimates as ``SETTLED`` were made."""
SETTLED: Final = 10
"""Estimates, from several views, after which lamps are taken for found, and light that stays as it is for known."""
FIRST: Final = 5
"""Estimates in which searches try as many directions as they ever do."""
MOST_CANDIDATES: Final = 160
"""Directions that are tried for a peak at first."""
LATER_CANDIDATES: Final = 40
"""Directions that are tried in a later search, others each time."""
DISTANCES: Final = np.array([2.0, 1.2, 0.8, 0.6, 0.45, 0.35])
"""Metres from the ball that are tried for a lamp, beside infinity."""
NEAREST: Final = 0.25
"""Metres from the ball within which no lamp is looked for: it would stand in the picture, in front of the desk."""
PEAK_ANGLE: Final = 0.12
"""Radians around a peak's direction that share its light."""
LAMP_SHARE: Final = 0.06
"""Radius of a lamp as a share of its distance: of a disc as wide as a cell."""
MIRROR_TRUST: Final = 0.5
"""Relative standard deviation of light that comes by way of a ball: dents, scratches and dust scatter it."""
ITERATIONS: Final = 6
WARM_ITERATIONS: Final = 3
STILL: Final = 0.02
"""Relative change, of surfaces or of the environment, below which the light is the same."""
REST: Final = 4
"""Most estimates in a row that are left out while the light is the same: a moving camera shows more."""
SUDDEN: Final = 0.25
"""Relative change that is solved for at once; what changes less may wait for one more estimate."""
CONVERGED: Final = 1.0e-3
"""Relative change of the largest unknown, in one reweighting, from which on nothing more is gained."""
DARK: Final = 0.005
"""pi times radiance below which a point says nothing: quantisation."""


class Kind(enum.IntEnum):
    """What a surface point lies on."""

    CARD = 0
    """White paper: its reflectance is known."""
    INK = 1
    """The marker's black cells."""
    PLANE = 2
    """A plane proxy, textured as tables are."""
    FACE = 3
    """One face of a box proxy."""


GRID: Final = 0.06
"""Metres between points on planes."""
_NOISE: Final = np.array([0.02, 0.04, 0.12, 0.04])
"""Relative standard deviation of one equation, by kind, where points scatter so much or are too few to tell."""
LEAST_NOISE: Final = 0.015
"""The same of the most even surface: transport that the model leaves out."""
SCATTER_POINTS: Final = 12
"""Points of a surface that tell how much they scatter."""
SCATTER_ITERATIONS: Final = 5
"""Of reweighting by which shadows and stains are left out of that."""
_SHARED: Final = np.array([4.0, 8.0, 2.0, 3.0])
"""Equations that share one error of transport that the model leaves out, by kind, however far apart."""
_TEXTURE: Final = np.array([0.0, 0.0, 0.03, 0.03])
"""Metres within which texture varies little, by kind: points that are closer share its error as well."""
_REFLECTANCE: Final = np.array([0.85, 0.04, 0.35, 0.35])
"""Expected reflectance, by kind; the scene knows the card's."""
_REFLECTANCE_SPREAD: Final = np.array([0.005, 0.4, 0.6, 0.6])
"""Standard deviation of its logarithm."""
_HUE_SPREAD: Final = np.array([0.005, 0.1, 0.4, 0.4])
"""Standard deviation of its logarithm about that in another channel: paper is white and ink grey."""


@dataclasses.dataclass(frozen=True)
class Surfaces:
    """Surface points of a scene, all in the world's frame."""

    points: NDArray[Any]
    """Records of ``SurfacePoint``, (n,)."""
    surface: NDArray[np.int64]
    """Surface of each point, (n,)."""
    kinds: NDArray[np.int64]
    """``Kind`` of each surface, (surfaces,)."""
    groups: NDArray[np.int64]
    """Number of the object that a surface belongs to, (surfaces,): faces of one box share it."""
    overlap: NDArray[np.float32]
    """How far points share their surface's texture, 0 to 1, (n, n)."""


@dataclasses.dataclass(frozen=True)
class Lamp:
    """A source of light that was found by what it does."""

    origin: Array
    """Where on the ball the camera sees it mirrored, metres, (3,)."""
    direction: Array
    """Unit, from there, (3,)."""
    distance: float
    """Metres from there; infinite where none was found."""
    power: Array
    """Radiance times solid angle as seen from the ball, per channel, beyond what the map shows, (3,)."""


@dataclasses.dataclass(frozen=True)
class Estimate:
    """What clipping took, as far as one frame tells."""

    excess: NDArray[np.float32]
    """Radiance that a wholly clipped texel lacks, (rows, columns, 3) of cells."""
    lower_bound: tuple[bool, bool, bool]
    """Channels in which the card clips or is not seen: there the total is a lower bound, or rests on priors."""
    lamps: tuple[Lamp, ...] = ()
    """Peaks, by falling power."""


Trace = Callable[[NDArray[np.float32]], Array]
"""Irradiance at every surface point per unit intensity of lamps (q, 4: position, radius), (n, q)."""


class _OneBlasThread:
    """NumPy's BLAS on one thread: products here take microseconds, and waking threads for them more.

    The number belongs to the process. Where several solvers are at work the first sets it, the last sets it back.
    """

    def __init__(self) -> None:
        self._lock, self._inside = threading.Lock(), 0

    @functools.cached_property
    def _controller(self) -> ThreadpoolController:
        """What finds the libraries; to look for them takes as long as four fits."""
        return ThreadpoolController()

    def __enter__(self) -> None:
        with self._lock:
            if self._inside == 0:
                self._limit = self._controller.limit(limits=1, user_api="blas")
            self._inside += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._inside -= 1
            if self._inside == 0:
                self._limit.restore_original_limits()


_ONE_BLAS_THREAD = _OneBlasThread()


# ---- surface points --------------------------------------------------------------------------------------------------


class _Collector:
    def __init__(self) -> None:
        self.rows: list[tuple[Array, Array, Array, float]] = []
        self.surface: list[int] = []
        self.kinds: list[int] = []
        self.groups: list[int] = []

    def add(
        self, positions: Sequence[Array], normal: Array, tangent: Array, half: float, kind: Kind, group: int
    ) -> None:
        self.rows += [(position, normal, tangent, half) for position in positions]
        self.surface += [len(self.kinds)] * len(positions)
        self.kinds.append(kind)
        self.groups.append(group)

    def result(self) -> Surfaces:
        points = np.zeros(len(self.rows), np.dtype(SurfacePoint.numpy_dtype()))
        for column, name in enumerate(("position", "normal", "tangent", "half")):
            points[name] = [row[column] for row in self.rows]
        surface, kinds = np.array(self.surface), np.array(self.kinds)
        overlap = texture_overlap(points["position"], surface, kinds[surface])
        return Surfaces(points, surface, kinds, np.array(self.groups), overlap)


def find_surfaces(scene: Scene, *, card_only: bool = False) -> Surfaces:
    """Points on everything physical that the scene models: the printed card, planes and boxes.

    On the card: the centres of all cells, and its quiet zone. On planes: rings around each ball, where its shadow and
    reflection fall, and a grid around the origin; not on the card (whose size beyond the quiet zone is not known) and
    not under boxes. On boxes: 5 x 5 per face.

    Args:
        scene: What is modelled.
        card_only: Leave out all but the card's paper.
    """
    found = _Collector()
    cells, white, side, outline = printed_cells(scene.marker)
    z, x = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
    low, high = outline.min(axis=0)[:2], outline.max(axis=0)[:2]
    along = np.linspace(0.0, 1.0, 8, endpoint=False)[:, None]
    corners = np.array([[low[0], high[1]], high, [high[0], low[1]], low]) + 0.5 * side * np.array(
        [[-1, 1], [1, 1], [1, -1], [-1, -1]]
    )
    ring = np.concatenate([a + along * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])
    paper = [*cells[white], *np.column_stack([ring, np.zeros(len(ring))])]
    found.add(paper, z, x, 0.3 * side, Kind.CARD, 0)
    if card_only:
        return found.result()
    found.add(list(cells[~white]), z, x, 0.3 * side, Kind.INK, 1)
    margin = 0.3 * float((high - low).max())
    for number, proxy in enumerate(scene.proxies):
        rotation, at = rotation_matrix(proxy.rotate), np.array(proxy.at)
        if proxy.shape == "plane":
            half = 0.5 * np.array(proxy.size)
            places = [np.stack(np.meshgrid(*2 * [np.arange(-0.45, 0.451, GRID)]), -1).reshape(-1, 2)]
            turn = np.arange(24) * np.pi / 12
            for probe in scene.probes:
                middle = (rotation.T @ (np.array(probe.center) - at))[:2]
                radii = probe.radius * np.geomspace(0.6, 7.0, 11)
                rings = radii[:, None, None] * np.stack([np.cos(turn), np.sin(turn)], -1)
                places.append(middle + rings.reshape(-1, 2))
            local = np.concatenate(places)
            local = local[(np.abs(local) < half).all(axis=1)]
            points = at + np.column_stack([local, np.zeros(len(local))]) @ rotation.T
            flat = np.abs(points[:, 2]) < 0.02
            card = flat & (points[:, :2] > low - margin).all(axis=1) & (points[:, :2] < high + margin).all(axis=1)
            points = points[~card & ~_in_boxes(scene, points)]
            found.add(list(points), rotation[:, 2], rotation[:, 0], 0.004, Kind.PLANE, 2 + number)
        elif proxy.shape == "box":
            half = 0.5 * np.array(proxy.size)
            steps = (np.arange(5) + 0.5) / 2.5 - 1.0
            for axis in range(3):
                u, v = (axis + 1) % 3, (axis + 2) % 3
                for sign in (-1.0, 1.0):
                    face = np.zeros((25, 3))
                    face[:, axis] = sign * half[axis]
                    face[:, u], face[:, v] = np.repeat(steps, 5) * half[u], np.tile(steps, 5) * half[v]
                    size = 0.12 * float(min(half[u], half[v]))
                    face_points = list(at + face @ rotation.T)
                    found.add(face_points, sign * rotation[:, axis], rotation[:, u], size, Kind.FACE, 2 + number)
    return found.result()


def _in_boxes(scene: Scene, points: Array) -> NDArray[np.bool_]:
    inside = np.zeros(len(points), bool)
    for proxy in scene.proxies:
        if proxy.shape == "box":
            local = (points - np.array(proxy.at)) @ rotation_matrix(proxy.rotate)
            inside |= (np.abs(local) < 0.5 * np.array(proxy.size) + 0.005).all(axis=1)
    return inside


def texture_overlap(
    positions: NDArray[Any], surface: NDArray[np.int64], kind: NDArray[np.int64]
) -> NDArray[np.float32]:
    """How far points share their surface's texture, 0 to 1, (n, n); 0 where its kind has none.

    Args:
        positions: Of the points, metres, (n, 3).
        surface: That each lies on, (n,).
        kind: ``Kind`` of that surface, (n,).
    """
    overlap = np.zeros((len(surface), len(surface)), np.float32)
    for number in np.unique(surface):
        own = np.flatnonzero(surface == number)
        reach = _TEXTURE[kind[own[0]]]
        if reach > 0.0:
            at = positions[own].astype(float)
            overlap[np.ix_(own, own)] = np.exp(-np.linalg.norm(at[:, None] - at, axis=2) / reach)
    return overlap


def measured_noise(
    points: NDArray[Any], surface: NDArray[np.int64], kinds: NDArray[np.int64], light: Array, exact: NDArray[np.bool_]
) -> Array:
    """Relative standard deviation of one equation, by surface: how far its points scatter about a smooth course.

    The course is a quadratic in the surface's own coordinates, of the logarithm: a lamp's light falls off like that.
    An even box or card says more than a table's texture, and more than all boxes and cards would have it.

    Args:
        points: Records of ``SurfacePoint``, (n,).
        surface: That each lies on, (n,).
        kinds: ``Kind`` of each surface, (surfaces,).
        light: pi times the radiance that each shows, (n, 3).
        exact: Where that does not clip and says something, (n, 3).

    Returns:
        Between ``LEAST_NOISE`` and what is usual for the kind, (surfaces,).
    """
    noise = np.array(_NOISE[kinds])
    for number in range(len(kinds)):
        own = np.flatnonzero((surface == number) & exact.all(axis=1))
        if len(own) < SCATTER_POINTS:
            continue
        at, normal, tangent = (points[name][own].astype(float) for name in ("position", "normal", "tangent"))
        places = np.column_stack([(at * axis).sum(axis=1) for axis in (tangent, np.cross(normal, tangent))])
        u, v = ((places - places.mean(axis=0)) / np.maximum(places.std(axis=0), 1e-9)).T
        terms = np.column_stack([np.ones(len(own)), u, v, u * u, u * v, v * v])
        logs = np.log(light[own]).mean(axis=1)
        weights = np.ones(len(own))
        for _ in range(SCATTER_ITERATIONS):
            course = np.linalg.lstsq(terms * weights[:, None], logs * weights, rcond=None)[0]
            off = np.abs(logs - terms @ course)
            scatter = 1.4826 * float(np.median(off))
            weights = 1.0 / np.sqrt(1.0 + (off / (2.0 * scatter + 1e-6)) ** 2)
        scatter *= np.sqrt(len(own) / (len(own) - terms.shape[1]))
        noise[number] = np.clip(scatter, LEAST_NOISE, noise[number])
    return noise


def shared_errors(overlap: NDArray[np.float32], kind: NDArray[np.int64], seen: NDArray[np.bool_]) -> Array:
    """Number of equations that share the error of each of the points that are seen.

    Args:
        overlap: From ``texture_overlap``, (n, n).
        kind: ``Kind`` of each point's surface, (n,).
        seen: Points that have an equation, (n,).
    """
    return np.asarray(np.maximum(_SHARED[kind], overlap @ seen.astype(np.float32))[seen])


def mirroring_points(directions: Array, center: Array, radius: float, camera: Array | None) -> Array:
    """Where on a ball a camera far away sees what lies in each direction, (m, 3).

    Args:
        directions: Unit, (m, 3).
        center: Of the ball, metres, (3,).
        radius: Of the ball, metres.
        camera: Where it stands, metres, (3,); None: the centre for all.
    """
    if camera is None:
        return np.broadcast_to(center, directions.shape)
    view = (camera - center) / np.linalg.norm(camera - center)
    halfway = directions + view
    return np.asarray(center + radius * halfway / np.maximum(np.linalg.norm(halfway, axis=1, keepdims=True), 1e-3))


# ---- regions ---------------------------------------------------------------------------------------------------------


def connected_regions(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Connected part that each cell of a latlong mask belongs to, across the seam and the poles; -1 for none."""
    height = len(mask)
    count, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    parent = list(range(count))

    def root(label: int) -> int:
        while parent[label] != label:
            label = parent[label]
        return label

    for row in range(height):
        for other in range(max(row - 1, 0), min(row + 2, height)):
            if labels[row, -1] and labels[other, 0]:
                parent[root(int(labels[row, -1]))] = root(int(labels[other, 0]))
    for row in (0, height - 1):
        at_pole = [int(label) for label in np.unique(labels[row]) if label]
        for label in at_pole[1:]:
            parent[root(label)] = root(at_pole[0])
    roots = np.array([root(label) for label in range(count)])
    number = np.full(count, -1)
    number[np.unique(roots[1:])] = np.arange(len(np.unique(roots[1:])))
    return np.asarray(number[roots][labels], np.int64)


def split_regions(
    labels: NDArray[np.int64], directions: Array, solid_angles: Array, size: float = REGION
) -> tuple[NDArray[np.int64], int]:
    """Split regions that are wider than ``size`` steradians into compact parts of about that size.

    Args:
        labels: Region of each cell, -1 for none, (m,).
        directions: Unit, (m, 3).
        solid_angles: (m,).
        size: Steradians.

    Returns:
        Part of each cell, -1 for none, and the number of parts.
    """
    parts = np.full(len(labels), -1)
    count = 0
    for region in range(int(labels.max(initial=-1)) + 1):
        index = np.flatnonzero(labels == region)
        d, weights = directions[index], solid_angles[index]
        pieces = max(1, int(np.ceil(weights.sum() / size)))
        centres = [d[np.argmax(d @ d.mean(axis=0))]]
        while len(centres) < pieces:
            centres.append(d[np.argmin((d @ np.array(centres).T).max(axis=1))])
        middle = np.array(centres)
        nearest = np.zeros(len(d), np.int64)
        for _ in range(8 if pieces > 1 else 1):
            nearest = np.argmax(d @ middle.T, axis=1)
            sums = np.stack([np.bincount(nearest, weights * d[:, axis], minlength=pieces) for axis in range(3)], -1)
            lengths = np.linalg.norm(sums, axis=1, keepdims=True)
            middle = np.where(lengths > 0, sums / np.maximum(lengths, 1e-12), middle)
        for piece in np.unique(nearest):
            parts[index[nearest == piece]] = count
            count += 1
    return parts, count


# ---- the least-squares problem ---------------------------------------------------------------------------------------


def solve_nonnegative(hessian: Array, gradient: Array, start: Array | None = None) -> Array:
    """Minimise x' H x / 2 - g' x over x >= 0.

    Block pivoting: free unknowns that turn negative are held at zero; once none does, held ones that pull upward are
    let go.

    Args:
        hessian: H, positive definite, (n, n).
        gradient: g, (n,).
        start: Solution of a similar problem: its positive unknowns start free.
    """
    free = np.ones(len(gradient), bool) if start is None else start > 0.0
    x = np.zeros(len(gradient))
    tolerance = 1e-9 * float(np.abs(gradient).max(initial=0.0))
    for _ in range(60):
        x[:] = 0.0
        index = np.flatnonzero(free)
        if len(index):
            x[index] = np.linalg.solve(hessian[np.ix_(index, index)], gradient[index])
        negative = free & (x < 0.0)
        if negative.any():
            free &= ~negative
            continue
        pulled = ~free & (hessian @ x - gradient < -tolerance)
        if not pulled.any():
            break
        free |= pulled
    return np.maximum(x, 0.0)


@dataclasses.dataclass(frozen=True)
class _Peak:
    cell: int
    distance: float


@dataclasses.dataclass
class _Fit:
    """A solution and the quadratic problem that it solves."""

    z: Array
    cost: float
    rows: NDArray[np.int64]
    matrix: Array
    target: Array
    weights: Array
    hessian: Array


class _Problem:
    """The equations of one frame."""

    def __init__(
        self,
        cells: NDArray[Any],
        transfer: NDArray[Any],
        mirrored: NDArray[Any],
        observations: NDArray[Any],
        surfaces: Surfaces,
        white: float,
        trace: Trace | None,
        origin: Array,
    ) -> None:
        self.shape = cells.shape
        self.radiance = cells["radiance"].reshape(-1, 3).astype(float)
        self.lost = cells["clipped"].reshape(-1, 3).astype(float)
        self.lacking = cells["lacking"].reshape(-1, 3).astype(float)
        self.direction = cells["direction"].reshape(-1, 3).astype(float)
        self.solid_angle = cells["solid_angle"].ravel().astype(float)
        modelled = cells["modelled"].ravel() > 0.5
        clipped = self.lost.max(axis=1) - cells["hidden"].ravel()
        self.may_hold_peak = (self.lost.max(axis=1) > 0.1) & ~modelled
        self._trace, self.origin = trace, origin
        self._traced: dict[_Peak, Array] = {}

        # What clips on modelled surfaces is not joined to what clips beyond.
        beyond = connected_regions(((clipped > LOST) & ~modelled).reshape(self.shape)).ravel()
        lit = connected_regions(((clipped > LOST) & modelled).reshape(self.shape)).ravel()
        component = np.where(lit >= 0, lit + beyond.max(initial=-1) + 1, beyond)
        self.part, self.parts = split_regions(component, self.direction, self.solid_angle)
        self.components = int(component.max(initial=-1)) + 1
        first = np.unique(self.part, return_index=True)[1][int((self.part < 0).any()) :]
        self.component = component[first]
        inside = component >= 0
        weights = (self.solid_angle * clipped)[inside]
        area = np.bincount(component[inside], weights, minlength=self.components)
        is_surface = np.bincount(component[inside], modelled[inside], minlength=self.components) > 0
        self.expected = np.where(is_surface, 0.0, (area + 0.01) ** EXPONENT)
        self.is_surface = is_surface[self.component]
        self.member = np.zeros((len(component), self.parts))
        self.member[np.flatnonzero(inside), self.part[inside]] = 1.0

        seen = observations["visible"] > 0.8
        self.index = np.flatnonzero(seen)
        shown = observations[seen]
        self.surface = surfaces.surface[seen]
        self.kinds, self.groups, self.white = surfaces.kinds, surfaces.groups, white
        self.kind = self.kinds[self.surface]
        self.shared = shared_errors(surfaces.overlap, surfaces.kinds[surfaces.surface], seen)
        through_balls = mirrored[seen]
        self.transfer = transfer[seen]
        # What clips in a cell lies off its middle, for which transfer was traced.
        lamps = np.flatnonzero((clipped > LOST) & ~modelled)
        normals = surfaces.points["normal"][seen]
        cosine = normals @ cells["middle"].reshape(-1, 3)[lamps].T
        turned = np.clip(normals @ cells["direction"].reshape(-1, 3)[lamps].T, 0.0, 2.0 * np.maximum(cosine, 0.0))
        self.transfer[:, lamps] *= np.where(cosine > 0.0, turned / np.maximum(cosine, 1e-6), 1.0)
        self.transfer += through_balls
        self.light = np.pi * shown["radiance"].astype(float)
        # Patches on a clutter's edge, or half in a sharp shadow, say nothing.
        even = np.pi * shown["deviation"] < 0.25 * self.light + 0.01
        self.exact = (self.light > DARK) & even & (shown["clipped"] < 0.01)
        self.bound = shown["clipped"] > 0.5
        self.noise = measured_noise(surfaces.points[seen], self.surface, self.kinds, self.light, self.exact)
        # With what clips taken to be some ten times as bright: only the order of magnitude matters.
        bright = (self.radiance + 10.0 * self.lacking * self.radiance).mean(axis=1)
        sums = self.transfer @ np.column_stack([self.radiance, bright]).astype(np.float32)
        self.captured = sums[:, :3]
        mirrored_sums = through_balls @ bright.astype(np.float32)
        self.mirrored_share = mirrored_sums / np.maximum(sums[:, 3], 1e-9)
        order = np.argsort(self.part, kind="stable")[np.count_nonzero(self.part < 0) :]
        starts = np.unique(self.part[order], return_index=True)[1]
        columns = [np.zeros((len(self.index), 0))] * 3
        if self.parts:
            sent = self.transfer[:, order]
            columns = [np.add.reduceat(sent * self.lacking[order, c], starts, axis=1) for c in range(3)]
        self.columns = np.stack(columns)
        self.peaks: list[_Peak] = []
        self.peak_columns = np.zeros((3, len(self.index), 0))
        self.ties = [
            (a, b)
            for a in range(len(self.kinds))
            for b in range(a)
            if self.kinds[a] == Kind.FACE and self.kinds[b] == Kind.FACE and self.groups[a] == self.groups[b]
        ]

    def card_means(self) -> tuple[Array, tuple[bool, bool, bool]]:
        """Common mean per channel that makes the card right, and whether that is a lower bound only."""
        means, bounds = np.zeros(3), [False] * 3
        expected = self.expected[self.component]
        card = self.kind == Kind.CARD
        for c in range(3):
            use = card & self.exact[:, c]
            if use.sum() < max(3.0, 0.3 * card.sum()):
                bounds[c] = True
                use = card & (self.exact[:, c] | self.bound[:, c])
            gain = self.columns[c][use] @ expected
            if not gain.any():
                continue
            irradiance = self.light[use, c] / self.white
            missing = irradiance - self.captured[use, c]
            mean = max(0.0, float(np.median(missing) / np.median(gain))) if np.median(gain) > 0 else 0.0
            for _ in range(10):
                weights = 1.0 / (1.0 + ((missing - gain * mean) / (0.03 * irradiance)) ** 2) / irradiance**2
                mean = max(0.0, float((weights * gain * missing).sum() / (weights * gain**2).sum()))
            means[c] = mean
        return means, (bounds[0], bounds[1], bounds[2])

    # Unknowns stand in this order: parts, peaks, means of components, the common mean, 1 / reflectance of each surface.

    @property
    def first_mean(self) -> int:
        """Place of the first component's mean."""
        return self.parts + len(self.peaks)

    @property
    def first_surface(self) -> int:
        """Place of the first surface's 1 / reflectance."""
        return self.first_mean + self.components + 1

    def start(self, mean: float) -> Array:
        """Unknowns as the card alone has them; surfaces are left open (0)."""
        z = np.zeros(self.first_surface + len(self.kinds))
        z[: self.parts] = mean * self.expected[self.component]
        z[self.first_mean : self.first_surface - 1] = mean * self.expected
        z[self.first_surface - 1] = mean
        return z

    def with_peak(self, z: Array) -> Array:
        """Unknowns of a problem with one peak less, and that peak at zero."""
        return np.insert(z, self.first_mean - 1, 0.0)

    def fit(self, c: int, z: Array, iterations: int, centre: Array | None = None, other: Array | None = None) -> _Fit:
        """Solve for one channel from a start.

        Args:
            c: Channel.
            z: Unknowns to start from.
            iterations: Of reweighting.
            centre: Draws parts and peaks to itself instead of to means.
            other: Unknowns of a channel that is known better: surfaces are of about that reflectance.
        """
        parts, mean_at, u_at = self.parts, self.first_mean, self.first_surface
        count = len(self.kinds)
        usable = np.bincount(self.surface[self.exact[:, c]], minlength=count) >= 4
        known = self.kind == Kind.CARD
        rows = np.flatnonzero(
            (self.exact[:, c] & (usable[self.surface] | known))
            | (self.bound[:, c] & usable[self.surface])
            | (self.bound[:, c] & known)
        )
        light, surface = self.light[rows, c], self.surface[rows]
        exact = self.exact[rows, c]
        matrix = np.zeros((len(rows), len(z)))
        matrix[:, :parts] = self.columns[c][rows] / light[:, None]
        matrix[:, parts:mean_at] = self.peak_columns[c][rows] / light[:, None]
        matrix[np.arange(len(rows)), u_at + surface] = -1.0
        target = -self.captured[rows, c] / light

        prior_u = np.where(self.kinds == Kind.CARD, 1.0 / self.white, 1.0 / _REFLECTANCE[self.kinds])
        spread_u = _REFLECTANCE_SPREAD[self.kinds]
        if other is not None:
            prior_u, spread_u = other[-count:], _HUE_SPREAD[self.kinds]
        z = z.copy()
        if not z[u_at:].any():
            ratio = matrix[:, :mean_at] @ z[:mean_at] - target
            z[u_at:] = prior_u
            for k in np.flatnonzero(usable & (self.kinds != Kind.CARD)):
                z[u_at + k] = max(float(np.median(ratio[exact & (surface == k)])), 1e-3)

        prior = np.zeros((mean_at + self.components + 1 + len(self.ties), len(z)))
        prior_target = np.zeros(len(prior))
        own = np.arange(mean_at + self.components + 1)
        prior[own, own] = 1.0
        if centre is None:
            free = np.flatnonzero(~self.is_surface)
            prior[free, mean_at + self.component[free]] = -1.0
            prior[mean_at : mean_at + self.components, u_at - 1] = -self.expected
        else:
            prior_target[:mean_at] = centre
        for row, (a, b) in enumerate(self.ties, start=len(own)):
            prior[row, u_at + a], prior[row, u_at + b] = 1.0, -1.0

        one_sided = ~exact
        sigma, shared = np.hypot(self.noise[surface], MIRROR_TRUST * self.mirrored_share[rows]), self.shared[rows]
        deviation = np.ones(len(prior))
        hessian = np.zeros((len(z), len(z)))
        weights = np.zeros(len(rows))
        diagonal = np.arange(u_at, len(z))
        for _ in range(iterations):
            u = np.maximum(z[u_at:], 1e-3)
            if centre is None:
                about = np.maximum(z[mean_at : u_at - 1][self.component], LEAST)
                deviation[:parts] = np.where(self.is_surface, SURFACE_EXCESS, INSIDE * about)
                deviation[parts:mean_at] = 10.0 * np.maximum(z[parts:mean_at], LEAST)
            else:
                deviation[:parts] = HUE * np.maximum(centre[:parts], 0.1)
                deviation[parts:mean_at] = HUE * np.maximum(centre[parts:], 0.01)
            deviation[mean_at : u_at - 1] = SPREAD * np.maximum(self.expected * z[u_at - 1], LEAST)
            deviation[u_at - 1] = 3.0 * max(z[u_at - 1], LEAST)
            for row, (a, b) in enumerate(self.ties, start=len(own)):
                deviation[row] = TIE * 0.5 * (u[a] + u[b])
            scaled = prior / deviation[:, None]
            hessian = scaled.T @ scaled
            gradient = scaled.T @ (prior_target / deviation)
            # Log-normal prior of 1 / reflectance, about the last estimate.
            hessian[diagonal, diagonal] += 1.0 / (u * spread_u) ** 2
            gradient[u_at:] += np.maximum(1.0 + np.log(prior_u / u), 0.2) / (u * spread_u**2)
            relative = (matrix @ z - target) / (u[surface] * sigma)
            weights = 1.0 / (1.0 + 0.25 * relative**2) / ((u[surface] * sigma) ** 2 * shared)
            weights[one_sided & (relative > 0.0)] = 0.0
            weighted = weights[:, None] * matrix
            hessian += matrix.T @ weighted
            gradient += weighted.T @ target
            # Deviations are relative: what they are relative to must not shrink for their sake.
            squared = weights * (matrix @ z - target) ** 2
            gradient[u_at:] += np.bincount(surface, squared, minlength=count) / u
            if centre is None:
                off = (scaled @ z) ** 2
                within = np.where(self.is_surface | (about <= LEAST), 0.0, off[:parts])
                gradient[mean_at : u_at - 1] += np.bincount(
                    self.component, within, minlength=self.components
                ) / np.maximum(z[mean_at : u_at - 1], LEAST)
                wide = self.expected * z[u_at - 1] > LEAST
                gradient[u_at - 1] += (off[mean_at : u_at - 1] * wide).sum() / max(z[u_at - 1], LEAST)
            last, z = z, solve_nonnegative(hessian, gradient, z)
            if np.abs(z - last).max() < CONVERGED * np.abs(z).max():
                break
        u = np.maximum(z[u_at:], 1e-3)
        z[u_at:] = u
        relative = (matrix @ z - target) / (u[surface] * sigma)
        relative[one_sided & (relative > 0.0)] = 0.0
        cost = float((4.0 * np.log1p(0.25 * relative**2) / shared).sum())
        cost += float((((prior @ z - prior_target) / deviation) ** 2).sum())
        cost += float(((np.log(u / prior_u) / spread_u) ** 2).sum())
        return _Fit(z, cost, rows, matrix, target, weights, hessian)

    def gains(self, fit: _Fit, c: int, columns: Array) -> Array:
        """Fall of the cost, to second order, if each of ``columns`` (points, q) were added as a free unknown, (q,)."""
        free = fit.z > 0.0
        added = columns[fit.rows] / self.light[fit.rows, c][:, None]
        weighted = fit.weights[:, None] * added
        pull = weighted.T @ (fit.target - fit.matrix @ fit.z)
        overlap = fit.matrix[:, free].T @ weighted
        own = (added * weighted).sum(axis=0)
        own -= (overlap * np.linalg.solve(fit.hessian[np.ix_(free, free)], overlap)).sum(axis=0)
        return np.asarray(np.where(pull > 0.0, pull**2 / np.maximum(own, 1e-9), 0.0), np.float64)

    def power_columns(self, peaks: Sequence[_Peak]) -> Array:
        """Irradiance per unit power of peaks, (points, q)."""
        cells = np.array([peak.cell for peak in peaks])
        distances = np.array([peak.distance for peak in peaks])
        columns: Array = np.asarray(self.transfer[:, cells] / self.solid_angle[cells], np.float64)
        near = [k for k, peak in enumerate(peaks) if np.isfinite(peak.distance)]
        if self._trace is not None and near:
            new = [k for k in near if peaks[k] not in self._traced]
            if new:
                at = self.origin[cells[new]] + distances[new, None] * self.direction[cells[new]]
                lamps = np.column_stack([at, LAMP_SHARE * distances[new]]).astype(np.float32)
                traced = self._trace(lamps)[self.index] * distances[new] ** 2
                self._traced.update((peaks[k], column) for k, column in zip(new, traced.T, strict=True))
            columns[:, near] = np.stack([self._traced[peaks[k]] for k in near], -1)
        return columns

    def patch(self, cell: int) -> Array:
        """Radiance that a unit of a peak's power is, spread over the cells around it that lack light, (m, 3)."""
        near = (self.direction @ self.direction[cell] > np.cos(PEAK_ANGLE)) & self.may_hold_peak
        near[cell] = True
        total = self.solid_angle[near] @ self.lacking[near]
        return np.asarray(near[:, None] / np.maximum(total, 1e-6), np.float64)

    def push(self, peak: _Peak) -> None:
        """Add a peak to the unknowns."""
        patch = self.patch(peak.cell)
        if np.isfinite(peak.distance):
            column = self.power_columns([peak])[:, 0]
            near = patch[:, 0] > 0.0
            block = np.stack([column * (self.lost[near, c].max() > LOST) for c in range(3)])
        else:
            block = np.stack([self.transfer @ (patch[:, c] * self.lacking[:, c]) for c in range(3)])
        self.peaks.append(peak)
        self.peak_columns = np.concatenate([self.peak_columns, block[:, :, None]], axis=2)

    def pop(self) -> None:
        """Take the last peak away."""
        self.peaks.pop()
        self.peak_columns = self.peak_columns[:, :, :-1]

    def tried(self, peak: _Peak, z: Array, c: int, iterations: int) -> _Fit:
        """Fit with one peak more, starting from unknowns without it."""
        self.push(peak)
        fit = self.fit(c, self.with_peak(z), iterations)
        self.pop()
        return fit

    def add_peak(self, fit: _Fit, c: int, candidates: Sequence[_Peak], columns: Array) -> _Fit | None:
        """Add the best peak if it is worth it; returns the new fit, or None."""
        gain = self.gains(fit, c, columns)
        best: tuple[_Peak, float] | None = None
        seen: list[_Peak] = []
        for place in np.argsort(-gain, kind="stable"):
            peak = candidates[place]
            if gain[place] < 0.5 * EVIDENCE or len(seen) == 5:
                break
            if any(
                peak.distance == s.distance and self.direction[peak.cell] @ self.direction[s.cell] > 0.95 for s in seen
            ):
                continue
            seen.append(peak)
            cost = self.tried(peak, fit.z, c, 4).cost
            if best is None or cost < best[1]:
                best = (peak, cost)
        if best is None or best[1] > fit.cost - EVIDENCE:
            return None
        self.push(self.settled(*best, fit, c, BETTER))
        return self.fit(c, self.with_peak(fit.z), ITERATIONS)

    def settled(self, peak: _Peak, cost: float, fit: _Fit, c: int, least: float) -> _Peak:
        """Where a peak that is not among the unknowns of ``fit``, and would lead to ``cost``, does best.

        A step must lower the cost by more than ``least``.
        """
        for _ in range(2):
            around = self.neighbours(peak)
            moved = False
            for place in np.argsort(-self.gains(fit, c, self.power_columns(around)), kind="stable")[:3]:
                other = self.tried(around[place], fit.z, c, 4).cost
                if other < cost - least:
                    peak, cost, moved = around[place], other, True
            if not moved:
                break
        return peak

    def move_peak(self, c: int, mean: float) -> None:
        """Move the first peak to where it does better, if that is nearby; it becomes the last."""
        peak = self.peaks.pop(0)
        self.peak_columns = self.peak_columns[:, :, 1:]
        fit = self.fit(c, self.start(mean), ITERATIONS)
        self.push(self.settled(peak, self.tried(peak, fit.z, c, 4).cost, fit, c, WORTH_MOVING))

    def neighbours(self, peak: _Peak) -> list[_Peak]:
        """Peaks in cells nearby, and at distances nearby."""
        close = np.flatnonzero((self.direction @ self.direction[peak.cell] > np.cos(0.2)) & self.may_hold_peak)
        found = [_Peak(int(cell), peak.distance) for cell in close]
        if np.isfinite(peak.distance):
            nearby = [peak.distance * factor for factor in (0.83, 0.91, 1.1, 1.2)]
            found += [_Peak(peak.cell, distance) for distance in nearby if distance > NEAREST]
        return found

    def find_peaks(self, c: int, z: Array, most: int, *, candidates: int = MOST_CANDIDATES, turn: int = 0) -> Array:
        """Add up to ``most`` peaks; returns the unknowns. Each ``turn`` tries other directions, if few at a time."""
        fit = self.fit(c, z, ITERATIONS)
        cells = np.flatnonzero(self.may_hold_peak)
        if len(cells) == 0 or most < 1:
            return fit.z
        step = -(-len(cells) // candidates)
        cells = cells[turn % step :: step]
        distances = [np.inf, *DISTANCES] if self._trace is not None else [np.inf]
        peaks = [_Peak(int(cell), float(distance)) for distance in distances for cell in cells]
        columns = self.power_columns(peaks)
        for _ in range(most):
            better = self.add_peak(fit, c, peaks, columns)
            if better is None:
                break
            fit = better
        return fit.z


class Recovery:
    """Estimates what clipping took, frame by frame; keeps the lamps that it found."""

    def __init__(
        self,
        surfaces: Surfaces,
        white: float,
        center: Sequence[float],
        *,
        radius: float = 0.0,
        method: str = "shading",
    ) -> None:
        """Prepare.

        Args:
            surfaces: From ``find_surfaces``.
            white: Reflectance of the card's paper.
            center: Centre of the ball, metres.
            radius: Of the ball, metres: lamps are seen from its surface. 0: from its centre.
            method: ``white_card`` or ``shading``.

        Raises:
            ValueError: There is no such method.
        """
        if method not in METHODS[1:]:
            raise ValueError(f"recover: no method {method!r} to estimate; expected {' or '.join(METHODS[1:])}")
        self.surfaces, self.method = surfaces, method
        self._white, self._center, self._radius = white, np.array(center, float), radius
        self._peaks: list[_Peak] = []
        self._frames = 0
        self._rested = 0
        self._seen: tuple[Array, Array, NDArray[np.bool_]] | None = None

    def rests(self, cells: NDArray[Any], observations: NDArray[Any]) -> bool:
        """Whether the last estimate still holds, as far as the light tells: then there is nothing to solve for.

        Takes note of what it is given, unless it holds.

        Args:
            cells: As for ``update``.
            observations: As for ``update``.
        """
        environment = cells["solid_angle"][..., None] * cells["radiance"].astype(float)
        shown = observations["radiance"].mean(axis=1).astype(float)
        told = (observations["visible"] > 0.8) & (observations["clipped"].max(axis=1) < 0.01) & (np.pi * shown > DARK)
        before, self._rested = self._seen, self._rested + 1
        if before is not None and self._frames >= SETTLED and (told & before[2]).any():
            both = told & before[2]
            # The sum of what changed, not of changes: which of two cells sees a window's edge varies by itself.
            moved = np.abs((environment - before[0]).sum(axis=(0, 1))).max() / max(
                environment.sum(axis=(0, 1)).max(), 1e-9
            )
            ratio = np.log(shown[both] / before[1][both])
            moved = max(moved, abs(float(np.median(ratio))), 0.5 * float(np.quantile(np.abs(ratio), 0.8)))
            if self._rested <= (REST if moved < STILL else 1 if moved < SUDDEN else 0):
                return True
        self._seen, self._rested = (environment, shown, told), 0
        return False

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
            cells: Records of ``kernels.recover.Cell``, (rows, columns).
            transfer: From ``trace_transfer``, straight, (n, rows * columns).
            mirrored: From ``trace_transfer``, by way of balls, (n, rows * columns).
            observations: Records of ``Observation``, (n,).
            trace: Traces lamps at finite distances; None: all light is distant.
            camera: Where the camera stands, metres, (3,); None: lamps are as seen from the ball's centre.
        """
        with _ONE_BLAS_THREAD:
            return self._solve(cells, transfer, mirrored, observations, trace, camera)

    def _solve(
        self,
        cells: NDArray[Any],
        transfer: NDArray[Any],
        mirrored: NDArray[Any],
        observations: NDArray[Any],
        trace: Trace | None,
        camera: Array | None,
    ) -> Estimate:
        """``update``, by the thread that asks for it alone."""
        origin = mirroring_points(cells["direction"].reshape(-1, 3).astype(float), self._center, self._radius, camera)
        problem = _Problem(cells, transfer, mirrored, observations, self.surfaces, self._white, trace, origin)
        self._frames += 1
        means, bounds = problem.card_means()
        if self.method == "white_card" or not (problem.parts or problem.may_hold_peak.any()):
            excess = problem.member @ (problem.expected[problem.component][:, None] * means)
            return self._estimate(problem, excess, bounds)
        means = np.maximum(means, 0.05)
        # The channel that surfaces show best.
        best = int(np.argmax(problem.exact.sum(axis=0) + np.array([0.0, 0.5, 0.0])))
        for peak in self._peaks:
            if problem.may_hold_peak[peak.cell]:
                problem.push(peak)
        before = self._frames - 1
        every = SEARCH_EVERY if before < SETTLED else LATER_EVERY
        if before and problem.peaks and (before < SETTLED or before % 2 == 0):
            problem.move_peak(best, means[best])
        start, environment = problem.start(means[best]), PEAKS - len(problem.peaks)
        if before == 0:
            problem.find_peaks(best, start, environment)
        elif before % every == 1:
            turn = before // SEARCH_EVERY
            candidates = MOST_CANDIDATES if before < FIRST else LATER_CANDIDATES
            problem.find_peaks(best, start, min(environment, 1), candidates=candidates, turn=turn)

        bright = problem.first_mean
        # Where the card does not tell, reflectances in a channel in which it does are worth more than guesses.
        known = min(range(3), key=lambda c: (bounds[c], c != best))
        told = problem.fit(known, problem.start(means[known]), ITERATIONS).z
        others = [told if bounds[c] and c != known else None for c in range(3)]
        first = [
            told if c == known else problem.fit(c, problem.start(means[c]), ITERATIONS, other=others[c]).z
            for c in range(3)
        ]
        solution = np.stack([z[:bright] for z in first], -1)
        if bright:
            solid = np.bincount(
                problem.part[problem.part >= 0],
                (problem.solid_angle * problem.lacking.max(axis=1))[problem.part >= 0],
                minlength=problem.parts,
            )
            total = np.concatenate([solid, np.ones(len(problem.peaks))]) @ solution + 1e-9
            shared = solution.sum(axis=1) / total.sum()
            solution = np.stack(
                [
                    problem.fit(c, first[c], WARM_ITERATIONS, centre=shared * total[c], other=others[c]).z[:bright]
                    for c in range(3)
                ],
                -1,
            )
        # A lamp that gives nothing in any channel has gone out, or never was.
        powers = solution[problem.parts :]
        self._peaks = [peak for peak, power in zip(problem.peaks, powers, strict=True) if power.any()]
        excess = problem.member @ solution[: problem.parts]
        lamps = []
        for peak, power in zip(problem.peaks, powers, strict=True):
            excess += problem.patch(peak.cell) * power
            lamps.append(Lamp(problem.origin[peak.cell], problem.direction[peak.cell], peak.distance, power))
        lamps.sort(key=lambda lamp: -float(lamp.power.sum()))
        return self._estimate(problem, excess, bounds, tuple(lamps))

    @staticmethod
    def _estimate(
        problem: _Problem, excess: Array, bounds: tuple[bool, bool, bool], lamps: tuple[Lamp, ...] = ()
    ) -> Estimate:
        return Estimate(excess.reshape(*problem.shape, 3).astype(np.float32), bounds, lamps)
