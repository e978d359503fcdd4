"""Polished receivers: closed forms, the float64 twin, hard cases, scene files, and the stage."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import warp as wp

from tests.error_model import check_error
from tests.hard_cases.rig import SIZE, look_at, make_quality, make_scene
from tests.kernel_rig import (
    TEXTURES,
    as_compiled,
    camera_fields,
    constant_environment,
    records,
    shape,
    tables,
    trace_of,
)
from tests.mirror_ball_rig import CHALK, DESK, FOCAL, RAYS, H, W, grey_frame
from tests.twins import color as reference_color
from tests.twins import gloss as reference
from tests.twins.visibility import Body
from warp_ar.engine.pipeline import Pipeline
from warp_ar.kernels import color
from warp_ar.kernels.objects.reflect import DistantLight, DistantLightConfig
from warp_ar.kernels.objects.shade import ShadeConfig
from warp_ar.kernels.receiver import gloss
from warp_ar.kernels.structs import (
    LAMBERT,
    POINT,
    SPHERE,
    FrameParams,
    Light,
    Material,
    Probe,
    RayScene,
    Shape,
    make_picture,
)
from warp_ar.scene import ProxyMaterial

pytestmark = pytest.mark.slow

EYE = np.array([0.02, -0.45, 0.3])
CENTER, RADIUS = np.array([0.0, 0.06, 0.07]), 0.05
POSE = look_at(EYE, CENTER * [1.0, 1.0, 0.0])
BALL = shape(SPHERE, CENTER, (RADIUS,) * 3, 0)
AROUND = np.array([0.5, 0.4, 0.3])
F0 = np.array([0.04, 0.05, 0.06])
DIFFERENCE = (np.array(CHALK["base_color"]) - 1.0) * AROUND
LAMP = {"kind": POINT, "position": (0.05, 0.35, 0.3), "intensity": (0.3, 0.2, 0.1), "attenuation": (0, 0, 1)}
# float32 positions, turned by a curved object's normal.
FLOAT_ERROR = 1e-5
# Relative spread of 4,096 rays, of which a lobe's tail brings a few hundred, and their four-pixel neighbourhood.
RAYS_ERROR = 0.04
# Radiance of a highlight that is looked for, and as much again.
LEAST_HIGHLIGHT = 4e-4
# Masking and Fresnel at the middle of a sphere.
SPHERE_ERROR = 0.02


def directions(pose=POSE, rays=RAYS):
    return np.concatenate([rays, np.ones_like(rays[..., :1])], -1).astype(float) @ pose.inverse().rotation.T


def run(
    material,
    objects=(BALL,),
    proxies=(DESK,),
    balls=(),
    lights=(),
    ratio=None,
    samples=4,
    pose=POSE,
    frame=None,
    rows=None,
    around=AROUND,
    smooth=False,
):
    """What the receiver changes, (H, W, 3), in even surroundings."""
    roughness, f0 = material
    trace = trace_of(objects, proxies)
    lit = tuple(sorted({one["kind"] for one in lights}))
    forms = DistantLightConfig(trace, (LAMBERT,), False, "sh", True, True)
    config = gloss.GlossConfig(trace, samples, lit, as_compiled(ShadeConfig(forms, lit, 1), form="sh", soft=False))
    inverse, whole = pose.inverse(), (0, H, 0, W)
    camera = camera_fields(inverse.translation, inverse.rotation, FOCAL, (H, W))
    params = records(FrameParams, {**camera, "ball_rect": whole, "shadow_rect": whole})
    sight = gloss.Sight()
    sight.scene = RayScene()
    sight.scene.objects, sight.scene.proxies = records(Shape, *objects), records(Shape, *proxies)
    sight.scene.materials = records(Material, {**dict.fromkeys(TEXTURES, -1), **CHALK})
    codes = grey_frame() if frame is None else frame
    sight.picture = make_picture(wp.array(codes, dtype=wp.vec3ub), tables()[0], wp.array(RAYS, dtype=wp.vec2))
    sight.probes = records(Probe, *balls)
    distant = DistantLight()
    distant.irradiance_sh = wp.array(constant_environment(around), dtype=wp.vec3)
    distant.levels = wp.full(4096, wp.vec3(*map(float, around)), dtype=wp.vec3)
    distant.level_height = 8
    sight.distant = distant
    layers = gloss.GlossLayers()
    if ratio is not None:
        layers.shadow_ratio = wp.array(ratio.astype(np.float32), dtype=wp.vec3)
    sight.layers = layers
    surfaces = records(gloss.Gloss, *[{"reflectance": f0, "roughness": roughness}] * len(proxies))
    change, surface = wp.full((H, W), wp.vec3(9.0), dtype=wp.vec3), wp.zeros((H, W), dtype=wp.int32)
    gloss.gloss(config, params, sight, records(Light, *lights), surfaces, change, surface, rows=rows)
    if not smooth:
        return change.numpy()
    out = wp.zeros((H, W), dtype=wp.vec3)
    gloss.smooth_gloss(change, surface, None, out)
    return out.numpy()


# --- closed forms and the twin


def test_a_mirror_shows_a_ball_where_geometry_says(device):
    """A plane mirror: within the mirrored outline Fresnel times what the ball differs by, nothing beside it."""
    rays, body = directions().reshape(-1, 3), Body("sphere", np.eye(3), CENTER, 1.0, np.full(3, RADIUS))
    expected, hit = reference.mirror(EYE, rays, [body], DIFFERENCE, F0)
    inner, outer = (
        reference.mirror(EYE, rays, [dataclasses.replace(body, extent=np.full(3, r))], DIFFERENCE, F0)[1]
        for r in (0.95 * RADIUS, 1.05 * RADIUS)
    )
    sure = inner | ~outer
    got = run((0.0, F0)).reshape(-1, 3)
    assert inner.sum() > 100
    assert (~outer).sum() > 1000
    np.testing.assert_allclose(got[sure], expected[sure], atol=FLOAT_ERROR)
    check_error("gloss", got[sure], expected[sure])
    np.testing.assert_array_equal(got[~outer], 0.0)
    edge = hit[~sure] | ~hit[~sure]
    assert edge.any()


@pytest.mark.parametrize("roughness", [0.3, 0.8])
def test_a_rough_receiver_is_the_integral_over_its_lobe(device, roughness):
    """GGX as printed, in float64, over the cone that the ball fills."""
    got = run((roughness, F0), samples=4096, rows=(24, 41))
    peak = np.abs(got[24:41]).max()
    for row, column in ((24, 32), (30, 30), (36, 36), (40, 20)):
        expected = reference.rough(EYE, directions()[row, column], CENTER, RADIUS, DIFFERENCE, F0, roughness**2)
        np.testing.assert_allclose(got[row, column], expected, rtol=RAYS_ERROR, atol=0.01 * peak)
    assert peak > 1e-4


def test_what_is_mirrored_is_not_shadowed(device):
    """A ratio of 1/2 darkens what the receiver mirrors with the rest: half of it comes back, no more than is shown."""
    bright = run((0.0, F0), objects=(), ratio=np.full((H, W, 3), 0.5))
    _, wo = reference.primary(EYE, directions().reshape(-1, 3))
    expected = 0.5 * reference.schlick(F0, wo[:, 2]) * AROUND
    np.testing.assert_allclose(bright.reshape(-1, 3), expected, rtol=1e-4)
    dark = np.full((H, W, 3), 8, np.uint8)
    shown = reference_color.decode(color.decode_table("srgb"), dark)
    held = run((0.0, (1.0, 1.0, 1.0)), objects=(), ratio=np.full((H, W, 3), 0.5), frame=dark)
    np.testing.assert_allclose(held, 0.5 * shown, rtol=1e-5)


def test_a_lamp_has_a_highlight(device):
    """D F G2 / (4 cos_o) of the half vector, times the light's irradiance, shadowed by the ball."""
    got = run((0.4, F0), lights=[LAMP], objects=()).reshape(-1, 3)
    points, wo = reference.primary(EYE, directions().reshape(-1, 3))
    to = np.array(LAMP["position"]) - points
    distance = np.linalg.norm(to, axis=1, keepdims=True)
    wi = to / distance
    expected = reference.lobe(wo, wi, F0, 0.16) * np.array(LAMP["intensity"]) / distance**2
    clear = expected.max(1) > 3e-4
    assert clear.sum() > 200
    np.testing.assert_allclose(got[clear], expected[clear], rtol=1e-4)
    assert (got[expected.max(1) < 1e-4] == 0.0).all()
    half_way = {**BALL, "position": 0.5 * (np.array(LAMP["position"]) + np.array([0.03, -0.02, 0.0]))}
    shaded = run((0.4, F0), lights=[LAMP], objects=[half_way], around=np.zeros(3)).reshape(-1, 3)
    peak = np.argmax(expected[:, 0])
    assert shaded[peak, 0] < 0.5 * expected[peak, 0]


