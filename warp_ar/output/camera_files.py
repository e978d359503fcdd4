"""Camera data for other programs: its track as OpenTrackIO samples, and its lens distortion as STMaps.

A track (``.jsonl``) has one sample of protocol version 1.0 per line. Distortion is left out, because OpenTrackIO's
models have other units than OpenCV's; STMaps contain it.

An STMap is a picture that gives compositors the source position of each pixel, to remove or apply lens distortion. Red
is s, from 0 at the left edge to 1 at the right; green is t, from 0 at the bottom to 1 at the top. Pixel centres are at
half-integers of the size: column j has s = (j + 0.5) / width. Values have 32 bits, because 16-bit floats cannot resolve
a pixel of a wide frame. Positions outside the frame are outside 0..1.
"""

from __future__ import annotations

import fractions
import json
import math
import uuid
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import OpenEXR

from warp_ar.exr_file import exr_header, store_exr
from warp_ar.files import store
from warp_ar.output.shot import FILM_WIDTH, Matrix, Shot
from warp_ar.scene import Camera
from warp_ar.scene.pixel_rays import pixel_rays, project

TRACK_SUFFIX = ".jsonl"

_SPACE = uuid.UUID("6f1f3c1e-8a4b-4e35-9f5e-0b8d8f0f7a11")
"""UUID namespace of the samples' identifiers; equal shots have equal identifiers."""


def write_track(path: Path, shot: Shot) -> list[Path]:
    """Write a sample for every frame that has a pose.

    Returns:
        The file that was written.

    Raises:
        SinkError: It cannot be written.
    """
    store(path, "".join(json.dumps(sample) + "\n" for sample in track_samples(shot)).encode())
    return [path]


def track_samples(shot: Shot) -> list[dict[str, Any]]:
    """Return the samples as JSON objects: z up, metres, degrees; with all angles 0, the camera faces +y."""
    camera = shot.camera
    pixel = 1e3 * FILM_WIDTH / camera.width
    rate = fractions.Fraction(shot.fps).limit_denominator(1001)
    static = {
        "camera": {
            "activeSensorPhysicalDimensions": {"width": pixel * camera.width, "height": pixel * camera.height},
            "activeSensorResolution": {"width": camera.width, "height": camera.height},
        }
    }
    lens = {
        "pinholeFocalLength": pixel * camera.fx,
        "projectionOffset": {
            "x": pixel * (camera.cx - 0.5 * (camera.width - 1)),
            "y": pixel * (camera.cy - 0.5 * (camera.height - 1)),
        },
    }
    samples = []
    for frame, placement in shot.camera_placements().items():
        # OpenTrackIO's camera faces +y with z up; this one faces -z with y up.
        turn = placement[:3, :3] @ np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
        pan, tilt, roll = track_angles(turn)
        x, y, z = placement[:3, 3].tolist()
        samples.append(
            {
                "program": "warp_ar",
                "protocol": {"name": "OpenTrackIO", "version": [1, 0, 0]},
                "sampleId": f"urn:uuid:{uuid.uuid5(_SPACE, f'{shot.scene.name} {frame}')}",
                "static": static,
                "timing": {
                    "mode": "internal",
                    "sampleRate": {"num": rate.numerator, "denom": rate.denominator},
                    "sequenceNumber": frame % 65536,
                },
                "lens": lens,
                "transforms": [
                    {
                        "id": "Camera",
                        "translation": {"x": x, "y": y, "z": z},
                        "rotation": {"pan": pan, "tilt": tilt, "roll": roll},
                    }
                ],
            }
        )
    return samples


def track_angles(turn: Matrix) -> tuple[float, float, float]:
    """Return pan, tilt and roll in degrees of a rotation Rz(pan) Rx(tilt) Ry(roll)."""
    tilt = math.asin(max(-1.0, min(1.0, float(turn[2, 1]))))
    if abs(turn[2, 1]) > 1.0 - 1e-12:  # straight up or down: pan and roll share one axis, and pan takes the whole angle
        return math.degrees(math.atan2(turn[1, 0], turn[0, 0])), math.degrees(tilt), 0.0
    pan, roll = math.atan2(-turn[0, 1], turn[1, 1]), math.atan2(-turn[2, 0], turn[2, 2])
    return math.degrees(pan), math.degrees(tilt), math.degrees(roll)


def undistort_map(camera: Camera) -> npt.NDArray[np.float32]:
    """Return s and t, (height, width, 2): the place in the frame of each pixel of an undistorted picture."""
    columns, rows = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    x, y = (columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy
    found = project(camera, np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3))
    return _coordinates(camera, found.reshape(camera.height, camera.width, 2))


def distort_map(camera: Camera) -> npt.NDArray[np.float32]:
    """Return s and t, (height, width, 2): the place in an undistorted picture of each pixel of the frame."""
    rays = pixel_rays(camera).astype(np.float64)
    return _coordinates(camera, rays * (camera.fx, camera.fy) + (camera.cx, camera.cy))


def _coordinates(camera: Camera, pixels: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    s = (pixels[..., 0] + 0.5) / camera.width
    t = 1.0 - (pixels[..., 1] + 0.5) / camera.height
    return np.stack([s, t], -1).astype(np.float32)


def write_stmap(path: Path, coordinates: npt.NDArray[np.float32]) -> None:
    """Write an STMap as OpenEXR: R is s, G is t, B is 0.

    Raises:
        SinkError: The file cannot be written.
    """
    values = np.concatenate([coordinates, np.zeros_like(coordinates[..., :1])], -1)
    store_exr(path, OpenEXR.File(exr_header(), {"RGB": np.ascontiguousarray(values)}))
