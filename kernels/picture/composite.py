"""The picture: the camera's frame, what virtual light adds to it, and the virtual objects over it.

    radiance = (1 - alpha) (frame * shadow_ratio + added_light + mirror_ball) + virtual

in linear light; ``virtual`` is premultiplied by its coverage alpha. A pixel that none of these layers changes keeps
the frame's code bit for bit, whatever the transfer. Layers count only inside their rectangle of ``FrameParams``: what
an earlier frame left elsewhere is not seen, and not read.

What is drawn ends at the codes where the camera's channels saturate, but no darker than the frame is there: beside its
lamps, nothing else is as bright.
"""

from __future__ import annotations

import dataclasses
import functools

import warp as wp

from warp_ar.kernels.color import ENCODE_KEYS, below_saturation, decode, encode, saturation_codes
from warp_ar.kernels.launch import Rows, launch_rows
from warp_ar.kernels.picture.codes import (
    WARP_LANES,
    WARP_PIXELS,
    by_warps,
    get_code,
    load_codes,
    row_parts,
    set_code,
    store_codes,
)
from warp_ar.kernels.rays.visibility import inside_rect
from warp_ar.kernels.structs import FrameParams

wp.set_module_options({"enable_backward": False})


@dataclasses.dataclass(frozen=True)
class CompositeConfig:
    """Which layers there are; the others are not compiled in."""

    virtual: bool = False
    """Virtual objects."""
    added: bool = False
    """Virtual light on the receiver."""
    ratio: bool = False
    """Shadows of the environment, a factor on the frame."""
    mirror_ball: bool = False
    """What mirror balls show of what is virtual, a change of the frame."""

    def general(self) -> CompositeConfig:
        """For any scene: layers that it lacks may then be empty."""
        return CompositeConfig(True, True, True, True)


@wp.struct
class Layers:
    """What is laid over the frame, (H, W) each; what a ``CompositeConfig`` leaves out may be empty."""

    objects: wp.array2d[wp.vec4]  # ``virtual``, which C++ keeps for itself: premultiplied linear radiance and coverage
    added: wp.array2d[wp.vec3]  # linear radiance
    ratio: wp.array2d[wp.vec3]  # factor on the frame's linear radiance
    mirror_ball: wp.array2d[wp.vec3]  # change of linear radiance


@wp.struct
class LayersAt:
    """``Layers`` at one pixel."""

    objects: wp.vec4
    added: wp.vec3
    ratio: wp.vec3
    mirror_ball: wp.vec3


@functools.cache
def make_read_layers(config: CompositeConfig) -> wp.Function:
    """``read_layers(params, layers, row, col) -> LayersAt``.

    A layer that is not there, or does not reach the pixel, changes nothing: it is 0, or a ratio of 1. All are read
    before any is looked at: one after another would be as many times the memory's latency.
    """

    @wp.func(module="unique")
    def read_layers(params: wp.array[FrameParams], layers: Layers, row: wp.int32, col: wp.int32) -> LayersAt:
        at = LayersAt()
        at.ratio = wp.vec3(1.0, 1.0, 1.0)
        if wp.static(config.virtual):
            if layers.objects.shape[0] > 0 and inside_rect(row, col, params[0].object_rect):
                at.objects = layers.objects[row, col]
        if wp.static(config.added):
            if layers.added.shape[0] > 0 and inside_rect(row, col, params[0].light_rect):
                at.added = layers.added[row, col]
        if wp.static(config.ratio):
            if layers.ratio.shape[0] > 0 and inside_rect(row, col, params[0].shadow_rect):
                at.ratio = layers.ratio[row, col]
        if wp.static(config.mirror_ball):
            if layers.mirror_ball.shape[0] > 0 and inside_rect(row, col, params[0].ball_rect):
                at.mirror_ball = layers.mirror_ball[row, col]
        return at

    return read_layers


@wp.func
def is_changed(at: LayersAt) -> wp.bool:
    """Whether layers touch a pixel; NaN does."""
    neutral = at.objects == wp.vec4(0.0, 0.0, 0.0, 0.0) and at.added == wp.vec3(0.0, 0.0, 0.0)
    neutral = neutral and at.ratio == wp.vec3(1.0, 1.0, 1.0) and at.mirror_ball == wp.vec3(0.0, 0.0, 0.0)
    return not neutral


@wp.func
def compose(radiance: wp.vec3, at: LayersAt) -> wp.vec3:
    """All layers over the frame's radiance; no more is taken from it than there is."""
    physical = wp.max(wp.cw_mul(radiance, at.ratio) + at.added + at.mirror_ball, wp.vec3(0.0, 0.0, 0.0))
    return (1.0 - at.objects[3]) * physical + wp.vec3(at.objects[0], at.objects[1], at.objects[2])


