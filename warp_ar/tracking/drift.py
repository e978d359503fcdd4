"""Drift of a camera's exposure and white balance, estimated from static surfaces.

Automatic exposure and white balance scale the whole picture: every surface, lit or in shadow, becomes brighter by the
same factor per channel. A change of the light does not: surfaces that an emitter reaches change, surfaces in its shadow
do not. So points on the card's paper and on the planes around it are observed in each frame, at fixed places in the
world. The first observation of each point is stored. Let d_i be the change of the logarithm of the radiance of point i
since its first observation, per channel, and m the median of d_i over the points. Then

    the gain is exp(m)    if the points agree: for a share ``AGREEING`` of them, |d_i - m| is below ``SPREAD`` |m|.

Until a drift is known, card and planes must also agree with each other. Afterwards a hand may cover one of them. A gain
counts as drift only if its logarithm exceeds ``LEAST``, so that a camera with fixed exposure is not affected. If the
points disagree, because the light changes or something covers them, the last gain is kept for ``PATIENCE`` frames and
then set to 1. Light that dims on all surfaces equally cannot be distinguished from a change of exposure and counts as
one. Drift is therefore estimated only if the scene sets ``metering = "automatic"``.

Codes are the camera's 8-bit pixel values. Paper is at most ``MOST_PRINT`` times as bright as ink on it. If the card
appears to have more contrast, the camera applies an S-shaped tone curve after its transfer function. The curve has one
parameter, the contrast of ``without_contrast``. The smallest contrast that explains the print is used.

A drift also helps to estimate the contrast, because it shows the same surfaces at several exposures. Under a tone
curve, mid-tones change more than dark and bright tones, so points of different codes disagree. The points are sorted
into bins by their first codes. The estimated contrast is the one under which the medians of the bins agree best, if
their disagreement is below ``BETTER`` times the disagreement without contrast.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from warp_ar.kernels.color import decode_table, without_contrast
from warp_ar.scene import Camera, Scene
from warp_ar.scene.geometry import rotation_matrix
from warp_ar.scene.pixel_rays import project
from warp_ar.scene.pose import Pose
from warp_ar.sources.deep_frame import DeepFrame
from warp_ar.tracking.markers import pattern_of

Array = NDArray[np.float64]

GRID = 21
"""Number of points along each side of a plane."""
LEAST_POINTS = 24
"""Smallest number of points, observed before, that a frame must show for an estimate."""
LEAST = 0.05
"""Smallest length of the vector (3,) of the channels' log gains that counts as a drift."""
AGREEING = 0.7
"""Share of points that must agree."""
SPREAD = 0.3
"""Largest allowed deviation from the median, as a share of the median's magnitude."""
FURTHEST = 0.06
"""Upper bound on the allowed deviation from the median, as a logarithm. A distant emitter that changes affects nearby
surfaces almost equally; their deviations exceed this bound."""
NOISE = 0.09
"""Largest allowed deviation once a drift is known, as a logarithm. It covers tone curve, blurred texture, noise and
compression."""
CARD = 0.15
"""Largest difference between the median changes of card and planes, as a logarithm. They differ under a tone curve,
because card and planes have different codes."""
PATIENCE = 4
"""Number of consecutive frames with disagreeing points after which the gain is set to 1."""
DARK, BRIGHT = 12, 250
"""Range of codes that are used: darker ones are coarsely quantised, brighter ones may be clipped."""
CONTRASTS = np.linspace(0.0, 1.0, 5)
"""Contrasts that are tried, beginning with 0."""
MOST_PRINT = 30.0
"""Largest ratio of paper to ink: 90 % reflectance to 3 %."""
BINS = (0.2, 0.35, 0.5, 0.65, 0.8)
"""Borders of the bins whose medians are compared, as codes divided by 255."""
BIN_POINTS = 4
"""Smallest number of points in a bin, or on the card, for a median."""
BETTER = 0.85
"""Largest ratio of the disagreement with contrast to that without, for the contrast to be used."""
TELLING = 0.08
"""Smallest logarithm of a channel's gain for which the channel contributes to the estimate of contrast."""
FIRST_LOOKS = 9
"""Number of contributions, one per channel and frame, before contrast is first estimated from a drift. The estimate is
repeated each time the number has doubled."""
_OFFSETS = np.array([(x, y) for y in (-2, 0, 2) for x in (-2, 0, 2)])
"""Offsets of the pixels around a point that are averaged."""


