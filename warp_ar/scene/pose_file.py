"""Readers of camera poses: COLMAP's images, NeRF's transforms, OpenTrackIO, USD, and JSON with R and t.

References:
    SMPTE RIS-OSVP, "OpenTrackIO" 1.0: transforms in metres, z up, the camera along +y; degrees about z, x, y in turn.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_ar.errors import SceneError, UsageError, WarpArError, import_extra
from warp_ar.exr_file import say_once
from warp_ar.files import limits, parse_json, read_bytes, read_text, too_much
from warp_ar.scene.description import PoseSpec
from warp_ar.scene.fields import Vec3
from warp_ar.scene.geometry import quaternion_matrix, rotation_matrix
from warp_ar.scene.messages import is_number

RawPose = tuple[tuple[float, ...], Vec3]
"""``camera_from_world`` with OpenCV's axes: R as 9 numbers row by row, and t in metres."""
Named = list[tuple[str, RawPose, str]]
"""Poses, each after its picture's name and before its camera's number in a COLMAP model; both may be empty."""
Matrix = npt.NDArray[np.float64]

USD_SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
MOST_FRAMES = 1_000_000
"""Largest number of poses in a file."""
TURNED = 1e-3
"""Largest deviation of R R^T from the identity."""
_LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Rotation ``world_from_camera`` of a level camera that faces +y, with z up."""
_Z_FROM_Y_UP = _LEVEL.T
"""Rotation from a y-up world to the z-up world of a marker; x is unchanged."""
_OPENCV = np.diag([1.0, -1.0, -1.0])
"""Rotation between OpenCV's and OpenGL's camera axes."""


def pose_of_placement(rotation: Matrix, position: Matrix) -> RawPose:
    """Invert a camera's placement: return ``camera_from_world``.

    Args:
        rotation: ``world_from_camera``, (3, 3). The camera's axes are OpenCV's here and in the result.
        position: Position of the camera in the world, metres, (3,).
    """
    inverse = rotation.T
    x, y, z = map(float, -inverse @ position)
    return tuple(map(float, inverse.reshape(-1))), (x, y, z)


def pose_of_position(position: Sequence[float], rotate: Sequence[float]) -> RawPose:
    """Return ``camera_from_world`` of a camera at ``position``, metres, rotated by ``rotate``, degrees.

    With zero rotation the camera faces the world's +y, with its x along the world's x and the world's z up.
    """
    return pose_of_placement(rotation_matrix(rotate) @ _LEVEL, np.array(position, float))


def rotation_of_quaternion(w: float, x: float, y: float, z: float) -> tuple[float, ...]:
    """Return the rotation matrix, 9 numbers row by row, of a quaternion (w, x, y, z) of any length."""
    n = math.hypot(w, x, y, z)  # normalise first: squares of tiny numbers would underflow to 0
    return tuple(map(float, quaternion_matrix(np.array([x, y, z, w]) / n).reshape(-1)))


def check_rotation(rotation: Sequence[float]) -> bool:
    """Return True if 9 numbers form a rotation matrix."""
    matrix = np.array(rotation, float).reshape(3, 3)
    return bool(np.abs(matrix @ matrix.T - np.eye(3)).max() < TURNED and np.linalg.det(matrix) > 0)


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Return a sort key that orders runs of digits by value.

    Its last item separates names such as ``f01`` and ``f1``.
    """
    parts = [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.split(r"(\d+)", name) if part]
    return [*parts, (2, 0, name)]


