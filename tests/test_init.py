"""A new desk: its folder, its card at true scale, and that it runs."""

from __future__ import annotations

import json
import tomllib

import cv2
import numpy as np
import pypdfium2
import pytest

from warp_ar import init
from warp_ar.calibration.board_finder import recognise_board
from warp_ar.calibration.card import draw_card, write_card
from warp_ar.errors import SceneError
from warp_ar.scene import CharucoBoard, Marker, dumps_scene, load_scene, loads_scene
from warp_ar.signature import is_signed
from warp_ar.tracking import card_layout

pytestmark = pytest.mark.slow

PRINT_MM = 0.15
"""Of the rendered PDF: pixels of a quarter of a millimetre, found by their corners to half of one."""


def test_folder_is_a_scene(tmp_path, capsys):
    assert init.main([str(tmp_path / "my desk"), "--radius", "0.025", "--source", "3"]) == 0
    said = capsys.readouterr().out
    assert said.splitlines()[-1] == f"next: python -m warp_ar.live {tmp_path / 'my desk'}"
    assert "radius" not in said  # it is given
    scene = load_scene(tmp_path / "my desk")
    assert (scene.name, scene.marker) == ("my desk", card_layout.CARD_MARKER)
    assert scene.probes[0].radius == 0.025
    assert scene.probes[0].center == card_layout.ball_center(0.025)
    assert scene.source.camera == 3
    assert scene.camera.field_of_view == 60.0
    assert scene.objects[0].file == (tmp_path / "my desk" / "teapot.ply").resolve()
    lines = (tmp_path / "my desk" / "scene.toml").read_text().splitlines()
    keys = [k for k, line in enumerate(lines) if " = " in line and not line.startswith(("#", "schema", "name"))]
    assert all(lines[k - 1].startswith("#") for k in keys)  # every key says what it is
    assert sorted(path.name for path in (tmp_path / "my desk").iterdir()) == sorted(
        ["scene.toml", "teapot.ply", *(name for name, _, _ in init.CARDS)]
    )
    assert [path.name for path in tmp_path.iterdir()] == ["my desk"]  # nothing is left aside


def test_guessed_camera_fits_any_frame():
    scene = loads_scene('schema = 1\n[camera]\nfield_of_view = 60.0\ntransfer = "gamma:2.2"\n')
    assert loads_scene(dumps_scene(scene)) == scene
    camera = scene.camera.scaled_to(1280, 720)
    assert camera.fx == pytest.approx(640 / np.tan(np.radians(30)))
    assert (camera.cx, camera.cy, camera.transfer) == (639.5, 359.5, "gamma:2.2")
    with pytest.raises(SceneError, match="not used beside field_of_view"):
        loads_scene("schema = 1\n[camera]\nfield_of_view = 60.0\nfx = 3.0\n")


@pytest.mark.parametrize(("paper", "size"), [("a4", (210.0, 297.0)), ("letter", (215.9, 279.4))])
def test_pdf_prints_at_true_scale(paper, size, tmp_path):
    """Rendered back to pixels of a quarter millimetre: board, rulers and paper have their lengths."""
    path = tmp_path / "card.pdf"
    write_card(card_layout.CARD_MARKER, path, paper)
    assert is_signed(path)
    with pypdfium2.PdfDocument(path) as document:
        page = document[0]
        assert np.allclose(np.array(page.get_size()) / 72 * 25.4, size, atol=0.03)
        picture = page.render(scale=4 * 25.4 / 72, grayscale=True).to_numpy().squeeze()
    board = cv2.aruco.CharucoDetector(
        cv2.aruco.CharucoBoard((5, 4), 0.032, 0.024, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
    )
    corners, numbers, _, _ = board.detectBoard(picture)
    assert len(numbers) == 12
    corners = corners.reshape(-1, 2)
    # A picture has whole pixels, so its scale is not quite four to the millimetre.
    scale = np.array(picture.shape[::-1]) / size
    assert np.abs(np.ptp(corners, axis=0) / scale - (3 * 32, 2 * 32)).max() < PRINT_MM
    # The rulers: the longest dark runs along the foot and the left side.
    dark = picture < 128
    assert abs(dark[-60:].sum(1).max() / 4 - 100) < 1
    assert abs(dark[:, :60].sum(0).max() / 4 - 100) < 1


@pytest.mark.parametrize(
    "marker",
    [
        card_layout.CARD_MARKER,
        Marker("DICT_5X5_100", board=CharucoBoard(7, 5, 0.03, 0.022)),
        Marker("DICT_6X6_50", board=CharucoBoard(8, 11, 1.0, 0.7)),
        Marker("DICT_APRILTAG_36h11", board=CharucoBoard(6, 5, 1.0, 0.75)),
    ],
    ids=str,
)
def test_board_is_recognised(marker):
    per_metre = 2500.0 if marker.board.square_length < 1 else 80.0
    card = draw_card(marker, per_metre)
    height, width = card.shape
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    there = np.array([[80, 60], [590, 90], [620, 430], [20, 400]], np.float32)
    matrix = cv2.getPerspectiveTransform(corners, there)
    found = recognise_board(cv2.warpPerspective(card, matrix, (640, 480), borderValue=255, flags=cv2.INTER_AREA))
    assert found.dictionary == marker.dictionary
    assert (found.board.columns, found.board.rows) == (marker.board.columns, marker.board.rows)
    share, wanted = (b.marker_length / b.square_length for b in (found.board, marker.board))
    assert share == pytest.approx(wanted, abs=0.02)


def test_no_board_where_there_is_none():
    assert recognise_board(np.full((480, 640), 128, np.uint8)) is None
    single = draw_card(Marker(), 2000.0)
    assert recognise_board(np.pad(single, 100, constant_values=255)) is None


def test_template_is_toml_with_the_reference_s_words(tmp_path, capsys):
    assert init.main([str(tmp_path / "a"), "--source", "clip.mp4"]) == 0
    assert "Write the ball's radius" in capsys.readouterr().out
    data = tomllib.loads((tmp_path / "a" / "scene.toml").read_text())
    assert data["source"]["path"].endswith("clip.mp4")
    assert json.dumps(data["probe"]["center"]) == json.dumps(list(map(float, card_layout.ball_center(0.035))))
