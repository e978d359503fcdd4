"""Calibration of a camera (pinhole with distortion, or fisheye) from views of a ChArUco board.

References:
    [Z00] Z. Zhang. A flexible new technique for camera calibration. PAMI 2000.
    [KB06] J. Kannala and S. Brandt. A generic camera model and calibration method for conventional, wide-angle, and
        fish-eye lenses. PAMI 2006.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from warp_ar.calibration.board_finder import BENT, STRAIGHT, find_markers, recognise_board, smallest_dictionary
from warp_ar.errors import UsageError, reason
from warp_ar.files import store
from warp_ar.scene import Camera, CharucoBoard, Marker
from warp_ar.scene.calibration_file import rational_of_fisheye
from warp_ar.signature import PROGRAM
from warp_ar.tracking.card_layout import CARD_MARKER
from warp_ar.tracking.markers import make_board

Image = NDArray[np.uint8]
_Views: TypeAlias = list[tuple[NDArray[Any], NDArray[Any], NDArray[Any]]]
"""For each view: corners in pixels, their ids, and their positions on the board."""

_MOVED = 0.03
"""Mean movement of a board's corners, relative to the picture's diagonal, from which a view counts as new."""
_MOST_VIEWS = 60
"""Largest number of views; more take time without improving the result."""
_FEWEST_VIEWS = 4
"""Smallest number of views that determine the focal length."""
GOOD_VIEWS = 12
"""Number of views below which a warning is given."""
_GROUPS = 15
"""Number of groups of views that are left out in turn; more take time without improving the estimate."""
LEAST_TILT = 15.0
"""Smallest range of the board's tilt, degrees; below it, focal length and distance are ambiguous."""
MOST_FOCAL = 0.03
"""Largest interval (two standard deviations) of the focal length, relative to it."""
_COVERAGE_CELLS = (4, 6)
"""Rows and columns of the grid that records where in the picture the board was seen."""


@dataclasses.dataclass(frozen=True)
class CameraReport:
    """Calibrated camera with its uncertainty."""

    camera: Camera
    """The camera; its transfer is not calibrated."""
    error: float
    """Root mean square reprojection error, pixels."""
    view_errors: tuple[float, ...]
    """Root mean square reprojection error of each view, pixels."""
    focal_deviation: float
    """Standard deviation of the focal length, pixels."""
    coverage: float
    """Share of the picture's grid cells in which the board was seen."""
    warnings: tuple[str, ...]
    """Advice for a better calibration, one line each."""
    marker: Marker
    """The board."""
    tilts: tuple[float, float]
    """Smallest and largest tilt of the board, degrees; for similar views, ``focal_deviation`` is too small."""
    fisheye: tuple[float, ...] = ()
    """k1 k2 k3 k4 of a fisheye that the camera's distortion approximates; empty for a pinhole."""

    @property
    def doubt(self) -> str:
        """Return the reason to reject the focal length; empty if it is accepted."""
        if self.tilts[1] - self.tilts[0] < LEAST_TILT:
            return f"the card was tilted by {self.tilts[0]:.0f} to {self.tilts[1]:.0f} degrees only"
        if (share := 2 * self.focal_deviation / self.camera.fx) > MOST_FOCAL:
            return f"the focal length is known to +/- {share:.0%} only"
        return ""


