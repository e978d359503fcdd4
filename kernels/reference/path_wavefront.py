"""Paths side by side as a wavefront of kernels, for a CUDA device.

In one loop (``path_tracer``) the threads of a warp soon do different things: one looks for a surface, another draws
directions at metal, a third asks what the frame shows, and all wait for each other. Here every path has a slot, and
what is next for it is done by a kernel of its own, whose threads take from a queue the slots for which it is next
[LKA13]:

    advance   light that reached the surface is added, the path goes on its next ray; a slot whose path has ended takes
              the next sample;
    find      what the rays meet;
    meet      light that they bring, and whether the path goes on;
    look      what the frame shows of proxies that they meet;
    shade     directions at surfaces: toward light, and in which paths go on;
    test      whether anything is in the way of light.

All that a path does is what ``path_following`` says, by the same functions with the same random numbers, and every
sample is written to its own place: in which slot it was followed, and in which order queues were filled, tells nowhere.

References:
    [LKA13] Laine, Karras, Aila, "Megakernels Considered Harmful: Wavefront Path Tracing on GPUs", HPG 2013.
"""

from __future__ import annotations

import functools

import numpy as np
import warp as wp

from warp_ar.kernels.launch import MOST_REGISTERS, launch
from warp_ar.kernels.materials import Surface
from warp_ar.kernels.rays.trace import TraceConfig, make_trace, offset_origin
from warp_ar.kernels.reference.path_following import (
    ENDED,
    RAY,
    SURFACE,
    DirectionSample,
    DirectLight,
    PathPair,
    PathState,
    add_direct,
    are_near_followed,
    draw_next,
    draw_toward_light,
    end_without,
    extend_path,
    is_first_white,
    leave_surface,
    lights_at,
    make_see_proxy,
    meet,
    next_density,
    reflected_from,
    take_seen,
    white_surface,
    with_virtual_content,
)
from warp_ar.kernels.reference.path_samples import Round
from warp_ar.kernels.reference.path_sampling import NO_DENSITY, PathKey, balance
from warp_ar.kernels.reference.path_starts import begin_path, camera_ray, sample_key, see, write_sample
from warp_ar.kernels.reference.path_vertices import (
    PROXY,
    LocalScene,
    Vertex,
    from_viewer,
    make_find_vertex,
    make_hidden_by_physical,
    make_look_up_material,
)
from warp_ar.kernels.structs import MIRROR, FrameParams

wp.set_module_options({"enable_backward": False})

EMPTY = wp.constant(3)
IDLE = wp.constant(4)
"""What is next for a slot beside ``SURFACE``, ``RAY`` and ``ENDED``: its first sample, or nothing any more."""

RAYS = wp.constant(0)
LOOKS = wp.constant(1)
PROXIES = wp.constant(2)
OBJECTS = wp.constant(3)
TESTS = wp.constant(4)
"""Queues, by what counts their slots; one for each source of light from ``TESTS`` on. ``PROXIES`` is filled from the
first place, ``OBJECTS`` from the last of the same array."""

NOT_ASKED = wp.constant(0)
BLOCKED = wp.constant(1)
REACHES = wp.constant(2)
HIDDEN = wp.constant(3)
"""Light on its way to a surface: reflected toward nowhere, met by something physical, by nothing, by an object."""

MOST_SLOTS = 1 << 22
"""Paths that are followed side by side at most; each takes half a kilobyte."""
ROUNDS_AHEAD = 8
"""Rounds of all kernels that are launched before it is asked whether any path is left."""


