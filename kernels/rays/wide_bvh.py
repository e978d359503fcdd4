"""Rays through triangles on a CPU: a tree whose nodes hold eight boxes, and whose leaves hold eight triangles.

Warp's own trees have two children per node, which suits a GPU, where 32 rays go side by side. A CPU has one ray at a
time and eight lanes: a node with eight boxes keeps them busy with that one ray [EG08], [DHK08]. Here a ray is tested
against eight boxes by some twenty instructions, and against eight triangles by some sixty, in Clang's vectors; where a
processor has narrower lanes, the compiler takes several steps.

A tree is an array of float32, read in blocks of 16 (64 bytes). A node is four blocks: lower x of its eight children,
lower y, lower z, upper x, upper y, upper z, and as integers where the children lie: at block c if c >= 0, a leaf at
block ~c if not; then ``BEFORE`` and ``LAST``. The root is at block 0. A leaf is five blocks: x, y and z of the eight
first corners, of the second and of the third, and as integers the triangles' numbers. Children that a node lacks are
boxes that no ray meets, of an empty leaf, which lies after the root: rays that are no numbers end, too. Triangles that
a leaf lacks are points.

Boxes are larger than their triangles by a margin that covers the rounding of a slab's bounds;
``kernels/rays/shapes.py``
says why no ray then slips through. Triangles are tested as Warp does, so that both devices agree: watertight [WBW13],
edge functions by Kahan's product of differences, whose sign is exact. Directions along an axis take 1e-30 for zero:
1 / 0 times a distance of 0 would be no number.

Building: parts of a node are split in two until there are eight or all fit a leaf, the part with the largest surface
first; each split minimises the surface-area heuristic over ``BINS`` bins of centroids along each axis [Wal07]. Splits
that take a single triangle off would make a deep tree; below ``MOST_DEPTH`` parts are halved, so that none is deeper
than the walk's stack. Where triangles move, boxes follow them from the last made node to the root; who has which
children stays.

References:
    [DHK08] Dammertz, Hanika, Keller, "Shallow Bounding Volume Hierarchies for Fast SIMD Ray Tracing of Incoherent
    Rays", EGSR 2008.
    [EG08] Ernst, Greiner, "Multi Bounding Volume Hierarchies", IEEE RT 2008.
    [Wal07] Wald, "On fast Construction of SAH-based Bounding Volume Hierarchies", IEEE RT 2007.
    [WBW13] Woop, Benthin, Wald, "Watertight Ray/Triangle Intersection", JCGT 2(1), 2013.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from warp_ar.kernels.structs import vec8

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

WIDTH = wp.constant(8)
"""Children of a node, and triangles of a leaf."""
BINS = wp.constant(16)
"""Places along an axis at which a split is tried."""
MOST_DEPTH = 20
"""Nodes above one another that are split by surface area. Below it each node has eighths of its triangles: another 10
for 2^31, so 7 * 30 entries wait at most on the walk's stack."""
BLOCK = wp.constant(16)
"""Numbers of a block."""
NODE_BLOCKS = wp.constant(4)
LEAF_BLOCKS = wp.constant(5)
BEFORE = wp.constant(56)
"""Place in a node of the node that was made before it, -1: it is the root. Children are made after their parents."""
LAST = wp.constant(57)
"""Place in the root of the node that was made last."""

STACK = 256
"""Entries of the walk's stack."""

vec8i = wp.types.vector(length=8, dtype=wp.int32)

# ---- walking ---------------------------------------------------------------------------------------------------------