class ExposureDrift:
    """Estimator of the camera's gain relative to its first frame; the gain is 1 until a drift is detected."""

    def __init__(self, scene: Scene, camera: Camera) -> None:
        """Choose the points to observe.

        Args:
            scene: Scene with a marker.
            camera: Camera of the frames.
        """
        self.watches = (camera, scene.marker, scene.proxies, scene.probes)
        """Inputs besides the frames on which estimates depend. Pipelines with equal inputs can share an instance."""
        self._camera = camera
        self._plain = decode_table(camera.transfer).astype(np.float64)
        self._points, self._is_card, self._is_ink = still_points(scene)
        self._first = np.full((len(self._points), 3), np.nan)
        self._first_gain = np.ones_like(self._first)
        self._moving, self._disagreed = False, 0
        # A measured response needs no contrast estimate.
        name = str(camera.transfer)
        self._asks_contrast = name == "srgb" or name.startswith("gamma:")
        self._disagreements: list[Array] = []
        self._next_looks = FIRST_LOOKS
        self.gain: Array = np.ones(3)
        """Camera's gain on radiance relative to its first frame, RGB."""
        self.saturation = np.full(3, 255.0)
        """Estimated code at which each channel saturates."""
        self.contrast = 0.0
        """Contrast of the camera's tone curve, as defined by ``without_contrast``."""

    def observe(self, image: NDArray[np.uint8], pose: Pose, deep: DeepFrame | None = None) -> bool:
        """Update gain and contrast from a frame.

        Args:
            image: uint8 RGB (height, width, 3).
            pose: ``camera_from_world``.
            deep: The frame at full bit depth, used instead of ``image`` if given.

        Returns:
            True if the gain or the contrast has changed.
        """
        codes = codes_around(image, self._camera, pose, self._points, deep)
        before, contrast = self.gain, self.contrast
        if self._asks_contrast and not np.isfinite(self._first).any():
            self.contrast = self._print_contrast(codes)
        change = self._change(codes, self.contrast)
        known = ~np.isnan(change).any(axis=1) & ~self._is_ink
        found = self._weigh(change[known], self._is_card[known])
        self._disagreed = 0 if found is not None else self._disagreed + 1
        if self._disagreed > PATIENCE:
            self._moving, self.gain = False, np.ones(3)
        if found is not None:
            self.gain = np.exp(found) if self._moving else np.ones(3)
            if self._moving and self._asks_contrast:
                self._ask_contrast(codes)
            new = np.isnan(self._first).any(axis=1)
            self._first[new], self._first_gain[new] = codes[new], self.gain
        return bool((before != self.gain).any()) or contrast != self.contrast

    def _change(self, codes: Array, contrast: float) -> Array:
        """Return the change of the logarithm of each point's radiance since its first observation, (n, 3).

        Args:
            codes: Codes of the points in the present frame, (n, 3).
            contrast: Assumed contrast of the camera's tone curve.
        """
        change = self._logarithm(codes, contrast) - self._logarithm(self._first, contrast)
        return np.asarray(change + np.log(self._first_gain))

    def _logarithm(self, codes: Array, contrast: float) -> Array:
        """Return the logarithm of the radiance of codes, (n, 3), if the camera's tone curve has a given contrast.

        Args:
            codes: Codes, (n, 3).
            contrast: Assumed contrast.
        """
        table = np.log(np.maximum(without_contrast(self._plain, contrast, self.saturation), 1e-6))
        return np.stack([np.interp(codes[:, c], np.arange(256), table[:, c]) for c in range(3)], -1)

    def _weigh(self, change: Array, is_card: NDArray[np.bool_]) -> Array | None:
        """Return the logarithm of the gain per channel, (3,); None if points disagree or too few are visible.

        Before a drift is known, points may disagree while their median changes by at most ``LEAST``; the result is
        then 0. It is also 0 if no point was observed before.

        Args:
            change: Change of the logarithm of radiance since each point's first observation, (k, 3).
            is_card: True for points on the card, (k,).
        """
        if not np.isfinite(self._first).any():
            return np.zeros(3)
        if len(change) < LEAST_POINTS:
            return None
        middle = np.median(change, axis=0)
        size = float(np.linalg.norm(middle))
        off = float(np.quantile(np.abs(change - middle).mean(axis=1), AGREEING))
        apart = 0.0
        if BIN_POINTS <= is_card.sum() <= len(change) - BIN_POINTS:
            apart = float(np.abs(np.median(change[is_card], axis=0) - np.median(change[~is_card], axis=0)).max())
        if self._moving:
            # Card and planes are no longer compared, because a hand may cover the card.
            return middle if off <= NOISE else None
        if off > min(SPREAD * size / np.sqrt(3.0), FURTHEST) or apart > CARD:
            return None if size > LEAST else np.zeros(3)
        self._moving |= size > LEAST
        return middle

    def _ask_contrast(self, codes: Array) -> None:
        """Add a frame's evidence on the contrast, and update the contrast once there is enough evidence."""
        changes = [self._change(codes, float(contrast)) for contrast in CONTRASTS]
        for c in range(3):
            seen = ~np.isnan(changes[0][:, c])
            if seen.sum() < LEAST_POINTS or abs(float(np.median(changes[0][seen, c]))) < TELLING:
                continue
            bins = np.digitize(self._first[seen, c] / 255.0, BINS)
            full = [b for b in range(len(BINS) + 1) if (bins == b).sum() >= BIN_POINTS]
            if len(full) < 2:
                continue
            medians = np.array([[np.median(change[seen, c][bins == b]) for b in full] for change in changes])
            self._disagreements.append(medians.std(axis=1) / np.maximum(np.abs(medians.mean(axis=1)), 1e-6))
        if len(self._disagreements) < self._next_looks:
            return
        self._next_looks = 2 * len(self._disagreements)
        disagree = np.median(self._disagreements, axis=0)
        best = int(np.argmin(disagree))
        if disagree[best] < BETTER * disagree[0]:
            self.contrast = max(self.contrast, float(CONTRASTS[best]))

    def _print_contrast(self, codes: Array) -> float:
        """Return the smallest contrast under which paper is at most ``MOST_PRINT`` times as bright as ink.

        The result is the largest of ``CONTRASTS`` if none suffices, and 0 if too few points are visible.
        """
        shown = [codes[part & ~np.isnan(codes).any(axis=1)] for part in (self._is_card, self._is_ink)]
        if min(len(part) for part in shown) < BIN_POINTS:
            return 0.0
        middle = np.array([np.median(part, axis=0) for part in shown])
        for contrast in map(float, CONTRASTS):
            paper, ink = np.exp(self._logarithm(middle, contrast)).sum(axis=1)
            if paper <= MOST_PRINT * ink:
                break
        return contrast