@wp.struct
class Wave:
    """Paths that are followed side by side, S of them, with light from L sources: the environment, virtual lights."""

    stages: wp.array[wp.int32]  # (S) what is next: SURFACE, RAY, ENDED, EMPTY or IDLE
    samples: wp.array[wp.int32]  # (S) the sample of the round that is followed
    keys: wp.array2d[wp.uint32]  # (words, S) of PathKey
    pairs: wp.array2d[wp.uint32]  # (words, S) of PathPair
    vertices: wp.array2d[wp.uint32]  # (words, S) of Vertex: what the ray met
    reflectances: wp.array[wp.vec3]  # (S) of a proxy there
    emissions: wp.array[wp.vec3]  # (S) radiance that the surface sends by itself
    following: wp.array2d[wp.uint32]  # (words, S) of PathState: the path on its next ray
    starts: wp.array2d[wp.vec3]  # (L, S) where a ray toward light starts
    toward: wp.array2d[wp.vec3]  # (L, S) its direction, unit
    distances: wp.array2d[wp.float32]  # (L, S) how far it goes
    arriving: wp.array2d[wp.vec3]  # (L, S) light that the surface then reflects, by its share
    reach: wp.array2d[wp.int32]  # (L, S) NOT_ASKED, BLOCKED, REACHES or HIDDEN
    taken: wp.array[wp.int32]  # (1) samples that have a slot or had one
    counts: wp.array[wp.int32]  # (TESTS + L) slots in the queues
    rays: wp.array[wp.int32]  # (S) queue of RAYS
    looks: wp.array[wp.int32]  # (S) queue of LOOKS
    shades: wp.array[wp.int32]  # (S) queues of PROXIES and OBJECTS
    tests: wp.array2d[wp.int32]  # (L, S) queues of TESTS


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    // Threads of a warp that are here for the same count add to it once.
    const unsigned same = __match_any_sync(__activemask(), index);
    const int lane = threadIdx.x & 31, first = __ffs(same) - 1;
    int place = 0;
    if (lane == first)
        place = atomicAdd(counts.data + index, __popc(same));
    return __shfl_sync(same, place, first) + __popc(same & ((1u << lane) - 1u));
#else
    return counts.data[index]++;
#endif
""")
def take_place(counts: wp.array[wp.int32], index: wp.int32) -> wp.int32:
    """Adds 1 to a count, and returns what it was."""


_LOAD = """
    // Word after word of neighbouring slots lie side by side.
    unsigned copy[sizeof({name}) / 4];
    const unsigned* word = (const unsigned*)words.data + slot;
    #pragma unroll
    for (unsigned k = 0; k < sizeof({name}) / 4; ++k)
        copy[k] = word[(size_t)k * words.shape[1]];
    #if defined(__CUDA_ARCH__)
    memcpy(&record, copy, sizeof({name}));
    #else
    __builtin_memcpy(&record, copy, sizeof({name}));
    #endif
"""
_STORE = """
    unsigned copy[sizeof({name}) / 4];
    #if defined(__CUDA_ARCH__)
    memcpy(copy, &record, sizeof({name}));
    #else
    __builtin_memcpy(copy, &record, sizeof({name}));
    #endif
    unsigned* word = (unsigned*)words.data + slot;
    #pragma unroll
    for (unsigned k = 0; k < sizeof({name}) / 4; ++k)
        word[(size_t)k * words.shape[1]] = copy[k];
"""


@wp.func_native(_LOAD.format(name=PathPair.native_name))
def load_pair(words: wp.array2d[wp.uint32], slot: wp.int32, record: wp.ref[PathPair]):
    """Read the pair of a slot."""


@wp.func_native(_STORE.format(name=PathPair.native_name))
def store_pair(words: wp.array2d[wp.uint32], slot: wp.int32, record: wp.ref[PathPair]):
    """Write the pair of a slot."""


@wp.func_native(_LOAD.format(name=PathState.native_name))
def load_state(words: wp.array2d[wp.uint32], slot: wp.int32, record: wp.ref[PathState]):
    """Read the path of a slot on its next ray."""


@wp.func_native(_STORE.format(name=PathState.native_name))
def store_state(words: wp.array2d[wp.uint32], slot: wp.int32, record: wp.ref[PathState]):
    """Write the path of a slot on its next ray."""


@wp.func_native(_LOAD.format(name=Vertex.native_name))
def load_vertex(words: wp.array2d[wp.uint32], slot: wp.int32, record: wp.ref[Vertex]):
    """Read what the ray of a slot met."""


@wp.func_native(_STORE.format(name=Vertex.native_name))
def store_vertex(words: wp.array2d[wp.uint32], slot: wp.int32, record: wp.ref[Vertex]):
    """Write what the ray of a slot met."""


@wp.func_native(_LOAD.format(name=PathKey.native_name))
def load_key(words: wp.array2d[wp.uint32], slot: wp.int32, record: wp.ref[PathKey]):
    """Read what makes the random numbers of a slot's path."""


@wp.func_native(_STORE.format(name=PathKey.native_name))
def store_key(words: wp.array2d[wp.uint32], slot: wp.int32, record: wp.ref[PathKey]):
    """Write what makes the random numbers of a slot's path."""


