"""Radiance above clipping: the estimate against closed forms, its twin, and panoramas that do not clip."""

import numpy as np
import pytest
import warp as wp

from tests.error_model import check_error
from tests.kernel_rig import trace_of
from tests.twins import color as reference_color
from tests.twins import declip as reference
from warp_ar.kernels import color
from warp_ar.kernels.picture import declip
from warp_ar.kernels.structs import PLANE, FrameParams, Probe, RayScene, Shape, make_picture

# float32 sums over a pyramid of ten levels, and one power per pixel.
FLOAT = 2e-5
# How far the camera of `look` stands from the ball, and the ball's radius, metres.
DISTANCE, RADIUS = 0.5, 0.05


def run(frame, by_ball=False, environment=None, params=None, proxies=()):
    frame = np.ascontiguousarray(frame, dtype=np.uint8)
    height, width = frame.shape[:2]
    array = wp.array(frame, dtype=wp.vec3ub)
    decode = wp.array(color.decode_table("srgb"), dtype=wp.vec3)
    out = wp.zeros((height, width), wp.vec3)
    levels = wp.zeros(declip.level_texels(height, width), wp.vec4)
    scene = RayScene()
    scene.proxies = wp.array(list(proxies), dtype=Shape) if proxies else wp.zeros(0, Shape)
    ball = Probe()
    ball.center, ball.radius, ball.reflectance = wp.vec3(0.0, 0.0, 0.0), RADIUS, wp.vec3(0.8, 0.8, 0.8)
    tiles = [wp.zeros(declip.tile_shape(height, width), wp.int32) for _ in range(2)]
    declip.mark_tiles(array, tiles[0])
    declip.widen_tiles(*tiles)
    active = tiles[1]
    declip.pull_frame(active, array, decode, None, levels)
    declip.fill_levels(active, array.shape, levels)
    declip.complete(active, array, decode, levels, out)
    declip.pull_frame(active, array, decode, out, levels)
    declip.fill_levels(active, array.shape, levels)
    declip.complete_core(
        declip.DeclipConfig(by_ball, trace_of((), [{"kind": one.kind} for one in proxies]).proxies),
        make_picture(array, None, wp.array(rays(height, width), dtype=wp.vec2)),
        levels,
        wp.array([params or FrameParams()], dtype=FrameParams),
        scene,
        wp.array([ball], dtype=Probe),
        None if environment is None else wp.array(environment, dtype=wp.vec3),
        out,
    )
    return out.numpy()


def rays(height, width):
    """A field of view of about 90 degrees."""
    y, x = np.mgrid[:height, :width]
    return (np.stack([x - 0.5 * (width - 1), y - 0.5 * (height - 1)], -1) * 2.0 / width).astype(np.float32)


def looking_at_ball():
    """Camera on the -y axis, looking along +y; image right is +x, image down is -z."""
    params = FrameParams()
    params.camera_position = wp.vec3(0.0, -DISTANCE, 0.0)
    params.world_from_camera = wp.mat33(1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, -1.0, 0.0)
    return params


def linear(frame):
    return reference_color.decode(color.decode_table("srgb"), np.ascontiguousarray(frame, dtype=np.uint8))


def encode(radiance):
    return reference_color.encode(np.clip(radiance, 0.0, 1.0), reference_color.encoded_srgb)


def blob(hue, peak, size=64, width=9.0):
    """A Gaussian glow of one hue, (size, size, 3)."""
    y, x = np.mgrid[:size, :size] - 0.5 * (size - 1)
    return peak * np.exp(-0.5 * (x * x + y * y) / width**2)[..., None] * np.asarray(hue, float)


def test_unclipped_pixels_keep_their_radiance(device):
    frame = np.random.default_rng(0).integers(0, 256, (33, 47, 3))
    keep = frame <= reference.KNEE
    np.testing.assert_allclose(run(frame)[keep], linear(frame)[keep], rtol=1e-6)


def test_no_step_at_the_knee(device):
    """From one code to the next, neither hue nor core may jump by more than a quarter of the way up to a stop."""
    frame = np.full((32, 32, 3), 248, np.uint8)
    frame[0, 0] = 255
    steps = []
    for code in range(248, 256):
        frame[8:, 8:] = code
        steps.append(run(frame)[20, 20, 0])
    assert (np.diff(steps) >= -FLOAT).all()
    assert np.diff(steps).max() < 0.27


def test_missing_channel_of_one_hue_is_exact(device):
    """Where everything has one hue and one channel clips, the others say how bright it was."""
    truth = blob((1.0, 0.45, 0.2), 1.9)
    out = run(encode(truth))
    partly = (truth[..., 0] > 1.0) & (truth[..., 1] < 0.98)
    assert partly.sum() > 100
    # Codes are rounded: half a code of 255 on what the hue is read from and on what it is applied to.
    np.testing.assert_allclose(out[partly][:, 0], truth[partly][:, 0], rtol=0.02)


