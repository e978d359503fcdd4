"""What is printed where on a marker or board: its cells, and the borders between black and white."""

from __future__ import annotations

import dataclasses
import functools

import cv2
import numpy as np
from numpy.typing import NDArray

from warp_ar.errors import UsageError
from warp_ar.scene import CharucoBoard, GridBoard, Marker
from warp_ar.tracking.markers import find_dictionary, make_board

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Pattern:
    """The print as geometry, in the world's frame: m edge points, c cells."""

    markers: dict[int, Array]
    """Corners (4, 3) of each marker by its id, clockwise from top left."""
    outline: Array
    """Corners (4, 3) of the whole."""
    points: Array
    """Points on the borders between black and white, (m, 3)."""
    tangents: Array
    """Unit direction of the border at each point, (m, 3)."""
    normals: Array
    """Unit direction toward white, (m, 3)."""
    clearances: Array
    """Distance to the nearest parallel border, (m,) metres."""
    cells: Array
    """Centres of cells, (c, 3)."""
    white: Array
    """1 where a cell is white, 0 where black, (c,)."""


def _cell_edges(
    cells: NDArray[np.bool_], left: float, top: float, size: float, clearance: float
) -> list[tuple[float, ...]]:
    """Borders between cells that differ: rows of middle (x, y), tangent, normal toward white, length, clearance."""
    edges: list[tuple[float, ...]] = []
    for row, column in np.argwhere(cells[:, 1:] != cells[:, :-1]):
        sign = 1.0 if cells[row, column + 1] else -1.0
        edges.append((left + (column + 1) * size, top - (row + 0.5) * size, 0, 1, sign, 0, size, clearance))
    for row, column in np.argwhere(cells[1:] != cells[:-1]):
        sign = -1.0 if cells[row + 1, column] else 1.0
        edges.append((left + (column + 0.5) * size, top - (row + 1) * size, 1, 0, 0, sign, size, clearance))
    return edges


def _edge_points(edges: Array) -> tuple[Array, Array, Array, Array]:
    """Points on edges with their tangents and normals, (m, 3) each, and clearances, (m,).

    Args:
        edges: Rows as ``_cell_edges`` gives them, (n, 8).
    """
    # Inner points of an edge only: its ends are corners, where another edge's blur is near.
    count = int(np.clip(240 // len(edges), 1, 4))
    along = np.linspace(-0.3, 0.3, count) if count > 1 else np.zeros(1)
    edges = np.repeat(edges[:: -(-len(edges) // 300)], count, axis=0)
    shift = np.tile(along, len(edges) // count) * edges[:, 6]
    flat = np.zeros((len(edges), 1))
    tangents, normals = np.hstack([edges[:, 2:4], flat]), np.hstack([edges[:, 4:6], flat])
    return np.hstack([edges[:, :2], flat]) + tangents * shift[:, None], tangents, normals, edges[:, 7]


@functools.cache
def make_pattern(dictionary: str, id: int, size: float, board: CharucoBoard | GridBoard | None) -> Pattern:
    """What a marker or board shows.

    Args:
        dictionary: Name of OpenCV's dictionary.
        id: Number of the marker, where there is no board.
        size: Side of its black square in metres, where there is no board.
        board: The board, if there is one.

    Raises:
        UsageError: There is no such marker, or its size is impossible.
    """
    book = find_dictionary(dictionary)
    bits = int(book.markerSize) + 2
    edges: list[tuple[float, ...]] = []
    if board is None:
        if not 0 <= id < len(book.bytesList):
            raise UsageError(f"marker id: {dictionary} has ids 0 to {len(book.bytesList) - 1}, not {id}")
        if not (np.isfinite(size) and size > 0):
            raise UsageError(f"marker size: {size} should be the edge length in metres, above 0")
        places, width, height, margin = {id: (-size / 2, size / 2)}, size, size, size / bits
    else:
        printed = make_board(Marker(dictionary, board=board))
        size, (width, height) = board.marker_length, board.size
        places = {
            int(number): (float(corners[0][0]) - width / 2, height / 2 - float(corners[0][1]))
            for number, corners in zip(np.ravel(printed.getIds()), printed.getObjPoints(), strict=True)
        }
        if isinstance(board, CharucoBoard):
            # The top left square is black, but for boards of an even number of rows in OpenCV's layout before 4.6.
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
    return Pattern(
        markers=corners,
        outline=_square(0.0, 0.0, width, height),
        points=points,
        tangents=tangents,
        normals=normals,
        clearances=clearances,
        cells=np.concatenate(centres),
        white=np.concatenate(white).astype(float),
    )


def printed_cells(marker: Marker) -> tuple[Array, NDArray[np.bool_], float, Array]:
    """What is printed where.

    Args:
        marker: Marker or board.

    Returns:
        Centres of all cells (c, 3), which of them are white (c,), the side of a cell in metres, and the whole's
        corners (4, 3).
    """
    pattern = make_pattern(marker.dictionary, marker.id, marker.size, marker.board)
    size = marker.size if marker.board is None else marker.board.marker_length
    side = size / (int(find_dictionary(marker.dictionary).markerSize) + 2)
    return pattern.cells, pattern.white > 0.5, side, pattern.outline


def _square(x: float, y: float, width: float, height: float) -> Array:
    w, h = width / 2, height / 2
    return np.array([[x - w, y + h, 0.0], [x + w, y + h, 0.0], [x + w, y - h, 0.0], [x - w, y - h, 0.0]])