def load_pose_file(path: Path) -> PoseSpec:
    """Read the poses of a clip's frames.

    JSON holds a list of objects with ``R`` (9 numbers or 3 rows) and ``t``, ``camera_from_world`` as returned by
    OpenCV's ``solvePnP``, and either all or none with a ``name``. Alternatively it holds OpenTrackIO samples, which a
    ``.jsonl`` file stores one per line.

    Follows:
        by pictures' names: COLMAP's images.txt (with or without points) and images.bin, NeRF's transforms.json, JSON
        with names; else frames in turn: JSON, OpenTrackIO, the one camera of a USD.

    Names:
        frames without a pose; NeRF's applied_transform, applied_scale (the world behind them is taken).

    Returns:
        The poses: with names in natural order of the names, else in the file's order.

    Raises:
        SceneError: Damaged; Alembic.
    """
    suffix = path.suffix.lower()
    if suffix == ".abc":
        raise SceneError(f"{path}: Alembic is not read; turn it into USD, as docs/formats.md shows for Blender")
    if suffix in USD_SUFFIXES:
        found: Named = [("", pose, "") for pose in read_usd(path)]
    elif suffix == ".bin":
        found = _read_colmap_binary(path)
    else:
        text = read_text(path, SceneError, expected="COLMAP's images.txt, or JSON")
        if suffix == ".jsonl":
            lines = (line for line in text.splitlines() if line.strip())
            samples = [parse_json(line, str(path), SceneError) for line in lines]
            found = [("", pose, "") for pose in read_track(path, samples)]
        else:
            by_json = suffix == ".json"
            found = [(*one, "") for one in _read_json(path, text)] if by_json else _read_colmap(path, text)
    if not found:
        raise SceneError(f"{path}: holds no pose; expected COLMAP's images, OpenTrackIO samples, or a list of R and t")
    found = [(name.replace("\\", "/"), pose, camera) for name, pose, camera in found]
    named = sum(1 for name, *_ in found if name)
    if named not in (0, len(found)):
        raise SceneError(f"{path}: {named} of {len(found)} poses have names of pictures; expected all, or none")
    if named:
        found.sort(key=lambda item: natural_key(item[0]))
    names, poses, cameras = zip(*found, strict=True)
    return PoseSpec(poses, path, names if named else (), cameras if any(cameras) else ())


def _read_json(path: Path, text: str) -> list[tuple[str, RawPose]]:
    entries = parse_json(text, str(path), SceneError)
    if isinstance(entries, dict) and isinstance(entries.get("frames"), list):
        if moved := [key for key in ("applied_transform", "applied_scale") if key in entries]:
            say_once(f"{path}: poses are taken in the world that {' and '.join(moved)} led to; nothing is undone")
        return [_nerf_pose(f"{path}: frame {index}", entry) for index, entry in enumerate(entries["frames"])]
    if isinstance(entries, dict) and "transforms" in entries:
        entries = [entries]
    if isinstance(entries, list) and entries and isinstance(entries[0], dict) and "transforms" in entries[0]:
        return [("", pose) for pose in read_track(path, entries)]
    if not isinstance(entries, list):
        raise SceneError(
            f'{path}: expected a list of poses such as {{"R": [1, 0, 0, 0, 1, 0, 0, 0, 1], "t": [0, 0, 1]}}'
        )
    poses = [_json_pose(f"{path}: pose {index}", entry) for index, entry in enumerate(entries)]
    names = [entry.get("name", "") for entry in entries]
    if not all(isinstance(name, str) for name in names):
        raise SceneError(f"{path}: name of a pose: expected the name of a picture")
    return list(zip(names, poses, strict=True))


def _nerf_pose(label: str, entry: Any) -> tuple[str, RawPose]:
    """Return name and pose of a frame of NeRF's ``transforms.json``, which has OpenGL's camera axes."""
    said = entry if isinstance(entry, dict) else {}
    name, numbers = said.get("file_path"), _finite(said.get("transform_matrix"))
    matrix = numbers.reshape(-1, 4) if len(numbers) in (12, 16) else np.zeros((3, 4))
    # The matrix may be stored by columns.
    last = bool((matrix[3:] == (0.0, 0.0, 0.0, 1.0)).all())
    if not isinstance(name, str) or not last or not check_rotation(matrix[:3, :3].ravel().tolist()):
        raise SceneError(f"{label}: expected file_path and transform_matrix, 4 rows of 4 of which the last is 0 0 0 1")
    return name, pose_of_placement(matrix[:3, :3] @ _OPENCV, matrix[:3, 3])


def _json_pose(label: str, entry: Any) -> RawPose:
    rotation, translation = (_finite(entry.get(key) if isinstance(entry, dict) else None) for key in ("R", "t"))
    if len(rotation) != 9 or len(translation) != 3 or not check_rotation(rotation.tolist()):
        right = "R, a rotation matrix of 9 numbers, and t, 3 numbers (metres): camera_from_world"
        raise SceneError(f"{label}: expected {right}")
    x, y, z = translation.tolist()
    return tuple(rotation.tolist()), (x, y, z)


def _finite(value: Any) -> Matrix:
    """Return the numbers of nested lists, (n,); an empty array if any is not a finite number."""
    try:
        numbers = np.array(value, float).reshape(-1)
    except (TypeError, ValueError, OverflowError):
        return np.zeros(0)
    return numbers if np.isfinite(numbers).all() else np.zeros(0)


