"""Place of a mirror ball, to a fraction of a millimetre, from what it mirrors of the receiver around it.

A ball's outline is a poor edge to measure by: at the rim a mirror reflects what lies right behind it, nearly at full
strength, so that the outline is a step of some percent, and the reflections that crowd inside it are far stronger. The
same reflections say more. A ray from the camera to the ball goes on to the receiver, whose picture the same frame
holds; so for a ball at c every pixel x of it that mirrors a visible point of a proxy has a prediction,

    I(x) = reflectance * I(project(hit(x, c))),

linear, for surfaces that scatter light alike to all sides. The printed card beside the ball is full of edges, and they
move by some pixels per millimetre in every direction, height included. The centre is what makes the residuals e, taken
between square roots of radiance, least under a cost that redescends (Geman-McClure, rho = e^2 / (e^2 + s^2)): clutter
that the scene leaves out, shine and shadows are outvoted. Gauss-Newton with numerical derivatives, s and the steps
shrinking. The camera sees the receiver far larger than the ball does, so it is blurred before it is compared.

Along the line of sight the centre is determined least: there, edges move slowly. But a ball stands on something, and
its height is better known than its place; so the height as given has a say, ``HEIGHT_COST``.

Confidence comes from the curvature at the end: (sigma^2 + ``UNMODELLED``^2) (J^T W J)^-1, times ``CORRELATED`` because
neighbouring samples share pixels and errors of the model.

The radius is told in the same way where outlines are in doubt. On the white card a ball's rim is a faint edge, for what
a mirror reflects there is what lies behind it; from above, the edge of the card's mirror image inside the rim is
stronger, in every frame alike, and so are the rings printed around the cross. Outlines then agree on a ball that is not
there. Of the right radius it explains twice as much as of one a tenth smaller, wherever that ball is put.
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
from warp_ar.sources.sources import Source
from warp_ar.tracking.tracking import Tracker, TrackState

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

BLURS = ((2.0, 8.0), (0.0, 3.0))
"""Pixels: standard deviations by which ball and receiver are blurred, for the search and for the fit. The ball shows
the receiver about a tenth as large. Without the search's own, 5 of 16 places told by two frames move by up to 1 mm."""
SEARCH_STEP = 2e-3
"""Metres between places that are tried first; edges blurred by 8 pixels lead from there."""
SEARCH_HEIGHT = 4e-3
"""Metres up and down that are tried: a ball stands on something, so its height is better known."""
SEARCH_ACROSS = 24
"""Samples across the ball while searching."""
STARTS = 4
"""Places that the fit starts from."""
SCALES = (0.1, 0.05)
"""Residuals, in square roots of camera values, at which a sample has half its say; stage by stage."""
STEPS = 8
"""Most Gauss-Newton steps of one stage."""
DONE = 2e-5
"""Metres: a shorter step ends a stage."""
SAME = 1e-4
"""Metres: starts that lead closer together lead to one place."""
LONGEST = 4e-3
"""Metres: no step is longer, for the edges are thinner."""
DIFFERENCE = 2e-4
"""Metres by which the centre is moved for derivatives."""
ACROSS = 60
"""Samples across the ball at most."""
RIM = 0.97
"""Share of the ball's radius within which samples lie: beyond, what is behind it shines in."""
FEWEST = 200
"""Samples without which nothing is said."""
HEIGHT_COST = 8e3
"""Cost per square metre of leaving the height as given: 0.008 for 1 mm."""
CORRELATED = 50.0
"""Number of neighbouring samples count as one."""
MOST_DEVIATION = 6e-4
"""Metres: a worse fit is no improvement on a ruler."""
MOST_ERROR = 0.36
"""Mean cost up to which the frames are explained: 0.1 to 0.2 on path-traced desks, 0.3 where a small ball is seen
through a video codec, 0.3 to 0.6 in wrong places."""
RIVAL_DISTANCE = 4e-3
RIVAL_SHARE = 0.75
"""Four millimetres away, metres, the cost must be so much higher: a wrong place is not that much better than others."""
DESK = Proxy("plane", size=(2.0, 2.0))
"""Desk that is taken to lie around the marker where a scene models nothing."""
REFINE_VIEWS = 3
REFINE_SEARCH = 0.006
"""Metres: a ruler is no worse, and less takes less time."""
UNMODELLED = 0.02
"""Square root of radiance: what even a perfect match may be off by, such as shine; an even receiver tells nothing."""
SPAN = 0.14
"""Share of the given radius by which it may be off."""
RADIUS_STEP = 0.02
"""Step between tried radii, relative to the given radius."""
ASIDE = 3
"""Distance from the best radius, in steps, of the radii whose costs are compared with the best."""
DISTINCT = 0.9
"""Largest ratio of the least cost to the costs ``ASIDE`` at which the radius counts as determined: 0.6 to 0.87 on
rendered desks."""
EXPLAINED = 0.42
"""Largest mean cost at which a ball explains its mirror image: 0.2 to 0.39 on rendered desks, 0.5 and more
otherwise."""
HOPELESS = 0.6
"""Mean cost of a few radii beyond which no other explains the frames: 0.25 to 0.45 on rendered desks up to six steps
beside the right one, 0.7 and more without a ball."""
RADIUS_VIEWS = 3
"""Frames that are compared: each costs a second."""
DEVIATION = 0.01
"""Share of the radius: standard deviation of what is found; on rendered desks it is off by 0.003, at most by 0.012."""
BETTER = 0.9
"""Share of another ball's cost below which a given one explains the frames better."""
_BOUND = 1e-4
"""Metres, and share of the distance: tolerance of what hides a point from the camera."""


