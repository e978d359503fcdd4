"""Checks of a scene's card, camera and light in its frames, by the visible marker."""

from __future__ import annotations

import collections
import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from warp_ar.calibration.board_finder import KNOWN, find_markers, recognise_board
from warp_ar.calibration.saturation import NEAR_FULL, SaturationLevels, ball_discs
from warp_ar.checks.finding import Finding
from warp_ar.kernels.color import decode_table
from warp_ar.scene import Camera, Marker, Pose, Scene
from warp_ar.scene.pixel_rays import project
from warp_ar.sources.source import Source
from warp_ar.tracking.markers import Detection, MarkerDetector, find_dictionary, pattern_of
from warp_ar.tracking.tracking import Tracker, TrackState

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

RARE: Final = 0.6
"""Share of frames that show the marker, below which there are too few."""
CELL_PIXELS: Final = 3.0
"""Smallest side in pixels of a marker's cells (its black and white squares) that are read reliably."""
WORST_EDGES: Final = 1.0
"""Largest root mean square distance in pixels between a print's edges in the picture and their places under the pose.
Correct settings of lens and board give 0.1 to 0.4."""
CLIPPED: Final = 250
"""8-bit code from which white paper counts as clipped."""
CLIPPED_SHARE: Final = 0.25
"""Largest share of clipped white cells."""
DARK: Final = 0.04
"""Linear value of white paper below which it is too dark, so that noise affects the whole picture."""
CONTRAST: Final = 0.5
"""Linear ratio of black ink to white paper above which there is haze, gloss, or another transfer function."""
STEEPEST: Final = 33.0
"""Largest linear ratio of white paper to black ink of a print on plain paper. Laser prints have 20 to 30, which is
measured within a tenth (the print of the bundled clips has 21, measured as 19 to 23 with correct settings). An S-shaped
tone curve raises the measured ratio to 35 to 43 with half of smoothstep, and to 84 to 103 with all of it."""
SHADOW: Final = 0.45
"""Difference between the 85th and the 15th percentile of the logarithm of white cells' radiance, without its linear
gradient across the card, above which there is a shadow."""
SHARP: Final = 0.14
"""Contrast per pixel of the sharpest edges, relative to the picture's contrast, below which the picture is blurred. It
is 0.4 in focus, and 0.08 to 0.13 with 4 pixels of blur."""
DRIFT: Final = 0.12
"""Largest difference between frames of the logarithm of exposure."""
TINT: Final = 0.06
"""Largest change between frames of the logarithm of red or blue relative to green."""
FOCAL: Final = 0.02
"""Relative difference between the focal length that the card's perspective gives and the camera's, beyond which they
contradict. With correct settings it is up to 0.015."""
FOCAL_VIEWS: Final = 10
"""Largest number of frames in which the focal length is measured."""
BOARD_VIEWS: Final = 4
"""Largest number of frames in which a board is searched although a single marker is expected. One frame is not enough,
because a hand or the border may hide parts of the board."""
BOARD_MARKERS: Final = 5
"""Smallest number of the dictionary's markers in a picture for a search for a board."""
LEAST_END: Final = 220
"""Smallest saturation code (code of clipped light) for a finding. No camera's range ends lower: limited range ends at
235, tone curves with a shoulder end above. Pictures that were darkened afterwards may end lower."""
ALIKE_ENDS: Final = 2.0
"""Largest difference between the saturation codes of the channels. A range or a shoulder is common to all channels; a
tint added to pictures later is not. At least two channels must saturate below the highest code. The third may not clip
at all, for example blue under warm lamps."""
LIMITED: Final = (14, 236)
"""Smallest lowest code and largest saturation code of pictures of limited range (16 to 235) that were taken for full
range, with a margin for a codec's errors."""
FEW: Final = 1e-3
"""Largest share of pixels beyond the lowest or highest code, caused by noise and a codec's ringing."""


@dataclasses.dataclass(frozen=True)
class Look:
    """Frames of a scene, with the camera's poses found by the marker."""

    camera: Camera
    """Camera at the frames' size."""
    images: tuple[Image, ...]
    """All frames, RGB."""
    views: tuple[tuple[Image, Pose], ...]
    """Frames with a visible marker, with ``camera_from_world``."""
    errors: tuple[float, ...]
    """Root mean square distance in pixels of the print's edges from their places under the pose, for each view."""
    table: NDArray[np.float32]
    """Linear value of each 8-bit code, (256, 3)."""