class BoardViews:
    """Distinct views of a ChArUco board, collected until they suffice for calibration [Z00]."""

    def __init__(
        self, marker: Marker | None = None, board: CharucoBoard | None = None, *, fisheye: bool = False
    ) -> None:
        """Start without views.

        Args:
            marker: the printed board; None: the ChArUco board in the first picture that shows one.
            board: layout of the board, if only the dictionary must be recognised.
            fisheye: True for a fisheye lens.

        Raises:
            UsageError: if the marker is no ChArUco board.
        """
        if marker is not None and not isinstance(marker.board, CharucoBoard):
            raise UsageError(f'--board: the camera is calibrated with a ChArUco board, such as "{CARD_MARKER.board}"')
        self.marker: Marker | None = None
        """The board, or None until it is recognised."""
        self._layout, self._fisheye = board, fisheye
        self._board: Any = None
        self._detector: Any = None
        if marker is not None:
            self._take(marker)
        self._size: tuple[int, int] | None = None
        self._seen = 0
        self.views: _Views = []

    def _recognised(self, gray: Image) -> Marker | None:
        if self._layout is None:
            return recognise_board(gray, BENT if self._fisheye else STRAIGHT)
        name, found = find_markers(gray)
        count = self._layout.marker_count
        if not found or max(d.id for d in found) >= count:
            return None
        return Marker(dictionary=smallest_dictionary(name, count - 1), board=self._layout)

    def _take(self, marker: Marker) -> None:
        self.marker = marker
        self._board = make_board(marker)
        self._detector = cv2.aruco.CharucoDetector(self._board)

    def add(self, image: Image) -> bool:
        """Add a picture, RGB or grey uint8; return True if it is a new view of the board.

        Raises:
            UsageError: if its size differs from that of the first picture.
        """
        size = (image.shape[1], image.shape[0])
        self._size = self._size or size
        if size != self._size:
            first = f"{self._size[0]}x{self._size[1]}"
            turned = "; hold the camera the same way for all" if size == self._size[::-1] else ""
            raise UsageError(f"picture {self._seen}: {size[0]}x{size[1]}; expected the first one's {first}{turned}")
        self._seen += 1
        gray = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        if self.marker is None:
            if (seen := self._recognised(gray)) is None:
                return False
            self._take(seen)
        corners, ids, _, _ = self._detector.detectBoard(gray)
        # Collinear corners, or fewer than six, do not determine a view's pose.
        if ids is None or len(ids) < 6 or self._board.checkCharucoCornersCollinear(ids):
            return False
        corners, ids = np.asarray(corners).reshape(-1, 2), np.ravel(ids)
        least = _MOVED * math.hypot(*size)
        if len(self.views) >= _MOST_VIEWS or any(_moved(corners, ids, *view[:2]) <= least for view in self.views):
            return False
        self.views.append((corners, ids, np.asarray(self._board.getChessboardCorners())[ids]))
        return True

    def covered(self) -> NDArray[np.bool_]:
        """Return a mask, by rows and columns of the picture's grid, of cells in which the board was seen."""
        return _covered(self.views, self._size or (1, 1))

    def solve(self) -> CameraReport:
        """Calibrate the camera: pinhole with distortion, or fisheye [KB06].

        Raises:
            UsageError: if too few views show the board.
            SceneError: if the lens is wider than supported.
        """
        size, fisheye = self._size, self._fisheye
        if size is None or self.marker is None or len(self.views) < _FEWEST_VIEWS:
            what = "a ChArUco board" if self.marker is None else f"{self.marker.board} ({self.marker.dictionary})"
            raise UsageError(
                f"{len(self.views)} different views of {what} in {self._seen} pictures; "
                f"expected {_FEWEST_VIEWS} at the least, {GOOD_VIEWS} for a good result"
            )
        result = _calibrate(self.views, size, fisheye)
        # Blurred views and views of a bent board are removed.
        most = 3 * np.median(result.view_errors)
        kept = [view for view, error in zip(self.views, result.view_errors, strict=True) if error <= most]
        if len(kept) < len(self.views) and len(kept) >= _FEWEST_VIEWS:
            result = _calibrate(kept, size, fisheye)
        else:
            kept = self.views
        error, matrix, rotations = result.error, result.matrix, result.rotations
        terms = tuple(map(float, np.ravel(result.distortion)))
        distortion = rational_of_fisheye(*size, matrix, terms) if fisheye else terms
        deviation = max(result.deviation, _spread(kept, size, fisheye))
        camera = Camera(*size, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], distortion)
        covered = _covered(kept, size)
        tilts = [math.degrees(math.acos(min(1.0, abs(cv2.Rodrigues(r)[0][2, 2])))) for r in rotations]
        warnings = []
        if len(kept) < GOOD_VIEWS:
            warnings.append(f"only {len(kept)} views: take {GOOD_VIEWS} or more, from different sides and distances")
        if covered.mean() < 0.8:
            empty = [_place(row, column) for row, column in np.argwhere(~covered)]
            warnings.append(f"the board never reached {', '.join(dict.fromkeys(empty))}: distortion is a guess there")
        if max(tilts) - min(tilts) < LEAST_TILT:
            warnings.append(
                f"the board was tilted by {min(tilts):.0f} to {max(tilts):.0f} degrees only: "
                "the focal length is uncertain"
            )
        if error > 1.0:
            warnings.append(
                f"reprojection error {error:.2f} pixels: is the print flat, the picture sharp, the board's text right?"
                + ("" if fisheye else " Of a very wide lens, try --fisheye")
            )
        return CameraReport(
            camera,
            error,
            tuple(map(float, result.view_errors)),
            deviation,
            float(covered.mean()),
            tuple(warnings),
            self.marker,
            (min(tilts), max(tilts)),
            terms if fisheye else (),
        )


