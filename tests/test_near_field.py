import numpy as np
import pytest
import warp as wp

from tests.environment_shadow_rig import COUNT, SIDE, draw, sky, sphere
from tests.error_model import check_error
from tests.kernel_rig import TEXTURES, camera_fields, constant_environment, records, tables, trace_of
from tests.relight_rig import CAMERA, DESK, LOOK_DOWN, POINTS, RAYS, H, W
from tests.twins import near_field as reference
from warp_ar.kernels.environment.lobes import lobe_texels
from warp_ar.kernels.objects import near_field
from warp_ar.kernels.objects.reflect import DistantLight, DistantLightConfig
from warp_ar.kernels.picture import frame_levels
from warp_ar.kernels.rays.visibility import make_visible, trace_pixels
from warp_ar.kernels.structs import (
    LAMBERT,
    MIRROR,
    PHONG,
    SPHERE,
    FrameParams,
    Hit,
    Material,
    RayScene,
    Shape,
    make_picture,
)

BALL = (0.0, 0.0, 0.06)
RADIUS = 0.05
LEVEL_HEIGHT = 8


def near_light(shape):
    near = near_field.NearLight()
    near.irradiance = wp.zeros(shape, wp.vec3)
    near.reflected, near.transmitted = wp.zeros(shape, wp.vec4), wp.zeros(shape, wp.vec4)
    return near


def run(
    objects,
    materials,
    code=255,
    filtered=True,
    ratio=None,
    added=None,
    rows=None,
    environment=None,
    samples=1,
    environment_shows=1.0,
    known=False,
    drawn=None,
    others=None,
    shown=None,
):
    models = tuple(sorted({m["model"] for m in materials}))
    forms = DistantLightConfig(
        trace_of([{"kind": SPHERE}], [DESK]),
        models,
        False,
        "sh" if set(models) - {MIRROR} else "none",
        bool(set(models) - {LAMBERT}),
        False,
        several=others is not None,
    )
    # As the stage has it: what no material needs is not compiled.
    lobes, samples = 4 if PHONG in models else 0, samples if MIRROR in models else 0
    layers = ratio is not None, added is not None
    config = near_field.NearFieldConfig(forms, COUNT, lobes, samples, SIDE, *layers, known)
    camera = camera_fields(CAMERA, LOOK_DOWN, 60, (H, W))
    params = records(FrameParams, {**camera, "object_rect": (0, H, 0, W), "light_rect": (0, H, 0, W)})
    scene = RayScene()
    scene.objects = records(Shape, *[{**item, "material": k} for k, item in enumerate(objects)])
    scene.proxies = records(Shape, DESK)
    scene.materials = records(Material, *[{**dict.fromkeys(TEXTURES, -1), **m} for m in materials])
    environment = sky() if environment is None else environment
    surroundings = make_surroundings(environment, environment_shows, others)
    rays = wp.array(RAYS, dtype=wp.vec2)
    hit_object, hits = wp.zeros((H, W), wp.int32), wp.zeros((H, W), Hit)
    visible = make_visible(hit_object, hits)
    trace_pixels(forms.trace, params, rays, scene, visible)
    drawn = draw(environment) if drawn is None else drawn
    shown = np.full((H, W), code) if shown is None else shown
    frame = wp.array(np.repeat(shown[..., None], 3, -1).astype(np.uint8), dtype=wp.vec3ub)
    near, layers = near_light((H, W)), near_field.ReceiverLayers()
    if ratio is not None:
        layers.shadow_ratio = wp.array(ratio, dtype=wp.vec3)
    if added is not None:
        layers.added = wp.array(added, dtype=wp.vec3)
    picture = make_picture(frame, tables()[0], rays)
    if forms.specular:
        layers.levels = make_levels(params, picture, layers)
    near_field.estimate_near_field(
        config, params, picture, layers, scene, surroundings, drawn[2], visible, near, rows=rows
    )
    if filtered:
        raw, near = near, near_light((H, W))
        near_field.filter_near_field(config, params, scene, visible, raw, near)
    return near.irradiance.numpy(), near.reflected.numpy(), hit_object.numpy(), hits.numpy(), drawn


def make_surroundings(environment, shows, others):
    """The environment, of which irradiance is that of 1 everywhere, and mirrors see ``shows``."""
    surroundings = DistantLight()
    surroundings.environment = wp.array(environment, dtype=wp.vec3)
    surroundings.irradiance_sh = wp.array(constant_environment(1.0), dtype=wp.vec3)
    surroundings.levels = wp.full(lobe_texels(LEVEL_HEIGHT), wp.vec3(*3 * [shows]), dtype=wp.vec3)
    surroundings.level_height = LEVEL_HEIGHT
    if others is not None:
        surroundings.others = others
    return surroundings


