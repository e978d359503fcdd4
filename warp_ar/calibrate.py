"""``python -m warp_ar.calibrate``: print a marker, and measure the camera, its response, and where the ball stands.

    card      writes a marker or board as a PNG that prints at exact size
    camera    pictures of a ChArUco board to an OpenCV YAML file, which ``--calibration`` and a scene's ``calibration``
    read ball      frames of a scene to its mirror ball's centre, for the scene's ``[probe]``
    response  pictures at several exposures to a response curve, for the scene's ``transfer``

A response file is text: 256 lines of three numbers, the linear red, green and blue value of each 8-bit code, 1 for code
255.

References:
    [Z00] Z. Zhang. A flexible new technique for camera calibration. PAMI 2000.
    [DM97] P. Debevec and J. Malik. Recovering high dynamic range radiance maps from photographs. SIGGRAPH 1997.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import math
import sys
from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import imageio.v3
import numpy as np
from numpy.typing import NDArray

from warp_ar.ball import fit_ball, posed_frames
from warp_ar.errors import SinkError, UsageError, WarpArError
from warp_ar.live import EXIT_DONE, EXIT_INTERRUPTED, EXIT_USAGE, Parser
from warp_ar.scene import Camera, CharucoBoard, Marker, Probe, Proxy, load_scene, loads_scene
from warp_ar.sources import open_source
from warp_ar.tracking import Pose, find_dictionary, make_board

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

PAPERS = {"a4": (210.0, 297.0), "a3": (297.0, 420.0), "letter": (215.9, 279.4)}
"""Width and height of paper in millimetres, upright."""
_MARGIN = 10.0
"""Millimetres at the paper's edges that printers leave white."""
_MOVED = 0.03
"""Share of the picture's diagonal that a board's corners must have moved for another view of it to be taken."""
_MOST_VIEWS = 60
"""Views that are used at most: more cost time and add nothing."""
_FEWEST_VIEWS = 4
"""Views without which the focal length is not determined with any certainty."""
GOOD_VIEWS = 12
"""Views below which a warning is due."""
_COVERAGE_CELLS = (4, 6)
"""Rows and columns into which the picture is cut to see where the board has been."""
_SEARCH = 10
"""Millimetres around the rough centre in which the ball is looked for."""
_MOST_FRAMES = 6
"""Frames that the mirrored desk is compared in: more cost seconds each, and add little."""
_BLUR = 0.9
"""Pixels: standard deviation of the blur under which the ball's rim is looked for."""
_RIM_POINTS = 96
"""Points on the ball's outline at which the picture is compared."""


# --- A card to print -------------------------------------------------------------------------------------------------


def card_size(marker: Marker) -> tuple[float, float]:
    """Width and height in metres of a marker or board without its white margin."""
    return marker.board.size if marker.board is not None else (marker.size, marker.size)


def draw_card(marker: Marker, pixels_per_metre: float) -> Image:
    """The marker or board with a white margin of one cell and more, each edge at its nearest pixel.

    Args:
        marker: what to draw.
        pixels_per_metre: resolution.

    Returns:
        uint8 (h, w), 0 or 255, the marker in its centre.
    """
    dictionary = find_dictionary(marker.dictionary)
    bits = int(dictionary.markerSize) + 2
    width, height = card_size(marker)
    side, board = marker.size, marker.board
    places: list[tuple[int, float, float]] = [(marker.id, 0.0, 0.0)]
    if board is not None:
        made, side = make_board(marker), board.marker_length
        places = [
            (int(number), float(corners[0][0]), float(corners[0][1]))
            for number, corners in zip(np.ravel(made.getIds()), made.getObjPoints(), strict=True)
        ]
    margin = max(side / bits, 0.005)
    image = np.full([round((length + 2 * margin) * pixels_per_metre) for length in (height, width)], 255, np.uint8)

    def fill(cells: NDArray[Any], left: float, top: float, size: float) -> None:
        rows, columns = (
            np.round((margin + start + size * np.arange(count + 1)) * pixels_per_metre).astype(int)
            for start, count in zip((top, left), cells.shape, strict=True)
        )
        image[rows[0] : rows[-1], columns[0] : columns[-1]] = np.repeat(
            np.repeat(cells, np.diff(rows), axis=0), np.diff(columns), axis=1
        )

    if isinstance(board, CharucoBoard):
        squares = np.add.outer(np.arange(board.rows), np.arange(board.columns)) % 2
        fill((255 * squares).astype(np.uint8), 0.0, 0.0, board.square_length)
    for number, left, top in places:
        fill(np.asarray(cv2.aruco.generateImageMarker(dictionary, number, bits, borderBits=1)), left, top, side / bits)
    return image


