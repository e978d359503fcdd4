"""Readers of camera calibrations in the formats of OpenCV, ROS, Kalibr, COLMAP and common scripts."""

from __future__ import annotations

import itertools
import math
import re
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NoReturn

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.declared import checked
from warp_ar.errors import SceneError
from warp_ar.files import bracket_depth, check_depth, indentation_depth, is_file, read_bytes, read_text, tag_depth
from warp_ar.scene.description import Camera
from warp_ar.scene.messages import LARGEST, MOST_PIXELS, SMALLEST, show_value

# Names of keys in OpenCV, ROS, ArUco and common Python scripts, compared without case and underscores.
_WIDTH: Final = ("image_width", "width", "w")
_HEIGHT: Final = ("image_height", "height", "h")
_SIZE: Final = ("image_size", "calib_image_dimensions", "resolution")
_MATRIX: Final = ("camera_matrix", "k", "mtx", "intrinsics")
_SINGLE: Final = (("fx", "fl_x"), ("fy", "fl_y", "fl_x"), ("cx", "ppx"), ("cy", "ppy"))
_DISTORTION: Final = (
    *("distortion_coefficients", "dist_coeffs", "dist_coeff", "dist", "distortion", "d", "distortion_coeffs", "coeffs"),
)
_TERMS: Final = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_MODEL: Final = ("distortion_model", "camera_model", "model", "camera_type", "projection_model")
_NOT_UNDERSTOOD: Final = "dist|coef|radial|tangential|skew|^(xi|s[1-4]|tau[xy]?|mirrorparameters)$"
"""Pattern of unsupported keys that change the projection; such a key is accepted only if its value is 0."""
_PINHOLES: Final = (
    *("plumb_bob", "rational_polynomial", "radtan", "pinhole", "opencv", "perspective", "brown_conrady", "none", ""),
    *("simple_pinhole", "simple_radial", "radial", "full_opencv", "radial_tangential"),
)
_FISHEYES: Final = (
    *("equidistant", "fisheye", "kannala_brandt", "opencv_fisheye", "kannala_brandt4", "equi"),
    *("simple_radial_fisheye", "radial_fisheye"),
)
_COLMAP: Final = {
    "SIMPLE_PINHOLE": "fl_x cx cy",
    "PINHOLE": "fl_x fl_y cx cy",
    "SIMPLE_RADIAL": "fl_x cx cy k1",
    "RADIAL": "fl_x cx cy k1 k2",
    "OPENCV": "fl_x fl_y cx cy k1 k2 p1 p2",
    "OPENCV_FISHEYE": "fl_x fl_y cx cy k1 k2 k3 k4",
    "FULL_OPENCV": "fl_x fl_y cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "FOV": "fl_x fl_y cx cy omega",
    "SIMPLE_RADIAL_FISHEYE": "fl_x cx cy k1",
    "RADIAL_FISHEYE": "fl_x cx cy k1 k2",
}
"""Parameters of COLMAP's camera models in the order of its files; models in the order of their numbers from 0."""
WIDEST: Final = 80.0
"""Largest angle from the axis, degrees, up to which a fisheye lens is converted; a pinhole's rays end at 90."""
FISHEYE_ERROR: Final = 0.25
"""Largest error in pixels of the rational model that replaces a fisheye model, anywhere in the picture."""
_EXPECTED: Final = "OpenCV's YAML, JSON or XML"