def test_edge_of_core_is_as_bright_as_its_hue_demands(device):
    truth = blob((1.0, 0.8, 0.5), 3.0)
    core = truth.min(-1) > 1.0
    out = run(encode(truth))
    assert (out[core][:, 0] >= 1.0 / 0.5 * 0.98).all()
    plain = np.abs(np.log2(truth[core])).mean()
    assert np.abs(np.log2(out[core] / truth[core])).mean() < 0.4 * plain


def test_grows_inward_by_at_most_a_stop(device):
    out = run(encode(blob((1.0, 1.0, 1.0), 40.0, 96, 12.0)))[48]
    assert (np.diff(out[48:70, 0]) <= FLOAT).all()
    assert 1.7 < out[48, 0] <= 2.0
    assert out.max() <= 2.0 * (1.0 + FLOAT)


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (5, 1), (31, 64), (64, 48), (97, 3), (120, 90)])
def test_matches_twin(device, shape):
    rng = np.random.default_rng(3)
    frame = np.clip(rng.normal(210.0, 60.0, (*shape, 3)), 0, 255).astype(np.uint8)
    frame[40:] //= 2  # tiles that take no part
    expected, active = reference.declip(frame, linear(frame))
    found, expected = run(frame), np.where(active[..., None], expected, 0.0)
    np.testing.assert_allclose(found, expected, rtol=FLOAT)
    check_error("declip", found, expected)


def test_never_below_clipping(device):
    frame = np.random.default_rng(5).choice(np.array([0, 3, 120, 255], np.uint8), (60, 60, 3))
    out = run(frame)
    assert np.isfinite(out).all()
    assert (out[frame >= reference.CLIPPED] >= 1.0 - FLOAT).all()


def environment(height=64, base=0.3, spots=()):
    """Grey environment with square spots: (theta, phi, half width in radians, radiance)."""
    theta, phi = np.meshgrid(
        (np.arange(height) + 0.5) * np.pi / height,
        ((np.arange(2 * height) + 0.5) / height - 1.0) * np.pi,
        indexing="ij",
    )
    out = np.full((height, 2 * height, 3), base, np.float32)
    for t, p, half, radiance in spots:
        out[(np.abs(theta - t) < half) & (np.abs(phi - p) < half)] = radiance
    return out


@pytest.mark.parametrize("pixel", [(32, 34), (30, 32), (33, 30), (34, 33)])
def test_ball_pixel_off_the_middle_shows_what_it_mirrors(device, pixel):
    """A lamp where the pixel's ray is mirrored to is found; one along the ball's normal there, or behind it, is not."""
    frame = np.full((65, 65, 3), 60, np.uint8)
    frame[pixel] = 255
    x, y = rays(65, 65)[pixel]
    direction, eye = np.array([x, 1.0, -y]) / np.linalg.norm([x, 1.0, y]), np.array([0.0, -DISTANCE, 0.0])
    along = direction @ eye
    normal = (eye + (-along - np.sqrt(along**2 - DISTANCE**2 + RADIUS**2)) * direction) / RADIUS
    mirrored = direction - 2.0 * (direction @ normal) * normal

    def lit_from(d):
        surroundings = environment(spots=[(np.arccos(d[2]), np.arctan2(d[1], d[0]), 0.2, 30.0)])
        return run(frame, True, surroundings, looking_at_ball())[pixel]

    assert (lit_from(mirrored) >= 24.0**0.5).all()
    for elsewhere in (normal, direction, -mirrored):
        assert (lit_from(elsewhere) == 1.0).all()


@pytest.mark.parametrize("distance", [0.45, 1.0, 1e4])
def test_lamp_beyond_the_scene_is_found_at_its_distance(device, distance):
    """A lamp seen up left of the ball: the ball sees it elsewhere the nearer it is."""
    frame = np.full((65, 65, 3), 60, np.uint8)
    frame[4:13, 4:13] = 255
    x, y = rays(65, 65)[8, 8]
    point = np.array([0.0, -DISTANCE, 0.0]) + distance * np.array([x, 1.0, -y])
    theta, phi = np.arccos(point[2] / np.linalg.norm(point)), np.arctan2(point[1], point[0])
    out = run(frame, True, environment(spots=[(theta, phi, 0.12, 50.0)]), looking_at_ball())
    assert out[8, 8].min() > 4.0
    elsewhere = run(frame, True, environment(spots=[(theta, phi + 2.0, 0.12, 50.0)]), looking_at_ball())
    assert elsewhere[8, 8].max() <= 2.0


def test_modelled_surface_is_no_lamp(device):
    frame = np.full((65, 65, 3), 60, np.uint8)
    frame[4:13, 4:13] = 255
    wall = Shape()
    wall.kind, wall.scale, wall.extent = PLANE, 1.0, wp.vec3(9.0, 9.0, 0.0)
    wall.rotation, wall.position = wp.mat33(1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, -1.0, 0.0), wp.vec3(0.0, 1.0, 0.0)
    bright = environment(base=20.0)
    assert run(frame, True, bright, looking_at_ball())[8, 8].min() > 4.0
    hidden = run(frame, True, bright, looking_at_ball(), [wall])
    assert hidden[8, 8].max() <= 2.0