def make_levels(params, picture, layers):
    """All levels of a picture."""
    levels = wp.zeros(frame_levels.level_texels(H, W), wp.vec3)
    frame_levels.shrink_frame(params, picture, layers, levels)
    for level in range(2, frame_levels.LAST_LEVEL + 1):
        frame_levels.shrink_level(H, W, level, levels)
    return levels


CHALK = {"model": LAMBERT, "base_color": (1, 1, 1)}
CHROME = {"model": MIRROR, "base_color": (1, 1, 1)}


def test_a_white_furnace_of_few_rays_has_no_noise(device):
    """What is met is as bright as what it hides, and the environment's irradiance is known."""
    irradiance, _, found, _, _ = run([sphere(BALL, RADIUS)], [CHALK], known=True)
    np.testing.assert_allclose(irradiance[found >= 0], np.pi, rtol=1e-5)


@pytest.mark.parametrize("code", [0, 255])
def test_matches_the_twin(device, code):
    irradiance, _, found, hits, drawn = run([sphere(BALL, RADIUS)], [CHALK], code=code, filtered=False)
    directions, flux = drawn[0].numpy().astype(np.float64), drawn[1].numpy()[:, 0].astype(np.float64)
    reach_x, reach_y = CAMERA[2] * RAYS[..., 0].max(), CAMERA[2] * RAYS[..., 1].max()

    def seen(x, y):
        return (np.abs(x) < reach_x) & (np.abs(y) < reach_y)

    found_here, expected_here = [], []
    for row, column in np.argwhere(found >= 0)[::7]:
        first = ((row % SIDE) * SIDE + column % SIDE) * COUNT
        part = slice(first, first + COUNT)
        hit = hits[row, column]
        expected = reference.irradiance_over_plane(
            hit["point"], hit["normal"], directions[part], SIDE * SIDE * flux[part], seen, code / 255
        )
        found_here.append(irradiance[row, column, 0])
        expected_here.append(expected)
    assert len(found_here) > 10
    check_error("near_field", found_here, expected_here)


def test_mirror_shows_the_picture_of_the_desk(device):
    # A mirror ball next to a chalk ball: rays that go down see the desk, others a black environment or the other ball.
    items = [sphere(BALL, RADIUS), sphere((0.14, 0.0, 0.06), RADIUS)]
    # Layers that change nothing, and others: one kernel for both.
    (_, plain, found, hits, _), (_, layered, _, _, _) = (
        run(
            items,
            [CHROME, CHALK],
            ratio=np.full((H, W, 3), ratio, np.float32),
            added=np.full((H, W, 3), added, np.float32),
            environment_shows=0.0,
        )
        for ratio, added in ((1.0, 0.0), (0.5, 0.25))
    )
    ball = found == 0
    assert (plain[ball, 3] == 1).all(), "nothing is left to the prefiltered environment"
    near = plain[..., 0]
    np.testing.assert_allclose(near[ball & (near > 0)], 1, atol=1e-5)
    changed = ball & (near > 0) & (np.abs(layered[..., 0] - 1) > 1e-6)
    np.testing.assert_allclose(layered[changed, :3], 0.75, atol=1e-5)
    # Reflected straight up from the top; to the desk beyond 45 degrees of tilt.
    up = hits["normal"][..., 2]
    assert (near[ball & (up > 0.95)] == 0).all()
    assert changed.sum() > 5
    # What stays 1 in spite of the layers is the chalk ball, unoccluded under a sky of 1.
    chalk = ball & (near > 0) & ~changed
    assert chalk.sum() >= 1
    assert POINTS[chalk][:, 0].mean() > 0


