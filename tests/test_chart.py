"""Colours by a chart: the matrix of a known camera, and the light and the scenes that it gives."""

import cv2
import numpy as np
import pytest

from tests.photo_files import FOCAL_35MM, encode_srgb, write_photo
from tests.photo_room import GAIN, photograph
from tests.test_plate import CORNERS, WIDE, numbers, on_plate, plate
from warp_ar import pose
from warp_ar.calibration.chart import measure_chart
from warp_ar.capture import main
from warp_ar.command_line import EXIT_DONE
from warp_ar.errors import UsageError
from warp_ar.kernels.color import decode_table
from warp_ar.photo_capture import capture_light
from warp_ar.scene import load_scene

PATCHES = """
37.986 13.555 14.059  65.711 18.130 17.810  49.927 -4.880 -21.925  43.139 -13.095 21.905  55.112 8.844 -25.399
70.719 -33.397 -0.199  62.661 36.067 57.096  40.020 10.410 -45.964  51.124 48.239 16.248  30.325 22.976 -21.587
72.532 -23.709 57.255  71.941 19.363 67.857  28.778 14.179 -50.297  55.261 -38.342 31.370  42.101 53.378 28.190
81.733 4.039 79.819  51.935 49.986 -14.574  51.038 -28.631 -28.638  96.539 -0.425 1.186  81.257 -0.638 -0.335
66.766 -0.734 -0.504  50.867 -0.153 -0.270  35.656 -0.421 -1.231  20.461 -0.079 -0.973
"""
"""L, a, b under D50 as the chart's maker states them."""
D50 = np.array([0.9642, 1.0, 0.8249])
SRGB_OF_XYZ = np.array(
    [[3.1338561, -1.6168667, -0.4906146], [-0.9787684, 1.9161415, 0.0334540], [0.0719453, -0.2289914, 1.4052427]]
)
"""From XYZ under D50, adapted to D65 by Bradford's matrix."""
CAMERA = np.array([[1.6, -0.4, -0.1], [-0.25, 1.45, -0.3], [0.05, -0.5, 1.9]])
"""From camera values to linear sRGB."""
TRUE = CAMERA * np.linalg.inv(CAMERA)[1].sum()
"""Which keeps the green of white."""
TOLERANCE = 0.06
"""Of a matrix: 8-bit codes, noise, blur; measured 0.02."""
PLACES = {
    "frontal": ((60, 60), (560, 60), (560, 395), (60, 395)),
    "seen at an angle": ((150, 90), (520, 130), (480, 390), (165, 330)),
    "upside down": ((520, 400), (150, 330), (170, 80), (490, 110)),
}
CODES = decode_table("srgb")


def chart(place, size=(640, 480), gain=0.7, noise=0.003, matrix=CAMERA, slope=0.0):
    """Linear camera values of a chart before a blurred background; ``slope`` is that of its light across it."""
    side, gap = 80, 12
    drawn = np.full((4 * side + 5 * gap, 6 * side + 7 * gap, 3), 0.02, np.float32)
    lightness, a, b = np.array(PATCHES.split(), float).reshape(24, 3).T
    bent = (lightness + 16) / 116 + np.stack([a / 500, 0 * a, -b / 200])
    xyz = np.where(bent > 6 / 29, bent**3, 3 * (6 / 29) ** 2 * (bent - 4 / 29)).T * D50
    patches = xyz @ SRGB_OF_XYZ.T
    for k, patch in enumerate(patches):
        y, x = (gap + at * (side + gap) for at in divmod(k, 6))
        drawn[y : y + side, x : x + side] = patch
    drawn *= 1.0 + slope * np.linspace(-1.0, 1.0, drawn.shape[1], dtype=np.float32)[:, None]
    height, width = drawn.shape[:2]
    corners = np.float32([(0, 0), (width, 0), (width, height), (0, height)])
    to = cv2.getPerspectiveTransform(corners, np.float32(PLACES[place]))
    rng = np.random.default_rng(1)
    around = np.clip(0.3 + 12.0 * cv2.GaussianBlur(rng.normal(0, 0.2, (*size[::-1], 3)), (0, 0), 12), 0.02, 1.0)
    mask = cv2.warpPerspective(np.ones_like(drawn), to, size)
    linear = mask * cv2.warpPerspective(drawn, to, size, flags=cv2.INTER_AREA) + (1.0 - mask) * around
    seen = gain * linear @ np.linalg.inv(matrix).T
    return seen + noise * rng.normal(size=seen.shape) * np.sqrt(0.1 + np.clip(seen, 0, 1))


