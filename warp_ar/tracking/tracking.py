"""Pose from a marker: detection, refinement on all printed edges, smoothing without lag, and a quality measure.

The world is the marker's frame: origin at the centre of the marker or board, x right and y up the printed page, z out
of it, metres. A pose is ``camera_from_world``: it maps a world point X to the camera point R X + t. The camera's axes
are x right, y down and z forward, and pixel centres have integer coordinates.

Detection gives four corners with an error of about 0.3 pixel, which is 0.25 degrees for a marker of 90 pixels. The
printed pattern contains far more information: every border between a black and a white cell is a line at a known place.
Refinement therefore moves the pose until those borders coincide with edges in the image [HS90], by Gauss-Newton with a
redescending weight. Across each border, the radiance I(u) is sampled at distances u from the predicted border, over a
window [-h, h]. Let b and w be the radiance on the black and on the white side. The offset e of the edge from the
predicted border does not depend on the edge's blur:

    e = (1 / (w - b)) * integral of (w - I(u)) du over [-h, h], minus h

No derivative of the image is taken, so noise averages out. Some effects shift all edges toward white or black although
nothing moves: clipped white, an inaccurate transfer function, ink that spreads. Motion blur shifts edges depending on
their direction. The shift of an edge with normal n in the picture is therefore modelled as n'Sn, where the three
numbers of the symmetric matrix S are unknown.

Objects, lights, proxies and mirror balls may be attached to markers of their own, which are tracked like the world's
marker. A marker's pose in the world follows from the camera's pose relative to both: world_from_marker =
world_from_camera camera_from_marker. A scene may give the camera's poses instead; a frame without one counts as lost.

References:
    [HS90] C. Harris and C. Stennett. RAPID, a video rate object tracker. BMVC 1990.
    [CB14] T. Collins and A. Bartoli. Infinitesimal plane-based pose estimation. IJCV 2014: the two poses of a plane, as
    OpenCV computes them.
"""

from __future__ import annotations

import dataclasses
import enum
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TypeGuard

import cv2
import numpy as np
from numpy.typing import NDArray

from warp_ar.declared import checked
from warp_ar.errors import UsageError
from warp_ar.scene import Camera, Light, Marker, Object, Pose, Probe, Proxy, Scene
from warp_ar.scene.description import PoseSpec
from warp_ar.sources.source import Frame, Source
from warp_ar.tracking.edge_fit import CORRELATED, NOISE_FLOOR, Box, EdgeFitter, Fit
from warp_ar.tracking.markers import Detection, MarkerDetector, pattern_of

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

_ENVIRONMENT = 0.6
"""Margin of the search region around the marker's predicted outline, relative to the outline's longer side."""

_CLOSE = 0.25
"""Margin of the first search region for a sharp marker. The region has half the pixels; detections are the same."""

_INSIDE = 12.0
"""Smallest distance in pixels of a marker's corners from the border of the first search region, because edges are
sampled beyond the corners."""

_BEFORE = np.array([3, 0, 1, 2])
"""Index of the corner before each corner of a marker."""

_NEAR = 0.5
"""Largest mean distance between detected and predicted corners at which the search ends, relative to the size returned
by ``_smallest``."""

_SHARP_AGAIN = 8
"""Number of frames for which the search for a sharp marker is skipped after it has failed."""

_REACH = (4.0, 3.0, 2.5, 2.5)
"""Largest half width in pixels of the window sampled across an edge, per Gauss-Newton step; narrow cells reduce it."""

_LOST_REACH = (9.0, 6.0, 4.0, 3.0, 2.5)
"""Largest half width in pixels of the window if the pose is only predicted from earlier frames."""

_CORNER_NOISE = 0.5
"""Standard deviation in pixels of a detected corner, for markers too small for edge refinement."""

_PATTERN = 0.7
"""Smallest correlation of the cells' brightness with the printed pattern."""

_SUPPORT = 0.4
"""Smallest share of the printed edges that must agree with a pose, to reject clutter."""

_ENOUGH = 0.7
"""Share of a board's edges that must agree to skip detection."""

_ALIKE = 3.0
"""Ratio of reprojection errors below which the second pose of a plane is examined as well as the first. Four corners of
a plane fit two poses about equally well if the plane is far away."""

