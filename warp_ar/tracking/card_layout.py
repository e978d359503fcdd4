"""Layout of the printed card: one sheet with marker board, white and grey reference patches, and a place for the ball.

The card's board is the scene's marker. It defines the world's frame: the origin is the board's centre, x points right,
y up the page, z out of it. Everything else on the card has a fixed position in that frame, so the centre of the mirror
ball follows from its radius.
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from warp_ar.scene import CharucoBoard, Marker

Image = NDArray[np.uint8]

CARD_BOARD: Final = CharucoBoard(5, 4, 0.032, 0.024)
CARD_MARKER: Final = Marker(dictionary="DICT_4X4_50", board=CARD_BOARD)
"""Board of the card; its few, large cells are resolved by a camera of 640 x 480 at arm's length."""
BALL_PLACE: Final = (0.0, 0.114)
"""Point where the ball touches the card, metres. It is behind the board, so that the ball does not hide the board from
a camera in front."""
RINGS: Final = (0.020, 0.025, 0.030, 0.035, 0.040)
"""Radii in metres of the printed rings around ``BALL_PLACE``. Seen from above, a ball just covers the ring of its own
radius, which shows the radius to the user."""
GREYS: Final = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Fraction of each grey patch that is covered by black dots. With dots instead of grey ink, the reflectance of a patch
does not depend on the printer's tone curve."""
GREY_SIZE: Final = (0.026, 0.010)
"""Width and height of a grey patch, metres."""

_TOP: Final = 0.052
"""Distance in metres from the top of Letter paper to the ball's place. On taller paper the layout is centred: half of
the additional height is at the top."""
_LETTER_HEIGHT: Final = 0.2794
_DOTS: Final = 4
"""Number of dots along each side of the square grid that repeats over a grey patch."""
_DOT: Final = 0.00025
"""Side of a dot in metres: too small for a camera to resolve, but large compared with the spread of ink."""


def grey_centers() -> NDArray[np.float64]:
    """Return the centres of the grey patches, (n, 3) metres in the board's frame, in the order of ``GREYS``."""
    pitch, height = CARD_BOARD.square_length, CARD_BOARD.size[1]
    x = (np.arange(len(GREYS)) - (len(GREYS) - 1) / 2) * pitch
    return np.column_stack([x, np.full(len(GREYS), -(height / 2 + 0.004 + GREY_SIZE[1] / 2)), np.zeros(len(GREYS))])


def ball_center(radius: float) -> tuple[float, float, float]:
    """Return the centre, in metres, of a ball of a radius in metres that stands on its place on the card."""
    return (*BALL_PLACE, radius)


def board_top(height: float) -> float:
    """Return the distance in metres from the upper edge of the paper to the board's centre.

    Args:
        height: Height of the paper, metres.
    """
    return _TOP + BALL_PLACE[1] + (height - _LETTER_HEIGHT) / 2


def draw_page(size: tuple[float, float], pixels_per_metre: float, board: Image) -> Image:
    """Draw the whole page.

    Args:
        size: Width and height of the paper in metres.
        pixels_per_metre: Resolution.
        board: Picture of the board at that resolution, with a white margin on all sides.

    Returns:
        uint8 (h, w), 0 or 255.
    """
    width, height = size
    page = np.full((round(height * pixels_per_metre), round(width * pixels_per_metre)), 255, np.uint8)
    origin = np.array([width / 2, board_top(height)])

    def pixel(x: float, y: float) -> tuple[int, int]:
        """Return column and row of a point in the board's frame."""
        return round((origin[0] + x) * pixels_per_metre), round((origin[1] - y) * pixels_per_metre)

    column, row = pixel(0.0, 0.0)
    top, left = row - board.shape[0] // 2, column - board.shape[1] // 2
    page[top : top + board.shape[0], left : left + board.shape[1]] = board
    for share, center in zip(GREYS, grey_centers(), strict=True):
        half_width, half_height = GREY_SIZE[0] / 2, GREY_SIZE[1] / 2
        (x0, y0), (x1, y1) = (pixel(center[0] + s * half_width, center[1] - s * half_height) for s in (-1, 1))
        page[y0:y1, x0:x1] = _grey(share, (y1 - y0, x1 - x0), round(_DOT * pixels_per_metre))
    _draw_place(page, pixel(*BALL_PLACE), pixels_per_metre)
    _draw_rulers(page, pixels_per_metre)
    return page


