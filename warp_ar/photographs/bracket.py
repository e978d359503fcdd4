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

over pixel pairs (u, v) [DM97]. A curve can absorb any single ratio, but not contradictions, because equal codes mean
equal radiance under every response. The remaining error of each step shows if the exposures are right.

References:
    [DM97] P. Debevec and J. Malik. Recovering high dynamic range radiance maps from photographs. SIGGRAPH 1997.
    [Mann00] S. Mann. Comparametric equations with practical applications in quantigraphic image processing. 2000.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence

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
HOLDS = 0.12
"""Largest difference, as a logarithm, between an exposure step and the pixels' ratio."""
CONTRADICTS = 0.3
"""Largest such difference if a response is estimated with it; above it, no response explains the exposures."""
FAR = 40.0
"""Ratio of exposures above which two pictures share no usable pixels."""
FEATURELESS = 6.0
"""Standard deviation of codes below which a picture is featureless."""
MOVED = 0.75
"""Correlation over well exposed pixels below which a picture shows another scene."""
RELIT = 0.1
"""Logarithm by which places of formerly equal brightness may differ: 0.03 under the same light."""
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
    correlation: tuple[float, ...]
    """Correlation of each photograph with the one that it was aligned to; 1 for the anchor, NaN if too few pixels are
    well exposed in both."""
    changed: tuple[float, ...]
    """Logarithm of the factor between formerly equal places, for each photograph and the one it was aligned to; NaN if
    too few pixels are well exposed in both."""

    @property
    def strangers(self) -> tuple[str, ...]:
        """Return the reason to leave out each picture; empty if there is none."""
        return tuple(map(_stranger, self.correlation, self.changed))


def _stranger(alike: float, changed: float) -> str:
    if alike < MOVED and not changed <= RELIT:
        return f"it shows something else ({alike:.0%} alike)"
    return f"its light differs, by {math.expm1(changed):.0%} from place to place" if changed > RELIT else ""


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


def register(reference: Image, other: Image, disc: NDArray[np.bool_]) -> tuple[Array, float]:
    """Return the shift and scale that align a picture with another one of another exposure.

    Args:
        reference: uint8 RGB (n, n, 3).
        other: The same size.
        disc: Mask of pixels that are used.

    Returns:
        (columns, rows, log of the scale about the centre) at which ``other`` must be sampled, and the correlation
        afterwards; NaN if fewer than ``LEAST_PIXELS`` can be used.
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

    def alike(move: Array) -> float:
        """Return the correlation; pixels that are dark or clipped in one picture are included."""
        seen, _ = look(second, move)
        told = disc & ~((first <= DARKEST) & (seen <= DARKEST)) & ~((first >= BRIGHTEST) & (seen >= BRIGHTEST))
        if told.sum() < LEAST_PIXELS:
            return math.nan
        wanted = np.interp(first[told], np.arange(256), _tone_curve(first[told], seen[told]))
        if np.ptp(wanted) == 0.0:
            # Both pictures are featureless, or one has much that the other lacks.
            return math.nan if np.std(seen[told]) < FEATURELESS else 0.0
        return float(np.corrcoef(wanted, seen[told])[0, 1])

    move = np.zeros(3)
    for coarse in (4.0, 2.0, 0.0, 0.0):
        a, b = (cv2.GaussianBlur(p, (0, 0), coarse) if coarse else p for p in (first, second))
        for _ in range(8):
            seen, ok = look(b, move)
            if ok.sum() < LEAST_PIXELS:
                return np.zeros(3), alike(np.zeros(3))
            wanted = np.asarray(np.interp(a, np.arange(256), _tone_curve(a[ok], seen[ok])), np.float32)
            step = _gauss_newton(seen, wanted, ok, x, y)
            move += np.clip(step, -0.02 * n, 0.02 * n)
            move[2] = float(np.clip(move[2], -0.1, 0.1))
            if np.abs(step[:2]).max() < 0.01:
                break
    return move, alike(move)


def align(
    images: Sequence[Image], circles: Sequence[Circle], exposures: Sequence[float] | None = None, anchor: int = 0
) -> Aligned:
    """Align pictures of one ball with the anchor.

    A picture of another scene, or with too few common pixels, is aligned with the nearest successfully aligned
    exposure, so that a wrong picture affects no other.

    Args:
        images: uint8 RGB, in order of exposure.
        circles: Approximate circle of the ball in each; exact for the anchor.
        exposures: Exposure of each, if known; pictures with a ratio above ``FAR`` cannot be aligned with each other.
        anchor: Index of the picture with which the others are aligned.
    """
    size = int(min(PATCH, max(48, 2.1 * circles[anchor][2])))
    disc = _disc(size)
    times = exposures or [1.0] * len(images)
    found = list(circles)
    patches = [cut_ball(image, circle, size) for image, circle in zip(images, circles, strict=True)]
    correlation, changed = [math.nan] * len(images), [math.nan] * len(images)
    correlation[anchor], good = 1.0, [anchor]
    for k in sorted(set(range(len(images))) - {anchor}, key=lambda k: abs(k - anchor)):
        (x, y, radius), rough = circles[k], patches[k]
        for base in (anchor, *sorted(good[1:], key=lambda other: abs(k - other))):
            if abs(math.log(times[k] / times[base])) > math.log(FAR):
                continue
            move, told = register(patches[base], rough, disc)
            if math.isnan(told) or told < correlation[k]:
                continue
            pixel = 2.1 * radius / size
            found[k] = x + pixel * move[0], y + pixel * move[1], radius * math.exp(move[2])
            patches[k] = cut_ball(images[k], found[k], size)
            correlation[k], changed[k] = told, _change(patches[base], patches[k])
            if not _stranger(told, changed[k]):
                good.append(k)
                break
    return Aligned(tuple(found), tuple(patches), tuple(correlation), tuple(changed))


def _disc(size: int) -> NDArray[np.bool_]:
    """Return the mask of a ball's pixels in its square, without the rim."""
    rows, columns = np.mgrid[:size, :size] - (size - 1) / 2
    return np.asarray(np.hypot(rows, columns) < 0.93 * size / 2.1)