def test_a_sphere_has_a_wider_highlight(device):
    """That of all its directions, summed up; a point's would be up to five times as bright."""
    roughness, radius, eye = 0.4, 0.005, np.array([0.0, -0.03, 0.4])
    pose = look_at(eye, np.array([0.0, 0.05, 0.0]))
    lamp = {**LAMP, "radius": radius, "position": (0.02, 0.1, 0.35)}
    got = run((roughness, F0), lights=[lamp], objects=(), pose=pose)
    point = run((roughness, F0), lights=[{**lamp, "radius": 0.0}], objects=(), pose=pose)
    pixels = np.argwhere(np.maximum(got, point).max(-1) > LEAST_HIGHLIGHT)
    pixels = pixels[:: max(len(pixels) // 40, 1)]
    radiance, place = np.array(LAMP["intensity"]) / (np.pi * radius**2), np.array(lamp["position"])
    expected = np.array(
        [reference.rough(eye, directions(pose)[i, j], place, radius, radiance, F0, roughness**2) for i, j in pixels]
    )

    def error(change):
        return np.abs(change[tuple(pixels.T)] - expected).sum() / expected.sum()

    assert len(pixels) > 30
    assert error(got) < SPHERE_ERROR
    assert error(got) < 0.6 * error(point)


# --- hard cases


@pytest.mark.parametrize("height", [1e-4, 1e-2])
@pytest.mark.parametrize("roughness", [0.0, 1e-3, 0.1, 1.0])
def test_grazing_view(device, height, roughness):
    """Fresnel goes to 1, masking to 0: finite, and no more than the surroundings differ by."""
    eye = np.array([0.0, -0.4, height])
    got = run((roughness, F0), pose=look_at(eye, np.array([0.0, 0.0, 0.0])), lights=[LAMP])
    assert np.isfinite(got).all()
    plain = run((roughness, F0), pose=look_at(eye, np.array([0.0, 0.0, 0.0])))
    assert (np.abs(plain) <= np.abs(DIFFERENCE).max() + 1e-4).all()


@pytest.mark.parametrize("roughness", [0.0, 0.3])
def test_from_below_and_behind_nothing_is_mirrored(device, roughness):
    """A plane faces its own +z; what is under it is not mirrored above it either."""
    below = look_at(np.array([0.02, -0.45, -0.3]), np.zeros(3))
    np.testing.assert_array_equal(run((roughness, F0), pose=below, lights=[LAMP]), 0.0)
    under = {**BALL, "position": CENTER * [1.0, 1.0, -2.0]}
    np.testing.assert_array_equal(run((roughness, F0), objects=[under]), 0.0)


def test_a_matt_receiver_and_a_ball_before_it_do_not_change(device):
    np.testing.assert_array_equal(run((0.3, np.zeros(3)), lights=[LAMP], ratio=np.full((H, W, 3), 0.5)), 0.0)
    mirror = {"center": 0.5 * EYE, "radius": 0.1, "reflectance": (0.8, 0.8, 0.8)}
    inverse = POSE.inverse()
    ray = np.array([0.0, 0.0, 1.0]) @ inverse.rotation.T
    towards = (np.array(mirror["center"]) - EYE) @ ray
    assert towards > 0
    covered = {**mirror, "center": EYE + 0.2 * ray / np.linalg.norm(ray), "radius": 0.15}
    np.testing.assert_array_equal(run((0.3, F0), balls=[covered]), 0.0)


# --- scenes and the stage


def polished(**changes):
    scene = make_scene(**changes)
    plane = dataclasses.replace(scene.proxies[0], material=ProxyMaterial(0.2, (0.3, 0.3, 0.3)))
    return dataclasses.replace(scene, proxies=(plane, *scene.proxies[1:]))


def test_the_picture_has_it(device):
    """The receiver alone changes, and the layer of mirrors holds what the picture has."""
    frame = np.full((SIZE[1], SIZE[0], 3), 120, np.uint8)
    pose = look_at((0.02, -0.3, 0.35))
    pictures, layers = [], []
    for scene in (make_scene(), polished()):
        with Pipeline(scene, device=device, quality=make_quality(), outputs=("image", "mirror_ball")) as pipeline:
            result = pipeline(frame, time_seconds=0.0, pose=pose)
            pictures.append(np.array(result.image).astype(int))
            layers.append(np.array(result.layers["mirror_ball"]))
    changed = (pictures[0] != pictures[1]).any(-1)
    assert changed.mean() > 0.02
    assert (layers[0] != layers[1]).any(-1).mean() > 0.02
    assert not changed[(layers[0] == layers[1]).all(-1)].any()
