"""Change of the picture's exposure: shorter, as a camera reacts to added light, or longer.

A shorter exposure scales linear light by s < 1. The radiance of clipped pixels is unknown, and scaling their clipped
value gives flat grey patches. (A *code* is an 8-bit pixel value.) A pixel counts as clipped if all its channels are. A
pixel with an unclipped channel is not far above clipping; brightening it would leave a bright island in a surface that
fades.

Methods:
``plain``: scaling alone; a clipped pixel is taken to be just clipped.

``paper``: [DH04] section 4.3 to the letter. Clipped pixels are scaled by a factor that depends on "the average
intensity of surrounding pixels", a, in a box around them, so that "the center of over-exposed regions will remain
bright while the edges fade with the rest of the image" and "extreme darkening will eventually decimate the entire
saturated region".
The box grows linearly from 1 pixel at s = 1 to ``max_box`` at s = 0:

    size = 1 + (1 - s) (max_box - 1).

The paper gives neither a formula for the factor nor the largest box. Here w rises linearly from 0, where half of the
box is bright (at the straight edge of a large region), to 1, where the whole box is saturated. The factor goes from s
to 1 with w:

    w = clamp(2 a - 1, 0, 1),   factor = s + (1 - s) w.

So s = 1 is the identity, a region smaller than half the box fades like the rest, and below ``LEAST_SCALE`` the factor
falls to 0 with s. With w = a, the other simple reading (``paper_mean``), an edge would stay half bright and no region
would be decimated. The factor sets in gradually from code ``KNEE`` up, so that noise around clipping does not show. It
scales the frame's light before virtual light, which is known, is added. docs/paper.md compares the readings.

A longer exposure, s > 1, is scaled and clipped, as in a camera.

``declipped``: each clipped pixel has the radiance that ``declip`` estimates for it, at least the clipped value; s = 1
is the identity.

Frames of more than 8 bits: means of boxes include the remainder that 8 bits cut off (``summed_area.write_cut``). A
linear frame that stores values above 1 needs no estimate: its clipped pixels have their linear radiance.

Output codes are limited to those at which the camera's channels saturate, so that a highlight is no brighter than a
lamp in the frame.

Pixels without layers and without an estimate are mapped by a table of 256 codes, computed for each s.

``auto`` keeps highlights of virtual light on the receiver below clipping. It samples a grid of pixels that virtual
light reaches and whose own code is not clipped, and finds the level P that all but ``CLIPPED_SHARE`` of them stay
below. The scale has the target

    s* = min(1, max(1 / P, MIN_AUTO_SCALE)),

and approaches it exponentially with the time constant ``AUTO_SECONDS``; in the first frame it is set at once. Levels
are counted in bins of an eighth of a stop, as integers, so their sum does not depend on the order.

References:
    [DH04] DiVerdi, Hoellerer, "Combining Dynamic Physical and Virtual Illumination in Augmented Reality", 2004.
"""

from __future__ import annotations

import functools

import warp as wp

from warp_ar.kernels.color import below_saturation, decode, encode, is_clipped, saturation_codes
from warp_ar.kernels.launch import launch, row_launcher
from warp_ar.kernels.picture.composite import Layers, compose, is_changed, read_layers
from warp_ar.kernels.picture.summed_area import fine_mean
from warp_ar.kernels.structs import FrameParams, Picture, filled

wp.set_module_options({"enable_backward": False})

METHODS = ("plain", "paper", "declipped")
"""Cheapest first."""
BOXES = ("paper", "paper_mean")
"""Methods that average a box around clipped pixels: the paper's, and a reading that docs/paper.md compares."""

MAX_BOX = 1.0 / 8.0
"""Side of the largest box in frame heights."""
LEAST_SCALE = wp.constant(wp.float32(1.0e-3))
"""Scale below which the paper's factor falls to 0 as well: at s = 0 the picture is black."""
KNEE = wp.constant(wp.float32(250.0))
"""Code from which a pixel's darkest channel begins to count as clipped."""

CLIPPED_SHARE = wp.constant(wp.float32(0.005))
"""Share of the pixels under virtual light that ``auto`` allows to clip."""
MIN_AUTO_SCALE = wp.constant(wp.float32(1.0 / 16.0))
"""Smallest scale that ``auto`` sets."""
AUTO_SECONDS = wp.constant(wp.float32(0.3))
"""Time constant of ``auto``, seconds."""
AUTO_STRIDE = 4
"""Distance of the pixels that ``auto`` samples, in rows and columns."""
LEVELS = 64
"""Bins of ``auto``: bin 0 lies below clipping, bin k is (k - 1) / 8 to k / 8 stops above; the last has no end."""

