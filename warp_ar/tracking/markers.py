"""Markers and boards: dictionaries by name, and where they are found in a picture."""

from __future__ import annotations

import dataclasses
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from warp_ar.errors import UsageError
from warp_ar.scene import CharucoBoard, Marker

Image = NDArray[np.uint8]

_WINDOWS = (7, 23)
"""Widths in pixels of the two adaptive thresholds: sharp small markers, and large or blurred ones."""


@dataclasses.dataclass(frozen=True)
class Detection:
    """One marker found in an image."""

    id: int
    """Number in its dictionary."""
    corners: NDArray[np.float32]
    """(4, 2) pixels, clockwise from the marker's own top left."""


def find_dictionary(name: str) -> Any:
    """OpenCV's predefined marker dictionary of that name.

    Args:
        name: such as ``"DICT_4X4_50"`` or ``"DICT_APRILTAG_36h11"``.

    Raises:
        UsageError: if OpenCV has none of that name.
    """
    number = getattr(cv2.aruco, name, None) if name.startswith("DICT_") else None
    if not isinstance(number, int):
        known = ", ".join(sorted(key for key in dir(cv2.aruco) if key.startswith("DICT_")))
        raise UsageError(f"marker dictionary: OpenCV has no {name!r}; it has {known}")
    return cv2.aruco.getPredefinedDictionary(number)


def make_board(marker: Marker) -> Any:
    """OpenCV's board object for a marker with ``board`` set; its own axes start at the top left, y down.

    Raises:
        UsageError: if the dictionary holds too few markers, or none of that name exists.
    """
    board = marker.board
    assert board is not None
    dictionary = find_dictionary(marker.dictionary)
    available = len(dictionary.bytesList)
    if available < board.marker_count:
        raise UsageError(
            f"marker board: {board} needs {board.marker_count} markers; {marker.dictionary} has {available}"
        )
    if isinstance(board, CharucoBoard):
        made = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square_length, board.marker_length, dictionary)
        made.setLegacyPattern(board.legacy)
        return made
    return cv2.aruco.GridBoard((board.columns, board.rows), board.marker_length, board.separation, dictionary)


class MarkerDetector:
    """Finds every marker of a dictionary, with sub-pixel corners; mirrored and inverted prints are not accepted."""

    def __init__(self, dictionary: str) -> None:
        parameters = cv2.aruco.DetectorParameters()
        parameters.adaptiveThreshWinSizeMin, parameters.adaptiveThreshWinSizeMax = _WINDOWS
        parameters.adaptiveThreshWinSizeStep = _WINDOWS[1] - _WINDOWS[0]
        # Cells read from their middle, at twice OpenCV's resolution, and markers at the border taken: on a real clip of
        # six markers and 145 frames, 119 frames show all six, where OpenCV's defaults show 95, and no other marker is
        # seen.
        parameters.perspectiveRemovePixelPerCell = 8
        parameters.perspectiveRemoveIgnoredMarginPerCell = 0.3
        parameters.minDistanceToBorder = 0
        # Against path-traced poses, root mean square per coordinate: 0.65 pixel unrefined, 0.75 by contour lines,
        # 0.28 by gradients (this one); AprilTag's quads are 0.45 pixel off in x and y. Edges refine the rest.
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        self._parameters = parameters
        self._detector = cv2.aruco.ArucoDetector(find_dictionary(dictionary), parameters)

    def detect(self, gray: Image, smallest: float = 10.0, *, sharp: bool = False) -> list[Detection]:
        """Markers in a uint8 (h, w) image, in OpenCV's order.

        Args:
            gray: the image.
            smallest: mean edge length in pixels of the smallest marker of interest; most time goes into what is
                smaller.
            sharp: Whether the narrow threshold alone is tried, which does not see what is blurred: half the time.
        """
        self._parameters.adaptiveThreshWinSizeMax = _WINDOWS[0 if sharp else 1]
        # OpenCV counts in shares of the longer image side.
        self._parameters.minMarkerPerimeterRate = 4 * smallest / max(gray.shape)
        self._detector.setDetectorParameters(self._parameters)
        corners, ids, _ = self._detector.detectMarkers(gray)
        if ids is None:
            return []
        return [
            Detection(int(i), np.asarray(c, np.float32).reshape(4, 2))
            for i, c in zip(np.ravel(ids), corners, strict=True)
        ]