def write_card(marker: Marker, path: Path, paper: str = "a4", dpi: float = 600.0) -> None:
    """Write a page with the card, its name and a 100 mm bar to check the printer with.

    Raises:
        UsageError: if the card does not fit on the paper.
        SinkError: if the file cannot be written.
    """
    if paper not in PAPERS:
        raise UsageError(f"--paper {paper}: expected {', '.join(PAPERS)}")
    if not 72 <= dpi <= 2400:
        raise UsageError(f"--dpi {dpi:g}: expected 72 to 2400 dots per inch")
    # PNG stores whole pixels per metre: drawn at that resolution, the print is exact.
    per_metre = round(dpi / 0.0254)
    width, height = PAPERS[paper]
    card_mm = [1e3 * length for length in card_size(marker)]
    foot = 15.0
    if card_mm[0] > card_mm[1]:
        width, height = height, width
    if card_mm[0] > width - 2 * _MARGIN or card_mm[1] > height - 2 * _MARGIN - foot:
        raise UsageError(
            f"card of {card_mm[0]:g} x {card_mm[1]:g} mm does not fit on {paper} ({width:g} x {height:g} mm "
            "with margins); choose smaller lengths or a larger --paper"
        )
    mm = per_metre / 1e3
    page = np.full((round(height * mm), round(width * mm)), 255, np.uint8)
    card = draw_card(marker, per_metre)
    h, w = (min(a, b) for a, b in zip(card.shape, page.shape, strict=True))
    card = card[(card.shape[0] - h) // 2 :, (card.shape[1] - w) // 2 :][:h, :w]
    y, x = (page.shape[0] - round(foot * mm) - h) // 2, (page.shape[1] - w) // 2
    page[y : y + h, x : x + w] = card
    bottom = page.shape[0] - round(_MARGIN * mm)
    page[bottom - round(mm) : bottom, round(_MARGIN * mm) : round(_MARGIN * mm) + round(100 * mm)] = 0
    name = str(marker.board) if marker.board is not None else f"id {marker.id}, {marker.size:g} m"
    text = f"{marker.dictionary}, {name}; print at 100 %: this bar is 100 mm"
    place = (round(_MARGIN * mm), bottom - round(3 * mm))
    cv2.putText(page, text, place, cv2.FONT_HERSHEY_SIMPLEX, mm / 9, 0, max(1, round(mm / 5)), cv2.LINE_AA)
    try:
        imageio.v3.imwrite(path, page, extension=".png", dpi=(per_metre * 0.0254, per_metre * 0.0254))
    except OSError as error:
        raise SinkError(f"{path}: cannot be written: {error.strerror or error}") from error


# --- The camera ------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class CameraReport:
    """A calibrated camera and how far to trust it."""

    camera: Camera
    """The camera; its transfer is not measured here."""
    error: float
    """Root mean square reprojection error, pixels."""
    view_errors: tuple[float, ...]
    """The same for each view that was used."""
    focal_deviation: float
    """Standard deviation of the focal length, pixels."""
    coverage: float
    """Share of the picture's cells where the board has been."""
    warnings: tuple[str, ...]
    """What would make it better, one line each."""


class BoardViews:
    """Different views of a ChArUco board, collected until they calibrate a camera [Z00]."""

    def __init__(self, marker: Marker) -> None:
        """Collect nothing yet.

        Args:
            marker: the board that was printed.

        Raises:
            UsageError: if it is no ChArUco board.
        """
        if not isinstance(marker.board, CharucoBoard):
            raise UsageError('--board: the camera is calibrated with a ChArUco board, such as "charuco 7x5 0.03 0.022"')
        self._marker = marker
        self._board = make_board(marker)
        self._detector = cv2.aruco.CharucoDetector(self._board)
        self._size: tuple[int, int] | None = None
        self._seen = 0
        self.views: list[tuple[NDArray[Any], NDArray[Any], NDArray[Any]]] = []
        """Corners in pixels, their numbers, and where they are on the board."""

    def add(self, image: Image) -> bool:
        """Take a picture, RGB or grey uint8; True if it shows the board as none before.

        Raises:
            UsageError: if its size is not the first one's.
        """
        size = (image.shape[1], image.shape[0])
        self._size = self._size or size
        if size != self._size:
            first = f"{self._size[0]}x{self._size[1]}"
            raise UsageError(f"picture {self._seen}: {size[0]}x{size[1]}; expected the first one's {first}")
        self._seen += 1
        gray = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        corners, ids, _, _ = self._detector.detectBoard(gray)
        # Corners on one line, or fewer than six, leave a view's pose open.
        if ids is None or len(ids) < 6 or self._board.checkCharucoCornersCollinear(ids):
            return False
        corners, ids = np.asarray(corners).reshape(-1, 2), np.ravel(ids)
        least = _MOVED * math.hypot(*size)
        if len(self.views) >= _MOST_VIEWS or any(_moved(corners, ids, *view[:2]) <= least for view in self.views):
            return False
        self.views.append((corners, ids, np.asarray(self._board.getChessboardCorners())[ids]))
        return True

    def covered(self) -> NDArray[np.bool_]:
        """Where in the picture the board has been, by rows and columns."""
        return _covered(self.views, self._size or (1, 1))

    def solve(self) -> CameraReport:
        """Pinhole and distortion.

        Raises:
            UsageError: if too few views show the board.
        """
        size = self._size
        if size is None or len(self.views) < _FEWEST_VIEWS:
            raise UsageError(
                f"{len(self.views)} different views of {self._marker.board} ({self._marker.dictionary}) in "
                f"{self._seen} pictures; expected {_FEWEST_VIEWS} at the least, {GOOD_VIEWS} for a good result"
            )
        result = _calibrate(self.views, size)
        errors = np.ravel(result[-1])
        # A blurred or bent view must not spoil the others.
        kept = [view for view, error in zip(self.views, errors, strict=True) if error <= 3 * np.median(errors)]
        if len(kept) < len(self.views) and len(kept) >= _FEWEST_VIEWS:
            result = _calibrate(kept, size)
            errors = np.ravel(result[-1])
        error, matrix, distortion, rotations, _, deviations, _, _ = result
        camera = Camera(
            *size, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], tuple(map(float, np.ravel(distortion)))
        )
        covered = _covered(kept, size)
        tilts = [math.degrees(math.acos(min(1.0, abs(cv2.Rodrigues(r)[0][2, 2])))) for r in rotations]
        warnings = []
        if len(kept) < GOOD_VIEWS:
            warnings.append(f"only {len(kept)} views: take {GOOD_VIEWS} or more, from different sides and distances")
        if covered.mean() < 0.8:
            empty = [_place(row, column) for row, column in np.argwhere(~covered)]
            warnings.append(f"the board never reached {', '.join(dict.fromkeys(empty))}: distortion is a guess there")
        if max(tilts) - min(tilts) < 15:
            warnings.append(
                f"the board was tilted by {min(tilts):.0f} to {max(tilts):.0f} degrees only: "
                "the focal length is uncertain"
            )
        if error > 1.0:
            warnings.append(
                f"reprojection error {error:.2f} pixels: is the print flat, the picture sharp, the board's text right?"
            )
        return CameraReport(
            camera,
            float(error),
            tuple(map(float, errors)),
            float(np.ravel(deviations)[:2].max()),
            float(covered.mean()),
            tuple(warnings),
        )