@wp.kernel(enable_backward=False, module="unique")
def advance_kernel(
    # In:
    params: wp.array[FrameParams],
    scene: LocalScene,
    asked: wp.int32,
    seed: wp.int32,
    first: wp.int32,
    done: wp.array2d[wp.int32],
    count: wp.int32,
    # Out:
    wave_out: Wave,
    samples_out: Round,
):
    """Bring paths from their surfaces onto their next rays, and let slots whose paths have ended take other samples."""
    slot = wp.tid()
    stage = wave_out.stages[slot]
    if stage == IDLE:
        return
    pair = PathPair()
    begins = stage == EMPTY
    lobe = bool(False)
    if not begins:
        load_pair(wave_out.pairs, slot, pair)
        if stage == SURFACE:
            with_virtual = with_virtual_content(pair)
            direct = DirectLight()
            if with_virtual:
                direct.changed = wave_out.emissions[slot]
            for source in range(wave_out.reach.shape[0]):
                reach = wave_out.reach[source, slot]
                if reach != NOT_ASKED:
                    pair.rays += 1
                if reach >= REACHES:
                    arriving = wave_out.arriving[source, slot]
                    direct = add_direct(direct, arriving, source == 0, reach == HIDDEN, pair.path, with_virtual)
            vertex = Vertex()
            load_vertex(wave_out.vertices, slot, vertex)
            following = PathState()
            load_state(wave_out.following, slot, following)
            pair = leave_surface(scene, vertex.hit, pair, direct, following)
        if pair.next == ENDED and pair.path.without:
            pair = end_without(pair)
        if pair.next == ENDED:
            write_sample(pair, wave_out.samples[slot], samples_out)
            begins = True
            # The gloss of what the pixel shows has a path of its own.
            lobe = pair.glossy and not pair.lobe
    if begins:
        k = wave_out.samples[slot]
        if not lobe:
            k = take_place(wave_out.taken, 0)
            if k >= count:
                wave_out.stages[slot] = IDLE
                return
            wave_out.samples[slot] = k
        key = sample_key(samples_out, k, seed, first, done)
        direction = camera_ray(params[0], scene.picture.rays, key)
        pair = begin_path(params[0].camera_position, direction, asked, lobe)
        if lobe:
            key.seed = ~key.seed
        store_key(wave_out.keys, slot, key)
    if stage != RAY:
        store_pair(wave_out.pairs, slot, pair)
        wave_out.stages[slot] = RAY
    wave_out.rays[take_place(wave_out.counts, RAYS)] = slot


@functools.cache
def make_find_kernel(trace: TraceConfig) -> wp.Kernel:
    """Kernel of ``find`` for the kinds of shape in ``trace``."""
    find_vertex = make_find_vertex(trace)

    @wp.kernel(enable_backward=False, module="unique", cuda_max_registers=MOST_REGISTERS)
    def find_kernel(
        # In:
        scene: LocalScene,
        # Out:
        wave_out: Wave,
    ):
        place = wp.tid()
        if place >= wave_out.counts[RAYS]:
            return
        slot = wave_out.rays[place]
        pair = PathPair()
        load_pair(wave_out.pairs, slot, pair)
        vertex = find_vertex(scene, pair.path.origin, pair.path.direction, not pair.path.without)
        store_vertex(wave_out.vertices, slot, vertex)

    return find_kernel


@wp.kernel(enable_backward=False, module="unique")
def meet_kernel(
    # In:
    scene: LocalScene,
    asked: wp.int32,
    # Out:
    wave_out: Wave,
    samples_out: Round,
):
    """Light that rays bring from what they met, and which queue is next for their paths."""
    place = wp.tid()
    if place >= wave_out.counts[RAYS]:
        return
    slot = wave_out.rays[place]
    pair = PathPair()
    load_pair(wave_out.pairs, slot, pair)
    vertex = Vertex()
    load_vertex(wave_out.vertices, slot, vertex)
    pair.rays += 1
    if pair.path.depth == 0:
        pair = see(scene, asked, vertex, pair, wave_out.samples[slot], samples_out)
    else:
        pair = meet(scene, vertex, pair)
    store_pair(wave_out.pairs, slot, pair)
    wave_out.stages[slot] = pair.next
    if pair.next == SURFACE:
        if vertex.kind != PROXY:
            wave_out.shades[wave_out.shades.shape[0] - 1 - take_place(wave_out.counts, OBJECTS)] = slot
        elif is_first_white(pair):
            wave_out.shades[take_place(wave_out.counts, PROXIES)] = slot
        else:
            wave_out.looks[take_place(wave_out.counts, LOOKS)] = slot


