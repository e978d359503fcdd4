"""What tests and benches of kernels hand to launchers: records of structs, shapes, tables, a constant environment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ar.kernels import color
from warp_ar.kernels.rays.trace import TraceConfig
from warp_ar.kernels.structs import Material
from warp_ar.scene import Pose, Scene
from warp_ar.scene.kinds import trace_config
from warp_ar.stages.base import Pass
from warp_ar.stages.shared.lighting import shares_kernels

SMALL_CAMERA = """[camera]
width = 64
height = 48
fx = 60.0
fy = 60.0
cx = 31.5
cy = 23.5
"""
"""Section of a scene file: frames so small that a test lights many."""

SMALL_DESK = f"""schema = 1
name = "test"
{SMALL_CAMERA}[marker]
size = 0.1
[probe]
center = [0.1, 0.0, 0.03]
radius = 0.03
"""
"""A scene file with that camera, a marker and a ball."""

TEXTURES = tuple(name for name in Material.vars if name.endswith("_texture"))
"""Fields of a material that are the index of a texture, or -1."""


def records(struct: Any, *values: dict[str, Any], device: Any = None) -> wp.array:
    """An array of structs, one for each dictionary; fields that it leaves out are zero."""
    out = np.zeros(len(values), np.dtype(struct.numpy_dtype()))
    for record, value in zip(out, values, strict=True):
        for key, item in value.items():
            record[key] = item
    return wp.array(out, dtype=struct, device=device)


def look_at(eye: Any, target: Any = (0.0, 0.0, 0.0)) -> Pose:
    """Pose of a camera at ``eye`` whose axis goes through ``target``, its x axis level."""
    forward = np.subtract(target, eye).astype(np.float64)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 0.0, 1.0) if abs(forward[2]) < 0.99 else (0.0, 1.0, 0.0))
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Pose(rotation, -rotation @ np.asarray(eye, np.float64))


def camera_fields(position: Any, turn: Any, focal: float, size: tuple[int, int]) -> dict[str, Any]:
    """Fields of ``FrameParams`` of a camera, of which ``turn`` is ``world_from_camera``.

    Its axis meets the middle of a picture of so many rows and columns.
    """
    middle = (size[1] - 1) / 2, (size[0] - 1) / 2
    return {"camera_position": position, "world_from_camera": turn, "focal": (focal, focal), "principal": middle}


def shape(kind: int, position: Any, extent: Any, material: int = -1) -> dict[str, Any]:
    """Fields of a ``Shape`` that is not turned."""
    place = {"kind": kind, "rotation": np.eye(3), "position": position, "scale": 1.0}
    return {**place, "extent": extent, "material": material}


def as_compiled(config: Any, **options: Any) -> Any:
    """A configuration as pipelines compile it: on CPU, where scenes share kernels, the general one."""
    return config.general(**options) if shares_kernels(wp.get_device()) else config


def trace_of(objects: Sequence[dict[str, Any]], proxies: Sequence[dict[str, Any]], **detail: bool) -> TraceConfig:
    """Kinds of these shapes, as pipelines compile them."""
    kinds = (tuple(sorted({int(one["kind"]) for one in shapes})) for shapes in (objects, proxies))
    found: TraceConfig = as_compiled(TraceConfig(*kinds, **detail))
    return found


def proxies_of(scene: Scene) -> tuple[int, ...]:
    """Kinds of a scene's proxies, as pipelines compile them."""
    found: tuple[int, ...] = as_compiled(trace_config(scene)).proxies
    return found


def tables(transfer: str = "srgb") -> tuple[wp.array, wp.array]:
    """Tables to decode codes, and to encode radiance."""
    return (
        wp.array(color.decode_table(transfer), dtype=wp.vec3),
        wp.array(color.encode_table(transfer), dtype=wp.vec3),
    )


def constant_environment(radiance: Any) -> npt.NDArray[np.float32]:
    """Spherical harmonics of E = pi L, the same for every normal."""
    sh = np.zeros((9, 3), np.float32)
    sh[0] = np.pi * np.asarray(radiance) / 0.28209479
    return sh


def launch_passes(passes: Sequence[Pass], bands: int) -> None:
    """A stage's passes one after another; those over rows in so many bands."""
    for step in passes:
        if bands == 1 or step.rows is None:
            step.launch(None)
        else:
            for band in range(bands):
                step.launch((step.rows * band // bands, step.rows * (band + 1) // bands))
