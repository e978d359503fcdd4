"""Equations of one frame: known and unknown light that each surface point receives.

The module ``recovery`` states the equations and their unknowns. Arrays over cells of the environment map have m rows;
a part is a region of clipped cells with one unknown radiance.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warp_ar.kernels.recovery.recover_cells import LOST
from warp_ar.light.config import CONFIG, Kind
from warp_ar.light.priors import alike, connected_regions, depth_profile, split_regions
from warp_ar.light.surfaces import Surfaces, measured_noise, shared_errors

Array = NDArray[np.float64]

Trace = Callable[[NDArray[np.float32]], Array]
"""Function that returns the irradiance of all points, (n, q), by emitters of intensity 1, (q, 4: position, radius)."""


@dataclasses.dataclass(frozen=True)
class Candidate:
    """Candidate for an emitter."""

    cell: int
    """Index of the cell in whose direction the emitter is."""
    distance: float
    """Distance in metres from the point where the ball reflects the emitter; infinite for a distant one."""


def mirroring_points(directions: Array, center: Array, radius: float, camera: Array | None) -> Array:
    """Return the points of a ball that reflect each direction to a distant camera, (m, 3).

    Args:
        directions: Unit directions, (m, 3).
        center: Centre of the ball, metres, (3,).
        radius: Radius of the ball, metres.
        camera: Position of the camera, metres, (3,); None: return the centre for all.
    """
    if camera is None:
        return np.broadcast_to(center, directions.shape)
    view = (camera - center) / np.linalg.norm(camera - center)
    halfway = directions + view
    return np.asarray(center + radius * halfway / np.maximum(np.linalg.norm(halfway, axis=1, keepdims=True), 1e-3))


def emitter_directions(cells: NDArray[Any]) -> Array:
    """Return the unit direction of a possible emitter in each cell, (m, 3).

    A lamp's image in the ball is wider than a cell, and the equations hardly determine which cell contains its centre.
    If nothing else clips within twice ``search.angle``, the direction is the centre of the clipped spot around the
    cell, found by mean shift. Otherwise, as in a window or a sky, whose centre need not be its brightest part, it is
    the direction of the cell.
    """
    search = CONFIG.search
    direction = cells["direction"].reshape(-1, 3).astype(float)
    lost = cells["solid_angle"].ravel() * cells["missing"].reshape(-1, 3).max(axis=1)
    lost = np.where((cells["modelled"].ravel() > 0.5) | (cells["hidden"].ravel() > 0.0), 0.0, lost)
    inside = np.flatnonzero(lost > 0.0)
    found, middle = direction.copy(), direction[inside]
    for _ in range(3):
        middle = ((middle @ direction[inside].T > np.cos(search.angle)) * lost[inside]) @ direction[inside]
        middle /= np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-12)
    cosine = middle @ direction[inside].T
    spot, around = ((cosine > np.cos(angle)) @ lost[inside] for angle in (search.angle, 2.0 * search.angle))
    alone = around <= (1.0 + search.stray) * spot
    found[inside[alone]] = middle[alone]
    return found


class Problem:
    """Equations of one frame."""

    def __init__(
        self,
        cells: NDArray[Any],
        transfer: NDArray[Any],
        mirrored: NDArray[Any],
        observations: NDArray[Any],
        surfaces: Surfaces,
        white: float,
        trace: Trace,
        aim: Array,
        origin: Array,
    ) -> None:
        """Set up both sides of the equations.

        Args:
            cells: Records of ``kernels.recover_cells.Cell``, (rows, columns).
            transfer: Direct transfer from ``trace_transfer``, (n, rows * columns).
            mirrored: Transfer by reflection in balls from ``trace_transfer``, (n, rows * columns).
            observations: Records of ``Observation``, (n,).
            surfaces: Surface points.
            white: Reflectance of the card's paper.
            trace: Function that traces emitters at finite distances.
            aim: Directions from ``emitter_directions``, (rows * columns, 3).
            origin: Points from ``mirroring_points`` for these directions, (rows * columns, 3).
        """
        self.shape = cells.shape
        self.trace, self.aim, self.origin = trace, aim, origin
        self._traced: dict[Candidate, Array] = {}
        self.candidates: list[Candidate] = []
        clipped = self._read_cells(cells)
        self._group_cells(cells, clipped)
        self._read_points(observations, surfaces, white)
        through_balls = self._aim_transfer(cells, transfer, mirrored, surfaces, clipped)
        self._sum_light(through_balls)
        self.candidate_columns = np.zeros((3, len(self.index), 0))
        faces = self.kinds == Kind.FACE
        one_box = faces & faces[:, None] & (self.groups == self.groups[:, None])
        self.ties = np.argwhere(np.tril(one_box, -1))
        """Pairs of faces of one box, whose reflectances are similar, (pairs, 2)."""

    def _read_cells(self, cells: NDArray[Any]) -> Array:
        """Store the cells of the map; return the largest share of each cell that clips in a channel, (m,)."""
        self.radiance = cells["radiance"].reshape(-1, 3).astype(float)
        self.lost = cells["clipped"].reshape(-1, 3).astype(float)
        self.missing = cells["missing"].reshape(-1, 3).astype(float)
        self.direction = cells["direction"].reshape(-1, 3).astype(float)
        self.solid_angle = cells["solid_angle"].ravel().astype(float)
        self.modelled = cells["modelled"].ravel() > 0.5
        self.hidden = cells["hidden"].ravel().astype(float)
        # Unseen cells hold no candidates, because shading measures missing light but hardly its direction.
        seen = self.hidden <= 0.0
        self.may_hold_candidate = (self.lost.max(axis=1) > 0.1) & ~self.modelled & seen
        return np.asarray(self.lost.max(axis=1) - self.hidden, np.float64)

    def _group_cells(self, cells: NDArray[Any], clipped: Array) -> None:
        """Group clipped cells into components and parts, and compute the expected missing radiance of components."""
        # Clipped cells that show modelled surfaces are grouped apart from those of the environment.
        beyond = connected_regions(((clipped > LOST) & ~self.modelled).reshape(self.shape)).ravel()
        lit = connected_regions(((clipped > LOST) & self.modelled).reshape(self.shape)).ravel()
        component = np.where(lit >= 0, lit + beyond.max(initial=-1) + 1, beyond)
        self.part, self.parts = split_regions(component, self.direction, self.solid_angle)
        self.components = int(component.max(initial=-1)) + 1
        first = np.unique(self.part, return_index=True)[1][int((self.part < 0).any()) :]
        self.component = component[first]
        inside = component >= 0
        is_surface = np.bincount(component[inside], self.modelled[inside], minlength=self.components) > 0
        area = np.bincount(component[inside], (self.solid_angle * clipped)[inside], minlength=self.components)
        usual = (area + 0.01) ** CONFIG.priors.exponent
        usual *= alike(self.lost, self.solid_angle, component, self.components)
        self.expected = np.where(is_surface, 0.0, usual)
        self.profile = np.ones_like(self.missing)
        """Factor on the missing share of each cell, by its depth in its component, (m, 3)."""
        self._depth = depth_profile(cells, component)
        self.is_surface = is_surface[self.component]
        self.member = np.zeros((len(component), self.parts))
        self.member[np.flatnonzero(inside), self.part[inside]] = 1.0

    def _read_points(self, observations: NDArray[Any], surfaces: Surfaces, white: float) -> None:
        """Store the visible points, with their radiance and the standard deviation of their equations."""
        seen = observations["visible"] > 0.8
        self.index = np.flatnonzero(seen)
        shown = observations[seen]
        self.points = surfaces.points["position"][seen].astype(float)
        self.normals = surfaces.points["normal"][seen].astype(float)
        self.surface = surfaces.surface[seen]
        self.kinds, self.groups, self.white = surfaces.kinds, surfaces.groups, white
        self.kind = self.kinds[self.surface]
        self.shared = shared_errors(surfaces.overlap, surfaces.kinds[surfaces.surface], seen)
        self.light = np.pi * shown["radiance"].astype(float)
        # Points whose surroundings vary are not used; they are at the edge of clutter or of a sharp shadow.
        even = np.pi * shown["deviation"] < 0.25 * self.light + 0.01
        self.exact = (self.light > CONFIG.surfaces.dark) & even & (shown["clipped"] < 0.01)
        self.bound = shown["clipped"] > 0.5
        points = surfaces.points[seen]
        self.noise, scatter = measured_noise(points, self.surface, self.kinds, self.light, self.exact)
        told = self.surface[self.exact.all(axis=1) & (self.kind >= Kind.PLANE)]
        self.texture = float(np.median(scatter[told] / self.noise[told])) if len(told) else 1.0
        """Median ratio of surfaces' scatter to ``noise``, without the card; at least 1."""

    def leave_out(self, points: NDArray[np.bool_]) -> None:
        """Exclude points, given as a mask (n,), from the equations, because something covers their surface."""
        self.exact[points] = self.bound[points] = False
        self.kind = np.where(points, -1, self.kind)

    def _aim_transfer(
        self, cells: NDArray[Any], transfer: NDArray[Any], mirrored: NDArray[Any], surfaces: Surfaces, clipped: Array
    ) -> NDArray[Any]:
        """Store the transfer from cells to visible points, (points, m); return the part by reflection in balls."""
        through_balls = mirrored[self.index]
        self.transfer = transfer[self.index]
        # Transfer was traced for the centre of each cell; it is corrected for the direction of clipped light in it.
        emitters = np.flatnonzero((clipped > LOST) & ~self.modelled)
        normals = surfaces.points["normal"][self.index]
        cosine = normals @ cells["middle"].reshape(-1, 3)[emitters].T
        turned = np.clip(normals @ cells["direction"].reshape(-1, 3)[emitters].T, 0.0, 2.0 * np.maximum(cosine, 0.0))
        self.transfer[:, emitters] *= np.where(cosine > 0.0, turned / np.maximum(cosine, 1e-6), 1.0)
        self.transfer += through_balls
        return through_balls

    def _sum_light(self, through_balls: NDArray[Any]) -> None:
        """Compute captured irradiance, the share that balls reflect, and irradiance of each part per unit radiance."""
        # Clipped light is assumed to be ten times as bright, because only the order of magnitude matters.
        bright = (self.radiance + 10.0 * self.missing * self.radiance).mean(axis=1)
        sums = self.transfer @ np.column_stack([self.radiance, bright]).astype(np.float32)
        self.captured = sums[:, :3]
        mirrored_sums = through_balls @ bright.astype(np.float32)
        self.mirrored_share = mirrored_sums / np.maximum(sums[:, 3], 1e-9)
        self._sum_parts()

    def share_by_depth(self) -> None:
        """Distribute missing light within parts and around candidates by depth from fading boundaries.

        The search for candidates must precede this, because light that is already at an emitter's place would hide it.
        """
        self.profile = self._depth
        self.missing = self.missing * self.profile
        self._sum_parts()
        candidates, self.candidates = self.candidates, []
        self.candidate_columns = self.candidate_columns[:, :, :0]
        for candidate in candidates:
            self.push(candidate)

    def _sum_parts(self) -> None:
        """Compute the irradiance of each part per unit radiance."""
        order = np.argsort(self.part, kind="stable")[np.count_nonzero(self.part < 0) :]
        starts = np.unique(self.part[order], return_index=True)[1]
        columns = [np.zeros((len(self.index), 0))] * 3
        if self.parts:
            sent = self.transfer[:, order]
            columns = [np.add.reduceat(sent * self.missing[order, c], starts, axis=1) for c in range(3)]
        self.columns = np.stack(columns)

    def card_means(self) -> tuple[Array, tuple[bool, bool, bool]]:
        """Return the common mean of missing radiance for which the card's radiance is right, per channel, (3,).

        Also return, per channel, True if it is only a lower bound because the card clips.
        """
        card = np.flatnonzero(self.kind == Kind.CARD)
        exact = self.exact[card]
        bounds = exact.sum(axis=0) < max(3.0, 0.3 * len(card))
        use = exact | (bounds & self.bound[card])
        irradiance = np.where(use, self.light[card] / self.white, 1.0)
        missing = irradiance - self.captured[card]
        gain = (self.columns[:, card] @ self.expected[self.component]).T
        means = np.zeros(3)
        for c in np.flatnonzero((use & (gain > 0.0)).any(axis=0)):
            middle = np.median(gain[use[:, c], c])
            means[c] = max(0.0, float(np.median(missing[use[:, c], c]) / middle)) if middle > 0.0 else 0.0
        for _ in range(10):
            weights = use / (1.0 + ((missing - gain * means) / (0.03 * irradiance)) ** 2) / irradiance**2
            total = np.maximum((weights * gain**2).sum(axis=0), 1e-30)
            means = np.maximum((weights * gain * missing).sum(axis=0) / total, 0.0)
        return means, (bool(bounds[0]), bool(bounds[1]), bool(bounds[2]))

    def card_factor(self, bounds: tuple[bool, bool, bool], doubt: float) -> float:
        """Return the share, 0 to 1, of the card's correction that is applied.

        The measured missing part of the card's irradiance has an error by the card's reflectance, the response and the
        ball. The true part is at least the measured one minus that error. Adding up to twice the true part is no worse
        than adding nothing.

        Args:
            bounds: True for channels in which the card clips.
            doubt: Standard deviation of the logarithm of the card's radiance.
        """
        config = CONFIG.evidence
        shares = [self.card_share(c, bounds[c]) for c in range(3)]
        missing = float(np.mean(shares))
        error = 1.28 * float(np.linalg.norm([doubt, config.response, config.ball]))
        return float(np.clip(2.0 * (missing - error) / max(missing, 1e-9), 0.0, 1.0))

    def card_share(self, c: int, is_bound: bool) -> float:
        """Return the share of the card's irradiance in a channel that captured light lacks; 0 without a card.

        Args:
            c: Channel.
            is_bound: True if the card clips, so that the share is a lower bound.
        """
        use = (self.kind == Kind.CARD) & (self.exact[:, c] | (self.bound[:, c] & is_bound))
        if not use.any():
            return 0.0
        return max(1.0 - float(np.median(self.captured[use, c] * self.white / self.light[use, c])), 0.0)

    # Order of unknowns: parts, candidates, means of components, the common mean, 1 / reflectance of each surface.

    @property
    def first_mean(self) -> int:
        """Index of the first component's mean among the unknowns."""
        return self.parts + len(self.candidates)

    @property
    def first_surface(self) -> int:
        """Index of the first surface's reciprocal reflectance among the unknowns."""
        return self.first_mean + self.components + 1

    def start(self, means: Array) -> Array:
        """Return start values of the unknowns, (3, unknowns), that the card alone implies; 0 for surfaces.

        Args:
            means: Common mean of missing radiance, per channel, (3,).
        """
        z = np.zeros((3, self.first_surface + len(self.kinds)))
        z[:, : self.parts] = means[:, None] * self.expected[self.component]
        z[:, self.first_mean : self.first_surface - 1] = means[:, None] * self.expected
        z[:, self.first_surface - 1] = means
        return z

    def power_columns(self, candidates: Sequence[Candidate]) -> Array:
        """Return the irradiance of points per unit power of candidates, (points, q)."""
        cells = np.array([candidate.cell for candidate in candidates])
        distances = np.array([candidate.distance for candidate in candidates])
        columns: Array = np.asarray(self.transfer[:, cells] / self.solid_angle[cells], np.float64)
        near = [k for k, candidate in enumerate(candidates) if np.isfinite(candidate.distance)]
        if near:
            new = [k for k in near if candidates[k] not in self._traced]
            if new:
                at = self.origin[cells[new]] + distances[new, None] * self.aim[cells[new]]
                emitters = np.column_stack([at, CONFIG.search.radius_share * distances[new]]).astype(np.float32)
                traced = self.trace(emitters)[self.index] * distances[new] ** 2
                self._traced.update((candidates[k], column) for k, column in zip(new, traced.T, strict=True))
            columns[:, near] = np.stack([self._traced[candidates[k]] for k in near], -1)
        return columns

    def patch(self, cell: int) -> Array:
        """Return factors of ``missing``, (m, 3), that give unit power to cells within ``search.angle`` of ``cell``."""
        near = (self.direction @ self.direction[cell] > np.cos(CONFIG.search.angle)) & self.may_hold_candidate
        near[cell] = True
        total = self.solid_angle[near] @ self.missing[near]
        return np.asarray(near[:, None] / np.maximum(total, 1e-6), np.float64)

    def light_of(self, candidates: Sequence[Candidate]) -> Array:
        """Return the irradiance of points per unit power of candidates, by channel, (3, points, q).

        The power of a distant candidate is distributed over its ``patch``. A near candidate has no power in channels in
        which nothing clips there.
        """
        light = np.repeat(self.power_columns(candidates)[None], 3, axis=0)
        for k, candidate in enumerate(candidates):
            patch = self.patch(candidate.cell)
            inside = np.flatnonzero(patch.any(axis=1))
            if np.isfinite(candidate.distance):
                light[:, :, k] *= (self.lost[inside].max(axis=0) > LOST)[:, None]
            else:
                light[:, :, k] = (self.transfer[:, inside] @ (patch * self.missing)[inside]).T
        return light

    def push(self, candidate: Candidate) -> None:
        """Add a candidate to the unknowns."""
        self.candidate_columns = np.concatenate([self.candidate_columns, self.light_of([candidate])], axis=2)
        self.candidates.append(candidate)

    def pop(self) -> None:
        """Remove the candidate that was added last."""
        self.candidates.pop()
        self.candidate_columns = self.candidate_columns[:, :, :-1]

    def distant_radiance(self, unknowns: Array) -> Array:
        """Return the missing radiance of cells from parts and candidates at infinity, (m, 3).

        Args:
            unknowns: Radiance of parts, then power of candidates, (parts + candidates, 3).
        """
        radiance = self.member @ unknowns[: self.parts]
        for candidate, power in zip(self.candidates, unknowns[self.parts :], strict=True):
            if not np.isfinite(candidate.distance):
                radiance += self.patch(candidate.cell) * power
        return radiance

    def near_emitters(self, unknowns: Array) -> list[tuple[Array, Array]]:
        """Return positions, metres (3,), and intensities, (3,), of the candidates at finite distances."""
        return [
            (self.origin[one.cell] + one.distance * self.aim[one.cell], power * one.distance**2)
            for one, power in zip(self.candidates, unknowns[self.parts :], strict=True)
            if np.isfinite(one.distance)
        ]

    def added_irradiance(self, unknowns: Array) -> Array:
        """Return the irradiance of points from parts and candidates, (points, 3).

        Args:
            unknowns: Radiance of parts, then power of candidates, (parts + candidates, 3).
        """
        columns = np.concatenate([self.columns, self.candidate_columns], axis=2)
        return np.asarray(np.einsum("cnk,kc->nc", columns, unknowns), np.float64)
