"""The camera's way as OpenTrackIO samples (``.jsonl``: one on each line), of protocol version 1.0.

Distortion is left out, whose models there are in other units than OpenCV's: STMaps tell it (see ``stmap``).
"""

from __future__ import annotations

import fractions
import json
import math
import uuid
from pathlib import Path
from typing import Any

import numpy as np

from warp_ar.errors import SinkError, reason
from warp_ar.files import write_whole
from warp_ar.output.shot import FILM_WIDTH, Matrix, Shot

TRACK_SUFFIX = ".jsonl"

_SPACE = uuid.UUID("6f1f3c1e-8a4b-4e35-9f5e-0b8d8f0f7a11")
"""Of the samples' identifiers, which are the same for the same shot."""


def write_track(path: Path, shot: Shot) -> list[Path]:
    """Write a sample for every frame that has a pose.

    Returns:
        The file that was written.

    Raises:
        SinkError: It cannot be written.
    """
    text = "".join(json.dumps(sample) + "\n" for sample in track_samples(shot))
    try:
        write_whole(path, text.encode())
    except OSError as error:
        raise SinkError(f"{path} cannot be written: {reason(error)}") from error
    return [path]


def track_samples(shot: Shot) -> list[dict[str, Any]]:
    """Samples as JSON has them: z up, metres, degrees; the camera looks along +y where its angles are 0."""
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
        # A camera of OpenTrackIO looks along its y, its z up; this one along its -z, its y up.
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
    """Pan, tilt and roll in degrees of a rotation Rz(pan) Rx(tilt) Ry(roll)."""
    tilt = math.asin(max(-1.0, min(1.0, float(turn[2, 1]))))
    if abs(turn[2, 1]) > 1.0 - 1e-12:  # straight up or down: pan and roll are about one axis, and pan takes all
        return math.degrees(math.atan2(turn[1, 0], turn[0, 0])), math.degrees(tilt), 0.0
    pan, roll = math.atan2(-turn[0, 1], turn[1, 1]), math.atan2(-turn[2, 0], turn[2, 2])
    return math.degrees(pan), math.degrees(tilt), math.degrees(roll)