def _grey(share: float, shape: tuple[int, int], dot: int) -> Image:
    """Return a grey patch as black dots on white, by ordered dithering with a 4x4 Bayer matrix; uint8, 0 or 255.

    Args:
        share: Fraction of the patch that is black.
        shape: Rows and columns of the patch, pixels.
        dot: Side of a dot, pixels.
    """
    order = np.array([[0, 8, 2, 10], [12, 4, 14, 6], [3, 11, 1, 9], [15, 7, 13, 5]])
    cells = np.where(order < share * _DOTS**2, 0, 255).astype(np.uint8)
    dot = max(dot, 1)
    tile = np.kron(cells, np.ones((dot, dot), np.uint8))
    repeats = [-(-length // side) for length, side in zip(shape, tile.shape, strict=True)]
    return np.tile(tile, repeats)[: shape[0], : shape[1]]


def _draw_place(page: Image, center: tuple[int, int], pixels_per_metre: float) -> None:
    """Draw the cross for the ball and the rings that show its radius."""
    thin = max(1, round(0.00015 * pixels_per_metre))
    for radius in RINGS:
        cv2.circle(page, center, round(radius * pixels_per_metre), 0, thin)
        place = (center[0] + round(0.0006 * pixels_per_metre), center[1] - round((radius - 0.0032) * pixels_per_metre))
        _write(page, f"{1e3 * radius:g}", place, pixels_per_metre, 0.0022)
    arm = round(0.004 * pixels_per_metre)
    cv2.line(page, (center[0] - arm, center[1]), (center[0] + arm, center[1]), 0, thin)
    cv2.line(page, (center[0], center[1] - arm), (center[0], center[1] + arm), 0, thin)


def _draw_rulers(page: Image, pixels_per_metre: float) -> None:
    """Draw the instructions and two rulers of 100 mm, one per direction, because printers scale each separately."""
    mm = pixels_per_metre / 1e3
    thin, left, bottom = max(1, round(0.2 * mm)), round(12 * mm), page.shape[0] - round(12 * mm)
    top = bottom - round(100 * mm)
    page[bottom : bottom + thin, left : left + round(100 * mm)] = 0
    page[top:bottom, left : left + thin] = 0
    for k in range(11):
        length = round((5 if k % 5 == 0 else 3) * mm)
        at = min(left + round(10 * k * mm), left + round(100 * mm) - thin)
        page[bottom - length : bottom, at : at + thin] = 0
        at = min(top + round(10 * k * mm), bottom - thin)
        page[at : at + thin, left : left + length] = 0
    lines = (
        "warp_ar: print at 100 %, not fitted to the page; both rulers are 100 mm. Lay it flat.",
        "Stand the mirror ball on the cross. Rings: its radius in mm. "
        f"Board: {CARD_MARKER.dictionary}, {CARD_MARKER.board}",
    )
    for k, text in enumerate(lines):
        _write(page, text, (left + round(7 * mm), bottom - round((12 - 4 * k) * mm)), pixels_per_metre, 0.0024)


def _write(page: Image, text: str, place: tuple[int, int], pixels_per_metre: float, height: float) -> None:
    """Write text with capitals of ``height`` metres; OpenCV's capitals have 21 pixels at scale 1."""
    scale = height * pixels_per_metre / 21
    cv2.putText(page, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, 0, max(1, round(1.6 * scale)), cv2.LINE_8)
