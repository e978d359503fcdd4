"""Photographs of one ball at several exposures: alignment of the pictures, and their actual exposures.

**Alignment.** Two exposures of one scene differ by a monotone function of codes. It is read from the joint histogram
(the comparagram [Mann00]). The shift and scale that minimise the remaining difference are found by Gauss-Newton with
redescending weights; both steps alternate. The ball's reflections have thousands of edges, so an accuracy of a tenth of
a pixel is possible.

**Exposures.** The ratio of two pictures' linear values is that of their exposures, where nothing clips. Exposures by
EXIF or file names are used if the pixels agree. That test needs a response curve. sRGB is tried first. Where it does
not fit, the response is estimated from the bracket itself, ln g(c) = ln sRGB(c) + sum_j a_j h_j(c), with hat functions
h_j over the codes, by robust least squares on

    ln g(u) - ln g(v) = ln(t_u / t_v)

over the median codes (u, v) of each level of brightness in two neighbouring pictures [DM97]. One curve absorbs a single
ratio, but not contradictions: it must explain all levels of all pairs. So the fit is repeated with the time of one
picture unknown, or the times of all pictures after a step, as if a photograph were missing. If the error then vanishes,
that time is wrong. Of three pictures, any one may explain the contradiction; then this is said.

References:
    [DM97] P. Debevec and J. Malik. Recovering high dynamic range radiance maps from photographs. SIGGRAPH 1997.
    [Mann00] S. Mann. Comparametric equations with practical applications in quantigraphic image processing. 2000.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from warp_ar.errors import UsageError
from warp_ar.kernels.color import decode_table
from warp_ar.sources.exposures import WAVERING

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Circle = tuple[float, float, float]

PATCH = 384
"""Largest size in pixels of the ball's picture in which exposures are compared."""
DARKEST, DIM, BRIGHTEST = 16, 40, 245
"""Codes between which a pixel is used; codes below ``DIM`` only if there are no others.

Flare and processing raise dark codes of single pictures, and a short exposure has no other source for its dark codes.
"""
FLAT = 30
"""Range of codes around a pixel above which it is near an edge, where blur mixes clipped with other pixels."""
LEAST_PIXELS = 400
"""Smallest number of pixels well exposed in two pictures for a ratio."""
SOFT = 2.6
"""Squared ratio of gradients above which a picture is softer than both of its neighbours: 2.2 by noise."""
HOLDS = 0.12
"""Largest difference, as a logarithm, between an exposure step and the pixels' ratio."""
CONTRADICTS = 0.3
"""Largest such difference if a response is estimated with it; above it, no response explains the exposures."""
UNEVEN = 0.05
"""Mean error of a response, as a logarithm, above which a time may be wrong: true times leave 0.02, at most 0.08."""
EXPLAINS = 0.4
"""Largest error that a wrong time leaves, relative to the error without it."""
NOISE = 4
"""Codes by which noise and compression change a pixel."""
SATURATED = 235
"""Code from which a channel may clip: some cameras end below 255, and resizing lowers small lamps."""
SLACK = math.log(1.5)
"""Logarithm by which a pixel may differ from the level of brightness that it belongs to."""
BEND = math.log(2.0)
"""Largest difference, as a logarithm, between the exposure step at a level of brightness and the median step."""
COMPARED = 256
"""Smallest size in pixels in which pictures are aligned; lamps of smaller ones are as thin as edges."""
SHARED = 0.05
"""Smallest share of the ball well exposed in two pictures that tells the step between them."""
CONTRARY = 0.02
"""Share of a ball that may contradict another picture: up to 0.017 in nine real brackets, of which a blurred picture
has the most."""
BY_LIGHT = 3.0
"""Weight of the pixels' light in that share, relative to that of their number."""
GAMMAS = (1.5, 2.7)
"""Range of gammas at code 40 of cameras' 8-bit pictures: Rec. 709 has 1.7, sRGB 2.1; linear raw files need no
estimate."""
HATS = 8
"""Number of a response's unknowns: values at codes evenly spaced in (c / 255)^(1 / 2)."""


_LOG_SRGB = np.log(np.maximum(decode_table("srgb")[:, 1].astype(float), 1e-4))