@checked
def load_calibration(path: str | Path, transfer: str | Path = "srgb", number: str | None = None) -> Camera:
    """Read a calibration file: OpenCV's YAML, JSON or XML, ROS's camera_info, Kalibr's camchain, COLMAP's cameras.

    Follows:
        size; camera matrix, or fx fy cx cy; distortion of 4, 5 or 8 terms; keys of OpenCV, ROS, Kalibr, ArUco, NeRF,
        RealSense; ROS's roi and binning; fisheyes to 80 degrees from the axis, as a rational model within 0.25 pixels.

    Args:
        path: The file.
        transfer: Encoding of the camera's values, because calibration files do not state it.
        number: Number of the camera in a COLMAP model; None: its only one.

    Raises:
        SceneError: Damaged; missing keys; several cameras; skew; other models; other keys of distortion; cameras of
            single frames; wider fisheyes.
    """
    path = Path(path)
    if not is_file(path):
        raise SceneError(f"{path}: no such calibration file")
    said = _read_tree(path, number)
    tree = {_plain_key(key): value for key, value in said.items()}

    def numbers(*names: str) -> list[float] | None:
        return next((_flatten(tree[key]) for key in map(_plain_key, names) if key in tree), None)

    def fail(name: str, value: object, right: str) -> NoReturn:
        shown = " is missing" if value is None else f" = {show_value(value)}"
        raise SceneError(f"{path}: {name}{shown}: {right}")

    size = numbers(*_SIZE) or [*(numbers(*_WIDTH) or []), *(numbers(*_HEIGHT) or [])]
    if len(size) != 2 or not all(1 <= side <= MOST_PIXELS and side == int(side) for side in size):
        right = f"expected image_width and image_height, whole numbers to {MOST_PIXELS} (pixels)"
        fail(_WIDTH[0], size or None, right)
    known = set(map(_plain_key, (*_DISTORTION, *_MODEL)))
    for key, value in said.items():
        plain = _plain_key(key)
        if plain not in known and re.search(_NOT_UNDERSTOOD, plain) and any(_flatten(value)):
            raise SceneError(f"{path}: {key}: not understood; expected {_DISTORTION[0]}: k1 k2 p1 p2 [k3 ...]")
    of_lens = {_plain_key(key) for key in (*_WIDTH, *_HEIGHT, *_MATRIX, *_TERMS, *_MODEL, *sum(_SINGLE, ()))}
    for frame in tree.get("frames") or ():
        for key, value in frame.items() if isinstance(frame, dict) else ():
            if (plain := _plain_key(key)) in of_lens and value != tree.get(plain, 0.0):
                raise SceneError(f"{path}: a frame has {key} of its own; expected one camera for all frames")
    fisheye = any("fisheye" in key and tree[key] not in (0.0, "false", "") for key in tree)
    for model in (str(tree[key]) for key in map(_plain_key, _MODEL) if key in tree):
        plain = re.sub("[- ]", "_", model.lower().removeprefix("distortion."))
        fisheye |= plain in _FISHEYES
        unbent = plain == "inverse_brown_conrady" and not any(numbers(*_DISTORTION) or ())  # RealSense: undistorted
        if plain not in (*_FISHEYES, *_PINHOLES) and not unbent:
            expected = ", ".join(filter(None, (*_PINHOLES, *_FISHEYES)))
            raise SceneError(f"{path}: camera model {model!r} is not understood; expected {expected}")
    k = numbers(*_MATRIX)
    singles = [value for names in _SINGLE for value in numbers(*names) or []]
    if k is None or len(k) == 4:
        fx, fy, cx, cy = k or (singles if len(singles) == 4 else [math.nan] * 4)
        middle = 0.5 if k is None and "flx" in tree else 0.0  # COLMAP puts pixel centres at halves, and so does NeRF
        k = None if math.isnan(fx) else [fx, 0.0, cx - middle, 0.0, fy, cy - middle, 0.0, 0.0, 1.0]
    if k is None or len(k) != 9 or not all(map(math.isfinite, k)):
        fail(_MATRIX[0], k, "expected a 3x3 matrix of finite numbers")
    if not (SMALLEST <= k[0] <= LARGEST and SMALLEST <= k[4] <= LARGEST):
        fail(_MATRIX[0], k, "focal lengths must be above 0 (pixels)")
    if any(abs(k[i]) > 1e-9 * k[0] for i in (1, 3, 6, 7)) or abs(k[8] - 1.0) > 1e-9:
        fail(_MATRIX[0], k, "expected [fx, 0, cx, 0, fy, cy, 0, 0, 1]: a camera without skew")
    terms = ("k1", "k2", "k3", "k4") if fisheye else _TERMS
    distortion = numbers(*_DISTORTION)
    single = [sum(numbers(term) or []) for term in terms] if any(term in tree for term in _TERMS) else []
    if distortion and single and any(a != b for a, b in itertools.zip_longest(distortion, single, fillvalue=0.0)):
        fail(_DISTORTION[0], distortion, f"expected the values of its {' '.join(terms)}, or one of both")
    distortion = distortion or single or list(Camera.distortion)
    columns, rows, (fx, _, cx, _, fy, cy, *_) = *map(int, size), k
    columns, fx, cx = _read_out(path, tree, "x", columns, fx, cx)
    rows, fy, cy = _read_out(path, tree, "y", rows, fy, cy)
    finite = all(map(math.isfinite, distortion))
    if fisheye:
        if len(distortion) != 4 or not finite:
            fail(_DISTORTION[0], distortion, "expected 4 finite values of a fisheye (k1 k2 k3 k4)")
        matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        try:
            distortion = list(rational_of_fisheye(columns, rows, matrix, distortion))
        except SceneError as error:
            raise SceneError(f"{path}: {error}") from error
    if len(distortion) > 8 and not any(distortion[8:]):
        distortion = distortion[:8]
    if len(distortion) not in (4, 5, 8) or not finite:
        fail(_DISTORTION[0], distortion, "expected 4, 5 or 8 finite values (k1 k2 p1 p2 [k3 [k4 k5 k6]])")
    return Camera(columns, rows, fx, fy, cx, cy, tuple(distortion), transfer)