_LEVELS = wp.constant(LEVELS)
_AUTO_STRIDE = wp.constant(AUTO_STRIDE)


@wp.struct
class ClippedEvidence:
    """Data from which the radiance of clipped pixels is estimated; arrays that a method does not read may be empty."""

    summed_area: wp.array2d[wp.uint32]  # (H, W) the frame's summed-area table, for methods that average boxes
    cut_table: wp.array2d[wp.uint32]  # (H, W) table of the remainder that 8 bits cut off; empty for frames of 8 bits
    max_box: wp.int32  # side of the largest box, pixels
    levels: wp.array[wp.vec3]  # (2,) radiance from which channels of a linear frame clip; empty for frames of 8 bits
    declipped: wp.array2d[wp.vec3]  # (H, W) linear radiance with clipped pixels estimated, for ``declipped``


@wp.struct
class Exposure:
    """An exposure scale, and the table of output codes that it gives for the frame's codes."""

    encode_table: wp.array[wp.vec3]  # from ``color.encode_table``
    scale: wp.array[wp.float32]  # (1,), not negative
    codes: wp.array[wp.vec3ub]  # (256,) from ``expose_codes`` for this scale


@wp.func
def surrounding_mean(clipped: ClippedEvidence, row: wp.int32, col: wp.int32, scale: wp.float32) -> wp.float32:
    """Return the mean intensity, 0..255, of the box around a pixel; ``scale``, 0..1, determines the box's size.

    For a size between two odd numbers the means of both boxes are interpolated, so that the result is centred and
    changes continuously with the scale.
    """
    reach = 0.5 * (1.0 - scale) * wp.float32(clipped.max_box - 1)
    inner = wp.int32(reach)
    fraction = reach - wp.float32(inner)
    smaller = fine_mean(clipped.summed_area, clipped.cut_table, row, col, 2 * inner + 1)
    return smaller + fraction * (fine_mean(clipped.summed_area, clipped.cut_table, row, col, 2 * inner + 3) - smaller)


@wp.func
def is_light(clipped: ClippedEvidence) -> wp.bool:
    """Return whether the frame is linear and stores radiance above 1, so that clipped pixels need no estimate."""
    return clipped.levels.shape[0] > 0 and clipped.levels[0][0] > 1.0


@wp.func
def paper_gain(mean: wp.float32, scale: wp.float32) -> wp.float32:
    """Return factor / s of [DH04] section 4.3 for a box mean in 0..255 and a scale in 0..1."""
    w = wp.clamp(2.0 / 255.0 * mean - 1.0, 0.0, 1.0)
    return 1.0 + (1.0 / wp.max(scale, LEAST_SCALE) - 1.0) * w


@wp.func
def paper_mean_gain(mean: wp.float32, scale: wp.float32) -> wp.float32:
    """Return factor / s with w = a (``paper_mean``), for a box mean in 0..255 and a scale in 0..1."""
    return 1.0 + (1.0 / wp.max(scale, LEAST_SCALE) - 1.0) * (mean / 255.0)


@wp.kernel(enable_backward=False)
def expose_codes_kernel(
    # In:
    decode_table: wp.array[wp.vec3],
    encode_table: wp.array[wp.vec3],
    scale: wp.array[wp.float32],
    # Out:
    codes_out: wp.array[wp.vec3ub],
):
    """Write the output code for one code of the frame, whose linear value is multiplied by the scale."""
    i = wp.tid()
    codes_out[i] = encode(encode_table, scale[0] * decode_table[i])


@wp.kernel(enable_backward=False)
def read_scale_kernel(
    # In:
    params: wp.array[FrameParams],
    # Out:
    scale_out: wp.array[wp.float32],
):
    """Write the scene's fixed exposure scale; a NaN or negative scale becomes 0."""
    scale_out[0] = wp.where(params[0].exposure_scale > 0.0, params[0].exposure_scale, 0.0)


@wp.func
def level_of(peak: wp.float32) -> wp.int32:
    """Return the index of the bin, of ``LEVELS``, for a radiance whose largest channel is ``peak``."""
    if not peak > 1.0:
        return 0
    return wp.min(wp.int32(wp.log2(wp.min(peak, 1.0e6)) * 8.0) + 1, _LEVELS - 1)