@dataclasses.dataclass(frozen=True)
class BallFit:
    """Place where a ball was found."""

    center: Array
    """World, metres, (3,)."""
    deviation: float
    """Standard deviation along the worst axis, metres."""
    error: float
    """Mean cost there, 0 (all samples agree) to 1 (none does)."""
    error_before: float
    """The same where the search began."""
    samples: int
    """Pixels that had a say."""
    rival: float
    """Least cost ``RIVAL_DISTANCE`` away."""

    @property
    def is_good(self) -> bool:
        """Return whether it is determined, and explains the frames."""
        distinct = self.error < RIVAL_SHARE * self.rival and self.error <= self.error_before + 0.01
        return self.deviation < MOST_DEVIATION and self.error < MOST_ERROR and distinct


class BallView:
    """One frame, prepared for comparing what balls in it mirror with what it shows."""

    def __init__(self, image: Image, pose: Pose, camera: Camera, table: NDArray[np.float32]) -> None:
        self.pose, self.camera = pose, camera
        inverse = pose.inverse()
        self.eye, self._world_from_camera = inverse.translation, inverse.rotation
        linear = np.stack([table[image[..., channel], channel] for channel in range(3)], -1)
        clipped = (image >= 254).any(-1).astype(np.float32)
        self._linear = np.dstack([linear, clipped**2])

    @functools.cached_property
    def coarse(self) -> list[Any]:
        """Pictures of ball and receiver for the search: square roots of radiance and of the share at clipping."""
        return self._blurred(*BLURS[0])

    @functools.cached_property
    def fine(self) -> list[Any]:
        """The same for the fit."""
        return self._blurred(*BLURS[1])

    def _blurred(self, *blurs: float) -> list[Any]:
        return [np.sqrt(cv2.GaussianBlur(self._linear, (0, 0), blur) if blur else self._linear) for blur in blurs]

    def sample(self, picture: Any, pixels: Array) -> Array:
        """Square roots of radiance and of the share at clipping, (n, 4)."""
        if not len(pixels):
            return np.zeros((0, 4))
        x, y = pixels.astype(np.float32).T
        return np.asarray(
            cv2.remap(picture, x[None], y[None], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0], np.float64
        )

    def rays(self, pixels: Array) -> Array:
        """Unit directions in the world, (n, 3)."""
        d = np.column_stack([undistorted(self.camera, pixels), np.ones(len(pixels))])
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        return np.asarray(d @ self._world_from_camera.T, np.float64)

    def project(self, points: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Pixels (n, 2) of world points, and which of them lie inside the frame."""
        pixels = project(self.camera, self.pose.apply(points))
        return pixels, _within(pixels, 2.0, (self.camera.width - 3, self.camera.height - 3))

    def disc(self, center: Array, radius: float, across: int) -> Array:
        """Pixels of samples on a ball, (n, 2)."""
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


# Sums and maxima over two or three columns are written out: NumPy is several times slower along a short last axis.


def _within(pixels: Array, low: float, high: tuple[float, float]) -> NDArray[np.bool_]:
    """Return which pixels (n, 2) lie inside a rectangle."""
    x, y = pixels[:, 0], pixels[:, 1]
    return np.asarray((x > low) & (x < high[0]) & (y > low) & (y < high[1]))


class _Receiver:
    """Planes and boxes that rays can meet, and the other balls, which hide them."""

    def __init__(self, proxies: Sequence[Proxy], others: Sequence[Probe]) -> None:
        known = [proxy for proxy in proxies if proxy.shape in ("plane", "box")]
        self._shapes = shapes_of(known or [DESK])
        self._others = [(np.array(probe.center), probe.radius) for probe in others]
        self.hides = len(self._shapes) > 1 or bool(self._others) or any(half[2] > 0.0 for _, _, half in self._shapes)
        """True if something can lie before what a ray meets; one plane alone hides nothing."""

    def trace(self, origin: Array, direction: Array) -> Array:
        """Distance to the nearest plane or box, (n,), infinite where there is none or another ball is before it."""
        nearest, _ = nearest_shape(self._shapes, origin, direction)
        for center, radius in self._others:
            nearest[_meet_ball(center, radius, origin, direction) < nearest] = np.inf
        return nearest


def _meet_ball(center: Array, radius: float, origin: Array, direction: Array) -> Array:
    """Distance along unit directions to a ball, infinite where it is missed."""
    o = origin - center
    b = dot(o, direction)
    disc = b**2 - dot(o, o) + radius**2
    t = -b - np.sqrt(np.maximum(disc, 0.0))
    return np.where((disc > 0.0) & (t > 0.0), t, np.inf)


_Samples = tuple[Array, Array]
"""Unit directions in the world, (n, 3), and square roots of radiance and of the share at clipping there, (n, 4)."""


@dataclasses.dataclass(frozen=True)
class _Task:
    """Views and ball that are compared."""

    views: Sequence[BallView]
    probe: Probe
    receiver: _Receiver
    is_coarse: bool = False

    def samples(self, view: BallView, center: Array) -> _Samples:
        """Return what one view shows of a ball."""
        pixels = view.disc(center, self.probe.radius, SEARCH_ACROSS if self.is_coarse else ACROSS)
        picture, _ = view.coarse if self.is_coarse else view.fine
        return view.rays(pixels), view.sample(picture, pixels)

    def residuals(self, view: BallView, center: Array, seen: _Samples) -> tuple[Array, NDArray[np.bool_]]:
        """Seen less predicted, (n, 3), and which samples have a prediction; the others' residuals are 0."""
        radius, eye, (directions, values) = self.probe.radius, view.eye, seen
        t = _meet_ball(center, radius, np.broadcast_to(eye, directions.shape), directions)
        # What is known to have no prediction is not looked at further: about half of the samples.
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
        # The ball with a margin: it bleeds into what is blurred.
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
        """Mean of rho over all samples, and how many there are."""
        total, count = 0.0, 0
        for view in self.views:
            e, told = self.residuals(view, center, self.samples(view, center))
            squared = dot(e, e)[told] / 3.0
            total += float((squared / (squared + scale**2)).sum())
            count += len(squared)
        height = center[2] - self.probe.center[2]
        return (total / count if count else 1.0) + HEIGHT_COST * height**2, count

    def normal_equations(self, center: Array, scale: float) -> tuple[Array, Array, float]:
        """J^T W J (3, 3), J^T W e (3,), and the weighted variance of a residual."""
        matrix, vector = np.zeros((3, 3)), np.zeros(3)
        squares, weights, count = 0.0, 0.0, 0
        for view in self.views:
            seen = self.samples(view, center)
            e, told = self.residuals(view, center, seen)
            # Only samples that have a prediction here and to all sides have a say: the others are not asked again.
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
        """Gauss-Newton, its steps shortened until they lower the cost."""
        cost, count = self.cost(center, scale)
        for _ in range(STEPS):
            matrix, vector, _ = self.normal_equations(center, scale)
            step = -np.linalg.solve(matrix + (1e-9 * np.trace(matrix) + 1e-12) * np.eye(3), vector)
            step *= min(1.0, LONGEST / max(float(np.linalg.norm(step)), 1e-12))
            for _ in range(4):
                # Fewer samples are cheaper to explain: the ball must not turn its back on the receiver.
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
    """Find a ball near where it is said to be.

    Args:
        frames: uint8 RGB pictures with ``camera_from_world``; one is enough, several from different sides are better.
        camera: The camera of all of them.
        probe: The ball: a rough centre, the radius and the reflectance.
        proxies: What stands on the receiver; without planes or boxes a desk at the marker's height is assumed.
        others: Other balls.
        search: Metres around the rough centre, along x and y, in which the ball is looked for.

    Returns:
        The fit, or None where too little of the receiver is mirrored; look at ``is_good`` before believing it.
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
    """Frames, RGB uint8 with ``camera_from_world``, prepared once for all balls that are tried."""
    table = decode_table(camera.transfer)
    return tuple(BallView(image, pose, camera, table) for image, pose in frames)


def mirrored_error(
    views: Sequence[BallView], probe: Probe, proxies: Sequence[Proxy] = (), others: Sequence[Probe] = ()
) -> tuple[float, Array] | None:
    """Return how badly a ball of a radius explains what frames show it to mirror, at the best place beside its own.

    Args:
        views: The frames.
        probe: The ball, its centre within some millimetres.
        proxies: What stands on the receiver; without planes or boxes a desk at the marker's height is assumed.
        others: Other balls.

    Returns:
        Mean cost, 0 (all samples agree) to 1, and the centre (3,); None where too little of the receiver is mirrored.
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
    """The ball with the radius, and the centre, that explain best what it mirrors; None where that does not tell.

    Args:
        views: RGB frames with ``camera_from_world``.
        camera: The camera.
        probe: The ball as it is given: it stands, its radius is within ``SPAN``, its centre within millimetres.
        proxies: What stands on the receiver.
        others: Other balls.
    """
    few = prepare_views(views[:: -(-len(views) // RADIUS_VIEWS)], camera)
    steps = round(SPAN / RADIUS_STEP)
    costs: dict[int, float] = {}
    balls: dict[int, Probe] = {}

    def attempt(k: int, place: tuple[float, float, float]) -> None:
        """Try a radius from a place, and still on the ground."""
        radius = probe.radius * (1.0 + RADIUS_STEP * k)
        start = (place[0], place[1], probe.center[2] + radius - probe.radius)
        ball = dataclasses.replace(probe, center=start, radius=radius)
        found = mirrored_error(few, ball, proxies, others)
        if found is not None and found[0] < costs.get(k, math.inf):
            x, y, z = (float(value) for value in found[1])
            costs[k], balls[k] = found[0], dataclasses.replace(ball, center=(x, y, z))

    # One of the first few is within four steps of the right radius, and explains more than nothing.
    first = [k for k in range(-steps, steps + 1) if k % 4 == 3 and abs(k) < steps]
    for k in first:
        attempt(k, probe.center)
    if not costs or min(costs.values()) > HOPELESS:
        return None
    for k in range(-steps, steps + 1, 2):
        if k not in first:
            attempt(k, probe.center)
    # From the best one outward, each from its neighbour's place.
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
    """Return whether a ball explains what is mirrored, and much better than another one does."""
    few = prepare_views(views[:: -(-len(views) // RADIUS_VIEWS)], camera)
    found = [mirrored_error(few, ball, proxies, others) for ball in (probe, other)]
    if found[0] is None or found[0][0] > EXPLAINED:
        return False
    return found[1] is None or found[0][0] < BETTER * found[1][0]


def posed_frames(source: Source, marker: Marker, camera: Camera, most: int) -> list[tuple[Image, Pose]]:
    """Frames of a source in which the marker is seen well, with their poses; of alternating exposures the longest.

    Args:
        source: It is read from its start, if it has one.
        marker: What to look for.
        camera: Of the source's size.
        most: Frames to look at.
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
    """The scene with its balls where the source shows them, as far as that is certain.

    Args:
        scene: Its balls within 6 mm of where they are.
        source: The frames; those of a device are gone afterwards.
        frames: How many to look at; of those that show the marker, ``REFINE_VIEWS`` are compared.

    Returns:
        The scene, and what was found for each ball; a fit that is not ``is_good`` has moved nothing.
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
