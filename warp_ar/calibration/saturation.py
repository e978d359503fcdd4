"""Codes at which a camera's channels saturate, estimated from pictures.

A saturated sensor need not give code 255: limited range, a shoulder or tone mapping may end at 235 or 238. Brighter
light is clipped there as well, and taking code 238 for a radiance of 0.85 hides that a lamp clips.

Saturation appears as a plateau: inside the mirror ball, where lamps and windows are visible, many codes are equal and
none is higher. Evenly lit surfaces also have similar codes, but with noise to both sides of a mean. A level L below 254
is therefore accepted if, inside the ball,

- codes L - 1 to L + 1 are more than ``LEAST_SHARE`` of all pixels, and at least ``LEAST_PIXELS``;
- they are ``STEEP`` times as frequent as the three codes below them: no bell curve has such a flank;
- at most the share ``ABOVE`` of them is higher, by rounding of a codec.

Compression spreads the channels' codes around a plateau by up to ten codes, but hardly the luma, which has full
resolution. A plateau of luma therefore counts for all channels if its pixels are neutral: lamps saturate all channels,
and few surfaces are as neutral.

Sharpening and strong compression may blur a plateau too much for this test. With automatic exposure there is a second
one: the code of a lit surface changes with the camera's gain, a plateau does not. If the top of the ball's luma,
neutral as above, stays within ``STILL`` codes over frames whose gains differ by at least ``MOVED``, it is the level; a
surface would have changed by about ten codes.

Before any drift, such a top is a level only under two more conditions: the camera applies a tone curve, as cameras that
end early do, and almost nothing in the whole picture is brighter. (A lit wall appears darker in the ball than
directly.) The level is withdrawn if it changes with the gain later.

An accepted level holds for all later frames, because the camera is the same. It is withdrawn permanently if a frame has
a concentration of codes 254 and 255 anywhere in the picture.

Frames with more than 8 bits are tested in the same way, with codes rounded to 8 bits. The plateau's exact level is the
median of the codes that were rounded to it: a channel that ends at code 950 of 1023 ends at 236.8 of 255.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warp_ar.scene import Camera, Probe
from warp_ar.scene.pose import Pose
from warp_ar.sources.deep_frame import DeepFrame

FULL = 255
"""Default saturation code of all channels."""
LEAST_LEVEL = 200
"""Smallest code accepted as a saturation level."""
NEAR_FULL = 253
"""Code from which on a plateau counts as 255, because codecs lower 255 by one or two."""
LEAST_PIXELS = 8
"""Smallest number of the ball's pixels on a plateau."""
LEAST_SHARE = 1e-3
"""Smallest share of the ball's pixels on a plateau."""
STEEP = 4.0
"""Smallest ratio of a plateau's pixels to those of as many codes below it."""
ABOVE = 0.05
"""Largest share, relative to a plateau's pixels, of higher codes, caused by rounding."""
ABOVE_LUMA = 0.15
"""Largest share of higher codes for a plateau of luma."""
NEUTRAL = 3.0
"""Largest deviation, in codes, of the median pixel of a luma plateau from it, in each channel."""
LUMA = np.array([0.299, 0.587, 0.114])
"""Weights of luma in JPEG and most video, ITU-R BT.601."""
RINGING = 17
"""Largest overshoot in codes above a plateau, by compression."""
LEAST_HEAP = 2e-4
"""Least share of the picture's pixels with codes 254 and 255 that shows that a channel saturates at 255."""
INSIDE = 0.95
"""Share of the ball's radius within which pixels certainly belong to the ball."""
WATCHED = 24
"""Number of first frames of a camera that are all measured."""
PERIOD = 12
"""Interval, in frames, between measurements after the first ``WATCHED`` frames."""
WIDTH = 1
"""Number of codes on either side that belong to a plateau."""
WIDE = 2
"""Number of codes on either side of a luma plateau after strong compression."""
NEUTRAL_WIDE = 6.0
"""Largest distance, in codes, of the median pixel of a wide luma plateau; chroma is compressed more than luma."""
LOPSIDED = 0.7
"""Largest ratio of pixels above a wide plateau to pixels in as many codes below it; a lit surface has a ratio of 1."""
TOP = 3
"""Number of codes on either side that belong to a blurred plateau."""
TOP_SHARE = 0.02
"""Smallest share of the ball's pixels on a blurred plateau."""
TOP_STEEP = 2.0
"""Smallest ratio of a blurred plateau's pixels to those of as many codes below it."""
STILL = 4
"""Largest range, in codes, of a plateau over time."""
MOVED = 0.25
"""Smallest logarithm of the ratio between the largest and the smallest gain."""
MOVED_FRAMES = 4
"""Smallest number of usable frames."""
HELD_HEAP = 2e-3
"""Share of pixels with codes 254 and 255 that disproves a lower saturation level found before. Sharpening and
compression cause smaller shares."""


