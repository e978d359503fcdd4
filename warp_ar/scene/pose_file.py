"""Camera poses from files: COLMAP's images, OpenTrackIO samples, USD, or JSON of R and t; one per frame."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from warp_ar.errors import SceneError
from warp_ar.files import parse_json, read_text
from warp_ar.scene.camera_paths import USD_SUFFIXES, read_colmap_binary, read_track, read_usd
from warp_ar.scene.description import Vec3
from warp_ar.scene.geometry import rotation_matrix

RawPose = tuple[tuple[float, ...], Vec3]

TURNED = 1e-3
"""Largest deviation of R R^T from the unit matrix."""


def rotation_of_quaternion(w: float, x: float, y: float, z: float) -> tuple[float, ...]:
    """Rotation matrix, 9 numbers row by row, of a quaternion of any length, w first as COLMAP has it."""
    n = math.hypot(w, x, y, z)  # squares of tiny numbers would be 0
    w, x, y, z = w / n, x / n, y / n, z / n
    return (
        *(1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        *(2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        *(2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )


def check_rotation(rotation: Sequence[float]) -> bool:
    """Whether 9 numbers are a rotation matrix."""
    matrix = np.array(rotation, float).reshape(3, 3)
    return bool(np.abs(matrix @ matrix.T - np.eye(3)).max() < TURNED and np.linalg.det(matrix) > 0)


def pose_of_position(position: Sequence[float], rotate: Sequence[float]) -> RawPose:
    """``camera_from_world`` of a camera at ``position`` (metres) turned by ``rotate`` (degrees about fixed axes).

    Unturned it looks along the world's +y, its x along the world's x, upright: world z is up.
    """
    level = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    rotation = (rotation_matrix(rotate) @ level).T
    translation = -rotation @ np.array(position, float)
    x, y, z = map(float, translation)
    return tuple(map(float, rotation.reshape(-1))), (x, y, z)


def load_poses(path: Path) -> tuple[RawPose, ...]:
    """Poses of a clip's frames in order.

    COLMAP's ``images.txt`` and ``images.bin`` have them by name: they are put in order of name, as frames of a folder
    are. JSON holds a list of objects with ``R`` (9 numbers or 3 rows) and ``t``, ``camera_from_world`` as OpenCV's
    ``solvePnP`` gives, or OpenTrackIO samples, which may also stand one on each line of a ``.jsonl``. USD holds one
    camera, whose frames are those from its start to its end.

    Raises:
        SceneError: The file cannot be used.
    """
    suffix = path.suffix.lower()
    poses: tuple[RawPose, ...]
    if suffix == ".abc":
        raise SceneError(f"{path}: Alembic is not read; turn it into USD, as docs/formats.md shows for Blender")
    if suffix in USD_SUFFIXES:
        poses = read_usd(path)
    elif suffix == ".bin":
        images = sorted(read_colmap_binary(path))
        poses = tuple((rotation_of_quaternion(*quaternion), shift) for _, quaternion, shift in images)
    else:
        text = read_text(path, SceneError, expected="COLMAP's images.txt, or JSON")
        if suffix == ".jsonl":
            lines = (line for line in text.splitlines() if line.strip())
            poses = read_track(path, [parse_json(line, str(path), SceneError) for line in lines])
        else:
            poses = _read_json(path, text) if suffix == ".json" else _read_colmap(path, text)
    if not poses:
        raise SceneError(f"{path}: holds no pose; expected COLMAP's images, OpenTrackIO samples, or a list of R and t")
    return poses


def _read_json(path: Path, text: str) -> tuple[RawPose, ...]:
    entries = parse_json(text, str(path), SceneError)
    if isinstance(entries, dict) and "transforms" in entries:
        entries = [entries]
    if isinstance(entries, list) and entries and isinstance(entries[0], dict) and "transforms" in entries[0]:
        return read_track(path, entries)
    if not isinstance(entries, list):
        raise SceneError(
            f'{path}: expected a list of poses such as {{"R": [1, 0, 0, 0, 1, 0, 0, 0, 1], "t": [0, 0, 1]}}'
        )
    return tuple(_json_pose(f"{path}: pose {index}", entry) for index, entry in enumerate(entries))


def _json_pose(label: str, entry: Any) -> RawPose:
    if not isinstance(entry, dict) or not {"R", "t"} <= entry.keys():
        raise SceneError(f"{label}: expected R and t, camera_from_world")
    try:
        rotation = np.array(entry["R"], float).reshape(-1)
        translation = np.array(entry["t"], float).reshape(-1)
    except (TypeError, ValueError, OverflowError):
        rotation = translation = np.zeros(0)
    finite = np.isfinite(rotation).all() and np.isfinite(translation).all()
    if len(rotation) != 9 or len(translation) != 3 or not finite or not check_rotation(rotation.tolist()):
        raise SceneError(f"{label}: expected R, a rotation matrix of 9 numbers, and t, 3 numbers (metres)")
    x, y, z = translation.tolist()
    return tuple(rotation.tolist()), (x, y, z)


def _read_colmap(path: Path, text: str) -> tuple[RawPose, ...]:
    """Lines ``ID QW QX QY QZ TX TY TZ CAMERA NAME``, each followed by one of points, which is not looked at."""
    lines = [line for line in text.splitlines() if not line.lstrip().startswith("#")]
    found: list[tuple[str, RawPose]] = []
    for number, line in enumerate(lines[::2]):
        if not line.strip():
            continue
        words = line.split(maxsplit=9)
        try:
            w, x, y, z, *shift = map(float, words[1:8])
            length = math.hypot(w, x, y, z)
            if len(words) < 10 or not 0.0 < length < math.inf or not all(map(math.isfinite, shift)):
                raise ValueError
        except ValueError:
            raise SceneError(
                f"{path}: image {number}: expected ID QW QX QY QZ TX TY TZ CAMERA NAME, as COLMAP writes"
            ) from None
        found.append((words[9], (rotation_of_quaternion(w, x, y, z), (shift[0], shift[1], shift[2]))))
    return tuple(pose for _, pose in sorted(found, key=lambda item: item[0]))
