"""Markers and boards: dictionaries by name, detection in a picture, and the geometry of the print.

A print is described by its cells (the black and white squares of its markers) and by the borders between black and
white.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from warp_ar.scene import CharucoBoard, Marker, Scene
from warp_ar.scene.description import DICTIONARIES
from warp_ar.scene.geometry import rotation_matrix

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

_WINDOWS = (7, 23)
"""Widths in pixels of the windows of two adaptive thresholds: for sharp small markers, and for large or blurred
ones."""


@dataclasses.dataclass(frozen=True)
class Detection:
    """Marker detected in an image."""

    id: int
    """Id in its dictionary."""
    corners: NDArray[np.float32]
    """Corners, (4, 2) pixels, clockwise from the corner that is printed at the marker's top left."""


def find_dictionary(name: str) -> Any:
    """Return OpenCV's predefined marker dictionary of a name, such as ``"DICT_4X4_50"``."""
    return cv2.aruco.getPredefinedDictionary(DICTIONARIES[name])


def tell_upright(scene: Scene) -> str:
    """Return a note on the orientation of an AprilTag, for which two conventions exist; empty for other markers."""
    marker = scene.marker
    if not (scene.has_marker and marker.dictionary.startswith("DICT_APRILTAG_")) or marker.turn or marker.board:
        return ""
    return (
        f"{marker.dictionary}: the world's axes are those of the marker as OpenCV draws it; the picture of it that "
        "AprilTag's authors publish stands on its head: [marker] turn = 180 takes its axes instead"
    )


def make_board(marker: Marker) -> Any:
    """Return OpenCV's board object for a marker with ``board`` set; its origin is the top left corner, with y down."""
    board = marker.board
    assert board is not None
    dictionary = find_dictionary(marker.dictionary)
    if isinstance(board, CharucoBoard):
        made = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square_length, board.marker_length, dictionary)
        made.setLegacyPattern(board.legacy)
        return made
    return cv2.aruco.GridBoard((board.columns, board.rows), board.marker_length, board.separation, dictionary)


class MarkerDetector:
    """Detector of all markers of a dictionary, with sub-pixel corners.

    Mirrored and inverted prints are not accepted.
    """

    def __init__(self, dictionary: str) -> None:
        parameters = cv2.aruco.DetectorParameters()
        parameters.adaptiveThreshWinSizeMin, parameters.adaptiveThreshWinSizeMax = _WINDOWS
        parameters.adaptiveThreshWinSizeStep = _WINDOWS[1] - _WINDOWS[0]
        # Bits are read from the middle of the cells at twice OpenCV's resolution, and markers at the picture's border
        # are accepted. In a real clip of 145 frames with six markers, all six are found in 119 frames (in 95 with
        # OpenCV's defaults), without false detections.
        parameters.perspectiveRemovePixelPerCell = 8
        parameters.perspectiveRemoveIgnoredMarginPerCell = 0.3
        parameters.minDistanceToBorder = 0
        # Corners have a root mean square error per coordinate of 0.65 pixel unrefined, 0.75 refined by contour lines
        # and 0.28 refined by gradients (used here), measured on path-traced pictures with known poses. Corners of
        # AprilTag's quads are off by 0.45 pixel in x and y. The edge fit refines the pose further.
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        self._parameters = parameters
        self._detector = cv2.aruco.ArucoDetector(find_dictionary(dictionary), parameters)

    def detect(self, gray: Image, smallest: float = 10.0, *, sharp: bool = False) -> list[Detection]:
        """Return the markers in a uint8 (h, w) image, in OpenCV's order.

        Args:
            gray: The image.
            smallest: Mean side length in pixels of the smallest marker that must be found. A large value saves most of
                the time.
            sharp: True to use the narrow threshold only, which takes half the time but misses blurred markers.
        """
        self._parameters.adaptiveThreshWinSizeMax = _WINDOWS[0 if sharp else 1]
        # OpenCV expects the perimeter relative to the longer image side.
        self._parameters.minMarkerPerimeterRate = 4 * smallest / max(gray.shape)
        self._detector.setDetectorParameters(self._parameters)
        corners, ids, _ = self._detector.detectMarkers(gray)
        if ids is None:
            return []
        return [
            Detection(int(i), np.asarray(c, np.float32).reshape(4, 2))
            for i, c in zip(np.ravel(ids), corners, strict=True)
        ]


@dataclasses.dataclass(frozen=True)
class Pattern:
    """Geometry of a print in its marker's frame, in metres, with m points on borders and c cells."""

    markers: dict[int, Array]
    """Corners (4, 3) of each marker by its id, clockwise from top left."""
    outline: Array
    """Outer corners (4, 3) of the whole print."""
    points: Array
    """Points on the borders between black and white, (m, 3)."""
    tangents: Array
    """Unit direction of the border at each point, (m, 3)."""
    normals: Array
    """Unit direction toward the white side at each point, (m, 3)."""
    clearances: Array
    """Distance in metres from each point to the nearest parallel border, (m,)."""
    cells: Array
    """Centres of the cells, (c, 3)."""
    white: NDArray[np.bool_]
    """True where a cell is white, (c,)."""
    side: float
    """Side of a cell in metres."""


