"""Virtual light on the desk: closed forms, the twin, geometry, culling, and the truth."""

import numpy as np
import pytest

from tests.error_model import check_error
from tests.kernel_rig import constant_environment, shape
from tests.relight_rig import CAMERA, FLOAT_ERROR, POINTS, PRIOR, RIM, H, W, noise_frame, point, run, unit
from tests.twins import color as reference_color
from tests.twins import relight as reference
from warp_ar.kernels import color
from warp_ar.kernels.receiver.receiver import METHODS, READINGS
from warp_ar.kernels.structs import DIRECTIONAL, SPHERE

# --- closed forms


def test_white_desk_has_the_value_of_the_scene_format(device):
    """Reflectance 1 (as bright as white in an environment of radiance 1), light above at d: intensity / (pi d^2)."""
    frame = np.full((H, W, 3), 255, np.uint8)
    got = run("reflectance", [point((0, 0, 0.25))], frame)
    _, n_dot_l, e = reference.point_light(POINTS, np.array([0, 0, 0.25]), 0.3)
    np.testing.assert_allclose(got, np.broadcast_to(n_dot_l * e / np.pi, got.shape), rtol=PRIOR + FLOAT_ERROR)
    assert got.max() == pytest.approx(0.3 / (np.pi * 0.25**2), rel=5e-3)  # no pixel is exactly under the light