def measured(linear):
    return measure_chart(encode_srgb(linear).astype(np.uint8), CODES, "a.jpg")


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("noise", [0.003, 0.02])
def test_a_known_matrix_is_found(place, noise):
    matrix, note = measured(chart(place, noise=noise))
    assert np.abs(matrix - TRUE).max() < TOLERANCE
    assert float(note.split("within ")[1].split("%")[0]) < 1.5
    dark, _ = measured(chart(place, gain=0.1))
    assert np.abs(dark - TRUE).max() < TOLERANCE


def test_where_the_matrix_fits_badly_the_greys_give_the_white_balance():
    """Light that doubles across the chart."""
    matrix, note = measured(chart("frontal", matrix=np.diag([1.9, 1.0, 1.5]), slope=0.33))
    assert "only its greys are used" in note
    np.testing.assert_allclose(matrix, np.diag([1.9, 1.0, 1.5]), atol=0.03)


def test_photographs_without_a_proper_chart_are_refused():
    plain = chart("frontal")
    with pytest.raises(UsageError, match=r"a.jpg: the colour chart clips \(code 255\)"):
        measured(2.0 * plain)
    with pytest.raises(UsageError, match=r"a.jpg shows no colour chart"):
        measured(cv2.GaussianBlur(plain, (0, 0), 30))
    with pytest.raises(UsageError, match=r"fit no camera \(off by \d+% of white\)"):
        measured(np.abs(0.6 - chart("frontal", gain=1.0)[..., ::-1]))


@pytest.mark.slow
def test_light_is_written_in_linear_srgb_and_scenes_turn_it_back(tmp_path, capsys):
    linear = GAIN / 120 * photograph()[0].astype(float)
    room = write_photo(tmp_path / "true.jpg", encode_srgb(linear))
    ball = write_photo(tmp_path / "ball.jpg", encode_srgb(linear @ np.linalg.inv(TRUE).T))
    shown = write_photo(tmp_path / "chart.jpg", encode_srgb(chart("seen at an angle")))
    known = {"circle": (272.0, 226.0, 48.5), "reflectance": 0.85, "focal_35mm": FOCAL_35MM, "device": "cpu"}
    known |= {"raises": False, "height": 32}
    true, plain = (capture_light([path], **known).light for path in (room, ball))
    found = capture_light([ball], chart=shown, **known).light
    clear = (true.radiance < 0.9 / 0.85).all(2) & (true.confidence > 0.5) & (true.radiance > 0.05).all(2)
    assert clear.sum() > 200
    off = [np.abs(np.log(light.radiance[clear] / true.radiance[clear])) for light in (found, plain)]
    assert np.median(off[0]) < 0.03 < 0.08 < np.median(off[1])
    np.testing.assert_allclose(
        found.radiance[clear] @ np.reshape(found.colors, (3, 3)).T, plain.radiance[clear], rtol=1e-3
    )

    given = ["--circle", "272.3", "225.6", "49.2", "--contact", "272", "260", "--device", "cpu"]
    files = ["--output", str(tmp_path / "light.exr"), "--scene", str(tmp_path / "ball.toml")]
    assert main([str(ball), *given, *files, "--chart", str(shown)]) == EXIT_DONE
    said = capsys.readouterr()
    assert "light in linear sRGB at the exposure of ball.jpg" in said.out
    assert "the colour chart of" in said.err
    assert load_scene(tmp_path / "ball.toml").captured.colors == pytest.approx(found.colors, abs=1e-4)

    picture, own = (
        plate(tmp_path / "plate.jpg"),
        write_photo(tmp_path / "own.jpg", encode_srgb(chart("frontal", matrix=np.eye(3)))),
    )
    sheet = ["--rectangle", *numbers(*map(on_plate, CORNERS)), "--rectangle-size", *numbers(WIDE)]
    into = [str(picture), *sheet, "--scene", str(tmp_path / "plate.toml"), "--overwrite", "--light"]
    for chart_of_plate, colors in (([], found.colors), (["--chart", str(own)], np.eye(3).ravel())):
        assert pose.main([*into, str(tmp_path / "light.exr"), *chart_of_plate]) == EXIT_DONE
        assert load_scene(tmp_path / "plate.toml").captured.colors == pytest.approx(colors, abs=TOLERANCE)
