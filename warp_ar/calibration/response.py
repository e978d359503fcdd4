"""Response curve of a camera, from the printed card's greys or from one still scene at several exposures.

A response file is text: 256 lines of three numbers, the linear red, green and blue value of each 8-bit code, 1 for code
255; a line that begins with # is a comment.

The card's greys are dots of black ink that cover a known share of the paper, too small for a camera: what a patch
reflects, over what white paper reflects, is 1 - s (1 - k) with the share s and black ink over white paper k. So each
picture shows the curve at five known ratios, and the board's own black and white tell how light falls off across the
card. One picture cannot tell a curve from ink that spreads; pictures of several exposures, in which a patch is seen at
several codes, can in part.

The curve is sRGB's with another gamma, another toe and a bend, as tone curves have:

    ln L(c) = ln L_srgb(c) + t_1 ln c + t_2 (ln L_srgb(c) - 2.2 ln c) + t_3 (1 - c) + t_4 (1 - c)^2,    L(1) = 1.

Gammas of 1.8 to 2.6 with an S are met within 1 %, rarely 3 %, down to code 20. So ln L of an observed code is linear in
t, in the exposure and in the light's slope across the card; only k and the ink's spread are not. A few steps of
Gauss-Newton with priors solve for all. The inverse of the normal matrix, times the residuals' spread, is the covariance
that gives the interval: most of it is what ink that spreads does to the greys.

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
from warp_ar.tracking.card_layout import GREY_SIZE, GREYS, SHEET, grey_centers
from warp_ar.tracking.markers import make_board, printed_cells

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

MOST: Final = 24
"""Pictures that are used at most."""
FEWEST: Final = 2
"""Least number of pictures that separate a gradient of the light from the curve."""
CORNERS: Final = 8
"""Corners of the board without which no patch is placed exactly."""
RANGE: Final = (8.0, 248.0)
"""Codes that are neither crushed nor clipped."""
RESOLVED: Final = 9.0
"""Standard deviation of a patch's codes above which its dots are seen one by one, and its mean means nothing."""
FLAT: Final = 3.0
"""Standard deviation of the codes of a cell that no neighbour's blur reaches."""
SPAN: Final = 90.0
"""Codes from the darkest to the brightest sample that a curve needs."""
BLACK: Final = (0.055, 0.5)
"""Black ink over white paper: what is expected, and the standard deviation of its logarithm."""
SPREAD: Final = 0.03
"""Standard deviation of what ink that spreads adds to a share of one half."""
CODE_ERROR: Final = 0.8
"""Standard error in codes of a patch's or cell's mean: noise, compression, blur from beside it."""
EVEN: Final = (0.01, 0.04)
"""Standard deviation of the logarithm of light from a patch, and from a zone's cells, that nothing here explains: cells
are small, and what their neighbours' blur adds to them is the same in all zones."""
BENDS: Final = ((0.0, 0.5), (-0.5, 0.5), (0.0, 0.5), (0.5, 1.0))
"""Expectation of t_1 to t_4, and its standard deviation."""
MISFIT: Final = 0.07
"""Standard deviation of the logarithm of what curves of this form miss of a camera's, in the darks; toward code 255,
where all curves meet, it falls as the square root of what is left."""
MOST_DEVIATION: Final = 0.25
"""Share of a middle code's value that its interval may have: usual cameras differ from sRGB by as much."""
COUNTED: Final = 5
"""Pictures beyond which more tell nothing new: what compression and the curve's form miss is alike in all of them, and
must not outvote what is expected of the curve and the ink."""
ZONES: Final = 3
"""The board's cells are averaged over so many zones along x and y: neighbours share what is wrong with them."""
_LIMITS: Final = ((0.015, 0.25), (-0.1, 0.1))
"""Bounds of k and of the ink's spread; beyond them a flat curve would fit anything."""
_STEPS: Final = 12
_TERMS: Final = len(BENDS)


def measure_response(images: Sequence[Image], exposures: Sequence[float]) -> Array:
    """Linear value of each 8-bit code, from pictures of one still scene at several exposure times [DM97].

    Args:
        images: RGB uint8 pictures of one size, taken without moving the camera.
        exposures: their exposure times in seconds; only ratios matter.

    Returns:
        (256, 3) red, green and blue, rising, 1 at code 255.

    Raises:
        UsageError: if there are too few pictures, they differ in size, or exposures are impossible.
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
    # More samples than OpenCV's 70, and smoother than its 10: 8-bit noise must not bend the curve.
    calibrate = cv2.createCalibrateDebevec(samples=300, lambda_=50.0, random=False)
    curve = np.asarray(calibrate.process(list(images), np.asarray(exposures, np.float32)), float).reshape(256, 3)
    if not np.isfinite(curve).all() or (curve <= 0).any():
        raise UsageError(
            "the exposures do not determine a response: are all pictures of one scene, neither black nor white?"
        )
    # Noise at the ends may bend the curve down; a response only rises.
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
    """A response curve and how far it is known."""

    curve: Array
    """Linear value of each code, (256, 3), 1 at code 255."""
    deviation: Array
    """Relative standard deviation of each value, (256, 3)."""
    views: int
    """Pictures that were used."""
    span: tuple[float, float]
    """Lowest and highest code that was seen; beyond them the curve goes on as cameras' curves do."""