def calibrate_camera(images: Iterable[Image], marker: Marker) -> CameraReport:
    """Pinhole and distortion from views of a ChArUco board.

    Args:
        images: RGB or grey uint8 pictures, all of one size; views that hardly differ from earlier ones are skipped.
        marker: the board that was printed.

    Raises:
        UsageError: if the board is no ChArUco board, sizes differ, or too few views show it.
    """
    views = BoardViews(marker)
    for image in images:
        views.add(image)
    return views.solve()


def _covered(
    views: Sequence[tuple[NDArray[Any], NDArray[Any], NDArray[Any]]], size: tuple[int, int]
) -> NDArray[np.bool_]:
    rows, columns = _COVERAGE_CELLS
    covered = np.zeros((rows, columns), bool)
    for corners, _, _ in views:
        cells = np.floor(corners / size * (columns, rows)).astype(int).clip(0, (columns - 1, rows - 1))
        covered[cells[:, 1], cells[:, 0]] = True
    return covered


def _moved(corners: NDArray[Any], ids: NDArray[Any], others: NDArray[Any], other_ids: NDArray[Any]) -> float:
    """Mean distance in pixels between the corners that two views share; infinite if none."""
    _, here, there = np.intersect1d(ids, other_ids, return_indices=True)
    return float(np.linalg.norm(corners[here] - others[there], axis=1).mean()) if len(here) else math.inf


