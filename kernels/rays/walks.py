"""The module of the walks that kernels on CPU call by their address, and the table that says where they lie.

``kernels/rays/called_walks.py`` has the other side: how they are called, and what the table holds.
"""

from __future__ import annotations

import functools
from typing import Any, Final

import warp as wp

from warp_ar.kernels.launch import Note, do_or_note
from warp_ar.kernels.rays.called_walks import (
    ANY_OBJECT,
    ANY_PROXY,
    ANY_TYPE,
    CLOSEST_OBJECT,
    CLOSEST_PROXY,
    CLOSEST_TYPE,
    SCENE_AT,
)
from warp_ar.kernels.rays.trace import ALL_KINDS, make_walks
from warp_ar.kernels.structs import Hit, RayScene, Shape

wp.set_module_options({"enable_backward": False})

_KEPT: dict[int, Any] = {}
"""Loaded code that tables point to: never unloaded, whatever becomes of the module that it was loaded for."""

# A lambda's arguments are values of their own, and no other code calls its walk: Clang makes one piece of code of both.
_ENTRY: Final = """
    {{
        using Walk = {type};
        const Walk walk = [](unsigned long long walks, const {shape}* shapes, int count, float ox, float oy, float oz,
            float dx, float dy, float dz, float t_max{out}) {{
            const {scene}& scene = *(const {scene}*)(walks + 8 * {scene_at});
            {result}{walk}(scene, wp::array_t<{shape}>(const_cast<{shape}*>(shapes), count), wp::vec3(ox, oy, oz),
                wp::vec3(dx, dy, dz), t_max);
        }};
        {places} = (unsigned long long)walk;
    }}
"""


def _entry(walk: wp.Function, places: list[int], closest: bool) -> str:
    """C++ that puts the address of a walk in its places of the table."""
    return _ENTRY.format(
        places=" = ".join(f"table.data[{place}]" for place in places),
        type=CLOSEST_TYPE if closest else ANY_TYPE,
        shape=Shape.native_name,
        scene=RayScene.native_name,
        scene_at=SCENE_AT,
        out=f", {Hit.native_name}* hit" if closest else "",
        result="*hit = " if closest else "return ",
        walk=walk.native_func,
    )


def _entries(objects: wp.Function, proxies: wp.Function, places: tuple[int, int], closest: bool) -> str:
    """C++ for the walk through objects and the one through proxies, which may be the same."""
    if objects is proxies:
        return _entry(objects, [*places], closest)
    return _entry(objects, [places[0]], closest) + _entry(proxies, [places[1]], closest)


@functools.cache
def make_walks_kernel(detail: bool, stretched: bool) -> wp.Kernel:
    """Kernel of one thread that writes the addresses of its module's walks to a table; for CPU.

    Args:
        detail: Whether any object's triangles let rays pass or have normal maps.
        stretched: Whether any object may be stretched.
    """
    closest_object, any_object = make_walks(ALL_KINDS, detail, stretched)
    closest_proxy, any_proxy = make_walks(ALL_KINDS, False, False)
    snippet = _entries(closest_object, closest_proxy, (CLOSEST_OBJECT, CLOSEST_PROXY), True)
    snippet += _entries(any_object, any_proxy, (ANY_OBJECT, ANY_PROXY), False)

    @wp.func_native(snippet)
    def write_addresses(table: wp.array[wp.uint64]):
        """Addresses of the walks."""

    @wp.kernel(module="unique", enable_backward=False)
    def walks_kernel(
        # Out:
        table: wp.array[wp.uint64],
    ):
        # Never run, and gone before Clang inlines: Warp compiles what a kernel calls, and knows nothing of snippets.
        never = wp.int32(0)
        if never > 0:
            scene = RayScene()
            zero = wp.vec3(0.0, 0.0, 0.0)
            closest_object(scene, scene.objects, zero, zero, 0.0)
            closest_proxy(scene, scene.proxies, zero, zero, 0.0)
            any_object(scene, scene.objects, zero, zero, 0.0)
            any_proxy(scene, scene.proxies, zero, zero, 0.0)
        write_addresses(table)

    return walks_kernel


def write_walks(detail: bool, stretched: bool, table: wp.array) -> None:
    """Write where the walks lie, once they are compiled and loaded: at once, unless launches are noted.

    Args:
        detail: Whether any object's triangles let rays pass or have normal maps.
        stretched: Whether any object may be stretched.
        table: On CPU; its first four words are written.
    """
    kernel = make_walks_kernel(detail, stretched)

    def do() -> None:
        wp.launch(kernel, 1, [], [table], device=table.device)
        _KEPT.update((id(loaded), loaded) for loaded in kernel.module.execs.values())

    do_or_note(Note(kernel, None, do))
