"""Shading: white furnace, closed forms, the float64 twin, edges, and builds with less than everything."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import warp as wp

from tests.error_model import check_error
from tests.kernel_rig import TEXTURES, constant_environment, records
from tests.test_visibility import GENERAL, World
from tests.twins import shade as reference
from warp_ar.kernels import structs
from warp_ar.kernels.edges import EdgeLists
from warp_ar.kernels.environment.lobes import lobe_texels
from warp_ar.kernels.objects.reflect import DistantLight, DistantLightConfig
from warp_ar.kernels.objects.shade import ShadeConfig, make_object_light, shade
from warp_ar.kernels.rays.visibility import make_visible, trace_pixels
from warp_ar.kernels.split_sum import integrate_dfg
from warp_ar.kernels.structs import LAMBERT, METALLIC_ROUGHNESS, MIRROR, PHONG, Hit

SIZE = (48, 64)
FOCAL = 60.0
LEVEL_HEIGHT = 16
EVERYTHING = ShadeConfig(
    DistantLightConfig(GENERAL, (), textures=True, diffuse="sh", specular=True, known=True), (), edge_samples=4
).general("sh", soft=False)

# Float32 positions against float64: 1e-6 of the cosine and the distance; a shadow's edge may fall to either side.
TWIN_TOLERANCE = 2e-5
TWIN_OUTLIERS = 4e-3
# Units in the last place between two kernels that share the code of a sample. On CUDA each is compiled by itself, and
# where only one hoists a product out of its loop, only the other contracts it with its sum: one rounding of a sample.
CONTRACTION_ULPS = {"cpu": 0, "cuda": 4}


def make_distant_light(models, device, radiance=1.0):
    """A constant environment for the given material models."""
    surroundings = DistantLight()
    surroundings.irradiance_sh = wp.array(constant_environment(radiance), dtype=wp.vec3, device=device)
    levels = np.full((lobe_texels(LEVEL_HEIGHT), 3), radiance, np.float32)
    surroundings.levels = wp.array(levels, dtype=wp.vec3, device=device)
    surroundings.level_height = LEVEL_HEIGHT
    if METALLIC_ROUGHNESS in models:
        table = wp.zeros((32, 32), dtype=wp.vec2, device=device)
        integrate_dfg(table)
        surroundings.dfg = table
    return surroundings


def materials(*fields, device):
    return records(structs.Material, *[{**dict.fromkeys(TEXTURES, -1), **values} for values in fields], device=device)


def lights(*fields, device):
    return records(structs.Light, *[{"attenuation": (0, 0, 1), **values} for values in fields], device=device)


def scene_of(world, *fields, device):
    """The world with a material for each object."""
    for index, record in enumerate(world.records):
        record["material"] = index % len(fields)
    scene = world.scene()
    scene.materials = materials(*fields, device=device)
    return scene


def render(
    scene,
    config,
    device,
    *,
    light_array=None,
    light_environment=1.0,
    rect=(0, 48, 0, 64),
    bands=(None,),
    eye=(0.0, 0.0, 0.0),
    listed=0,
):
    """Trace and shade a frame of a camera at ``eye`` that looks along +z; (48, 64, 4)."""
    place = {"camera_position": eye, "world_from_camera": np.eye(3), "focal": FOCAL, "object_rect": rect}
    params = records(structs.FrameParams, place, device=device)
    rays = wp.array(pixel_rays().astype(np.float32), dtype=wp.vec2, device=device)
    found = wp.zeros(SIZE, dtype=wp.int32, device=device)
    hits = wp.zeros(SIZE, dtype=Hit, device=device)
    virtual = wp.full(SIZE, wp.vec4(9.0), dtype=wp.vec4, device=device)
    surroundings = make_distant_light(config.distant.models, device, light_environment)
    light_array = lights(device=device) if light_array is None else light_array
    visible = make_visible(found, hits)
    trace_pixels(config.distant.trace, params, rays, scene, visible)
    lists = None
    if listed:
        samples = wp.zeros(listed * config.edge_samples, dtype=wp.vec4, device=device)
        count, edges = (wp.zeros(n, dtype=t, device=device) for n, t in ((1, wp.int32), (listed, wp.vec2i)))
        lists = EdgeLists.of(count, edges, samples)
    for rows in bands:
        inputs = (params, rays, scene, make_object_light(surroundings, light_array), visible)
        shade(config, *inputs, virtual, edge_lists=lists, rows=rows)
    return virtual.numpy()


def pixel_rays(offset=(0.0, 0.0)):
    x, y = np.meshgrid((np.arange(64) - 31.5 + offset[0]) / FOCAL, (np.arange(48) - 23.5 + offset[1]) / FOCAL)
    return np.stack([x, y], -1)


def ball(device, *, radius=0.5, depth=2.0):
    return World(device).add("sphere", extent=(radius,) * 3, at=(0, 0, depth))


# --- Closed form ------------------------------------------------------------------------------------------------------

WHITE = {
    "lambert": {"model": LAMBERT, "base_color": 1.0},
    "phong": {"model": PHONG, "base_color": 0.3, "specular": 0.7, "shininess": 20.0},
    "plastic": {"model": METALLIC_ROUGHNESS, "base_color": 1.0, "roughness": 0.4},
    "metal": {"model": METALLIC_ROUGHNESS, "base_color": 1.0, "roughness": 1.0, "metallic": 1.0},
    "mirror": {"model": MIRROR, "base_color": 1.0},
}


def test_coverage_of_a_disc(device):
    """With smooth edges, the sum of coverages is the projected area of a ball."""
    area = math.pi * (FOCAL * math.tan(math.asin(0.25))) ** 2
    scene = scene_of(ball(device), WHITE["lambert"], device=device)
    errors = []
    for samples in (1, 4):
        config = dataclasses.replace(EVERYTHING, edge_samples=samples)
        alpha = render(scene, config, device)[..., 3]
        errors.append(abs(alpha.sum() - area) / area)
        assert set(np.unique(np.round(alpha * samples, 4))) <= set(range(samples + 1))
    # About 100 edge pixels with a quantisation error of 1 / sqrt(12 n) or less each, of an area of 750.
    assert errors[0] < 0.02
    assert errors[1] < 0.008


@pytest.mark.slow
@pytest.mark.parametrize(("edge_samples", "listed"), [(4, 5)])
def test_listed_edges_are_the_same(device, edge_samples, listed):
    """Edges sampled on their own, or in place where the list does not hold them all, are as edges sampled at once."""
    scene = scene_of(ball(device), WHITE["plastic"], device=device)
    config = dataclasses.replace(EVERYTHING, edge_samples=edge_samples)
    expected = render(scene, config, device)
    assert ((expected[..., 3] > 0.0) & (expected[..., 3] < 1.0)).sum() > 20
    image = render(scene, config, device, listed=listed)
    np.testing.assert_array_equal(image[..., 3], expected[..., 3])
    np.testing.assert_array_max_ulp(image, expected, CONTRACTION_ULPS["cpu" if device == "cpu" else "cuda"])


# --- The float64 twin -------------------------------------------------------------------------------------------------


def test_matches_reference(device):
    """Lambertian shapes that shadow each other, against brute force in double precision, edge samples included."""
    world = World(device)
    world.add("sphere", extent=(0.4, 0.4, 0.4), at=(-0.3, 0, 2)).add("box", extent=(0.3, 0.2, 0.4), at=(0.4, 0.2, 2.4))
    world.add("box", extent=(3, 3, 0.1), at=(0, 0, 3.2), rotate=(20, 10, 0))
    base = np.array([[0.8, 0.2, 0.1], [0.1, 0.7, 0.2], [0.5, 0.5, 0.5]])
    scene = scene_of(world, *({"model": LAMBERT, "base_color": color} for color in base), device=device)
    position, intensity = np.array([-1.2, -0.9, 0.6]), np.array([3.0, 2.0, 1.0])
    light = lights({"kind": structs.POINT, "position": position, "intensity": intensity}, device=device)
    image = render(scene, EVERYTHING, device, light_array=light, light_environment=0.0)

    samples = []
    for b in range(2):
        for a in range(2):
            offset = ((a + (b + 0.5) / 2) / 2 - 0.5, (b + (1.5 - a) / 2) / 2 - 0.5)
            directions = np.concatenate([pixel_rays(offset), np.ones((*SIZE, 1))], -1).reshape(-1, 3)
            samples.append(
                np.column_stack(
                    reference.shade_point_light(world.bodies, base, np.zeros(3), directions, position, intensity)
                )
            )
    directions = np.concatenate([pixel_rays(), np.ones((*SIZE, 1))], -1).reshape(-1, 3)
    center = np.column_stack(
        reference.shade_point_light(world.bodies, base, np.zeros(3), directions, position, intensity)
    )
    smooth = np.mean(samples, 0).reshape(*SIZE, 4)
    center = center.reshape(*SIZE, 4)
    # A pixel is either its centre or the mean of its samples; which of the two is the edge test's business.
    error = np.minimum(np.abs(image - smooth).max(-1), np.abs(image - center).max(-1))
    assert (error > TWIN_TOLERANCE).mean() < TWIN_OUTLIERS
    nearest = np.where((np.abs(image - smooth).max(-1) < np.abs(image - center).max(-1))[..., None], smooth, center)
    check_error("shade", image[error <= TWIN_TOLERANCE], nearest[error <= TWIN_TOLERANCE])
    # Where the object changes between neighbours, it must be the mean.
    _, which, _ = reference.closest(world.bodies, np.zeros_like(directions), directions)
    which = which.reshape(SIZE)
    edge = np.zeros(SIZE, bool)
    edge[:, 1:] |= which[:, 1:] != which[:, :-1]
    edge[:, :-1] |= which[:, 1:] != which[:, :-1]
    assert edge.sum() > 100
    assert (np.abs(image - smooth).max(-1)[edge] > TWIN_TOLERANCE).mean() < 0.05  # shadow edges beside outlines


# --- Structure --------------------------------------------------------------------------------------------------------


def crowd(device):
    world = World(device)
    for index, at in enumerate([(-0.6, 0, 2), (0, 0.2, 1.8), (0.6, 0, 2.2)]):
        world.add("sphere", extent=(0.35,) * 3, at=at, scale=1.0 + 0.1 * index)
    return world


def test_only_the_rectangle_is_touched_and_bands_make_the_whole(device):
    """Zero outside the rectangle, the same inside; bands equal one launch bit for bit."""
    scene = scene_of(crowd(device), WHITE["lambert"], device=device)
    whole = render(scene, EVERYTHING, device)
    np.testing.assert_array_equal(render(scene, EVERYTHING, device, bands=((0, 9), (9, 30), (30, 48))), whole)
    part = render(scene, EVERYTHING, device, rect=(15, 35, 20, 50))
    outside = np.ones(SIZE, bool)
    outside[15:35, 20:50] = False
    assert (part[outside] == 0).all()
    np.testing.assert_array_equal(part[16:34, 21:49], whole[16:34, 21:49])


def test_edge_samples_must_be_a_square(device):
    """Anything else names the value and what would be right."""
    scene = scene_of(ball(device), WHITE["lambert"], device=device)
    with pytest.raises(ValueError, match="edge_samples is 3; expected a square"):
        render(scene, dataclasses.replace(EVERYTHING, edge_samples=3), device)


# --- Hard cases -------------------------------------------------------------------------------------------------------
