"""Rows 11 and 12: summed-area tables at every size, boxes in corners and beyond; exposures and frames at their ends.

Bounds: tables are exact modulo 2^32; exposure 1 is the identity to the bit, 0 is black, nothing in between goes up as
the scale goes down.
"""

from __future__ import annotations

import functools

import numpy as np
import pytest
import warp as wp
from hypothesis import example, given
from hypothesis import strategies as st

from tests.hard_cases import generators
from tests.hard_cases.rig import METHODS, SIZE, cases, methods
from warp_ar.kernels import color
from warp_ar.kernels.picture import composite, expose, summed_area
from warp_ar.kernels.structs import FrameParams, make_picture

FRAMES = generators.frames(SIZE[1], SIZE[0])
JUST_BELOW_1 = float(np.nextafter(np.float32(1), np.float32(0)))


@wp.kernel(module="unique", enable_backward=False)
def sum_boxes_kernel(
    # In:
    table: wp.array2d[wp.uint32],
    boxes: wp.array[wp.vec4i],
    # Out:
    sums_out: wp.array[wp.uint32],
):
    i = wp.tid()
    b = boxes[i]
    sums_out[i] = summed_area.box_sum(table, b[0], b[1], b[2], b[3])


def sum_boxes(table, boxes):
    sums = wp.zeros(len(boxes), dtype=wp.uint32)
    wp.launch(sum_boxes_kernel, dim=len(boxes), inputs=[table, wp.array(boxes, dtype=wp.vec4i)], outputs=[sums])
    return sums.numpy()


@pytest.mark.atlas(row=11, stage="summed_area")
@given(rows=st.integers(1, 97), columns=st.integers(1, 97), seed=st.integers(0, 9), white=st.booleans())
@example(rows=1, columns=1, seed=0, white=True)
@example(rows=1, columns=97, seed=0, white=False)
def test_any_box_of_any_frame(device, rows, columns, seed, white):
    """1x1 boxes in the far corner, boxes larger than the image, empty and inverted ones; against sums in int64."""
    rng = np.random.default_rng(seed)
    values = np.full((rows, columns), 255) if white else rng.integers(0, 256, (rows, columns))
    frame = wp.array(np.repeat(values[..., None], 3, 2).astype(np.uint8), dtype=wp.vec3ub)
    table = wp.zeros((rows, columns), dtype=wp.uint32)
    summed_area.sum_area(frame, table)
    boxes = rng.integers(-5, max(rows, columns) + 5, (20, 4))
    boxes = np.concatenate(
        [boxes, [[rows - 1, rows, columns - 1, columns], [-99, 999, -99, 999], [2, 2, 0, 9], [5, 1, 5, 1]]]
    )
    expected = [values[max(b[0], 0) : max(b[1], 0), max(b[2], 0) : max(b[3], 0)].sum() for b in boxes]
    np.testing.assert_array_equal(sum_boxes(table, boxes.astype(np.int32)), expected)


@functools.cache
def tables(device):
    return wp.array(color.decode_table("srgb"), dtype=wp.vec3, device=device), wp.array(
        color.encode_table("srgb"), dtype=wp.vec3, device=device
    )


def exposed(method, image, scale, device):
    """The frame at another exposure, without layers."""
    decode, encode = tables(device)
    frame = wp.array(np.ascontiguousarray(image), dtype=wp.vec3ub)
    params = np.zeros(1, np.dtype(FrameParams.numpy_dtype()))
    params["exposure_scale"] = scale
    params = wp.array(params, dtype=FrameParams)
    table, out = wp.zeros(frame.shape, dtype=wp.uint32), wp.zeros(frame.shape, dtype=wp.vec3ub)
    factor, codes = wp.zeros(1, dtype=wp.float32), wp.zeros(256, dtype=wp.vec3ub)
    summed_area.sum_area(frame, table)
    expose.read_scale(params, factor)
    expose.expose_codes(decode, encode, factor, codes)
    expose.expose(
        method,
        params,
        make_picture(frame, decode, None),
        composite.make_layers(),
        expose.make_clipped_evidence(frame.shape[0], table, None),
        expose.make_exposure(encode, factor, codes),
        out,
    )
    return out.numpy()