# A row on CPU, sixteen pixels at a time: their 48 values go side by side through the processor's vectors, all but the
# tables' look-ups; a block that no layer touches is copied. Every product and sum is rounded by itself and in the order
# of ``compose``, ``encode_channel`` and ``below_saturation``, which it equals in all bits.
@wp.func_native(
    """
#if !defined(__CUDA_ARCH__)
    #pragma clang fp contract(off)
    constexpr int N = 16;
    const int width = frame.shape[1];
    const unsigned char* codes = reinterpret_cast<const unsigned char*>(frame.data) + size_t(row) * 3 * width;
    unsigned char* out = reinterpret_cast<unsigned char*>(image.data) + size_t(row) * 3 * width;
    const float* decoded = reinterpret_cast<const float*>(decode_table.data);
    const float* table = reinterpret_cast<const float*>(encode_table.data);
    wp::int32 level[3] = {255, 255, 255};
    if (decode_table.shape[0] > 256)
        for (int c = 0; c < 3; ++c) level[c] = static_cast<wp::int32>(decoded[3 * 256 + c] + 0.5f);
    const bool ends = level[0] < 255 || level[1] < 255 || level[2] < 255;

    // Columns that each layer reaches in this row, and where it lies.
    struct Layer { const float* at; int start, stop; };
    auto reach = [&](const auto& array, const wp::vec_t<4, wp::int32>& rect, int bit) {
        Layer layer = {nullptr, 0, 0};
        if ((kept & bit) && array.shape[0] > 0 && row >= rect[0] && row < rect[1]) {
            layer.at = reinterpret_cast<const float*>(array.data) + size_t(row) * width * (sizeof(*array.data) / 4);
            layer.start = rect[2] > 0 ? rect[2] : 0;
            layer.stop = rect[3] < width ? rect[3] : width;
        }
        return layer;
    };
    const Layer objects = reach(layers.objects, params.object_rect, 1);
    const Layer added = reach(layers.added, params.light_rect, 2);
    const Layer ratio = reach(layers.ratio, params.shadow_rect, 4);
    const Layer mirror_ball = reach(layers.mirror_ball, params.ball_rect, 8);

    auto overlaps = [](const Layer& layer, int j) { return j < layer.stop && j + N > layer.start; };
    auto take = [&](float* into, const Layer& layer, int j, float neutral) {
        if (j >= layer.start && j + N <= layer.stop) {
            memcpy(into, layer.at + 3 * j, 3 * N * sizeof(*into));
            return;
        }
        for (int i = 0; i < 3 * N; ++i) {
            const int column = j + i / 3;
            into[i] = column >= layer.start && column < layer.stop ? layer.at[3 * j + i] : neutral;
        }
    };

    // Colour and coverage of N pixels, coverage three times: value 3 k + c of pixel k is number 4 k + c.
    typedef float Lanes __attribute__((vector_size(64), aligned(4)));
    auto spread = [](float* colour, float* coverage, const float* at) {
        const Lanes p = *(const Lanes*)at, q = *(const Lanes*)(at + 16);
        const Lanes s = *(const Lanes*)(at + 32), t = *(const Lanes*)(at + 48);
        Lanes* into = (Lanes*)colour;
        into[0] = __builtin_shufflevector(p, q, 0, 1, 2, 4, 5, 6, 8, 9, 10, 12, 13, 14, 16, 17, 18, 20);
        into[1] = __builtin_shufflevector(q, s, 5, 6, 8, 9, 10, 12, 13, 14, 16, 17, 18, 20, 21, 22, 24, 25);
        into[2] = __builtin_shufflevector(s, t, 10, 12, 13, 14, 16, 17, 18, 20, 21, 22, 24, 25, 26, 28, 29, 30);
        into = (Lanes*)coverage;
        into[0] = __builtin_shufflevector(p, q, 3, 3, 3, 7, 7, 7, 11, 11, 11, 15, 15, 15, 19, 19, 19, 23);
        into[1] = __builtin_shufflevector(q, s, 7, 7, 11, 11, 11, 15, 15, 15, 19, 19, 19, 23, 23, 23, 27, 27);
        into[2] = __builtin_shufflevector(s, t, 11, 15, 15, 15, 19, 19, 19, 23, 23, 23, 27, 27, 27, 31, 31, 31);
    };

    int start = width, stop = 0;
    const Layer* all[4] = {&objects, &added, &ratio, &mirror_ball};
    for (const Layer* layer : all)
        if (layer->stop > layer->start) {
            start = layer->start < start ? layer->start : start;
            stop = layer->stop > stop ? layer->stop : stop;
        }
    if (start >= stop) start = stop = width;
    memcpy(out, codes, 3 * start);
    memcpy(out + 3 * stop, codes + 3 * stop, 3 * (width - stop));
    for (int j = start; j < stop; j += N) {
        const int count = width - j < N ? width - j : N;
        const bool any[4] = {overlaps(objects, j), overlaps(added, j), overlaps(ratio, j), overlaps(mirror_ball, j)};
        float covered[3 * N] = {}, alpha[3 * N] = {}, a[3 * N] = {}, m[3 * N] = {}, r[3 * N];
        unsigned changed[3 * N];
        unsigned touched = 0, whole = 1;
        if (any[0] || any[1] || any[2] || any[3]) {
            for (int i = 0; i < 3 * N; ++i) r[i] = 1.0f;
            if (j >= objects.start && j + N <= objects.stop) {
                spread(covered, alpha, objects.at + 4 * j);
            } else if (any[0]) {
                const int first = objects.start > j ? objects.start - j : 0;
                const int last = objects.stop < j + N ? objects.stop - j : N;
                for (int k = first; k < last; ++k) {
                    const float* at = objects.at + 4 * (j + k);
                    for (int c = 0; c < 3; ++c) {
                        covered[3 * k + c] = at[c];
                        alpha[3 * k + c] = at[3];
                    }
                }
            }
            if (any[1]) take(a, added, j, 0.0f);
            if (any[2]) take(r, ratio, j, 1.0f);
            if (any[3]) take(m, mirror_ball, j, 0.0f);
            for (int i = 0; i < 3 * N; ++i) {
                changed[i] = (covered[i] != 0.0f) | (alpha[i] != 0.0f) | (a[i] != 0.0f);
                changed[i] |= (r[i] != 1.0f) | (m[i] != 0.0f);
                touched |= changed[i];
                whole &= changed[i];
            }
        }
        if (touched == 0) {
            memcpy(out + 3 * j, codes + 3 * j, 3 * count);
            continue;
        }
        unsigned char code[3 * N] = {};
        memcpy(code, codes + 3 * j, 3 * count);
        float x[3 * N], steps[3 * N], next[3 * N];
        wp::int32 key[3 * N], found[3 * N];
        // Look-ups one by one: a vector of them takes longer on half of all processors, and no less on the others.
        #pragma clang loop vectorize(disable) unroll_count(6)
        for (int i = 0; i < 3 * N; ++i) x[i] = decoded[3 * code[i] + i % 3];
        for (int i = 0; i < 3 * N; ++i) {
            float value = x[i] * r[i];
            value = value + a[i];
            value = value + m[i];
            value = value > 0.0f ? value : 0.0f;
            value = (1.0f - alpha[i]) * value;
            value = value + covered[i];
            x[i] = value > 0.0f ? (value < 1.0f ? value : 1.0f) : 0.0f;  // NaN is not above 0
            key[i] = 3 * static_cast<wp::int32>(__builtin_sqrtf(x[i]) * static_cast<float>(keys - 1));
        }
        #pragma clang loop vectorize(disable) unroll_count(6)
        for (int i = 0; i < 3 * N; ++i) {
            steps[i] = table[key[i] + i % 3];
            next[i] = table[key[i] + i % 3 + 3 * keys];
        }
        unsigned unsure = 0;
        for (int i = 0; i < 3 * N; ++i) {
            const wp::int32 whole = static_cast<wp::int32>(steps[i]);
            found[i] = whole + (x[i] >= next[i] ? 1 : 0);
            unsure |= steps[i] != static_cast<float>(whole);
        }
        if (unsure)
            for (int i = 0; i < 3 * N; ++i)
                if (steps[i] != static_cast<float>(static_cast<wp::int32>(steps[i])))
                    while (x[i] >= table[3 * (2 * keys + found[i]) + i % 3]) ++found[i];
        if (ends)
            for (int i = 0; i < 3 * N; ++i) {
                const wp::int32 most = code[i] > level[i % 3] ? code[i] : level[i % 3];
                found[i] = found[i] < most ? found[i] : most;
            }
        if (whole) {
            for (int i = 0; i < 3 * N; ++i) code[i] = static_cast<unsigned char>(found[i]);
        } else {
            for (int k = 0; k < 3 * N; k += 3) {
                const bool kept_code = (changed[k] | changed[k + 1] | changed[k + 2]) == 0;
                for (int i = k; i < k + 3; ++i) code[i] = kept_code ? code[i] : static_cast<unsigned char>(found[i]);
            }
        }
        memcpy(out + 3 * j, code, 3 * count);
    }
#endif
"""
)
def composite_row(
    params: FrameParams,
    frame: wp.array2d[wp.vec3ub],
    decode_table: wp.array[wp.vec3],
    encode_table: wp.array[wp.vec3],
    layers: Layers,
    kept: wp.int32,
    keys: wp.int32,
    row: wp.int32,
    image: wp.array2d[wp.vec3ub],
):
    """Write a row of the picture, on CPU; ``kept`` has a bit for each layer, ``keys`` are those of the encode table."""