_ALIKE_PIXELS = 0.5
"""Difference of reprojection errors in pixels below which the second pose is examined, whatever the ratio."""

_FLIP_EVIDENCE = 12.0
"""Accumulated log likelihood that is needed to switch between the two poses of a plane."""

_FRAME_EVIDENCE = 4.0
"""Largest contribution of one frame to that log likelihood, so that a single bad frame cannot switch the pose."""

_SETTLE = 9.0
"""Squared deviation, in standard deviations and per degree of freedom, between the measured and the last pose at which
the smoothed pose moves half the way."""

_FORGET = 0.4
"""Time constant in seconds of the smoothing: after it, earlier measurements have at most the weight 1/e."""


class TrackState(enum.Enum):
    """Origin of a tracked pose."""

    TRACKED = "tracked"
    """The marker was measured in this frame."""
    HELD = "held"
    """The marker was not measured for a moment: the pose is extrapolated with a decaying velocity."""
    LOST = "lost"
    """The marker was not measured for longer than the hold time: there is no pose."""


@dataclasses.dataclass(frozen=True)
class Track:
    """Tracking result of one frame."""

    pose: Pose | None
    """``camera_from_world``, or None when lost."""
    state: TrackState
    """Origin of the pose."""
    quality: float
    """Quality of the pose, 0 to 1: the share of the printed edges that support it, reduced by its uncertainty. A
    standard deviation of 1 degree, or of 1 % of the distance, halves it."""
    corners: NDArray[np.float32] | None
    """Corners of the marker or board in the image under ``pose``, (4, 2) pixels, clockwise from the page's top left;
    None when lost."""
    reprojection_error: float
    """Root mean square distance in pixels between predicted and measured edges (or corners, for small markers);
    infinite without measurement."""


def _rotation(vector: Array) -> Array:
    return np.asarray(cv2.Rodrigues(np.asarray(vector, float))[0], float)


def _log(rotation: Array) -> Array:
    """Return the rotation vector of a rotation matrix, (3,), with length 0 to pi."""
    return np.asarray(cv2.Rodrigues(rotation)[0], float).ravel()


def _difference(a: Pose, b: Pose) -> Array:
    """Return (6,): rotation vector w and translation d such that a = (exp(w) b.R, b.t + d)."""
    return np.concatenate([_log(a.rotation @ b.rotation.T), a.translation - b.translation])


def _moved(pose: Pose, step: Array) -> Pose:
    return Pose(_rotation(step[:3]) @ pose.rotation, pose.translation + step[3:6])


