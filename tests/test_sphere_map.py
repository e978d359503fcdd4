"""The paper's way to look the ball up: a texture of the frame, box filters, OpenGL's sphere mapping."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import warp as wp
from hypothesis import example, given
from hypothesis import strategies as st

from tests import kernel_rig
from tests.error_model import check_error
from tests.kernel_rig import records
from tests.twins import color as reference_color
from tests.twins import sphere_map as reference
from tests.twins.latlong import directions
from warp_ar.kernels import color
from warp_ar.kernels.environment import sphere_map
from warp_ar.kernels.environment.lobes import lobe_count
from warp_ar.kernels.structs import FrameParams, Probe

H, W = 96, 128
FOCAL, PRINCIPAL = (140.0, 150.0), ((W - 1) / 2 + 3.0, (H - 1) / 2 - 2.0)
CENTER, RADIUS = np.array([-0.09, 0.02, 0.04]), 0.04
EYE = np.array([0.02, -0.3, 0.35])
MAP = (16, 32)
# Running means of equal numbers are exact; scaling by pi rounds once.
FURNACE = 1e-6
CLIP = 2.5  # radiance from which on a linear picture of these tests clips


def look_at(eye, target):
    """World from camera: z toward the target, x to the right, y down."""
    return kernel_rig.look_at(eye, target).rotation.T


def camera(eye, rotation, distortion=(0.0,) * 8):
    place = {"camera_position": eye, "world_from_camera": rotation, "focal": FOCAL, "principal": PRINCIPAL}
    return records(FrameParams, {**place, "distortion": distortion})


def run(frame, eye=EYE, rotation=None, level=0, scale=1.0, distortion=(0.0,) * 8, shape=MAP, rows=(None,), light=None):
    """Texture of all levels, the latlong map of one, confidence and clipping."""
    rotation = look_at(eye, CENTER) if rotation is None else rotation
    params, probes = camera(eye, rotation, distortion), records(Probe, {"center": CENTER, "radius": RADIUS})
    frame = wp.array(frame, dtype=wp.vec3ub)
    decode = wp.array(color.decode_table("srgb"), dtype=wp.vec3)
    linear = None if light is None else wp.array(light, dtype=wp.vec3)
    clip = None if light is None else wp.array(np.full((2, 3), CLIP), dtype=wp.vec3)
    texture = wp.full(sphere_map.map_texels(), wp.vec3(9.0, 9.0, 9.0), dtype=wp.vec3)
    out, confidence = wp.zeros(shape[0] * shape[1], dtype=wp.vec3), wp.zeros(shape, dtype=wp.float32)
    clipped = wp.zeros(shape, dtype=wp.vec3)
    for band in rows:
        whole = None if band is None else (band[0] * sphere_map.SIZE // shape[0], band[1] * sphere_map.SIZE // shape[0])
        sphere_map.copy_ball(params, probes, frame, decode, linear, texture, rows=whole)
    sphere_map.halve_levels(texture)
    for band in rows:
        sphere_map.look_up_level(params, texture, level, shape, out, scale=scale, rows=band)
        sphere_map.trust_ball(params, probes, frame, linear, clip, confidence, clipped, rows=band)
    return texture.numpy(), out.numpy().reshape(*shape, 3), confidence.numpy(), clipped.numpy()


def noise(seed=0):
    return np.random.default_rng(seed).integers(0, 256, (H, W, 3)).astype(np.uint8)


@pytest.mark.parametrize("level", [0, 2, 4, 6])
def test_matches_twin(device, level):
    """Texture, every level and the map of one, poles and seam included."""
    frame, rotation = noise(level), look_at(EYE, CENTER + 0.02)
    texture, found, _, _ = run(frame, rotation=rotation, level=level)
    radiance = reference_color.decode(color.decode_table("srgb"), frame)
    center, radius = reference.disc(EYE, rotation, FOCAL, PRINCIPAL, CENTER, RADIUS)
    levels = reference.levels(reference.texture(radiance, center, radius, sphere_map.SIZE))
    assert len(levels) == sphere_map.level_count()
    check_error("sphere_map", texture, np.concatenate([one.reshape(-1, 3) for one in levels]))
    check_error("sphere_map", found, reference.look_up(levels[level], directions(*MAP), rotation))


def test_a_linear_picture_is_read_in_the_place_of_codes(device):
    """Light above white is there as it is, what is darker than a code too; and clipping is the picture's own."""
    light = np.random.default_rng(3).uniform(0.0, 3.0, (H, W, 3)).astype(np.float32) ** 4 / 20.0
    rotation = look_at(EYE, CENTER + 0.02)
    texture, found, confidence, clipped = run(np.zeros((H, W, 3), np.uint8), rotation=rotation, level=2, light=light)
    center, radius = reference.disc(EYE, rotation, FOCAL, PRINCIPAL, CENTER, RADIUS)
    levels = reference.levels(reference.texture(light.astype(float), center, radius, sphere_map.SIZE))
    assert levels[0].max() > 1.5
    check_error("sphere_map", texture, np.concatenate([one.reshape(-1, 3) for one in levels]))
    check_error("sphere_map", found, reference.look_up(levels[2], directions(*MAP), rotation))
    assert confidence.all()
    assert 0.0 < clipped.mean() < 0.5
    # What codes say is the same to the bit by either way.
    frame = noise(5)
    same = color.decode_table("srgb")[frame, np.arange(3)]
    for codes, linear in list(zip(run(frame), run(frame, light=same), strict=True))[:3]:
        np.testing.assert_array_equal(codes, linear)