def test_levels_are_means_of_the_picture_with_what_is_virtual(device):
    """Rows and columns that are no powers of two; shadows everywhere, light within its rectangle."""
    rng = np.random.default_rng(3)
    height, width = 23, 45
    shown, ratio = rng.uniform(0, 2, (height, width, 3)), rng.uniform(0, 1, (height, width, 3))
    added, rect = rng.uniform(0, 1, (height, width, 3)), (4, 20, 7, 31)
    picture = make_picture(
        wp.zeros((height, width), wp.vec3ub), tables()[0], wp.zeros((height, width), wp.vec2), wp.array(shown, wp.vec3)
    )
    layers = frame_levels.ReceiverLayers()
    layers.shadow_ratio, layers.added = wp.array(ratio, dtype=wp.vec3), wp.array(added, dtype=wp.vec3)
    levels = wp.zeros(frame_levels.level_texels(height, width), wp.vec3)
    frame_levels.shrink_frame(records(FrameParams, {"light_rect": rect}), picture, layers, levels)
    for level in range(2, frame_levels.LAST_LEVEL + 1):
        frame_levels.shrink_level(height, width, level, levels)
    composed = shown * ratio
    composed[4:20, 7:31] += added[4:20, 7:31]
    for level in range(1, frame_levels.LAST_LEVEL + 1):
        side, (rows, columns) = 2**level, frame_levels.level_size(height, width, level)
        assert (rows, columns) == (-(-height // side), -(-width // side))
        start = frame_levels.level_offset(height, width, level)
        found = levels.numpy()[start : start + rows * columns].reshape(rows, columns, 3)
        expected = [
            [composed[i : i + side, j : j + side].mean((0, 1)) for j in range(0, width, side)]
            for i in range(0, height, side)
        ]
        np.testing.assert_allclose(found, expected, rtol=2e-6)


def test_share_follows_the_light(device):
    """Half of the rays meet something near; the other half carries nine tenths of the light, or none is known."""
    found = np.zeros((16, 16), int)
    mirrored = np.broadcast_to(np.array([0.2, 0.2, 0.2, 0.5]), (16, 16, 4))
    for missed, light, left in ((0.9, 1.0, 0.5 * 0.9), (0.0, 1.0, 0.0), (0.0, 0.0, 0.5)):
        passed = np.broadcast_to(np.array([missed, missed, missed, light]), (16, 16, 4))
        _, out = average(found, (0, 0, 1), np.zeros((16, 16, 3)), mirrored, (PHONG,), passed=passed)
        np.testing.assert_allclose(out[..., :3], 0.2 + 0.5 * missed, rtol=1e-6)
        np.testing.assert_allclose(out[..., 3], 1 - left, rtol=1e-6)


def average(
    found, normals, irradiance, mirrored, models=(LAMBERT, LAMBERT), rect=None, passed=None, lobes=4, **surface
):
    """Filter estimates as given, (h, w); object k has material k, of model k and this surface."""
    height, width = found.shape
    forms = DistantLightConfig(
        trace_of([{"kind": SPHERE}], [DESK]), tuple(sorted(set(models))), False, "sh", True, False
    )
    config = near_field.NearFieldConfig(forms, COUNT, lobes, 1, SIDE, False, False)
    scene = RayScene()
    scene.objects = records(Shape, *[{**sphere(BALL, RADIUS), "material": k} for k in range(len(models))])
    scene.materials = records(
        Material, *[{"model": model, **dict.fromkeys(TEXTURES, -1), **surface} for model in models]
    )
    hits = np.zeros(found.shape, np.dtype(Hit.numpy_dtype()))
    hits["normal"] = normals
    estimate, near = near_light((height, width)), near_light((height, width))
    estimate.irradiance.assign(irradiance.astype(np.float32))
    estimate.reflected.assign(mirrored.astype(np.float32))
    estimate.transmitted.assign(np.zeros_like(mirrored, np.float32) if passed is None else passed.astype(np.float32))
    visible = make_visible(wp.array(found.astype(np.int32), dtype=wp.int32), wp.array(hits, dtype=Hit))
    params = records(FrameParams, {"object_rect": rect or (0, height, 0, width)})
    near_field.filter_near_field(config, params, scene, visible, estimate, near)
    return near.irradiance.numpy(), near.reflected.numpy()


def test_averages_stop_at_the_edges_of_objects(device):
    """Neither another object nor what stands where nothing is seen (here: NaN) gets in, at any edge."""
    found = np.full((17, 23), -1)
    found[2:15, 3:11], found[2:15, 11:20] = 0, 1
    found[6, 3] = found[14, 15] = -1  # notches
    found[0, 0] = 0  # one pixel alone
    light = np.where(found == 0, 1.0, np.where(found == 1, 5.0, np.nan))
    irradiance, mirrored = average(found, (0, 0, 1), light[..., None].repeat(3, -1), light[..., None].repeat(4, -1))
    for out in (irradiance, mirrored):
        for item, value in ((0, 1.0), (1, 5.0)):
            np.testing.assert_allclose(out[found == item], value, rtol=1e-6)
        assert (out[found < 0] == 0).all(), "what is no object is left alone"


def test_averages_stop_at_creases_and_at_the_rectangle(device):
    found = np.zeros((16, 16), int)
    normals = np.where((np.arange(16) < 8)[None, :, None], (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)) * np.ones((16, 1, 1))
    light = np.where(np.arange(16) < 8, 1.0, 5.0) * np.ones((16, 1))
    light[:, 0] = np.nan  # beyond the rectangle
    out, _ = average(found, normals, light[..., None].repeat(3, -1), np.ones((16, 16, 4)), rect=(0, 16, 1, 16))
    np.testing.assert_allclose(out[:, 1:8], 1.0, rtol=1e-6)
    np.testing.assert_allclose(out[:, 8:], 5.0, rtol=1e-6)
