"""Rays through a mesh's triangles by the tree of a ``wp.Mesh``.

The traversal is that of ``wp.mesh_query_ray`` [AL09]: the nearer child first, the farther one is pushed on a stack. The
test of a triangle is cheaper. Warp picks the ray's axes by indices, which puts vectors into local memory, divides anew
to shear each triangle, and reads a list to find its corners. Here axes and shear are computed once per ray, and corner
k of face f is point 3 f + k (``warp_ar.scene.ray_mesh``). So kernels also spill fewer registers. The code depends on
Warp's internal ``Mesh``, ``BVH`` and packed nodes.

The test of a triangle is Warp's: watertight [WBW13], edge functions by Kahan's product of differences, whose sign is
exact. Directions along an axis take 1e-30 for zero: 1 / 0 times a distance of 0 would be no number. Boxes with a margin
(``make_ray_mesh``) are never touched so by a ray that meets what is in them; others may be.

References:
    [AL09] Aila, Laine, "Understanding the Efficiency of Ray Traversal on GPUs", HPG 2009.
    [WBW13] Woop, Benthin, Wald, "Watertight Ray/Triangle Intersection", JCGT 2(1), 2013.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

STACK = 32
"""Size of the stack: each level holds at most one pending node, and trees built by Warp have up to 31 levels."""

_WALK = """
    #if defined(__CUDA_ARCH__)
    #define WP_AR_LOAD(address) __ldg(address)
    #else
    #define WP_AR_LOAD(address) (*(address))
    #endif
    const wp::Mesh mesh = wp::mesh_get(mesh_id);
    const float* points = (const float*)mesh.points.data;
    const float smallest = 1.0e-30f;
    const wp::vec3 inverse(
        1.0f / (wp::abs(direction[0]) < smallest ? wp::copysign(smallest, direction[0]) : direction[0]),
        1.0f / (wp::abs(direction[1]) < smallest ? wp::copysign(smallest, direction[1]) : direction[1]),
        1.0f / (wp::abs(direction[2]) < smallest ? wp::copysign(smallest, direction[2]) : direction[2])
    );
    // Triangles are sheared so that the ray runs along +z of permuted axes.
    const float across = wp::abs(direction[0]), along = wp::abs(direction[1]), up = wp::abs(direction[2]);
    const bool x_first = across > along && across > up, y_first = !x_first && along > up;
    const int kz = x_first ? 0 : y_first ? 1 : 2;
    int kx = x_first ? 1 : y_first ? 2 : 0, ky = x_first ? 2 : y_first ? 0 : 1;
    const float dz = x_first ? direction[0] : y_first ? direction[1] : direction[2];
    float dx = x_first ? direction[1] : y_first ? direction[2] : direction[0];
    float dy = x_first ? direction[2] : y_first ? direction[0] : direction[1];
    const float oz = x_first ? origin[0] : y_first ? origin[1] : origin[2];
    float ox = x_first ? origin[1] : y_first ? origin[2] : origin[0];
    float oy = x_first ? origin[2] : y_first ? origin[0] : origin[1];
    if (dz < 0.0f) {{
        const int k = kx; kx = ky; ky = k;
        const float d = dx; dx = dy; dy = d;
        const float o = ox; ox = oy; oy = o;
    }}
    const float shear_x = dx / dz, shear_y = dy / dz, scale = 1.0f / dz;

    // A node in one word: its two numbers, children or the ends of a list of triangles, and which of the two they are.
    const auto pack = [](const wp::BVHPackedNodeHalf& lower, const wp::BVHPackedNodeHalf& upper) {{
        return (wp::uint64(lower.b) << 62) | (wp::uint64(upper.i) << 31) | wp::uint64(lower.i);
    }};
    const int root = *mesh.bvh.root;

    float t_near = t_max;
    {found}
    wp::uint64 stack[{stack}];
    int waiting = 0;
    wp::uint64 node = pack(
        wp::bvh_load_node(mesh.bvh.node_lowers, root), wp::bvh_load_node(mesh.bvh.node_uppers, root));
    while (true) {{
        const int first = (wp::int32)(node & 0x7fffffffu), second = (wp::int32)((node >> 31) & 0x7fffffffu);
        if (node >> 62) {{
            for (int at = first; at < second; ++at) {{
                const int face = WP_AR_LOAD(mesh.bvh.primitive_indices + at);
                const float* corner = points + 9 * face;
                const float az = WP_AR_LOAD(corner + kz) - oz;
                const float bz = WP_AR_LOAD(corner + 3 + kz) - oz;
                const float cz = WP_AR_LOAD(corner + 6 + kz) - oz;
                const float ax = (WP_AR_LOAD(corner + kx) - ox) - shear_x * az;
                const float ay = (WP_AR_LOAD(corner + ky) - oy) - shear_y * az;
                const float bx = (WP_AR_LOAD(corner + 3 + kx) - ox) - shear_x * bz;
                const float by = (WP_AR_LOAD(corner + 3 + ky) - oy) - shear_y * bz;
                const float cx = (WP_AR_LOAD(corner + 6 + kx) - ox) - shear_x * cz;
                const float cy = (WP_AR_LOAD(corner + 6 + ky) - oy) - shear_y * cz;
                const float u = wp::diff_product(cx, by, cy, bx);
                const float v = wp::diff_product(ax, cy, ay, cx);
                const float w = wp::diff_product(bx, ay, by, ax);
                const bool below = u < 0.0f || v < 0.0f || w < 0.0f, above = u > 0.0f || v > 0.0f || w > 0.0f;
                const float determinant = u + v + w;
                if ((below && above) || determinant == 0.0f)
                    continue;
                const float over = 1.0f / determinant;
                const float t = (u * (scale * az) + v * (scale * bz) + w * (scale * cz)) * over;
                if (t >= 0.0f && t < t_near) {{
                    {meet}
                }}
            }}
        }} else {{
            const wp::BVHPackedNodeHalf first_lower = wp::bvh_load_node(mesh.bvh.node_lowers, first);
            const wp::BVHPackedNodeHalf first_upper = wp::bvh_load_node(mesh.bvh.node_uppers, first);
            const wp::BVHPackedNodeHalf second_lower = wp::bvh_load_node(mesh.bvh.node_lowers, second);
            const wp::BVHPackedNodeHalf second_upper = wp::bvh_load_node(mesh.bvh.node_uppers, second);
            float t0 = t_near, t1 = t_near;
            const bool meets_first = wp::intersect_ray_aabb(
                origin, inverse, wp::vec3(first_lower.x, first_lower.y, first_lower.z),
                wp::vec3(first_upper.x, first_upper.y, first_upper.z), t0) && t0 < t_near;
            const bool meets_second = wp::intersect_ray_aabb(
                origin, inverse, wp::vec3(second_lower.x, second_lower.y, second_lower.z),
                wp::vec3(second_upper.x, second_upper.y, second_upper.z), t1) && t1 < t_near;
            if (meets_first || meets_second) {{
                const wp::uint64 one = pack(first_lower, first_upper);
                const wp::uint64 two = pack(second_lower, second_upper);
                const bool first_next = meets_first && (!meets_second || t0 < t1);
                node = first_next ? one : two;
                if (meets_first && meets_second && waiting < {stack})
                    stack[waiting++] = first_next ? two : one;
                continue;
            }}
        }}
        if (waiting == 0)
            return {missed};
        node = stack[--waiting];
    }}
    #undef WP_AR_LOAD
"""
_CLOSEST = """
                    t_near = t;
                    u_near = u * over;
                    v_near = v * over;
                    face_near = face;"""


@wp.func_native(
    _WALK.format(
        stack=STACK,
        found="float u_near = 0.0f, v_near = 0.0f; int face_near = -1;",
        meet=_CLOSEST,
        missed="wp::vec4(t_near, u_near, v_near, (float&)face_near)",
    )
)
def find_closest_face(mesh_id: wp.uint64, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> wp.vec4:
    """Return (t, u, v, index) of the closest triangle before ``t_max``; the index, or -1, is the bits of a float."""


@wp.func_native(_WALK.format(stack=STACK, found="", meet="return true;", missed="false"))
def meets_any_face(mesh_id: wp.uint64, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> wp.bool:
    """Return whether a ray meets a triangle before ``t_max``."""