@dataclasses.dataclass(frozen=True)
class Aligned:
    """Aligned pictures of one ball."""

    circles: tuple[Circle, ...]
    """Circle of the ball in each picture: column, row, radius in pixels."""
    patches: tuple[Image, ...]
    """Crops around the ball, all of one size, uint8 RGB."""
    strangers: tuple[str, ...]
    """Reason to leave out each picture; empty if there is none."""
    is_odd: bool
    """True if the anchor contradicts most of the others."""


def cut_ball(image: Image, circle: Circle, size: int) -> Image:
    """Return the square around a ball, with a side of 2.1 radii.

    Args:
        image: (height, width, 3).
        circle: Column, row and radius of the ball in pixels.
        size: Pixels along a side of the result.

    Returns:
        (size, size, 3), averaged where it is reduced.
    """
    x, y, radius = circle
    scale = 2.1 * radius / size
    corner = (x - 1.05 * radius + 0.5 * scale - 0.5, y - 1.05 * radius + 0.5 * scale - 0.5)
    # Averaged before reduction, so that a sample represents all pixels that it covers.
    blurred = cv2.GaussianBlur(image, (0, 0), 0.35 * scale) if scale > 1.5 else image
    matrix = np.array([[scale, 0.0, corner[0]], [0.0, scale, corner[1]]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(blurred, matrix, (size, size), flags=flags, borderMode=cv2.BORDER_REPLICATE))


def _tone_curve(u: NDArray[np.float32], v: NDArray[np.float32]) -> Array:
    """Return the median code of the second picture for each code of the first, (256,), non-decreasing."""
    bins = np.clip((u / 8).astype(int), 0, 31)
    middle = np.array([np.median(v[bins == k]) if (bins == k).sum() > 20 else np.nan for k in range(32)])
    known = np.isfinite(middle)
    curve = np.interp(np.arange(256), 8 * np.flatnonzero(known) + 3.5, np.maximum.accumulate(middle[known]))
    return np.asarray(curve)


def _gauss_newton(
    seen: NDArray[np.float32],
    wanted: NDArray[np.float32],
    ok: NDArray[np.bool_],
    x: NDArray[np.float32],
    y: NDArray[np.float32],
) -> Array:
    """Return the step (columns, rows, log scale) that aligns ``seen`` with ``wanted``, robustly."""
    slope_x, slope_y = (cv2.Sobel(seen, cv2.CV_32F, *way, scale=1 / 8)[ok] for way in ((1, 0), (0, 1)))
    error = (seen - wanted)[ok].astype(float)
    scale = 2.0 + 1.5 * float(np.median(np.abs(error)))
    weight = 1.0 / (1.0 + (error / scale) ** 2) ** 2
    jacobian = np.column_stack([slope_x, slope_y, slope_x * x[ok] + slope_y * y[ok]]).astype(float)
    normal = jacobian.T @ (weight[:, None] * jacobian) + 1e-6 * np.eye(3)
    return np.asarray(-np.linalg.solve(normal, jacobian.T @ (weight * error)))


def register(reference: Image, other: Image, disc: NDArray[np.bool_]) -> Array:
    """Return the shift and scale that align a picture with another one of another exposure.

    Args:
        reference: uint8 RGB (n, n, 3).
        other: The same size.
        disc: Mask of pixels that are used.

    Returns:
        Columns, rows, and log of the scale about the centre at which ``other`` must be sampled; 0 if fewer than
        ``LEAST_PIXELS`` can be used.
    """
    n = len(reference)
    gray = [cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32) for picture in (reference, other)]
    first, second = (cv2.GaussianBlur(picture, (0, 0), 1.0) for picture in gray)
    y, x = np.asarray(np.mgrid[:n, :n] - (n - 1) / 2, np.float32)
    well = disc & (reference.max(2) < BRIGHTEST) & (first > DARKEST)

    def look(blurred: NDArray[np.float32], move: Array) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Return the other picture sampled under ``move``, and a mask of pixels well exposed in both."""
        grow, middle = math.exp(move[2]), (n - 1) / 2
        at_x = (grow * x + middle + move[0]).astype(np.float32)
        at_y = (grow * y + middle + move[1]).astype(np.float32)
        seen = np.asarray(cv2.remap(blurred, at_x, at_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
        return seen, well & (seen > DARKEST) & (seen < BRIGHTEST - 5)

    move = np.zeros(3)
    for coarse in (0.04 * n, 0.02 * n, 0.01 * n, 0.0):
        a, b = (cv2.GaussianBlur(p, (0, 0), coarse) if coarse else p for p in (first, second))
        for _ in range(8):
            seen, ok = look(b, move)
            if ok.sum() < LEAST_PIXELS:
                return np.zeros(3)
            wanted = np.asarray(np.interp(a, np.arange(256), _tone_curve(a[ok], seen[ok])), np.float32)
            step = _gauss_newton(seen, wanted, ok, x, y)
            move += np.clip(step, -0.02 * n, 0.02 * n)
            move[2] = float(np.clip(move[2], -0.1, 0.1))
            if np.abs(step[:2]).max() < 0.01:
                break
    return move


def align(
    images: Sequence[Image], circles: Sequence[Circle], exposures: Sequence[float] | None = None, anchor: int = 0
) -> Aligned:
    """Align pictures of one ball with the anchor.

    A picture of another scene, or with too few common pixels, is aligned with the nearest successfully aligned
    exposure, so that a wrong picture affects no other.

    Args:
        images: uint8 RGB, in order of exposure.
        circles: Approximate circle of the ball in each; exact for the anchor.
        exposures: Exposure of each, if known.
        anchor: Index of the picture with which the others are aligned.
    """
    cut = int(np.clip(2.1 * circles[anchor][2], 48, PATCH))
    size = max(cut, COMPARED)
    disc, count = _disc(size), len(images)
    times = np.log(exposures or np.ones(count))
    found, good = list(circles), [anchor]
    patches = [cut_ball(image, circle, size) for image, circle in zip(images, circles, strict=True)]
    for k in sorted(set(range(count)) - {anchor}, key=lambda k: abs(k - anchor)):
        (x, y, radius), rough, least = circles[k], patches[k], math.inf
        for base in (anchor, *sorted(good[1:], key=lambda other: abs(k - other))):
            move, pixel = register(patches[base], rough, disc), 2.1 * radius / size
            circle = x + pixel * move[0], y + pixel * move[1], radius * math.exp(move[2])
            patch = cut_ball(images[k], circle, size)
            share = disagreement(patches[base], patch)
            if share < least:
                found[k], patches[k], least = circle, patch, share
            if share <= CONTRARY:
                good.append(k)
                break
    shares = np.full((count, count), math.nan)
    for a, b in itertools.combinations(range(count), 2):
        step = times[b] - times[a] if exposures and b == a + 1 else None
        shares[a, b] = shares[b, a] = disagreement(patches[a], patches[b], step)
    stay, is_odd = _agreeing(shares, anchor)
    why = "it shows something else in {:.0%} of the ball (another place or light, blur, or something before it)"
    reasons = ["" if stays else why.format(np.nanmax(row)) for stays, row in zip(stay, shares, strict=True)]
    patches = [cut_ball(image, circle, cut) for image, circle in zip(images, found, strict=True)]
    return Aligned(tuple(found), tuple(patches), tuple(reasons), is_odd)


def _agreeing(shares: Array, anchor: int) -> tuple[NDArray[np.bool_], bool]:
    """Return a mask of pictures without contradictions, and True if the anchor is the odd one or a tie decides.

    The picture that others contradict most is removed until none is contradicted. If that is the anchor, those that
    contradict it are removed instead.

    Args:
        shares: ``disagreement`` of each pair of pictures, (n, n); NaN if unknown.
        anchor: Index of the shown picture.
    """
    shares = np.nan_to_num(shares)
    stay, favour = np.ones(len(shares), bool), CONTRARY * (np.arange(len(shares)) == anchor)
    while (contrary := (shares[:, stay] > CONTRARY).any(1) & stay).any():
        stay[np.where(contrary, shares[:, stay].sum(1) - favour, -1.0).argmax()] = False
    is_odd = not stay[anchor] or 2 * int(stay.sum()) <= len(stay)
    return (stay if stay[anchor] else shares[anchor] <= CONTRARY), is_odd


def disagreement(first: Image, other: Image, step: float | None = None) -> float:
    """Return the share of a ball in which two aligned pictures of different exposures contradict each other.

    Equally bright places of one are equally bright in the other, whatever the response. Clipped pixels are lower
    bounds, dark ones upper bounds. Pixels count by their number and by their light, because lamps are small.

    Args:
        first: uint8 RGB (n, n, 3).
        other: The same size.
        step: Logarithm of the ratio of the exposures, used if too few pixels are well exposed in both.

    Returns:
        0 to 1; NaN if the pictures cannot be compared.
    """
    disc, near = _disc(len(first)), np.ones((3, 3), np.uint8)
    both = sorted((first, other), key=lambda picture: -float(picture.mean()))
    clips, ends = (cv2.dilate(np.uint8(one.max(2) >= SATURATED), np.ones((5, 5))) > 0 for one in both)
    u, v = (cv2.cvtColor(cv2.GaussianBlur(one, (0, 0), 1.0), cv2.COLOR_RGB2GRAY) for one in both)
    well = disc & ~clips & ~ends & (u > DARKEST) & (v > DARKEST)
    if well.sum() >= SHARED * disc.sum():
        ratio, level = _LOG_SRGB[v[well]] - _LOG_SRGB[u[well]], u[well] // 8
        known = np.flatnonzero(np.bincount(level) > 20)
        steps = np.array([np.median(ratio[level == k]) for k in known])
        middle = np.median(ratio)
        expected, slack = np.interp(u, 8 * known + 3.5, steps.clip(middle - BEND, middle + BEND)), SLACK
    elif step is not None:
        expected, slack = np.full(u.shape, -abs(step)), SLACK + BEND
    else:
        return math.nan
    low = _LOG_SRGB[cv2.subtract(cv2.erode(u, near), NOISE)] + expected - slack
    high = np.where(clips, math.inf, _LOG_SRGB[cv2.add(cv2.dilate(u, near), NOISE)] + expected + slack)
    off = np.where(ends, math.inf, _LOG_SRGB[cv2.add(v, NOISE)]) < low
    off |= _LOG_SRGB[cv2.subtract(v, NOISE)] > high
    told = disc & ~((u <= DARKEST) & (v <= DARKEST)) & ~(clips & ends)
    if not told.any():
        return math.nan
    # Single pixels and lines are edges.
    off = cv2.morphologyEx(np.uint8(off & told), cv2.MORPH_OPEN, near) > 0
    light = np.exp(np.maximum(_LOG_SRGB[v], np.minimum(low, 0.0)))
    weight = told * (1.0 + BY_LIGHT * light / light[told].mean())
    return float((off * weight).sum() / weight.sum())


def _disc(size: int) -> NDArray[np.bool_]:
    """Return the mask of a ball's pixels in its square, without the rim."""
    rows, columns = np.mgrid[:size, :size] - (size - 1) / 2
    return np.asarray(np.hypot(rows, columns) < 0.93 * size / 2.1)