class Tracker:
    """Tracker of one marker or board over a sequence of frames.

    Args:
        marker: The marker or board.
        camera: The camera. Its transfer function matters little, because a common shift of all edges is estimated.
        hold: Time in seconds for which the pose is extrapolated after the last measurement.
        steady: True to smooth the pose over time. The smoothed pose deviates from the measured one by little more than
            the measurement's uncertainty: a static marker does not jitter, a moving one does not lag.

    Raises:
        UsageError: The marker does not exist, an argument has another type, or ``hold`` is below 0.
    """

    @checked
    def __init__(self, marker: Marker, camera: Camera, *, hold: float = 0.2, steady: bool = True) -> None:
        if hold < 0.0:
            raise UsageError(f"hold = {hold}: expected seconds, 0 or more")
        self._pattern = pattern_of(marker)
        self._detector = MarkerDetector(marker.dictionary)
        self._hold, self._steady = hold, steady
        self._fitter = EdgeFitter(self._pattern, camera)
        self.reset()

    def reset(self) -> None:
        """Forget all earlier frames."""
        self._pose: Pose | None = None
        self._velocity = np.zeros(6)
        self._time = -np.inf
        self._quality = 0.0
        self._evidence = 0.0
        self._rival = False
        self._blurred = 0  # number of frames in which the search for a sharp marker is skipped

    def track(self, image: Image, time: float) -> Track:
        """Track the marker in the next frame.

        Args:
            image: uint8 (height, width, 3) RGB, or (height, width) grey.
            time: Time in seconds, increasing from frame to frame.

        Raises:
            UsageError: The image does not have the camera's size, or is not 8-bit.
        """
        if image.dtype != np.uint8 or image.shape[:2] != self._fitter.gray.shape or image.shape[2:] not in ((), (3,)):
            h, w = self._fitter.gray.shape
            raise UsageError(f"image: {image.dtype} {image.shape} should be uint8 ({h}, {w}, 3), the camera's size")
        if not 0 <= time - self._time <= self._hold:
            self.reset()  # the last measurement is too old for a prediction, or time went backwards
        guess = self._predict(time)
        fit = self._measure(image, guess)
        if fit is None:
            if guess is None:
                return _NO_POSE
            quality = self._quality * (1 - (time - self._time) / self._hold) if self._hold > 0 else 0.0
            return Track(guess, TrackState.HELD, float(np.clip(quality, 0, 1)), self._outline(guess), np.inf)
        pose, quality = self._steadied(fit, guess, time), self._judge(fit)
        if self._pose is not None:
            elapsed = max(time - self._time, 1e-3)
            self._velocity = _difference(pose, self._pose) / elapsed
        self._pose, self._time, self._quality = pose, time, quality
        return Track(pose, TrackState.TRACKED, quality, self._outline(pose), fit.error)

    def detect(
        self, image: Image, box: Box | None = None, smallest: float = 10.0, *, sharp: bool = False
    ) -> list[Detection]:
        """Detect this marker, or the markers of this board; the result is independent of the camera.

        Args:
            image: uint8 RGB or grey.
            box: Rows and columns of the searched part; None: the whole image.
            smallest: Mean side length in pixels of the smallest marker that must be found.
            sharp: True to use the narrow threshold only.

        Returns:
            Detections, with corners in pixels of the whole image.
        """
        detected = self._detector.detect(self._show(image, box), max(smallest, 10.0), sharp=sharp)
        origin = np.array((0, 0) if box is None else (box[1].start, box[0].start), np.float32)
        return [Detection(d.id, d.corners + origin) for d in detected if d.id in self._pattern.markers]

    def error_of(self, image: Image, found: list[Detection]) -> float:
        """Return the reprojection error of a pose fitted to detections in one image, without earlier frames.

        Args:
            image: uint8 (height, width, 3) RGB, or (height, width) grey.
            found: Result of ``detect`` for the image, by any tracker of this marker.

        Returns:
            The root mean square error in pixels; infinite if no pose fits.
        """
        self._show(image)
        fit = self._fit_detections(found, None)
        return np.inf if fit is None else fit.error

    def _predict(self, time: float) -> Pose | None:
        """Return the last pose extrapolated to a time; None without a last pose.

        The velocity halves within the hold time, so that the pose of a hidden marker does not move far.
        """
        if self._pose is None:
            return None
        elapsed = time - self._time
        decay = np.log(2) / max(self._hold, 1e-3)
        guess = _moved(self._pose, self._velocity * (-np.expm1(-decay * elapsed) / decay))
        return guess if guess.apply(self._pattern.outline)[:, 2].min() > 0 else self._pose

    def _outline(self, pose: Pose) -> NDArray[np.float32]:
        return self._fitter.project(pose.apply(self._pattern.outline))[0].astype(np.float32)

    def _measure(self, image: Image, guess: Pose | None) -> Fit | None:
        """Return the pose measured in this image alone; None if the marker is not found.

        Args:
            image: uint8 RGB or grey.
            guess: Predicted pose, if any. It limits the search, is the start of the fit where detection fails, and
                selects one of the two poses of a plane.
        """
        if guess is not None:
            # The edges of a board are tried before detection: decoding its many markers is slow, and a board has no
            # ambiguous second pose.
            if len(self._pattern.markers) > 1:
                self._show(image, self._around(self._outline(guess)))
                fit = self._fit_guess(guess)
                if fit is not None and fit.support >= _ENOUGH:
                    return fit
            fit = self._fit_detections(self._find_expected(image, guess), guess)
            if fit is None or not fit.edges:
                # Corners of a marker may be hidden or outside the picture while enough of its edges are visible.
                self._show(image, self._around(self._outline(guess)))
                fit = self._fit_guess(guess) or fit
            if fit is not None:
                return fit
        found = self.detect(image)
        self._rival = len(found) > len({d.id for d in found})
        fit = self._fit_detections(found, guess)
        if fit is None or not fit.edges or self._rival or len(self._pattern.markers) > 1:
            return fit
        # The measurement is repeated in the same way as in the next frame, so that a static marker does not move from
        # the first frame to the second.
        return self._fit_detections(self._find_expected(image, fit.pose), fit.pose) or fit

    def _show(self, image: Image, box: Box | None = None) -> Image:
        """Set the part of an image for fitting (default: the whole image), and return it in grey."""
        h, w = self._fitter.gray.shape
        return self._fitter.show(image, (slice(0, h), slice(0, w)) if box is None else box)

    def _around(self, outline: NDArray[np.float32], environment: float = _ENVIRONMENT) -> Box:
        """Return the rows and columns of the image around a marker's outline; never empty.

        Args:
            outline: Corners of the outline, (4, 2) pixels.
            environment: Margin relative to the outline's longer side; 16 pixels are added to it.
        """
        low, high = outline.min(0), outline.max(0)
        environment = environment * float((high - low).max()) + 16
        h, w = self._fitter.gray.shape
        (x0, y0), (x1, y1) = np.clip(low - environment, 0, (w - 32, h - 32)), np.clip(high + environment, 32, (w, h))
        return slice(int(y0), int(np.ceil(y1))), slice(int(x0), int(np.ceil(x1)))

    def _smallest(self, guess: Pose) -> float:
        """Return a lower bound in pixels on the side length of markers, for detection.

        It is 0.6 times the mean side length of the smallest marker of the print under the predicted pose ``guess``.
        """
        corners = np.concatenate([guess.apply(c) for c in self._pattern.markers.values()])
        pixels = self._fitter.project(corners)[0].reshape(-1, 4, 2)
        sides = pixels - pixels[:, _BEFORE]
        return 0.6 * float(np.sqrt((sides**2).sum(axis=2)).mean(axis=1).min())

    def _find_expected(self, image: Image, guess: Pose) -> list[Detection]:
        """Detect the markers near their places under the predicted pose ``guess``.

        A single marker is first searched for with the narrow threshold alone, which finds the same corners of a sharp
        marker in less time. If that fails, the marker may be blurred. Both thresholds are then used for
        ``_SHARP_AGAIN`` searches.
        """
        smallest, expected = self._smallest(guess), self._outline(guess)
        if len(self._pattern.markers) == 1 and self._blurred == 0:
            for environment in (_CLOSE, _ENVIRONMENT):
                box = self._around(expected, environment)
                found = self.detect(image, box, smallest, sharp=True)
                near = [d for d in found if np.linalg.norm(d.corners - expected, axis=1).mean() < _NEAR * smallest]
                if near and (environment == _ENVIRONMENT or all(_is_inside(d.corners, box) for d in near)):
                    return found
            self._blurred = _SHARP_AGAIN
        self._blurred = max(self._blurred - 1, 0)
        return self.detect(image, self._around(expected), smallest)

    def _fit_detections(self, found: list[Detection], guess: Pose | None) -> Fit | None:
        found = self._chosen(found, guess)
        if not found:
            return None
        corners = np.concatenate([d.corners for d in found]).astype(float)
        points = np.concatenate([self._pattern.markers[d.id] for d in found])
        candidates = self._plane_poses(points, corners)
        if not candidates:
            return None
        most = max(_ALIKE * candidates[0][1], candidates[0][1] + _ALIKE_PIXELS)
        alike = [pose for pose, error in candidates if error < most or pose is candidates[0][0]]
        fitted = [(pose, self._fitter.fit(pose, _REACH)) for pose in alike]
        fits = [fit if _holds(fit) else self._fit_corners(pose, points, corners) for pose, fit in fitted]
        good = [fit for fit in fits if fit.pattern >= _PATTERN]
        return self._preferred(good, guess) if good else None

    def _chosen(self, found: list[Detection], guess: Pose | None) -> list[Detection]:
        """Return one detection per id: the one nearest to its predicted place, or without a prediction the largest."""
        if len(found) < 2:
            return found

        def rank(d: Detection) -> float:
            if guess is None:
                return -abs(float(cv2.contourArea(d.corners)))
            expected = self._fitter.project(guess.apply(self._pattern.markers[d.id]))[0]
            return float(np.linalg.norm(d.corners - expected, axis=1).mean())

        best: dict[int, Detection] = {}
        for d in sorted(found, key=rank):
            best.setdefault(d.id, d)
        return list(best.values())

    def _plane_poses(self, points: Array, corners: Array) -> list[tuple[Pose, float]]:
        """Return the two poses of a plane that fit its corners [CB14], the better one first.

        With clockwise corners, z points toward the camera in both poses. Poses behind the camera are left out.

        Args:
            points: Corners in the marker's frame, (n, 3).
            corners: Corners in the image, (n, 2) pixels.

        Returns:
            Poses with their root mean square reprojection errors in pixels.
        """
        # With z into the page, a marker seen frontally has the identity rotation. With z out of the page, it is rotated
        # by exactly half a turn, where OpenCV's solver divides 0 by 0 and returns a pose that is off by 160 pixels.
        facing = np.diag([1.0, -1.0, -1.0])
        try:
            _, rotations, translations, _ = cv2.solvePnPGeneric(
                points @ facing, corners, self._fitter.matrix, self._fitter.distortion, flags=cv2.SOLVEPNP_IPPE
            )
        except cv2.error:  # collinear corners
            return []
        poses = []
        for r, t in zip(rotations, translations, strict=True):
            if not np.isfinite([r, t]).all():
                continue
            pose = Pose(_rotation(r) @ facing, np.asarray(t, float).ravel())
            if pose.apply(self._pattern.outline)[:, 2].min() > 0:
                residual = self._fitter.project(pose.apply(points))[0] - corners
                poses.append((pose, float(np.sqrt((residual**2).sum(1).mean()))))
        return sorted(poses, key=lambda p: p[1])

    def _preferred(self, fits: list[Fit], guess: Pose | None) -> Fit:
        """Return one of the two poses of a plane.

        This is the pose nearer to the prediction ``guess``, until the accumulated evidence for the other pose exceeds
        ``_FLIP_EVIDENCE``. Without a prediction, it is the pose with the smaller residuals.
        """
        if guess is None or len(fits) < 2:
            self._evidence = 0.0
            return min(fits, key=lambda f: f.cost)
        near, far = sorted(fits, key=lambda f: float(np.linalg.norm(_difference(f.pose, guess)[:3])))
        noise = max(min(near.cost, far.cost), NOISE_FLOOR**2)
        independent = 0.5 * len(self._pattern.points) / CORRELATED
        against = float(np.clip(independent * (near.cost - far.cost) / noise, -_FRAME_EVIDENCE, _FRAME_EVIDENCE))
        self._evidence = max(self._evidence + against, 0.0)
        if self._evidence < _FLIP_EVIDENCE:
            return near
        self._evidence = 0.0
        return far

    def _fit_corners(self, pose: Pose, points: Array, corners: Array) -> Fit:
        """Return a pose that was computed from detected corners, with its uncertainty and error.

        Args:
            pose: The pose.
            points: Corners in the marker's frame, (n, 3).
            corners: Corners in the image, (n, 2) pixels.
        """
        camera = pose.apply(points)
        pixels, jacobian = self._fitter.project(camera)
        residual = pixels - corners
        # A rotation vector w moves the camera point R X by w x RX: a row j of the derivative becomes (RX x j, j).
        arm = (camera - pose.translation)[:, None]
        rows = np.concatenate([np.cross(arm, jacobian), jacobian], axis=-1).reshape(-1, 6)
        information = rows.T @ rows / _CORNER_NOISE**2
        cost = float((residual**2).mean())
        pattern = self._fitter.correlate(pose)
        return Fit(pose, information, float(np.sqrt(2 * cost)), 0.5, cost, pattern, edges=False)

    def _fit_guess(self, guess: Pose) -> Fit | None:
        fit = self._fitter.fit(guess, _LOST_REACH)
        return fit if _holds(fit) else None

    def _steadied(self, fit: Fit, guess: Pose | None, time: float) -> Pose:
        """Return the measured pose averaged with the last one, in which the last one has little weight if they differ.

        Let x be the difference between measured and last pose, and L the information matrix of the measurement. Without
        motion, s = x'Lx / 6 is about 1. The last pose is moved by the share s / (s + c) of x, with c = ``_SETTLE``. The
        error that is left, c x / (s + c), is at most half of sqrt(c) standard deviations for any motion.
        """
        if self._pose is None or guess is None or not self._steady:
            return fit.pose
        step = _difference(fit.pose, self._pose)
        deviation = float(step @ fit.information @ step) / 6
        share = max(deviation / (deviation + _SETTLE), -np.expm1(-(time - self._time) / _FORGET))
        return _moved(self._pose, share * step)

    def _judge(self, fit: Fit) -> float:
        """Return the quality of a pose, 0 to 1, from its support and its uncertainty.

        It is halved if the last detection in a whole picture found two markers with one id.
        """
        # The pseudoinverse gives unobservable motions the variance 0.
        variances = np.maximum(np.linalg.pinv(fit.information).diagonal(), 0.0).tolist()
        turn = math.degrees(math.sqrt(sum(variances[:3])))
        shift = 100.0 * math.sqrt(sum(variances[3:])) / math.hypot(*fit.pose.translation.tolist())
        quality = min(1.0, fit.support / 0.9) / (1.0 + turn**2 + shift**2)
        return min(max(quality * (0.5 if self._rival else 1.0), 0.0), 1.0)