@dataclasses.dataclass(frozen=True)
class _Samples:
    """Samples of the card in one picture: places (n, 2) in metres, shares of ink (n,), codes (n, 3)."""

    places: Array
    shares: Array
    codes: Array


def measure_grey_response(images: Iterable[Image]) -> GreyResponse:
    """The response curve by the card's greys.

    Args:
        images: RGB uint8 pictures of the printed card, best of several exposures or under changing light.

    Raises:
        UsageError: Too few of them show the card, its dots are seen one by one, or all of it has one brightness.
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
    """Patches and cells of one picture; None where the card is not seen, empty where its dots are."""
    gray = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
    board = make_board(SHEET)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(gray)
    if ids is None or len(ids) < CORNERS:
        return None
    # OpenCV's board has its origin at a corner and y down the page, the card at its middle and y up.
    assert SHEET.board is not None
    width, height = SHEET.board.size
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
    """Add the board's white and black, averaged over zones."""
    cells, white, side, _ = printed_cells(SHEET)
    middle = np.column_stack([a.ravel() for a in np.meshgrid(*[np.linspace(-0.15, 0.15, 3) * side] * 2)])
    extent = np.abs(cells[:, :2]).max(0)
    zone = np.clip(((cells[:, :2] / extent + 1) / 2 * ZONES).astype(int), 0, ZONES - 1) @ (1, ZONES)
    for number in range(ZONES**2):
        for is_white in (False, True):
            kept = []
            for cell in cells[(zone == number) & (white == is_white), :2]:
                seen = _codes_at(image, matrix, cell + middle)
                # A cell that a neighbour's blur reaches is no flat white or black.
                if seen is not None and seen.std(0).max() < FLAT:
                    kept.append((cell, seen.mean(0)))
            if len(kept) >= 3:
                places.append(np.mean([cell for cell, _ in kept], 0))
                shares.append(0.0 if is_white else 1.0)
                codes.append(np.median([seen for _, seen in kept], 0))


def _codes_at(image: Image, matrix: Array, points: Array) -> Array | None:
    """Codes (n, 3) at points (n, 2) of the card; None outside the picture."""
    pixels = cv2.perspectiveTransform(points.reshape(-1, 1, 2), matrix).reshape(-1, 2)
    if (pixels < 1).any() or (pixels > (image.shape[1] - 2, image.shape[0] - 2)).any():
        return None
    x, y = pixels.astype(np.float32).T
    return np.asarray(cv2.remap(image, x[:, None], y[:, None], cv2.INTER_LINEAR)[:, 0], float)


def _log_srgb(code: Array) -> Array:
    """Logarithm of sRGB's linear value of codes 0 to 1."""
    value: Array = decode_srgb(code)
    return np.log(np.maximum(value, 1e-6))


def _bends(code: Array) -> Array:
    """Return what t_1 to t_4 are factors of, (n, 4)."""
    log = np.log(np.maximum(code, 1.0 / 255.0))
    return np.stack([log, _log_srgb(code) - 2.2 * log, 1.0 - code, (1.0 - code) ** 2], -1)


def _log_curve(code: Array, terms: Array) -> Array:
    return np.asarray(_log_srgb(code) + _bends(code) @ terms)


def _reflected(share: Array, black: float, spread: float) -> Array:
    """Logarithm of what a share of ink reflects over white paper; ``spread`` is what a half gains."""
    inked = np.clip(share + 4.0 * spread * share * (1.0 - share), 0.0, 1.0)
    return np.log(1.0 - inked * (1.0 - black))


def _solve(found: list[_Samples], channel: int) -> tuple[Array, Array]:
    """Curve (256,) and relative deviation (256,) of one channel."""
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
        # Errors of a code are those of its logarithm times the curve's slope there. The slope must be the curve's own:
        # with another's, the flatter a curve is the better it fits.
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
    # Samples of one picture share what is wrong with them: the pictures and patches count, not the cells.
    excess = max(float((rest**2).mean()) / say**2, 1.0)
    covariance = np.asarray(np.linalg.inv(normal) * excess, float)
    return _curve(np.asarray(solved[:_TERMS], float), covariance[:_TERMS, :_TERMS])


def _joined(found: list[_Samples], channel: int) -> tuple[NDArray[np.int64], Array, Array, Array, Array]:
    """Picture, place, share, code (0 to 1) and ``EVEN`` of all samples that are neither crushed nor clipped."""
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
    # A response only rises, from nothing.
    curve = np.maximum.accumulate(np.where(codes > 0, curve, 0.0))
    deviation = np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", bends, covariance, bends), 0.0))
    return curve / curve[-1], np.hypot(deviation, MISFIT * np.sqrt(1.0 - codes))
