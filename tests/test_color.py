import numpy as np
import pytest
import warp as wp

from tests.twins import color as reference
from warp_ar.errors import SceneError
from warp_ar.kernels import color

# Both sides round the same real number; float64 pow may itself err by a few ulp (1e-16 relative, times 255), so codes
# may differ only where the unrounded code lies this close to a half.
HALF_CODE_SLACK = 1e-10


@wp.kernel(enable_backward=False)
def decode_kernel(table: wp.array[wp.vec3], codes: wp.array[wp.vec3ub], radiance_out: wp.array[wp.vec3]):
    i = wp.tid()
    radiance_out[i] = color.decode(table, codes[i])


@wp.kernel(enable_backward=False)
def encode_kernel(table: wp.array[wp.vec3], radiance: wp.array[wp.vec3], codes_out: wp.array[wp.vec3ub]):
    i = wp.tid()
    codes_out[i] = color.encode(table, radiance[i])


def encode(transfer, values):
    values = np.ascontiguousarray(values, np.float32)
    out = wp.zeros(len(values), wp.vec3ub)
    table = wp.array(color.encode_table(transfer), dtype=wp.vec3)
    wp.launch(encode_kernel, len(values), [table, wp.array(values, dtype=wp.vec3)], [out])
    return out.numpy()


def decode(transfer, codes):
    out = wp.zeros(len(codes), wp.vec3)
    table = wp.array(color.decode_table(transfer), dtype=wp.vec3)
    wp.launch(decode_kernel, len(codes), [table, wp.array(codes, dtype=wp.vec3ub)], [out])
    return out.numpy()


def write_response(path, values):
    path.write_text("\n".join(" ".join(repr(float(v)) for v in row) for row in values) + "\n")
    return str(path)


@pytest.fixture
def measured(tmp_path):
    """A film-like curve, different per channel, scaled as a measurement would be."""
    x = np.linspace(0, 1, 256)[:, None]
    return write_response(tmp_path / "response.txt", (0.3 * x + 0.7 * x ** np.array([2.0, 2.6, 3.1])) * [3.0, 5.0, 4.0])


@pytest.fixture(params=["srgb", "linear", "gamma:1", "gamma:2.2", "gamma:0.5", "gamma:3", "gamma:6", "measured"])
def transfer(request, measured):
    return measured if request.param == "measured" else request.param


CODES = np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1)


def test_every_code_survives_a_round_trip(device, transfer):
    np.testing.assert_array_equal(encode(transfer, decode(transfer, CODES)), CODES)


def test_ends_are_black_and_clipping(transfer):
    table = color.decode_table(transfer)
    assert (table[-1] == 1.0).all()
    assert (table[0] == 0.0).all()
    assert (np.diff(table, axis=0) > 0.0).all()


def unrounded(transfer, x):
    if transfer == "srgb":
        return reference.encoded_srgb(x)
    if transfer == "linear":
        return 255.0 * x
    if transfer.startswith("gamma:"):
        return reference.encoded_gamma(x, float(transfer[6:]))
    values = np.loadtxt(transfer)
    values = values / values[-1]
    return np.stack([reference.encoded_measured(x[:, c], values[:, c]) for c in range(3)], -1)


def test_encode_is_the_nearest_code(device, transfer):
    """Half a code is the largest error: for random inputs, tiny ones, and those around each threshold."""
    rng = np.random.default_rng(1)
    thresholds = color.encode_table(transfer)[2 * color.ENCODE_KEYS : -1]
    around = [thresholds]
    for direction in (np.float32(-1.0), np.float32(2.0)):
        step = thresholds
        for _ in range(3):
            step = np.nextafter(step, direction)
            around.append(step)
    values = np.concatenate([rng.random((200_000, 3)), 10.0 ** rng.uniform(-9, 0, (100_000, 3)), *around]).astype(
        np.float32
    )
    values = np.clip(values, 0.0, 1.0)
    exact = unrounded(transfer, values.astype(np.float64))
    error = np.abs(encode(transfer, values).astype(np.float64) - exact)
    assert error.max() <= 0.5 + HALF_CODE_SLACK


def test_what_is_no_colour_is_clamped(device, transfer):
    values = np.array(
        [-1e30, -1e-30, -0.0, np.nan, -np.inf, np.inf, 1.0, np.nextafter(np.float32(1), np.float32(2)), 1e30],
        np.float32,
    )
    codes = encode(transfer, np.repeat(values[:, None], 3, axis=1))[:, 0]
    np.testing.assert_array_equal(codes, [0, 0, 0, 0, 0, 255, 255, 255, 255])


def test_plateau_of_a_response_keeps_its_radiance(device, tmp_path):
    """Codes that mean the same radiance cannot all survive; what comes back means the same."""
    values = np.repeat(np.maximum(np.linspace(0, 1, 256) - 0.1, 0.0)[:, None], 3, axis=1)
    path = write_response(tmp_path / "plateau.txt", values)
    linear = decode(path, CODES)
    np.testing.assert_array_equal(decode(path, encode(path, linear)), linear)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("1 2 3\n", "256 lines"),
        ("\n".join(["a b c"] * 256), "three linear values"),
        ("\n".join(f"{k} {k} {-k}" for k in range(256)), "not negative"),
        ("\n".join(f"{k} {k} {k if k != 9 else 0}" for k in range(256)), "line 10"),
        ("\n".join(["1 1 1"] * 256), "must rise"),
    ],
)
def test_bad_response_is_named(tmp_path, content, words):
    path = tmp_path / "bad.txt"
    path.write_text(content)
    with pytest.raises(SceneError, match=words) as caught:
        color.decode_table(str(path))
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("transfer", ["sRGB!", "gamma:", "gamma:x", "gamma:0", "gamma:nan", "missing.txt"])
def test_unknown_transfer_says_what_would_be_right(transfer):
    for table in (color.decode_table, color.encode_table):
        with pytest.raises(SceneError, match=r"camera\.transfer.*gamma:2\.2"):
            table(transfer)