def _is_inside(corners: NDArray[np.float32], box: Box) -> bool:
    """Return True if corners, (4, 2) pixels, lie at least ``_INSIDE`` pixels inside a part of the image."""
    rows, columns = box
    low, high = corners.min(0), corners.max(0)
    return bool(
        (low >= (columns.start + _INSIDE, rows.start + _INSIDE)).all()
        and (high <= (columns.stop - _INSIDE, rows.stop - _INSIDE)).all()
    )


def _holds(fit: Fit | None) -> TypeGuard[Fit]:
    return fit is not None and fit.support >= _SUPPORT and fit.pattern >= _PATTERN


Places = Mapping[Marker, Pose | None]
"""``world_from_marker`` of each marker; None for a marker that is lost."""


def own_markers(scene: Scene) -> tuple[Marker, ...]:
    """Return the markers to which objects, lights or other parts of a scene are attached, each once."""
    items: tuple[Object | Light | Proxy | Probe, ...] = (*scene.objects, *scene.lights, *scene.proxies, *scene.probes)
    return tuple(dict.fromkeys(item.marker for item in items if item.marker is not None))


def track_markers(
    trackers: Mapping[Marker, Tracker], image: NDArray[np.uint8], time: float, camera_from_world: Pose | None
) -> Places:
    """Return markers' poses in the world; all are None while ``camera_from_world`` is unknown.

    Args:
        trackers: Tracker of each marker.
        image: uint8 RGB, (height, width, 3).
        time: Time of the frame, seconds.
        camera_from_world: Pose of the camera by the world's marker or from the scene; None if unknown.
    """
    found = {marker: tracker.track(image, time).pose for marker, tracker in trackers.items()}
    if camera_from_world is None:
        return dict.fromkeys(found)
    world = camera_from_world.inverse()
    return {marker: None if pose is None else world.after(pose) for marker, pose in found.items()}


