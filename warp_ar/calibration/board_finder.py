"""Recognition of an unknown ChArUco board: its dictionary, columns, rows, and size of markers relative to squares.

All markers of one dictionary are detected. The ids of a ChArUco board increase along its rows, so a number of columns
determines each marker's place on the board. The right number is the one for which a homography explains the markers'
places in the picture.
"""

from __future__ import annotations

import math
import re
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from warp_ar.scene import CharucoBoard, Marker
from warp_ar.tracking.card_layout import CARD_MARKER
from warp_ar.tracking.markers import Detection, MarkerDetector, find_dictionary

Image = NDArray[np.uint8]

KNOWN: Final = (CARD_MARKER, Marker(dictionary="DICT_5X5_100", board=CharucoBoard(7, 5, 0.03, 0.022)))
"""Boards distributed with this program, whose lengths are known."""
DICTIONARIES: Final = (
    *("DICT_4X4_1000", "DICT_5X5_1000", "DICT_6X6_1000", "DICT_7X7_1000", "DICT_ARUCO_ORIGINAL"),
    *("DICT_APRILTAG_36h11", "DICT_APRILTAG_25h9", "DICT_APRILTAG_16h5", "DICT_ARUCO_MIP_36h12"),
)
"""Dictionaries that are tried; OpenCV's smaller dictionaries are their first entries."""
_FEWEST: Final = 5
"""Smallest number of markers that identify a layout."""
_LAYOUTS: Final = range(3, 15)
"""Numbers of columns that are tried."""
STRAIGHT: Final = 0.04
"""Largest median distance, in marker sides, between a layout's corners and the detected ones. Lens distortion stays
below it; a wrong layout exceeds it several times."""
BENT: Final = 0.3
"""Value of ``STRAIGHT`` for a fisheye: the distance is up to 0.23 for a right layout, 0.7 or more for a wrong one."""


def find_markers(image: Image) -> tuple[str, list[Detection]]:
    """Return the dictionary with the most markers in a picture, and its markers.

    Args:
        image: uint8 RGB or grey.

    Returns:
        The name of OpenCV's smallest dictionary that contains all of them, and the markers; an empty name if there are
        none.
    """
    gray = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
    best: tuple[str, list[Detection]] = ("", [])
    for name in DICTIONARIES:
        found = MarkerDetector(name).detect(gray)
        if len(found) > len(best[1]):
            best = (name, found)
    name, found = best
    return (smallest_dictionary(name, max(d.id for d in found)) if found else "", found)


def smallest_dictionary(name: str, number: int) -> str:
    """Return the smallest dictionary, of the same family as ``name``, that contains a marker's number."""
    if (family := re.fullmatch(r"(DICT_\dX\d)_\d+", name)) is None:
        return name
    return f"{family[1]}_{next(size for size in (50, 100, 250, 1000) if number < size)}"


def recognise_board(image: Image, most_off: float = STRAIGHT) -> Marker | None:
    """Return the ChArUco board in a picture; None if too little of a board is visible.

    A board that is not among ``KNOWN`` gets squares of one metre, because a camera's intrinsics do not depend on their
    length.

    Args:
        image: uint8 RGB or grey.
        most_off: ``STRAIGHT``, or ``BENT`` for a fisheye.
    """
    name, found = find_markers(image)
    if len(found) < _FEWEST or len({d.id for d in found}) < len(found):
        return None
    corners = np.stack([d.corners for d in found]).astype(float)
    side = float(np.median(np.linalg.norm(corners - np.roll(corners, 1, 1), axis=2)))
    for marker in KNOWN:
        assert isinstance(marker.board, CharucoBoard)
        ratio = marker.board.marker_length / marker.board.square_length
        most = max(d.id for d in found)
        if marker.dictionary.rsplit("_", 1)[0] == name.rsplit("_", 1)[0] and most < marker.board.marker_count:
            off, _ = _explain(found, corners, marker.board.columns, 0, ratio)
            if off < most_off * side:
                return marker
    # A board whose top row starts with a marker has OpenCV's layout before 4.6.
    tried = [
        (*_explain(found, corners, columns, first, None), columns, first) for columns in _LAYOUTS for first in (0, 1)
    ]
    off, ratio, columns, first = min(tried)
    if off > most_off * side or not 0.3 < ratio < 0.97:
        return None
    rows = max(3, math.ceil(2 * (max(d.id for d in found) + 1) / columns))
    rows += columns * rows // 2 <= max(d.id for d in found)
    rows += first and rows % 2  # a board with an odd number of rows begins with a black square in both layouts
    name = smallest_dictionary(name, columns * rows // 2 - 1)
    if columns * rows // 2 > len(find_dictionary(name).bytesList):
        return None
    return Marker(dictionary=name, board=CharucoBoard(columns, rows, 1.0, round(ratio, 3), bool(first)))


def _explain(
    found: list[Detection], corners: NDArray[Any], columns: int, first: int, ratio: float | None
) -> tuple[float, float]:
    """Return the median distance in pixels of corners from a layout, and the ratio of marker to square side.

    Args:
        found: The markers.
        corners: Their corners in the picture, (n, 4, 2).
        columns: Squares along x.
        first: 1 if the board's first square is white, else 0.
        ratio: Ratio of marker to square side; None: estimate it, with no more than two homographies.
    """
    squares = [(row, column) for row in range(64) for column in range(columns) if (row + column + first) % 2 == 1]
    if max(d.id for d in found) >= len(squares):
        return math.inf, 0.0
    places = np.array([squares[d.id][::-1] for d in found], float) + 0.5
    if min(np.ptp(places[:, 0]), np.ptp(places[:, 1])) < 1:
        return math.inf, 0.0
    middle = np.array([_crossing(quad) for quad in corners])
    matrix, _ = cv2.findHomography(middle, places, 0)
    if matrix is None:
        return math.inf, 0.0
    flat = cv2.perspectiveTransform(corners.reshape(-1, 1, 2), matrix).reshape(-1, 4, 2) - places[:, None]
    if ratio is None:
        ratio = float(np.median(np.abs(flat))) * 2
    spokes = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * ratio / 2
    matrix, _ = cv2.findHomography((places[:, None] + spokes).reshape(-1, 2), corners.reshape(-1, 2), 0)
    if matrix is None:
        return math.inf, 0.0
    there = cv2.perspectiveTransform((places[:, None] + spokes).reshape(-1, 1, 2), matrix).reshape(-1, 2)
    return float(np.median(np.linalg.norm(there - corners.reshape(-1, 2), axis=1))), ratio


def _crossing(quad: NDArray[Any]) -> NDArray[Any]:
    """Return the intersection of a quadrilateral's diagonals: the projected centre of a square."""
    a, b, c, d = (np.append(corner, 1.0) for corner in quad)
    point = np.cross(np.cross(a, c), np.cross(b, d))
    return np.asarray(point[:2] / point[2])
