import numpy as np
import pytest
import warp as wp

from tests.error_model import check_error
from tests.kernel_rig import tables
from tests.test_composite import H, make_arrays, make_layers, make_params
from tests.twins import color as reference_color
from tests.twins import composite as reference_composite
from tests.twins import expose as reference
from warp_ar.kernels import color
from warp_ar.kernels.color import decode_codes
from warp_ar.kernels.picture import expose, summed_area
from warp_ar.kernels.structs import make_picture
from warp_ar.sources.deep_frame import srgb8

# How far `auto` may miss: one bin of an eighth of a stop, and the share that may clip.
BIN = 2.0**0.125
SCALES = [0.0, 0.01, 0.25, 0.5, 0.9, np.nextafter(np.float32(1), np.float32(0)), 1.0, 1.5, 4.0]


def run(
    frame,
    scale,
    method="paper",
    virtual=None,
    added=None,
    ratio=None,
    mirror_ball=None,
    transfer="srgb",
    light=None,
    clips=np.inf,
):
    frame_array = wp.array(frame, dtype=wp.vec3ub)
    shape = frame.shape[:2]
    height, width = shape
    params = make_params(*4 * [(0, height, 0, width)], scale)
    decode, encode = tables(transfer)
    table, scale_array = wp.zeros(shape, wp.uint32), wp.zeros(1, wp.float32)
    codes, image = wp.zeros(256, wp.vec3ub), wp.zeros(shape, wp.vec3ub)
    summed_area.sum_area(frame_array, table)
    expose.read_scale(params, scale_array)
    expose.expose_codes(decode, encode, scale_array, codes)
    over = make_arrays(virtual, added, ratio, mirror_ball)
    deep = {}
    light = None if light is None else wp.array(light, dtype=wp.vec3)
    if light is not None:
        cut, cut_table = wp.zeros(shape, wp.vec3ub), wp.zeros(shape, wp.uint32)
        summed_area.write_cut(frame_array, decode, light, cut)
        summed_area.sum_area(cut, cut_table)
        deep = {"cut_table": cut_table, "levels": wp.array(np.full((2, 3), clips), dtype=wp.vec3)}
    picture, exposure = make_picture(frame_array, decode, None, light), expose.make_exposure(encode, scale_array, codes)
    clipped = expose.make_clipped_evidence(height, table, wp.array(declipped(frame, transfer), dtype=wp.vec3), **deep)
    expose.expose(method, params, picture, over, clipped, exposure, image)
    return image.numpy()


def declipped(frame, transfer="srgb"):
    """An estimate to expose: three times clipping wherever a channel clips, in that channel."""
    return np.where(frame >= 254, 3.0, linear(frame, transfer))


def linear(frame, transfer="srgb"):
    return reference_color.decode(color.decode_table(transfer), frame)


def disc(size=96, radius=20):
    """A white disc on dark grey."""
    y, x = np.mgrid[:size, :size] - size // 2
    return np.repeat(np.where(x * x + y * y <= radius * radius, 255, 40).astype(np.uint8)[..., None], 3, axis=2)


@pytest.mark.parametrize("level", [238, 255])
def test_what_is_drawn_ends_where_the_camera_does(device, level):
    """A white object over a frame whose lamps end at ``level``; what the frame shows above it stays."""
    frame = np.full((8, 8, 3), 60, np.uint8)
    frame[0] = 241
    decode = wp.array(color.camera_table("srgb", (level, level, level)), dtype=wp.vec3)
    encode = wp.array(color.encode_table("srgb"), dtype=wp.vec3)
    scale, codes, image = wp.array([1.0], wp.float32), wp.zeros(256, wp.vec3ub), wp.zeros((8, 8), wp.vec3ub)
    expose.expose_codes(decode, encode, scale, codes)
    drawn = np.zeros((8, 8, 4), np.float32)
    drawn[:, :4] = (5.0, 5.0, 0.2, 1.0)
    picture = make_picture(wp.array(frame, dtype=wp.vec3ub), decode, None, None)
    over = make_arrays(drawn)
    clipped = expose.make_clipped_evidence(8, None, None)
    params = make_params(*4 * [(0, 8, 0, 8)], 1.0)
    expose.expose("plain", params, picture, over, clipped, expose.make_exposure(encode, scale, codes), image)
    shown = image.numpy()
    np.testing.assert_array_equal(shown[:, 4:], frame[:, 4:])
    dark = round(255.0 * float(color.encode_codes("srgb", np.array([[0.2]]))[0, 0]))
    assert shown[1, 0].tolist() == [level, level, dark]
    assert shown[0, 0].tolist() == [max(level, 241), max(level, 241), dark]


