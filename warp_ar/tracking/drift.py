"""Drift of a camera's exposure and white balance, estimated from still surfaces.

A camera that meters for itself scales the whole picture: every surface, lit or in shadow, becomes brighter by the same
factor per channel. Light that changes does not: what an emitter reaches follows it, what lies in its shadow does not.
So points of the card's paper and of the planes around it are looked at in each frame, at their places in the world.
Each remembers what it showed first. With d_i the change of the logarithm of the radiance of point i since then, per
channel, and m their median,

    the gain is exp(m)    where the points agree: a share ``AGREEING`` of |d_i - m| is below ``SPREAD`` |m|,

and where card and planes say the same, until a drift is known: then a hand may be over either. A drift must pass
``LEAST`` before it is believed: the light of a frame whose camera holds still is not touched. Where points disagree,
because the light changes or something covers them, the last gain holds for a few frames, and the gain is 1 after them.
Light that dims on all surfaces alike cannot be told from an exposure, and is taken for one: so all this is done only
where the scene says that the camera meters by itself.

Paper is at most some ``MOST_PRINT`` times as bright as the ink on it. Where the card looks more so, the camera lays an
S-shaped curve over its transfer (``without_contrast``); the least contrast that explains the print is taken.

A drift is a bracket as well. Where the camera lays such a curve over its transfer, the middle of the range changes by
more than its ends: points of different codes then disagree. The contrast is the one under which medians over bins of
codes agree best, where what they disagree by falls below ``BETTER`` of what it is without.
"""

from __future__ import annotations

import copy
from typing import Self

import numpy as np
from numpy.typing import NDArray

from warp_ar.kernels.color import decode_table, without_contrast
from warp_ar.scene import Camera, Scene
from warp_ar.scene.geometry import rotation_matrix
from warp_ar.scene.pixel_rays import project
from warp_ar.scene.pose import Pose
from warp_ar.sources.deep_frame import Plate
from warp_ar.tracking.markers import printed_cells

Array = NDArray[np.float64]

GRID = 21
"""Points along each side of a plane."""
LEAST_POINTS = 24
"""Points that must be seen again."""
LEAST = 0.05
"""Least logarithm of the gain over all channels that counts as a drift."""
AGREEING = 0.7
"""Share of points that must agree."""
SPREAD = 0.3
"""Distance that they may lie off the median, as a share of its length."""
FURTHEST = 0.06
"""The same at most, logarithm: an emitter that changes far away lights what is near alike, within more."""
NOISE = 0.09
"""The same in a drift that is known: a tone curve, a lens that blurs texture, noise and compression."""
CARD = 0.15
"""Logarithm by which card and planes may differ: they lie at different places of a tone curve."""
PATIENCE = 4
"""Frames in a row in which points disagree, after which no drift is known any more."""
DARK, BRIGHT = 12, 250
"""Codes between which a channel is taken to tell: beyond them are quantisation and clipping."""
CONTRASTS = np.linspace(0.0, 1.0, 5)
"""Contrasts that are tried, none first."""
MOST_PRINT = 30.0
"""Ratio of paper to ink: print that reflects 3 % on paper that reflects 90 %."""
BINS = (0.2, 0.35, 0.5, 0.65, 0.8)
"""Codes over 255 that part the bins whose medians are compared."""
BIN_POINTS = 4
"""Points of a bin."""
BETTER = 0.85
"""Ratio of disagreements, with a contrast to without, from which it is believed."""
TELLING = 0.08
"""Logarithm of a channel's gain from which its frame tells of the contrast."""
FIRST_LOOKS = 9
"""Channels of frames that must tell; the contrast is asked for again each time that twice as many have."""
_OFFSETS = np.array([(x, y) for y in (-2, 0, 2) for x in (-2, 0, 2)])
"""Pixels around a point whose mean it shows."""


