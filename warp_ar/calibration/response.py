"""Measurement of a camera's response curve, from the printed card or from a static scene at several exposures.

A response file is text: 256 lines of three numbers, the linear red, green and blue value of each 8-bit code, 1 for code
255; a line that begins with # is a comment.

The card's grey patches consist of dots of black ink that cover a known share of the paper and are too small for a
camera. The reflectance of a patch relative to white paper is 1 - s (1 - k), with the share s and the ratio k of black
ink to white paper. Each picture therefore shows the curve at five known ratios, and the board's black and white show
the gradient of the light across the card. One picture cannot separate the curve from the spread of ink; pictures at
several exposures, which show a patch at several codes, can in part.

The curve is modelled as sRGB's with another gamma, another toe, and a bend as in tone curves:

    ln L(c) = ln L_srgb(c) + t_1 ln c + t_2 (ln L_srgb(c) - 2.2 ln c) + t_3 (1 - c) + t_4 (1 - c)^2,    L(1) = 1.

Gammas of 1.8 to 2.6 with an S-shape are reproduced within 1 %, rarely 3 %, down to code 20. Thus ln L of an observed
code is linear in t, in the exposure and in the light's gradient across the card; only k and the ink's spread are
nonlinear. A few steps of Gauss-Newton with priors solve for all. The inverse of the normal matrix, times the variance
of the residuals, is the covariance that gives the interval. Its largest part is the effect of ink spread on the grey
patches.

References:
    [DM97] P. Debevec and J. Malik. Recovering high dynamic range radiance maps from photographs. SIGGRAPH 1997.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from warp_ar.errors import UsageError
from warp_ar.files import store
from warp_ar.signature import PROGRAM
from warp_ar.srgb import decode_srgb
from warp_ar.tracking.card_layout import CARD_BOARD, CARD_MARKER, GREY_SIZE, GREYS, grey_centers
from warp_ar.tracking.markers import make_board, pattern_of

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

MOST: Final = 24
"""Largest number of pictures used."""
FEWEST: Final = 2
"""Smallest number of pictures that separate a gradient of the light from the curve."""
CORNERS: Final = 8
"""Smallest number of detected board corners for locating the patches."""
RANGE: Final = (8.0, 248.0)
"""Range of codes that are neither crushed nor clipped."""
RESOLVED: Final = 9.0
"""Standard deviation of a patch's codes above which its dots are resolved, so that its mean code is meaningless."""
FLAT: Final = 3.0
"""Largest standard deviation of the codes of a cell that is not affected by its neighbours' blur."""
SPAN: Final = 90.0
"""Smallest range of codes, from the darkest to the brightest sample, that determines a curve."""
BLACK: Final = (0.055, 0.5)
"""Expected ratio of black ink to white paper, and the standard deviation of its logarithm."""
SPREAD: Final = 0.03
"""Standard deviation of the coverage that ink spread adds to a share of one half."""
CODE_ERROR: Final = 0.8
"""Standard error in codes of a patch's or cell's mean: noise, compression, neighbouring blur."""
EVEN: Final = (0.01, 0.04)
"""Standard deviations of the logarithm of a patch and of a zone's cells that the model does not explain; cells are
small, and the blur from neighbours is the same in all zones."""
BENDS: Final = ((0.0, 0.5), (-0.5, 0.5), (0.0, 0.5), (0.5, 1.0))
"""Mean and standard deviation of the priors on t_1 to t_4."""
MISFIT: Final = 0.07
"""Standard deviation of the logarithm, in dark regions, of a camera's curve from curves of this form; toward code 255,
where all curves meet, it decreases as the square root of the remaining range."""
MOST_DEVIATION: Final = 0.25
"""Largest interval of a middle code's value, relative to it; common cameras differ from sRGB by as much."""
COUNTED: Final = 5
"""Number of pictures beyond which more add no information: errors of compression and of the curve's form are the same
in all of them, and must not outweigh the priors."""
ZONES: Final = 3
"""Number of zones along x and y over which the board's cells are averaged, because neighbours have the same errors."""
_LIMITS: Final = ((0.015, 0.25), (-0.1, 0.1))
"""Bounds of k and of the ink's spread; without them a flat curve would fit any picture."""
_STEPS: Final = 12
_TERMS: Final = len(BENDS)