_WALK = """
#if defined(__CUDA_ARCH__)
    return {missed};
#else
    #pragma clang fp contract(off)
    typedef float Lanes __attribute__((ext_vector_type(8), aligned(4)));
    typedef bool Bits __attribute__((ext_vector_type(8)));
    #define WP_AR_MASK(condition) __builtin_bit_cast(unsigned char, __builtin_convertvector(condition, Bits))
    #define WP_AR_LESS(a, b) ((a) < (b) ? (a) : (b))
    #define WP_AR_MORE(a, b) ((a) > (b) ? (a) : (b))
    const float* blocks = (const float*)tree;

    // The near and the far bound of each axis, as offsets into a node.
    Lanes inverse[3], start[3];
    int near_at[3], far_at[3];
    for (int axis = 0; axis < 3; ++axis) {{
        float slope = direction[axis];
        if (__builtin_fabsf(slope) < 1.0e-30f)
            slope = __builtin_copysignf(1.0e-30f, slope);
        inverse[axis] = 1.0f / slope;
        start[axis] = origin[axis];
        near_at[axis] = 8 * axis + (slope < 0.0f ? 24 : 0);
        far_at[axis] = 8 * axis + (slope < 0.0f ? 0 : 24);
    }}
    // Triangles are sheared so that the ray runs along +z of permuted axes.
    int kz = 0;
    for (int axis = 1; axis < 3; ++axis)
        if (__builtin_fabsf(direction[axis]) > __builtin_fabsf(direction[kz]))
            kz = axis;
    int kx = (kz + 1) % 3, ky = (kz + 2) % 3;
    if (direction[kz] < 0.0f) {{
        const int swapped = kx;
        kx = ky;
        ky = swapped;
    }}
    const Lanes shear_x = direction[kx] / direction[kz], shear_y = direction[ky] / direction[kz];
    const Lanes scale = 1.0f / direction[kz];
    // a b - c d, to a rounding or two: its sign is exact.
    const auto difference = [](Lanes a, Lanes b, Lanes c, Lanes d) {{
        const Lanes cd = c * d;
        return __builtin_elementwise_fma(a, b, -cd) + __builtin_elementwise_fma(-c, d, cd);
    }};

    float t_near = t_max, u_near = 0.0f, v_near = 0.0f;
    int face_near = -1, place = 0, waiting = 0;
    int places[{stack}];
    {distances}
    while (true) {{
        if (place >= 0) {{
            const float* node = blocks + 16 * (long long)place;
            const int* children = (const int*)(node + 48);
            Lanes enter = 0.0f, leave = t_near;
            for (int axis = 0; axis < 3; ++axis) {{
                const Lanes first = (*(const Lanes*)(node + near_at[axis]) - start[axis]) * inverse[axis];
                const Lanes last = (*(const Lanes*)(node + far_at[axis]) - start[axis]) * inverse[axis];
                enter = WP_AR_MORE(first, enter);
                leave = WP_AR_LESS(last, leave);
            }}
            unsigned met = WP_AR_MASK(enter <= leave);
            if (met) {{
                {descend}
                continue;
            }}
        }} else {{
            const float* leaf = blocks + 16 * (long long)~place;
            Lanes x[3], y[3], z[3];
            for (int corner = 0; corner < 3; ++corner) {{
                const float* at = leaf + 24 * corner;
                z[corner] = *(const Lanes*)(at + 8 * kz) - start[kz];
                x[corner] = (*(const Lanes*)(at + 8 * kx) - start[kx]) - shear_x * z[corner];
                y[corner] = (*(const Lanes*)(at + 8 * ky) - start[ky]) - shear_y * z[corner];
            }}
            const Lanes u = difference(x[2], y[1], y[2], x[1]);
            const Lanes v = difference(x[0], y[2], y[0], x[2]);
            const Lanes w = difference(x[1], y[0], y[1], x[0]);
            const Lanes least = WP_AR_LESS(WP_AR_LESS(u, v), w), most = WP_AR_MORE(WP_AR_MORE(u, v), w);
            unsigned met = WP_AR_MASK((least >= 0.0f) | (most <= 0.0f));
            if (met) {{
                const Lanes determinant = u + v + w, inverse_determinant = 1.0f / determinant;
                const Lanes t = (u * (scale * z[0]) + v * (scale * z[1]) + w * (scale * z[2])) * inverse_determinant;
                met &= WP_AR_MASK((determinant != 0.0f) & (t >= 0.0f) & (t < t_near));
                {meet}
            }}
        }}
        {go_on}
    }}
    #undef WP_AR_MASK
    #undef WP_AR_LESS
    #undef WP_AR_MORE
#endif
"""

# The nearest child is next; the others wait, the farthest lowest on the stack.
_DESCEND_SORTED = """
                int next = __builtin_ctz(met);
                float t_next = enter[next];
                next = children[next];
                const int bottom = waiting;
                while (met &= met - 1) {
                    const int lane = __builtin_ctz(met);
                    int other = children[lane];
                    float t_other = enter[lane];
                    if (t_other < t_next) {
                        const int place_before = next;
                        next = other;
                        other = place_before;
                        const float t_before = t_next;
                        t_next = t_other;
                        t_other = t_before;
                    }
                    int at = waiting++;
                    for (; at > bottom && distances[at - 1] < t_other; --at) {
                        places[at] = places[at - 1];
                        distances[at] = distances[at - 1];
                    }
                    places[at] = other;
                    distances[at] = t_other;
                }
                place = next;"""
_MEET_CLOSEST = """
                for (; met; met &= met - 1) {
                    const int lane = __builtin_ctz(met);
                    if (t[lane] < t_near) {
                        t_near = t[lane];
                        u_near = u[lane] * inverse_determinant[lane];
                        v_near = v[lane] * inverse_determinant[lane];
                        face_near = ((const int*)(leaf + 72))[lane];
                    }
                }"""
