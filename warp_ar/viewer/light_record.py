"""What ``/light.json`` says: harmonics of the environment, its key light, what is known of both. Loads Warp."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from warp_ar.errors import UsageError
from warp_ar.kernels.environment.irradiance import cosine_lobe
from warp_ar.light.captured import find_emitters, latlong_directions, texel_solid_angles
from warp_ar.output.environment_axes import CUBES, FACES, check_axes, to_cube, world_from_marker
from warp_ar.output.environment_file import write_environment
from warp_ar.output.environment_harmonics import BASIS, project_radiance
from warp_ar.output.radiance_hdr import encode_hdr
from warp_ar.scene import Pose
from warp_ar.signature import PROGRAM
from warp_ar.viewer.camera import written

_DEGREES: Final = (0, 1, 1, 1, 2, 2, 2, 2, 2)
_LOBE: Final = np.array([cosine_lobe(degree) for degree in _DEGREES])


@dataclasses.dataclass(frozen=True)
class LightState:
    """The light of a moment."""

    radiance: npt.NDArray[np.float32]
    """Latlong in this program's axes, linear RGB in camera values, (rows, columns, 3)."""
    exposure: float
    """Factor on the picture's radiance."""
    recovery: Mapping[str, Any]
    """What recovered light rests on, of ``recover``; empty where it does not run."""
    others: tuple[npt.NDArray[np.float32], ...] = ()
    """The same light at each mirror ball after the first, where it is interpolated."""
    places: tuple[tuple[float, float, float], ...] = ()
    """Where all those balls stand, the first one too, metres in the marker's frame."""


def describe(state: LightState, pose: Pose | None, axes: str) -> dict[str, Any]:
    """What ``/light.json`` says.

    Args:
        state: The light.
        pose: ``camera_from_world`` of the newest frame; None while the marker is lost.
        axes: One of ``AXES``.

    Raises:
        UsageError: There are no such axes.
    """
    check_axes(axes)
    turn = world_from_marker(axes)
    coefficients = project_radiance(state.radiance, axes)
    several = {"balls": _balls(state, turn, axes)} if state.others else {}
    return {
        "program": PROGRAM,
        "type": "light",
        "axes": axes,
        "world_from_marker": turn.ravel().tolist(),
        "basis": list(BASIS),
        "radiance": coefficients.tolist(),
        "irradiance": (coefficients * _LOBE[:, None]).tolist(),
        "key": key_light(state.radiance, turn),
        **several,
        "interval": _interval(state.recovery),
        "exposure": state.exposure,
        "whiteLevel": 1.0,
        "pose": None if pose is None else {"R": pose.rotation.ravel().tolist(), "t": pose.translation.tolist()},
    }


def _balls(state: LightState, turn: npt.NDArray[np.float64], axes: str) -> list[dict[str, Any]]:
    """The light at every mirror ball, the first one's too, and where it stands."""
    told = []
    for place, radiance in zip(state.places, (state.radiance, *state.others), strict=True):
        coefficients = project_radiance(radiance, axes)
        told.append(
            {
                "at": (turn @ np.array(place)).tolist(),
                "radiance": coefficients.tolist(),
                "irradiance": (coefficients * _LOBE[:, None]).tolist(),
                "key": key_light(radiance, turn),
            }
        )
    return told


def key_light(radiance: npt.NDArray[np.float32], turn: npt.NDArray[np.float64]) -> dict[str, Any] | None:
    """The emitter that brings most: where it is, what it brings, how far the light goes its way; None of no emitter.

    ``directionality`` is clamp(2 V . s / phi, 0, 1) with the flow V = integral of L d and phi = integral of L: 0 where
    light comes from everywhere, 1 for a sun in the dark.
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
    """Irradiance along the marker's axes and the interval that it lies in; None where light is not recovered."""
    if "irradiance_value" not in recovery:
        return None
    values = {name: recovery[f"irradiance_{name}"] for name in ("low", "value", "high")}
    return {"of": "irradiance of surfaces that face +x -x +y -y +z -z of the marker", **values}


def encode_picture(state: LightState, kind: str, axes: str, layout: str, size: int | None, ball: int = 0) -> bytes:
    """The environment at a ball as an ``exr`` or ``hdr``; arguments and errors as those of `write_environment`."""
    radiance = _at_ball(state, ball)
    return written(f"light.{kind}", lambda path: write_environment(path, radiance, axes=axes, layout=layout, size=size))


def _at_ball(state: LightState, ball: int) -> npt.NDArray[np.float32]:
    count = 1 + len(state.others)
    if not 0 <= ball < count:
        raise UsageError(f"ball = {ball}: {count} {'has' if count == 1 else 'have'} a light, counted from 0")
    return (state.radiance, *state.others)[ball]


def encode_face(state: LightState, axes: str, size: int | None, face: str, ball: int = 0) -> bytes:
    """One face of the cube, of ``FACES``, as HDR; arguments and errors as those of `to_cube`."""
    check_axes(axes, "cube")
    column = to_cube(_at_ball(state, ball), axes, size)
    edge, number = column.shape[1], FACES.index(face)
    picture = np.ascontiguousarray(column[number * edge : (number + 1) * edge])
    return encode_hdr(picture, CUBES[axes])