def _calibrate(views: Sequence[tuple[NDArray[Any], NDArray[Any], NDArray[Any]]], size: tuple[int, int]) -> Any:
    pixels = [corners.astype(np.float32) for corners, _, _ in views]
    points = [points.astype(np.float32) for _, _, points in views]
    plain, full = (
        cv2.calibrateCameraExtended(points, pixels, size, np.eye(3), np.zeros(5), flags=flags)
        for flags in (cv2.CALIB_FIX_K3, 0)
    )
    # The sixth-order term bends the corners of the picture wildly where it only fits noise.
    return full if full[0] < 0.9 * plain[0] else plain


def _place(row: int, column: int) -> str:
    rows, columns = _COVERAGE_CELLS
    vertical = "top" if row == 0 else "bottom" if row == rows - 1 else "middle"
    return f"the {vertical} {'left' if column < columns / 3 else 'right' if column >= columns * 2 / 3 else 'centre'}"


def write_camera(report: CameraReport, path: Path) -> None:
    """Write OpenCV's YAML (or JSON or XML, by the name's ending).

    Raises:
        SinkError: if the file cannot be written.
    """
    if path.suffix.lower() not in (".yml", ".yaml", ".json", ".xml"):
        raise UsageError(f"--output {path}: expected a name that ends in .yml, .json or .xml")
    if not path.parent.is_dir():
        raise SinkError(f"{path}: cannot be written: no folder {path.parent}")
    camera = report.camera
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        opened = storage.isOpened()
    except (cv2.error, SystemError):  # the latter is how OpenCV's constructor reports a file that does not open
        opened = False
    if not opened:
        raise SinkError(f"{path}: cannot be written")
    storage.write("image_width", camera.width)
    storage.write("image_height", camera.height)
    storage.write("camera_matrix", camera.matrix())
    storage.write("distortion_coefficients", np.array(camera.distortion)[None])
    storage.write("avg_reprojection_error", report.error)
    storage.release()


# --- The ball --------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class BallReport:
    """Where a mirror ball stands."""

    center: tuple[float, float, float]
    """Centre in the marker's frame, metres."""
    contrast: float
    """Contrast across its outline against that just outside, or share of samples that agree: 0 nothing there, 1 all."""
    views: int
    """Frames that were used."""
    deviation: float | None = None
    """Standard deviation in metres along the worst axis, where the mirrored desk told; None: only the outline did."""