def _read_out(
    path: Path, tree: dict[str, Any], axis: str, side: int, focal: float, middle: float
) -> tuple[int, float, float]:
    """Return side, focal length and principal point along one axis, all in the pixels that ROS's camera_info delivers.

    The camera reads out a region of interest of the sensor and then averages bins: column u of the sensor is column (u
    + 1/2 - offset) / bin - 1/2 of the picture. An offset or bin of 0 means that there is none.
    """
    told = tree.get("roi")
    roi = told if isinstance(told, dict) else {}
    names = f"{axis}_offset", "width" if axis == "x" else "height"
    values = [*(roi.get(name, 0.0) for name in names), tree.get(f"binning{axis}", 0.0)]
    whole = all(isinstance(value, float) and value >= 0.0 and value == int(value) for value in values)
    offset, length, bins = map(int, values) if whole else (0, 0, 0)
    length, bins = length or side - offset, max(bins, 1)
    if not whole or length < bins or offset + length > side:
        raise SceneError(f"{path}: roi and binning_{axis} are {values}; expected whole pixels of its {side}")
    return length // bins, focal / bins, (middle + 0.5 - offset) / bins - 0.5


def rational_of_fisheye(
    width: int, height: int, matrix: npt.NDArray[np.float64], terms: Sequence[float]
) -> tuple[float, ...]:
    """Return k1 k2 p1 p2 k3 k4 k5 k6 of OpenCV's rational model that approximates a fisheye in the whole picture.

    A fisheye model [KB06] projects a point at the angle t from the axis to the radius f (t + k1 t^3 + k2 t^5 + k3 t^7 +
    k4 t^9). With r = tan t, the radial factor (t + ...) / r is fitted by (1 + a1 r^2 + a2 r^4 + a3 r^6) / (1 + b1 r^2 +
    b2 r^4 + b3 r^6): atan(r) / r has Pade approximants that converge for all r.

    References:
        [KB06] J. Kannala and S. Brandt. A generic camera model and calibration method for conventional, wide-angle, and
        fish-eye lenses. PAMI 2006.

    Args:
        width: Width of the picture in pixels.
        height: Height of the picture in pixels.
        matrix: Camera matrix, (3, 3).
        terms: k1 k2 k3 k4 of the fisheye.

    Raises:
        SceneError: The picture reaches farther from the axis than ``WIDEST`` (the message names a crop that does not),
            the radius does not grow everywhere with the angle, or no rational model is within ``FISHEYE_ERROR`` of it.
    """
    corners = np.array([[x, y] for x in (-0.5, width - 0.5) for y in (-0.5, height - 0.5)])
    farthest = float(np.linalg.norm((corners - matrix[:2, 2]) / (matrix[0, 0], matrix[1, 1]), axis=1).max())
    theta = np.linspace(0.0, math.pi, 4001)[1:]
    turned = theta * (1.0 + sum(term * theta ** (2 * n + 2) for n, term in enumerate(terms)))
    rising = int(np.argmin(np.append(np.diff(turned), -1.0) > 0.0)) + 1  # the radius decreases beyond this angle
    theta, turned = theta[:rising], turned[:rising]
    count = int(np.searchsorted(turned, farthest)) + 1
    if count > rising or theta[count - 1] > math.radians(WIDEST):
        reach = f"{math.degrees(theta[min(count, rising) - 1]):.0f} degrees" + " and more" * (count > rising)
        share = float(np.interp(math.radians(WIDEST - 2.0), theta, turned)) / farthest  # largest at the border
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
    for _ in range(20):  # residuals of the linearised equation, weighted by the denominator
        rows = np.concatenate([powers, -wanted[:, None] * powers], 1) * (weight * radius)[:, None]
        scale = np.abs(rows).max(0)
        found = np.linalg.lstsq(rows / scale, (wanted - 1.0) * weight * radius, rcond=1e-15)[0] / scale
        weight = 1.0 / np.abs(1.0 + powers @ found[3:])
    factor = (1.0 + powers @ found[:3]) / (1.0 + powers @ found[3:])
    off = float(np.abs(factor * radius - turned).max()) * max(matrix[0, 0], matrix[1, 1])
    if not off < FISHEYE_ERROR:
        raise SceneError(f"the fisheye's model is approximated only to {off:.2f} pixels; expected {FISHEYE_ERROR:g}")
    k1, k2, k3, k4, k5, k6 = map(float, found)
    return k1, k2, 0.0, 0.0, k3, k4, k5, k6