@functools.cache
def make_look_kernel(trace: TraceConfig) -> wp.Kernel:
    """Kernel of ``look`` for the kinds of shape in ``trace``."""
    see_proxy = make_see_proxy(trace)

    @wp.kernel(enable_backward=False, module="unique", cuda_max_registers=MOST_REGISTERS)
    def look_kernel(
        # In:
        params: wp.array[FrameParams],
        scene: LocalScene,
        # Out:
        wave_out: Wave,
    ):
        place = wp.tid()
        if place >= wave_out.counts[LOOKS]:
            return
        slot = wave_out.looks[place]
        vertex = Vertex()
        load_vertex(wave_out.vertices, slot, vertex)
        seen = see_proxy(params[0], scene, vertex)
        pair = PathPair()
        load_pair(wave_out.pairs, slot, pair)
        pair = take_seen(pair, seen)
        store_pair(wave_out.pairs, slot, pair)
        wave_out.stages[slot] = pair.next
        if pair.next == SURFACE:
            wave_out.reflectances[slot] = seen.reflectance
            wave_out.shades[take_place(wave_out.counts, PROXIES)] = slot

    return look_kernel


@functools.cache
def make_shade_kernel() -> wp.Kernel:
    """Kernel of ``shade``."""
    look_up_material = make_look_up_material()

    @wp.kernel(enable_backward=False, module="unique")
    def shade_kernel(
        # In:
        scene: LocalScene,
        # Out:
        wave_out: Wave,
    ):
        place = wp.tid()
        if place >= wave_out.counts[PROXIES] and place < wave_out.shades.shape[0] - wave_out.counts[OBJECTS]:
            return
        slot = wave_out.shades[place]
        pair = PathPair()
        load_pair(wave_out.pairs, slot, pair)
        path = pair.path
        key = PathKey()
        load_key(wave_out.keys, slot, key)
        vertex = Vertex()
        load_vertex(wave_out.vertices, slot, vertex)
        wo = -path.direction
        facing = from_viewer(vertex, wo)
        hit = facing.hit
        surface = Surface()
        if is_first_white(pair):
            surface = white_surface(scene, facing, pair.lobe)
        else:
            surface = look_up_material(scene, facing, wo, wave_out.reflectances[slot])
        wave_out.emissions[slot] = surface.emission
        following = PathState()
        is_mirror = surface.model == wp.static(int(MIRROR))
        sources = wave_out.reach.shape[0]
        asked = wp.where(is_mirror, 0, 1 + lights_at(scene, facing.kind, surface, pair))
        for source in range(sources):
            wave_out.reach[source, slot] = NOT_ASKED
        without_near = are_near_followed(scene, facing.kind, surface, pair)
        for index in range(asked + 1):
            is_next = index == asked
            drawn = DirectionSample()
            if is_next:
                drawn.direction = draw_next(scene, hit, surface, wo, path, key)
            else:
                drawn = draw_toward_light(scene, hit, surface, wo, path, index - 1, without_near, key)
            wi = drawn.direction
            reflected = reflected_from(surface, hit, wo, wi)
            if wp.max(reflected) > 0.0:
                start = offset_origin(hit.point, hit.geometric_normal, wi, hit.error)
                density = NO_DENSITY
                if not is_mirror and (is_next or drawn.density >= 0.0):
                    density = next_density(scene, hit, surface, wo, wi, path)
                if is_next:
                    following = extend_path(path, start, wi, reflected, density, without_near, key)
                else:
                    share = balance(drawn.times * drawn.density, density) / drawn.per
                    wave_out.arriving[index, slot] = share * wp.cw_mul(reflected, drawn.radiance)
                    wave_out.starts[index, slot] = start
                    wave_out.toward[index, slot] = wi
                    wave_out.distances[index, slot] = drawn.distance
                    wave_out.tests[index, take_place(wave_out.counts, TESTS + index)] = slot
        store_state(wave_out.following, slot, following)

    return shade_kernel


