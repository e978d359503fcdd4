"""Position of a mirror ball, accurate to a fraction of a millimetre, from its mirror image of the receiver.

A ball's outline is poorly suited for measurement. At the rim, a mirror reflects the surface right behind it at nearly
full strength, so the outline is a step of a few percent, next to much stronger reflections inside it. The reflections
themselves contain more information. A ray from the camera is mirrored by the ball toward the receiver, which the same
frame also shows directly. For a ball at c, every pixel x of the ball that mirrors a visible point of a proxy therefore
has a predicted radiance,

    I(x) = reflectance * I(project(hit(x, c))),

for diffuse surfaces. The printed card next to the ball is full of edges, which move by several pixels per millimetre of
the centre in every direction, including height. The centre minimises the residuals e between square roots of radiance,
under the robust cost rho = e^2 / (e^2 + s^2) (Geman-McClure), which rejects clutter outside the model, specular
reflections and shadows. It is found by Gauss-Newton with numerical derivatives and with decreasing s and step sizes.
The camera sees the receiver much larger than its mirror image, so the direct picture is blurred before the comparison.

The centre is least certain along the line of sight, where edges move slowly. The height of a ball on a surface is
better known than its position, so deviations from the given height are penalised by ``HEIGHT_COST``.

The covariance follows from the curvature at the minimum: (sigma^2 + ``UNMODELLED``^2) (J^T W J)^-1, times
``CORRELATED``, because neighbouring samples share pixels and model errors.

The radius is estimated in the same way where outlines are unreliable. On the white card, a ball's rim is a faint edge,
because it mirrors the card behind it. Seen from above, the mirrored edge of the card inside the rim is stronger in
every frame, and so are the rings printed around the cross; outlines may then agree on a wrong ball. A ball with the
right radius explains twice as much of the mirror image as one that is a tenth smaller, at any position.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from warp_ar.ball.surface_rays import dot, nearest_shape, shapes_of
from warp_ar.kernels.color import decode_table
from warp_ar.scene import Camera, Marker, Pose, Probe, Proxy, Scene
from warp_ar.scene.pixel_rays import project, undistorted
from warp_ar.sources.source import Source
from warp_ar.tracking.tracking import Tracker, TrackState

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

BLURS = ((2.0, 8.0), (0.0, 3.0))
"""Standard deviations in pixels of the blur of ball and receiver, for the search and for the fit. The mirror image of
the receiver is about a tenth of its direct size. Without the blur for the search, 5 of 16 positions by two frames move
by up to 1 mm."""
SEARCH_STEP = 2e-3
"""Distance in metres between candidate positions; from there, edges blurred by 8 pixels lead to the minimum."""
SEARCH_HEIGHT = 4e-3
"""Range of candidate heights, up and down, in metres; it is small because a ball stands on a surface."""
SEARCH_ACROSS = 24
"""Samples across the ball during the search."""
STARTS = 4
"""Number of candidate positions from which the fit starts."""
SCALES = (0.1, 0.05)
"""Residual s of each stage, in square roots of camera values, at which a sample has half its weight."""
STEPS = 8
"""Largest number of Gauss-Newton steps in one stage."""
DONE = 2e-5
"""Step length in metres below which a stage ends."""
SAME = 1e-4
"""Distance in metres below which two solutions are the same."""
LONGEST = 4e-3
"""Largest step length in metres, because edges are thin."""
DIFFERENCE = 2e-4
"""Displacement of the centre in metres for numerical derivatives."""
ACROSS = 60
"""Largest number of samples across the ball."""
RIM = 0.97
"""Share of the ball's radius within which samples lie; beyond it, the blur mixes in the background."""
FEWEST = 200
"""Smallest number of samples for a result."""
HEIGHT_COST = 8e3
"""Cost per square metre of deviation from the given height: 0.008 for 1 mm."""
CORRELATED = 50.0
"""Number of neighbouring samples that count as one independent sample."""
MOST_DEVIATION = 6e-4
"""Largest standard deviation of an accepted fit, metres: that of a measurement with a ruler."""
MOST_ERROR = 0.36
"""Largest mean cost at which the frames count as explained: 0.1 to 0.2 on path-traced scenes, 0.3 for a small ball in
compressed video, 0.3 to 0.6 at wrong positions."""
RIVAL_DISTANCE = 4e-3
RIVAL_SHARE = 0.75
"""Largest ratio of the cost at the minimum to the cost four millimetres away; at a wrong position the ratio is
larger."""
DESK = Proxy("plane", size=(2.0, 2.0))
"""Plane around the marker that is assumed for a scene without proxies."""
REFINE_VIEWS = 3
REFINE_SEARCH = 0.006
"""Half width of the search, metres: the error of a position that was measured with a ruler."""
UNMODELLED = 0.02
"""Square root of radiance by which even a correct prediction may be wrong, for example by specular reflection; on a
uniform receiver it keeps the covariance large."""
SPAN = 0.14
"""Relative error of the given radius that is searched."""
RADIUS_STEP = 0.02
"""Step between tried radii, relative to the given radius."""
ASIDE = 3
"""Distance from the best radius, in steps, of the radii whose costs are compared with the best cost."""
DISTINCT = 0.9
"""Largest ratio of the least cost to the costs ``ASIDE`` at which the radius counts as determined: 0.6 to 0.87 on
rendered desks."""
EXPLAINED = 0.42
"""Largest mean cost at which a ball explains its mirror image: 0.2 to 0.39 on rendered desks, 0.5 and more
otherwise."""
HOPELESS = 0.6
"""Mean cost of the first few radii above which the search stops: 0.25 to 0.45 on rendered scenes up to six steps from
the right radius, 0.7 and more without a ball."""
RADIUS_VIEWS = 3
"""Number of frames that are compared; each takes a second."""
DEVIATION = 0.01
"""Standard deviation of the estimated radius, relative to it; on rendered scenes the error is 0.003, at most 0.012."""
BETTER = 0.9
"""Largest ratio of costs at which one ball explains the frames better than another."""
_BOUND = 1e-4
"""Tolerance of the occlusion test, in metres and as a share of the distance."""