def take_look(
    scene: Scene, source: Source, frames: int, every: int = 1, tell: Callable[[str], object] | None = None
) -> Look:
    """Read some of a source's first frames and track the marker; of alternating exposures, only the longest is used.

    Args:
        scene: Scene with the marker and the camera.
        source: Source of the frames.
        frames: Number of frames to read.
        every: Stride of the frames that are used; 1 uses every frame.
        tell: Function to which a progress text for users is passed.

    Raises:
        SceneError: The camera was calibrated for another aspect ratio.
        SourceError: The source fails.
    """
    shown = (
        frame for frame in itertools.islice(source, frames) if frame.exposure_time in (None, *source.exposures[:1])
    )
    camera = scene.camera.scaled_to(*source.size)
    count = min(frames, source.length or frames)

    def some() -> Iterator[tuple[Image, float]]:
        for frame in itertools.islice(shown, 0, None, every):
            if tell is not None:
                tell(f"looking at frame {frame.index + 1} of {count}")
            yield frame.image, frame.time

    return look_at(scene.marker, camera, some())


def look_at(marker: Marker, camera: Camera, frames: Iterable[tuple[Image, float]]) -> Look:
    """Track the marker in frames.

    Args:
        marker: The printed card.
        camera: Camera of the frames.
        frames: 8-bit RGB of the camera's size, each with its time in seconds.
    """
    tracker = Tracker(marker, camera, steady=False)
    images, views, errors = [], [], []
    for image, seconds in frames:
        images.append(image)
        track = tracker.track(image, seconds)
        if track.state is TrackState.TRACKED and track.pose is not None:
            views.append((image, track.pose))
            errors.append(track.reprojection_error)
    return Look(camera, tuple(images), tuple(views), tuple(errors), decode_table(camera.transfer))


