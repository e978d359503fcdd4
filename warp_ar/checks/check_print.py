"""Check of the printed card's scale by the paper around it, whose size is known.

If the card is printed at 97 %, everything else appears 3 % larger: the print itself cannot show the error, but the
paper can. In units of the print, an A4 sheet printed at 97 % is 216 mm wide, which is nearly the width of Letter.
However, its upper edge is 179 mm from the board's centre, unlike Letter's. The left, right and upper edges of the sheet
are therefore searched near their expected places, along lines across the margin.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from warp_ar.calibration.card import PAPERS
from warp_ar.checks.finding import Finding
from warp_ar.scene import Camera, CharucoBoard, Marker, Pose
from warp_ar.scene.pixel_rays import project
from warp_ar.tracking.card_layout import CARD_BOARD, CARD_MARKER, board_top

Image = NDArray[np.uint8]

OFF: Final = 0.012
"""Largest relative error of a print's scale. Printers cause as much by the feeding of paper."""
SIDES: Final = (0.096, 0.122)
"""Range in metres of the distance from the board's centre to the left or right edge of A4 or Letter, printed at 90 to
110 %."""
UPPER: Final = (0.158, 0.200)
"""Range in metres of the distance from the board's centre to the upper edge."""
STEP: Final = 0.0005
"""Distance in metres between samples across an edge."""
LINES: Final = 24
"""Number of lines across each edge, along which it is searched."""
DARKER: Final = 14.0
"""Smallest difference in 8-bit codes between the paper and its surroundings."""
ALIKE: Final = 0.0012
"""Largest difference in metres between the edge on a line and the median over the lines, for the line to agree."""
AGREE: Final = 0.5
"""Share of the lines that must agree."""
SAME: Final = 0.003
"""Largest difference in metres between the upper edge that is found and that of a paper of the width that is found."""
FEWEST: Final = 2
"""Smallest number of views that show the sheet."""


def card_scale(marker: Marker) -> float | None:
    """Return the ratio of a marker's lengths to those of the printed card; None if it is not that card."""
    board, made = marker.board, CARD_BOARD
    if not isinstance(board, CharucoBoard) or marker.dictionary != CARD_MARKER.dictionary:
        return None
    if (board.columns, board.rows) != (made.columns, made.rows):
        return None
    scale = board.square_length / made.square_length
    return scale if abs(board.marker_length / made.marker_length / scale - 1.0) < 1e-3 else None


def check_print(marker: Marker, camera: Camera, views: Sequence[tuple[Image, Pose]]) -> list[Finding]:
    """Return a finding if the paper contradicts the scale of the marker's lengths.

    Args:
        marker: The scene's marker.
        camera: Camera of the pictures.
        views: Pictures with ``camera_from_world``.
    """
    told = card_scale(marker)
    if told is None:
        return []
    sheets = [sheet for image, pose in views if (sheet := _find_sheet(image, camera, pose)) is not None]
    if len(sheets) < FEWEST:
        return []
    width, upper = (float(value) for value in np.median(sheets, axis=0))
    tried = []
    for paper in ("a4", "letter"):
        paper_width, height = (length / 1e3 for length in PAPERS[paper])
        # True metres per metre in the scene: above 1 if the print is larger than the scene states.
        factor = paper_width / width
        # Printers scale a page about its centre.
        printed = factor * told
        top = (height / 2 - printed * (height / 2 - board_top(height))) / factor
        tried.append((abs(top - upper), factor, paper))
    miss, factor, paper = min(tried)
    if miss > SAME or abs(factor - 1.0) < OFF:
        return []
    right = factor * told
    lengths = f"{CARD_BOARD.square_length * right:.5f} {CARD_BOARD.marker_length * right:.5f}"
    name = "A4" if paper == "a4" else "Letter"
    text = f"the card is printed at {right:.1%}, measured from its {name} paper; [marker] has {told:.1%}"
    remedy = (
        f"measure its rulers, which should be {100 * right:.1f} mm, and write [marker] board = "
        f'"charuco {CARD_BOARD.columns}x{CARD_BOARD.rows} {lengths}"; or print it at 100 %'
    )
    return [Finding("card.print", text, remedy)]


def _find_sheet(image: Image, camera: Camera, pose: Pose) -> tuple[float, float] | None:
    """Return the sheet's width and the distance of its upper edge from the board's centre, in the scene's metres.

    The result is None if one of the edges is not found.
    """
    gray = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), (0, 0), 0.8).astype(np.float32)
    along = np.linspace(-0.05, 0.15, LINES)
    # The middle of the upper edge is left out, because the ball may hide it.
    beside = np.concatenate([np.linspace(-0.09, -0.05, LINES // 2), np.linspace(0.05, 0.09, LINES // 2)])
    sides = [_find_edge(gray, camera, pose, SIDES, [((sign, 0.0), (0.0, y)) for y in along]) for sign in (-1.0, 1.0)]
    upper = _find_edge(gray, camera, pose, UPPER, [((0.0, 1.0), (x, 0.0)) for x in beside])
    if sides[0] is None or sides[1] is None or upper is None:
        return None
    return sides[0] + sides[1], upper


def _find_edge(
    gray: NDArray[np.float32],
    camera: Camera,
    pose: Pose,
    window: tuple[float, float],
    lines: Sequence[tuple[tuple[float, float], tuple[float, float]]],
) -> float | None:
    """Return the distance in metres from the board's centre to an edge of the paper; None if the lines disagree.

    Args:
        gray: The picture in grey.
        camera: Camera of the picture.
        pose: ``camera_from_world``.
        window: Range of distances in metres in which the edge is searched.
        lines: Lines along which the edge is searched, each with direction and start in the board's plane.
    """
    far = np.arange(*window, STEP)
    found = []
    for way, start in lines:
        points = np.array([[start[0] + way[0] * t, start[1] + way[1] * t, 0.0] for t in far])
        pixels = project(camera, pose.apply(points))
        if not ((pixels >= 1) & (pixels <= (gray.shape[1] - 2, gray.shape[0] - 2))).all():
            continue
        values = cv2.remap(gray, pixels.astype(np.float32)[:, None], None, cv2.INTER_LINEAR).ravel()
        # The paper must be bright up to its edge, and its surroundings darker.
        falls = values[:-4] - values[4:]
        k = int(falls.argmax())
        if falls[k] < DARKER or values[: k + 1].min() < values[k + 4] + 0.5 * DARKER:
            continue
        weight = np.clip(values[k : k + 4] - values[k + 1 : k + 5], 0, None)
        found.append(float(far[k] + STEP * (0.5 + (np.arange(4) * weight).sum() / max(weight.sum(), 1e-6))))
    if len(found) < AGREE * len(lines):
        return None
    middle = float(np.median(found))
    near = [value for value in found if abs(value - middle) < ALIKE]
    return float(np.mean(near)) if len(near) >= AGREE * len(lines) else None