@wp.kernel(enable_backward=False)
def composite_rows_kernel(
    # In:
    row_start: wp.int32,
    params: wp.array[FrameParams],
    frame: wp.array2d[wp.vec3ub],
    decode_table: wp.array[wp.vec3],
    encode_table: wp.array[wp.vec3],
    layers: Layers,
    kept: wp.int32,
    keys: wp.int32,
    # Out:
    image_out: wp.array2d[wp.vec3ub],
):
    """One thread per row, on CPU."""
    i = row_start + wp.tid()
    composite_row(params[0], frame, decode_table, encode_table, layers, kept, keys, i, image_out)


@functools.cache
def make_composite_kernel(config: CompositeConfig, warps: bool) -> wp.Kernel:
    """Kernel specialised to ``config``, by warps (see ``codes``) or by runs of pixels; equal ones share one kernel."""
    read_layers = make_read_layers(config)

    @wp.kernel(module="unique", enable_backward=False)
    def composite_kernel(
        # In:
        row_start: wp.int32,
        params: wp.array[FrameParams],
        frame: wp.array2d[wp.vec3ub],
        decode_table: wp.array[wp.vec3],
        encode_table: wp.array[wp.vec3],
        layers: Layers,
        run: wp.int32,
        # Out:
        image_out: wp.array2d[wp.vec3ub],
    ):
        i, part = wp.tid()
        i += row_start
        if wp.static(warps):
            first = part // WARP_LANES * WARP_PIXELS
            codes = load_codes(frame, i, first)
            k = part % WARP_LANES
            while k < WARP_PIXELS:
                j = first + k
                if j < frame.shape[1]:
                    at = read_layers(params, layers, i, j)
                    if is_changed(at):
                        shown = get_code(codes, k)
                        made = encode(encode_table, compose(decode(decode_table, shown), at))
                        set_code(codes, k, below_saturation(made, shown, saturation_codes(decode_table)))
                k += WARP_LANES
            store_codes(codes, image_out, i, first)
        else:
            for j in range(part * run, wp.min(part * run + run, frame.shape[1])):
                code = frame[i, j]
                at = read_layers(params, layers, i, j)
                if is_changed(at):
                    made = encode(encode_table, compose(decode(decode_table, code), at))
                    code = below_saturation(made, code, saturation_codes(decode_table))
                image_out[i, j] = code

    return composite_kernel


