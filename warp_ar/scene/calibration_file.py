"""Camera calibrations as OpenCV, ROS and the usual scripts write them."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NoReturn

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.errors import SceneError
from warp_ar.files import bracket_depth, check_depth, indentation_depth, is_file, read_text, tag_depth
from warp_ar.scene.description import Camera
from warp_ar.scene.messages import LARGEST, MOST_PIXELS, SMALLEST, show_value

# Keys as OpenCV's, ROS's, ArUco's and the usual Python scripts write them.
_WIDTH_NAMES: Final = ("image_width", "image_Width", "width", "imageWidth", "w")
_HEIGHT_NAMES: Final = ("image_height", "image_Height", "height", "imageHeight", "h")
_SIZE_NAMES: Final = ("image_size", "imageSize", "image_Size", "calibImageDimensions", "resolution")
_MATRIX_NAMES: Final = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "CameraMatrix", "K", "mtx", "intrinsics")
_SINGLE_NAMES: Final = (("fx", "fl_x"), ("fy", "fl_y", "fl_x"), ("cx", "ppx"), ("cy", "ppy"))
_DISTORTION_NAMES: Final = (
    *("distortion_coefficients", "Distortion_Coefficients", "distortionCoefficients", "dist_coeffs", "distCoeffs"),
    *("dist_coeff", "dist", "distortion", "D", "distortion_coeffs", "coeffs"),
)
_TERMS: Final = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_MODEL_NAMES: Final = ("distortion_model", "camera_model", "model", "camera_type", "projection_model")
_PINHOLES: Final = (
    *("plumb_bob", "rational_polynomial", "radtan", "pinhole", "opencv", "perspective", "brown_conrady", "none", ""),
    *("simple_pinhole", "simple_radial", "radial", "full_opencv"),
)
_FISHEYES: Final = (
    *("equidistant", "fisheye", "kannala_brandt", "opencv_fisheye", "kannala_brandt4", "equi"),
    *("simple_radial_fisheye", "radial_fisheye"),
)
_COLMAP: Final = {
    "SIMPLE_PINHOLE": "fl_x cx cy",
    "PINHOLE": "fl_x fl_y cx cy",
    "SIMPLE_RADIAL": "fl_x cx cy k1",
    "SIMPLE_RADIAL_FISHEYE": "fl_x cx cy k1",
    "RADIAL": "fl_x cx cy k1 k2",
    "RADIAL_FISHEYE": "fl_x cx cy k1 k2",
    "OPENCV": "fl_x fl_y cx cy k1 k2 p1 p2",
    "OPENCV_FISHEYE": "fl_x fl_y cx cy k1 k2 k3 k4",
    "FULL_OPENCV": "fl_x fl_y cx cy k1 k2 p1 p2 k3 k4 k5 k6",
}
"""Parameters of COLMAP's models, in the order of its lists."""
WIDEST: Final = 80.0
"""Degrees from the axis to which a fisheye's picture is followed; a pinhole's rays end at 90."""
FISHEYE_ERROR: Final = 0.25
"""Pixels by which the rational model may miss a fisheye's anywhere in the picture."""
_EXPECTED: Final = "OpenCV's YAML, JSON or XML"