def _colmap_pose(label: str, numbers: Sequence[float]) -> RawPose:
    """Return the pose of a quaternion and a translation, 7 numbers."""
    if not all(map(math.isfinite, numbers)) or not 0.0 < math.hypot(*numbers[:4]) < math.inf:
        raise SceneError(f"{label}: expected QW QX QY QZ TX TY TZ, a rotation and a translation")
    w, x, y, z, *shift = numbers
    return rotation_of_quaternion(w, x, y, z), (shift[0], shift[1], shift[2])


def _read_colmap(path: Path, text: str) -> Named:
    """Return names, poses and cameras of lines ``ID QW QX QY QZ TX TY TZ CAMERA NAME``.

    A line of 2D points may follow each.
    """
    found: Named = []
    of_points = False
    for line in text.splitlines():
        words = line.split(maxsplit=9)
        count = len(line.split())
        # A line of 2D points consists of triples of numbers.
        named = count >= 10 and not (count % 3 == 0 and all(map(is_number, line.split())))
        if line.lstrip().startswith("#") or (of_points and not named) or (not words and not of_points):
            of_points = of_points and line.lstrip().startswith("#")
            continue
        label = f"{path}: image {len(found)}"
        if not named or not all(map(is_number, words[:9])):
            raise SceneError(f"{label}: expected ID QW QX QY QZ TX TY TZ CAMERA NAME, as COLMAP writes")
        found.append((words[9], _colmap_pose(label, [float(word) for word in words[1:8]]), words[8]))
        of_points = True
    return found


def _read_colmap_binary(path: Path) -> Named:
    """Return names, poses and cameras of COLMAP's ``images.bin``."""
    data = read_bytes(path, "mesh_bytes", SceneError)
    found: list[tuple[str, list[float], str]] = []
    try:
        (count,), at = struct.unpack_from("<Q", data), 8
        if count > limits().mesh_elements:
            raise SceneError(too_much(str(path), count, "images", "mesh_elements"))
        for _ in range(count):
            *numbers, camera = struct.unpack_from("<7dI", data, at + 4)
            end = data.index(b"\0", at + 64)
            found.append((data[at + 64 : end].decode("utf-8", "replace"), numbers, str(camera)))
            (points,) = struct.unpack_from("<Q", data, end + 1)
            at = end + 9 + 24 * points
    except (struct.error, ValueError, OverflowError) as error:  # overflow: a count larger than any file
        raise SceneError(f"{path}: cut off after {len(data):,} bytes, or no images.bin of COLMAP") from error
    return [(name, _colmap_pose(f"{path}: image {name!r}", numbers), camera) for name, numbers, camera in found]


def read_track(path: Path, samples: Sequence[Any]) -> tuple[RawPose, ...]:
    """Return the pose of each OpenTrackIO sample.

    Args:
        path: Path of the file, for messages.
        samples: JSON objects with ``transforms``, each relative to the one before it.

    Raises:
        SceneError: A sample is invalid.
    """
    return tuple(_read_sample(f"{path}: sample {index}", sample) for index, sample in enumerate(samples))


def _read_sample(label: str, sample: Any) -> RawPose:
    transforms = sample.get("transforms") if isinstance(sample, Mapping) else None
    if not isinstance(transforms, list) or not transforms:
        raise SceneError(f"{label}: expected transforms, a list of translation and rotation, as OpenTrackIO has it")
    rotation, position = np.eye(3), np.zeros(3)
    for transform in transforms:
        scaled = isinstance(transform, Mapping) and "scale" in transform
        if scaled and _numbers(label, transform, "scale", ("x", "y", "z")) != [1.0] * 3:
            raise SceneError(f"{label}: transforms: scale is {transform['scale']}; expected 1 along x, y and z")
        x, y, z = _numbers(label, transform, "translation", ("x", "y", "z"))
        turn = rotation_of_track(*_numbers(label, transform, "rotation", ("pan", "tilt", "roll")))
        position = position + rotation @ np.array([x, y, z])
        rotation = rotation @ turn
    return pose_of_placement(rotation @ _LEVEL, position)


def rotation_of_track(pan: float, tilt: float, roll: float) -> Matrix:
    """Return the rotation of OpenTrackIO's angles in degrees: about z, then the rotated x, then the rotated y axis."""
    return rotation_matrix((tilt, 0.0, pan)) @ rotation_matrix((0.0, roll, 0.0))