def _colmap_text(path: Path) -> str:
    """Return COLMAP's ``cameras.bin`` in the form of ``cameras.txt``."""
    data = read_bytes(path, "text_bytes", SceneError)
    lines, at, models = [], 8, list(_COLMAP.items())
    try:
        for _ in range(struct.unpack_from("<Q", data)[0]):
            number, model, *size = struct.unpack_from("<IiQQ", data, at)
            if not 0 <= model < len(models):
                raise SceneError(f"{path}: camera model {model} is not understood; expected {', '.join(_COLMAP)}")
            name, terms = models[model]
            values = struct.unpack_from(f"<{len(terms.split())}d", data, at + 24)
            at += 24 + 8 * len(values)
            lines.append(" ".join(map(str, (number, name, *size, *values))))
    except struct.error as error:
        raise SceneError(f"{path}: cut off after {len(data):,} bytes, or no cameras.bin of COLMAP") from error
    return "\n".join(lines)


def _read_tree(path: Path, number: str | None) -> dict[str, Any]:
    """Return the keys and values of a calibration file as numbers, texts, lists and maps."""
    binary = path.suffix.lower() == ".bin"
    text = _colmap_text(path) if binary else read_text(path, SceneError, expected=_EXPECTED)
    cameras: dict[str, Any] = {}
    for line in text.splitlines() if binary or path.suffix.lower() == ".txt" else ():
        words = line.split()
        if len(words) < 5 or not re.fullmatch("[A-Z][A-Z_]+", words[1]) or number not in (None, words[0]):
            continue
        names = ["width", "height", *_COLMAP.get(words[1], "").split()]
        try:
            values = dict(zip(names, map(float, words[2:]), strict=words[1] in _COLMAP))
        except ValueError as error:
            raise SceneError(f"{path}: {line.strip()[:80]!r}: expected numbers for {', '.join(names)}") from error
        cameras[f"camera {words[0]}"] = {"camera_model": words[1], **values}
    if (binary or number is not None) and not cameras:
        raise SceneError(f"{path}: holds no camera {number or '1'} of COLMAP")
    tree = cameras or _by_opencv(path, text)
    inner = [key for key, value in tree.items() if isinstance(value, dict) and "data" not in value]
    if len(inner) == len(tree) > 1:
        raise SceneError(f"{path}: holds {len(tree)} cameras ({', '.join(inner[:4])}); keep the one of the frames")
    result: dict[str, Any] = tree[inner[0]] if len(inner) == len(tree) == 1 else tree
    return result


def _by_opencv(path: Path, text: str) -> dict[str, Any]:
    """Parse a calibration with OpenCV; deep nesting is refused first, because its recursive parsers crash on it."""
    start = text.lstrip()[:1]
    depth = tag_depth(text) if start == "<" else bracket_depth(text)
    if start not in ("<", "{", "["):
        depth += indentation_depth(text)
    check_depth(depth, str(path), SceneError)
    wrong = f"{path}: the calibration cannot be read; expected {_EXPECTED}"
    if "\0" in text or not start:
        raise SceneError(wrong)
    if start not in "<{[%":  # Python's YAML does not indent lists, but OpenCV requires it
        text = re.sub(r"(?m)^( *)- (?=[-+.\d\[])", r"\1 - ", text)
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        tree = _plain(storage.root()) if storage.isOpened() else None
        storage.release()
    except (cv2.error, SystemError) as error:  # OpenCV's constructor reports an unreadable file as SystemError
        raise SceneError(wrong) from error
    if not isinstance(tree, dict):
        raise SceneError(wrong)
    return tree


def _plain(node: Any) -> Any:
    """Return an OpenCV file node as maps, lists, numbers and texts."""
    if node.isMap():
        return {key: _plain(node.getNode(key)) for key in node.keys()}  # noqa: SIM118
    if node.isSeq():
        return [_plain(node.at(index)) for index in range(node.size())]
    return node.string() if node.isString() else float(node.real()) if node.isReal() or node.isInt() else None


def _plain_key(key: str) -> str:
    return key.replace("_", "").lower()


def _flatten(value: Any) -> list[float]:
    """Return the numbers of a matrix, a map with ``data`` (ROS), nested lists or a single value.

    Other values become NaN.
    """
    if isinstance(value, dict):
        return _flatten(value.get("data", ""))
    if isinstance(value, list):
        return [number for entry in value for number in _flatten(entry)]
    return [] if value is None else [value if isinstance(value, float) else math.nan]