def measure_response(images: Sequence[Image], exposures: Sequence[float]) -> Array:
    """Return the linear value of each 8-bit code, from pictures of a static scene at several exposure times [DM97].

    Args:
        images: RGB uint8 pictures of one size, taken without moving the camera.
        exposures: their exposure times in seconds; only ratios matter.

    Returns:
        Red, green and blue, (256, 3), increasing, with 1 at code 255.

    Raises:
        UsageError: if there are too few pictures, they differ in size, or exposures are invalid.
    """
    if len(images) < 3 or len(images) != len(exposures):
        raise UsageError(
            f"{len(images)} pictures and {len(exposures)} exposures; expected one for each, and three or more"
        )
    if len({image.shape for image in images}) > 1:
        raise UsageError("pictures of different sizes; expected one still camera")
    if not all(math.isfinite(e) and e > 0 for e in exposures) or max(exposures) < 2 * min(exposures):
        raise UsageError(
            f"exposures {', '.join(f'{e:g}' for e in exposures)}: expected times above 0 that differ by 2 or more"
        )
    # More samples than OpenCV's 70, and more smoothing than its 10, so that 8-bit noise does not distort the curve.
    calibrate = cv2.createCalibrateDebevec(samples=300, lambda_=50.0, random=False)
    curve = np.asarray(calibrate.process(list(images), np.asarray(exposures, np.float32)), float).reshape(256, 3)
    if not np.isfinite(curve).all() or (curve <= 0).any():
        raise UsageError(
            "the exposures do not determine a response: are all pictures of one scene, neither black nor white?"
        )
    # Noise may make the ends of the curve decrease; a response only increases.
    curve = np.maximum.accumulate(curve, axis=0)
    curve -= curve[0]
    if (curve[-1] <= 0).any():
        raise UsageError("the pictures do not differ: expected one scene at several exposures")
    return np.asarray(curve / curve[-1], float)


def write_response(curve: Array, path: Path) -> None:
    """Write a response as text: 256 lines of three linear values.

    Raises:
        SinkError: if the file cannot be written.
    """
    text = f"# {PROGRAM}\n" + "".join(f"{r:.9g} {g:.9g} {b:.9g}\n" for r, g, b in curve)
    store(path, text.encode())


@dataclasses.dataclass(frozen=True)
class GreyResponse:
    """Response curve with its uncertainty."""

    curve: Array
    """Linear value of each code, (256, 3), 1 at code 255."""
    deviation: Array
    """Relative standard deviation of each value, (256, 3)."""
    views: int
    """Number of pictures used."""
    span: tuple[float, float]
    """Lowest and highest observed code; beyond them the curve is extrapolated by the model."""


@dataclasses.dataclass(frozen=True)
class _Samples:
    """Samples of the card in one picture: positions (n, 2) in metres, shares of ink (n,), codes (n, 3)."""

    places: Array
    shares: Array
    codes: Array


def measure_grey_response(images: Iterable[Image]) -> GreyResponse:
    """Measure the response curve from the card's grey patches.

    Args:
        images: RGB uint8 pictures of the printed card, ideally at several exposures or under changing light.

    Raises:
        UsageError: Too few pictures show the card, its dots are resolved, or its contrast is too low.
    """
    found, resolved, count = [], 0, 0
    for image in images:
        count += 1
        sampled = _sample(image)
        resolved += sampled is not None and len(sampled.shares) == 0
        if sampled is not None and len(sampled.shares):
            found.append(sampled)
    if len(found) < FEWEST:
        if resolved:
            raise UsageError(
                f"the dots of the card's greys are seen one by one in {resolved} of {count} pictures; step back until "
                "they blend, or take smaller pictures"
            )
        raise UsageError(
            f"the card's greys are seen in {len(found)} of {count} pictures; expected {FEWEST} or more, with all of "
            "the board and the row of greys below it"
        )
    found = found[:: -(-len(found) // MOST)]
    channels = [_solve(found, channel) for channel in range(3)]
    codes = np.concatenate([samples.codes for samples in found])
    inside = codes[(codes >= RANGE[0]) & (codes <= RANGE[1])]
    return GreyResponse(
        np.stack([curve for curve, _ in channels], -1),
        np.stack([deviation for _, deviation in channels], -1),
        len(found),
        (float(inside.min()), float(inside.max())),
    )


def _sample(image: Image) -> _Samples | None:
    """Return patches and cells of one picture; None without a visible card, empty if its dots are resolved."""
    gray = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
    board = make_board(CARD_MARKER)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(gray)
    if ids is None or len(ids) < CORNERS:
        return None
    # OpenCV's board has its origin at a corner with y down the page; the card has it at the centre with y up.
    width, height = CARD_BOARD.size
    flat = np.asarray(board.getChessboardCorners(), float)[np.ravel(ids)][:, :2]
    flat = (flat - (width / 2, height / 2)) * (1.0, -1.0)
    matrix, _ = cv2.findHomography(flat, np.asarray(corners, float).reshape(-1, 2), cv2.RANSAC, 2.0)
    if matrix is None:
        return None
    places, shares, codes = [], [], []
    across, down = np.meshgrid(np.linspace(-0.33, 0.33, 12), np.linspace(-0.25, 0.25, 4))
    grid = np.column_stack([across.ravel() * GREY_SIZE[0], down.ravel() * GREY_SIZE[1]])
    for share, center in zip(GREYS, grey_centers(), strict=True):
        seen = _codes_at(image, matrix, center[:2] + grid)
        if seen is None:
            return None
        if seen.std(0).max() > RESOLVED and 0.0 < share < 1.0:
            return _Samples(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 3)))
        places.append(center[:2])
        shares.append(share)
        codes.append(seen.mean(0))
    _add_cells(image, matrix, places, shares, codes)
    return _Samples(np.array(places), np.array(shares), np.array(codes))


