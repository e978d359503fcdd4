"""Sections of a scene file about the camera: its numbers, its source of frames, its pose, its exposure."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Final, cast

from warp_ar.files import is_file
from warp_ar.scene.calibration_file import load_calibration
from warp_ar.scene.description import Camera, Exposure, PoseSpec, SourceSpec
from warp_ar.scene.exif import camera_by_exif
from warp_ar.scene.keys import INTRINSICS, keys_of
from warp_ar.scene.messages import MOST_PIXELS, SMALLEST
from warp_ar.scene.pose_file import check_rotation, load_poses, pose_of_position, rotation_of_quaternion
from warp_ar.scene.scene_table import SceneTable

_SOURCES: Final = ("path", "camera", "synthetic")
_TRANSFERS: Final = '"srgb", "linear", "gamma:2.2" or the path of a measured response'
_NOMINAL_SIZE: Final = (640, 480)
"""Pixels of a guessed camera until its frames' size is known."""


def _exif_camera(table: SceneTable, source: object, transfer: str | Path) -> Camera:
    """The camera by the EXIF of the scene's own first picture."""
    path = source.get("path") if isinstance(source, dict) else None
    if not isinstance(path, str):
        table.fail("calibration", '"exif" reads the pictures of the scene: give [source] path; else a file or numbers')
    pictures = SceneTable(table.label, table.files, "source", source, keys_of(SourceSpec))
    return camera_by_exif(pictures.resolve("path", "pictures"), transfer)


def read_camera(table: SceneTable, source: object = None) -> Camera:
    """``[camera]``; ``source`` is the data of ``[source]``, whose first picture may tell the camera."""
    transfer = _read_transfer(table)
    if table.data.get("calibration") == "exif":
        for key in INTRINSICS:
            if key in table:
                table.fail(key, "not used beside calibration; give either EXIF or the numbers")
        return _exif_camera(table, source, transfer)
    if "calibration" in table:
        for key in INTRINSICS:
            if key in table:
                table.fail(key, "not used beside calibration; give either the file or the numbers")
        if "field_of_view" in table:
            table.fail("field_of_view", "not used beside calibration; give either the file or the guess")
        return load_calibration(table.file("calibration", "a calibration file"), transfer)
    if "field_of_view" in table:
        for key in INTRINSICS:
            if key in table:
                table.fail(key, "not used beside field_of_view; give either the numbers or the guess")
        field = table.number("field_of_view", low=5.0, high=150.0, unit="degrees")
        return Camera.guessed(*_NOMINAL_SIZE, field, transfer)
    if not any(key in table for key in INTRINSICS):
        names = ", ".join(INTRINSICS[:6])
        right = f"give {names}, or field_of_view, or calibration with the path of OpenCV's YAML or JSON"
        table.fail("width", right)
    return Camera(
        width=table.integer("width", low=1, high=MOST_PIXELS),
        height=table.integer("height", low=1, high=MOST_PIXELS),
        fx=table.number("fx", low=SMALLEST, unit="pixels"),
        fy=table.number("fy", low=SMALLEST, unit="pixels"),
        cx=table.number("cx", unit="pixels"),
        cy=table.number("cy", unit="pixels"),
        distortion=table.vector("distortion", Camera.distortion, sizes=(4, 5, 8)),
        transfer=transfer,
    )


def _read_transfer(table: SceneTable) -> str | Path:
    value = table.text("transfer", "srgb", right=_TRANSFERS)
    if value in ("srgb", "linear"):
        return value
    if value.startswith("gamma:"):
        try:
            gamma = float(value.removeprefix("gamma:"))
        except ValueError:
            gamma = math.nan
        if not 0.1 <= gamma <= 10.0:
            table.fail("transfer", 'expected a gamma from 0.1 to 10, such as "gamma:2.2"')
        return value
    path = table.resolve("transfer", _TRANSFERS)
    if not is_file(path):
        table.fail("transfer", f"expected {_TRANSFERS}; no such file: {path}")
    return path


def read_source(table: SceneTable) -> SourceSpec:
    """``[source]``."""
    given = [key for key in _SOURCES if key in table]
    if len(given) != 1:
        key = given[1] if given else "path"
        also = f"{given[0]} is given too; " if given else ""
        table.fail(key, f"{also}expected exactly one of path, camera and synthetic")
    path = table.resolve("path", "a folder of frames or a video") if "path" in table else None
    camera = table.integer("camera", low=0, high=1023) if "camera" in table else None
    if camera is not None and not table.files.has_camera(camera):
        table.fail("camera", "a scene from outside opens no capture device; start the program with --source")
    # Whether the path is there is asked when the source is opened: another source may stand in for it.
    return SourceSpec(
        path=path,
        camera=camera,
        synthetic=table.text("synthetic", right="the name of a generated source") if "synthetic" in table else None,
        fps=table.number("fps", low=1e-3, high=1e5, unit="frames per second") if "fps" in table else None,
        exposures=table.vector("exposures", sizes=range(2, 9), low=1e-6, high=1e3, unit="seconds")
        if "exposures" in table
        else None,
        shown=table.number("shown", low=1e-6, high=1e3, unit="seconds") if "shown" in table else None,
        metering=cast(Any, table.choice("metering", ("fixed", "automatic"), "fixed")) if "metering" in table else None,
    )


POSE_KEYS: Final = ("R", "t", "quaternion", "position", "rotate", "file")
_POSES: Final = "expected R and t, quaternion and t (both camera_from_world), position and rotate, or file"


def read_pose(table: SceneTable) -> PoseSpec:
    """``[pose]``."""
    given = [key for key in ("R", "quaternion", "position", "file") if key in table]
    if len(given) != 1:
        key = given[1] if given else "R"
        table.fail(key, f"{given[0]} is given too; {_POSES}" if given else _POSES)
    way = given[0]
    others = {"R": ("t",), "quaternion": ("t",), "position": ("rotate",), "file": ()}[way]
    for key in table.data:
        if key != way and key not in others:
            table.fail(key, f"not used with {way}; {_POSES}")
    if way == "file":
        path = table.file("file", "poses: COLMAP's images, OpenTrackIO, USD, or JSON")
        return PoseSpec(load_poses(path), path)
    if way == "position":
        rotate = table.vec3("rotate", (0.0, 0.0, 0.0), unit="degrees")
        return PoseSpec((pose_of_position(table.vec3("position", unit="metres"), rotate),))
    translation = table.vec3("t", unit="metres")
    if way == "R":
        rotation = table.vector("R", sizes=(9,))
        if not check_rotation(rotation):
            table.fail("R", "expected a rotation matrix, 9 numbers row by row: camera_from_world, as OpenCV has it")
        return PoseSpec(((rotation, translation),))
    w, x, y, z = table.vector("quaternion", sizes=(4,), low=-1e6, high=1e6)
    if w == x == y == z == 0.0:
        table.fail("quaternion", "has no length; expected w, x, y, z as COLMAP has them")
    return PoseSpec(((rotation_of_quaternion(w, x, y, z), translation),))


def read_exposure(table: SceneTable) -> Exposure:
    """``[exposure]``."""
    if table.data.get("scale") == "auto":
        return Exposure("auto")
    if isinstance(table.data.get("scale"), str):
        table.fail("scale", 'expected a number, 0 or more, or "auto"')
    return Exposure(table.number("scale", 1.0, low=0.0))
