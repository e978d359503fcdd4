import dataclasses

import numpy as np
import pytest
import warp as wp

from tests.error_model import check_error
from tests.kernel_rig import TEXTURES, camera_fields, constant_environment, records, shape, tables
from tests.reference import environment_shadow as reference
from tests.test_relight import CAMERA, DESK, LOOK_DOWN, POINTS, RAYS, H, W
from warp_ar.engine.graph import make_plan
from warp_ar.kernels import (
    environment_samples,
    environment_shadow,
    environment_shadow_filter,
    environment_shadow_wavefront,
)
from warp_ar.kernels.environment_samples import EnvironmentSample, SampleSets
from warp_ar.kernels.environment_shadow_cells import (
    EnvironmentShadowConfig,
    ShadowCells,
    cell_column,
    shaded_shape,
)
from warp_ar.kernels.reflect import DistantLight, DistantLightConfig
from warp_ar.kernels.structs import (
    BOX,
    LAMBERT,
    PLANE,
    SPHERE,
    Emitter,
    FrameParams,
    Material,
    Probe,
    RayScene,
    Shape,
    make_picture,
)
from warp_ar.kernels.trace import TraceConfig
from warp_ar.scene import load_scene
from warp_ar.stages.quality import PRESETS
from warp_ar.stages.request import Request

COUNT, SIDE = 64, 4
ORIGIN = (0.0, 0.0, 0.035)
# Sums of float32 over up to 2048 terms of like size.
SUM_ERROR = 2e-5
# Rays that pass a sphere's rim nearer than this share of its radius may fall on either side of it.
RIM = 1e-3
# 1024 stratified samples of a smooth integrand: far below the 1 / sqrt 1024 of independent ones.
STRATIFIED = 0.01
# One sample of a sun may fall into the texel of the sky beside it.
ONE_SAMPLE = 1.0 / 512
# One set has 64 samples, of which half follow the light: a step of its visibility is 1/32, a few of them its error.
SET_ERROR = 0.12
# Mean over all pixels: 192 tiles of all 1024 samples each.
MEAN_ERROR = 2e-3


def draw(environment, count=COUNT * SIDE * SIDE):
    environment = np.asarray(environment, np.float32)
    height, width = environment.shape[:2]
    cumulative, sums = wp.zeros((height, width), wp.float32), wp.zeros(height, wp.vec2)
    directions, flux = wp.zeros(count, wp.vec3), wp.zeros(count, wp.vec3)
    samples = wp.zeros(count, EnvironmentSample)
    source = wp.array(environment, dtype=wp.vec3)
    environment_samples.sum_environment(source, cumulative, sums)
    environment_samples.draw_samples(source, cumulative, sums, wp.vec3(*ORIGIN), directions, flux, samples)
    return directions, flux, samples


def list_texels(environment):
    environment = np.asarray(environment, np.float32)
    count = environment.shape[0] * environment.shape[1]
    directions, flux = wp.zeros(count, wp.vec3), wp.zeros(count, wp.vec3)
    samples = wp.zeros(count, EnvironmentSample)
    environment_samples.list_texels(wp.array(environment, dtype=wp.vec3), wp.vec3(*ORIGIN), directions, flux, samples)
    return directions, flux, samples


def sky(radiance=1.0, size=(32, 64)):
    return np.full((*size, 3), radiance, np.float32)


def with_sun(row, column, radiance, environment=None):
    environment = sky() if environment is None else environment
    environment[row, column] = radiance
    return environment


def sphere(center, radius):
    return shape(SPHERE, center, (radius, 0, 0))


def shadow_cells(shape, stride=1, *, like=None, notes=True):
    """Cells with nothing in them yet, or with the estimates of others."""
    cells = ShadowCells()
    cells.stride = stride
    cells.ratio, cells.bounced, cells.surface = (
        (wp.zeros(shape, wp.vec4), wp.zeros(shape, wp.vec3), wp.full(shape, 7, wp.int32))
        if like is None
        else (like.ratio, like.bounced, like.surface)
    )
    cells.filtered = wp.zeros(shape, wp.vec3)
    if notes:
        tiles = shaded_shape(*shape)
        cells.shaded = wp.full(tiles, -1, dtype=wp.int32) if like is None else like.shaded
        cells.changed = wp.full(tiles, -1, dtype=wp.int32)
    return cells