@wp.kernel(enable_backward=False)
def count_levels_kernel(
    # In:
    row_start: wp.int32,
    params: wp.array[FrameParams],
    picture: Picture,
    layers: Layers,
    # Out:
    levels_out: wp.array2d[wp.int32],
):
    """Count, for one sampled row, the pixels under virtual light in each bin of radiance."""
    strip = row_start + wp.tid()
    for level in range(_LEVELS):
        levels_out[strip, level] = 0
    i = strip * _AUTO_STRIDE
    rect = params[0].light_rect
    if i < rect[0] or i >= rect[1]:
        return
    for j in range(rect[2], rect[3], _AUTO_STRIDE):
        code = picture.frame[i, j]
        clipped = wp.max(wp.max(code[0], code[1]), code[2]) == wp.uint8(255)
        at = read_layers(params, layers, i, j)
        dark = at.added == wp.vec3(0.0, 0.0, 0.0)
        if not clipped and not at.objects[3] > 0.5 and not dark:
            level = level_of(wp.max(compose(decode(picture.decode_table, code), at)))
            levels_out[strip, level] = levels_out[strip, level] + 1


@wp.kernel(enable_backward=False)
def adapt_scale_kernel(
    # In:
    params: wp.array[FrameParams],
    levels: wp.array2d[wp.int32],
    # Out:
    scale_out: wp.array[wp.float32],
):
    """Move the exposure scale toward its target; a scale of 0, which was never set, becomes the target."""
    total = int(0)
    for strip in range(levels.shape[0]):
        for level in range(_LEVELS):
            total += levels[strip, level]
    allowed = wp.int32(CLIPPED_SHARE * wp.float32(total))
    level = int(_LEVELS - 1)
    above = int(0)
    while level > 0:
        for strip in range(levels.shape[0]):
            above += levels[strip, level]
        if above > allowed:
            break
        level -= 1
    aim = wp.max(wp.pow(2.0, -0.125 * wp.float32(level)), MIN_AUTO_SCALE)
    before = scale_out[0]
    if before > 0.0:
        aim = before + (aim - before) * (1.0 - wp.exp(-params[0].time_step / AUTO_SECONDS))
    scale_out[0] = aim


@functools.cache
def make_find_gain(method: str) -> wp.Function:
    """Return the function ``find_gain(code, i, j, clipped, s) -> float``.

    Its result is the estimated radiance of a clipped pixel over its clipped value, at the scale ``s``. It is 1 for
    unclipped pixels, and for methods that use no box.
    """
    box_gain = paper_mean_gain if method == "paper_mean" else paper_gain

    @wp.func(module="unique")
    def find_gain(code: wp.vec3ub, i: wp.int32, j: wp.int32, clipped: ClippedEvidence, s: wp.float32) -> wp.float32:
        gain = float(1.0)
        if wp.static(method in BOXES):
            least = wp.float32(wp.min(wp.min(code[0], code[1]), code[2]))
            if least > KNEE and s < 1.0 and not is_light(clipped):
                share = (least - KNEE) / (255.0 - KNEE)
                mean = surrounding_mean(clipped, i, j, s)
                gain = 1.0 + share * (box_gain(mean, s) - 1.0)
        return gain

    return find_gain


@functools.cache
def make_expose_kernel(method: str) -> wp.Kernel:
    """Return the kernel of one of ``METHODS`` or ``BOXES``; calls with the same method share one kernel.

    Raises:
        ValueError: There is no such method.
    """
    known = dict.fromkeys((*METHODS, *BOXES))
    if method not in known:
        raise ValueError(f"method: {method!r} is none of {', '.join(known)}")
    find_gain = make_find_gain(method)

    @wp.kernel(module="unique", enable_backward=False)
    def expose_kernel(
        # In:
        row_start: wp.int32,
        params: wp.array[FrameParams],
        picture: Picture,
        layers: Layers,
        clipped: ClippedEvidence,
        exposure: Exposure,
        run: wp.int32,
        # Out:
        image_out: wp.array2d[wp.vec3ub],
    ):
        """Expose a run of pixels of one row."""
        i, part = wp.tid()
        i += row_start
        s = exposure.scale[0]
        codes = exposure.codes
        saturation = saturation_codes(picture.decode_table)
        for j in range(part * run, wp.min(part * run + run, image_out.shape[1])):
            code = picture.frame[i, j]
            gain = find_gain(code, i, j, clipped, s)
            guessed = bool(gain != 1.0)
            if wp.static(method == "declipped"):
                guessed = s < 1.0 and wp.max(is_clipped(code)) > 0.0 and not is_light(clipped)
            known = is_light(clipped) and wp.max(wp.max(code[0], code[1]), code[2]) == wp.uint8(255)
            at = read_layers(params, layers, i, j)
            if guessed or known or is_changed(at):
                radiance = gain * decode(picture.decode_table, code)
                if wp.static(method == "declipped"):
                    if guessed:
                        radiance = clipped.declipped[i, j]
                if known:
                    radiance = picture.linear[i, j]
                made = encode(exposure.encode_table, s * compose(radiance, at))
                image_out[i, j] = below_saturation(made, code, saturation)
            else:
                image_out[i, j] = wp.vec3ub(
                    codes[wp.int32(code[0])][0], codes[wp.int32(code[1])][1], codes[wp.int32(code[2])][2]
                )

    return expose_kernel


