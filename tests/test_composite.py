from typing import NamedTuple

import numpy as np
import pytest
import warp as wp

from tests.error_model import check_error
from tests.kernel_rig import records, tables
from tests.twins import color as reference_color
from tests.twins import composite as reference
from warp_ar.kernels import color
from warp_ar.kernels.picture import composite
from warp_ar.kernels.structs import FrameParams

H, W = 24, 40


class Laid(NamedTuple):
    """The layers that there are."""

    virtual: bool = False
    added: bool = False
    ratio: bool = False
    mirror_ball: bool = False


CONFIGS = [Laid(v, a, r, m) for m in (False, True) for v in (False, True) for a in (False, True) for r in (False, True)]


def make_params(
    object_rect=(0, H, 0, W),
    light_rect=(0, H, 0, W),
    shadow_rect=(0, H, 0, W),
    ball_rect=(0, H, 0, W),
    scale=1.0,
    time_step=0.0,
):
    rects = {"object_rect": object_rect, "light_rect": light_rect, "shadow_rect": shadow_rect, "ball_rect": ball_rect}
    return records(FrameParams, {**rects, "exposure_scale": scale, "time_step": time_step})


def make_layers(seed=0):
    rng = np.random.default_rng(seed)
    frame = rng.integers(0, 256, (H, W, 3)).astype(np.uint8)
    alpha = rng.choice([0.0, 0.25, 1.0], (H, W, 1))
    virtual = np.concatenate([rng.random((H, W, 3)) * alpha, alpha], -1).astype(np.float32)
    added = (rng.random((H, W, 3)) * rng.choice([0.0, 1.0], (H, W, 1))).astype(np.float32)
    ratio = rng.random((H, W, 3)).astype(np.float32)
    mirror_ball = (rng.uniform(-1.0, 1.0, (H, W, 3)) * rng.choice([0.0, 1.0], (H, W, 1))).astype(np.float32)
    return frame, virtual, added, ratio, mirror_ball


def make_arrays(virtual=None, added=None, ratio=None, mirror_ball=None):
    """Layers of what ``make_layers`` draws, or of part of it."""
    dtypes = (wp.vec4, wp.vec3, wp.vec3, wp.vec3)
    return composite.make_layers(
        *(
            None if values is None else wp.array(values, dtype=dtype)
            for values, dtype in zip((virtual, added, ratio, mirror_ball), dtypes, strict=True)
        )
    )


def run(
    config,
    frame,
    virtual=None,
    added=None,
    ratio=None,
    mirror_ball=None,
    params=None,
    transfer="srgb",
    bands=(None,),
    saturation=None,
):
    given = (virtual, added, ratio, mirror_ball)
    layers = make_arrays(*(values if there else None for values, there in zip(given, config, strict=True)))
    decode, encode = tables(transfer)
    if saturation is not None:
        decode = wp.array(color.camera_table(transfer, saturation), dtype=wp.vec3)
    out = wp.full(frame.shape[:2], wp.vec3ub(7, 7, 7), dtype=wp.vec3ub)
    for rows in bands:
        composite.composite(
            params or make_params(), wp.array(frame, dtype=wp.vec3ub), decode, encode, layers, out, rows=rows
        )
    return out.numpy()


def assert_codes(got, linear):
    check_error("composite", got, reference_color.encoded_srgb(np.clip(linear, 0.0, 1.0)))


@pytest.mark.parametrize("transfer", ["srgb", "linear", "gamma:2.2"])
@pytest.mark.parametrize("config", CONFIGS, ids=str)
def test_what_nothing_touches_stays_bit_for_bit(device, config, transfer):
    frame, *_ = make_layers()
    black = np.zeros((H, W, 3), np.float32)
    empty = np.zeros((H, W, 4), np.float32), black, np.ones((H, W, 3), np.float32), black
    np.testing.assert_array_equal(run(config, frame, *empty, transfer=transfer), frame)


@pytest.mark.parametrize("saturation", [(238, 236, 255), (255, 255, 255)], ids=str)
@pytest.mark.parametrize("config", CONFIGS, ids=str)
def test_what_is_drawn_ends_where_the_camera_does(device, config, saturation):
    """No brighter than that, but no darker than the frame; what no layer touches stays, however bright."""
    frame, virtual, added, ratio, mirror_ball = make_layers(3)
    virtual[..., :3] *= 3.0
    untouched = (np.arange(W) % 3 == 0) | (np.arange(W) > 30)
    for layer, neutral in ((virtual, 0.0), (added, 0.0), (ratio, 1.0), (mirror_ball, 0.0)):
        layer[:, untouched] = neutral
    layers = virtual, 3.0 * added, ratio, mirror_ball
    without = run(config, frame, *layers)
    expected = np.minimum(without, np.maximum(frame, np.array(saturation, np.uint8)))
    expected[:, untouched] = frame[:, untouched]
    np.testing.assert_array_equal(run(config, frame, *layers, saturation=saturation), expected)
    if config.virtual or config.added:
        assert (expected != without).any() == (min(saturation) < 255)


@pytest.mark.parametrize("config", CONFIGS, ids=str)
def test_matches_twin(device, config):
    frame, virtual, added, ratio, mirror_ball = make_layers(1)
    linear = reference.compose(
        reference_color.decode(color.decode_table("srgb"), frame),
        virtual if config.virtual else None,
        added if config.added else None,
        ratio if config.ratio else None,
        mirror_ball if config.mirror_ball else None,
    )
    assert_codes(run(config, frame, virtual, added, ratio, mirror_ball), linear)


def test_layers_count_only_inside_their_rectangles(device):
    frame, virtual, added, ratio, mirror_ball = make_layers(2)
    rects = (3, 15, 5, 21), (10, 24, 0, 33), (7, 20, 11, 39), (1, 12, 15, 38)
    got = run(CONFIGS[15], frame, virtual, added, ratio, mirror_ball, make_params(*rects))
    inside_object, inside_light, inside_shadow, inside_ball = (reference.within(rect, (H, W)) for rect in rects)
    linear = reference.compose(
        reference_color.decode(color.decode_table("srgb"), frame),
        virtual * inside_object[..., None],
        added * inside_light[..., None],
        np.where(inside_shadow[..., None], ratio, 1.0),
        mirror_ball * inside_ball[..., None],
    )
    assert_codes(got, linear)
    outside = ~(inside_object | inside_light | inside_shadow | inside_ball)
    np.testing.assert_array_equal(got[outside], frame[outside])


def test_no_more_is_taken_from_a_ball_than_it_shows(device):
    """A change below black is black, and takes nothing from what lies over it."""
    frame, virtual, *_ = make_layers(5)
    virtual[..., 3] = 0.25
    gone = np.full((H, W, 3), -5.0, np.float32)
    assert_codes(run(CONFIGS[12], frame, virtual, mirror_ball=gone), virtual[..., :3].astype(float))
