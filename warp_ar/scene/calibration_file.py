"""Camera calibrations as OpenCV, ROS and the usual scripts write them."""

from __future__ import annotations

import math
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
_WIDTH_NAMES: Final = ("image_width", "image_Width", "width", "imageWidth")
_HEIGHT_NAMES: Final = ("image_height", "image_Height", "height", "imageHeight")
_SIZE_NAMES: Final = ("image_size", "imageSize", "image_Size", "calibImageDimensions", "resolution")
_MATRIX_NAMES: Final = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "CameraMatrix", "K", "mtx", "intrinsics")
_DISTORTION_NAMES: Final = (
    *("distortion_coefficients", "Distortion_Coefficients", "distortionCoefficients", "dist_coeffs", "distCoeffs"),
    *("dist_coeff", "dist", "distortion", "D", "distortion_coeffs"),
)
_MODEL_NAMES: Final = ("distortion_model", "camera_model", "model", "camera_type", "projection_model")
_PINHOLES: Final = ("plumb_bob", "rational_polynomial", "radtan", "pinhole", "opencv", "perspective", "brown_conrady")
_FISHEYES: Final = ("equidistant", "fisheye", "kannala_brandt", "opencv_fisheye", "kannala_brandt4", "equi")
_NOT_DISTORTION: Final = ("distortion_model", "fisheye_model")
WIDEST: Final = 80.0
"""Degrees from the axis to which a fisheye's picture is followed; a pinhole's rays end at 90."""
FISHEYE_ERROR: Final = 0.25
"""Pixels by which the rational model may miss a fisheye's anywhere in the picture."""