def test_background_is_blended_into_coarse_levels_alone(device):
    """Section 3.3: what surrounds the ball reaches filtered maps, from the texture's corners."""
    rotation = look_at(EYE, CENTER)
    center, radius = reference.disc(EYE, rotation, FOCAL, PRINCIPAL, CENTER, RADIUS)
    rows, columns = np.mgrid[:H, :W]
    off = np.hypot((columns - center[0]) / radius[0], (rows - center[1]) / radius[1])
    dark = np.full((H, W, 3), 60, np.uint8)
    bright = dark.copy()
    bright[off > 1.15] = 255  # a bilinear sample at the rim reaches a pixel beyond it
    maps = [[run(frame, level=level)[1] for level in (0, 4)] for frame in (dark, bright)]
    np.testing.assert_array_equal(maps[0][0], maps[1][0])
    assert (maps[1][1] - maps[0][1]).max() > 0.05


@pytest.mark.parametrize("code", [1, 128, 255])
@pytest.mark.parametrize("eye", [(0.02, -0.3, 0.35), (-0.09, 0.02, 0.1), (-0.09, -2.0, 0.5)], ids=str)
def test_a_constant_frame_is_a_constant_map(device, code, eye):
    """At every level, and pi times it as irradiance."""
    frame = np.full((H, W, 3), code, np.uint8)
    expected = color.decode_table("srgb")[code]
    for level in range(sphere_map.level_count()):
        texture, found, confidence, clipped = run(frame, np.array(eye), level=level, scale=np.pi)
        np.testing.assert_array_equal(texture, np.broadcast_to(expected, texture.shape))
        np.testing.assert_allclose(found, np.broadcast_to(np.pi * expected, found.shape), rtol=FURNACE)
        assert (confidence == 1.0).all()
        assert (clipped == float(code == 255)).all()


@given(
    log_distance=st.floats(-8, 8),
    direction=st.sampled_from([(0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, -0.6, 0.8), (-0.6, 0.64, 0.48)]),
    off=st.floats(-0.5, 0.5),
    bend=st.sampled_from([0.0, -0.3, 0.2]),
)
@example(log_distance=0.0, direction=(0.0, 0.0, 1.0), off=0.0, bend=0.0)
def test_from_anywhere(device, log_distance, direction, off, bend):
    """From the ball's centre to far away, with any lens, in or beyond the frame: finite, within the frame's range."""
    eye = CENTER + RADIUS * 10.0**log_distance * np.array(direction)
    rotation = look_at(eye, CENTER + off * RADIUS * np.array([1.0, 0.5, 0.25])) if log_distance > -7 else np.eye(3)
    frame = noise(1)
    linear = reference_color.decode(color.decode_table("srgb"), frame)
    distortion = (bend, 0.1 * bend, 0.01, -0.01, 0.0, 0.0, 0.0, 0.0)
    texture, found, confidence, clipped = run(frame, eye, rotation, distortion=distortion)
    assert np.isin(confidence, (0.0, 1.0)).all()
    assert np.isin(clipped, (0.0, 1.0)).all()
    if confidence.any():
        for values in (texture, found):
            assert linear.min() * (1 - 1e-5) <= values.min() <= values.max() <= linear.max() * (1 + 1e-5)
    else:
        assert not texture.any()
        assert not found.any()


def test_what_stands_before_the_ball_is_in_the_map(device):
    """The paper copies the ball's pixels, whatever they show: a red card before its left half is red light."""
    rotation = look_at(EYE, CENTER)
    center, _ = reference.disc(EYE, rotation, FOCAL, PRINCIPAL, CENTER, RADIUS)
    frame = np.full((H, W, 3), 128, np.uint8)
    frame[:, : round(center[0]) - 2] = (255, 0, 0)
    _, found, confidence, clipped = run(frame)
    u, _ = reference.sphere_mapped(directions(*MAP), rotation)
    np.testing.assert_allclose(found[u < -0.3], np.broadcast_to([1.0, 0.0, 0.0], found[u < -0.3].shape), atol=1e-6)
    assert (found[u > 0.3, 0] < 0.3).all()
    assert (confidence == 1.0).all()
    assert (clipped[u < -0.3] == [1.0, 0.0, 0.0]).all()


@pytest.mark.parametrize("height", [32, 64, 128, 256])
def test_lobes_widen_level_by_level(height):
    """The mirror is the texture itself, the widest lobe the level of 2x2, each one between twice as wide."""
    lobes = lobe_count(height)
    levels = [sphere_map.glossy_level(lobe, lobes) for lobe in range(lobes)]
    assert levels[0] == 0
    assert sphere_map.level_size(levels[-1]) == 2
    assert all(b - a in (0, 1) or a == 0 for a, b in itertools.pairwise(levels))
