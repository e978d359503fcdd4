"""Ways of cameras as other programs write them: USD, OpenTrackIO, COLMAP's binary images.

References:
    SMPTE RIS-OSVP, "OpenTrackIO" 1.0: transforms in metres, z up, the camera along +y; degrees about z, x, y in turn.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_ar.errors import SceneError
from warp_ar.files import limits, read_bytes, too_much
from warp_ar.scene.description import Vec3

RawPose = tuple[tuple[float, ...], Vec3]
"""R, 9 numbers row by row, and t in metres: ``camera_from_world``, OpenCV's axes."""

USD_SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")

MOST_FRAMES = 1_000_000
"""Poses of a file."""

Matrix = npt.NDArray[np.float64]

_LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""``world_from_camera`` of a level camera that looks along +y, z up."""
_Z_FROM_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""From a y-up world to the z-up one of a marker: x stays."""


def pose_of_placement(rotation: Matrix, position: Matrix) -> RawPose:
    """``camera_from_world`` of ``world_from_camera``, OpenCV's axes."""
    inverse = rotation.T
    x, y, z = map(float, -inverse @ position)
    return tuple(map(float, inverse.reshape(-1))), (x, y, z)


def read_track(path: Path, samples: Sequence[Any]) -> tuple[RawPose, ...]:
    """Poses of OpenTrackIO samples, one each.

    Args:
        path: For messages.
        samples: JSON objects with ``transforms``, the last relative to those before it.

    Raises:
        SceneError: A sample is none.
    """
    return tuple(_read_sample(f"{path}: sample {index}", sample) for index, sample in enumerate(samples))


def _read_sample(label: str, sample: Any) -> RawPose:
    transforms = sample.get("transforms") if isinstance(sample, Mapping) else None
    if not isinstance(transforms, list) or not transforms:
        raise SceneError(f"{label}: expected transforms, a list of translation and rotation, as OpenTrackIO has it")
    rotation, position = np.eye(3), np.zeros(3)
    for transform in transforms:
        x, y, z = _numbers(label, transform, "translation", ("x", "y", "z"))
        turn = rotation_of_track(*_numbers(label, transform, "rotation", ("pan", "tilt", "roll")))
        position = position + rotation @ np.array([x, y, z])
        rotation = rotation @ turn
    return pose_of_placement(rotation @ _LEVEL, position)


def rotation_of_track(pan: float, tilt: float, roll: float) -> Matrix:
    """Rotation of OpenTrackIO's angles in degrees: about z, then the turned x, then the turned y."""
    (cz, sz), (cx, sx), (cy, sy) = ((math.cos(a), math.sin(a)) for a in map(math.radians, (pan, tilt, roll)))
    about_z = np.array([[cz, -sz, 0.0], [sz, cz, 0.0], [0.0, 0.0, 1.0]])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cx, -sx], [0.0, sx, cx]])
    about_y = np.array([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]])
    return np.asarray(about_z @ about_x @ about_y)


def _numbers(label: str, transform: Any, name: str, keys: tuple[str, ...]) -> list[float]:
    values = transform.get(name) if isinstance(transform, Mapping) else None
    found: list[Any] = [values.get(key) for key in keys] if isinstance(values, Mapping) else []
    good = [isinstance(one, int | float) and not isinstance(one, bool) and math.isfinite(one) for one in found]
    if not found or not all(good):
        raise SceneError(f"{label}: transforms: expected {name} with {', '.join(keys)}, finite numbers")
    return [float(one) for one in found]


def read_usd(path: Path) -> tuple[RawPose, ...]:
    """Poses of the only camera of a USD file, one per frame from its start to its end.

    Raises:
        SceneError: usd-core is not installed, or the file cannot be used.
    """
    read_bytes(path, "mesh_bytes", SceneError)  # it is there, regular, and not too large
    try:
        import pxr.Tf
        import pxr.Usd
        import pxr.UsdGeom
        import pxr.UsdUtils
    except ImportError as error:
        raise SceneError(f'{path}: USD files need usd-core; install it with pip install "warp-ar[exchange]"') from error
    quiet = pxr.UsdUtils.CoalescingDiagnosticDelegate()  # takes what USD would print while it lives
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
    # Blender says time codes alone, one for each frame: what USD takes for frames then is 24, whatever they are.
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
    """Pose of a placement of a camera that looks along -z; scale of its rig does not turn it."""
    axes, position = matrix[:3, :3], unit * matrix[:3, 3]
    lengths = np.linalg.norm(axes, axis=0)
    if not np.isfinite(matrix).all() or (lengths == 0.0).any():
        raise SceneError(f"{label}: the camera's placement is no finite, regular matrix")
    rotation = axes / lengths
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0.0:
        raise SceneError(f"{label}: the camera is mirrored or skewed; expected a rotation and a translation")
    turn = _Z_FROM_Y_UP if up == "Y" else np.eye(3)
    return pose_of_placement(turn @ rotation @ np.diag([1.0, -1.0, -1.0]), turn @ position)


def read_colmap_binary(path: Path) -> list[tuple[str, tuple[float, ...], Vec3]]:
    """Names, quaternions (w first) and translations of COLMAP's ``images.bin``.

    Raises:
        SceneError: The file is cut off, or none.
    """
    data = read_bytes(path, "mesh_bytes", SceneError)
    found: list[tuple[str, tuple[float, ...], Vec3]] = []
    try:
        (count,), at = struct.unpack_from("<Q", data), 8
        if count > limits().mesh_elements:
            raise SceneError(too_much(str(path), count, "images", "mesh_elements"))
        for _ in range(count):
            w, x, y, z, tx, ty, tz = struct.unpack_from("<7d", data, at + 4)
            end = data.index(b"\0", at + 64)
            name = data[at + 64 : end].decode("utf-8", "replace")
            (points,) = struct.unpack_from("<Q", data, end + 1)
            at = end + 9 + 24 * points
            found.append((name, (w, x, y, z), (tx, ty, tz)))
    except (struct.error, ValueError, OverflowError) as error:  # overflow: more points than any file holds
        raise SceneError(f"{path}: cut off after {len(data):,} bytes, or no images.bin of COLMAP") from error
    for name, quaternion, shift in found:
        if not all(map(math.isfinite, (*quaternion, *shift))) or not any(quaternion):
            raise SceneError(f"{path}: image {name!r}: its pose is no rotation and translation")
    return found