@pytest.mark.parametrize("method", expose.BOXES)
@pytest.mark.parametrize("scale", SCALES)
def test_boxes_match_their_twins(device, scale, method):
    frame = np.concatenate([disc(48, 10), make_layers(2)[0][:, :40].repeat(2, 0)], axis=1)
    gains = reference.gains(frame, scale, expose.largest_box(frame.shape[0]), method)
    exact = reference_color.encoded_srgb(np.clip(linear(frame) * gains[..., None] * np.float64(scale), 0.0, 1.0))
    check_error("expose", run(frame, scale, method), exact)


@pytest.mark.parametrize("method", expose.METHODS)
@pytest.mark.parametrize("scale", [0.1, 0.5, 2.0])
def test_light_above_white_needs_no_guess(device, scale, method):
    """A linear frame says what is there; codes of 8 bits would make 1, or a guess, of all that is above."""
    light = np.random.default_rng(5).uniform(0.0, 4.0, (40, 50, 3)).astype(np.float32)
    light[10:30, 10:40] += 1.5
    frame = srgb8(light)
    shown = np.where((frame == 255).any(-1, keepdims=True), light, linear(frame))
    exact = reference_color.encoded_srgb(np.clip(shown * np.float64(scale), 0.0, 1.0))
    check_error("expose", run(frame, scale, method, light=light), exact)


@pytest.mark.parametrize("code", [128.4, 128.6, 131.5])
def test_boxes_of_deep_frames_are_means_of_what_they_show(device, code):
    """A flat frame around a pixel that clips, at a scale where a third of a code of the mean is two of the picture."""
    scale, values = 0.01, np.full((96, 96), code)
    values[48, 48] = 255.0
    codes = np.repeat(values[..., None], 3, 2)
    light = decode_codes("srgb", codes.ravel() / 255.0)[:, 0].reshape(codes.shape).astype(np.float32)
    frame = np.round(codes).astype(np.uint8)
    mean = reference.surrounding_mean(values, 48, 48, scale, expose.largest_box(96))
    exact = reference_color.encoded_srgb(np.array(reference.paper_factor(mean, scale)))
    deep = run(frame, scale, "paper", light=light, clips=0.98)[48, 48]
    np.testing.assert_allclose(deep, exact, atol=0.51)
    if abs(code - round(code)) > 0.1:
        assert abs(float(run(frame, scale, "paper")[48, 48, 0]) - exact) > 1.0, "8 bits do not hold it"


@pytest.mark.parametrize("method", expose.METHODS)
def test_frames_of_8_bits_are_exposed_alike_from_a_linear_picture(device, method):
    frame = np.concatenate([disc(48, 10), make_layers(2)[0][:, :40].repeat(2, 0)], axis=1)
    light = linear(frame).astype(np.float32)
    np.testing.assert_array_equal(run(frame, 0.25, method, light=light, clips=0.98), run(frame, 0.25, method))


@pytest.mark.parametrize("scale", [0.25, 0.75, 2.0])
def test_layers_are_composed_before_they_are_exposed(device, scale):
    frame, *layers = make_layers(3)
    gains = reference.gains(frame, scale, expose.largest_box(H))
    total = reference_composite.compose(linear(frame) * gains[..., None], *layers)
    exact = reference_color.encoded_srgb(np.clip(scale * total, 0.0, 1.0))
    check_error("expose", run(frame, scale, "paper", *layers), exact)


def test_centre_stays_bright_and_edge_fades(device):
    """Figure 7 of the paper: at half the exposure the middle of a large disc is white, its rim grey."""
    frame = disc(96, 30)
    box, plain = run(frame, 0.5, "paper")[..., 0].astype(int), run(frame, 0.5, "plain")[..., 0].astype(int)
    assert box[48, 48] == 255
    assert plain[48, 48] == 188
    profile = box[48, 48:79]
    assert (np.diff(profile) <= 0).all()
    assert profile[-1] < 220
    unclipped = frame[..., 0] < 255
    np.testing.assert_array_equal(box[unclipped], plain[unclipped])