def largest_box(height: int) -> int:
    """Return the side of the largest box, pixels, for a frame of ``height`` rows."""
    return max(1, round(MAX_BOX * height))


def make_clipped_evidence(
    height: int,
    summed_area: wp.array | None,
    declipped: wp.array | None,
    cut_table: wp.array | None = None,
    levels: wp.array | None = None,
) -> ClippedEvidence:
    """Return the ``ClippedEvidence`` of a frame; None leaves out an array that the method does not read.

    Args:
        height: Rows of the frame.
        summed_area: (H, W) uint32, from ``summed_area.sum_area``.
        declipped: (H, W) vec3, linear radiance with clipped pixels estimated.
        cut_table: (H, W) uint32, table of the remainder that 8 bits cut off; None for frames of 8 bits.
        levels: (2,) vec3, radiance from which channels of a linear frame clip; None for frames of 8 bits.
    """
    arrays = {"summed_area": summed_area, "declipped": declipped, "cut_table": cut_table, "levels": levels}
    return filled(ClippedEvidence(), max_box=largest_box(height), **arrays)


def make_exposure(encode_table: wp.array, scale: wp.array, codes: wp.array) -> Exposure:
    """Return an ``Exposure`` of these arrays.

    Args:
        encode_table: From ``color.encode_table``.
        scale: (1,) float32, not negative.
        codes: (256,) vec3ub, from ``expose_codes`` for this scale.
    """
    return filled(Exposure(), encode_table=encode_table, scale=scale, codes=codes)


def read_scale(params: wp.array, scale_out: wp.array) -> None:
    """Write the fixed exposure scale of ``params[0]``, or 0 if it is negative, to ``scale_out``, (1,) float32."""
    launch(read_scale_kernel, 1, [params], [scale_out], device=params.device)


count_levels = row_launcher(count_levels_kernel, like=lambda *given: given[-1].shape[:1])
"""Count the pixels under virtual light in each bin of radiance, for ``auto``.

Args:
    params: (1,) FrameParams.
    picture: (H, W) the camera's frame; rays are not read.
    layers: From ``make_layers``, including virtual light on the receiver.
    levels_out: (ceil(H / AUTO_STRIDE), LEVELS) int32, one row per sampled row of the frame.
"""


def adapt_scale(params: wp.array, levels: wp.array, scale_out: wp.array) -> None:
    """Move the exposure scale toward the target that the counts give.

    Args:
        params: (1,) FrameParams; the time step.
        levels: Counts from ``count_levels``.
        scale_out: (1,) float32, changed in place; 0 on entry: it was never set, and becomes the target.
    """
    launch(adapt_scale_kernel, 1, [params, levels], [scale_out], device=params.device)


def expose_codes(decode_table: wp.array, encode_table: wp.array, scale: wp.array, codes_out: wp.array) -> None:
    """Write the table that maps each code to its code after scaling, (256,) vec3ub; ``scale`` is (1,) float32."""
    launch(expose_codes_kernel, 256, [decode_table, encode_table, scale], [codes_out], device=scale.device)


expose = row_launcher(make_expose_kernel, runs=True)
"""Compose the layers over the frame and write the picture at another exposure.

Args:
    method: One of ``METHODS``, or of the readings in ``BOXES``.
    params: (1,) FrameParams; its rectangles bound the layers.
    picture: (H, W) the camera's frame, contiguous; rays are not read.
    layers: From ``make_layers``.
    clipped: From ``make_clipped_evidence``.
    exposure: From ``make_exposure``.
    image_out: (H, W) vec3ub, contiguous.
"""