def outline_ball(camera: Camera, pose: Pose, center: Array, radius: float) -> tuple[Array, Array, NDArray[np.bool_]]:
    """The silhouette of a ball.

    Rays that touch the ball touch it on a circle: with d the distance of the centre c from the eye and n the direction
    to it, the circle's centre is c - n r^2 / d and its radius r sqrt(1 - r^2 / d^2).

    Returns:
        Pixels (n, 2) on the outline, outward unit normals (n, 2) in the image, and which points (n,) lie above the
        ball's middle in the world; empty if the ball is not wholly before the camera.
    """
    c = pose.apply(center)
    d = float(np.linalg.norm(c))
    if d <= radius or c[2] <= radius:
        return np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, bool)
    n = c / d
    u = np.cross(n, [0.0, 1.0, 0.0] if abs(n[1]) < 0.9 else [1.0, 0.0, 0.0])
    u /= np.linalg.norm(u)
    v = np.cross(n, u)
    angle = 2 * np.pi * np.arange(_RIM_POINTS) / _RIM_POINTS
    spokes = np.outer(np.cos(angle), u) + np.outer(np.sin(angle), v)
    rim = c - n * radius**2 / d + radius * math.sqrt(1 - (radius / d) ** 2) * spokes
    pixels = cv2.projectPoints(rim, np.zeros(3), np.zeros(3), camera.matrix(), np.array(camera.distortion))[0].reshape(
        -1, 2
    )
    tangent = np.roll(pixels, -1, 0) - np.roll(pixels, 1, 0)
    normal = np.stack([tangent[:, 1], -tangent[:, 0]], -1) / np.maximum(np.linalg.norm(tangent, axis=1), 1e-9)[:, None]
    outward = np.sign(((pixels - pixels.mean(0)) * normal).sum(1))
    above = (rim - c) @ pose.rotation[:, 2] > 0
    return pixels, normal * outward[:, None], above


def locate_ball(
    views: Sequence[tuple[Image, Pose]],
    camera: Camera,
    probe: Probe,
    proxies: Sequence[Proxy] = (),
    others: Sequence[Probe] = (),
) -> BallReport:
    """Centre of a mirror ball from frames with known poses: by the desk that it mirrors, else by its outline.

    On path-traced desks the mirrored desk gives the centre within 0.2 to 0.7 mm where the height is right, and within
    1.7 mm where that is off by 1.5.

    Args:
        views: RGB frames with ``camera_from_world``.
        camera: The camera.
        probe: The ball; its centre within 10 mm.
        proxies: What stands on the desk.
        others: Other balls.

    Raises:
        UsageError: The ball is in too few frames to see its outline.
    """
    few = views[:: -(-len(views) // _MOST_FRAMES)]
    fit = fit_ball(few, camera, probe, proxies, others, search=1e-3 * _SEARCH)
    if fit is None or not fit.is_good:
        return outline_search(views, camera, probe.center, probe.radius)
    x, y, z = (float(v) for v in fit.center)
    return BallReport((x, y, z), 1.0 - fit.error, len(few), fit.deviation)


def outline_search(
    views: Sequence[tuple[Image, Pose]], camera: Camera, center: Sequence[float], radius: float
) -> BallReport:
    """Centre of a mirror ball of known radius and height, from its outline in frames with known poses.

    The height stays as given: a ball stands on something, and from nearby viewpoints height and distance are hard to
    tell apart. Over the other two the mean contrast across the outline is largest where the ball is, less that just
    outside: reflections crowd inside the rim and would pull the outline in. Only the upper half counts, where the rim
    reflects what lies behind the desk; below, it reflects the desk before the desk. No edge is picked by threshold.

    On path-traced desks this comes within 1 mm where the rim stands out, and within 9 mm where a bright band lies just
    inside it: look at the result, and measure such a ball with a ruler.

    Args:
        views: RGB frames with ``camera_from_world``.
        camera: the camera.
        center: rough centre in the marker's frame, metres, within 10 mm, and at the right height.
        radius: metres.

    Raises:
        UsageError: if the ball is in too few frames to see its outline.
    """
    h, w = views[0][0].shape[:2]
    gradients = [_gradients(image) for image, _ in views]

    def score(c: Array) -> float:
        total, count = 0.0, 0
        for (dx, dy), (_, pose) in zip(gradients, views, strict=True):
            pixels, normals, above = outline_ball(camera, pose, c, radius)
            rings = pixels + np.array([0.0, 3.5, 5.5])[:, None, None] * _BLUR * normals
            within = above & ((rings >= 1) & (rings <= (w - 2, h - 2))).all((0, 2))
            if not within.any():
                continue
            x, y = np.moveaxis(rings[:, within].astype(np.float32), 2, 0)
            slope = cv2.remap(dx, x, y, cv2.INTER_LINEAR) * normals[within, 0]
            slope = np.abs(slope + cv2.remap(dy, x, y, cv2.INTER_LINEAR) * normals[within, 1])
            # A lamp's edge must not outweigh the whole rim: strong is strong enough.
            strength = slope / (slope + 0.02)
            total += float((strength[0] - 0.5 * (strength[1] + strength[2])).sum())
            count += int(within.sum())
        return total / count if count >= _RIM_POINTS // 4 else -math.inf

    best, count = np.array(center, float), _SEARCH
    # Everywhere at 1 mm first: reflections make maxima of their own.
    for step in (1e-3, 4e-4, 2e-4, 1e-4, 5e-5):
        places = [
            best + step * np.array([x, y, 0.0]) for x in range(-count, count + 1) for y in range(-count, count + 1)
        ]
        scores = [score(place) for place in places]
        best, count = places[int(np.argmax(scores))], 2
    if not math.isfinite(max(scores)):
        raise UsageError(f"ball at {[round(x, 4) for x in center]}: its upper half is in no frame")
    x, y, z = (float(v) for v in best)
    return BallReport((x, y, z), max(scores), len(views))


def _gradients(image: Image) -> list[Any]:
    """Derivatives of blurred encoded brightness (0 to 1) along x and y, times the blur's width."""
    gray = cv2.medianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), 3).astype(np.float32) / 255
    smooth = cv2.GaussianBlur(gray, (0, 0), _BLUR)
    return [cv2.Sobel(smooth, cv2.CV_32F, x, y, ksize=3, scale=_BLUR / 8) for x, y in ((1, 0), (0, 1))]