KERNEL_METHODS = [method for method in METHODS["expose"] if method in ("plain", "paper")]


@pytest.mark.atlas(row=11, stage="expose")
@pytest.mark.parametrize("method", KERNEL_METHODS)
@given(rows=st.integers(1, 70), columns=st.integers(1, 70), scale=st.floats(0, 1))
@example(rows=1, columns=1, scale=0.5)
@example(rows=70, columns=1, scale=JUST_BELOW_1)
def test_a_white_frame_of_any_size_fades_evenly(device, method, rows, columns, scale):
    """Boxes that reach beyond the frame count what is inside it: no dark borders, no corners."""
    out = exposed(method, np.full((rows, columns, 3), 255, np.uint8), scale, device)
    assert (out == out[0, 0]).all()


@pytest.mark.atlas(row=12, stage="expose")
@pytest.mark.parametrize("method", KERNEL_METHODS)
@pytest.mark.parametrize("name", FRAMES)
def test_exposures_at_their_ends(device, method, name):
    frame = FRAMES[name]
    np.testing.assert_array_equal(exposed(method, frame, 1.0, device), frame)
    for black in (0.0, -1.0, np.nan, 1e-8):
        assert (exposed(method, frame, black, device) == 0).all()
    np.testing.assert_array_equal(exposed(method, frame, JUST_BELOW_1, device), frame)
    brighter = exposed(method, frame, 1e8, device)
    np.testing.assert_array_equal(brighter, np.where(frame > 0, 255, 0))
    scales = (0.0, 0.01, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99, 1.0, 1.5, 3.0)
    pictures = np.array([exposed(method, frame, scale, device) for scale in scales]).astype(int)
    assert (np.diff(pictures, axis=0) >= 0).all(), "darker, yet a pixel got brighter"


def untouched_by(rig):
    """Pixels that no layer changes."""
    untouched = (rig.get("virtual") == 0).all(-1) & (rig.get("added_light") == 0).all(-1)
    for name, neutral in (("shadow_ratio", 1.0), ("mirror_ball", 0.0)):
        if name in rig.arrays:
            untouched &= (rig.get(name) == neutral).all(-1)
    return untouched


@pytest.mark.atlas(row=12)
@pytest.mark.parametrize(
    ("stage", "method"),
    cases("summed_area", "composite", "expose"),
)
@pytest.mark.parametrize("name", ["black", "white", "one saturated pixel"])
def test_frames_at_their_ends_in_the_pipeline(rig_for, stage, method, name):
    """A black desk stays black where nothing falls on it; a saturated one is no darker for light added to it."""
    rig = rig_for(stage, method)
    picture = rig.frame(FRAMES[name])
    if stage == "summed_area":
        weights = np.array([54, 183, 19])  # Rec. 709 in 256ths
        expected = ((FRAMES[name] @ weights + 128) >> 8).cumsum(0).cumsum(1)
        np.testing.assert_array_equal(rig.get("summed_area"), expected)
        return
    untouched = untouched_by(rig)
    assert untouched.any()
    if stage == "composite":
        np.testing.assert_array_equal(picture[untouched], FRAMES[name][untouched])
    else:
        assert (picture[untouched] <= FRAMES[name][untouched]).all()


@pytest.mark.atlas(row=11, stage="expose")
@pytest.mark.parametrize("method", methods("expose"))
def test_no_box_beyond_the_frame_darkens_its_border(rig_for, method):
    """On a white frame every pixel, in corners too, is at least as bright as scaling alone makes it."""
    rig = rig_for("expose", method)
    picture = rig.frame(FRAMES["white"])
    untouched = untouched_by(rig)
    scale = rig.get("expose_scale")[0]
    least = round(255 * float(1.055 * scale ** (1 / 2.4) - 0.055))
    assert untouched.any()
    assert (picture[untouched] >= least).all()