def _collect(patches: Sequence[Image]) -> tuple[tuple[Array, Array], ...]:
    disc = _disc(len(patches[0]))
    smooth = [cv2.GaussianBlur(patch, (0, 0), 1.5) for patch in patches]
    # Near edges, misalignment changes the ratio.
    plain = [
        cv2.morphologyEx(cv2.cvtColor(patch, cv2.COLOR_RGB2GRAY), cv2.MORPH_GRADIENT, np.ones((5, 5), np.uint8))
        for patch in smooth
    ]
    pairs = []
    for k in range(len(patches) - 1):
        u, v = smooth[k], smooth[k + 1]
        ok = disc & (u.max(2) <= BRIGHTEST) & (v.max(2) <= BRIGHTEST)
        bright = ok & (u.min(2) >= DIM) & (v.min(2) >= DIM)
        flat = (plain[k] < FLAT) & (plain[k + 1] < FLAT)
        dim = ok & flat & (u.min(2) >= DARKEST) & (v.min(2) >= DARKEST)
        ways = ((bright & flat, LEAST_PIXELS), (bright, 5 * LEAST_PIXELS), (dim, 0))
        ok = next(chosen for chosen, least in ways if chosen.sum() >= least)
        pairs.append((u[ok].astype(float), v[ok].astype(float)))
    return tuple(pairs)