def _cell_edges(
    cells: NDArray[np.bool_], left: float, top: float, size: float, clearance: float
) -> list[tuple[float, ...]]:
    """Return the borders between black and white cells of a grid.

    Args:
        cells: Mask of white cells, (rows, columns).
        left: x of the grid's left side, metres.
        top: y of the grid's upper side, metres.
        size: Side of a cell, metres.
        clearance: Distance from each border to the nearest parallel one, metres.

    Returns:
        For each border: middle (x, y), unit tangent (x, y), unit normal toward white (x, y), length and clearance.
    """
    edges: list[tuple[float, ...]] = []
    for row, column in np.argwhere(cells[:, 1:] != cells[:, :-1]):
        sign = 1.0 if cells[row, column + 1] else -1.0
        edges.append((left + (column + 1) * size, top - (row + 0.5) * size, 0, 1, sign, 0, size, clearance))
    for row, column in np.argwhere(cells[1:] != cells[:-1]):
        sign = -1.0 if cells[row + 1, column] else 1.0
        edges.append((left + (column + 0.5) * size, top - (row + 1) * size, 1, 0, 0, sign, size, clearance))
    return edges


def _edge_points(edges: Array) -> tuple[Array, Array, Array, Array]:
    """Return points on borders with their tangents and normals, (m, 3) each, and clearances, (m,).

    Args:
        edges: Borders as returned by ``_cell_edges``, (n, 8).
    """
    # Points lie in the middle part of a border, because the blur of other borders interferes at its ends.
    count = int(np.clip(240 // len(edges), 1, 4))
    along = np.linspace(-0.3, 0.3, count) if count > 1 else np.zeros(1)
    edges = np.repeat(edges[:: -(-len(edges) // 300)], count, axis=0)
    shift = np.tile(along, len(edges) // count) * edges[:, 6]
    flat = np.zeros((len(edges), 1))
    tangents, normals = np.hstack([edges[:, 2:4], flat]), np.hstack([edges[:, 4:6], flat])
    return np.hstack([edges[:, :2], flat]) + tangents * shift[:, None], tangents, normals, edges[:, 7]


@functools.cache
def pattern_of(marker: Marker) -> Pattern:
    """Return the geometry of a marker's or board's print."""
    size, board, turn = marker.size, marker.board, marker.turn
    book = find_dictionary(marker.dictionary)
    bits = int(book.markerSize) + 2
    edges: list[tuple[float, ...]] = []
    if board is None:
        places, width, height, margin = {marker.id: (-size / 2, size / 2)}, size, size, size / bits
    else:
        printed = make_board(marker)
        size, (width, height) = board.marker_length, board.size
        places = {
            int(number): (float(corners[0][0]) - width / 2, height / 2 - float(corners[0][1]))
            for number, corners in zip(np.ravel(printed.getIds()), printed.getObjPoints(), strict=True)
        }
        if isinstance(board, CharucoBoard):
            # The top left square is black, except in OpenCV's layout before 4.6 with an even number of rows.
            first = int(board.legacy and board.rows % 2 == 0)
            squares = (np.add.outer(np.arange(board.rows), np.arange(board.columns) + first) % 2).astype(bool)
            square = board.square_length
            margin = (square - size) / 2
            edges += _cell_edges(squares, -width / 2, height / 2, square, min(margin, square / 2))
        else:
            margin = board.separation
    cell = size / bits
    margin = min(margin, cell)
    centres, white = [], []
    for number, (left, top) in places.items():
        image = cv2.aruco.generateImageMarker(book, number, bits, borderBits=1)
        pattern = np.pad(np.asarray(image) > 127, 1, constant_values=True)
        edges += _cell_edges(pattern, left - cell, top + cell, cell, margin)
        rows_, columns_ = np.indices((bits, bits))
        centres.append(
            np.stack([left + (columns_ + 0.5) * cell, top - (rows_ + 0.5) * cell, 0.0 * rows_], -1).reshape(-1, 3)
        )
        white.append(pattern[1:-1, 1:-1].ravel())
    points, tangents, normals, clearances = _edge_points(np.array(edges, float))
    corners = {n: _square(x + size / 2, y - size / 2, size, size) for n, (x, y) in places.items()}
    turned = np.round(rotation_matrix((0.0, 0.0, turn))).T  # transposed, because each row of the arrays is a point
    return Pattern(
        markers={number: square @ turned for number, square in corners.items()},
        outline=_square(0.0, 0.0, *((width, height) if turn % 180 == 0 else (height, width))),
        points=points @ turned,
        tangents=tangents @ turned,
        normals=normals @ turned,
        clearances=clearances,
        cells=np.concatenate(centres) @ turned,
        white=np.concatenate(white),
        side=cell,
    )


def _square(x: float, y: float, width: float, height: float) -> Array:
    w, h = width / 2, height / 2
    return np.array([[x - w, y + h, 0.0], [x + w, y + h, 0.0], [x + w, y - h, 0.0], [x - w, y - h, 0.0]])
