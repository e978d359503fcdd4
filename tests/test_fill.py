import numpy as np
import pytest
import warp as wp

from tests.error_model import check_error
from tests.kernel_rig import proxies_of, records
from tests.twins import fill as reference
from tests.twins import latlong
from warp_ar.kernels import structs
from warp_ar.kernels.color import decode_table
from warp_ar.kernels.environment import fill
from warp_ar.kernels.environment.fill_frame import FRAME_TRUST, OWN_SHADOW, fill_frame
from warp_ar.scene import loads_scene
from warp_ar.scene.ray_scene import HostScene

SIZES = [(32, 64), (64, 128), (7, 14), (5, 9), (1, 2), (1, 7), (3, 1), (1, 1), (16, 33), (2, 4)]


def filled(radiance, confidence, **options):
    height, width = np.shape(confidence)
    levels = wp.zeros(fill.fill_level_offsets(height, width)[-1], dtype=wp.vec4)
    out = wp.full((height, width), wp.vec3(-1.0), dtype=wp.vec3)
    radiance = wp.array(np.ascontiguousarray(radiance, np.float32), dtype=wp.vec3)
    fill.seed_fill(radiance, wp.array(np.ascontiguousarray(confidence, np.float32), dtype=wp.float32), levels)
    fill.push_pull(levels, height, width, **options)
    fill.finish_fill(levels, out)
    return out.numpy()


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_fill_matches_twin(device, height, width):
    rng = np.random.default_rng(5)
    radiance = np.float32(rng.uniform(0, 2, (height, width, 3)))
    confidence = np.float32(rng.random((height, width)) * (rng.random((height, width)) > 0.5))
    expected = reference.fill(radiance.astype(float), confidence.astype(float))
    check_error("fill", filled(radiance, confidence), expected)


