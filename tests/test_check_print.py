"""A card that was not printed at true scale is told by its paper."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tests.printed_card import PrintedCard
from tests.rendered_room import look_at
from warp_ar.checks.check_pictures import look_at as look_over
from warp_ar.checks.check_print import card_scale, check_print
from warp_ar.scene import Camera, CharucoBoard, Marker, Pose
from warp_ar.tracking.card_layout import SHEET

CAMERA = Camera(640, 480, 600.0, 600.0, 321.0, 238.0)


def encode(linear):
    return np.clip(linear, 0, 1) ** (1 / 2.2)


def findings(paper, scale, told=1.0, seed=0):
    """What is found where the card is printed at ``scale`` and the scene says ``told``."""
    rng = np.random.default_rng(seed)
    card = PrintedCard(rng, paper=paper, scale=scale)
    images = []
    for k in range(3):
        eye = np.array([0.12 * (k - 1), -0.42, 0.5 + 0.04 * k])
        pose = Pose(*look_at(eye, np.array([0.0, 0.02, 0.0])))
        images.append((card.photograph(CAMERA, pose, 0.7, encode), k / 24))
    board = SHEET.board
    lengths = (board.square_length * told, board.marker_length * told)
    marker = dataclasses.replace(SHEET, board=CharucoBoard(board.columns, board.rows, *lengths))
    look = look_over(marker, CAMERA, images)
    assert len(look.views) == 3
    return check_print(marker, CAMERA, look.views)


@pytest.mark.parametrize(("paper", "scale"), [("a4", 0.97), ("letter", 0.97), ("a4", 0.94), ("letter", 1.04)])
def test_other_scales_are_told(paper, scale):
    (found,) = findings(paper, scale)
    assert found.name == "card.print"
    printed = float(found.text.split("printed at ")[1].split("%")[0])
    assert printed == pytest.approx(100 * scale, abs=0.6)
    assert f"be {printed:.1f} mm" in found.remedy


@pytest.mark.parametrize(
    ("paper", "scale", "told"), [("a4", 1.0, 1.0), ("letter", 1.0, 1.0), ("a4", 0.97, 0.97), ("letter", 1.005, 1.0)]
)
def test_what_the_scene_says_is_no_finding(paper, scale, told):
    assert findings(paper, scale, told, seed=1) == []


def test_other_markers_have_no_known_paper():
    assert card_scale(Marker()) is None
    assert card_scale(SHEET) == 1.0
    assert card_scale(dataclasses.replace(SHEET, dictionary="DICT_5X5_50")) is None