# --- The response ----------------------------------------------------------------------------------------------------


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
    try:
        path.write_text("".join(f"{r:.9g} {g:.9g} {b:.9g}\n" for r, g, b in curve))
    except OSError as error:
        raise SinkError(f"{path}: cannot be written: {error.strerror}") from error


# --- The command -----------------------------------------------------------------------------------------------------


def _marker(options: argparse.Namespace) -> Marker:
    """The marker that options describe, checked as a scene's is."""
    lines = [f"dictionary = {json.dumps(options.dictionary)}"]
    if options.board is not None:
        lines.append(f"board = {json.dumps(options.board)}")
    else:
        lines += [f"id = {options.id}", f"size = {options.size}"]
    return loads_scene("\n".join(["schema = 1", 'name = "options"', _CAMERA, "[marker]", *lines]), "options").marker


_CAMERA = "[camera]\nwidth = 2\nheight = 2\nfx = 2.0\nfy = 2.0\ncx = 0.5\ncy = 0.5"


def _pictures(paths: Sequence[str], most: int | None = None) -> Iterable[Image]:
    for path in paths:
        with open_source(path) as source:
            for frame in itertools.islice(source, most):
                yield frame.image


def _fraction(text: str) -> float:
    try:
        return float(Fraction(text))
    except (ValueError, ZeroDivisionError):
        raise argparse.ArgumentTypeError(f"{text!r}: expected a time in seconds, such as 0.02 or 1/50") from None


def make_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = Parser(
        prog="python -m warp_ar.calibrate", description="Print a marker; measure the camera, its response, the ball."
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="card|camera|ball|response")

    def add(name: str, text: str, output: str | None) -> Any:
        command = commands.add_parser(name, help=text, description=text)
        if output is not None:
            command.add_argument("--output", type=Path, default=Path(output), metavar="FILE", help=f"default: {output}")
        return command.add_argument

    board = 'a board, as in a scene: "charuco 7x5 0.03 0.022" or "grid 4x3 0.04 0.01", lengths in metres'
    option = add("card", "write a marker or board as a PNG that prints at exact size", "card.png")
    option("--dictionary", default="DICT_4X4_50", metavar="NAME", help="OpenCV's dictionary (default: DICT_4X4_50)")
    option("--id", type=int, default=0, help="which marker (default: 0)")
    option("--size", type=float, default=0.08, help="side of the black square in metres (default: 0.08)")
    option("--board", metavar="TEXT", help=board)
    option("--paper", default="a4", metavar="|".join(PAPERS), help="default: a4")
    option("--dpi", type=float, default=600.0, help="dots per inch (default: 600)")
    option = add("camera", "calibrate the camera from pictures of a ChArUco board", "camera.yml")
    option("pictures", nargs="+", metavar="PATH|INDEX", help="folders, pictures, videos, or a capture device")
    option("--dictionary", default="DICT_5X5_100", metavar="NAME", help="OpenCV's dictionary (default: DICT_5X5_100)")
    option(
        "--board", default="charuco 7x5 0.03 0.022", metavar="TEXT", help=board + " (default: charuco 7x5 0.03 0.022)"
    )
    option("--frames", type=int, metavar="N", help="stop after N frames of each video or device")
    option = add("ball", "measure where a scene's mirror ball stands", None)
    option(
        "scene",
        metavar="SCENE",
        help="a scene file or bundled scene: its camera, marker, and a rough [probe] with the radius",
    )
    option("--source", metavar="PATH|INDEX", help="frames, if not the scene's own")
    option("--frames", type=int, default=60, metavar="N", help="frames to look at (default: 60)")
    option = add("response", "measure the response curve from pictures of one still scene", "response.txt")
    option("pictures", nargs="+", metavar="PATH", help="pictures, in the order of --exposures")
    option(
        "--exposures", nargs="+", type=_fraction, required=True, metavar="S", help="seconds, such as 1/200 1/50 0.08"
    )
    return parser