@pytest.mark.parametrize(("height", "width"), [(32, 64), (128, 256)])
def test_no_share_of_an_emitter_is_spread_over_what_is_unseen(device, height, width):
    """The emitter stays; beside it the unseen gets what it would if the emitter were as bright as ``most``."""
    confidence = np.ones((height, width))
    confidence[: height // 2, : width // 2] = 0.0
    dim = np.full((height, width, 3), 0.3)
    dim[height // 2 + 1, width // 4] = 2.0
    lit = np.where(dim > 1.0, [900.0, 4000.0, 2.0], dim)
    known = confidence > 0.0
    out = filled(lit, confidence, most=2.0)
    assert (out[known] == np.float32(lit[known])).all()
    assert (out[~known] == filled(dim, confidence)[~known]).all()
    assert filled(lit, confidence)[~known].max() > 2.0, "without a bound it would be spread"


def test_nothing_known_is_no_light(device):
    assert (filled(np.full((16, 32, 3), 5.0), np.zeros((16, 32))) == 0).all()
    assert (filled(np.full((16, 32, 3), np.nan), np.ones((16, 32))) == 0).all()


@pytest.mark.parametrize(("height", "width"), [(32, 64), (31, 62), (15, 33)])
def test_a_hole_in_a_ramp_is_bridged_without_shift(device, height, width):
    """Hard case 4: holes at both poles, across the seam and in the middle of a map of its own directions."""
    ramp = 1.0 + latlong.directions(height, width)
    holes = {
        "north": (0, 0, 1),
        "south": (0, 0, -1),
        "seam": (-1, 0, 0),
        "middle": (1, 0, 0),
        "slant": (0.6, -0.5, 0.4),
    }
    for name, axis in holes.items():
        axis = np.array(axis) / np.linalg.norm(axis)
        inside = latlong.directions(height, width) @ axis > np.cos(np.radians(25))
        out = filled(ramp, np.where(inside, 0.0, 1.0))
        error = (out - ramp)[inside]
        # The cap bulges 0.09 over its rim, and push-pull fills it from patches as wide as the hole.
        assert np.abs(error).max() < 0.3, name
        across = error - (error @ axis)[:, None] * axis
        weight = latlong.solid_angles(height, width)[inside][:, None]
        # On average it leans nowhere: half a texel of the coarsest level that fits the hole would be 0.2.
        assert np.abs((across * weight).sum(0) / weight.sum()).max() < 0.05, name


# --- What the camera sees beyond and beside the ball goes into the map where the ball does not tell -------------------


HEIGHT = 64
WIDTH = 2 * HEIGHT
CODES = 0.01
"""A texel's directions against a ramp over the frame: they lie within a texel of its middle."""

SCENE = """
schema = 1
[camera]
width = 320
height = 240
fx = 160.0
fy = 160.0
cx = 159.5
cy = 119.5
transfer = "linear"
[marker]
size = 0.05
[probe]
center = [0.0, 0.0, 0.1]
radius = 0.03
"""
PLANE = """
[[proxy]]
shape = "plane"
size = [4.0, 4.0]
"""
EYE = np.array([-0.5, 0.0, 0.1])
"""Looks along +x, level with the ball."""
CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""``world_from_camera``."""


def given(device, frame, text, balls):
    """What ``fill_frame`` reads, and the kinds of proxy."""
    scene = loads_scene(text)
    host = HostScene(scene, device)
    place = {"camera_position": EYE, "world_from_camera": CAMERA}
    lens = {"focal": (160.0, 160.0), "principal": (159.5, 119.5)}
    probes = [{"center": center, "radius": 0.03, "reflectance": 0.85} for center in balls]
    codes, table = wp.array(frame, dtype=wp.vec3ub, device=device), decode_table("linear")
    arguments = (
        structs.make_picture(codes, wp.array(table, dtype=wp.vec3, device=device), None),
        records(structs.FrameParams, {**place, **lens}, device=device),
        records(structs.Probe, *probes, device=device),
        host.ray_scene,
    )
    return host, arguments, proxies_of(scene)


def filled_fill_frame(device, frame, text, seed, *, balls=((0.0, 0.0, 0.1),), ball=0):
    """Level 0 of the pyramid, (h, w, 4), after the frame was put into ``seed``."""
    _host, arguments, proxies = given(device, frame, text, balls)
    levels = wp.array(seed.reshape(-1, 4), dtype=wp.vec4, device=device)
    fill_frame(proxies, *arguments, (HEIGHT, WIDTH), ball, levels)
    return levels.numpy().reshape(HEIGHT, WIDTH, 4)


def ramp():
    """Red grows to the right, green downward; blue is even."""
    y, x = np.mgrid[:240, :320]
    return np.stack([x * 255 // 320, y, np.full_like(x, 100)], -1).astype(np.uint8)


def pixels_of(points):
    """Pixel of each point relative to the camera, (..., 2)."""
    p = points @ CAMERA
    return 160.0 * p[..., :2] / p[..., 2:] + [159.5, 119.5]


def inside(pixel, margin):
    return ((pixel > margin) & (pixel < np.array([319.0, 239.0]) - margin)).all(axis=-1)


def test_a_map_is_that_of_its_ball(device):
    """Of two, the second one's map is what it would be as the first; and not the first one's."""
    balls, seed = ((0.0, 0.0, 0.1), (0.1, 0.15, 0.06)), np.zeros((HEIGHT, WIDTH, 4), np.float32)
    second = filled_fill_frame(device, ramp(), SCENE + PLANE, seed, balls=balls, ball=1).copy()
    np.testing.assert_array_equal(second, filled_fill_frame(device, ramp(), SCENE + PLANE, seed, balls=balls[::-1]))
    assert (second != filled_fill_frame(device, ramp(), SCENE + PLANE, seed, balls=balls)).any()


def test_at_infinity_a_direction_is_where_the_camera_looks_along_it(device):
    level = filled_fill_frame(device, ramp(), SCENE, np.zeros((HEIGHT, WIDTH, 4), np.float32))
    d = latlong.directions(HEIGHT, WIDTH)
    pixel = pixels_of(d)
    seen = (d[..., 0] > 0.2) & inside(pixel, 6.0)
    past = seen & (np.arccos(d[..., 0]) > np.arcsin(1.2 * 0.03 / 0.5) + 0.05)
    assert past.sum() > 300
    assert level[past][:, 3] == pytest.approx(float(FRAME_TRUST.val if hasattr(FRAME_TRUST, "val") else FRAME_TRUST))
    assert level[past][:, 0] == pytest.approx(pixel[past][:, 0] / 320, abs=CODES + 1 / 255)
    assert level[past][:, 1] == pytest.approx(pixel[past][:, 1] / 255, abs=CODES + 1 / 255)
    # Behind the ball, and behind the camera, it sees nothing.
    behind = np.arccos(np.clip(d[..., 0], -1.0, 1.0)) < 0.02
    assert (level[behind | (d[..., 0] < 0.0)][:, 3] == 0.0).all()


def test_modelled_surfaces_are_looked_up_where_they_are(device):
    level = filled_fill_frame(device, ramp(), SCENE + PLANE, np.zeros((HEIGHT, WIDTH, 4), np.float32))
    d = latlong.directions(HEIGHT, WIDTH)
    down = (d[..., 2] < -0.15) & (d[..., 0] > 0.0)
    hit = np.array([0.0, 0.0, 0.1]) - 0.1 * d / np.where(down, d[..., 2], -1.0)[..., None]
    pixel = pixels_of(hit - EYE)
    away = np.linalg.norm(np.cross(hit - EYE, [1.0, 0.0, 0.0]), axis=-1) / np.linalg.norm(hit - EYE, axis=-1)
    # A texel's directions lie up to 2.8 degrees from its middle, by which their hits move along the plane.
    far = np.linalg.norm(hit - [0.0, 0.0, 0.1], axis=-1) > 1.5 * float(OWN_SHADOW) * 0.03
    told = down & far & inside(pixel, 6.0) & (away > 0.12)
    assert told.sum() > 100
    # Texels near the horizon span many pixels of the plane.
    assert np.median(np.abs(level[told][:, 1] - pixel[told][:, 1] / 255)) < CODES
    # Parallax: at infinity the same directions are elsewhere.
    assert np.median(np.abs(pixels_of(d)[told][:, 1] - pixel[told][:, 1])) > 10.0


def test_the_ball_s_own_shadow_is_not_taken_for_light(device):
    level = filled_fill_frame(device, ramp(), SCENE + PLANE, np.zeros((HEIGHT, WIDTH, 4), np.float32))
    d = latlong.directions(HEIGHT, WIDTH)
    to_plane = np.where(d[..., 2] < 0.0, -0.1 / np.minimum(d[..., 2], -1e-6), np.inf)
    near = to_plane < 0.9 * float(OWN_SHADOW) * 0.03
    assert near.sum() > 1000
    assert (level[near][:, 3] == 0.0).all()
    assert (level[(to_plane > 0.3) & (d[..., 2] < -0.1)][:, 3] > 0.0).sum() > 100


def test_what_the_ball_tells_is_kept(device):
    seed = np.zeros((HEIGHT, WIDTH, 4), np.float32)
    seed[..., :3], seed[..., 3] = 0.9, 1.0
    assert np.array_equal(filled_fill_frame(device, ramp(), SCENE, seed), seed)
    seed[..., 3] = 0.5
    level = filled_fill_frame(device, ramp(), SCENE, seed)
    changed = level[..., 3] > 0.5
    # Half by the ball, 0.8 of the other half by the frame, whose blue is 100.
    expected = (0.5 * 0.9 + 0.4 * 100 / 255) / 0.9
    whole = level[..., 3] > 0.899
    assert changed.any()
    assert level[whole][:, 2] == pytest.approx(expected, abs=1e-5)
    assert np.array_equal(level[~changed], seed[~changed])