@pytest.mark.parametrize("scale", SCALES)
def test_declipped_pixels_show_their_estimate(device, scale):
    frame = make_layers(4)[0]
    frame[::3, ::2, 0] = 255
    frame[::5, ::5] = 255
    radiance = declipped(frame) if scale < 1.0 else linear(frame)  # only a shorter exposure shows it
    exact = reference_color.encoded_srgb(np.clip(radiance * np.float64(scale), 0.0, 1.0))
    check_error("expose", run(frame, scale, "declipped"), exact)


@pytest.mark.parametrize(("other", "factor"), [(255, 1.0), (191, 0.806), (128, 0.615)])
def test_the_papers_factor_by_hand(device, other, factor):
    """Stripes of white and of another code, far wider than the box: a is their mean, factor = s + (1 - s) (2 a - 1).

    With 240 rows the box at a quarter is 1 + 0.75 * 29 = 22.75 pixels: between 21 and 23 whole ones, which hold 11 and
    12 white columns of 21 and 23 around a white column when every other column is white.
    """
    frame = np.full((240, 240, 3), other, np.uint8)
    frame[:, ::2] = 255
    share = 0.125 * 11 / 21 + 0.875 * 11 / 23  # white columns around a white one: 11 of 21, 11 of 23
    mean = (share * 255 + (1 - share) * other) / 255
    exact = 0.25 + 0.75 * (2 * mean - 1)
    assert exact == pytest.approx(factor, abs=0.01)
    got = run(frame, 0.25, "paper")[120, 120]
    np.testing.assert_allclose(got, reference_color.encoded_srgb(np.array(exact)), atol=0.51)


def auto(added, frame=None, frames=1, time_step=1.0 / 30, start=0.0, virtual=None, mirror_ball=None):
    frame = np.zeros((*added.shape[:2], 3), np.uint8) if frame is None else frame
    height, width = frame.shape[:2]
    params = make_params(*4 * [(0, height, 0, width)], time_step=time_step)
    levels = wp.zeros((-(-height // expose.AUTO_STRIDE), expose.LEVELS), wp.int32)
    scale = wp.array([start], dtype=wp.float32)
    frame, decode = wp.array(frame, dtype=wp.vec3ub), tables()[0]
    for _ in range(frames):
        over = make_arrays(virtual, added, None, mirror_ball)
        expose.count_levels(params, make_picture(frame, decode, None), over, levels)
        expose.adapt_scale(params, levels, scale)
    return float(scale.numpy()[0])


def spot(level, height=64, width=80):
    added = np.zeros((height, width, 3), np.float32)
    added[10:50, 20:70] = level
    return added


@pytest.mark.parametrize("level", [1.1, 2.0, 5.3, 12.0])
def test_auto_keeps_highlights_below_clipping(device, level):
    scale = auto(spot(level))
    assert 1.0 / (level * BIN) <= scale <= 1.0 / level


def test_auto_is_bounded_and_finite(device):
    for level in (1e6, np.inf, np.nan):
        assert auto(spot(level)) in (1.0, expose.MIN_AUTO_SCALE)


def test_auto_ignores_what_darkening_cannot_help(device):
    assert auto(spot(3.0), frame=np.full((64, 80, 3), 255, np.uint8)) == 1.0
    hidden = np.zeros((64, 80, 4), np.float32)
    hidden[..., 3] = 1.0
    assert auto(spot(3.0), virtual=hidden) == 1.0


def test_auto_sees_the_desk_as_it_is_composed(device):
    """What a ball beside the lit desk shows is no reason to darken it; what is taken from lit pixels counts."""
    bright = np.where(spot(1.0) > 0, 0.0, 50.0).astype(np.float32)
    assert auto(spot(0.9), mirror_ball=bright) == 1.0
    assert auto(spot(4.0), mirror_ball=-3.5 * (spot(1.0) > 0).astype(np.float32)) == 1.0


def test_auto_allows_a_few_glints(device):
    added = np.full((400, 400, 3), 0.5, np.float32)
    added[::100, ::100] = 50.0  # 16 of 10,000 sampled pixels
    assert auto(added) == 1.0


def test_auto_follows_smoothly_and_settles(device):
    steps = [auto(spot(4.0), frames=n, start=1.0) for n in (1, 2, 5, 60)]
    assert steps == sorted(steps, reverse=True)
    assert steps[0] > 0.85
    assert steps[-1] == pytest.approx(auto(spot(4.0)), abs=1.5e-3)  # after 2 s, e^-6.7 of the way is left
    assert auto(spot(4.0), time_step=0.0, start=0.7) == pytest.approx(0.7)
