"""Animations of a glTF file: which nodes move, and by which keyframes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from warp_ar.scene.gltf_arrays import GltfArrays
from warp_ar.scene.mesh_assets import fail, objects
from warp_ar.scene.mesh_parts import LARGEST
from warp_ar.scene.node_animation import INTERPOLATIONS, WIDTHS, Sampler

_SHORTEST: Final = 1e-12
"""Length of a quaternion that still is a direction."""


@dataclasses.dataclass(frozen=True, eq=False)
class GltfAnimation:
    """One animation of a file."""

    samplers: Mapping[int, Mapping[str, Sampler]]
    """By node, then by the property that they move."""
    duration: float
    """Time of the last key, in seconds."""


def animation_names(path: Path, header: dict[str, Any]) -> list[str]:
    """Names of a file's animations, by number; empty where one has none.

    Raises:
        SceneError: They are no list of objects.
    """
    return [str(item.get("name", ""))[:60] for item in objects(path, header, "animations")]


def moves_morph_targets(path: Path, header: dict[str, Any], wanted: str | int | None) -> bool:
    """Whether an animation, or with None any, has a channel that moves morph targets.

    Raises:
        SceneError: There is no such animation, or it is damaged.
    """
    items = objects(path, header, "animations")
    if wanted is not None:
        items = [items[_find(path, animation_names(path, header), wanted)]]
    targets = (channel.get("target") for item in items for channel in objects(path, item, "channels"))
    return any(isinstance(target, dict) and target.get("path") == "weights" for target in targets)


def read_animation(
    path: Path,
    header: dict[str, Any],
    arrays: GltfArrays,
    wanted: str | int,
    note: Callable[[str], None],
) -> GltfAnimation:
    """Read one animation.

    Args:
        path: The file, for messages.
        header: Its JSON.
        arrays: Its accessors.
        wanted: Name of the animation, or its number from 0 on.
        note: Takes what is not shown.

    Raises:
        SceneError: There is no such animation, or it is damaged.
    """
    items, number = objects(path, header, "animations"), _find(path, animation_names(path, header), wanted)
    item, label = items[number], f"animation {number}"
    known: dict[tuple[int, str], Sampler] = {}
    found: dict[int, dict[str, Sampler]] = {}
    samplers, count = objects(path, item, "samplers"), len(objects(path, header, "nodes"))
    for channel in objects(path, item, "channels"):
        target = channel.get("target")
        if not isinstance(target, dict):
            fail(path, f"{label} has a channel without a target")
        prop = target.get("path")
        if not isinstance(prop, str) or prop not in WIDTHS:
            if prop != "weights":  # what is said of morph targets, `moves_morph_targets` tells
                note(f"animated {str(prop)[:30]}")
            continue
        if target.get("node") is None:  # said by an extension, if at all
            continue
        node = _index(path, target["node"], count, f"{label} moves node")
        index = _index(path, channel.get("sampler"), len(samplers), f"{label} has a channel of sampler")
        if prop in found.setdefault(node, {}):
            fail(path, f"{label} moves the {prop} of node {node} twice")
        if (index, prop) not in known:
            known[index, prop] = _read_sampler(path, samplers[index], arrays, prop, f"{label}, sampler {index}")
        found[node][prop] = known[index, prop]
    duration = max((float(sampler.times[-1]) for sampler in known.values()), default=0.0)
    return GltfAnimation(found, duration)


def _find(path: Path, names: list[str], wanted: str | int) -> int:
    if not names:
        fail(path, "it has no animation; leave out the object's animation")
    if isinstance(wanted, int):
        if not 0 <= wanted < len(names):
            fail(path, f"animation {wanted} is asked for; it has {len(names)}, counted from 0")
        return wanted
    if wanted not in names:
        known = ", ".join(repr(name) for name in names[:8]) + (", ..." if len(names) > 8 else "")
        fail(path, f"animation {wanted!r} is asked for; it has {known}")
    return names.index(wanted)


def _index(path: Path, value: object, count: int, what: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < count:
        fail(path, f"{what} {str(value)[:20]}; there are {count}, counted from 0")
    return value


def _read_sampler(path: Path, item: dict[str, Any], arrays: GltfArrays, prop: str, label: str) -> Sampler:
    way, width = item.get("interpolation", "LINEAR"), WIDTHS[prop]
    if way not in INTERPOLATIONS:
        fail(path, f"{label} has the interpolation {str(way)[:20]!r}; {', '.join(INTERPOLATIONS)} are right")
    times = np.asarray(arrays.read(item.get("input"), f"{label}: input", (1,)), dtype=np.float64)[:, 0]
    values = np.asarray(arrays.read(item.get("output"), f"{label}: output", (width,)), dtype=np.float64)
    count, each = len(times), 3 if way == "CUBICSPLINE" else 1
    if not count:
        fail(path, f"{label} has no keyframe")
    if not (np.abs(times) < LARGEST).all() or (np.diff(times) < 0.0).any() or times[0] < 0.0:
        fail(path, f"{label} has times that are not finite, below 0, or not in order")
    if len(values) != each * count:
        fail(path, f"{label} has {count} times and {len(values)} values; {each * count} are right")
    if not (np.abs(values) < LARGEST).all():
        fail(path, f"{label} has a value that is not finite, or above {LARGEST:g}")
    shaped: npt.NDArray[np.float64] = values.reshape(count, 3, width) if each == 3 else values
    keys = shaped[:, 1] if each == 3 else shaped
    if prop == "rotation" and not (np.linalg.norm(keys, axis=1) > _SHORTEST).all():
        fail(path, f"{label} has a rotation without length")
    return Sampler(times, shaped, way, prop == "rotation")