def load_calibration(path: str | Path, transfer: str | Path = "srgb") -> Camera:
    """Read a calibration file: OpenCV's YAML, JSON or XML, ROS's camera_info, Kalibr's camchain, COLMAP's cameras.txt.

    Follows:
        size; camera matrix, or fx fy cx cy; distortion of 4, 5 or 8 terms; keys of OpenCV, ROS, Kalibr, ArUco, NeRF;
        fisheyes to 80 degrees from the axis, as a rational model within 0.25 pixels.

    Args:
        path: The file.
        transfer: Encoding of the camera's values, which such files do not hold.

    Raises:
        SceneError: Damaged; missing keys; several cameras; skew; other models; other keys of distortion; wider
            fisheyes.
    """
    path = Path(path)
    if not is_file(path):
        raise SceneError(f"{path}: no such calibration file")
    tree = _read_tree(path)

    def numbers(names: Sequence[str]) -> list[float] | None:
        return next((_flatten(tree[name]) for name in names if name in tree), None)

    def fail(names: Sequence[str], value: object, right: str) -> NoReturn:
        shown = " is missing" if value is None else f" = {show_value(value)}"
        raise SceneError(f"{path}: {names[0]}{shown}: {right}")

    size = numbers(_SIZE_NAMES) or [*(numbers(_WIDTH_NAMES) or []), *(numbers(_HEIGHT_NAMES) or [])]
    if len(size) != 2 or not all(1 <= side <= MOST_PIXELS and side == int(side) for side in size):
        right = f"expected image_width and image_height, whole numbers to {MOST_PIXELS} (pixels)"
        fail(_WIDTH_NAMES, size or None, right)
    known = {name.lower() for name in (*_DISTORTION_NAMES, *_MODEL_NAMES)}
    for key in tree:
        if key.lower() not in known and re.search("dist|coef|^xi$|^mirror_parameters$", key.lower()):
            raise SceneError(f"{path}: {key}: not understood; expected {_DISTORTION_NAMES[0]}: k1 k2 p1 p2 [k3 ...]")
    fisheye = any("fisheye" in key.lower() and tree[key] not in (0.0, "false", "") for key in tree)
    for model in (str(tree[name]) for name in _MODEL_NAMES if name in tree):
        plain = model.lower().replace("-", "_").replace(" ", "_")
        fisheye |= plain in _FISHEYES
        if plain not in (*_FISHEYES, *_PINHOLES):
            expected = ", ".join(filter(None, (*_PINHOLES, *_FISHEYES)))
            raise SceneError(f"{path}: camera model {model!r} is not understood; expected {expected}")
    k = numbers(_MATRIX_NAMES)
    singles = [value for names in _SINGLE_NAMES for value in numbers(names) or []]
    if k is None or len(k) == 4:
        fx, fy, cx, cy = k or (singles if len(singles) == 4 else [math.nan] * 4)
        middle = 0.5 if k is None and "fl_x" in tree else 0.0  # COLMAP's pixel centres lie at halves, so NeRF's do
        k = None if math.isnan(fx) else [fx, 0.0, cx - middle, 0.0, fy, cy - middle, 0.0, 0.0, 1.0]
    if k is None or len(k) != 9 or not all(map(math.isfinite, k)):
        fail(_MATRIX_NAMES, k, "expected a 3x3 matrix of finite numbers")
    if not (SMALLEST <= k[0] <= LARGEST and SMALLEST <= k[4] <= LARGEST):
        fail(_MATRIX_NAMES, k, "focal lengths must be above 0 (pixels)")
    if any(abs(k[i]) > 1e-9 * k[0] for i in (1, 3, 6, 7)) or abs(k[8] - 1.0) > 1e-9:
        fail(_MATRIX_NAMES, k, "expected [fx, 0, cx, 0, fy, cy, 0, 0, 1]: a camera without skew")
    terms = ("k1", "k2", "k3", "k4") if fisheye else _TERMS
    distortion = numbers(_DISTORTION_NAMES)
    if not distortion and any(term in tree for term in _TERMS):
        distortion = [sum(numbers([term]) or []) for term in terms]
    distortion = distortion or list(Camera.distortion)
    shape = int(size[0]), int(size[1])
    finite = all(map(math.isfinite, distortion))
    if fisheye:
        if len(distortion) != 4 or not finite:
            fail(_DISTORTION_NAMES, distortion, "expected 4 finite values of a fisheye (k1 k2 k3 k4)")
        try:
            distortion = list(rational_of_fisheye(*shape, np.reshape(k, (3, 3)), distortion))
        except SceneError as error:
            raise SceneError(f"{path}: {error}") from error
    if len(distortion) > 8 and not any(distortion[8:]):
        distortion = distortion[:8]
    if len(distortion) not in (4, 5, 8) or not finite:
        fail(_DISTORTION_NAMES, distortion, "expected 4, 5 or 8 finite values (k1 k2 p1 p2 [k3 [k4 k5 k6]])")
    return Camera(*shape, k[0], k[4], k[2], k[5], tuple(distortion), transfer)