class SaturationLevels:
    """Estimator of each channel's saturation code over the frames."""

    def __init__(self) -> None:
        """Start with 255 for all channels."""
        self.levels: NDArray[np.float64] = np.full(3, float(FULL))
        """Saturation code of each channel, (3,); fractional for frames with more than 8 bits."""
        self._is_full = np.zeros(3, bool)
        self._tops: list[tuple[int, float]] = []
        self._stays: int | None = None
        self._guess: bool | None = None
        """True if the levels are provisional, from ``luma_top`` before any change of gain; None: none was tried; False:
        it was withdrawn, or a plateau was found."""

    def observe(
        self,
        image: NDArray[np.uint8],
        balls: Sequence[tuple[float, float, float]],
        gain: float = 1.0,
        deep: DeepFrame | None = None,
        *,
        bent: bool = False,
    ) -> bool:
        """Update the levels from one picture; return True if a level has changed.

        Args:
            image: uint8 RGB (height, width, 3).
            balls: Centre x, y and radius of each ball, pixels.
            gain: Gain of the camera relative to its first frame, if it drifts.
            deep: The frame at full depth, whose codes inside balls are used instead of those of ``image``; not for
                linear frames.
            bent: True if the camera is known to apply a tone curve, and its gain is estimated.
        """
        if self._is_full.all() and gain == 1.0:
            return False
        before = self.levels.copy()
        exact = None
        if deep is not None and deep.picture.dtype == np.uint16:
            exact = ball_codes(deep.picture, balls) / 257.0
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
        """Return True if the code ``top`` may be the saturation level, by the brighter pixels of one frame."""
        if self._guess is not None or (self.levels != FULL).any():
            return False
        brighter = float((image[::2, ::2] @ LUMA > top + RINGING // 2).mean())
        self._guess = True if brighter <= HELD_HEAP else None
        return bool(self._guess)

    def _unmoved(self, top: int | None, gain: float) -> int | None:
        """Return the code at which luma saturates for all gains so far; None if frames or gains are too few to tell."""
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
    """Return the exact level of a plateau whose 8-bit code is known.

    Args:
        codes: Codes of one channel, scaled to 0..255 but not rounded, (n,).
        level: The rounded code.
    """
    on = codes[np.rint(codes) == level]
    return float(np.median(on)) if len(on) else float(level)


def find_plateau(counts: NDArray[np.int64], steep: float, above: float, width: int = WIDTH) -> int | None:
    """Return the code at which a channel saturates; None if its pixels show no plateau.

    Args:
        counts: Number of pixels of each code, (256,).
        steep: Smallest ratio of the plateau's frequency to that of the codes below and above it.
        above: Largest share of higher codes, relative to the plateau's pixels.
        width: Number of codes on either side that belong to the plateau.
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
    """Return the code at which all channels saturate, by a plateau of luma; None if there is none.

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
    """Return the code around which the luma of the brightest pixels is concentrated.

    Return None if it is not concentrated, or if it is concentrated near code 255.

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
    # Several windows contain all of a plateau that is narrower than the window.
    middle = int(np.median(luma[in_crowd]))
    off = np.abs(codes[in_crowd].astype(np.float64) - middle)
    return middle if np.median(off, axis=0).max() <= NEUTRAL_WIDE else None


def ball_codes(
    image: NDArray[Any], balls: Sequence[tuple[float, float, float]], inside: float = INSIDE
) -> NDArray[Any]:
    """Return the codes of the pixels inside balls, (n, 3), in the picture's type.

    Args:
        image: uint8 or uint16 RGB (height, width, 3).
        balls: Centre x, y and radius of each ball, pixels.
        inside: Share of the radius within which pixels are used.
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
    """Return balls as circles in the picture: centre x, y and radius in pixels; balls behind the camera are left out.

    Args:
        probes: The balls.
        camera: Camera of the picture; its distortion is ignored, because an approximate circle suffices.
        pose: ``camera_from_world``.
    """
    discs = []
    for probe in probes:
        x, y, z = (float(v) for v in pose.rotation @ np.array(probe.center) + pose.translation)
        if z > probe.radius:
            discs.append((camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy, camera.fx * probe.radius / z))
    return discs
