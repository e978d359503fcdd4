"""Light without a mirror ball, estimated from the card, planes and boxes of a frame, with its uncertainty.

The environment is divided into ``ROWS`` x 2 ``ROWS`` cells; cell c has the constant radiance x_c. A point p of a
surface of reflectance rho has the radiance

    r_p = rho / pi sum_c x_c max(n_p . d_c, 0) V_pc w_c

where n_p is its normal, d_c the direction of cell c, w_c the cell's solid angle, and V_pc is 0 where a box occludes the
cell, else 1. The reflectance of the card's paper is known. Those of other surfaces and the light are estimated in
alternation. Cells that the frame shows are measured directly.

The prior on x has the mean m and the covariance P. Above the horizon, m is the mean radiance that the card measures;
below it, m is the radiance of the table. P follows from ``SPREAD`` and ``REACH``. Let A x = b be the equations and S
the covariance of their noise. The light is the x >= 0 that minimises (x - m)' P^-1 (x - m) + (A x - b)' S^-1 (A x - b);
its covariance is (P^-1 + A' S^-1 A)^-1.

A flat card hardly measures light from near the horizon. ``SIDES`` is the assumed share of that light. Its value for a
frame without a visible face of a box is such that an upright and a flat surface have equal irradiance, as under
constant light.
"""

from __future__ import annotations

import dataclasses
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.errors import UsageError
from warp_ar.kernels.color import decode_table
from warp_ar.light.config import Kind
from warp_ar.light.fit import one_blas_thread, solve_nonnegative
from warp_ar.light.surfaces import find_surfaces
from warp_ar.scene import Pose, Proxy, Scene
from warp_ar.scene.geometry import rotation_matrix
from warp_ar.scene.pixel_rays import project, undistorted

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

ROWS: Final = 8
"""Rows of cells from zenith to nadir."""
SIDES: Final = (0.9, 0.3)
"""Prior share of the card's light from near the horizon: without a visible face of a box, and with one."""
NEAR_HORIZON: Final = 0.25
"""Sine of the height above the horizon at which the light from near the horizon has fallen to 1 / e."""
SPREAD: Final = (0.7, 0.4)
"""Relative standard deviation of the prior on a cell's radiance, above and below the horizon."""
REACH: Final = 0.8
"""Angle in radians at which the correlation of cells has fallen to 1 / e."""
NOISE: Final = {Kind.CARD: 0.02, Kind.PLANE: 0.1, Kind.FACE: 0.05}
"""Relative standard deviation of a surface's radiance, by kind; for textures it does not fall with more points."""
INDEPENDENT: Final = 4
"""Number of points of a plane or box that count as independent."""
SEEN: Final = 0.2
"""Relative standard deviation of a cell that is partly visible in the frame."""
CLIPPED: Final = 250
"""8-bit code from which a channel counts as clipped and is not used."""
EXCESS: Final = 1.3
"""Factor on the light measured by a card that clips, because it is a lower bound."""
STEP: Final = 12
"""Distance in pixels between the directions at which the frame is read."""
CENTER: Final = (0.0, 0.0, 0.05)
"""Position for which the light is estimated, metres: above the card, where objects stand."""
TURNS: Final = 6
"""Number of alternations between reflectances and light."""
WITHIN: Final = 7.5
"""Number of estimated standard deviations within which nine tenths of the errors lie, measured on desks of known light.
It is large because most of an error is not noise, but light from directions that no surface faces."""