_GO_ON_NEARER = """
        do {
            if (waiting == 0)
                return wp::vec4(t_near, u_near, v_near, __builtin_bit_cast(float, face_near));
            --waiting;
        } while (distances[waiting] >= t_near);
        place = places[waiting];"""

# Any order will do: the walk ends with the first triangle.
_DESCEND = """
                place = children[__builtin_ctz(met)];
                while (met &= met - 1)
                    places[waiting++] = children[__builtin_ctz(met)];"""
_MEET_ANY = """
                if (met)
                    return true;"""
_GO_ON = """
        if (waiting == 0)
            return false;
        place = places[--waiting];"""


@wp.func_native(
    _WALK.format(
        missed="wp::vec4(t_max, 0.0f, 0.0f, 0.0f)",
        distances=f"float distances[{STACK}];",
        stack=STACK,
        descend=_DESCEND_SORTED,
        meet=_MEET_CLOSEST,
        go_on=_GO_ON_NEARER,
    )
)
def walk_closest(tree: wp.uint64, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> wp.vec4:
    """T of the closest triangle before ``t_max``, its first two barycentric weights, the bits of its number or -1."""


@wp.func_native(_WALK.format(missed="false", distances="", stack=STACK, descend=_DESCEND, meet=_MEET_ANY, go_on=_GO_ON))
def walk_any(tree: wp.uint64, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> wp.bool:
    """Return whether a ray meets a triangle before ``t_max``."""


# ---- building --------------------------------------------------------------------------------------------------------


@wp.func
def half_area(lower: wp.vec3, upper: wp.vec3) -> wp.float32:
    """Half the surface of a box."""
    e = upper - lower
    return e[0] * e[1] + e[1] * e[2] + e[2] * e[0]


@wp.func
def find_bin(middle: wp.float32, low: wp.float32, bins_per_length: wp.float32) -> wp.int32:
    """Bin of a centroid."""
    return wp.clamp(wp.int32((middle - low) * bins_per_length), 0, BINS - 1)


@wp.struct
class Building:
    """Input of the construction of a tree, and its working memory."""

    lower: wp.array[wp.vec3]  # boxes, with their margins
    upper: wp.array[wp.vec3]
    order: wp.array[wp.int32]  # triangles, those of a part one after another
    bin_lower: wp.array[wp.vec3]
    bin_upper: wp.array[wp.vec3]
    bin_count: wp.array[wp.int32]
    right_area: wp.array[wp.float32]
    tasks: wp.array[wp.vec4i]  # nodes to be: start and stop in order, number that tells where they lie, depth


@wp.func
def split_part(b: Building, start: wp.int32, stop: wp.int32) -> wp.int32:
    """Order the triangles of a part by the best split; returns where the second half starts."""
    low = wp.vec3(wp.inf, wp.inf, wp.inf)
    high = -low
    for k in range(start, stop):
        middle = 0.5 * (b.lower[b.order[k]] + b.upper[b.order[k]])
        low = wp.min(low, middle)
        high = wp.max(high, middle)
    best = wp.float32(wp.inf)
    best_axis = wp.int32(-1)
    best_bin = wp.int32(0)
    for axis in range(3):
        if high[axis] > low[axis]:
            scale = wp.float32(BINS) / (high[axis] - low[axis])
            for k in range(BINS):
                b.bin_count[k] = 0
                b.bin_lower[k] = wp.vec3(wp.inf, wp.inf, wp.inf)
                b.bin_upper[k] = -wp.vec3(wp.inf, wp.inf, wp.inf)
            for k in range(start, stop):
                triangle = b.order[k]
                lower = b.lower[triangle]
                upper = b.upper[triangle]
                place = find_bin(0.5 * (lower[axis] + upper[axis]), low[axis], scale)
                b.bin_count[place] = b.bin_count[place] + 1
                b.bin_lower[place] = wp.min(b.bin_lower[place], lower)
                b.bin_upper[place] = wp.max(b.bin_upper[place], upper)
            box_lower = wp.vec3(wp.inf, wp.inf, wp.inf)
            box_upper = -box_lower
            for step in range(BINS - 1):
                k = BINS - 1 - step
                box_lower = wp.min(box_lower, b.bin_lower[k])
                box_upper = wp.max(box_upper, b.bin_upper[k])
                b.right_area[k] = half_area(box_lower, box_upper)
            box_lower = wp.vec3(wp.inf, wp.inf, wp.inf)
            box_upper = -box_lower
            count = wp.int32(0)
            for k in range(BINS - 1):
                box_lower = wp.min(box_lower, b.bin_lower[k])
                box_upper = wp.max(box_upper, b.bin_upper[k])
                count += b.bin_count[k]
                if count > 0 and count < stop - start:
                    cost = half_area(box_lower, box_upper) * wp.float32(count)
                    cost += b.right_area[k + 1] * wp.float32(stop - start - count)
                    if cost < best:
                        best = cost
                        best_axis = axis
                        best_bin = k
    if best_axis < 0:
        return (start + stop) // 2
    scale = wp.float32(BINS) / (high[best_axis] - low[best_axis])
    first = wp.int32(start)
    last = wp.int32(stop - 1)
    while first <= last:
        triangle = b.order[first]
        centroid = 0.5 * (b.lower[triangle][best_axis] + b.upper[triangle][best_axis])
        if find_bin(centroid, low[best_axis], scale) <= best_bin:
            first += 1
        else:
            b.order[first] = b.order[last]
            b.order[last] = triangle
            last -= 1
    return first


@wp.func
def bound_part(b: Building, start: wp.int32, stop: wp.int32) -> wp.types.matrix(shape=(2, 3), dtype=wp.float32):
    """Box of a part."""
    lower = b.lower[b.order[start]]
    upper = b.upper[b.order[start]]
    for k in range(start + 1, stop):
        lower = wp.min(lower, b.lower[b.order[k]])
        upper = wp.max(upper, b.upper[b.order[k]])
    return wp.matrix_from_rows(lower, upper)


@wp.kernel(enable_backward=False)
def build_wide_bvh_kernel(
    most_depth: wp.int32,
    # In:
    b: Building,
    # Out:
    tree_out: wp.array[wp.float32],
    blocks_out: wp.array[wp.int32],
):
    """One thread: writes a tree while there is room, and how many blocks it takes, or more than there are.

    ``refit_wide_bvh_kernel`` writes its boxes and its triangles' corners.
    """
    distant = tree_out.shape[0] // BLOCK
    for lane in range(WIDTH):
        tree_out[NODE_BLOCKS * BLOCK + 9 * WIDTH + lane] = wp.cast(wp.int32(-1), wp.float32)
    blocks = wp.int32(NODE_BLOCKS + LEAF_BLOCKS)
    made_before = wp.int32(-1)
    tasks = wp.int32(1)
    b.tasks[0] = wp.vec4i(0, b.order.shape[0], -1, 0)
    while tasks > 0 and blocks <= distant:
        tasks -= 1
        task = b.tasks[tasks]
        node = wp.int32(0)
        if task[2] >= 0:
            node = blocks
            blocks += NODE_BLOCKS
            tree_out[task[2]] = wp.cast(node, wp.float32)
        starts = vec8i()
        stops = vec8i()
        areas = vec8()
        starts[0] = task[0]
        stops[0] = task[1]
        parts = wp.int32(1)
        pick = wp.int32(0)
        while parts < WIDTH and pick >= 0:
            pick = wp.int32(-1)
            largest = wp.float32(-1.0)
            for k in range(parts):
                if stops[k] - starts[k] > WIDTH:
                    size = areas[k]
                    if task[3] >= most_depth:
                        size = wp.float32(stops[k] - starts[k])
                    if size > largest:
                        largest = size
                        pick = k
            if pick >= 0:
                middle = (starts[pick] + stops[pick]) // 2
                if task[3] < most_depth:
                    middle = split_part(b, starts[pick], stops[pick])
                starts[parts] = middle
                stops[parts] = stops[pick]
                stops[pick] = middle
                box = bound_part(b, starts[pick], stops[pick])
                areas[pick] = half_area(box[0], box[1])
                box = bound_part(b, starts[parts], stops[parts])
                areas[parts] = half_area(box[0], box[1])
                parts += 1

        if blocks + WIDTH * LEAF_BLOCKS <= distant:
            at = node * BLOCK
            tree_out[at + BEFORE] = wp.cast(made_before, wp.float32)
            made_before = node
            for k in range(WIDTH):
                tree_out[at + 6 * WIDTH + k] = wp.cast(wp.int32(-1 - NODE_BLOCKS), wp.float32)
                if k < parts and stops[k] - starts[k] > WIDTH:
                    b.tasks[tasks] = wp.vec4i(starts[k], stops[k], at + 6 * WIDTH + k, task[3] + 1)
                    tasks += 1
                elif k < parts:
                    tree_out[at + 6 * WIDTH + k] = wp.cast(-1 - blocks, wp.float32)
                    for lane in range(WIDTH):
                        triangle = wp.int32(-1)
                        if starts[k] + lane < stops[k]:
                            triangle = b.order[starts[k] + lane]
                        tree_out[blocks * BLOCK + 9 * WIDTH + lane] = wp.cast(triangle, wp.float32)
                    blocks += LEAF_BLOCKS
        else:
            blocks = distant + 1
    tree_out[LAST] = wp.cast(made_before, wp.float32)
    blocks_out[0] = blocks


@wp.kernel(enable_backward=False)
def refit_wide_bvh_kernel(
    margin: wp.float32,
    # In:
    corners: wp.array[wp.vec3],
    # Out:
    tree_out: wp.array[wp.float32],
):
    """One thread: puts a tree's triangles where their corners are and boxes around them, the last made node first."""
    around = wp.vec3(margin, margin, margin)
    node = wp.cast(tree_out[LAST], wp.int32)
    while node >= 0:
        at = node * BLOCK
        for k in range(WIDTH):
            lower = wp.vec3(wp.inf, wp.inf, wp.inf)
            upper = -lower
            child = wp.cast(tree_out[at + 6 * WIDTH + k], wp.int32)
            for lane in range(WIDTH):
                if child >= 0:
                    low = child * BLOCK + lane
                    high = low + 3 * WIDTH
                    lower = wp.min(lower, wp.vec3(tree_out[low], tree_out[low + WIDTH], tree_out[low + 2 * WIDTH]))
                    upper = wp.max(upper, wp.vec3(tree_out[high], tree_out[high + WIDTH], tree_out[high + 2 * WIDTH]))
                else:
                    leaf = (-1 - child) * BLOCK + lane
                    triangle = wp.cast(tree_out[leaf + 9 * WIDTH], wp.int32)
                    if triangle >= 0:
                        for corner in range(3):
                            place = corners[3 * triangle + corner]
                            for axis in range(3):
                                tree_out[leaf + 24 * corner + 8 * axis] = place[axis]
                            lower = wp.min(lower, place - around)
                            upper = wp.max(upper, place + around)
            for axis in range(3):
                tree_out[at + WIDTH * axis + k] = lower[axis]
                tree_out[at + WIDTH * (3 + axis) + k] = upper[axis]
        node = wp.cast(tree_out[at + BEFORE], wp.int32)


def refit_wide_bvh(tree: wp.array, corners: wp.array, margin: float) -> None:
    """Have a tree hold its triangles where they are now.

    Args:
        tree: Of ``build_wide_bvh``.
        corners: Corner k of triangle f is the (3 f + k)-th.
        margin: By how much boxes are larger than their triangles, in the same unit.
    """
    wp.launch(refit_wide_bvh_kernel, 1, [margin, corners], [tree], device="cpu")


def build_wide_bvh(corners: np.ndarray, margin: float, *, most_depth: int = MOST_DEPTH) -> wp.array:
    """Build a tree for ``walk_closest`` and ``walk_any``, on the CPU.

    Args:
        corners: Of one triangle or more, (n, 3, 3), float32.
        margin: By how much boxes are larger than their triangles, in the same unit.
        most_depth: Nodes above one another from which on parts are halved, ``MOST_DEPTH`` at most.

    Returns:
        The tree, float32; its address is what the walks take.
    """
    count = len(corners)
    scratch = {"bin_lower": wp.vec3, "bin_upper": wp.vec3, "bin_count": wp.int32, "right_area": wp.float32}
    with wp.ScopedDevice("cpu"):
        b = Building()
        b.lower = wp.array(corners.min(axis=1) - np.float32(margin), dtype=wp.vec3)
        b.upper = wp.array(corners.max(axis=1) + np.float32(margin), dtype=wp.vec3)
        b.order = wp.array(np.arange(count), dtype=wp.int32)
        for name, dtype in scratch.items():
            setattr(b, name, wp.zeros(int(BINS), dtype=dtype))
        # Every node that waits has more than eight triangles of its own.
        b.tasks = wp.zeros(count // int(WIDTH) + 2, dtype=wp.vec4i)
        used = wp.zeros(1, dtype=wp.int32)
        blocks = 2 * count + 64
        while True:
            tree = wp.zeros(blocks * int(BLOCK), dtype=wp.float32)
            wp.launch(build_wide_bvh_kernel, 1, [most_depth, b], [tree, used])
            needed = int(used.numpy()[0])
            if needed <= blocks:
                tree = wp.array(tree.numpy()[: needed * int(BLOCK)], dtype=wp.float32)
                refit_wide_bvh(tree, wp.array(corners.reshape(-1, 3), dtype=wp.vec3), margin)
                return tree
            blocks *= 2