def calibrate_camera(
    images: Iterable[Image],
    marker: Marker | None = None,
    board: CharucoBoard | None = None,
    *,
    fisheye: bool = False,
) -> CameraReport:
    """Calibrate a camera from views of a ChArUco board.

    Args:
        images: RGB or grey uint8 pictures, all of one size; views similar to earlier ones are skipped.
        marker: the printed board; None: the board in the pictures.
        board: layout of the board, if only the dictionary must be recognised.
        fisheye: True for a fisheye lens.

    Raises:
        UsageError: if the board is no ChArUco board, sizes differ, or too few views show it.
        SceneError: if the lens is wider than supported.
    """
    views = BoardViews(marker, board, fisheye=fisheye)
    for image in images:
        views.add(image)
    return views.solve()


def _covered(views: _Views, size: tuple[int, int]) -> NDArray[np.bool_]:
    rows, columns = _COVERAGE_CELLS
    covered = np.zeros((rows, columns), bool)
    for corners, _, _ in views:
        cells = np.floor(corners / size * (columns, rows)).astype(int).clip(0, (columns - 1, rows - 1))
        covered[cells[:, 1], cells[:, 0]] = True
    return covered


def _moved(corners: NDArray[Any], ids: NDArray[Any], others: NDArray[Any], other_ids: NDArray[Any]) -> float:
    """Return the mean distance in pixels between the corners that two views share; infinite if they share none."""
    _, here, there = np.intersect1d(ids, other_ids, return_indices=True)
    return float(np.linalg.norm(corners[here] - others[there], axis=1).mean()) if len(here) else math.inf


@dataclasses.dataclass(frozen=True)
class _Solution:
    """Camera model fitted to views."""

    error: float
    """Root mean square reprojection error, pixels."""
    matrix: NDArray[Any]
    distortion: NDArray[Any]
    """k1 k2 p1 p2 k3 for a pinhole, k1 k2 k3 k4 for a fisheye."""
    rotations: Sequence[NDArray[Any]]
    """Rotation vector of the board in each view."""
    deviation: float
    """Standard deviation of the focal length if corners were independent, pixels; 0: unknown."""
    view_errors: NDArray[Any]
    """Root mean square reprojection error of each view, pixels."""


def _calibrate(views: _Views, size: tuple[int, int], fisheye: bool) -> _Solution:
    if fisheye:
        return _solve_fisheye(views, size)
    plain, full = (_solve(views, size, flags) for flags in (cv2.CALIB_FIX_K3, 0))
    # The sixth-order term is left out where it would only fit noise and distort the picture's corners.
    return full if full.error < 0.9 * plain.error else plain