def _numbers(label: str, transform: Any, name: str, keys: tuple[str, ...]) -> list[float]:
    values = transform.get(name) if isinstance(transform, Mapping) else None
    found: list[Any] = [values.get(key) for key in keys] if isinstance(values, Mapping) else []
    good = [isinstance(one, int | float) and not isinstance(one, bool) and math.isfinite(one) for one in found]
    if not found or not all(good):
        raise SceneError(f"{label}: transforms: expected {name} with {', '.join(keys)}, finite numbers")
    return [float(one) for one in found]


def load_usd(error: type[WarpArError] = UsageError) -> Any:
    """Return USD's modules.

    Raises:
        WarpArError: As ``error``: it is not installed.
    """
    names = ("Gf", "Sdf", "Tf", "Usd", "UsdGeom", "UsdLux", "UsdShade", "UsdUtils", "Vt")
    modules = (f"pxr.{name}" for name in names)
    return import_extra("exchange", "USD files need usd-core", "pxr", *modules, error=error)


def read_usd(path: Path) -> tuple[RawPose, ...]:
    """Return the poses of the only camera of a USD file, one per frame from the stage's start to its end.

    Raises:
        SceneError: usd-core is not installed, or the file cannot be used.
    """
    read_bytes(path, "mesh_bytes", SceneError)  # checks that it exists, is a regular file and not too large
    pxr = load_usd(SceneError)
    quiet = pxr.UsdUtils.CoalescingDiagnosticDelegate()  # captures USD's messages while it exists
    try:
        stage = pxr.Usd.Stage.Open(str(path), pxr.Usd.Stage.LoadAll)
    except pxr.Tf.ErrorException as error:
        raise SceneError(f"{path}: no USD file that can be read; is it whole?") from error
    finally:
        quiet.TakeUncoalescedDiagnostics()
        del quiet
    cameras = [prim for prim in stage.Traverse() if prim.IsA(pxr.UsdGeom.Camera)]
    if len(cameras) != 1:
        names = ", ".join(str(prim.GetPath()) for prim in cameras[:4])
        raise SceneError(f"{path}: expected one camera, found {len(cameras)}{f' ({names})' if names else ''}")
    start, end = stage.GetStartTimeCode(), stage.GetEndTimeCode()
    # Blender writes time codes only, one per frame; USD then reports 24 frames per second, whatever the rate is.
    told = stage.GetFramesPerSecond() if stage.HasAuthoredMetadata("framesPerSecond") else 0.0
    step = stage.GetTimeCodesPerSecond() / (told or stage.GetTimeCodesPerSecond())
    finite = math.isfinite(start) and math.isfinite(end) and math.isfinite(step) and step > 0.0
    count = math.floor((end - start) / step + 1e-6) + 1 if finite and end >= start else 1
    if count > MOST_FRAMES:
        raise SceneError(f"{path}: {count:,} frames; expected {MOST_FRAMES:,} at most")
    up = str(pxr.UsdGeom.GetStageUpAxis(stage))
    unit = float(pxr.UsdGeom.GetStageMetersPerUnit(stage))
    camera = pxr.UsdGeom.Xformable(cameras[0])
    poses = []
    for index in range(count):
        rows = np.array(camera.ComputeLocalToWorldTransform(start + step * index))
        poses.append(_pose_of_usd(f"{path}: frame {index}", rows.T, unit, up))
    return tuple(poses)


def _pose_of_usd(label: str, matrix: Matrix, unit: float, up: str) -> RawPose:
    """Return ``camera_from_world`` of the placement of a camera that faces -z; scale in its transform is removed."""
    axes, position = matrix[:3, :3], unit * matrix[:3, 3]
    lengths = np.linalg.norm(axes, axis=0)
    if not np.isfinite(matrix).all() or (lengths == 0.0).any():
        raise SceneError(f"{label}: the camera's placement is no finite, regular matrix")
    rotation = axes / lengths
    if not check_rotation(rotation.ravel().tolist()):
        raise SceneError(f"{label}: the camera is mirrored or skewed; expected a rotation and a translation")
    turn = _Z_FROM_Y_UP if up == "Y" else np.eye(3)
    return pose_of_placement(turn @ rotation @ _OPENCV, turn @ position)
