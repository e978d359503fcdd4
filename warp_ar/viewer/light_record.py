"""Content of ``/light.json``: harmonics of the environment, its strongest emitter, and recovery status.

Importing this module loads Warp.
"""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_ar.errors import UsageError
from warp_ar.light.captured import find_emitters, latlong_directions, texel_solid_angles
from warp_ar.light.latlong_axes import world_from_marker
from warp_ar.output.environment_axes import BASIS, CUBES, FACES, LOBE, check_axes, project_radiance, to_cube
from warp_ar.output.environment_file import encode_hdr, write_environment
from warp_ar.scene import Pose
from warp_ar.signature import PROGRAM


@dataclasses.dataclass(frozen=True, eq=False)
class LightState:
    """Light at one moment."""

    radiance: npt.NDArray[np.float32]
    """Latlong map in the marker's axes (z up), linear RGB in camera values, (rows, columns, 3)."""
    exposure: float
    """Factor on the picture's radiance."""
    recovery: Mapping[str, Any]
    """Status of the stage ``recover``; empty if the stage does not run."""
    others: tuple[npt.NDArray[np.float32], ...] = ()
    """Latlong maps of the other mirror balls, if light is interpolated between balls."""
    places: tuple[tuple[float, float, float], ...] = ()
    """Centres of the balls, the first included, metres in the marker's frame."""


def describe(state: LightState, pose: Pose | None, axes: str) -> dict[str, Any]:
    """Return the content of ``/light.json``.

    Args:
        state: The light.
        pose: ``camera_from_world`` of the newest frame; None while the marker is lost.
        axes: One of ``AXES``.

    Raises:
        UsageError: ``axes`` is not one of ``AXES``.
    """
    check_axes(axes)
    turn = world_from_marker(axes)
    lights = [_describe_ball(radiance, turn, axes) for radiance in (state.radiance, *state.others)]
    places = [(turn @ np.array(place)).tolist() for place in state.places]
    several = {"balls": [{"at": at, **light} for at, light in zip(places, lights, strict=True)]} if state.others else {}
    return {
        "program": PROGRAM,
        "type": "light",
        "axes": axes,
        "world_from_marker": turn.ravel().tolist(),
        "basis": list(BASIS),
        **lights[0],
        **several,
        "interval": _interval(state.recovery),
        "exposure": state.exposure,
        "whiteLevel": 1.0,
        "pose": None if pose is None else {"R": pose.rotation.ravel().tolist(), "t": pose.translation.tolist()},
    }


def _describe_ball(radiance: npt.NDArray[np.float32], turn: npt.NDArray[np.float64], axes: str) -> dict[str, Any]:
    coefficients = project_radiance(radiance, axes)
    irradiance = (coefficients * LOBE[:, None]).tolist()
    return {"radiance": coefficients.tolist(), "irradiance": irradiance, "key": key_light(radiance, turn)}


def key_light(radiance: npt.NDArray[np.float32], turn: npt.NDArray[np.float64]) -> dict[str, Any] | None:
    """Return the strongest emitter: direction, irradiance, solid angle and directionality; None if there is none.

    ``directionality`` is clamp(2 V . s / phi, 0, 1) with the emitter's direction s, the flow V = integral of L d and
    phi = integral of L. It is 0 for uniform light and 1 for a single small emitter in the dark.
    """
    found = find_emitters(radiance, np.zeros_like(radiance), 0.0)
    if not found:
        return None
    emitter = found[0]
    height = len(radiance)
    weight = radiance.mean(2) * texel_solid_angles(height)
    flow = (latlong_directions(height) * weight[..., None]).sum((0, 1))
    direction = np.array(emitter.direction)
    share = 2.0 * float(flow @ direction) / max(float(weight.sum()), 1e-30)
    return {
        "direction": (turn @ direction).tolist(),
        "irradiance": list(emitter.power),
        "solid_angle": emitter.solid_angle,
        "directionality": min(max(share, 0.0), 1.0),
    }


def _interval(recovery: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the irradiance along the marker's axes with its interval; None if clipped light is not recovered."""
    if "irradiance_value" not in recovery:
        return None
    values = {name: recovery[f"irradiance_{name}"] for name in ("low", "value", "high")}
    return {"of": "irradiance of surfaces that face +x -x +y -y +z -z of the marker", **values}


def encode_picture(state: LightState, kind: str, axes: str, layout: str, size: int | None, ball: int = 0) -> bytes:
    """Return the environment at a ball as ``exr`` or ``hdr``; see `write_environment` for arguments and errors."""
    radiance = _at_ball(state, ball)
    return written(f"light.{kind}", lambda path: write_environment(path, radiance, axes=axes, layout=layout, size=size))


def _at_ball(state: LightState, ball: int) -> npt.NDArray[np.float32]:
    count = 1 + len(state.others)
    if not 0 <= ball < count:
        raise UsageError(f"ball = {ball}: {count} {'has' if count == 1 else 'have'} a light, counted from 0")
    return (state.radiance, *state.others)[ball]


def encode_face(state: LightState, axes: str, size: int | None, face: str, ball: int = 0) -> bytes:
    """Return one face of the cube map, one of ``FACES``, as HDR; see `to_cube` for arguments and errors."""
    check_axes(axes, "cube")
    column = to_cube(_at_ball(state, ball), axes, size)
    edge, number = column.shape[1], FACES.index(face)
    picture = np.ascontiguousarray(column[number * edge : (number + 1) * edge])
    return encode_hdr(picture, CUBES[axes])


def written(name: str, write: Callable[[Path], object]) -> bytes:
    """Return the bytes that ``write`` writes into a temporary file of that name."""
    with tempfile.TemporaryDirectory(prefix="warp_ar_live_") as folder:
        path = Path(folder) / name
        write(path)
        return path.read_bytes()