def _solve(views: _Views, size: tuple[int, int], flags: int) -> _Solution:
    pixels = [corners.astype(np.float32) for corners, _, _ in views]
    points = [points.astype(np.float32) for _, _, points in views]
    error, matrix, distortion, rotations, _, deviations, _, errors = cv2.calibrateCameraExtended(
        points, pixels, size, np.eye(3), np.zeros(5), flags=flags
    )
    deviation = float(np.ravel(deviations)[:2].max())
    return _Solution(float(error), matrix, distortion, rotations, deviation, np.ravel(errors))


def _solve_fisheye(views: _Views, size: tuple[int, int]) -> _Solution:
    pixels = [corners.astype(np.float64)[None] for corners, _, _ in views]
    points = [points.astype(np.float64)[None] for _, _, points in views]
    flags = cv2.CALIB_RECOMPUTE_EXTRINSIC | cv2.CALIB_FIX_SKEW
    try:
        error, matrix, distortion, rotations, shifts = cv2.fisheye.calibrate(
            points, pixels, size, np.eye(3), np.zeros(4), flags=flags
        )
    except cv2.error as problem:
        raise UsageError(f"the views fit no fisheye ({reason(problem)}); leave out --fisheye, or add views") from None
    found = [
        cv2.fisheye.projectPoints(board, turn, shift, matrix, distortion)[0]
        for board, turn, shift in zip(points, rotations, shifts, strict=True)
    ]
    errors = [np.sqrt(((one - seen) ** 2).sum(-1).mean()) for one, seen in zip(found, pixels, strict=True)]
    return _Solution(float(error), matrix, distortion, rotations, 0.0, np.array(errors))


def _spread(views: _Views, size: tuple[int, int], fisheye: bool) -> float:
    """Return the standard deviation of the focal length in pixels, by leaving out groups of views in turn (jackknife).

    Errors of corners in one view are correlated (blur, lens effects outside the model), so a deviation that assumes
    independent corners is too small. With f_g the focal length without group g of n,

        s^2 = (n - 1) / n  sum_g (f_g - mean f)^2.
    """
    count = min(len(views), _GROUPS)
    if count <= _FEWEST_VIEWS:
        return 0.0
    found = []
    for group in range(count):
        rest = [view for number, view in enumerate(views) if number % count != group]
        matrix = (_solve_fisheye(rest, size) if fisheye else _solve(rest, size, cv2.CALIB_FIX_K3)).matrix
        found.append((matrix[0, 0], matrix[1, 1]))
    return float(np.sqrt((count - 1) * np.var(found, axis=0).max()))


def _place(row: int, column: int) -> str:
    rows, columns = _COVERAGE_CELLS
    vertical = "top" if row == 0 else "bottom" if row == rows - 1 else "middle"
    return f"the {vertical} {'left' if column < columns / 3 else 'right' if column >= columns * 2 / 3 else 'centre'}"


def write_camera(report: CameraReport, path: Path) -> None:
    """Write a camera as OpenCV's YAML, or by the suffix as JSON or XML.

    Raises:
        SinkError: The file cannot be written.
        UsageError: The path has another suffix.
    """
    if path.suffix.lower() not in (".yml", ".yaml", ".json", ".xml"):
        raise UsageError(f"--output {path}: expected a name that ends in .yml, .json or .xml")
    camera = report.camera
    storage = cv2.FileStorage(path.suffix.lower(), cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("program", PROGRAM)
    storage.write("image_width", camera.width)
    storage.write("image_height", camera.height)
    storage.write("camera_matrix", camera.matrix())
    if report.fisheye:
        storage.write("fisheye_model", 1)
    storage.write("distortion_coefficients", np.array(report.fisheye or camera.distortion)[None])
    storage.write("avg_reprojection_error", report.error)
    store(path, storage.releaseAndGetString().encode())