_NO_POSE = Track(None, TrackState.LOST, 0.0, None, math.inf)


def given_pose(spec: PoseSpec | None, frame: Frame | int) -> Pose | Track | None:
    """Return the camera's pose that the scene gives for a frame.

    Args:
        spec: The scene's poses; None if it gives none.
        frame: The frame, or only its index.

    Returns:
        The pose; a lost track if the scene gives none for this frame; None without ``spec``.
    """
    if spec is None:
        return None
    found = spec.at(frame) if isinstance(frame, int) else spec.at(frame.index - frame.begins, frame.name)
    return _NO_POSE if found is None else Pose(*found)


def tell_missing_poses(spec: PoseSpec | None, source: Source) -> str:
    """Return a message on the frames for which a file of poses has none.

    It is empty if all have one, or if the frames are not known in advance.
    """
    if spec is None or spec.file is None or source.live:
        return ""
    frames = source.names or ("",) * (source.length or 0)
    missing = [index for index, name in enumerate(frames) if spec.at(index, name) is None]
    if not missing:
        return ""
    first = Path(frames[missing[0]]).name or f"frame {missing[0]}"
    are = "1 frame has" if len(missing) == 1 else f"{len(missing)} of {len(frames)} frames have"
    return f"{spec.file}: {are} no pose there, {first} first; no virtual objects are shown in them"