class ExposureDrift:
    """Follows the camera's gain, frame after frame; 1 until a drift is seen."""

    def __init__(self, scene: Scene, camera: Camera) -> None:
        """Choose points.

        Args:
            scene: With a marker.
            camera: Of the frames.
        """
        self.watches = (camera, scene.marker, scene.proxies, scene.probes)
        """Things that frames are of: the same frames tell those that watch the same, the same."""
        self._camera = camera
        self._plain = decode_table(camera.transfer).astype(np.float64)
        self._points, self._is_card, self._is_ink = still_points(scene)
        self._first = np.full((len(self._points), 3), np.nan)
        self._first_gain = np.ones_like(self._first)
        self._moving, self._disagreed = False, 0
        # A measured response is believed.
        name = str(camera.transfer)
        self._asks_contrast = name == "srgb" or name.startswith("gamma:")
        self._disagreements: list[Array] = []
        self._next_looks = FIRST_LOOKS
        self.gain: Array = np.ones(3)
        """Factor of the camera on radiance, against its first frame, RGB."""
        self.saturation = np.full(3, 255.0)
        """Estimated code at which each channel saturates."""
        self.contrast = 0.0
        """Contrast of the camera's tone curve, as in ``without_contrast``."""

    def copied(self) -> Self:
        """Return what has been seen so far, for another pipeline to go on from; what it sees changes nothing here."""
        other = copy.copy(self)
        other._first, other._first_gain = self._first.copy(), self._first_gain.copy()
        other._disagreements = list(self._disagreements)
        return other

    def observe(self, image: NDArray[np.uint8], pose: Pose, plate: Plate | None = None) -> bool:
        """Look at a frame.

        Args:
            image: uint8 RGB (height, width, 3).
            plate: The frame at its full depth, read in the place of ``image`` where there is one.
            pose: ``camera_from_world``.

        Returns:
            Whether the gain or the contrast is another one now.
        """
        codes = codes_around(image, self._camera, pose, self._points, plate)
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
        """Logarithm of what points show over what they showed first, for a camera of gain 1 then, (n, 3).

        Args:
            codes: Of the points now, (n, 3).
            contrast: That the camera is taken to have.
        """
        change = self._logarithm(codes, contrast) - self._logarithm(self._first, contrast)
        return np.asarray(change + np.log(self._first_gain))

    def _logarithm(self, codes: Array, contrast: float) -> Array:
        """Of the radiance that codes (n, 3) stand for under a contrast, (n, 3)."""
        table = np.log(np.maximum(without_contrast(self._plain, contrast, self.saturation), 1e-6))
        return np.stack([np.interp(codes[:, c], np.arange(256), table[:, c]) for c in range(3)], -1)

    def _weigh(self, change: Array, is_card: NDArray[np.bool_]) -> Array | None:
        """Logarithm of the gain; None where points do not tell.

        Args:
            change: Of the logarithm of radiance since each point was first seen, (k, 3).
            is_card: Which of them are the card's, (k,).
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
            # A hand may be over the card, and over as much of the planes as need not agree.
            return middle if off <= NOISE else None
        if off > min(SPREAD * size / np.sqrt(3.0), FURTHEST) or apart > CARD:
            return None if size > LEAST else np.zeros(3)
        self._moving |= size > LEAST
        return middle

    def _ask_contrast(self, codes: Array) -> None:
        """Add what a frame says of the contrast, and where enough have spoken, take the best."""
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
        """The least contrast of the camera under which the card's print is no blacker than print is."""
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
    image: NDArray[np.uint8], camera: Camera, pose: Pose, points: Array, plate: Plate | None = None
) -> Array:
    """Mean codes around points, NaN where they are not seen or do not tell, (n, 3).

    Args:
        image: uint8 RGB (height, width, 3).
        camera: Of the frame.
        pose: ``camera_from_world``.
        points: Metres, (n, 3).
        plate: The frame at its full depth: its codes are then fractions of 8-bit ones.
    """
    result = np.full((len(points), 3), np.nan)
    pixels = project(camera, pose.apply(points))
    at = np.round(np.clip(np.nan_to_num(pixels, nan=-1.0), -1e6, 1e6)).astype(np.int64)
    inside = np.flatnonzero(((at >= 2) & (at < np.array([camera.width, camera.height]) - 2)).all(axis=1))
    around = at[inside] + _OFFSETS[:, None]
    rows, columns = around[..., 1], around[..., 0]
    if plate is None:
        codes = image.reshape(-1, 3).take(rows * image.shape[1] + columns, axis=0)
        sums = codes.sum(axis=0, dtype=np.int64)
    else:
        codes = plate.codes_at(rows, columns, str(camera.transfer))
        sums = codes.sum(axis=0)
    tells = np.flatnonzero(((codes.min(axis=0) > DARK) & (codes.max(axis=0) < BRIGHT)).all(axis=1))
    result[inside[tells]] = sums[tells] / len(_OFFSETS)
    return result


def under_boxes(scene: Scene, points: Array) -> NDArray[np.bool_]:
    """Return which points (n, 3) lie in boxes that stand still, or within a centimetre of one."""
    hidden = np.zeros(len(points), bool)
    for box in scene.proxies:
        if box.shape == "box" and box.marker is None:
            within = (points - np.array(box.at)) @ rotation_matrix(box.rotate)
            hidden |= (np.abs(within) < 0.5 * np.array(box.size) + 0.01).all(axis=1)
    return hidden


def still_points(scene: Scene) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]:
    """Points of the card and of planes, not under boxes or beside balls, (n, 3); which are its paper, which its ink."""
    cells, white, _, outline = printed_cells(scene.marker)
    low, high = outline.min(axis=0)[:2], outline.max(axis=0)[:2]
    margin = 0.3 * float((high - low).max())
    found, steps = [cells[white], cells[~white]], np.linspace(-0.45, 0.45, GRID)
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