def make_layers(
    virtual: wp.array | None = None,
    added_light: wp.array | None = None,
    shadow_ratio: wp.array | None = None,
    mirror_ball: wp.array | None = None,
) -> Layers:
    """Layers as kernels read them; None leaves one empty.

    Args:
        virtual: (H, W) vec4, premultiplied radiance of virtual objects and their coverage.
        added_light: (H, W) vec3, radiance that virtual lights add to what is physical.
        shadow_ratio: (H, W) vec3, factor on the frame's radiance.
        mirror_ball: (H, W) vec3, change of the frame's radiance in the mirror balls.
    """
    layers = Layers()
    given = {"objects": virtual, "added": added_light, "ratio": shadow_ratio, "mirror_ball": mirror_ball}
    for name, array in given.items():
        if array is not None:
            setattr(layers, name, array)
    return layers


def composite(
    config: CompositeConfig,
    params: wp.array,
    frame: wp.array,
    decode_table: wp.array,
    encode_table: wp.array,
    layers: Layers,
    image_out: wp.array,
    *,
    rows: Rows | None = None,
) -> None:
    """Write the picture.

    Args:
        config: Which layers there are.
        params: (1,) FrameParams; its rectangles bound the layers.
        frame: (H, W) vec3ub, the camera's frame, RGB, contiguous.
        decode_table: (257,) vec3 of ``color.camera_table``, or (256,) of ``color.decode_table``.
        encode_table: Table of ``color.encode_table``.
        layers: From ``make_layers``.
        image_out: (H, W) vec3ub, contiguous; values above clipping give the code where the camera
            saturates or the frame's, whichever is more; NaN gives 0.
        rows: Band of rows; None means all.
    """
    height, width = frame.shape
    tables = [decode_table, encode_table]
    if frame.device.is_cpu:
        kept = config.virtual + 2 * config.added + 4 * config.ratio + 8 * config.mirror_ball
        inputs = [params, frame, *tables, layers, kept, ENCODE_KEYS]
        launch_rows(composite_rows_kernel, (height,), inputs, [image_out], rows=rows, device=frame.device)
        return
    threads, run = row_parts(frame.device, width)
    launch_rows(
        make_composite_kernel(config, by_warps(frame.device, width)),
        (height, threads),
        [params, frame, *tables, layers, run],
        [image_out],
        rows=rows,
        device=frame.device,
    )