def _add_cells(image: Image, matrix: Array, places: list[Array], shares: list[float], codes: list[Array]) -> None:
    """Add the board's white and black cells, averaged over zones."""
    pattern = pattern_of(CARD_MARKER)
    cells, white, side = pattern.cells, pattern.white, pattern.side
    middle = np.column_stack([a.ravel() for a in np.meshgrid(*[np.linspace(-0.15, 0.15, 3) * side] * 2)])
    extent = np.abs(cells[:, :2]).max(0)
    zone = np.clip(((cells[:, :2] / extent + 1) / 2 * ZONES).astype(int), 0, ZONES - 1) @ (1, ZONES)
    for number in range(ZONES**2):
        for is_white in (False, True):
            kept = []
            for cell in cells[(zone == number) & (white == is_white), :2]:
                seen = _codes_at(image, matrix, cell + middle)
                # A cell affected by a neighbour's blur is not uniform.
                if seen is not None and seen.std(0).max() < FLAT:
                    kept.append((cell, seen.mean(0)))
            if len(kept) >= 3:
                places.append(np.mean([cell for cell, _ in kept], 0))
                shares.append(0.0 if is_white else 1.0)
                codes.append(np.median([seen for _, seen in kept], 0))


def _codes_at(image: Image, matrix: Array, points: Array) -> Array | None:
    """Return codes (n, 3) at points (n, 2) of the card; None if any is outside the picture."""
    pixels = cv2.perspectiveTransform(points.reshape(-1, 1, 2), matrix).reshape(-1, 2)
    if (pixels < 1).any() or (pixels > (image.shape[1] - 2, image.shape[0] - 2)).any():
        return None
    x, y = pixels.astype(np.float32).T
    return np.asarray(cv2.remap(image, x[:, None], y[:, None], cv2.INTER_LINEAR)[:, 0], float)


def _log_srgb(code: Array) -> Array:
    """Return the logarithm of sRGB's linear value of codes from 0 to 1."""
    value: Array = decode_srgb(code)
    return np.log(np.maximum(value, 1e-6))


def _bends(code: Array) -> Array:
    """Return the factors of t_1 to t_4, (n, 4)."""
    log = np.log(np.maximum(code, 1.0 / 255.0))
    return np.stack([log, _log_srgb(code) - 2.2 * log, 1.0 - code, (1.0 - code) ** 2], -1)


def _log_curve(code: Array, terms: Array) -> Array:
    return np.asarray(_log_srgb(code) + _bends(code) @ terms)


def _reflected(share: Array, black: float, spread: float) -> Array:
    """Return the logarithm of the reflectance of an ink share relative to white paper.

    ``spread`` is the coverage that the spread of ink adds to a share of one half.
    """
    inked = np.clip(share + 4.0 * spread * share * (1.0 - share), 0.0, 1.0)
    return np.log(1.0 - inked * (1.0 - black))


