"""Codes at which a camera's channels saturate, estimated from pictures.

A sensor that saturates need not give 255: limited range, a shoulder or tone mapping may end at 235 or 238. What lies
above that light is lost all the same, and code 238 taken for a radiance of 0.85 hides that a lamp clips.

Saturation shows as a plateau: of the codes inside the mirror ball, where lamps and windows are seen, many are the same
and none is higher. Surfaces that are evenly lit crowd too, but around a mean, with noise to both sides. So a level L
below 254 is believed where, in the ball,

- codes L - 1 to L + 1 are more than ``LEAST_SHARE`` of all, and at least ``LEAST_PIXELS``;
- they are ``STEEP`` times as frequent as the three codes before them: no bell has such a flank;
- next to nothing, ``ABOVE`` of them, is higher: rounding of a codec.

Compression throws the channels' codes to both sides of a plateau, up to some ten, but hardly their luma: it keeps that
in full resolution. So a plateau of luma counts for all channels where its pixels are neutral: lamps drive all channels
to the end, and few surfaces are so neutral.

Where sharpening and hard compression blur a plateau too far for that, a camera that meters for itself tells all the
same: what it shows of a lit surface moves with its gain, and a plateau does not. So where the top of the luma in the
ball, neutral as above, stays within ``STILL`` codes over frames whose gains differ by ``MOVED`` and more, it is the
level: a surface would have moved by some ten codes.

Before anything drifts such a top is a level only where two more things say so: the camera lays a tone curve over what
it shows, as cameras do that end early, and next to nothing in the whole picture is brighter. A lit wall in the ball is
dimmed by it: the wall itself, or paper, is brighter beside it. It is taken back where it moves with the gain after all.

A level that was seen holds for all frames after it, for the camera is the same. A frame whose codes heap up at 254 and
255 anywhere in the picture takes it back for good.

Frames of more than 8 bits are asked in the same way, by their codes rounded to 8. Where the plateau lies between two of
these is the median of what was rounded to its code: a channel that ends at code 950 of 1023 ends at 236.8 of 255.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warp_ar.scene import Camera, Probe
from warp_ar.scene.pose import Pose
from warp_ar.sources.deep_frame import Plate

FULL = 255
"""Code at which channels saturate unless pictures say otherwise."""
LEAST_LEVEL = 200
"""Code below which no camera is taken to saturate."""
NEAR_FULL = 253
"""Level from which on the usual one is meant: codecs lower 255 by one or two."""
LEAST_PIXELS = 8
"""Pixels of the ball that a plateau has."""
LEAST_SHARE = 1e-3
"""Share of the ball's pixels that it has."""
STEEP = 4.0
"""Ratio of a plateau's pixels to those of as many codes before it."""
ABOVE = 0.05
"""Share of a plateau's pixels that may be higher: rounding."""
ABOVE_LUMA = 0.15
"""The same of a plateau of luma."""
NEUTRAL = 3.0
"""Codes by which the median pixel of a plateau of luma may be off it, in each channel."""
LUMA = np.array([0.299, 0.587, 0.114])
"""Weights of luma in JPEG and most video, ITU-R BT.601."""
RINGING = 17
"""Codes by which compression exceeds a plateau."""
LEAST_HEAP = 2e-4
"""Share of the whole picture that has codes 254 and 255 where a channel saturates at them."""
INSIDE = 0.95
"""Share of the ball's radius within which pixels are the ball's for certain."""
WATCHED = 24
"""First frames of a camera, each of which is looked at."""
PERIOD = 12
"""Interval, in frames, between later measurements."""
WIDTH = 1
"""Codes to either side of a plateau's own that belong to it."""
WIDE = 2
"""The same for luma after strong compression."""
NEUTRAL_WIDE = 6.0
"""Largest distance, in codes, of the median pixel of such a plateau; chroma is compressed more strongly than luma."""
LOPSIDED = 0.7
"""Largest ratio of pixels above a wide plateau to pixels in as many codes below it; a lit surface has a ratio of 1."""
TOP = 3
"""Codes to either side of a blurred plateau's own that belong to it."""
TOP_SHARE = 0.02
"""Share of the ball's pixels that it has."""
TOP_STEEP = 2.0
"""Ratio of its pixels to those of as many codes before it."""
STILL = 4
"""Codes over which it may be spread in time."""
MOVED = 0.25
"""Logarithm of the ratio of the largest gain to the least."""
MOVED_FRAMES = 4
"""Frames that must tell."""
HELD_HEAP = 2e-3
"""Share of the whole picture that has codes 254 and 255 where a level that was seen is taken back: sharpening and
compression throw some there."""


