"""Reflectance and roughness of a polished table, measured from frames from several sides.

A matt point has the same radiance from every side. A polished one adds its reflection, which is another part of the
environment from each side, and scatters less of the light:

    I_k(x) = (1 + e_k) D(x) + g F_k(x) (L_k(x) - D(x)) + h H_k(x)

Here I_k is the radiance of point x in view k, D the scattered radiance, e_k the drift of the exposure, and F_k L_k the
environment filtered by a GGX lobe with Fresnel's factor for the reflectance ``USUAL``. H is light that clips in the
ball, of which only the direction is known; its strength h is a separate unknown. D is the mean of the point over the
views. Texture therefore cannot be taken for a reflection, and the table need not be uniform. g is 0 for a matt table
and 1 for lacquer. g and h are found by robust least squares for several widths of the lobe. Near its rim the ball's
image is less sharp than a polished table's, so that the best width is often too small; the next larger one is therefore
accepted as possible.

To exclude other effects that move with the camera, such as vignetting or objects on the table, the environment rotated
about the vertical must explain clearly less than the environment itself.

References:
    [DB23] Dupuy, Benyoub 2023, Sampling Visible GGX Normals with Spherical Caps.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from warp_ar.ball.ball_reflectance import are_seen
from warp_ar.calibration.card import card_size
from warp_ar.scene import Camera, Pose, Probe, Proxy, Scene
from warp_ar.scene.geometry import rotation_matrix

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

USUAL: Final = 0.04
"""Reflectance at normal incidence of lacquer, glass and varnish."""
ROUGHNESS: Final = (0.05, 0.1, 0.15, 0.2, 0.3, 0.45)
"""Roughnesses that are tried."""
CLIPPED: Final = 245
"""8-bit code from which a point counts as clipped and is not used."""
HOT: Final = 0.77
"""Linear value in the ball's image, 1 at clipping, from which light may have been clipped."""
VIEWS: Final = 3
"""Smallest number of views in which a point must be visible."""
FEWEST: Final = 150
"""Smallest number of usable points."""
ACROSS: Final = 70
"""Number of points across the examined part of the table."""
REACH: Final = 0.6
"""Half width of the examined part of the table, metres, around the scene's origin."""
RAYS: Final = 12
"""Number of rays per point and view."""
TURNS: Final = 7
"""Number of rotated environments for comparison."""
ROUNDS: Final = 6
"""Number of iterations of reweighting."""
GAIN: Final = 0.06
"""Smallest share of the differences between views that must be explained; on matt tables, 0.01 is explained by
chance."""
CLEARLY: Final = 1.5
"""Smallest ratio of the explained share to the largest share that a rotated environment explains."""
LEAST: Final = 0.3
"""Smallest g of a polished table, because no coat reflects less than 0.012."""
CONTRADICTED: Final = -0.12
"""Value of h below which clipped light would cancel adjacent reflections, so that g is undetermined."""
FACTOR: Final = 2.0
"""Factor of uncertainty of the reflectance, in both directions."""
WIDTHS: Final = 0.8
"""Smallest explained share of a possible roughness, relative to that of the best roughness."""


@dataclasses.dataclass(frozen=True)
class Polish:
    """Roughness and reflectance of a table."""

    roughness: tuple[float, float, float]
    """Most likely, least and largest roughness."""
    reflectance: tuple[float, float, float] | None
    """Most likely, least and largest reflectance; None: only reflections of clipped light were found."""
    gain: float
    """Share of the differences between views that is explained."""


@dataclasses.dataclass(frozen=True)
class _Seen:
    """Observations of n points in k views."""

    points: Array
    """Positions, (n, 3)."""
    radiance: Array
    """Linear radiance, (k, n, 3)."""
    wo: Array
    """Unit direction toward the camera, in the table's frame, (k, n, 3)."""
    tells: NDArray[np.bool_]
    """True where a point is usable in a view, (k, n)."""

    @property
    def mean(self) -> Array:
        """Mean radiance over the views, (n, 3)."""
        total = (self.radiance * self.tells[..., None]).sum(0)
        return np.asarray(np.maximum(total / np.maximum(self.tells.sum(0), 1)[:, None], 2e-3))