def _change(first: Image, other: Image) -> float:
    """Return the logarithm by which equally bright places of one picture differ in the other.

    The tone curve cancels out. Light from another direction does not.
    """
    (u, v), *_ = _collect((first, other))
    if len(u) < LEAST_PIXELS:
        return math.nan
    level = (u.mean(1) / 8).astype(int)
    ratio = (_LOG_SRGB[v.astype(int)] - _LOG_SRGB[u.astype(int)]).mean(1)
    middle = np.array([np.median(ratio[level == k]) if (level == k).any() else 0.0 for k in range(32)])
    return 1.4826 * float(np.median(np.abs(ratio - middle[level])))


@dataclasses.dataclass(frozen=True)
class Ratios:
    """Ratios of neighbouring exposures, measured by pixels."""

    pairs: tuple[tuple[Array, Array], ...]
    """Codes (m, 3) well exposed in both pictures of each neighbouring pair."""
    curve: Array
    """Linear value of each code, (256, 3)."""
    steps: tuple[float, ...]
    """Ratio of each picture's exposure to the one before, by the pixels; NaN if too few are well exposed."""


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


def _steps(pairs: Sequence[tuple[Array, Array]], curve: Array) -> tuple[float, ...]:
    steps = []
    for u, v in pairs:
        if len(u) < LEAST_PIXELS:
            steps.append(math.nan)
            continue
        low, high = (np.stack([np.interp(c[:, i], np.arange(256), curve[:, i]) for i in range(3)], 1) for c in (u, v))
        ratio = np.log(high.sum(1) / low.sum(1))
        # Every brightness level has the same weight, independent of its number of pixels.
        bins = (u.mean(1) / 16).astype(int)
        medians = [np.median(ratio[bins == k]) for k in range(16) if (bins == k).sum() >= LEAST_PIXELS // 16]
        steps.append(float(np.exp(np.median(medians))))
    return tuple(steps)


def measure_ratios(patches: Sequence[Image], curve: Array) -> Ratios:
    """Measure ratios of neighbouring exposures under a response, in aligned pictures."""
    pairs = _collect(patches)
    return Ratios(pairs, curve, _steps(pairs, curve))


def estimate_response(ratios: Ratios, steps: Sequence[float]) -> Ratios:
    """Estimate the response that fits given exposure steps best, and return the pixels' ratios under it.

    All channels share one curve: cameras apply the same curve to them, and white balance does not change ratios.
    """
    knots = np.linspace(0.0, 1.0, HATS + 1)
    codes = np.sqrt(np.arange(256) / 255.0)
    hats = np.stack([np.interp(codes, knots, np.eye(HATS + 1)[j]) for j in range(HATS)], 1)
    base = np.log(np.maximum(decode_table("srgb")[:, 1].astype(float), 1e-5))
    rows, wanted, share = [], [], []
    for (u, v), step in zip(ratios.pairs, steps, strict=True):
        if len(u) < LEAST_PIXELS:
            continue
        u, v = u.mean(1), v.mean(1)
        at_u, at_v = (np.stack([np.interp(c, np.arange(256), hats[:, j]) for j in range(HATS)], 1) for c in (u, v))
        rows.append(at_v - at_u)
        wanted.append(math.log(step) - (np.interp(v, np.arange(256), base) - np.interp(u, np.arange(256), base)))
        # Every brightness level has the same weight, independent of its number of pixels.
        bins = (u / 16).astype(int)
        share.append(1.0 / np.bincount(bins, minlength=16)[bins])
    if not rows:
        return ratios
    a, b, w = np.concatenate(rows), np.concatenate(wanted), np.concatenate(share)
    bend = np.diff(np.eye(HATS + 1), 2, axis=0)[:, :HATS]
    prior = 0.3 * bend.T @ bend + 1e-3 * np.eye(HATS)
    weight, values = w, np.zeros(HATS)
    for _ in range(12):
        values = np.linalg.solve(a.T @ (weight[:, None] * a) + prior, a.T @ (weight * b))
        error = a @ values - b
        weight = w / (1.0 + (error / 0.15) ** 2)
    table = np.exp(base + hats @ values)
    table[0] = 0.0
    table = np.maximum.accumulate(table)
    curve = np.repeat((table / table[-1])[:, None], 3, 1)
    return Ratios(ratios.pairs, curve, _steps(ratios.pairs, curve))


@dataclasses.dataclass(frozen=True)
class Exposures:
    """Exposures of a bracket after comparison of all statements."""

    ratios: tuple[float, ...]
    """Ratio of each picture's exposure to the first's."""
    curve: Array | None
    """Linear value of each code, (256, 3), if sRGB does not fit; else None."""
    notes: tuple[str, ...]
    """Notes for users, one line each."""


def _off(claimed: Sequence[float], seen: Sequence[float]) -> float:
    """Return the largest logarithm of the ratio between claimed and measured steps."""
    return max((abs(math.log(c / s)) for c, s in zip(claimed, seen, strict=True) if math.isfinite(s)), default=0.0)


def _wrong_one(claim: Sequence[float], seen: Sequence[float]) -> tuple[int, float] | None:
    """Return the index of the only picture with a wrong claim, and its error.

    None unless the pixels confirm all others.
    """
    off = [math.log(c / s) if math.isfinite(s) else 0.0 for c, s in zip(claim, seen, strict=True)]
    if len(off) < 3 or max(map(abs, off)) < CONTRADICTS:
        return None
    total = np.cumsum([0.0, *off])
    wrong = [k for k in range(len(total)) if np.abs(np.diff(np.delete(total, k))).max() <= HOLDS]
    if len(wrong) != 1:
        return None
    return wrong[0], math.exp(total[wrong[0]] - total[wrong[0] - 1 if wrong[0] else 1])


def _total(steps: Sequence[float]) -> float:
    return 1.0 / math.prod(steps)


def _number(value: float) -> str:
    return f"{value:.3g}"


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
    exif: Sequence[float] | None,
    names: Sequence[float] | None,
    given: Sequence[float] | None = None,
    labels: Sequence[str] = (),
    known: bool = False,
) -> Exposures:
    """Determine the exposures of a bracket.

    Args:
        patches: Aligned pictures, longest exposure first.
        transfer: Response to try first.
        exif: Exposure of each by its EXIF; None if unknown.
        names: Exposure of each by its file name; None if unknown.
        given: Exposure of each given by the user, which takes precedence.
        labels: Names of the pictures.
        known: True if ``transfer`` is certain, so that no response is estimated.

    Raises:
        UsageError: EXIF, names and pixels contradict each other; the message has all figures.
    """
    seen = measure_ratios(patches, decode_table(transfer).astype(float))
    steps = {
        name: tuple(b / a for a, b in itertools.pairwise(claim))
        for name, claim in (("--exposures", given), ("EXIF", exif), ("names", names))
        if claim is not None
    }
    if given is not None:
        steps = {"--exposures": steps["--exposures"]}
    figures = ", ".join(f"{name} say{'s' * (name == 'EXIF')} {_number(_total(s))}" for name, s in steps.items())
    pixels = [s for s in seen.steps if math.isfinite(s)]
    figures += f"{', ' * bool(figures)}pixels say {_number(_total(pixels))}" + " over the steps that they tell" * (
        len(pixels) < len(seen.steps)
    )
    if not steps:
        if len(pixels) < len(seen.steps):
            raise UsageError(
                "neither EXIF nor names give the exposures, and too few pixels can be compared; give --exposures"
            )
        note = f"exposures are from the pixels alone, with the response {transfer}: {figures} times"
        return Exposures(tuple(np.cumprod([1.0, *seen.steps]).tolist()), None, (note,))
    best, notes = _believed(steps, seen.steps, figures)
    claim = steps[best]
    ratios = tuple(np.cumprod([1.0, *claim]).tolist())
    off = _off(claim, seen.steps)
    wrong = _wrong_one(claim, seen.steps)
    if wrong is not None:
        which, times = wrong
        notes.append(
            f"{labels[which] if labels else f'picture {which + 1}'}: {best} give{'s' * (best == 'EXIF')} it "
            f"{_number(times)} times the exposure that pixels tell, and all others agree: the pixels are believed"
        )
        ratios = tuple(ratio / times if k == which else ratio for k, ratio in enumerate(ratios))
        return Exposures(tuple(ratio / ratios[0] for ratio in ratios), None, tuple(notes))
    if off <= HOLDS:
        return Exposures(ratios, None, tuple(notes))
    bent = seen if known else estimate_response(seen, claim)
    rest = _off(claim, bent.steps)
    if known or rest > CONTRADICTS:
        raise UsageError(
            f"exposures contradict the pictures: from the longest to the shortest {figures} times, and no response "
            f"explains them (a step is off by {math.expm1(rest):.0%}); give the true ones with --exposures, or "
            "take what the pixels say (--exposures pixels)"
        )
    dark = decode_table(transfer)[:, 1][40] / max(bent.curve[40, 1], 1e-9)
    notes.append(
        f"the response is not {transfer} (off by {math.exp(off):.2f} in one step, {_number(float(dark))} times at code "
        "40): it was estimated from the bracket"
    )
    gamma = math.log(bent.curve[40, 1]) / math.log(40 / 255)
    if not GAMMAS[0] <= gamma <= GAMMAS[1]:
        notes.append(
            f"no known camera has this response: gamma {gamma:.1f} in the darks, not {GAMMAS[0]} to {GAMMAS[1]}; "
            f"if a time is wrong instead, {transfer} holds, and --exposures pixels is right ({figures} times)"
        )
    return Exposures(ratios, bent.curve, tuple(notes))


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
    for k in sorted(range(len(ratios)), key=lambda k: -ratios[k]):
        near = [other for other in kept if abs(math.log(ratios[k] / ratios[other])) < math.log(WAVERING)]
        if k != shown and near:
            ratio = max(ratios[k] / ratios[near[0]], ratios[near[0]] / ratios[k])
            notes.append(f"{names[k]} is left out: its exposure and that of {names[near[0]]} are {ratio:.2f} apart")
        elif k != shown:
            kept.append(k)
    return tuple(sorted(kept, key=lambda k: -ratios[k])), tuple(notes)