def run(
    drawn,
    objects=(),
    proxies=(DESK,),
    probes=(),
    count=COUNT,
    side=SIDE,
    stride=1,
    bounce="estimated",
    secondary=1.0,
    albedo=0.0,
    rect=(0, H, 0, W),
    rows=None,
    filtered=True,
    out=None,
    emitters=False,
    partials=1,
    as_wavefront=False,
    others=None,
):
    kinds = tuple(tuple(sorted({item["kind"] for item in items})) for items in (objects, proxies))
    several = others is not None
    forms = DistantLightConfig(TraceConfig(*kinds), (LAMBERT,), False, "sh", False, bool(probes), several=several)
    config = EnvironmentShadowConfig(forms, count, side, bounce, secondary, emitters, partials)
    camera = camera_fields(CAMERA, LOOK_DOWN, 60, (H, W))
    params = records(FrameParams, {**camera, "shadow_rect": rect})
    scene = RayScene()
    objects = [{**item, "material": 0} for item in objects]
    scene.objects, scene.proxies = records(Shape, *objects), records(Shape, *proxies)
    scene.materials = records(Material, {"model": LAMBERT, "base_color": (albedo,) * 3, **dict.fromkeys(TEXTURES, -1)})
    surroundings = DistantLight()
    surroundings.environment = wp.array(sky(), dtype=wp.vec3)
    surroundings.probes = records(Probe, *probes)
    surroundings.irradiance_sh = wp.array(constant_environment(1.0), dtype=wp.vec3)
    if several:
        surroundings.others = others
    frame = wp.full((H, W), wp.vec3ub(255, 255, 255), dtype=wp.vec3ub)
    shape = -(-H // stride), -(-W // stride)
    cells = shadow_cells(shape, stride)
    rays = wp.array(RAYS, dtype=wp.vec2)
    wave = environment_shadow_wavefront.make_wavefront(config, *shape, rays.device) if as_wavefront else None
    assert as_wavefront == (wave is not None)
    picture = make_picture(frame, tables()[0], rays)
    sets = SampleSets()
    sets.directions, sets.flux, sets.samples = drawn
    environment_shadow.shade_environment(
        config, params, picture, scene, surroundings, sets, cells, wave=wave, rows=rows
    )
    if not filtered:
        return cells.ratio.numpy()[..., :3], cells.surface.numpy()
    # Around cells that are not shaded nothing is averaged, and tiles in which no cell differs from 1 are passed by.
    every, skipped = shadow_cells(shape, stride, like=cells, notes=False), shadow_cells(shape, stride, like=cells)
    out = wp.full((H, W), wp.vec3(9.0, 9.0, 9.0), dtype=wp.vec3) if out is None else out
    passed = wp.full((H, W), wp.vec3(9.0, 9.0, 9.0), dtype=wp.vec3)
    for some, target in ((every, out), (skipped, passed)):
        environment_shadow_filter.filter_ratio(config, params, some, rows=rows)
        environment_shadow_filter.spread_ratio(config, params, rays, scene, surroundings.probes, some, target)
    np.testing.assert_array_equal(skipped.filtered.numpy(), every.filtered.numpy())
    np.testing.assert_array_equal(passed.numpy(), out.numpy())
    return out.numpy()


# --- Samples ----------------------------------------------------------------------------------------------------------


def test_samples_of_a_constant_environment_sum_to_the_sphere(device):
    directions, flux, samples = draw(sky(0.7))
    assert samples.numpy()["measure"].sum() == pytest.approx(4 * np.pi, rel=STRATIFIED)
    up = np.maximum(directions.numpy()[:, 2], 0) @ flux.numpy()
    np.testing.assert_allclose(up, 0.7 * np.pi, rtol=STRATIFIED)


@pytest.mark.parametrize("row", [0, 3, 14])
def test_irradiance_of_a_one_texel_sun_over_a_dark_sky(device, row):
    environment = with_sun(row, 5, 1e6, sky(1e-4))
    directions, flux, _ = draw(environment)
    wi, solid_angle = reference.texel_directions(32, 64)
    expected = (np.maximum(wi[..., 2], 0) * solid_angle)[..., None] * environment
    up = np.maximum(directions.numpy()[:, 2], 0) @ flux.numpy()
    np.testing.assert_allclose(up, expected.sum((0, 1)), rtol=STRATIFIED)


@pytest.mark.parametrize("size", [(16, 32), (256, 512), (5, 9)])
def test_cumulative_sums_match_their_twin(device, size):
    """Along rows and over rows, over eight decades of radiance."""
    environment = np.float32(10.0 ** np.random.default_rng(6).uniform(-4, 4, (*size, 3)))
    cumulative, sums = wp.zeros(size, wp.float32), wp.zeros(size[0], wp.vec2)
    environment_samples.sum_environment(wp.array(environment, dtype=wp.vec3), cumulative, sums)
    along, over = reference.cumulative_sums(environment.astype(np.float64), float(environment_samples.SIDE_WEIGHT))
    check_error("environment_samples", cumulative.numpy(), along)
    for channel in range(2):
        check_error("environment_samples", sums.numpy()[:, channel], over[:, channel])


@pytest.mark.parametrize("size", [(16, 32), (5, 9), (1, 4)])
def test_every_sample_lies_in_the_texel_that_it_shows(device, size):
    height, width = size
    ramp = np.arange(height * width, dtype=np.float32).reshape(size)
    _, _, samples = draw(np.repeat(ramp[..., None], 3, -1))
    found = samples.numpy()
    wi = found["direction"]
    np.testing.assert_allclose(np.linalg.norm(wi, axis=1), 1, atol=1e-6)
    row = np.arccos(np.clip(wi[:, 2], -1, 1)) / np.pi * height
    column = (np.arctan2(wi[:, 1], wi[:, 0]) / np.pi + 1) / 2 * width
    texel = found["radiance"][:, 0].astype(int)
    # Half a texel from its middle, and what float32 directions lose.
    assert np.abs(row - (texel // width + 0.5)).max() < 0.5 + 1e-3
    off = np.abs(column - (texel % width + 0.5))
    assert np.minimum(off, width - off).max() < 0.5 + 1e-3
    assert len(np.unique(texel)) > min(height * width, 1024) // 3


@pytest.mark.parametrize("value", [0.0, np.nan, -5.0, np.inf])
def test_samples_stay_finite(device, value):
    environment = with_sun(4, 9, value, sky(0.0))
    for drawn in (draw(environment), list_texels(environment)):
        found = drawn[2].numpy()
        for name in ("direction", "radiance", "measure"):
            assert np.isfinite(found[name]).all(), name
        assert np.isfinite(drawn[1].numpy()).all()
        assert (found["radiance"] >= 0).all()
    if value != np.inf:
        assert found["radiance"].max() == 0


def test_sets_are_stratified():
    points = [(reference.radical_inverse(i), reference.sobol_second(i)) for i in range(1024)]
    for start in range(0, 1024, 64):
        cells = {(int(u * 8), int(v * 8)) for u, v in points[start : start + 64]}
        assert len(cells) == 64


def test_sobol_matches_its_twin(device):
    out = wp.zeros(1024, wp.float32)
    wp.launch(_sobol_kernel, dim=1024, outputs=[out])
    np.testing.assert_allclose(out.numpy(), [reference.sobol_second(i) for i in range(1024)], atol=2**-24)


@wp.kernel(enable_backward=False)
def _sobol_kernel(out: wp.array[wp.float32]):
    i = wp.tid()
    out[i] = environment_samples.sobol_second(wp.uint32(i))


def test_texels_list_the_map(device):
    environment = np.random.default_rng(3).random((8, 16, 3)).astype(np.float32)
    directions, flux, samples = list_texels(environment)
    wi, solid_angle = reference.texel_directions(8, 16)
    np.testing.assert_allclose(directions.numpy().reshape(8, 16, 3), wi, atol=1e-6)
    np.testing.assert_allclose(flux.numpy().reshape(8, 16, 3), solid_angle[..., None] * environment, rtol=1e-5)
    np.testing.assert_allclose(samples.numpy()["measure"].sum(), 4 * np.pi, rtol=SUM_ERROR)


def lamp_at(*positions, origin=ORIGIN):
    """Records of lamps at positions in the world, and an unused one; None stands for a distant lamp straight up."""
    values = []
    for at in positions:
        offset = np.array([0, 0, 1.0]) if at is None else np.asarray(at) - origin
        distance = np.linalg.norm(offset)
        far = np.inf if at is None else distance
        values.append({"origin": origin, "direction": offset / distance, "distance": far})
    return records(Emitter, *values, {})


def test_lamps_give_their_samples_a_place(device):
    at = np.array([0.3, -0.1, 0.2])
    direction = (at - ORIGIN) / np.linalg.norm(at - ORIGIN)
    environment = sky(0.5, (64, 128))
    wi = reference.texel_directions(64, 128)[0]
    environment[wi @ direction > np.cos(0.1)] = 40.0
    environment[wi[..., 2] > np.cos(0.1)] = 40.0
    _, _, samples = list_texels(environment)
    environment_samples.place_emitters(lamp_at(at, None), samples)
    found = samples.numpy()
    near = found["distance"] < 1e29
    np.testing.assert_array_equal(near, (wi @ direction > np.cos(0.1)).ravel())
    np.testing.assert_allclose(found["distance"][near], np.linalg.norm(at - ORIGIN), rtol=1e-5)
    assert np.isfinite(found["distance"]).all()


def test_lamps_are_placed_from_where_the_ball_mirrors_them(device):
    at, mirrors = np.array([0.3, -0.1, 0.2]), np.array([0.01, 0.02, 0.06])
    direction = (at - mirrors) / np.linalg.norm(at - mirrors)
    environment = sky(0.5, (256, 512))
    environment[reference.texel_directions(256, 512)[0] @ direction > np.cos(0.1)] = 40.0
    _, _, samples = list_texels(environment)
    environment_samples.place_emitters(lamp_at(at, origin=mirrors), samples)
    found = samples.numpy()
    near = found["distance"] < 1e29
    places = found["origin"][near] + found["distance"][near, None] * found["direction"][near]
    weights = found["measure"][near, None]
    # The mean over a disc of 0.1 rad lies its sagitta short of its middle.
    np.testing.assert_allclose((weights * places).sum(0) / weights.sum(), at, atol=0.002)
    np.testing.assert_allclose(found["origin"][~near], np.broadcast_to(ORIGIN, (int((~near).sum()), 3)), rtol=1e-6)


# --- Ratio ------------------------------------------------------------------------------------------------------------


def test_nothing_virtual_changes_nothing_to_the_bit(device):
    drawn = draw(with_sun(6, 20, 500.0))
    far = sphere((0, 0, -3), 0.05)  # below the desk
    assert (run(drawn, [far], probes=[{"center": (0.1, 0, 0.03), "radius": 0.03}]) == 1).all()


def test_sphere_under_an_even_sky(device):
    center, radius = (0.02, -0.03, 0.09), 0.05
    expected = 1 - reference.sphere_form_factor(POINTS, center, radius)
    got = run(draw(sky(0.3)), [sphere(center, radius)])[..., 0]
    assert np.abs(got - expected).max() < SET_ERROR
    assert abs((got - expected).mean()) < MEAN_ERROR
    # A pixel's window holds every set once, but not at one point: what is left is the curvature of the shadow.
    inner = (got - expected)[8:-8, 8:-8]
    assert np.sqrt((inner**2).mean()) < STRATIFIED


def test_reference_method_matches_the_twin(device):
    environment = np.random.default_rng(1).random((32, 64, 3)).astype(np.float32)
    environment[8, 40] = 300.0
    drawn = list_texels(environment)
    spheres, balls = [((0.05, 0.02, 0.06), 0.05), ((-0.1, 0.0, 0.04), 0.04)], [((-0.05, 0.1, 0.035), 0.035)]
    got = run(
        drawn,
        [sphere(*item) for item in spheres],
        probes=[{"center": c, "radius": r} for c, r in balls],
        count=2048,
        side=1,
        filtered=False,
    )[0]
    wi, flux = drawn[0].numpy().astype(np.float64), drawn[1].numpy().astype(np.float64)
    bright = wi[8 * 64 + 40]
    checked = 0
    for row, column in np.random.default_rng(0).integers(0, (H, W), (40, 2)):
        point = POINTS[row, column]
        to_ball = point - CAMERA
        if reference.meets_sphere(CAMERA, (to_ball / np.linalg.norm(to_ball))[None], *balls[0])[0]:
            continue
        shadowing = [*spheres, *balls]
        if min(reference.clearance(point, bright[None], *item)[0] for item in shadowing) < RIM:
            continue
        expected = reference.ratio_on_plane(point[None], wi, flux, spheres, balls)[0]
        # A ray at a rim may fall on either side: one of 2048, none bright but the sun, which is clear of them.
        check_error("environment_shadow", got[row, column], expected)
        checked += 1
    assert checked > 20


def test_light_that_the_physical_hides_is_not_hidden_again(device):
    # The sun stands above -y; a mirror ball and, behind it, a virtual ball are in its way to the same pixels.
    environment = with_sun(12, 16, 3000.0, sky(0.2))
    sun = reference.texel_directions(32, 64)[0][12, 16]
    ball = 0.03 * np.array([0, 0, 1]) + 0.0
    drawn = draw(environment)
    objects = [sphere(ball + 0.2 * sun, 0.027)]
    alone = run(drawn, objects)[..., 0]
    behind = run(drawn, objects, probes=[{"center": ball, "radius": 0.03}])[..., 0]
    shaded = alone < 0.5
    assert shaded.sum() > 20
    # What is left is sky: the virtual ball's share of it.
    assert behind[shaded].min() > 0.85


def test_proxies_hide_light(device):
    environment = with_sun(12, 16, 3000.0, sky(0.2))
    sun = reference.texel_directions(32, 64)[0][12, 16]
    wall = shape(BOX, tuple(0.6 * sun), (0.1, 0.1, 0.1))
    objects = [sphere(0.15 * sun, 0.03)]
    drawn = draw(environment)
    alone, behind = run(drawn, objects)[..., 0], run(drawn, objects, proxies=(DESK, wall))[..., 0]
    shaded = alone < 0.3
    assert shaded.sum() > 20
    assert behind[shaded].min() > 0.6


def test_sun_in_shadow_leaves_the_sky(device):
    environment = with_sun(4, 30, 400.0, sky(0.5))
    wi, solid_angle = reference.texel_directions(32, 64)
    center, radius = 0.3 * wi[4, 30], 0.04
    flux = (np.maximum(wi[..., 2], 0) * solid_angle)[..., None] * environment
    hidden = reference.sphere_form_factor(np.zeros(3), center, radius) * 0.5 * np.pi
    expected = 1 - (flux[4, 30, 0] + hidden) / flux[..., 0].sum()
    got = run(draw(environment), [sphere(center, radius)])
    at = np.unravel_index(np.linalg.norm(POINTS, axis=-1).argmin(), (H, W))
    assert got[at][0] == pytest.approx(expected, abs=0.02)


def test_black_environment_and_deep_contact(device):
    assert (run(draw(sky(0.0)), [sphere((0, 0, 0.05), 0.05)]) == 1).all()
    # A slab that lies on the desk leaves nothing under it.
    slab = shape(BOX, (0, 0, 0.02), (0.2, 0.2, 0.02 - 1e-5))
    dark = run(draw(sky(1.0)), [slab])
    at = np.unravel_index(np.linalg.norm(POINTS, axis=-1).argmin(), (H, W))
    assert dark[at].max() < 1e-3


@pytest.mark.parametrize("albedo", [0.0, 0.8, 1.0])
@pytest.mark.parametrize("bounce", ["estimated", "traced"])
def test_bounce(device, bounce, albedo):
    item = [sphere((0, 0, 0.08), 0.05)]
    drawn = draw(sky(1.0))
    black, lit = run(drawn, item)[..., 0], run(drawn, item, bounce=bounce, albedo=albedo)[..., 0]
    if albedo == 0.0:
        np.testing.assert_allclose(lit, black, atol=SUM_ERROR)
    else:
        # In a white furnace a white sphere is as bright as the sky but for what the shadow under it takes.
        hidden = 1 - black
        back = (lit - black)[hidden > 0.1] / hidden[hidden > 0.1]
        assert back.max() < albedo + SET_ERROR
        assert albedo * 0.7 < back.mean() < albedo + MEAN_ERROR


def test_estimated_bounce_keeps_the_energy_of_a_white_environment(device):
    """To and fro between white objects and the desk nothing is lost, however close they are."""
    for item in (sphere((0, 0, 0.08), 0.05), sphere((0.03, 0.02, 0.06), 0.05), shape(BOX, (0, 0, 0.07), (0.05,) * 3)):
        got = run(draw(sky(1.0)), [item], albedo=1.0)
        np.testing.assert_allclose(got, 1.0, atol=10 * SUM_ERROR)


def test_estimated_bounce_is_the_sum_of_its_series(device):
    """A grey sphere high above the desk: its lower half sees the desk, its upper half the sky."""
    center, radius, albedo = (0.0, 0.0, 0.2), 0.03, 0.6
    drawn = list_texels(sky(1.0))
    got = run(drawn, [sphere(center, radius)], albedo=albedo, count=2048, side=1)[..., 0]
    at = np.unravel_index(np.linalg.norm(POINTS, axis=-1).argmin(), (H, W))
    point = POINTS[at]
    # Directions of the texels that meet the sphere, and its normals there.
    wi, flux = drawn[0].numpy().astype(np.float64), drawn[1].numpy()[:, 0].astype(np.float64)
    weight = np.maximum(wi[:, 2], 0) * flux
    met = reference.meets_sphere(point, wi, center, radius)
    to_center = np.asarray(center) - point
    along = wi[met] @ to_center
    t = along - np.sqrt(radius**2 - (to_center @ to_center - along**2))
    up = ((point + t[:, None] * wi[met] - center) / radius)[:, 2]
    hidden, desk = weight[met].sum() / weight.sum(), albedo * (weight[met] @ (0.5 - 0.5 * up)) / weight.sum()
    surroundings = albedo * hidden - desk
    assert hidden > 0.01
    assert 0.005 < desk < albedo * hidden
    assert got[at] == pytest.approx((1 - hidden + surroundings) / (1 - desk), abs=SUM_ERROR)


@pytest.mark.parametrize("bounce", ["estimated", "traced"])
def test_the_physical_is_not_black(device, bounce):
    """In a white environment with a white box and a perfect ball only the virtual object, a black one, takes light."""
    center, radius = (0.02, -0.03, 0.03), 0.02
    drawn = draw(sky(1.0))
    probes = [{"center": (0.1, -0.03, 0.03), "radius": 0.03, "reflectance": (1, 1, 1)}]
    wall = shape(BOX, (-0.1, -0.03, 0.04), (0.03, 0.1, 0.04))
    alone = run(drawn, [sphere(center, radius)], bounce=bounce)[..., 0]
    among = run(drawn, [sphere(center, radius)], proxies=(DESK, wall), probes=probes, bounce=bounce)[..., 0]
    # Of what they stand on, and hide from the camera; and where they stand between the desk and the object.
    clear = (np.abs(POINTS[..., 1] + 0.03) < 0.05) & (POINTS[..., 0] > -0.03) & (POINTS[..., 0] < 0.05)
    assert clear.sum() > 20
    assert alone[clear].min() < 0.7
    np.testing.assert_allclose(among[clear], alone[clear], atol=10 * SUM_ERROR)
    # A white object changes nothing: nothing that it hides is darker or lighter than itself.
    if bounce == "estimated":
        white = run(drawn, [sphere(center, radius)], proxies=(DESK, wall), probes=probes, albedo=1.0)
        np.testing.assert_allclose(white, 1.0, atol=10 * SUM_ERROR)


@pytest.mark.parametrize("bounce", ["estimated", "traced"])
def test_the_physical_among_samples_matches_the_reference(device, bounce):
    """Sets of 64 samples beside every texel, with a box and a ball that differ from the environment behind them."""
    environment = sky(0.3)
    environment[8:14, 10:30] = 4.0
    probes = [{"center": (0.1, 0.02, 0.03), "radius": 0.03, "reflectance": (0.8, 0.8, 0.8)}]
    wall = shape(BOX, (-0.1, 0.0, 0.04), (0.03, 0.1, 0.04))
    scene = {"proxies": (DESK, wall), "probes": probes, "albedo": 0.6, "bounce": bounce}
    item = [sphere((0.0, -0.02, 0.06), 0.04)]
    got = run(draw(environment), item, **scene)
    expected = run(list_texels(environment), item, **scene, count=2048, side=1)
    assert expected.min() < 0.8
    assert abs((got - expected).mean()) < MEAN_ERROR
    assert np.abs(got - expected).max() < SET_ERROR


@pytest.mark.parametrize("bounce", ["estimated", "traced"])
def test_half_of_a_set_speaks_for_all_of_it(device, bounce):
    environment = with_sun(6, 20, 100.0)
    item = [sphere((0, 0, 0.07), 0.05)]
    whole, half = (run(draw(environment), item, albedo=0.8, bounce=bounce, secondary=share) for share in (1.0, 0.5))
    assert (half != whole).any()
    assert abs((half - whole).mean()) < MEAN_ERROR
    assert np.abs(half - whole).max() < SET_ERROR
    black = [run(draw(environment), item, bounce=bounce, secondary=share) for share in (1.0, 0.5)]
    np.testing.assert_array_equal(*black)


@pytest.mark.parametrize("bounce", ["estimated", "traced"])
def test_what_the_ball_hides_is_not_there(device, bounce):
    """Seen from the desk in front of the ball, an object behind it neither takes light nor sends any."""
    ball = np.array([0.0, 0.0, 0.035])
    probes = [{"center": ball, "radius": 0.035, "reflectance": (0.5, 0.5, 0.5)}]
    point = POINTS[H // 2, W // 4]
    toward = (ball - point) / np.linalg.norm(ball - point)
    item = [sphere(point + 0.4 * toward, 0.07)]
    scene = {"bounce": bounce, "albedo": 0.9, "count": 2048, "side": 1, "filtered": False}
    drawn = list_texels(sky(1.0))
    assert run(drawn, item, **scene)[0][H // 2, W // 4].max() < 0.995
    assert (run(drawn, item, probes=probes, **scene)[0][H // 2, W // 4] == 1).all()


def test_near_lamps_cast_their_own_shadow(device):
    # A lamp 0.4 m above the ball: straight up as the environment has it, aslant from elsewhere.
    environment = sky(1e-3, (64, 128))
    environment[:1] = 5000.0
    lamp = np.array([0, 0, 0.435])
    directions, flux, samples = draw(environment)
    item = [sphere((0.1, 0, 0.1), 0.03)]
    distant = run((directions, flux, samples), item)[..., 0]
    environment_samples.place_emitters(lamp_at(lamp), samples)
    near = run((directions, flux, samples), item, emitters=True)[..., 0]
    # Centre of the shadow: where the line through lamp and object meets the desk.
    expected = lamp + (np.array([0.1, 0, 0.1]) - lamp) * lamp[2] / (lamp[2] - 0.1)
    for got, center in ((distant, (0.1, 0.0)), (near, expected[:2])):
        weight = (got < 0.5).astype(float)
        assert weight.sum() > 10
        found = (POINTS[..., :2] * weight[..., None]).sum((0, 1)) / weight.sum()
        assert np.abs(found - center).max() < 0.012  # a pixel is 10 mm


# --- Cells ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stride", [1, 2, 3])
def test_bands_of_rows_and_rectangles(device, stride):
    drawn = draw(with_sun(6, 20, 100.0))
    item = [sphere((0, 0, 0.05), 0.05)]
    whole = run(drawn, item, stride=stride)
    assert whole.min() < 0.6
    rect = (7, 31, 12, 50)
    part = run(drawn, item, stride=stride, rect=rect)
    inside = np.zeros((H, W), bool)
    inside[7:31, 12:50] = True
    np.testing.assert_array_equal(part[inside], whole[inside])
    assert (part[~inside] == 1).all()
    assert (run(drawn, item, stride=stride, rect=(0, 0, 0, 0)) == 1).all()


@pytest.mark.parametrize("secondary", [1.0, 0.5])
@pytest.mark.parametrize("bounce", ["estimated", "traced"])
def test_a_wavefront_finds_the_same(device, bounce, secondary):
    """By one kernel or by four: with a box, a ball and a lamp at a place, all of which may be before the objects."""
    drawn = draw(with_sun(6, 20, 100.0))
    environment_samples.place_emitters(lamp_at((0.1, 0.05, 0.4)), drawn[2])
    scene = {
        "objects": [sphere((0, 0, 0.05), 0.05), shape(BOX, (-0.1, -0.1, 0.03), (0.03, 0.02, 0.03))],
        "proxies": (DESK, shape(BOX, (-0.12, 0.08, 0.04), (0.03, 0.04, 0.04))),
        "probes": [{"center": (0.1, 0, 0.03), "radius": 0.03, "reflectance": (0.8, 0.7, 0.6)}],
        "stride": 2,
        "bounce": bounce,
        "secondary": secondary,
        "albedo": 0.5,
        "emitters": True,
    }
    one = run(drawn, **scene)
    assert one.min() < 0.7
    for partials in (2, 8):
        found = run(drawn, **scene, partials=partials, as_wavefront=True)
        np.testing.assert_allclose(found, one, atol=SUM_ERROR)
        np.testing.assert_array_equal(run(drawn, **scene, partials=partials, as_wavefront=True), found)
    dark = run(drawn, **{**scene, "albedo": 0.0}, partials=8, as_wavefront=True)
    assert (dark[one < 0.99] < one[one < 0.99]).mean() > 0.5, "objects send light"


def test_a_wavefront_takes_one_set_and_little_memory(device):
    forms = DistantLightConfig(TraceConfig((SPHERE,), (PLANE,)), (LAMBERT,), False, "none", False, False)

    def wavefront(count, partials, secondary=1.0, size=(10, 20)):
        config = EnvironmentShadowConfig(forms, count, 4, "traced", secondary, partials=partials)
        return environment_shadow_wavefront.make_wavefront(config, *size, device)

    found = wavefront(64, 4, 0.5)
    assert (found.occluded.shape, found.queue.shape) == ((4, 10, 20), (10 * 20 * 32,))
    assert wavefront(64, 1) is None, "more samples than a word has bits"
    assert wavefront(128, 8) is None, "more than a set"
    assert wavefront(64, 2, size=(1080, 1920)) is None, "too much memory"


@wp.kernel(enable_backward=False)
def _columns_kernel(side: wp.int32, lanes: wp.int32, out: wp.array[wp.int32]):
    thread = wp.tid()
    out[thread] = cell_column(thread, out.shape[0], side, lanes)


@pytest.mark.parametrize("columns", [5, 128, 300, 640])
def test_every_column_has_a_thread(device, columns):
    for lanes in (1, 32):
        out = wp.zeros(columns, wp.int32)
        wp.launch(_columns_kernel, columns, [4, lanes], [out])
        taken = out.numpy()
        np.testing.assert_array_equal(np.sort(taken), np.arange(columns))
        whole = taken[: columns // (4 * lanes) * 4 * lanes].reshape(-1, lanes)
        assert (whole % 4 == whole[:, :1] % 4).all(), "a warp's cells are of one set"


def test_half_resolution_agrees(device):
    drawn = draw(sky(1.0))
    item = [sphere((0, 0, 0.09), 0.05)]
    full, half = run(drawn, item), run(drawn, item, stride=2)
    assert np.abs(full - half).max() < SET_ERROR
    assert abs((full - half).mean()) < MEAN_ERROR


def test_bands_agree_with_the_whole(device):
    drawn = draw(sky(1.0))
    item = [sphere((0, 0, 0.09), 0.05)]
    whole, key = run(drawn, item, filtered=False)
    for rows in ((0, 13), (13, H)):
        part, part_key = run(drawn, item, filtered=False, rows=rows)
        np.testing.assert_array_equal(part[slice(*rows)], whole[slice(*rows)])
        np.testing.assert_array_equal(part_key[slice(*rows)], key[slice(*rows)])


ON_DESK = EnvironmentShadowConfig(
    DistantLightConfig(TraceConfig((), (PLANE,)), (LAMBERT,), False, "none", False, False), 64, 4, "estimated"
)


def filtered_cells(ratio, surface, side=4):
    cells = shadow_cells(surface.shape, notes=False)
    cells.ratio.assign(np.asarray(ratio, np.float32))
    cells.surface.assign(surface.astype(np.int32))
    config = dataclasses.replace(ON_DESK, side=side)
    environment_shadow_filter.filter_ratio(config, records(FrameParams, {}), cells)
    return cells.filtered.numpy()


def test_filter_keeps_surfaces_apart(device):
    ratio = np.ones((16, 16, 4), np.float32)
    ratio[:, 8:, :3] = 0.25
    surface = np.zeros((16, 16), np.int32)
    surface[:, 8:] = 8
    surface[3, :] = -1
    out = filtered_cells(ratio, surface)
    expected = np.where(surface == 0, 1.0, 0.25)[..., None].repeat(3, -1)
    expected[3] = 0.0
    np.testing.assert_array_equal(out, expected)


def filtered(ratio, side=4):
    """What ``filter_ratio`` makes of one channel."""
    cells = np.repeat(np.asarray(ratio, np.float32)[..., None], 4, -1)
    return filtered_cells(cells, np.zeros(cells.shape[:2]), side)[..., 0]


def test_filter_weights_every_set_alike(device):
    # Each set has its own value; away from borders the mean of all is exact wherever the window lies.
    rows, columns = np.mgrid[:24, :24]
    value = 1 + 1e-3 * ((rows % 4) * 4 + columns % 4)
    np.testing.assert_allclose(filtered(value)[2:-2, 2:-2], 1.0075, rtol=1e-6)


def test_filter_narrows_where_that_makes_a_difference(device):
    # An edge between two even halves: only the cells at the edge are blurred.
    edge = np.full((24, 24), 0.2)
    edge[:, 12:] = 0.8
    expected = np.where(np.arange(24) < 12, 0.2, 0.8)
    got = filtered(edge)[8]
    np.testing.assert_allclose(np.delete(got, [11, 12]), np.delete(expected, [11, 12]), atol=1e-6)
    assert 0.35 <= got[11] <= 0.425
    weak = np.full((24, 24), 0.5)
    weak[:, 12:] += 0.5 * environment_shadow_filter.CONTRAST
    assert np.ptp(filtered(weak)[8, 10:14]) < np.ptp(filtered(weak, side=2)[8, 10:14])
    # A mean of 16 cells has half the noise of a mean of 4: where cells differ by chance, few of the latter are picked.
    noise = 0.5 + np.random.default_rng(0).normal(0, 0.1, (96, 96))
    wide, narrow = (filtered(noise, side=side)[4:-4, 4:-4].std() for side in (4, 2))
    assert wide < 0.8 * narrow


def test_what_no_picture_shows_is_exactly_one(device):
    value = np.ones((24, 24), np.float32)
    value[:, 12:] = 1 - 0.9 * environment_shadow_filter.NEGLIGIBLE
    assert (filtered(value) == 1).all()
    value[:, 12:] = 1 - 1.1 * environment_shadow_filter.NEGLIGIBLE
    assert (filtered(value)[:, 14:] != 1).all()


def test_spread_is_a_ramp(device):
    # Cells hold the row and column of the pixel that they were estimated at: between them a ramp has no step, no shift.
    for stride in (1, 2, 3, 4):
        cells = (9, 12)
        size = (cells[0] * stride, cells[1] * stride)
        axes = [np.arange(n) * stride + stride // 2 for n in cells]
        values = np.stack([*np.meshgrid(*axes, indexing="ij"), np.zeros(cells)], -1).astype(np.float32)
        params = records(FrameParams, {"shadow_rect": (0, size[0], 0, size[1])})
        out, rays = wp.zeros(size, wp.vec3), wp.zeros(size, wp.vec2)
        averaged = shadow_cells(cells, stride, notes=False)
        averaged.filtered, averaged.surface = wp.array(values, dtype=wp.vec3), wp.zeros(cells, wp.int32)
        environment_shadow_filter.spread_ratio(ON_DESK, params, rays, RayScene(), None, averaged, out)
        expected = [np.clip(np.arange(n), axis[0], axis[-1]) for n, axis in zip(size, axes, strict=True)]
        np.testing.assert_allclose(out.numpy()[..., :2], np.stack(np.meshgrid(*expected, indexing="ij"), -1), atol=1e-5)


def test_pixels_between_surfaces_find_their_own(device):
    # A board above the desk, dark, and the desk around it, unshaded: no pixel takes the other's ratio.
    board = shape(PLANE, (0.003, 0.004, 0.1), (0.083, 0.061, 0))
    params = records(
        FrameParams, {"camera_position": CAMERA, "world_from_camera": LOOK_DOWN, "shadow_rect": (0, H, 0, W)}
    )
    scene = RayScene()
    scene.proxies = records(Shape, DESK, board)
    stride = 4
    meets = CAMERA + (POINTS - CAMERA) * (0.6 - 0.1) / 0.6
    on_board = (np.abs(meets[..., :2] - (0.003, 0.004)) <= (0.083, 0.061)).all(-1)
    middle = on_board[stride // 2 :: stride, stride // 2 :: stride]
    averaged = shadow_cells(middle.shape, stride, notes=False)
    averaged.surface = wp.array(np.where(middle, 8, 0), dtype=wp.int32)
    averaged.filtered = wp.array(np.where(middle, 0.25, 1.0)[..., None].repeat(3, -1), dtype=wp.vec3)
    out, rays = wp.zeros((H, W), wp.vec3), wp.array(RAYS, dtype=wp.vec2)
    environment_shadow_filter.spread_ratio(ON_DESK, params, rays, scene, None, averaged, out)
    np.testing.assert_array_equal(out.numpy()[..., 0], np.where(on_board, 0.25, 1.0))


@pytest.mark.parametrize("stride", [1, 4, 5, 9])
def test_pixels_between_surfaces_may_have_a_kernel_of_their_own(device, monkeypatch, stride):
    """Cells of random surfaces, each on what is there or not: every pixel is written once, the same by both ways."""
    rng = np.random.default_rng(stride)
    shape_of_cells = -(-H // stride), -(-W // stride)
    board = shape(PLANE, (0.003, 0.004, 0.1), (0.083, 0.061, 0))
    scene = RayScene()
    scene.proxies = records(Shape, DESK, board)
    averaged = shadow_cells(shape_of_cells, stride, notes=False)
    averaged.surface = wp.array(rng.choice([-1, 0, 8], shape_of_cells, p=[0.2, 0.5, 0.3]), dtype=wp.int32)
    averaged.filtered = wp.array(rng.uniform(0.1, 0.9, (*shape_of_cells, 3)), dtype=wp.vec3)
    rays = wp.array(RAYS, dtype=wp.vec2)
    for rect in ((0, H, 0, W), (3, H - 2, 5, W - 1), (0, 0, 0, 0)):
        params = records(FrameParams, {"camera_position": CAMERA, "world_from_camera": LOOK_DOWN, "shadow_rect": rect})
        found = []
        for apart in (False, True):
            out = wp.full((H, W), wp.vec3(9.0, 9.0, 9.0), dtype=wp.vec3)
            monkeypatch.setattr(environment_shadow_filter, "spreads_apart", lambda *_, apart=apart: apart)
            environment_shadow_filter.spread_ratio(ON_DESK, params, rays, scene, None, averaged, out)
            found.append(out.numpy())
        if str(device) == "cpu":
            np.testing.assert_array_equal(found[1], found[0])
        else:  # NVRTC joins products and sums in each kernel as it likes
            np.testing.assert_allclose(found[1], found[0], rtol=1e-6)
        assert (found[1] < 2.0).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"count": 100}, "count is 100"),
        ({"secondary": 0.0}, "secondary is 0"),
        ({"secondary": 1.5}, "secondary is 1.5"),
        ({"partials": 3}, "partials is 3"),
    ],
)
def test_bad_configs_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(ON_DESK, **changes)


# --- Stage ------------------------------------------------------------------------------------------------------------


def stages(scene, method, **changes):
    scene = dataclasses.replace(scene, **changes)
    quality = PRESETS["medium"].with_methods(environment_shadow=method)
    plan = make_plan(Request(scene, quality, (scene.camera.width, scene.camera.height)))
    return {stage.name for stage, _ in plan.stages}, dict(plan.left_out)


def test_stage_says_why_it_is_left_out():
    scene = load_scene("torus")
    run_stages, _ = stages(scene, "coarse")
    assert {"environment_samples", "environment_shadow"} <= run_stages
    for changes, method, reason in (
        ({"objects": ()}, "coarse", "no virtual object"),
        ({"proxies": ()}, "coarse", "no proxy"),
        ({}, "none", "leaves out"),
    ):
        names, left_out = stages(scene, method, **changes)
        assert "environment_shadow" not in names
        assert "environment_samples" not in names
        assert reason in left_out["environment_shadow"]