def test_frames_of_more_than_8_bits_reflect_as_they_are(device):
    """A desk darker than 1/255, and one brighter than white: reflectance is of the light itself, not of its codes."""
    shown = np.exp(np.random.default_rng(4).uniform(np.log(4e-4), np.log(1 / 255), (H, W, 3)))
    shown[:, W // 2 :] *= 1000.0
    table = color.decode_table("srgb")
    frame = reference_color.encode(np.minimum(shown, 1.0), reference_color.encoded_srgb).astype(np.uint8)
    coded = reference_color.decode(table, frame)
    surroundings = np.where(np.arange(W) < W // 2, 0.02, 20.0)[None, :, None] * np.ones(3)
    at, intensity = np.array([0.05, 0.0, 0.25]), 0.3
    _, n_dot_l, e = reference.point_light(POINTS, at, intensity)
    expected = reference.reflectance(shown, np.pi * surroundings) / np.pi * n_dot_l * e
    for half, level in ((slice(0, W // 2), 0.02), (slice(W // 2, W), 20.0)):
        sh = constant_environment((level,) * 3)
        got = run("reflectance", [point(at)], frame, sh=sh, linear=shown)[:, half]
        np.testing.assert_allclose(got, expected[:, half], rtol=3e-4, atol=1e-9)
        codes = run("reflectance", [point(at)], frame, sh=sh)[:, half]
        assert np.abs(codes / got - 1.0).max() > 0.1, "8 bits do not hold it"
    same = run("reflectance", [point(at)], frame, linear=coded)
    np.testing.assert_array_equal(same, run("reflectance", [point(at)], frame))


SLANT = unit(0.6, 0.0, 0.8)
"""Toward the virtual light of the paper's three cases: N.L = 0.8 on the desk."""
CASES = {"coincident": (SLANT, 1.0), "orthogonal": (unit(-0.8, 0.0, 0.6), 0.0), "opposing": (-SLANT, -1.0)}
"""Brightest physical direction, and the cosine between both."""


def slanted():
    return [{"kind": DIRECTIONAL, "direction": -SLANT, "intensity": (0.5, 0.4, 0.3)}]


@pytest.mark.parametrize("directionality", [0.0, 0.41, 1.0])
@pytest.mark.parametrize("case", CASES)
def test_paper_in_its_three_cases_by_hand(device, case, directionality):
    """[DH04] section 4.2 from a frame: Kd / pi E times the video at alpha = 1, N.L at 0, the video's inverse at -1.

    Kd is 0.5, E (0.5, 0.4, 0.3). Columns of code 51 and 204: m = 0.2 and 0.8, the code over 255 (their linear luminance
    would be 0.033 and 0.604). How far the environment's light dominates plays no part in the text.
    """
    frame = np.full((H, W, 3), 51, np.uint8)
    frame[:, ::2] = 204
    got = run("paper", slanted(), frame, key=(CASES[case][0], directionality))
    dark, bright = {"coincident": (0.2, 0.8), "orthogonal": (0.8, 0.8), "opposing": (0.8, 0.2)}[case]
    arriving = 0.5 / np.pi * np.array([0.5, 0.4, 0.3])
    np.testing.assert_allclose(got[:, 1::2], np.broadcast_to(dark * arriving, got[:, 1::2].shape), rtol=FLOAT_ERROR)
    np.testing.assert_allclose(got[:, ::2], np.broadcast_to(bright * arriving, got[:, ::2].shape), rtol=FLOAT_ERROR)


# --- twins


@pytest.mark.parametrize("method", dict.fromkeys((*METHODS, *READINGS)))
def test_matches_twin(device, method):
    frame = noise_frame()
    key, directionality = unit(-0.5, 0.3, 0.8), 0.7
    centers, radii = np.array([[0.05, 0.0, 0.08], [-0.1, -0.05, 0.05]]), [0.03, 0.04]
    surroundings = np.array([0.8, 0.7, 0.5])
    lights = [(np.array([0.1, 0.1, 0.3]), np.array([0.3, 0.2, 0.1])), (np.array([-0.2, 0.0, 0.2]), np.array([0.1] * 3))]
    table = color.decode_table("srgb")
    radiance = reference_color.decode(table, frame)
    expected, margin = np.zeros((H, W, 3)), np.full((H, W), np.inf)
    for at, intensity in lights:
        wi, n_dot_l, e = reference.point_light(POINTS, at, intensity)
        dark, near = reference.hidden(POINTS, at, centers, radii)
        alpha = (wi @ key)[..., None]
        kd, response = reference.respond(method, frame, radiance, n_dot_l, alpha, directionality, np.pi * surroundings)
        expected += np.where(dark[..., None], 0.0, kd / np.pi * response * e)
        margin = np.minimum(margin, near)
    got = run(
        method,
        [point(at, intensity) for at, intensity in lights],
        frame,
        objects=[shape(SPHERE, c, (r, 0, 0)) for c, r in zip(centers, radii, strict=True)],
        key=(key, directionality),
        sh=constant_environment(surroundings),
    )
    sure = margin > RIM
    assert sure.mean() > 0.95
    np.testing.assert_allclose(got[sure], expected[sure], rtol=3e-4, atol=1e-6)
    check_error("relight", got[sure], expected[sure])
    assert (got[sure] == 0.0).any()  # there is shadow


# --- geometry


def test_ball_hides_the_desk_and_throws_a_shadow(device):
    probe = {"center": (0.0, 0.0, 0.1), "radius": 0.04, "reflectance": (0.85,) * 3}
    light = np.array([-0.2, 0.0, 0.4])
    got = run("flat", [point(light)], probes=[probe])
    plain = run("flat", [point(light)])
    dark, near = reference.hidden(POINTS, light, [np.array([0, 0, 0.1])], [0.04])
    seen, rim = reference.hidden(POINTS, CAMERA, [np.array([0, 0, 0.1])], [0.04])
    sure = (near > RIM) & (rim > RIM)
    expected = np.where((dark | seen)[..., None], 0.0, plain)
    np.testing.assert_array_equal(got[sure], expected[sure])
    assert (dark & ~seen).any()


@pytest.mark.parametrize("irradiance", [np.nan, np.inf, -np.inf, -1.0, 0.0, 1e-30])
def test_reflectance_is_within_bounds_for_any_environment(device, irradiance):
    surroundings = np.full((8, 16, 3), irradiance, np.float32)
    got = run("reflectance", [point((0, 0, 0.3))], irradiance_map=surroundings)
    white = run("flat", [point((0, 0, 0.3))]) / 0.5
    assert ((got >= 0.0) & (got <= white * (1.0 + FLOAT_ERROR))).all()


# --- culling


def test_nothing_is_left_outside_the_rectangle(device):
    light = [point((0, 0, 0.3))]
    whole, part = run("flat", light), run("flat", light, rect=(10, 30, 5, 50))
    inside = np.zeros((H, W), bool)
    inside[10:30, 5:50] = True
    np.testing.assert_array_equal(part[inside], whole[inside])
    np.testing.assert_array_equal(part[~inside], 0.0)