def _solve(found: list[_Samples], channel: int) -> tuple[Array, Array]:
    """Return the curve (256,) and its relative deviation (256,) of one channel."""
    view, places, shares, codes, even = _joined(found, channel)
    if len(codes) == 0 or np.ptp(codes) * 255.0 < SPAN:
        low, high = (255.0 * end for end in (codes.min(initial=1.0), codes.max(initial=0.0)))
        raise UsageError(
            f"the card's greys have codes {low:.0f} to {high:.0f} only; light it so that its white is bright and does "
            "not clip"
        )
    count = view.max() + 1
    fixed = np.zeros((len(codes), 3 * count))
    rows = np.arange(len(codes))
    for k, column in enumerate((np.ones(len(codes)), places[:, 0] * 10, places[:, 1] * 10)):
        fixed[rows, 3 * view + k] = -column
    bends = _bends(codes)
    black, spread = math.log(BLACK[0]), 0.0
    prior = np.concatenate([[1 / width for _, width in BENDS], [1 / BLACK[1], 1 / SPREAD], np.full(3 * count, 1e-3)])
    solved = np.zeros(_TERMS + 2 + 3 * count)
    means = np.array([mean for mean, _ in BENDS])
    solved[:_TERMS] = means
    say = math.sqrt(min(1.0, COUNTED / float(count)))
    for _ in range(_STEPS):
        # The error of a code times the curve's slope is the error of the logarithm. The slope must be that of the
        # current curve: otherwise flat curves would fit best.
        ahead, behind = (_log_curve(codes + step, solved[:_TERMS]) for step in (0.003, -0.003))
        weight = say / np.hypot(CODE_ERROR / 255.0 * np.maximum((ahead - behind) / 0.006, 0.3), even)
        now = _reflected(shares, math.exp(black), spread)
        by_black = (_reflected(shares, math.exp(black + 1e-4), spread) - now) / 1e-4
        by_spread = (_reflected(shares, math.exp(black), spread + 1e-4) - now) / 1e-4
        # bends t - d_black - d_spread - exposure - slope = now - ln L_srgb
        design = np.column_stack([bends, -by_black, -by_spread, fixed]) * weight[:, None]
        target = (now - _log_srgb(codes)) * weight
        start = np.concatenate([means, [math.log(BLACK[0]) - black, -spread], np.zeros(3 * count)])
        normal = design.T @ design + np.diag(prior**2)
        solved = np.linalg.solve(normal, design.T @ target + prior**2 * start)
        black = float(np.clip(black + solved[_TERMS], *np.log(_LIMITS[0])))
        spread = float(np.clip(spread + solved[_TERMS + 1], *_LIMITS[1]))
    rest = design @ solved - target
    # Errors of samples in one picture are correlated: pictures and patches count, not cells.
    excess = max(float((rest**2).mean()) / say**2, 1.0)
    covariance = np.asarray(np.linalg.inv(normal) * excess, float)
    return _curve(np.asarray(solved[:_TERMS], float), covariance[:_TERMS, :_TERMS])


def _joined(found: list[_Samples], channel: int) -> tuple[NDArray[np.int64], Array, Array, Array, Array]:
    """Return picture index, position, share of ink, code (0 to 1) and deviation (``EVEN``) of all usable samples."""
    view = np.concatenate([np.full(len(samples.shares), k) for k, samples in enumerate(found)])
    places, shares = (np.concatenate([getattr(samples, name) for samples in found]) for name in ("places", "shares"))
    codes = np.concatenate([samples.codes[:, channel] for samples in found])
    even = np.concatenate([np.where(np.arange(len(one.shares)) < len(GREYS), *EVEN) for one in found])
    kept = (codes >= RANGE[0]) & (codes <= RANGE[1])
    _, number = np.unique(view[kept], return_inverse=True)
    return number.astype(np.int64), places[kept], shares[kept], codes[kept] / 255.0, even[kept]


def _curve(terms: Array, covariance: Array) -> tuple[Array, Array]:
    codes = np.arange(256) / 255.0
    bends = _bends(codes)
    curve = np.exp(_log_curve(codes, terms))
    # A response only increases, from zero.
    curve = np.maximum.accumulate(np.where(codes > 0, curve, 0.0))
    deviation = np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", bends, covariance, bends), 0.0))
    return curve / curve[-1], np.hypot(deviation, MISFIT * np.sqrt(1.0 - codes))
