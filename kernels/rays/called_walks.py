"""Walks through the scene that a kernel calls by their address, on CPU, instead of holding them.

A walk through all kinds of shape is a long piece of code, and Clang took most of a start to compile it again for each
module with rays in it. Here it is compiled once, in the module of ``make_walks_kernel``, whose launch writes the walks'
addresses to a table; ``RayScene.walks`` says where the table lies, so that a kernel of another module can call them. A
call takes some nanoseconds more than code in place. On CUDA, where rays wait for registers and not for compilers,
kernels hold their walks, and nothing here is compiled in.

The table (``TABLE_SIZE`` words of 64 bits) belongs to one ``RayScene``: four addresses, then the scene itself as walks
read it, but for the shapes, which a call brings along. Which walks it points to is up to the scene: a kernel that calls
is the same for scenes with and without triangles that let rays pass.
"""

from __future__ import annotations

from typing import Final

import warp as wp

from warp_ar.kernels.structs import Hit, RayScene, Shape

wp.set_module_options({"enable_backward": False})

CLOSEST_OBJECT = wp.constant(0)
CLOSEST_PROXY = wp.constant(1)
ANY_OBJECT = wp.constant(2)
ANY_PROXY = wp.constant(3)
"""Places of addresses in the table."""

SCENE_AT: Final = 4
"""Where in the table the scene lies, in words."""

CLOSEST_TYPE: Final = (
    f"void (*)(unsigned long long, const {Shape.native_name}*, int,"
    f" float, float, float, float, float, float, float, {Hit.native_name}*)"
)
"""C++ type of a walk to the closest hit: table, shapes, how many, origin, direction, t_max; where to write the hit."""
ANY_TYPE: Final = (
    f"bool (*)(unsigned long long, const {Shape.native_name}*, int, float, float, float, float, float, float, float)"
)
"""C++ type of a walk to any hit."""

_CALL: Final = """
#if !defined(__CUDA_ARCH__)
    const unsigned long long* table = (const unsigned long long*)walks;
    using Walk = {type};
    if (shapes.shape[0] > 0)
        {result}((Walk)table[place])(walks, shapes.data, shapes.shape[0], origin[0], origin[1], origin[2],
            direction[0], direction[1], direction[2], t_max{out});
#endif
    {missed}
"""

_MISSED: Final = "hit_out.t = t_max; hit_out.shape = -1; hit_out.corner = -1;"


@wp.func_native(_CALL.format(type=CLOSEST_TYPE, result="return ", out=", &hit_out", missed=_MISSED))
def call_closest(
    walks: wp.uint64,
    place: wp.int32,
    shapes: wp.array[Shape],
    origin: wp.vec3,
    direction: wp.vec3,
    t_max: wp.float32,
    hit_out: wp.ref[Hit],
):
    """Write the closest hit among shapes, by the walk at a place of the table."""


@wp.func_native(_CALL.format(type=ANY_TYPE, result="return ", out="", missed="return false;"))
def call_any(
    walks: wp.uint64,
    place: wp.int32,
    shapes: wp.array[Shape],
    origin: wp.vec3,
    direction: wp.vec3,
    t_max: wp.float32,
) -> wp.bool:
    """Whether a ray meets any of the shapes, by the walk at a place of the table."""


@wp.func
def call_closest_object(scene: RayScene, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> Hit:
    """``Trace.closest_object``."""
    hit = Hit()
    call_closest(scene.walks, CLOSEST_OBJECT, scene.objects, origin, direction, t_max, hit)
    return hit


@wp.func
def call_closest_proxy(scene: RayScene, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> Hit:
    """``Trace.closest_proxy``."""
    hit = Hit()
    call_closest(scene.walks, CLOSEST_PROXY, scene.proxies, origin, direction, t_max, hit)
    return hit


@wp.func
def call_any_object(scene: RayScene, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> wp.bool:
    """``Trace.occluded_by_objects``."""
    return call_any(scene.walks, ANY_OBJECT, scene.objects, origin, direction, t_max)


@wp.func
def call_any_proxy(scene: RayScene, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> wp.bool:
    """``Trace.occluded_by_proxies``."""
    return call_any(scene.walks, ANY_PROXY, scene.proxies, origin, direction, t_max)


@wp.func
def call_any_of_both(scene: RayScene, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> wp.bool:
    """``Trace.occluded``."""
    if call_any(scene.walks, ANY_OBJECT, scene.objects, origin, direction, t_max):
        return True
    return call_any(scene.walks, ANY_PROXY, scene.proxies, origin, direction, t_max)