def _levels(patches: Sequence[Image]) -> Array:
    """Return pairs, and both median codes, (m, 3), of each level of brightness in neighbouring pictures.

    Every level counts once, independent of its number of pixels.
    """
    rows = []
    for k, (u, v) in enumerate(_collect(patches)):
        level = (u.mean(1) / 8).astype(int)
        count = np.bincount(level) * (len(u) >= LEAST_PIXELS)
        for at in np.flatnonzero(count >= LEAST_PIXELS // 16):
            rows.append((k, np.median(u[level == at].mean(1)), np.median(v[level == at].mean(1))))
    return np.array(rows).reshape(-1, 3)


def _at(table: Array, codes: Array) -> Array:
    """Return columns of a table (256, n) at codes (m,), interpolated: (m, n)."""
    return np.stack([np.interp(codes, np.arange(256), column) for column in table.T], 1)


def _steps(levels: Array, curve: Array, count: int) -> tuple[float, ...]:
    """Return the ratio of each picture's exposure to the one before; NaN if too few pixels are well exposed."""
    pair, low, high = levels[:, 0], *(_at(curve, levels[:, k]).sum(1) for k in (1, 2))
    told = [np.log(high / low)[pair == k] for k in range(count)]
    return tuple(float(np.exp(np.median(ratio))) if len(ratio) else math.nan for ratio in told)


def _fit(levels: Array, steps: Array, shift: Array) -> tuple[Array, float, float]:
    """Fit a response to exposure steps, of which some change by an unknown amount.

    All channels share one curve: cameras apply the same curve to them, and white balance does not change ratios.

    Args:
        levels: Median codes (``_levels``).
        steps: Claimed ratio of each picture's exposure to the one before.
        shift: By how much the logarithm of each picture's exposure changes, per unit of the unknown.

    Returns:
        The curve, (256, 3), the unknown, and the mean error of a level's ratio, as a logarithm.
    """
    codes, knots = np.sqrt(np.arange(256) / 255.0), np.linspace(0.0, 1.0, HATS + 1)
    hats = np.stack([np.interp(codes, knots, hat) for hat in np.eye(HATS + 1)[:HATS]], 1)
    pair, table = levels[:, 0].astype(int), np.column_stack([hats, _LOG_SRGB])
    grown = _at(table, levels[:, 2]) - _at(table, levels[:, 1])
    design = np.column_stack([grown[:, :HATS], -np.diff(shift)[pair]])
    wanted = np.log(steps)[pair] - grown[:, HATS]
    bend = np.diff(np.eye(HATS + 1), 2, axis=0)
    bend[:, HATS] = 0.0
    prior = 0.3 * bend.T @ bend + np.diag([*[1e-3] * HATS, 1e-9])
    weight, values = np.ones(len(levels)), np.zeros(HATS + 1)
    for _ in range(12):
        values = np.linalg.solve(design.T @ (weight[:, None] * design) + prior, design.T @ (weight * wanted))
        error = design @ values - wanted
        weight = 1.0 / (1.0 + (error / 0.15) ** 2)
    curve = np.maximum.accumulate(np.exp(_LOG_SRGB + hats @ values[:HATS]) * (codes > 0.0))
    return np.repeat(curve[:, None] / curve[-1], 3, 1), float(values[HATS]), float(np.abs(error).mean())


def _corrections(levels: Array, steps: Array) -> list[Array]:
    """Return corrections to the logarithms of the pictures' exposures, the best first.

    Each corrects one picture or all after a step, and makes the response of a camera explain all levels; empty if none
    does, or if no correction is needed.
    """
    count = len(steps) + 1
    ways = [*np.eye(count), *(1.0 * (np.arange(count) >= k) for k in range(2, count - 1))]
    _, _, whole = _fit(levels, steps, np.zeros(count))
    fits = [(*_fit(levels, steps, way), way) for way in ways]
    fits = sorted((fit for fit in fits if GAMMAS[0] <= _gamma(fit[0]) <= GAMMAS[1]), key=lambda fit: fit[2])
    if not fits or whole < UNEVEN or fits[0][2] > EXPLAINS * whole or abs(fits[0][1]) < CONTRADICTS:
        return []
    return [change * way for _, change, error, way in fits if error < 2.0 * fits[0][2]]


def _gamma(curve: Array) -> float:
    """Return a response's gamma in the darks, at code 40."""
    return math.log(max(curve[40, 1], 1e-9)) / math.log(40 / 255)


def find_soft(patches: Sequence[Image]) -> list[int]:
    """Return the indices of pictures whose gradients are weaker than those of both neighbours, relative to the light.

    Noise and rounding make gradients grow from each exposure to the next, so a picture is compared with both sides.
    """
    disc, sharper = _disc(len(patches[0])), []
    light = [_LOG_SRGB[cv2.cvtColor(patch, cv2.COLOR_RGB2GRAY)] for patch in patches]
    bounds = _LOG_SRGB[[DARKEST, BRIGHTEST]]
    for pair in itertools.pairwise(cv2.GaussianBlur(picture, (0, 0), 1.0) for picture in light):
        well = np.all([(picture > bounds[0]) & (picture < bounds[1]) for picture in pair], 0) & disc
        well = cv2.erode(well.astype(np.uint8), np.ones((5, 5))) > 0
        energy = [sum((cv2.Sobel(one, -1, *way)[well] ** 2).sum() for way in ((1, 0), (0, 1))) for one in pair]
        sharper.append(math.sqrt(energy[0] / energy[1]) if well.sum() >= LEAST_PIXELS else math.nan)
    return [k + 1 for k, (before, after) in enumerate(itertools.pairwise(sharper)) if before > SOFT * after]


@dataclasses.dataclass(frozen=True)
class Exposures:
    """Exposures of a bracket after comparison of all statements."""

    ratios: tuple[float, ...]
    """Ratio of each picture's exposure to the first's."""
    curve: Array | None
    """Linear value of each code, (256, 3), if sRGB does not fit; else None."""
    notes: tuple[str, ...]
    """Notes for users, one line each."""


def _off(claimed: Sequence[float] | Array, seen: Sequence[float]) -> float:
    """Return the largest logarithm of the ratio between claimed and measured steps."""
    return max((abs(math.log(c / s)) for c, s in zip(claimed, seen, strict=True) if math.isfinite(s)), default=0.0)


def _reading(correction: Array, best: str, labels: Sequence[str]) -> str:
    """Return a correction in words."""
    which = np.flatnonzero(correction)
    gives = f"{best} give{'s' * (best == 'EXIF')}"
    times = f"{math.exp(-correction[which[0]]):.3g}"
    if len(which) == 1:
        return f"{labels[which[0]]}: {gives} it {times} times the exposure that pixels tell"
    between = f"{labels[which[0] - 1]} and {labels[which[0]]}"
    return f"is a photograph missing between {between}? {gives} the second {times} times the exposure that pixels tell"


def _believed(steps: dict[str, tuple[float, ...]], seen: Sequence[float], figures: str) -> tuple[str, list[str]]:
    """Return the name of the claim that the pixels confirm, and notes on it.

    Raises:
        UsageError: EXIF and names contradict each other, and the pixels confirm neither.
    """
    if len(steps) < 2 or _off(steps["EXIF"], steps["names"]) <= HOLDS:
        return next(iter(steps)), []
    best = min(steps, key=lambda name: _off(steps[name], seen))
    if _off(steps[best], seen) > 2.0 * HOLDS:
        raise UsageError(
            f"exposures contradict each other: from the longest to the shortest {figures} times; "
            "give the true ones with --exposures, take what the pixels say (--exposures pixels), or leave out pictures "
            "with automatic ISO"
        )
    return best, [f"{best} and pixels agree on the exposures, which the others contradict: {figures} times"]


def agree_exposures(
    patches: Sequence[Image],
    transfer: str,
    claims: Mapping[str, Sequence[float]],
    labels: Sequence[str] = (),
    known: bool = False,
) -> Exposures:
    """Determine the exposures of a bracket.

    Args:
        patches: Aligned pictures, longest exposure first.
        transfer: Response to try first.
        claims: Exposure of each by ``EXIF`` and ``names``, as far as known, or by ``--exposures``.
        labels: Names of the pictures.
        known: True if ``transfer`` is certain, so that no response is estimated.

    Raises:
        UsageError: EXIF, names and pixels contradict each other; the message has all figures.
    """
    labels = labels or [f"picture {k + 1}" for k in range(len(patches))]
    levels, tried = _levels(patches), decode_table(transfer).astype(float)
    seen = _steps(levels, tried, len(patches) - 1)
    steps = {name: tuple(b / a for a, b in itertools.pairwise(claim)) for name, claim in claims.items()}
    figures = ", ".join(f"{name} say{'s' * (name == 'EXIF')} {1.0 / math.prod(s):.3g}" for name, s in steps.items())
    pixels = [s for s in seen if math.isfinite(s)]
    figures += f"{', ' * bool(figures)}pixels say {1.0 / math.prod(pixels):.3g}" + " over the steps that they tell" * (
        len(pixels) < len(seen)
    )
    if not steps:
        if len(pixels) < len(seen):
            raise UsageError(
                "neither EXIF nor names give the exposures, and too few pixels can be compared; give --exposures"
            )
        note = f"exposures are from the pixels alone, with the response {transfer}: {figures} times"
        return Exposures(tuple(np.cumprod([1.0, *seen]).tolist()), None, (note,))
    best, notes = _believed(steps, seen, figures)
    claim, doubts = np.array(steps[best]), []
    if _off(claim, seen) > HOLDS:
        found = _corrections(levels, claim)
        readings = [_reading(correction, best, labels) for correction in found]
        corrected = [claim * np.exp(np.diff(correction)) for correction in found]
        sure = [k for k, steps_ in enumerate(corrected) if _off(steps_, seen) <= HOLDS]
        sure = sure or [0] * (len(found) == 1 and not known)
        if sure:
            claim, one = corrected[sure[0]], readings.pop(sure[0])
            agree = "and all others agree: the pixels are believed"
            if readings:
                agree = f"or else {'; or '.join(readings)}: the times disagree, and the first is taken to be wrong"
            notes.append(f"{one}, {agree}")
        elif found:
            doubts.append(f"a time contradicts the others ({'; or '.join(readings)})")
    ratios, off = tuple(np.cumprod([1.0, *claim]).tolist()), _off(claim, seen)
    if off <= HOLDS:
        return Exposures(ratios, None, tuple(notes))
    curve, _, _ = _fit(levels, claim, np.zeros(len(patches)))
    bent = _steps(levels, curve, len(claim))
    worst = int(np.nanargmax(np.abs(np.log(claim / bent))))
    rest = abs(math.log(claim[worst] / bent[worst]))
    if known or rest > CONTRADICTS:
        raise UsageError(
            f"exposures contradict the pictures: from the longest to the shortest {figures} times, and no response "
            f"explains them ({labels[worst]} to {labels[worst + 1]} is off by {math.expm1(rest):.0%}); give the true "
            "ones with --exposures, or take what the pixels say (--exposures pixels)"
        )
    notes.append(
        f"the response is not {transfer} (off by {math.exp(off):.2f} in one step, "
        f"{tried[40, 1] / max(curve[40, 1], 1e-9):.3g} times at code 40): it was estimated from the bracket"
    )
    needed = np.flatnonzero(np.abs(np.log(claim / seen)) > HOLDS)
    if len(needed) == 1:
        doubts.append(f"only the step from {labels[needed[0]]} to {labels[needed[0] + 1]} needs this response")
    elif len(claim) == 2:
        doubts.append("three photographs do not tell a response from a wrong time")
    gamma = _gamma(curve)
    if not GAMMAS[0] <= gamma <= GAMMAS[1]:
        least, most = GAMMAS
        doubts.append(f"no known camera has this response: gamma {gamma:.1f} in the darks, not {least} to {most}")
    if doubts:
        otherwise = f"if a time is wrong instead, {transfer} holds, and --exposures pixels is right ({figures} times)"
        notes.append(f"{'; '.join(doubts)}; {otherwise}")
    return Exposures(ratios, curve, tuple(notes))


def thin_exposures(
    ratios: Sequence[float], shown: int, names: Sequence[str]
) -> tuple[tuple[int, ...], tuple[str, ...]]:
    """Return the pictures of a bracket to use: one of each group within the ratio ``WAVERING``.

    Args:
        ratios: Exposures.
        shown: Index of the exposure that is always kept.
        names: Names of the pictures.

    Returns:
        Indices, longest exposure first, and a note for each that is left out.
    """
    kept, notes = [shown], []
    for k in sorted(set(range(len(ratios))) - {shown}, key=lambda k: -ratios[k]):
        apart = {other: math.exp(abs(math.log(ratios[k] / ratios[other]))) for other in kept}
        near = min(apart, key=lambda other: apart[other])
        if apart[near] < WAVERING:
            notes.append(f"{names[k]} is left out: its exposure and that of {names[near]} are {apart[near]:.2f} apart")
        else:
            kept.append(k)
    return tuple(sorted(kept, key=lambda k: -ratios[k])), tuple(notes)