def rational_of_fisheye(
    width: int, height: int, matrix: npt.NDArray[np.float64], terms: Sequence[float]
) -> tuple[float, ...]:
    """Return OpenCV's k1 k2 p1 p2 k3 k4 k5 k6 that project as a fisheye does, over the whole picture.

    A fisheye [KB06] puts a point at the angle t from the axis at f (t + k1 t^3 + k2 t^5 + k3 t^7 + k4 t^9). With r =
    tan t, the radial factor (t + ...) / r is fitted by (1 + a1 r^2 + a2 r^4 + a3 r^6) / (1 + b1 r^2 + b2 r^4 + b3 r^6):
    atan(r) / r has Pade approximants that converge for all r.

    References:
        [KB06] J. Kannala and S. Brandt. A generic camera model and calibration method for conventional, wide-angle, and
        fish-eye lenses. PAMI 2006.

    Args:
        width: Width of the picture in pixels.
        height: Height of the picture in pixels.
        matrix: Camera matrix, (3, 3).
        terms: k1 k2 k3 k4 of the fisheye.

    Raises:
        SceneError: The picture looks farther from the axis than ``WIDEST`` (the message has a crop that does not), the
            terms fold it over, or no rational model meets it within ``FISHEYE_ERROR``.
    """
    corners = np.array([[x, y] for x in (-0.5, width - 0.5) for y in (-0.5, height - 0.5)])
    farthest = float(np.linalg.norm((corners - matrix[:2, 2]) / (matrix[0, 0], matrix[1, 1]), axis=1).max())
    theta = np.linspace(0.0, math.pi, 4001)[1:]
    turned = theta * (1.0 + sum(term * theta ** (2 * n + 2) for n, term in enumerate(terms)))
    rising = int(np.argmin(np.append(np.diff(turned), -1.0) > 0.0)) + 1  # from there on the terms fold the picture over
    theta, turned = theta[:rising], turned[:rising]
    count = int(np.searchsorted(turned, farthest)) + 1
    if count > rising or theta[count - 1] > math.radians(WIDEST):
        reach = f"{math.degrees(theta[min(count, rising) - 1]):.0f} degrees" + " and more" * (count > rising)
        share = float(np.interp(math.radians(WIDEST - 2.0), theta, turned)) / farthest  # the fit is worst at the rim
        raise SceneError(
            f"the fisheye's picture reaches {reach} from its axis; expected {WIDEST:g} at most, which a pinhole can "
            f"follow: crop frames and calibration to {int(share * width)}x{int(share * height)} around the principal "
            "point, or undistort the frames first (cv2.fisheye)"
        )
    theta, turned = theta[:count], turned[:count]
    radius = np.tan(theta)
    wanted, square = turned / radius, radius**2
    powers = np.stack([square, square**2, square**3], 1)
    weight = np.ones(len(theta))
    for _ in range(20):  # of the linearised equation, reweighted by its denominator
        rows = np.concatenate([powers, -wanted[:, None] * powers], 1) * (weight * radius)[:, None]
        scale = np.abs(rows).max(0)
        found = np.linalg.lstsq(rows / scale, (wanted - 1.0) * weight * radius, rcond=1e-15)[0] / scale
        weight = 1.0 / np.abs(1.0 + powers @ found[3:])
    factor = (1.0 + powers @ found[:3]) / (1.0 + powers @ found[3:])
    off = float(np.abs(factor * radius - turned).max()) * max(matrix[0, 0], matrix[1, 1])
    if not off < FISHEYE_ERROR:
        raise SceneError(f"the fisheye's model is met within {off:.2f} pixels only; expected {FISHEYE_ERROR:g}")
    k1, k2, k3, k4, k5, k6 = map(float, found)
    return k1, k2, 0.0, 0.0, k3, k4, k5, k6


def _read_tree(path: Path) -> dict[str, Any]:
    """Return the keys of a calibration with numbers, texts, lists and maps."""
    text = read_text(path, SceneError, expected=_EXPECTED)
    told = re.findall(r"(?m)^\s*\d+\s+([A-Z_]+)\s+(\d+)\s+(\d+)((?:\s+[-+.\deE]+)+)\s*$", text)
    cameras: dict[str, Any] = {}
    for model, width, height, rest in told if path.suffix.lower() == ".txt" else ():
        values = [float(word) for word in rest.split()]
        named = dict(zip(_COLMAP.get(model, "").split(), values, strict=False))
        size = {"width": float(width), "height": float(height)}
        cameras[f"camera {len(cameras)}"] = {"camera_model": model, **size, **named}
    tree = cameras or _by_opencv(path, text)
    inner = [key for key, value in tree.items() if isinstance(value, dict) and "data" not in value]
    if len(inner) == len(tree) > 1:
        raise SceneError(f"{path}: holds {len(tree)} cameras ({', '.join(inner[:4])}); keep the one of the frames")
    result: dict[str, Any] = tree[inner[0]] if len(inner) == len(tree) == 1 else tree
    return result


def _by_opencv(path: Path, text: str) -> dict[str, Any]:
    """Return what OpenCV reads, whose parsers call themselves at every level, and crash from some depth on."""
    start = text.lstrip()[:1]
    depth = tag_depth(text) if start == "<" else bracket_depth(text)
    if start not in ("<", "{", "["):
        depth += indentation_depth(text)
    check_depth(depth, str(path), SceneError)
    wrong = f"{path}: the calibration cannot be read; expected {_EXPECTED}"
    if "\0" in text or not start:
        raise SceneError(wrong)
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        tree = _plain(storage.root()) if storage.isOpened() else None
        storage.release()
    except (cv2.error, SystemError) as error:  # SystemError: how its constructor reports a file that does not parse
        raise SceneError(wrong) from error
    if not isinstance(tree, dict):
        raise SceneError(wrong)
    return tree


def _plain(node: Any) -> Any:
    """Return a node as maps, lists, numbers and texts."""
    if node.isMap():
        return {key: _plain(node.getNode(key)) for key in node.keys()}  # noqa: SIM118
    if node.isSeq():
        return [_plain(node.at(index)) for index in range(node.size())]
    return node.string() if node.isString() else float(node.real()) if node.isReal() or node.isInt() else None


def _flatten(value: Any) -> list[float]:
    """Numbers of a matrix, of a map with ``data`` (ROS), of nested lists, or a single one."""
    if isinstance(value, dict):
        return _flatten(value.get("data"))
    if isinstance(value, list):
        return [number for entry in value for number in _flatten(entry)]
    return [value] if isinstance(value, float) else []