def codes_around(
    image: NDArray[np.uint8], camera: Camera, pose: Pose, points: Array, deep: DeepFrame | None = None
) -> Array:
    """Return the mean code of nine pixels around each point, (n, 3).

    It is NaN for points outside the picture and for points with a code not between ``DARK`` and ``BRIGHT``.

    Args:
        image: uint8 RGB (height, width, 3).
        camera: Camera of the frame.
        pose: ``camera_from_world``.
        points: World points in metres, (n, 3).
        deep: The frame at full bit depth, used instead of ``image`` if given; its codes are scaled to 0..255 and not
            rounded.
    """
    result = np.full((len(points), 3), np.nan)
    pixels = project(camera, pose.apply(points))
    at = np.round(np.clip(np.nan_to_num(pixels, nan=-1.0), -1e6, 1e6)).astype(np.int64)
    inside = np.flatnonzero(((at >= 2) & (at < np.array([camera.width, camera.height]) - 2)).all(axis=1))
    around = at[inside] + _OFFSETS[:, None]
    rows, columns = around[..., 1], around[..., 0]
    if deep is None:
        codes = image.reshape(-1, 3).take(rows * image.shape[1] + columns, axis=0)
        sums = codes.sum(axis=0, dtype=np.int64)
    else:
        codes = deep.codes_at(rows, columns, str(camera.transfer))
        sums = codes.sum(axis=0)
    tells = np.flatnonzero(((codes.min(axis=0) > DARK) & (codes.max(axis=0) < BRIGHT)).all(axis=1))
    result[inside[tells]] = sums[tells] / len(_OFFSETS)
    return result


def under_boxes(scene: Scene, points: Array) -> NDArray[np.bool_]:
    """Return a mask, (n,), of the points inside a static box of the scene or near one.

    A point is near if its coordinates in the box's frame exceed half the box's size by less than a centimetre.

    Args:
        scene: Scene with the boxes; boxes attached to markers are not static.
        points: World points in metres, (n, 3).
    """
    hidden = np.zeros(len(points), bool)
    for box in scene.proxies:
        if box.shape == "box" and box.marker is None:
            within = (points - np.array(box.at)) @ rotation_matrix(box.rotate)
            hidden |= (np.abs(within) < 0.5 * np.array(box.size) + 0.01).all(axis=1)
    return hidden


def still_points(scene: Scene) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]:
    """Return points on the card and on static planes, for observation.

    Points of the planes that are under a static box, near the card or near a ball are left out.

    Returns:
        World points in metres, (n, 3), and masks (n,) of the points on the card's paper and of those on its ink.
    """
    pattern = pattern_of(scene.marker)
    low, high = pattern.outline.min(axis=0)[:2], pattern.outline.max(axis=0)[:2]
    margin = 0.3 * float((high - low).max())
    found, steps = [pattern.cells[pattern.white], pattern.cells[~pattern.white]], np.linspace(-0.45, 0.45, GRID)
    for proxy in scene.proxies:
        if proxy.shape != "plane" or proxy.marker is not None:
            continue
        local = np.stack(np.meshgrid(*(steps * side for side in proxy.size)), -1).reshape(-1, 2)
        points = np.array(proxy.at) + np.column_stack([local, np.zeros(len(local))]) @ rotation_matrix(proxy.rotate).T
        hidden = ((points[:, :2] > low - margin) & (points[:, :2] < high + margin)).all(axis=1)
        hidden &= np.abs(points[:, 2]) < 0.02
        for probe in scene.probes:
            if probe.marker is not None:
                continue
            hidden |= np.linalg.norm(points - np.array(probe.center), axis=1) < 2.5 * probe.radius
        found.append(points[~hidden & ~under_boxes(scene, points)])
    number = np.repeat(np.arange(len(found)), [len(part) for part in found])
    return np.concatenate(found), number == 0, number == 1
