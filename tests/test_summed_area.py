import numpy as np
import pytest
import warp as wp

from tests.error_model import check_error
from tests.twins import summed_area as reference
from warp_ar.kernels import color
from warp_ar.kernels.color import decode_codes
from warp_ar.kernels.picture import summed_area

# Half a step of 1/64 code, and half as much again for places read off the straight line between two codes.
CUT = 1.5 / 128.0


@wp.kernel(enable_backward=False)
def box_kernel(
    table: wp.array2d[wp.uint32],
    boxes: wp.array[wp.vec4i],
    sums_out: wp.array[wp.uint32],
    means_out: wp.array[wp.float32],
):
    i = wp.tid()
    b = boxes[i]
    sums_out[i] = summed_area.box_sum(table, b[0], b[1], b[2], b[3])
    means_out[i] = summed_area.box_mean(table, b[0], b[2], b[1] - b[0])


def make_table(frame):
    table = wp.zeros(frame.shape[:2], wp.uint32)
    summed_area.sum_area(wp.array(frame, dtype=wp.vec3ub), table)
    return table


def query(table, boxes):
    boxes = wp.array(np.asarray(boxes, np.int32).reshape(-1, 4), dtype=wp.vec4i)
    sums, means = wp.zeros(boxes.shape, wp.uint32), wp.zeros(boxes.shape, wp.float32)
    wp.launch(box_kernel, boxes.shape, [table, boxes], [sums, means])
    return sums.numpy(), means.numpy()


def random_frame(height, width, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3)).astype(np.uint8)


def white(height, width):
    return np.full((height, width, 3), 255, np.uint8)


@pytest.mark.parametrize("size", [(1, 1), (1, 97), (97, 1), (63, 64), (130, 257)])
def test_matches_twin(device, size):
    frame = random_frame(*size)
    check_error("summed_area", make_table(frame).numpy(), reference.sum_area(frame))


@wp.kernel(enable_backward=False)
def fine_mean_kernel(
    table: wp.array2d[wp.uint32], cut_table: wp.array2d[wp.uint32], size: wp.int32, means_out: wp.array2d[wp.float32]
):
    row, col = wp.tid()
    means_out[row, col] = summed_area.fine_mean(table, cut_table, row, col, size)


def fine_means(codes, light, size):
    frame, table = wp.array(codes, dtype=wp.vec3ub), wp.array(color.decode_table("srgb"), dtype=wp.vec3)
    cut, out = wp.zeros(codes.shape[:2], dtype=wp.vec3ub), wp.zeros(codes.shape[:2], dtype=wp.float32)
    tables = [make_table(codes), None]
    if light is not None:
        summed_area.write_cut(frame, table, wp.array(light, dtype=wp.vec3), cut)
        tables[1] = make_table(cut.numpy())
    wp.launch(fine_mean_kernel, codes.shape[:2], [*tables, size], [out])
    return out.numpy()


def test_what_8_bits_cut_off_is_in_means_of_a_linear_picture(device):
    """A dark desk of two to five codes: the mean of what the linear picture says, where codes are off by a tenth."""
    rng = np.random.default_rng(8)
    y, x = np.mgrid[:40, :60]
    # Smooth, so that rounding does not average out: places of codes, in sRGB's straight part and beyond it.
    places = (2.2 + 2.0 * (x / 60) + 0.3 * (y / 40))[..., None] * np.array([1.0, 0.93, 0.85])
    places += rng.uniform(0.0, 0.05, places.shape)
    light = decode_codes("srgb", places.reshape(-1) / 255.0)[:, 0].reshape(places.shape).astype(np.float32)
    codes = np.round(places).astype(np.uint8)
    expected = reference.box_means(places @ np.array([54.0, 183.0, 19.0]) / 256.0, 9)
    fine, plain = fine_means(codes, light, 9), fine_means(codes, None, 9)
    assert np.abs(fine - expected).max() < CUT
    assert np.abs(plain - expected).max() > 0.2
    assert np.abs(plain - expected).mean() > 10.0 * np.abs(fine - expected).mean()


def test_what_codes_say_has_no_rest(device):
    """A linear picture of codes gives the same means to the bit; light above white counts as white."""
    codes = random_frame(40, 60, 2)
    light = color.decode_table("srgb")[codes, np.arange(3)]
    np.testing.assert_array_equal(fine_means(codes, light, 11), fine_means(codes, None, 11))
    white = np.full((20, 30, 3), 255, np.uint8)
    assert (fine_means(white, np.full(white.shape, 7.5, np.float32), 5) == 255.0).all()


@pytest.mark.parametrize("content", ["white", "top half"])
def test_large_frames_are_exact(device, content):
    """Sequential float32 sums are wrong by grey levels here, and plain 32-bit ones overflow at 8K."""
    height, width = 4320, 7680
    frame = white(height, width)
    if content == "top half":
        frame[height // 2 :] = 0
    edge = height // 2
    boxes = [
        [height - 1, height, width - 1, width],  # one pixel in the far corner
        [edge - 1, edge, width - 1, width],
        [edge, edge + 1, 0, 1],
        [edge - 100, edge + 100, width - 200, width],
        [height - 4000, height + 50, width - 4000, width + 50],  # larger than a 4K frame is high
    ]
    table = make_table(frame)
    sums, _ = query(table, boxes)
    lit = height if content == "white" else edge
    expected = [255 * (min(r1, lit) - min(max(r0, 0), lit)) * (min(c1, width) - max(c0, 0)) for r0, r1, c0, c1 in boxes]
    np.testing.assert_array_equal(sums, np.array(expected, np.int64))
    if content == "white":
        # The documented limit: the sum over a whole white 8K frame does not fit, what comes is its remainder.
        whole, _ = query(table, [[0, height, 0, width]])
        assert int(whole[0]) == (255 * height * width) % 2**32
