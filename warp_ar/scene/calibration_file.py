"""Camera calibrations as OpenCV, ROS and the usual scripts write them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NoReturn

import cv2

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
    *("dist_coeff", "dist", "distortion", "D"),
)


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
    distortion = found["distortion"] or Camera.distortion
    if len(distortion) > 8 and not any(distortion[8:]):
        distortion = distortion[:8]
    if len(distortion) not in (4, 5, 8) or not all(map(math.isfinite, distortion)):
        fail(_DISTORTION_NAMES, distortion, "expected 4, 5 or 8 finite values (k1 k2 p1 p2 [k3 [k4 k5 k6]])")
    return Camera(int(size[0]), int(size[1]), k[0], k[4], k[2], k[5], tuple(distortion), transfer)


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