@functools.cache
def make_test_kernel(trace: TraceConfig) -> wp.Kernel:
    """Kernel of ``test`` for the kinds of shape in ``trace``."""
    hidden_by_physical = make_hidden_by_physical(trace)
    occluded_by_objects = make_trace(trace).occluded_by_objects

    @wp.kernel(enable_backward=False, module="unique", cuda_max_registers=MOST_REGISTERS)
    def test_kernel(
        # In:
        scene: LocalScene,
        # Out:
        wave_out: Wave,
    ):
        source, place = wp.tid()
        if place >= wave_out.counts[TESTS + source]:
            return
        slot = wave_out.tests[source, place]
        start = wave_out.starts[source, slot]
        wi = wave_out.toward[source, slot]
        distance = wave_out.distances[source, slot]
        reach = REACHES
        if hidden_by_physical(scene, start, wi, distance):
            reach = BLOCKED
        else:
            pair = PathPair()
            load_pair(wave_out.pairs, slot, pair)
            if with_virtual_content(pair):
                if occluded_by_objects(scene.rays, start, wi, distance):
                    reach = HIDDEN
        wave_out.reach[source, slot] = reach

    return test_kernel


def make_wave(slots: int, lights: int, device: wp.DeviceLike) -> Wave:
    """Room for paths that are followed side by side.

    Args:
        slots: How many, 1 or more.
        lights: Virtual lights in the scene.
        device: Where.
    """
    wave, sources = Wave(), lights + 1
    for name, kind in {"keys": PathKey, "pairs": PathPair, "vertices": Vertex, "following": PathState}.items():
        words = np.dtype(kind.numpy_dtype()).itemsize // 4
        setattr(wave, name, wp.empty((words, slots), dtype=wp.uint32, device=device))
    kinds = {"reflectances": wp.vec3, "emissions": wp.vec3}
    for name, kind in (kinds | dict.fromkeys(("stages", "samples", "rays", "looks", "shades"), wp.int32)).items():
        setattr(wave, name, wp.empty(slots, dtype=kind, device=device))
    kinds = {"starts": wp.vec3, "toward": wp.vec3, "distances": wp.float32, "arriving": wp.vec3}
    for name, kind in (kinds | {"reach": wp.int32, "tests": wp.int32}).items():
        setattr(wave, name, wp.empty((sources, slots), dtype=kind, device=device))
    wave.taken = wp.zeros(1, dtype=wp.int32, device=device)
    wave.counts = wp.zeros(int(TESTS) + sources, dtype=wp.int32, device=device)
    return wave


def follow_in_waves(
    trace: TraceConfig,
    params: wp.array[FrameParams],
    scene: LocalScene,
    done: wp.array2d[wp.int32],
    wave: Wave,
    samples_out: Round,
    *,
    count: int,
    asked: int,
    seed: int,
    first: int,
) -> None:
    """Trace the samples of a round, as ``path_tracer.trace_paths`` does.

    Args:
        trace: Kinds of shape in the scene.
        params: (1,) FrameParams: the camera.
        scene: All that paths meet.
        done: (H, W) samples of each pixel in rounds before.
        wave: Of ``make_wave``, for as many lights as the scene has.
        samples_out: Of ``list_samples``.
        count: Its samples.
        asked: As for ``trace_paths``.
        seed: Of the random numbers.
        first: Number of a pixel's first sample among those of the seed.
    """
    sources, slots = wave.reach.shape
    used = min(slots, max(count, 1))
    wave.stages.fill_(int(EMPTY))
    wave.taken.zero_()
    passes = (
        (advance_kernel, slots, [params, scene, asked, seed, first, done, count], [wave, samples_out]),
        (make_find_kernel(trace), used, [scene], [wave]),
        (meet_kernel, used, [scene, asked], [wave, samples_out]),
        (make_look_kernel(trace), used, [params, scene], [wave]),
        (make_shade_kernel(), slots, [scene], [wave]),
        (make_test_kernel(trace), (sources, used), [scene], [wave]),
    )
    left = True
    while left:
        for _ in range(ROUNDS_AHEAD):
            wave.counts.zero_()
            for kernel, size, inputs, outputs in passes:
                launch(kernel, size, inputs, outputs, device=done.device)
        left = bool(wave.counts[int(RAYS) : int(RAYS) + 1].numpy()[0])