def check_pictures(scene: Scene, look: Look) -> list[Finding]:
    """Return the findings on card and camera."""
    if not look.images:
        return [Finding("source.empty", "the source has no frames", "check [source]")]
    if not look.views:
        return [why_unseen(scene.marker, look)]
    # A board's marker that is taken for a single one gives a wrong scale, which would cause all other findings.
    views = [image for image, _ in look.views]
    if (board := board_instead(scene.marker, views[:: -(-len(views) // BOARD_VIEWS)])) is not None:
        return [board]
    if (twice := _marker_twice(scene.marker, views)) is not None:
        return [twice]
    return list(_check_card(scene.marker, look))


def _check_card(marker: Marker, look: Look) -> Iterator[Finding]:
    """Yield findings on the marker, and on the camera and the light as measured on it."""
    share = len(look.views) / len(look.images)
    if share < RARE:
        text = f"the marker is seen in {share:.0%} of {len(look.images)} frames"
        yield Finding("marker.rare", text, "keep the whole card in the picture, flat, lit and unhidden")
    side = float(np.median([_marker_side(marker, look.camera, pose) for _, pose in look.views]))
    least = CELL_PIXELS * (int(find_dictionary(marker.dictionary).markerSize) + 2)
    if side < least:
        text = f"a marker is {side:.0f} pixels wide; expected {least:.0f} or more"
        yield Finding("marker.small", text, "move the camera nearer, or print a larger card")
    worst = float(np.median(look.errors))
    if worst > WORST_EDGES:
        text = f"the print's edges are {worst:.1f} pixels from their places by the camera's numbers"
        remedy = "lay the card flat, check [marker], and run python -m warp_ar.calibrate camera PICTURES"
        yield Finding("camera.edges", text, remedy)
    yield from _check_focal(marker, look)
    few = look.views[:: max(1, len(look.views) // 6)]
    yield from _check_light(marker, look, few)
    yield from _check_blur(marker, look, few)


def _marker_twice(marker: Marker, images: Sequence[Image]) -> Finding | None:
    """Return the finding that the first and the last picture show a marker of the scene twice; None if not."""
    own = set(pattern_of(marker).markers)
    detector = MarkerDetector(marker.dictionary)
    for image in (images[0], images[-1]):
        counts = collections.Counter(each.id for each in detector.detect(_gray(image)) if each.id in own)
        if not counts or counts.most_common(1)[0][1] < 2:
            return None
    wanted = f"{marker.dictionary} {marker.board or f'id {marker.id}'}"
    text = f"{wanted} is in the picture twice, so that tracking may confuse them"
    return Finding("marker.twice", text, "cover or remove one of them")


def _marker_side(marker: Marker, camera: Camera, pose: Pose) -> float:
    """Return the side in pixels of a marker, or the median side of a board's markers."""
    quads = [project(camera, pose.apply(corners)) for corners in pattern_of(marker).markers.values()]
    return float(np.median([np.linalg.norm(quad - np.roll(quad, 1, 0), axis=1).mean() for quad in quads]))


def why_unseen(marker: Marker, look: Look) -> Finding:
    """Return the finding on a marker that no frame shows, with the likely cause, such as another marker."""
    image = look.images[len(look.images) // 2]
    wanted = f"{marker.dictionary} {marker.board or f'id {marker.id}'}"
    ids = set(pattern_of(marker).markers)
    mirrored = MarkerDetector(marker.dictionary).detect(np.ascontiguousarray(_gray(image)[:, ::-1]))
    if ids & {d.id for d in mirrored}:
        text = "the picture is mirrored: the marker is seen in its mirror image only"
        return Finding("marker.mirrored", text, "turn the camera's mirroring off")
    level = float(look.table[image].mean())
    if level < 0.01:
        return Finding(
            "picture.dark", f"the picture is dark: {level:.1%} of clipping on average", "uncover the camera, add light"
        )
    if float((image >= CLIPPED).mean()) > 0.7:
        return Finding("picture.clipped", "the picture is overexposed: most of it clips", "set a shorter exposure")
    if _is_blurred(image):
        return Finding("picture.blurred", "the picture is blurred", "focus on the card, and keep the camera still")
    if (board := board_instead(marker, [image])) is not None:
        return board
    name, seen = find_markers(image)
    if marker.board is None and name == marker.dictionary and ids & {d.id for d in seen}:
        text = f"{wanted} is in the picture, but no camera with fx {look.camera.fx:.0f} pixels sees a square like that"
        return Finding("camera.focal", text, "python -m warp_ar.calibrate camera PICTURES")
    if seen:
        numbers = ", ".join(str(n) for n in sorted({d.id for d in seen})[:6])
        text = f"no {wanted} in {len(look.images)} frames; the picture shows {name} {numbers}"
        return Finding("marker.other", text, "print the card of [marker], or write the printed one into [marker]")
    whole = "the whole card with its white margin" if marker.board else "the whole black square with its white margin"
    text = f"no {wanted} in {len(look.images)} frames; {whole} must be in the picture"
    return Finding("marker.unseen", text, "show all of it, flat, sharp and lit; check [marker]")


def board_instead(marker: Marker, images: Sequence[Image]) -> Finding | None:
    """Return the finding that pictures show a board although the scene has a single marker of another size.

    Args:
        marker: The scene's marker.
        images: RGB pictures, uint8 (h, w, 3).

    Returns:
        The finding; None if the scene has a board, or no picture shows a board with the marker's number.
    """
    if marker.board is not None:
        return None
    detector = MarkerDetector(marker.dictionary)
    for image in images:
        # Detection with one dictionary takes milliseconds; recognition of a layout, which tries all, takes longer.
        if len(detector.detect(_gray(image))) < BOARD_MARKERS:
            continue
        seen = recognise_board(image)
        if seen is None or seen.board is None or marker.id >= seen.board.marker_count:
            continue
        known = seen in KNOWN
        what = "the printed card" if seen == KNOWN[0] else "a printed board"
        name = str(seen.board) if known else " ".join(str(seen.board).split()[:2])
        text = (
            f"{what} is in the picture ({seen.dictionary}, {name}), though the scene expects a single marker of "
            f"{1e3 * marker.size:g} mm, id {marker.id}: it is one of the board's, and all lengths would be wrong"
        )
        lengths = name if known else f"{name} SQUARE MARKER"
        remedy = f'write board = "{lengths}" into [marker] in place of id and size'
        more = "" if known else ", the lengths of a square and a marker in metres"
        return Finding("marker.board", text, f"{remedy}{more}; or take the board away and show the marker alone")
    return None


def _is_blurred(image: Image) -> bool:
    """Return True if no structure in a picture has a sharp edge."""
    gray = cv2.medianBlur(_gray(image), 3).astype(np.float32)
    low, high = np.percentile(gray, (1, 99))
    slope = np.hypot(cv2.Sobel(gray, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(gray, cv2.CV_32F, 0, 1, scale=1 / 8))
    return bool(high - low > 20 and np.percentile(slope, 99.9) < SHARP * (high - low))


def _gray(image: Image) -> Image:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)


@dataclasses.dataclass(frozen=True)
class FocalFit:
    """Focal length for which the print's edges fit best."""

    ratio: float
    """Ratio of the focal length to the camera's own."""
    deviation: float
    """Standard error of the ratio."""
    views: int
    """Number of frames used."""
    gain: float
    """Sum of squared residuals with the camera's focal length, divided by that with the best focal length."""


def measure_focal(marker: Marker, look: Look) -> FocalFit | None:
    """Return the focal length for which the print's edges fit best, with poses fitted again for each candidate.

    The sum of squared residuals as a function of the focal length is approximated by a parabola. The standard error is
    a jackknife estimate: the fit is repeated without each of the frames.

    Args:
        marker: The printed card.
        look: Frames with the marker.

    Returns:
        The fit; None if fewer than four frames can be used.
    """
    images = [image for image, _ in look.views[:: -(-len(look.views) // FOCAL_VIEWS) or 1]]
    if len(images) < 4:
        return None
    tracker = Tracker(marker, look.camera, steady=False)
    pictures = [(image, tracker.detect(image)) for image in images]
    # The minimum is located with few frames, and then measured with all of them.
    rough = np.exp(np.linspace(-0.3, 0.3, 9))
    few = [_squared_errors(marker, look.camera, pictures[:: -(-len(pictures) // 3)], factor).sum() for factor in rough]
    factors = rough[int(np.argmin(few))] * np.array([0.94, 0.97, 1.0, 1.03, 1.06])
    squares = np.array([_squared_errors(marker, look.camera, pictures, factor) for factor in factors])
    kept = np.isfinite(squares).all(0)
    if (count := int(kept.sum())) < 4:
        return None
    squares = squares[:, kept]
    best = _lowest(factors, squares.sum(1))
    left = np.array([_lowest(factors, squares.sum(1) - squares[:, k]) for k in range(count)])
    deviation = math.sqrt((count - 1) / count * float(((left - left.mean()) ** 2).sum()))
    as_given = _squared_errors(marker, look.camera, pictures, 1.0)[kept].sum()
    return FocalFit(best, deviation, count, float(as_given / max(squares.sum(1).min(), 1e-12)))


def _check_focal(marker: Marker, look: Look) -> Iterator[Finding]:
    fit = measure_focal(marker, look)
    # If all views are from one side, the minimum is too flat for a conclusion.
    if fit is None or abs(fit.ratio - 1) < max(FOCAL, 3 * fit.deviation) or fit.gain < 1.02:
        return
    given = look.camera.fx
    text = (
        f"[camera] fx = {given:.0f}: the card's perspective in {fit.views} views fits "
        f"{fit.ratio * given:.0f} +/- {2 * fit.deviation * given:.0f}"
    )
    yield Finding("camera.focal", text, "python -m warp_ar.calibrate camera PICTURES")


def _squared_errors(
    marker: Marker, camera: Camera, pictures: Sequence[tuple[Image, list[Detection]]], factor: float
) -> Array:
    """Return the mean squared distance in pixels of the print's edges from their places under a fitted pose, (n,).

    It is infinite for pictures in which no pose fits.

    Args:
        marker: The printed card.
        camera: Camera of the pictures.
        pictures: Pictures with the markers detected in them.
        factor: Factor on the camera's focal length.
    """
    tracker = Tracker(marker, dataclasses.replace(camera, fx=camera.fx * factor, fy=camera.fy * factor), steady=False)
    return np.array([tracker.error_of(image, found) ** 2 for image, found in pictures])


def _lowest(factors: Array, totals: Array) -> float:
    """Return the factor with the smallest total, from a parabola fitted to the totals; clamped to the tried range."""
    curve, slope, _ = np.polyfit(factors, totals, 2)
    lowest = -slope / (2 * curve) if curve > 0 else factors[np.argmin(totals)]
    return float(np.clip(lowest, factors[0], factors[-1]))


def _cell_values(marker: Marker, look: Look, image: Image, pose: Pose) -> tuple[Array, Array, Array]:
    """Return the marker's white cells in an image, positions and 8-bit RGB values, and the values of its black cells.

    Args:
        marker: The printed card.
        look: Frames of the same camera; only the camera is used.
        image: The image.
        pose: ``camera_from_world``.
    """
    cells, white = pattern_of(marker).cells, pattern_of(marker).white
    pixels = project(look.camera, pose.apply(cells))
    inside = ((pixels >= 1) & (pixels <= (look.camera.width - 2, look.camera.height - 2))).all(1)
    x, y = np.round(pixels[inside]).astype(int).T
    codes = image[y, x].astype(float)
    return cells[inside][white[inside]], codes[white[inside]], codes[~white[inside]]


def _check_light(marker: Marker, look: Look, views: Sequence[tuple[Image, Pose]]) -> Iterator[Finding]:
    """Yield findings on the card's paper (clipped, dark, in a shadow), its contrast and its drift over frames."""
    clipped, dark, ratios, uneven, whites = [], [], [], [], []
    for image, pose in views:
        places, white, black = _cell_values(marker, look, image, pose)
        if len(white) < 6 or len(black) < 6:
            continue
        linear = np.stack([look.table[white[:, k].astype(int), k] for k in range(3)], -1)
        ink = np.stack([look.table[black[:, k].astype(int), k] for k in range(3)], -1)
        clipped.append(float((white.max(1) >= CLIPPED).mean()))
        level = float(np.median(linear.mean(1)))
        dark.append(level)
        ratios.append(float(np.median(ink.mean(1))) / max(level, 1e-6))
        whites.append(np.median(linear, axis=0))
        log = np.log(np.maximum(linear.mean(1), 1e-4))
        design = np.column_stack([np.ones(len(places)), places[:, :2]])
        rest = log - design @ np.linalg.lstsq(design, log, rcond=None)[0]
        # A shadow darkens many of the cells. Cells that are dark by noise of the print or blurred edges are few.
        uneven.append(float(np.percentile(rest, 85) - np.percentile(rest, 15)))
    if not whites:
        return
    if np.median(clipped) > CLIPPED_SHARE:
        text = f"{np.median(clipped):.0%} of the card's white clips, so that it does not show the light"
        yield Finding("card.clipped", text, "set a shorter exposure on the camera")
    if np.median(dark) < DARK:
        text = f"the card's white is dark: {np.median(dark):.1%} of clipping"
        yield Finding("card.dark", text, "add light, or set a longer exposure")
    elif np.median(ratios) > CONTRAST:
        text = f"the card's black is {np.median(ratios):.0%} of its white: haze, gloss, or another transfer curve"
        yield Finding("card.contrast", text, "turn the card out of the lamp's reflection; check [camera] transfer")
    elif (steep := 1.0 / max(float(np.median(ratios)), 1e-3)) > STEEPEST:
        text = (
            f"the card's white is {steep:.0f} times as bright as its black; on plain paper it is 20 to 30 times: the "
            "camera lays a tone curve over [camera] transfer, or the print is on glossy photo paper"
        )
        remedy = "turn its contrast and HDR modes off, or python -m warp_ar.calibrate response PICTURES"
        yield Finding("camera.response", text, remedy)
    if np.median(uneven) > SHADOW:
        text = (
            f"a shadow lies across the card: its white differs by a factor of {math.exp(float(np.median(uneven))):.1f}"
        )
        yield Finding("card.shadow", text, "move the object that shades the card, or the card")
    yield from _check_drift(look, views, np.array(whites))


def _check_drift(look: Look, views: Sequence[tuple[Image, Pose]], whites: Array) -> Iterator[Finding]:
    """Yield findings on drift of exposure or white balance, which changes the whole picture by one factor.

    A lamp changes surfaces by different factors.

    Args:
        look: Frames of the scene.
        views: The frames that are compared, the first and the last.
        whites: Median linear value of the card's paper in each frame that shows enough of it, (n, 3).
    """
    if len(whites) < 2:
        return
    first, last = views[0][0], views[-1][0]
    tints = np.log(whites[:, [0, 2]] / whites[:, 1:2])
    levels = np.log(whites.mean(1))
    a, b = (look.table[cv2.resize(i, (32, 24), interpolation=cv2.INTER_AREA)].reshape(-1, 3, 3) for i in (first, last))
    low, high = (np.stack([p[..., k, k] for k in range(3)], -1) for p in (a, b))
    known = ((low > 0.01) & (low < 0.85) & (high > 0.01) & (high < 0.85)).all(-1)
    if known.sum() < 100:
        return
    ratio = np.log(high[known] / low[known])
    change = np.median(ratio.mean(1))
    spread = float(np.percentile(ratio.mean(1), 80) - np.percentile(ratio.mean(1), 20))
    if abs(change) > DRIFT and abs(levels[-1] - levels[0]) > DRIFT and spread < 0.5 * abs(change):
        text = f"the exposure drifts: all of the picture changes by a factor of {math.exp(change):.2f}"
        yield Finding("camera.drift", text, 'lock the camera\'s exposure, or write [source] metering = "automatic"')
    colour = ratio[:, [0, 2]] - ratio[:, 1:2]
    shift, width = np.median(colour, axis=0), np.percentile(colour, 80, axis=0) - np.percentile(colour, 20, axis=0)
    k = int(np.argmax(np.abs(shift)))
    # Switching off a lamp changes brightness and colour together; automatic white balance hardly changes brightness.
    alike = width[k] < 0.75 * abs(shift[k]) and abs(change) < 0.4
    if abs(shift[k]) > TINT and abs(tints[-1, k] - tints[0, k]) > TINT and alike:
        text = f"the white balance drifts: {'red' if k == 0 else 'blue'} by a factor of {math.exp(shift[k]):.2f}"
        yield Finding("camera.balance", text, "lock the camera's white balance")


def _check_blur(marker: Marker, look: Look, views: Sequence[tuple[Image, Pose]]) -> Iterator[Finding]:
    """Yield a finding if the print is blurred in most of the pictures."""
    blurred = []
    for image, pose in views:
        pixels = project(look.camera, pose.apply(pattern_of(marker).outline)).astype(np.float32)
        x, y, width, height = cv2.boundingRect(pixels)
        blurred.append(_is_blurred(image[max(y, 0) : y + height, max(x, 0) : x + width]))
    if np.mean(blurred) > 0.5:
        yield Finding("picture.blurred", "the card is blurred", "focus on the card, and keep the camera still")


def check_saturation(scene: Scene, look: Look) -> list[Finding]:
    """Return a finding if clipped light in the mirror balls has a code below 255.

    Nothing is found if no ball shows clipped light.

    Args:
        scene: Scene with its balls.
        look: Frames of the scene.
    """
    seen = SaturationLevels()
    for image, pose in look.views:
        seen.observe(image, ball_discs(scene.probes, look.camera, pose))
    told = seen.levels[seen.levels < NEAR_FULL]
    if len(told) < 2 or told.min() < LEAST_END or np.ptp(told) > ALIKE_ENDS:
        return []
    level = round(float(np.median(told)))
    if max(float((image[::2, ::2] > level + ALIKE_ENDS).mean()) for image, _ in look.views) > FEW:
        return []
    text = f"clipped light in the ball has code {level} of 255"
    remedy = "turn the camera's HDR and tone mapping modes off, so that clipped light has code 255"
    if _lowest_code(look.images) >= LIMITED[0] and level <= LIMITED[1]:
        text += " and nothing is black: limited range (16 to 235) shown as if it were full"
        remedy = "set the camera, the capture card or the recording to full range (0 to 255)"
    else:
        text += ": a shoulder, tone mapping, or another range than 0 to 255"
    return [Finding("camera.saturation", text, remedy)]


def _lowest_code(images: Sequence[NDArray[np.uint8]]) -> float:
    """Return the lowest code in the darkest channel of some pictures, ignoring the share ``FEW`` of the pixels."""
    few = images[:: -(-len(images) // 4)]
    return min(float(np.quantile(image[::2, ::2].min(axis=2), FEW)) for image in few)