@dataclasses.dataclass(frozen=True)
class BallFit:
    """Result of fitting a ball's position."""

    center: Array
    """Centre in the world, metres, (3,)."""
    deviation: float
    """Standard deviation along the least certain axis, metres."""
    error: float
    """Mean cost at the centre, 0 (all samples agree) to 1 (none does)."""
    error_before: float
    """Mean cost at the initial centre."""
    samples: int
    """Number of pixels that were used."""
    rival: float
    """Smallest cost of centres at the distance ``RIVAL_DISTANCE`` from the fitted one."""

    @property
    def is_good(self) -> bool:
        """Return True if the position is certain and explains the frames."""
        distinct = self.error < RIVAL_SHARE * self.rival and self.error <= self.error_before + 0.01
        return self.deviation < MOST_DEVIATION and self.error < MOST_ERROR and distinct


class BallView:
    """One frame, prepared for comparing a ball's mirror image with the direct picture."""

    def __init__(self, image: Image, pose: Pose, camera: Camera, table: NDArray[np.float32]) -> None:
        self.pose, self.camera = pose, camera
        inverse = pose.inverse()
        self.eye, self._world_from_camera = inverse.translation, inverse.rotation
        linear = np.stack([table[image[..., channel], channel] for channel in range(3)], -1)
        clipped = (image >= 254).any(-1).astype(np.float32)
        self._linear = np.dstack([linear, clipped**2])

    @functools.cached_property
    def coarse(self) -> list[Any]:
        """Return pictures of ball and receiver for the search: square roots of radiance and of the clipped share."""
        return self._blurred(*BLURS[0])

    @functools.cached_property
    def fine(self) -> list[Any]:
        """Return pictures of ball and receiver for the fit, with the same channels as ``coarse``."""
        return self._blurred(*BLURS[1])

    def _blurred(self, *blurs: float) -> list[Any]:
        return [np.sqrt(cv2.GaussianBlur(self._linear, (0, 0), blur) if blur else self._linear) for blur in blurs]

    def sample(self, picture: Any, pixels: Array) -> Array:
        """Return square roots of radiance and of the clipped share at pixels, (n, 4)."""
        if not len(pixels):
            return np.zeros((0, 4))
        x, y = pixels.astype(np.float32).T
        return np.asarray(
            cv2.remap(picture, x[None], y[None], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0], np.float64
        )

    def rays(self, pixels: Array) -> Array:
        """Return unit directions of pixels' rays in the world, (n, 3)."""
        d = np.column_stack([undistorted(self.camera, pixels), np.ones(len(pixels))])
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        return np.asarray(d @ self._world_from_camera.T, np.float64)

    def project(self, points: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Return pixels (n, 2) of world points, and a mask of those inside the frame."""
        pixels = project(self.camera, self.pose.apply(points))
        return pixels, _within(pixels, 2.0, (self.camera.width - 3, self.camera.height - 3))

    def disc(self, center: Array, radius: float, across: int) -> Array:
        """Return the pixels of samples on a ball's disc, (n, 2), at most ``across`` along its diameter."""
        c = self.pose.apply(center)
        if c[2] < 2 * radius:
            return np.zeros((0, 2))
        middle, _ = self.project(center[None])
        reach = self.camera.fx * radius / c[2]
        grid = np.linspace(-RIM, RIM, int(np.clip(2 * reach, 8, across)))
        x, y = np.meshgrid(grid, grid)
        inside = x**2 + y**2 < RIM**2
        pixels = middle + reach * np.column_stack([x[inside], y[inside]])
        edge = (self.camera.width - 2, self.camera.height - 2)
        return np.asarray(pixels[_within(pixels, 1.0, edge)], np.float64)


# Sums and maxima over two or three columns are unrolled: NumPy is several times slower along a short last axis.


def _within(pixels: Array, low: float, high: tuple[float, float]) -> NDArray[np.bool_]:
    """Return a mask of pixels (n, 2) inside a rectangle."""
    x, y = pixels[:, 0], pixels[:, 1]
    return np.asarray((x > low) & (x < high[0]) & (y > low) & (y < high[1]))


class _Receiver:
    """Planes and boxes that rays can hit, and the other balls, which occlude them."""

    def __init__(self, proxies: Sequence[Proxy], others: Sequence[Probe]) -> None:
        known = [proxy for proxy in proxies if proxy.shape in ("plane", "box")]
        self._shapes = shapes_of(known or [DESK])
        self._others = [(np.array(probe.center), probe.radius) for probe in others]
        self.hides = len(self._shapes) > 1 or bool(self._others) or any(half[2] > 0.0 for _, _, half in self._shapes)
        """True if a hit can be occluded; a single plane occludes nothing."""

    def trace(self, origin: Array, direction: Array) -> Array:
        """Return the distance to the nearest plane or box, (n,).

        Infinite if there is none or another ball is in front.
        """
        nearest, _ = nearest_shape(self._shapes, origin, direction)
        for center, radius in self._others:
            nearest[_meet_ball(center, radius, origin, direction) < nearest] = np.inf
        return nearest


def _meet_ball(center: Array, radius: float, origin: Array, direction: Array) -> Array:
    """Return the distance along unit directions to a ball; infinite for rays that miss it."""
    o = origin - center
    b = dot(o, direction)
    disc = b**2 - dot(o, o) + radius**2
    t = -b - np.sqrt(np.maximum(disc, 0.0))
    return np.where((disc > 0.0) & (t > 0.0), t, np.inf)


_Samples = tuple[Array, Array]
"""Unit directions in the world, (n, 3), and square roots of radiance and of the clipped share there, (n, 4)."""


@dataclasses.dataclass(frozen=True)
class _Task:
    """One fit: the views and the ball, and the cost of a centre."""

    views: Sequence[BallView]
    probe: Probe
    receiver: _Receiver
    is_coarse: bool = False

    def samples(self, view: BallView, center: Array) -> _Samples:
        """Return the samples of a ball in one view."""
        pixels = view.disc(center, self.probe.radius, SEARCH_ACROSS if self.is_coarse else ACROSS)
        picture, _ = view.coarse if self.is_coarse else view.fine
        return view.rays(pixels), view.sample(picture, pixels)

    def residuals(self, view: BallView, center: Array, seen: _Samples) -> tuple[Array, NDArray[np.bool_]]:
        """Return residuals, observed minus predicted, (n, 3), and a mask of samples with a prediction.

        Other residuals are 0.
        """
        radius, eye, (directions, values) = self.probe.radius, view.eye, seen
        t = _meet_ball(center, radius, np.broadcast_to(eye, directions.shape), directions)
        # Samples without prediction are skipped: about half of them.
        index = np.flatnonzero(np.isfinite(t) & (values[:, 3] < 0.1))
        direction = directions[index]
        point = eye + t[index, None] * direction
        normal = (point - center) / radius
        mirrored = direction - 2.0 * dot(direction, normal)[:, None] * normal
        s = self.receiver.trace(point, mirrored)
        met = np.isfinite(s)
        index, hit = index[met], point[met] + s[met, None] * mirrored[met]
        places, inside = view.project(hit)
        index, hit, places = index[inside], hit[inside], places[inside]
        away = hit - eye
        distance = np.sqrt(dot(away, away))
        away /= np.maximum(distance, 1e-9)[:, None]
        origin = np.broadcast_to(eye, away.shape)
        # The ball with a margin, because its pixels blur into the surroundings.
        shown = _meet_ball(center, 1.1 * radius, origin, away) > distance
        if self.receiver.hides:
            shown &= self.receiver.trace(origin, away) > distance * (1.0 - _BOUND) - _BOUND
        _, picture = view.coarse if self.is_coarse else view.fine
        wanted = view.sample(picture, places)
        shown &= wanted[:, 3] < 0.1
        index, wanted = index[shown], wanted[shown]
        residuals, told = np.zeros((len(t), 3)), np.zeros(len(t), bool)
        residuals[index] = values[index, :3] - wanted[:, :3] * np.sqrt(self.probe.reflectance)
        told[index] = True
        return residuals, told

    def cost(self, center: Array, scale: float) -> tuple[float, int]:
        """Return the mean of rho over all samples, and the number of samples."""
        total, count = 0.0, 0
        for view in self.views:
            e, told = self.residuals(view, center, self.samples(view, center))
            squared = dot(e, e)[told] / 3.0
            total += float((squared / (squared + scale**2)).sum())
            count += len(squared)
        height = center[2] - self.probe.center[2]
        return (total / count if count else 1.0) + HEIGHT_COST * height**2, count

    def normal_equations(self, center: Array, scale: float) -> tuple[Array, Array, float]:
        """Return J^T W J (3, 3), J^T W e (3,), and the weighted variance of a residual."""
        matrix, vector = np.zeros((3, 3)), np.zeros(3)
        squares, weights, count = 0.0, 0.0, 0
        for view in self.views:
            seen = self.samples(view, center)
            e, told = self.residuals(view, center, seen)
            # Only samples with a prediction at the centre and at all displaced centres are used.
            seen, e = (seen[0][told], seen[1][told]), e[told]
            columns, told = [], np.ones(len(e), bool)
            for axis in np.eye(3):
                ahead, told_ahead = self.residuals(view, center + DIFFERENCE * axis, seen)
                behind, told_behind = self.residuals(view, center - DIFFERENCE * axis, seen)
                columns.append((ahead - behind) / (2.0 * DIFFERENCE))
                told = told & told_ahead & told_behind
            jacobian, e = np.stack(columns, -1)[told], e[told]
            weight = (scale**2 / (scale**2 + dot(e, e) / 3.0)) ** 2
            matrix += np.einsum("n,nci,ncj->ij", weight, jacobian, jacobian)
            vector += np.einsum("n,nci,nc->i", weight, jacobian, e)
            squares += float((weight * dot(e, e) / 3.0).sum())
            weights += float(weight.sum())
            count += len(e)
        matrix[2, 2] += count * scale**2 * HEIGHT_COST
        vector[2] += count * scale**2 * HEIGHT_COST * (center[2] - self.probe.center[2])
        return matrix, vector, squares / max(weights, 1e-12)

    def descend(self, center: Array, scale: float) -> Array:
        """Minimise by Gauss-Newton, with steps shortened until they lower the cost."""
        cost, count = self.cost(center, scale)
        for _ in range(STEPS):
            matrix, vector, _ = self.normal_equations(center, scale)
            step = -np.linalg.solve(matrix + (1e-9 * np.trace(matrix) + 1e-12) * np.eye(3), vector)
            step *= min(1.0, LONGEST / max(float(np.linalg.norm(step)), 1e-12))
            for _ in range(4):
                # Fewer samples are easier to explain: the solution must not turn the ball away from the receiver.
                better, left = self.cost(center + step, scale)
                if better < cost and left >= 0.8 * count:
                    break
                step *= 0.4
            else:
                return center
            center, cost = center + step, better
            if np.linalg.norm(step) < DONE:
                break
        return center


def fit_ball(
    frames: Sequence[tuple[Image, Pose]],
    camera: Camera,
    probe: Probe,
    proxies: Sequence[Proxy] = (),
    others: Sequence[Probe] = (),
    *,
    search: float = 0.01,
) -> BallFit | None:
    """Find a ball near its given position.

    Args:
        frames: uint8 RGB pictures with ``camera_from_world``; one is enough, several from different sides are better.
        camera: The camera of all of them.
        probe: The ball with an approximate centre, the radius and the reflectance.
        proxies: Proxies of the scene; without planes or boxes, a plane at the marker's height is assumed.
        others: Other balls.
        search: Half width in metres, along x and y, of the searched region around the approximate centre.

    Returns:
        The fit, or None if the ball mirrors too little of the receiver. Check ``is_good`` before using it.
    """
    fine = _Task(prepare_views(frames, camera), probe, _Receiver(proxies, others))
    coarse = dataclasses.replace(fine, is_coarse=True)
    start: Array = np.array(probe.center, np.float64)
    before, count = fine.cost(start, SCALES[-1])
    if count < FEWEST:
        return None
    steps = np.arange(-round(search / SEARCH_STEP), round(search / SEARCH_STEP) + 1)
    heights = np.arange(-round(SEARCH_HEIGHT / SEARCH_STEP), round(SEARCH_HEIGHT / SEARCH_STEP) + 1)
    places = start + SEARCH_STEP * np.stack(np.meshgrid(steps, steps, heights), -1).reshape(-1, 3)
    ranked = places[np.argsort([coarse.cost(place, SCALES[0])[0] for place in places])]
    found: list[tuple[float, int, Array]] = []
    led: list[Array] = []
    for place in [start, *ranked[: STARTS - 1]]:
        center = fine.descend(place if place is start else coarse.descend(place, SCALES[0]), SCALES[0])
        if all(np.linalg.norm(center - other) >= SAME for other in led):
            led.append(center)
            for scale in SCALES[1:]:
                center = fine.descend(center, scale)
            found.append((*fine.cost(center, SCALES[-1]), center))
    error, samples, center = min(found, key=lambda one: one[0])
    matrix, _, variance = fine.normal_equations(center, SCALES[-1])
    worst = float(np.linalg.eigvalsh(matrix)[0])
    deviation = float(np.sqrt(CORRELATED * (variance + UNMODELLED**2) / worst)) if worst > 0.0 else np.inf
    around = [center + sign * RIVAL_DISTANCE * axis for axis in np.eye(3) for sign in (-1.0, 1.0)]
    rival = min(fine.cost(place, SCALES[-1])[0] for place in around)
    return BallFit(center, deviation, error, before, samples, rival)


def prepare_views(frames: Sequence[tuple[Image, Pose]], camera: Camera) -> tuple[BallView, ...]:
    """Prepare frames, RGB uint8 with ``camera_from_world``, once for all balls that are tried."""
    table = decode_table(camera.transfer)
    return tuple(BallView(image, pose, camera, table) for image, pose in frames)


def mirrored_error(
    views: Sequence[BallView], probe: Probe, proxies: Sequence[Proxy] = (), others: Sequence[Probe] = ()
) -> tuple[float, Array] | None:
    """Return the least mean cost of a ball of a given radius, by its mirror image in the frames, and the best centre.

    Args:
        views: The frames.
        probe: The ball, with a centre accurate to a few millimetres.
        proxies: Proxies of the scene; without planes or boxes, a plane at the marker's height is assumed.
        others: Other balls.

    Returns:
        Mean cost, 0 (all samples agree) to 1, and the centre (3,); None if the ball mirrors too little of the receiver.
    """
    task = _Task(views, probe, _Receiver(proxies, others))
    center: Array = np.array(probe.center, np.float64)
    if task.cost(center, SCALES[-1])[1] < FEWEST:
        return None
    for scale in SCALES:
        center = task.descend(center, scale)
    return task.cost(center, SCALES[-1])[0], center


def mirrored_radius(
    views: Sequence[tuple[Image, Pose]],
    camera: Camera,
    probe: Probe,
    proxies: Sequence[Proxy],
    others: Sequence[Probe] = (),
) -> Probe | None:
    """Return the ball with the radius and centre that best explain its mirror image; None if they are not determined.

    Args:
        views: RGB frames with ``camera_from_world``.
        camera: The camera.
        probe: The given ball: it stands on a surface, its radius is accurate to ``SPAN``, its centre to millimetres.
        proxies: Proxies of the scene.
        others: Other balls.
    """
    few = prepare_views(views[:: -(-len(views) // RADIUS_VIEWS)], camera)
    steps = round(SPAN / RADIUS_STEP)
    costs: dict[int, float] = {}
    balls: dict[int, Probe] = {}

    def attempt(k: int, place: tuple[float, float, float]) -> None:
        """Store the least cost of radius number ``k`` and its ball, searched from a place at which the ball stands."""
        radius = probe.radius * (1.0 + RADIUS_STEP * k)
        start = (place[0], place[1], probe.center[2] + radius - probe.radius)
        ball = dataclasses.replace(probe, center=start, radius=radius)
        found = mirrored_error(few, ball, proxies, others)
        if found is not None and found[0] < costs.get(k, math.inf):
            x, y, z = (float(value) for value in found[1])
            costs[k], balls[k] = found[0], dataclasses.replace(ball, center=(x, y, z))

    # One of the first few radii is within four steps of the right one, and is better than no ball.
    first = [k for k in range(-steps, steps + 1) if k % 4 == 3 and abs(k) < steps]
    for k in first:
        attempt(k, probe.center)
    if not costs or min(costs.values()) > HOPELESS:
        return None
    for k in range(-steps, steps + 1, 2):
        if k not in first:
            attempt(k, probe.center)
    # Outward from the best radius, each starting from its neighbour's centre.
    best = min(costs, key=lambda k: costs[k])
    for way in (1, -1):
        for k in range(best + way, best + (ASIDE + 2) * way, way):
            if k - way in balls:
                attempt(k, balls[k - way].center)
    best = min(costs, key=lambda k: costs[k])
    near = [k for k in costs if abs(k - best) <= 2]
    aside = [costs[k] for k in costs if abs(k - best) == ASIDE]
    if len(near) < 5 or len(aside) < 2 or costs[best] > EXPLAINED or costs[best] > DISTINCT * min(aside):
        return None
    bend, slope, _ = np.polyfit(near, [costs[k] for k in near], 2)
    part = float(np.clip(-0.5 * slope / bend, best - 1.0, best + 1.0)) - best if bend > 0.0 else 0.0
    radius = probe.radius * (1.0 + RADIUS_STEP * (best + part))
    px, py, pz = balls[best].center
    return dataclasses.replace(probe, center=(px, py, pz + radius - balls[best].radius), radius=float(radius))


def explains_better(
    views: Sequence[tuple[Image, Pose]],
    camera: Camera,
    probe: Probe,
    other: Probe,
    proxies: Sequence[Proxy],
    others: Sequence[Probe] = (),
) -> bool:
    """Return True if a ball explains the mirror image, and much better than another ball does."""
    few = prepare_views(views[:: -(-len(views) // RADIUS_VIEWS)], camera)
    found = [mirrored_error(few, ball, proxies, others) for ball in (probe, other)]
    if found[0] is None or found[0][0] > EXPLAINED:
        return False
    return found[1] is None or found[0][0] < BETTER * found[1][0]


def posed_frames(source: Source, marker: Marker, camera: Camera, most: int) -> list[tuple[Image, Pose]]:
    """Return frames with a well visible marker and their poses; of alternating exposures, those of the longest.

    Args:
        source: Source of frames; recorded ones are read from their start.
        marker: The marker or board.
        camera: Camera at the source's frame size.
        most: Largest number of frames to read.
    """
    tracker = Tracker(marker, camera)
    found = []
    for frame in itertools.islice(source, most):
        if frame.exposure_time not in (None, *source.exposures[:1]):
            continue
        track = tracker.track(frame.image, frame.time)
        if track.state is TrackState.TRACKED and track.pose is not None and track.quality > 0.5:
            found.append((frame.image, track.pose))
    return found


def refine_balls(scene: Scene, source: Source, *, frames: int = 24) -> tuple[Scene, tuple[BallFit | None, ...]]:
    """Return the scene with each ball at the position that the frames show, if that position is certain.

    Args:
        scene: Scene whose balls are accurate to 6 mm.
        source: Source of frames; a device's frames are consumed.
        frames: Number of frames to read; ``REFINE_VIEWS`` of those that show the marker are compared.

    Returns:
        The scene, and the fit of each ball. A ball whose fit is not ``is_good`` is not moved.
    """
    camera = scene.camera.scaled_to(*source.size)
    views = posed_frames(source, scene.marker, camera, frames)
    views = views[:: max(-(-len(views) // REFINE_VIEWS), 1)]
    fits: list[BallFit | None] = []
    probes = []
    for probe in scene.probes:
        others = [other for other in scene.probes if other is not probe]
        fixed = views and probe.marker is None
        fit = fit_ball(views, camera, probe, scene.proxies, others, search=REFINE_SEARCH) if fixed else None
        fits.append(fit)
        if fit is not None and fit.is_good:
            x, y, z = (float(v) for v in fit.center)
            probe = dataclasses.replace(probe, center=(x, y, z))
        probes.append(probe)
    return dataclasses.replace(scene, probes=tuple(probes)), tuple(fits)