def load_calibration(path: str | Path, transfer: str | Path = "srgb") -> Camera:
    """Read a calibration file: OpenCV's YAML, JSON or XML, or ROS's camera_info YAML.

    Args:
        path: The file; keys as OpenCV's and ROS's calibration programs write them (``image_width``,
            ``image_height``, ``camera_matrix``, ``distortion_coefficients`` and their common variants).
        transfer: Encoding of the camera's values, which such files do not hold.

    Raises:
        SceneError: The file is missing, damaged, lacks a key, or holds a camera that is not a pinhole.
    """
    path = Path(path)
    if not is_file(path):
        raise SceneError(f"{path}: no such calibration file")
    text = _checked_text(path)
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        if not storage.isOpened():
            raise SceneError(f"{path}: the calibration cannot be read; expected OpenCV's YAML, JSON or XML")
        found = {
            what: _calibration_numbers(storage, names)
            for what, names in {
                "width": _WIDTH_NAMES,
                "height": _HEIGHT_NAMES,
                "size": _SIZE_NAMES,
                "matrix": _MATRIX_NAMES,
                "distortion": _DISTORTION_NAMES,
            }.items()
        }
        keys = tuple(storage.root().keys()) if storage.root().isMap() else ()
        models = [storage.getNode(key).string() for key in _MODEL_NAMES if key in keys]
        fisheye = "fisheye_model" in keys and storage.getNode("fisheye_model").real() != 0.0
        storage.release()
    except (
        cv2.error,
        SystemError,
    ) as error:  # SystemError: how OpenCV's constructor reports a file that does not parse
        raise SceneError(f"{path}: the calibration cannot be read; expected OpenCV's YAML, JSON or XML") from error

    def fail(names: Sequence[str], value: object, right: str) -> NoReturn:
        shown = " is missing" if value is None else f" = {show_value(value)}"
        raise SceneError(f"{path}: {names[0]}{shown}: {right}")

    size = found["size"] or [*(found["width"] or []), *(found["height"] or [])]
    if len(size) != 2 or not all(1 <= side <= MOST_PIXELS and side == int(side) for side in size):
        fail(
            _WIDTH_NAMES,
            size or None,
            f"expected image_width and image_height, whole numbers to {MOST_PIXELS} (pixels)",
        )
    k = found["matrix"]
    if k is None or len(k) != 9 or not all(map(math.isfinite, k)):
        fail(_MATRIX_NAMES, k, "expected a 3x3 matrix of finite numbers")
    if not (SMALLEST <= k[0] <= LARGEST and SMALLEST <= k[4] <= LARGEST):
        fail(_MATRIX_NAMES, k, "focal lengths must be above 0 (pixels)")
    if any(abs(k[i]) > 1e-9 * k[0] for i in (1, 3, 6, 7)) or abs(k[8] - 1.0) > 1e-9:
        fail(_MATRIX_NAMES, k, "expected [fx, 0, cx, 0, fy, cy, 0, 0, 1]: a camera without skew")
    known = {name.lower() for name in (*_DISTORTION_NAMES, *_NOT_DISTORTION)}
    for key in keys:
        if ("dist" in key.lower() and key.lower() not in known) or key.lower() in ("xi", "mirror_parameters"):
            raise SceneError(f"{path}: {key}: not understood; expected {_DISTORTION_NAMES[0]}: k1 k2 p1 p2 [k3 ...]")
    for model in models:
        plain = model.lower().replace("-", "_").replace(" ", "_")
        if plain in _FISHEYES:
            fisheye = True
        elif plain not in _PINHOLES:
            raise SceneError(
                f"{path}: camera model {model!r} is not understood; expected {', '.join((*_PINHOLES, *_FISHEYES))}"
            )
    distortion = found["distortion"] or Camera.distortion
    if fisheye:
        if len(distortion) != 4 or not all(map(math.isfinite, distortion)):
            fail(_DISTORTION_NAMES, distortion, "expected 4 finite values of a fisheye (k1 k2 k3 k4)")
        shape = int(size[0]), int(size[1])
        try:
            terms = rational_of_fisheye(*shape, np.reshape(k, (3, 3)), distortion)
        except SceneError as error:
            raise SceneError(f"{path}: {error}") from error
        return Camera(*shape, k[0], k[4], k[2], k[5], terms, transfer)
    if len(distortion) > 8 and not any(distortion[8:]):
        distortion = distortion[:8]
    if len(distortion) not in (4, 5, 8) or not all(map(math.isfinite, distortion)):
        fail(_DISTORTION_NAMES, distortion, "expected 4, 5 or 8 finite values (k1 k2 p1 p2 [k3 [k4 k5 k6]])")
    return Camera(int(size[0]), int(size[1]), k[0], k[4], k[2], k[5], tuple(distortion), transfer)


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
        SceneError: The picture looks farther from the axis than ``WIDEST``, the terms fold it over, or no rational
            model meets it within ``FISHEYE_ERROR``.
    """
    corners = np.array([[x, y] for x in (-0.5, width - 0.5) for y in (-0.5, height - 0.5)])
    farthest = float(np.linalg.norm((corners - matrix[:2, 2]) / (matrix[0, 0], matrix[1, 1]), axis=1).max())
    theta = np.linspace(0.0, math.radians(WIDEST), 2001)[1:]
    turned = theta * (1.0 + sum(term * theta ** (2 * n + 2) for n, term in enumerate(terms)))
    count = int(np.searchsorted(turned, farthest)) + 1
    if (np.diff(turned[:count]) <= 0.0).any() or (count >= len(theta) and turned[-1] < farthest):
        raise SceneError(
            f"the fisheye's picture reaches farther than {WIDEST:g} degrees from its axis, which no pinhole follows; "
            "undistort it first, or calibrate a crop of its middle"
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


def _checked_text(path: Path) -> str:
    """A calibration that OpenCV may read: its parsers call themselves at every level, and crash from some depth on."""
    text = read_text(path, SceneError, expected="OpenCV's YAML, JSON or XML")
    start = text.lstrip()[:1]
    depth = tag_depth(text) if start == "<" else bracket_depth(text)
    if start not in ("<", "{", "["):
        depth += indentation_depth(text)
    check_depth(depth, str(path), SceneError)
    if "\0" in text or not start:
        raise SceneError(f"{path}: the calibration cannot be read; expected OpenCV's YAML, JSON or XML")
    return text


def _calibration_numbers(storage: Any, names: Sequence[str]) -> list[float] | None:
    """All numbers under the first of ``names`` that is there, in order; None where none is."""
    for name in names:
        node = storage.getNode(name)
        if not node.empty():
            return _flatten(node)
    return None


def _flatten(node: Any) -> list[float]:
    """Numbers of a matrix, of a map with ``data`` (ROS), of nested lists, or a single one."""
    if node.isMap():
        return _flatten(node.getNode("data"))
    if node.isSeq():
        return [number for i in range(node.size()) for number in _flatten(node.at(i))]
    return [float(node.real())] if node.isReal() or node.isInt() else []