class SaturationLevels:
    """Remembers at which code each channel saturates, frame after frame."""

    def __init__(self) -> None:
        """Take every channel to saturate at 255."""
        self.levels: NDArray[np.float64] = np.full(3, float(FULL))
        """Code at which each channel saturates, (3,); between two of 8 bits where frames have more."""
        self._is_full = np.zeros(3, bool)
        self._tops: list[tuple[int, float]] = []
        self._stays: int | None = None
        self._guess: bool | None = None
        """True if the levels are those of a top that need not stay; None: none was tried, and False: it did not."""

    def observe(
        self,
        image: NDArray[np.uint8],
        balls: Sequence[tuple[float, float, float]],
        gain: float = 1.0,
        plate: Plate | None = None,
        *,
        bent: bool = False,
    ) -> bool:
        """Look at one picture; returns whether a level has changed.

        Args:
            image: uint8 RGB (height, width, 3).
            balls: Centre x, y and radius of each ball, pixels.
            gain: Of the camera, against its first frame, where that is known to drift.
            plate: The frame at its full depth, whose codes are read in the place of ``image``'s in balls. Linear light
                has none.
            bent: Whether the camera is known to lay a tone curve over what it shows, and its gain is followed.
        """
        if self._is_full.all() and gain == 1.0:
            return False
        before = self.levels.copy()
        exact = None
        if plate is not None and plate.picture.dtype == np.uint16:
            exact = ball_codes(plate.picture, balls) / 257.0
        codes = ball_codes(image, balls) if exact is None else np.rint(exact).astype(np.uint8)
        top = luma_top(codes)
        if self._stays is None:
            self._stays = self._unmoved(top, gain)
        if self._stays is not None:
            self.levels[:] = self._stays
            return bool((before != self.levels).any())
        found = luma_plateau(codes)
        if found is not None:
            self._guess = False
        elif bent and top is not None and self._may_be_level(image, top):
            found = top
        for c in range(3):
            part = np.ascontiguousarray(image[::2, ::2, c])
            heap = int(np.count_nonzero(part >= 254))
            before_it = int(np.count_nonzero(part >= 252)) - heap
            share = LEAST_HEAP if self.levels[c] == FULL else HELD_HEAP
            self._is_full[c] |= heap >= max(LEAST_PIXELS, share * part.size) and heap > 2 * before_it
            level = find_plateau(np.bincount(codes[:, c], minlength=256), STEEP, ABOVE)
            if level is None:
                level = found
            if level is not None and level != round(self.levels[c]):
                self.levels[c] = level if exact is None else _exact_level(exact[:, c], level)
            if self._is_full[c]:
                self.levels[c] = FULL
        return bool((before != self.levels).any())

    def _may_be_level(self, image: NDArray[np.uint8], top: int) -> bool:
        """Return whether the code around which luma crowds may be the level before a gain has moved."""
        if self._guess is not None or (self.levels != FULL).any():
            return False
        brighter = float((image[::2, ::2] @ LUMA > top + RINGING // 2).mean())
        self._guess = True if brighter <= HELD_HEAP else None
        return bool(self._guess)

    def _unmoved(self, top: int | None, gain: float) -> int | None:
        """Return the code at which luma saturates at any gain; None if still unknown."""
        if top is None:
            return None
        self._tops = [*self._tops, (top, float(np.log(max(gain, 1e-6))))][-WATCHED:]
        level, moved = np.array(self._tops).T
        if len(level) < MOVED_FRAMES or np.ptp(moved) < MOVED:
            return None
        if np.ptp(level) <= STILL:
            return int(np.median(level))
        if self._guess:
            self._guess, self.levels[:] = False, FULL
        return None


def _exact_level(codes: NDArray[np.float64], level: int) -> float:
    """Return where a plateau lies whose 8-bit code is known.

    Args:
        codes: Of one channel, in steps of 8 bits but not rounded, (n,).
        level: The rounded code.
    """
    on = codes[np.rint(codes) == level]
    return float(np.median(on)) if len(on) else float(level)


def find_plateau(counts: NDArray[np.int64], steep: float, above: float, width: int = WIDTH) -> int | None:
    """The code at which a channel saturates, or None where its pixels do not tell.

    Args:
        counts: How often each code is seen, (256,).
        steep: How many times as frequent as the codes before and behind it a plateau must be.
        above: Share of its pixels that may be higher.
        width: Codes to either side of its own that belong to it.
    """
    highest = int(np.flatnonzero(counts).max(initial=0))
    if highest < LEAST_LEVEL:
        return None
    candidates = np.arange(max(highest - RINGING, LEAST_LEVEL), highest + 1)
    level = int(candidates[np.argmax(counts[candidates])])
    on = int(counts[level - width : level + width + 1].sum())
    below = int(counts[level - 3 * width - 1 : level - width].sum())
    behind = counts[level + width + 1 :]
    if level >= NEAR_FULL or on < max(LEAST_PIXELS, LEAST_SHARE * int(counts.sum())):
        return None
    after = int(behind[: 2 * width + 1].sum())
    is_steep = on >= steep * max(below, after) and (width == WIDTH or after <= LOPSIDED * below)
    return level if is_steep and int(behind.sum()) <= above * on else None


def luma_plateau(codes: NDArray[np.uint8]) -> int | None:
    """The code at which all channels saturate by a plateau of luma, or None.

    Args:
        codes: Pixels, (n, 3).
    """
    luma = np.round(codes @ LUMA).astype(np.int64)
    counts = np.bincount(luma, minlength=256)
    level, width = find_plateau(counts, STEEP, ABOVE_LUMA), WIDTH
    if level is None:
        level, width = find_plateau(counts, STEEP, ABOVE_LUMA, WIDE), WIDE
    if level is None:
        return None
    on = codes[np.abs(luma - level) <= width].astype(np.float64)
    off = np.median(np.abs(on - level), axis=0).max()
    return level if off <= (NEUTRAL if width == WIDTH else NEUTRAL_WIDE) else None


def luma_top(codes: NDArray[np.uint8]) -> int | None:
    """The code around which the brightest pixels' luma crowds, below the usual level; None where it does not.

    Args:
        codes: Pixels, (n, 3).
    """
    luma = np.round(codes @ LUMA).astype(np.int64)
    counts = np.bincount(luma, minlength=256)
    around = np.convolve(counts, np.ones(2 * TOP + 1, np.int64), "same")
    level = LEAST_LEVEL + int(np.argmax(around[LEAST_LEVEL : NEAR_FULL - TOP]))
    on, below = int(around[level]), int(counts[level - 3 * TOP - 1 : level - TOP].sum())
    if on < max(LEAST_PIXELS, TOP_SHARE * len(codes)) or on < TOP_STEEP * below:
        return None
    if counts[level + TOP + 1 :].sum() > 0.5 * on or counts[NEAR_FULL:].sum() > ABOVE * on:
        return None
    in_crowd = np.abs(luma - level) <= TOP
    # Where a plateau is narrower than the window, several windows hold all of it.
    middle = int(np.median(luma[in_crowd]))
    off = np.abs(codes[in_crowd].astype(np.float64) - middle)
    return middle if np.median(off, axis=0).max() <= NEUTRAL_WIDE else None


def ball_codes(
    image: NDArray[Any], balls: Sequence[tuple[float, float, float]], inside: float = INSIDE
) -> NDArray[Any]:
    """Codes of the pixels inside balls, (n, 3), of the picture's type.

    Args:
        image: uint8 or uint16 RGB (height, width, 3).
        balls: Centre x, y and radius of each, pixels.
        inside: Share of the radius within which a pixel is taken.
    """
    height, width = image.shape[:2]
    found = [np.zeros((0, 3), image.dtype)]
    for x, y, radius in balls:
        r = inside * radius
        top, bottom = max(int(np.ceil(y - r)), 0), min(int(np.floor(y + r)) + 1, height)
        left, right = max(int(np.ceil(x - r)), 0), min(int(np.floor(x + r)) + 1, width)
        if top >= bottom or left >= right:
            continue
        off = np.hypot(np.arange(top, bottom)[:, None] - y, np.arange(left, right)[None] - x)
        found.append(image[top:bottom, left:right][off <= r])
    return np.concatenate(found)


def ball_discs(probes: Sequence[Probe], camera: Camera, pose: Pose) -> list[tuple[float, float, float]]:
    """Return balls in the picture as circles: centre x, y and radius, pixels; none of those behind the camera.

    Args:
        probes: The balls.
        camera: Its distortion is left out: a rough place is enough.
        pose: ``camera_from_world``.
    """
    discs = []
    for probe in probes:
        x, y, z = (float(v) for v in pose.rotation @ np.array(probe.center) + pose.translation)
        if z > probe.radius:
            discs.append((camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy, camera.fx * probe.radius / z))
    return discs