@dataclasses.dataclass(frozen=True, eq=False)
class CardLight:
    """Coarse environment of one frame for irradiance, which depends only on spherical harmonics up to order two."""

    radiance: npt.NDArray[np.float32]
    """Latlong radiance, z up, (``ROWS``, 2 ``ROWS``, 3), in units of the camera's clipping."""
    covariance: Array
    """Covariance of the cells' radiance, by channel, (3, cells, cells)."""

    def irradiance(self, normals: npt.ArrayLike) -> tuple[Array, Array]:
        """Return the irradiance of surfaces with normals (n, 3), and half its 90 % interval, (n, 3) each."""
        directions, angles = _cells()
        weights = np.maximum(np.asarray(normals, np.float64) @ directions.T, 0.0) * angles
        variance = np.einsum("nc,kcd,nd->nk", weights, self.covariance, weights)
        return weights @ self.radiance.reshape(-1, 3), WITHIN * np.sqrt(np.maximum(variance, 0.0))

    @property
    def main_direction(self) -> Array:
        """Unit vector in the direction of the mean of the light, (3,)."""
        directions, angles = _cells()
        sum_: Array = (self.radiance.reshape(-1, 3).mean(axis=1) * angles) @ directions
        return sum_ / max(float(np.linalg.norm(sum_)), 1e-12)

    @property
    def latlong(self) -> npt.NDArray[np.float32]:
        """Radiance repeated to the size of a file of captured light, (32, 64, 3)."""
        return np.repeat(np.repeat(self.radiance, 32 // ROWS, axis=0), 32 // ROWS, axis=1)

    @property
    def words(self) -> str:
        """Line of text with the irradiance from above, its interval, and the main direction of the light."""
        value, half = (float(part.mean()) for part in self.irradiance(np.array([[0.0, 0.0, 1.0]])))
        x, y, z = self.main_direction
        told = f"from above {value:.2f} +- {half:.2f} camera values, mainly from ({x:.2f}, {y:.2f}, {z:.2f})"
        return f"light by the card, of second order: irradiance {told}"


def light_by_card(image: npt.NDArray[np.uint8], scene: Scene, pose: Pose) -> CardLight:
    """Estimate the light from the surfaces in a frame.

    Args:
        image: uint8 RGB, (height, width, 3).
        scene: Scene with a marker, planes and boxes; its camera has the frame's size.
        pose: ``camera_from_world``.

    Raises:
        UsageError: The frame does not show the marker's white paper.
    """
    shown = _look(image, scene, pose)
    if not (shown.group == 0).any():
        raise UsageError("light by the card: the frame does not show its white paper; show the whole card")
    with one_blas_thread():
        found = [_solve(shown, scene.marker.white, channel) for channel in range(3)]
    radiance = np.stack([values for values, _ in found], -1).reshape(ROWS, 2 * ROWS, 3)
    return CardLight(radiance.astype(np.float32), np.stack([covariance for _, covariance in found]))


@dataclasses.dataclass(frozen=True, eq=False)
class _Shown:
    """Linear values that a frame shows at surface points, and in directions of the environment."""

    values: Array
    """Linear values at points, (n, 3)."""
    exact: Mask
    """True where values do not clip, (n, 3)."""
    kind: npt.NDArray[np.int64]
    """``Kind`` of each point's surface."""
    group: npt.NDArray[np.int64]
    """Index of each point's surface; 0 is the card."""
    transfer: Array
    """Transfer from the radiance of cells to the irradiance of points, (n, cells)."""
    cells: npt.NDArray[np.int64]
    """Indices of the cells that the frame shows."""
    radiance: Array
    """Mean linear values of those cells, (m, 3)."""


def _look(image: npt.NDArray[np.uint8], scene: Scene, pose: Pose) -> _Shown:
    surfaces, camera = find_surfaces(dataclasses.replace(scene, probes=())), scene.camera
    kind, group = surfaces.kinds[surfaces.surface], surfaces.groups[surfaces.surface]
    points, normals = (surfaces.points[name].astype(np.float64) for name in ("position", "normal"))
    eye, blurred, exact = pose.inverse().translation, *_blur(image, decode_table(camera.transfer))
    places = np.nan_to_num(project(camera, pose.apply(points)), nan=-1.0).round()
    inside = ((places >= 3.0) & (places < np.array([camera.width, camera.height]) - 3.0)).all(axis=1)
    toward = eye - points
    facing = (toward * normals).sum(axis=1) > 0.1 * np.linalg.norm(toward, axis=1)
    hidden = _hidden(points + 1e-3 * normals, toward[:, None], scene.proxies)[:, 0]
    own = inside & facing & ~hidden & (kind != Kind.INK)
    columns, rows = places[own].astype(int).T
    directions, angles = _cells()
    sight = ~_hidden((points + 1e-3 * normals)[own], directions[None], scene.proxies)
    transfer = np.maximum(normals[own] @ directions.T, 0.0) * sight * angles

    u, v = (part.ravel() for part in np.meshgrid(*(np.arange(4, size, STEP) for size in (camera.width, camera.height))))
    rays = np.column_stack([undistorted(camera, np.column_stack([u, v])), np.ones(len(u))]) @ pose.rotation
    on_table = rays[:, 2] * np.sign(eye[2]) < -0.02
    reached = eye - rays * (eye[2] / np.where(on_table, rays[:, 2], 1.0))[:, None]
    seen = _cell_of(np.where(on_table[:, None], reached - CENTER, rays))
    count = np.bincount(seen, minlength=len(directions))
    sums = np.stack([np.bincount(seen, blurred[v, u, c], minlength=len(count)) for c in range(3)], -1)
    cells = np.flatnonzero(count >= 2)
    observed = blurred[rows, columns], exact[rows, columns], kind[own], group[own], transfer
    return _Shown(*observed, cells, sums[cells] / count[cells, None])


def _solve(shown: _Shown, white: float, channel: int) -> tuple[Array, Array]:
    """Return the radiance of the cells in one channel, (cells,), and its covariance.

    Args:
        shown: Values of the frame.
        white: Reflectance of the card's paper.
        channel: Index of the channel.
    """
    directions, angles = _cells()
    exact, values = shown.exact[:, channel].copy(), shown.values[:, channel]
    card = shown.group == 0
    clips = exact[card].mean() < 0.7
    level = float(np.median(values[card if clips else card & exact])) / white * (EXCESS if clips else 1.0)
    exact &= ~(card & clips)
    up = directions[:, 2] > 0.0
    ring = np.where(up, np.exp(-directions[:, 2] / NEAR_HORIZON), 0.0)
    ring *= np.pi / (ring * np.maximum(directions[:, 2], 0.0) * angles).sum()
    share = SIDES[int((shown.kind == Kind.FACE).any())]
    below = shown.radiance[~up[shown.cells], channel]
    prior = np.where(up, level * (1.0 - share + share * ring), np.median(below) if len(below) else 0.3 * level)
    spread = np.where(up, SPREAD[0] * np.maximum(prior, 0.5 * level), SPREAD[1] * prior) + 1e-6
    angle = np.arccos(np.clip(directions @ directions.T, -1.0, 1.0))
    inverse = np.linalg.inv(spread[:, None] * spread * np.exp(-angle / REACH))
    seen = shown.radiance[:, channel]
    rows, right, noise = [np.eye(len(angles))[shown.cells]], [seen], [SEEN * np.maximum(seen, 1e-4)]
    light = prior
    for _ in range(TURNS):
        del rows[1:], right[1:], noise[1:]
        for group in np.unique(shown.group[exact]):
            own = exact & (shown.group == group)
            received, kind = shown.transfer[own] @ light, Kind(shown.kind[own][0])
            told = np.pi * float(values[own] @ received) / max(float(received @ received), 1e-12)
            reflectance = white if group == 0 else float(np.clip(told, 0.02, 0.95))
            count = int(own.sum())
            alike = np.sqrt(count if kind == Kind.CARD else max(count / INDEPENDENT, 1.0))
            rows.append(shown.transfer[own] * reflectance / np.pi)
            right.append(values[own])
            noise.append(np.full(count, NOISE[kind] * max(float(values[own].mean()), 1e-4) * alike))
        weighted = (matrix := np.concatenate(rows)) / np.concatenate(noise)[:, None] ** 2
        precision = inverse + matrix.T @ weighted
        gradient = inverse @ prior + weighted.T @ np.concatenate(right)
        light = solve_nonnegative(precision[None], gradient[None])[0]
    covariance = np.asarray(np.linalg.inv(precision), np.float64)
    return light, covariance


def _cells() -> tuple[Array, Array]:
    """Return directions, (cells, 3), and solid angles, (cells,), of the cells.

    Rows run from +z to -z; columns from -x through -y, +x and +y.
    """
    theta = (np.arange(ROWS) + 0.5) / ROWS * np.pi
    phi = ((np.arange(2 * ROWS) + 0.5) / ROWS - 1.0) * np.pi
    theta, phi = (part.ravel() for part in np.meshgrid(theta, phi, indexing="ij"))
    directions: Array = np.column_stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
    bands = -np.diff(np.cos(np.linspace(0.0, np.pi, ROWS + 1)))
    angles: Array = np.repeat(bands * np.pi / ROWS, 2 * ROWS)
    return directions, angles


def _cell_of(directions: Array) -> npt.NDArray[np.int64]:
    x, y, z = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).T
    row = np.clip(np.arccos(np.clip(z, -1.0, 1.0)) / np.pi * ROWS, 0, ROWS - 1).astype(np.int64)
    column = np.clip((np.arctan2(y, x) / np.pi + 1.0) * ROWS, 0, 2 * ROWS - 1).astype(np.int64)
    cells: npt.NDArray[np.int64] = row * 2 * ROWS + column
    return cells


def _blur(image: npt.NDArray[np.uint8], decode: Array) -> tuple[Array, Mask]:
    """Return linear values as means of 5 x 5 pixels, (h, w, 3), and a mask of the means without clipped pixels."""
    linear = np.stack([decode[image[..., c], c] for c in range(3)], -1)
    return cv2.blur(linear, (5, 5)), cv2.blur((image >= CLIPPED).astype(np.float32), (5, 5)) == 0.0


def _hidden(points: Array, directions: Array, proxies: tuple[Proxy, ...]) -> Mask:
    """Return a mask, (n, m), of the directions in which a box occludes the environment.

    Args:
        points: Points, (n, 3).
        directions: Directions for all points, (1, m, 3), or for each, (n, m, 3).
        proxies: Proxies, of which the static boxes are used.
    """
    found = np.zeros((len(points), directions.shape[1]), bool)
    for box in proxies:
        if box.shape == "box" and box.marker is None:
            turn, half = rotation_matrix(box.rotate), 0.5 * np.array(box.size)
            start, way = ((points - np.array(box.at)) @ turn)[:, None], directions @ turn
            with np.errstate(divide="ignore", invalid="ignore"):
                ends = (-half - start) / way, (half - start) / way
            near, far = np.minimum(*ends).max(axis=-1), np.maximum(*ends).min(axis=-1)
            found |= far > np.maximum(near, 0.0)
    return found