def _run_ball(options: argparse.Namespace) -> None:
    scene = load_scene(options.scene)
    if not scene.probes:
        raise UsageError(f"{options.scene}: expected a [probe] with a rough center and the radius")
    spec = options.source
    if spec is None:
        spec = scene.source.path or scene.source.camera if scene.source is not None else None
    if spec is None:
        raise UsageError(f"{options.scene}: names no frames; give --source")
    with open_source(spec) as source:
        camera = scene.camera.scaled_to(*source.size)
        views = posed_frames(source, scene.marker, camera, options.frames)
    if not views:
        raise UsageError(f"{spec}: no marker in the first {options.frames} frames; see [marker] in {options.scene}")
    views = views[:: -(-len(views) // 12)]
    for index, probe in enumerate(scene.probes):
        others = [other for other in scene.probes if other is not probe]
        report = locate_ball(views, camera, probe, scene.proxies, others)
        moved = 1e3 * math.dist(report.center, probe.center)
        x, y, z = report.center
        how = "by its outline, height as given"
        if report.deviation is not None:
            how = f"by the desk in it, +/- {1e3 * report.deviation:.2f} mm"
        print(f"probe {index}: center = [{x:.5f}, {y:.5f}, {z:.5f}]  ({moved:.1f} mm off the scene's; {how})")
        if report.contrast < 0.2:
            print(
                f"warp_ar: probe {index}: little contrast at the ball's rim ({report.contrast:.0%}); check the result",
                file=sys.stderr,
            )


def _run(options: argparse.Namespace) -> None:
    if options.command == "card":
        write_card(_marker(options), options.output, options.paper, options.dpi)
        print(f"{options.output}: print at 100 %, without fitting to the page, and check that the bar is 100 mm")
    elif options.command == "camera":
        options.id, options.size = 0, 0.08
        report = calibrate_camera(_pictures(options.pictures, options.frames), _marker(options))
        write_camera(report, options.output)
        c = report.camera
        print(
            f"{options.output}: fx {c.fx:.2f} fy {c.fy:.2f} (+/- {report.focal_deviation:.2f}) "
            f"cx {c.cx:.2f} cy {c.cy:.2f}"
        )
        print(
            f"reprojection error {report.error:.3f} pixels over {len(report.view_errors)} views "
            f"(worst {max(report.view_errors):.3f}), {report.coverage:.0%} of the picture covered"
        )
        for warning in report.warnings:
            print(f"warp_ar: {warning}", file=sys.stderr)
    elif options.command == "response":
        curve = measure_response(list(_pictures(options.pictures)), options.exposures)
        write_response(curve, options.output)
        middle = ", ".join(f"{v:.4f}" for v in curve[128])
        print(f"{options.output}: code 128 is {middle} of clipping (sRGB: 0.2159)")
    else:
        _run_ball(options)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    try:
        _run(make_parser().parse_args(arguments))
    except WarpArError as error:
        print(f"warp_ar: {error}", file=sys.stderr)
        return EXIT_USAGE
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