@dataclasses.dataclass(frozen=True)
class _Fit:
    """Fit for one environment and roughness."""

    strength: Array
    """g and, if light clips, h."""
    off: Array
    """Absolute residuals divided by each point's mean, (k, n, 3)."""


def estimate_polish(
    scene: Scene,
    camera: Camera,
    views: Sequence[tuple[Image, Pose]],
    environment: NDArray[np.float32],
    table: NDArray[np.float32],
) -> Polish | None:
    """Return the roughness and reflectance of the first plane of a scene, from reflections of the environment.

    Args:
        scene: Scene with a plane, a mirror ball and a card.
        camera: Camera of the pictures, at their size.
        views: RGB pictures (h, w, 3) with ``camera_from_world``: six or more, at least twenty degrees apart.
        environment: Environment as captured by the ball, without recovered light, (rows, 2 rows, 3).
        table: Linear value of each 8-bit code, (256, 3).

    Returns:
        The result; None if the table is matt, or cannot be distinguished from a matt one.
    """
    plane = next((proxy for proxy in scene.proxies if proxy.shape == "plane" and proxy.material is None), None)
    if plane is None or not scene.probes or len(views) < VIEWS:
        return None
    seen = _observe(scene, camera, plane, views, table)
    if len(seen.points) < FEWEST:
        return None
    turn = rotation_matrix(plane.rotate)
    hot = HOT / max(max(probe.reflectance) for probe in scene.probes)
    alone = _solve(seen, [])
    fits = {roughness: _explain(seen, environment, turn, roughness, hot) for roughness in ROUGHNESS}
    scatter = min(_scatter(seen, fit.off) for fit in fits.values())
    before = _cost(seen, alone.off, scatter)
    gains = {roughness: 1.0 - _cost(seen, fit.off, scatter) / before for roughness, fit in fits.items()}
    best = max(gains, key=lambda roughness: gains[roughness])
    if gains[best] < GAIN or fits[best].strength[0] < LEAST:
        return None
    turned = -np.inf
    for step in range(1, TURNS + 1):
        other = np.roll(environment, step * environment.shape[1] // (TURNS + 1), axis=1)
        cost = _cost(seen, _explain(seen, other, turn, best, hot).off, scatter)
        turned = max(turned, 1.0 - cost / before)
    if gains[best] < CLEARLY * turned:
        return None
    wide = [roughness for roughness, gain in gains.items() if gain >= WIDTHS * gains[best]]
    least = 0.0 if wide[0] == ROUGHNESS[0] else wide[0]
    most = ROUGHNESS[min(ROUGHNESS.index(wide[-1]) + 1, len(ROUGHNESS) - 1)]
    found = USUAL * float(fits[best].strength[0])
    known = len(fits[best].strength) == 1 or fits[best].strength[1] > CONTRADICTED
    return Polish((best, least, most), (found, found / FACTOR, FACTOR * found) if known else None, gains[best])


def _observe(
    scene: Scene, camera: Camera, plane: Proxy, views: Sequence[tuple[Image, Pose]], table: NDArray[np.float32]
) -> _Seen:
    """Return the points of a plane outside the card and the balls, with their radiance in all views."""
    side = np.linspace(-REACH, REACH, ACROSS)
    local = np.stack([*np.meshgrid(side, side), np.zeros((ACROSS, ACROSS))], -1).reshape(-1, 3)
    turn = rotation_matrix(plane.rotate)
    local[:, :2] -= (np.asarray(plane.at) @ turn)[:2]
    local = local[(np.abs(local[:, :2]) < 0.49 * np.asarray(plane.size)[:2]).all(axis=1)]
    points = local @ turn.T + np.asarray(plane.at)
    free = (np.abs(points[:, :2]) > 0.6 * np.asarray(card_size(scene.marker))).any(axis=1)
    for probe in scene.probes:
        free &= np.linalg.norm(points - np.asarray(probe.center), axis=1) > 2.4 * probe.radius
    points = points[free]
    radiance, wo, tells = [], [], []
    for image, pose in views:
        eye = -pose.rotation.T @ pose.translation
        toward = eye - points
        toward /= np.linalg.norm(toward, axis=1, keepdims=True)
        at = cv2.projectPoints(
            pose.apply(points), np.zeros(3), np.zeros(3), camera.matrix(), np.array(camera.distortion)
        )[0].reshape(-1, 2)
        linear = np.stack([table[image[..., k], k] for k in range(3)], -1)
        clips = cv2.dilate((image.max(-1) >= CLIPPED).astype(np.float32), np.ones((3, 3)))
        good = np.ones(len(points), bool)
        normal = turn[:, 2]
        away = 2.0 * (toward @ normal)[:, None] * normal - toward
        for probe in scene.probes:
            good &= are_seen(scene, camera, probe, pose, points)
            good &= ~_meets(probe, points, away)
        x, y = np.where(good, at.T, 0.0).astype(np.float32)
        radiance.append(_sample(cv2.blur(linear, (3, 3)), x, y))
        tells.append(good & (_sample(clips, x, y)[:, 0] <= 0.0))
        wo.append(toward @ turn)
    seen = _Seen(points, np.array(radiance), np.array(wo), np.array(tells))
    often = seen.tells.sum(0) >= VIEWS
    return _Seen(points[often], seen.radiance[:, often], seen.wo[:, often], seen.tells[:, often])


def _meets(probe: Probe, points: Array, directions: Array) -> NDArray[np.bool_]:
    """Return a mask, (n,), of the rays that pass near a ball.

    Args:
        probe: The ball.
        points: Origins of the rays, (n, 3).
        directions: Unit directions of the rays, (n, 3).
    """
    to = np.asarray(probe.center) - points
    along = (to * directions).sum(1)
    return np.asarray((along > 0.0) & ((to**2).sum(1) - along**2 < (1.6 * probe.radius) ** 2))


def _sample(image: NDArray[np.float32], x: NDArray[np.float32], y: NDArray[np.float32]) -> Array:
    """Return an image's values at pixels (x, y), (k,) each, by bilinear interpolation, (k, channels)."""
    found = cv2.remap(image, x[:, None], y[:, None], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found.reshape(len(x), -1), float)


def _look_up(maps: NDArray[np.float32], directions: Array) -> Array:
    """Return the values of a latlong map in directions (k, 3) by bilinear interpolation, (k, channels)."""
    rows, columns = maps.shape[:2]
    y = np.clip(np.arccos(np.clip(directions[:, 2], -1.0, 1.0)) / np.pi * rows - 0.5, 0.0, rows - 1.0)
    x = (np.arctan2(directions[:, 1], directions[:, 0]) / np.pi + 1.0) / 2.0 * columns + 0.5
    wrapped = np.concatenate([maps[:, -1:], maps, maps[:, :1]], axis=1)
    parts = [
        _sample(wrapped, *np.split(np.stack([x, y]).astype(np.float32)[:, low : low + 30_000].reshape(-1), 2))
        for low in range(0, len(x), 30_000)  # the limit of ``cv2.remap``
    ]
    return np.concatenate(parts)


def _mirror(wo: Array, roughness: float, seed: int) -> tuple[Array, Array]:
    """Return directions reflected by visible GGX microfacets [DB23], and their weights.

    Args:
        wo: Unit directions toward the camera, in the table's frame, (n, 3).
        roughness: Roughness of the table.
        seed: Seed of the random numbers.

    Returns:
        Directions, (n, RAYS, 3); and weights, which include Fresnel's factor, (n, RAYS).
    """
    alpha, shift = roughness**2, np.random.default_rng(seed).random((len(wo), 1, 2))
    steps = np.arange(RAYS)[None]
    turn, height = 2.0 * np.pi * ((steps / RAYS + shift[..., 0]) % 1.0), (steps * 0.6180339887 + shift[..., 1]) % 1.0
    view = wo[:, None]
    stretched = np.concatenate([alpha * view[..., :2], view[..., 2:]], -1)
    stretched /= np.linalg.norm(stretched, axis=-1, keepdims=True)
    z = (1.0 - height) * (1.0 + stretched[..., 2]) - stretched[..., 2]
    ring = np.sqrt(np.clip(1.0 - z * z, 0.0, 1.0))
    facet = np.stack([ring * np.cos(turn), ring * np.sin(turn), z], -1) + stretched
    facet = np.concatenate([alpha * facet[..., :2], np.maximum(facet[..., 2:], 1e-6)], -1)
    facet /= np.linalg.norm(facet, axis=-1, keepdims=True)
    cosine = (facet * view).sum(-1)
    wi = 2.0 * cosine[..., None] * facet - view
    own, other = _masking(view[..., 2], alpha), _masking(wi[..., 2], alpha)
    fresnel = USUAL + (1.0 - USUAL) * np.clip(1.0 - cosine, 0.0, 1.0) ** 5
    return wi, np.where(wi[..., 2] > 0.0, fresnel * (1.0 + own) / (1.0 + own + other), 0.0)


def _masking(cosine: Array, alpha: float) -> Array:
    """Return Smith's auxiliary function Lambda of GGX for the cosine of a direction's angle to the normal."""
    return np.asarray(0.5 * (np.sqrt(1.0 + alpha**2 * (1.0 / np.maximum(cosine, 1e-4) ** 2 - 1.0)) - 1.0))


def _explain(seen: _Seen, environment: NDArray[np.float32], turn: Array, roughness: float, hot: float) -> _Fit:
    """Return the fit of an environment's reflection to the differences between views.

    Args:
        seen: Observations.
        environment: Environment, (rows, 2 rows, 3).
        turn: Rotation from the table's frame to the world, (3, 3).
        roughness: Roughness of the table.
        hot: Radiance from which light may have been clipped.
    """
    clips = cv2.dilate((environment.max(-1) >= hot).astype(np.float32), np.ones((3, 3)))
    known = np.where(clips[..., None] > 0.0, np.minimum(environment, hot), environment).astype(np.float32)
    rest = np.stack([clips, np.ones_like(clips)], axis=-1)
    brought = np.zeros((*seen.tells.shape, 5))
    for view, tells in enumerate(seen.tells):
        wi, weight = _mirror(seen.wo[view, tells], roughness, view)
        toward = (wi @ turn.T).reshape(-1, 3)
        radiance = np.concatenate([_look_up(part, toward) for part in (known, rest)], axis=1).reshape(*weight.shape, 5)
        brought[view, tells] = (weight[..., None] * radiance).mean(1)
    terms = [brought[..., :3] - brought[..., 4:] * seen.mean]
    if brought[..., 3].max() > 1e-4:
        terms.append(np.repeat(brought[..., 3:4], 3, axis=-1))
    return _solve(seen, terms)


def _solve(seen: _Seen, terms: list[Array]) -> _Fit:
    """Return the robust least-squares fit of terms, (k, n, 3), and of exposures to the differences between views."""
    mean, trust = seen.mean, np.ones_like(seen.radiance)
    views = np.arange(len(seen.radiance))[:, None, None]
    drifts = [mean * (views == view) for view in range(1, len(views))]
    for _ in range(ROUNDS):
        weight = trust * seen.tells[..., None] / mean**2
        total = np.maximum(weight.sum(0), 1e-12)

        def differ(values: Array, weight: Array = weight, total: Array = total) -> Array:
            return np.asarray((values - (values * weight).sum(0) / total) * np.sqrt(weight)).ravel()

        matrix = np.stack([differ(one) for one in [*terms, *drifts]], axis=1)
        scale = np.linalg.norm(matrix, axis=0) + 1e-12
        matrix, aim = matrix / scale, differ(seen.radiance)
        solution = np.linalg.solve(matrix.T @ matrix + 1e-7 * np.eye(len(scale)), matrix.T @ aim)
        left = (aim - matrix @ solution).reshape(seen.radiance.shape) / np.sqrt(np.maximum(weight, 1e-12))
        off = np.abs(left) / mean
        trust = 1.0 / (1.0 + (off / (2.5 * _scatter(seen, off))) ** 2) ** 2
    return _Fit((solution / scale)[: len(terms)], off)


def _scatter(seen: _Seen, off: Array) -> float:
    return 1.4826 * float(np.median(off[seen.tells])) + 1e-6


def _cost(seen: _Seen, off: Array, scatter: float) -> float:
    """Return the mean of squared residuals, in units of three times the scatter and at most 1 each."""
    return float(np.minimum((off[seen.tells] / (3.0 * scatter)) ** 2, 1.0).mean())
