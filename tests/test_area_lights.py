"""Objects that emit as lights: closed forms, the float64 twin, shadows, and the ends of their ranges."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import warp as wp

from tests.kernel_rig import SMALL_CAMERA, look_at
from tests.twins import area_lights as twin
from warp_ar.engine.pipeline import Pipeline
from warp_ar.kernels.rays.area_lights import AreaSample, area_numbers, make_area_count, make_area_sample
from warp_ar.kernels.structs import RayScene
from warp_ar.scene import (
    AreaLight,
    Camera,
    EmissiveMaterial,
    LambertMaterial,
    Object,
    Proxy,
    Scene,
    dumps_scene,
    loads_scene,
)
from warp_ar.scene.ray_scene import HostScene
from warp_ar.stages.quality import PRESETS

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
DOWN = (180.0, 0.0, 0.0)
N = 256
# Of 256 places in a pixel, and the mean over the 16 of a tile.
ONE_PIXEL, TILE = 0.02, 2e-3
# Directions within triangles lose 1e-7 / angle^2, for the smallest angle 1e-3, and more where one is seen edge on.
TWIN_MOST, TWIN_WORST = 1e-4, 1e-2

area_count, area_sample = make_area_count(N), make_area_sample(N)
as_points = make_area_sample(1)


@wp.kernel(enable_backward=False, module="unique")
def gather_kernel(
    # In:
    scene: RayScene,
    points: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    point_like: wp.bool,
    # Out:
    irradiance_out: wp.array2d[wp.vec3],
):
    i, j = wp.tid()
    total = wp.vec3()
    if point_like:
        for k in range(scene.area_lights.shape[0]):
            sample = as_points(scene, points[i], normals[i], k, 1, 0.0)
            total += wp.max(wp.dot(sample.wi, normals[i]), 0.0) * sample.irradiance_normal
    else:
        count = area_count(scene)
        for k in range(count):
            sample = area_sample(scene, points[i], normals[i], k, count, wp.float32(j) / 16.0)
            total += wp.max(wp.dot(sample.wi, normals[i]), 0.0) * sample.irradiance_normal
    irradiance_out[i, j] = total


@wp.kernel(enable_backward=False, module="unique")
def draw_kernel(
    # In:
    scene: RayScene,
    points: wp.array[wp.vec3],
    # Out:
    samples_out: wp.array[AreaSample],
    numbers_out: wp.array[wp.vec3],
):
    i = wp.tid()
    samples_out[i] = area_sample(scene, points[i], wp.vec3(0.0, 0.0, 1.0), i % N, N, wp.float32((i / N) % 16) / 16.0)
    numbers_out[i] = area_numbers(i % N, N, wp.float32((i / N) % 16) / 16.0)


def host(*items: AreaLight | Object, device: str = "cpu") -> HostScene:
    objects = tuple(item.as_object() if isinstance(item, AreaLight) else item for item in items)
    return HostScene(Scene(CAMERA, objects=objects), wp.get_device(device))


def gather(scene: HostScene, points, normals=(0.0, 0.0, 1.0), *, point_like: bool = False):
    """Irradiance in 16 pixels of a tile, (n, 16, 3)."""
    points = np.atleast_2d(np.asarray(points, np.float32))
    device = scene.ray_scene.materials.device
    normals = np.broadcast_to(np.asarray(normals, np.float32), points.shape).copy()
    out = wp.zeros((len(points), 16), dtype=wp.vec3, device=device)
    inputs = [wp.array(points, dtype=wp.vec3, device=device), wp.array(normals, dtype=wp.vec3, device=device)]
    wp.launch(gather_kernel, out.shape, [scene.ray_scene, *inputs, point_like], [out], device=device)
    return out.numpy()


def check(found, expected, *, one: float = ONE_PIXEL, tile: float = TILE):
    assert found[..., 0].mean(axis=1) == pytest.approx(expected, rel=tile)
    assert np.abs(found[..., 0] / np.asarray(expected)[:, None] - 1.0).max() < one


POINTS = np.array([[0.0, 0.0, 0.0], [0.12, -0.05, 0.0], [0.3, 0.2, 0.05], [0.02, 0.01, 0.28]])


def test_a_rect_sends_what_lamberts_formula_says(device):
    scene = host(AreaLight("rect", 2.0, color=(1.0, 0.5, 0.0), at=(0.0, 0.0, 0.3), rotate=DOWN, size=(0.2, 0.1)),
                 device=device)  # fmt: skip
    x, y = 0.1, 0.05
    corners = np.array([[-x, -y, 0.3], [x, -y, 0.3], [x, y, 0.3], [-x, y, 0.3]])
    expected = [2.0 * twin.polygon_irradiance(corners, point, np.array([0.0, 0.0, 1.0])) for point in POINTS]
    found = gather(scene, POINTS)
    check(found, expected)
    np.testing.assert_allclose(found[..., 1], 0.5 * found[..., 0], rtol=1e-5)
    assert not found[..., 2].any()


def test_a_disk_sends_what_its_form_factor_says(device):
    scene = host(AreaLight("disk", 1.0, at=(0.0, 0.0, 0.3), rotate=DOWN, radius=0.1), device=device)
    expected = [twin.disk_irradiance(0.1, 0.3 - z, np.hypot(x, y)) for x, y, z in POINTS]
    # The disk is a polygon, of which 112 triangles cover 99.95 %.
    check(gather(scene, POINTS), expected, tile=3e-3)


def test_a_sphere_sends_as_a_point_and_the_same_through_any_surface_around_it(device):
    scene = host(AreaLight("sphere", 3.0, at=(0.0, 0.0, 0.3), radius=0.05), device=device)
    up = np.array([0.0, 0.0, 1.0])
    points = np.vstack([POINTS[:3], [[0.04, 0.0, 0.2]]])
    expected = [3.0 * twin.sphere_irradiance(0.05, np.array([0.0, 0.0, 0.3]), point, up) for point in points]
    check(gather(scene, points), expected)
    # Energy: what leaves the surface, pi L 4 pi r^2, arrives on any sphere around it.
    directions = twin.unit(np.random.default_rng(1).standard_normal((64, 3)))
    around = np.array([0.0, 0.0, 0.3]) + 0.4 * directions
    arriving = gather(scene, around, -directions)[..., 0].mean() * 4.0 * np.pi * 0.4**2
    assert arriving == pytest.approx(3.0 * np.pi * 4.0 * np.pi * 0.05**2, rel=TILE)


def test_a_tube_sends_out_what_leaves_its_surface(device):
    scene = host(AreaLight("tube", 1.0, radius=0.02, length=0.2), device=device)
    directions = twin.unit(np.random.default_rng(2).standard_normal((512, 3)))
    arriving = gather(scene, 1.5 * directions, -directions)[..., 0].mean() * 4.0 * np.pi * 1.5**2
    # 512 directions, of which the tube shows none along its axis: a standard error of 1.5 %.
    assert arriving == pytest.approx(np.pi * 2.0 * np.pi * 0.02 * 0.2, rel=0.05)


def test_inside_of_a_box_that_shines_in_all_is_as_bright(device):
    """A furnace: six rects around a point, each facing it, give pi L through any surface."""
    sides = [
        AreaLight("rect", 1.0, at=tuple(-0.5 * axis), rotate=turn, size=(1.0, 1.0))
        for axis, turn in zip(
            np.concatenate([np.eye(3), -np.eye(3)]),
            [(0.0, 90.0, 0.0), (-90.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, -90.0, 0.0), (90.0, 0.0, 0.0), DOWN],
            strict=True,
        )
    ]
    normals = twin.unit(np.random.default_rng(3).standard_normal((5, 3)))
    found = gather(host(*sides, device=device), 0.3 * normals, normals)
    # Places go to triangles by their area, 21 or 22 to each, wherever the point is: 3.3 % of a pixel's 256.
    check(found, np.full(5, np.pi), one=4 * 0.033, tile=0.01)


def test_places_on_triangles_are_those_of_the_twin(device):
    light = AreaLight("rect", 1.0, at=(0.05, 0.02, 0.3), rotate=(150.0, 20.0, 10.0), size=(0.2, 0.1))
    scene = host(light, device=device)
    rng = np.random.default_rng(4)
    count = 16 * N
    points = rng.uniform((-0.4, -0.4, 0.0), (0.4, 0.4, 0.2), (count, 3)).astype(np.float32)
    points[::4] *= 20.0  # seen under small angles
    samples = wp.zeros(count, dtype=AreaSample, device=device)
    numbers = wp.zeros(count, dtype=wp.vec3, device=device)
    inputs = [scene.ray_scene, wp.array(points, dtype=wp.vec3, device=device)]
    wp.launch(draw_kernel, count, inputs, [samples, numbers], device=device)
    found, numbers = samples.numpy(), numbers.numpy().astype(np.float64)
    from warp_ar.scene.geometry import rotation_matrix

    local = np.array([[-0.1, -0.05, 0.0], [0.1, -0.05, 0.0], [0.1, 0.05, 0.0], [-0.1, 0.05, 0.0]])
    corners = local @ rotation_matrix(light.rotate).T + np.array(light.at)
    second = numbers[:, :1] >= 0.5
    parts = [twin.draw_on_triangle(corners[list(t)], points.astype(np.float64), numbers[:, 1:2], numbers[:, 2:])
             for t in ((0, 1, 2), (0, 2, 3))]  # fmt: skip
    wi, distance, measure = (np.where(second, b, a) for a, b in zip(*parts, strict=True))
    lit = found["irradiance_normal"][:, 0] > 0.0
    assert lit.mean() > 0.5
    aside = np.abs(found["wi"] - wi)[lit].max(axis=1)
    beyond = np.abs(found["distance"] / (twin.NEARLY * distance[:, 0]) - 1.0)[lit]
    for error in (aside, beyond):
        assert np.quantile(error, 0.98) < TWIN_MOST
        assert error.max() < TWIN_WORST
    # Which of the two ways is taken differs where the angle is the limit to the last place.
    same = np.abs(found["irradiance_normal"][lit, 0] * N / (measure[lit, 0] / 0.5) - 1.0) < TWIN_MOST
    assert same.mean() > 0.999


@pytest.mark.parametrize("kind", ["rect", "disk", "sphere", "tube"])
def test_whatever_the_place_all_numbers_are_finite_and_bounded(device, kind):
    """In, on, behind and beside the light, at its corners, and for one of almost no size: never more than pi L."""
    sizes = {"rect": {"size": (0.2, 0.1)}, "tube": {"radius": 0.05, "length": 0.2}}
    light = AreaLight(kind, 1.0, rotate=(0.0, 0.0, 0.0), **sizes.get(kind, {"radius": 0.1}))
    tiny = {key: tuple(1e-6 for _ in value) if isinstance(value, tuple) else 1e-6
            for key, value in sizes.get(kind, {"radius": 0.1}).items()}  # fmt: skip
    points = [
        (0, 0, 0), (0, 0, 1e-9), (0.1, 0.05, 0), (0.1, 0, 0), (0.05, 0, 0.1), (0.3, 0, 0), (0, 0, -0.2),
        (0, 0, 1e-4), (0.0999, 0.0499, 1e-5), (1e4, 0, 1), (0, 0, 1e-30),
    ]  # fmt: skip
    for item in (light, dataclasses.replace(light, **tiny)):
        for normal in ((0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0)):
            for point_like in (False, True):
                found = gather(host(item, device=device), points, normal, point_like=point_like)
                assert np.isfinite(found).all()
                assert found.min() >= 0.0
                # A sample's place is picked among all triangles: of 256, half a per cent more than is there.
                if not point_like:
                    assert found.max() <= np.pi * 1.1


def test_only_the_front_shines_unless_two_sided(device):
    light = AreaLight("rect", 1.0, size=(0.2, 0.1))
    above, below = ((0.0, 0.0, 0.3), (0.0, 0.0, -1.0)), ((0.0, 0.0, -0.3), (0.0, 0.0, 1.0))
    front = gather(host(light, device=device), *above)
    assert front.min() > 0.0
    assert not gather(host(light, device=device), *below).any()
    both = host(dataclasses.replace(light, two_sided=True), device=device)
    np.testing.assert_allclose(gather(both, *below).mean(), front.mean(), rtol=TILE)


def test_a_picture_is_looked_for_where_it_is_bright(device, tmp_path):
    """A rect that is dark but for its bright corner sends what the corner alone would, with little noise."""
    import cv2

    picture = np.zeros((64, 64, 3), np.uint8)
    picture[:8, :8] = (0, 0, 255)  # top left, red
    cv2.imwrite(str(tmp_path / "corner.png"), picture)
    shown = AreaLight("rect", 1.0, at=(0.0, 0.0, 0.3), rotate=DOWN, size=(0.8, 0.8), image=tmp_path / "corner.png")
    found = gather(host(shown, device=device), POINTS[:3])
    # Turned over about x, the picture's top left is at -x and -y. Its cells' borders blur by a texel of 16.
    corner = AreaLight("rect", 1.0, at=(-0.35, -0.35, 0.3), rotate=DOWN, size=(0.1, 0.1))
    expected = gather(host(corner, device=device), POINTS[:3])[..., 0].mean(axis=1)
    np.testing.assert_allclose(found[..., 0].mean(axis=1), expected, rtol=0.05)
    assert found[..., 0].std(axis=1).max() / expected.min() < 0.1
    assert not found[..., 1:].any()


def test_linear_pictures_keep_their_range(device, tmp_path):
    import cv2

    picture = np.full((8, 16, 3), 0.5, np.float32)
    picture[2, 3] = 40.0
    cv2.imwrite(str(tmp_path / "sky.hdr"), picture)
    light = AreaLight("rect", 1.0, at=(0.0, 0.0, 5.0), rotate=DOWN, size=(1.0, 0.5), image=tmp_path / "sky.hdr")
    found = gather(host(light, device=device), [[0.0, 0.0, 0.0]])[..., 0].mean()
    # 0.5 is 1/80 of the largest: half a step of its code is 2 %.
    assert found == pytest.approx(0.5 / 25.0 * picture.mean(), rel=0.05)


TEXT = f"""schema = 1
{SMALL_CAMERA}[marker]
size = 0.08
[[light]]
kind = "{{kind}}"
at = [0.0, 0.0, 0.3]
intensity = 2.0
"""


@pytest.mark.parametrize(
    ("kind", "keys"),
    [("rect", "size = [0.2, 0.1]"), ("disk", "radius = 0.1\ntwo_sided = true"), ("sphere", "radius = 0.1"),
     ("tube", "radius = 0.01\nlength = 0.3")],
)  # fmt: skip
def test_scene_files_have_them_as_lights_and_as_objects(kind, keys):
    scene = loads_scene(TEXT.format(kind=kind) + keys)
    assert not scene.lights
    (item,) = scene.objects
    assert item.shape == kind
    assert item.material == EmissiveMaterial(intensity=2.0, two_sided="two_sided" in keys)
    assert loads_scene(dumps_scene(scene)) == scene


# Of the mean. Noise of 16 samples per cell of two pixels, at most; all but one pixel in a hundred, where the shadow is
# sharper than a cell.
CELL_MEAN, CELL_WORST = 0.01, 0.15


@pytest.mark.slow
@pytest.mark.parametrize("method", ["coarse", "fine"])
def test_cells_know_the_light_that_each_pixel_would_ask_for(device, method):
    """A receiver under a rect, in a box's shadow too."""
    box = Object("box", size=(0.05, 0.05, 0.1), at=(-0.03, 0.0, 0.05), material=LambertMaterial((0.0, 0.0, 0.0)))
    light = AreaLight("rect", 2.0, at=(0.1, 0.0, 0.3), rotate=(160.0, 0.0, 30.0), size=(0.2, 0.1))
    camera = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
    scene = Scene(camera, proxies=(Proxy("plane", size=(3.0, 3.0)),), objects=(box, light.as_object()))
    added = {}
    for asked in ("brute_force", method):
        quality = PRESETS["low"].with_methods(area_light=asked)
        with Pipeline(scene, device=device, quality=quality) as pipeline:
            pipeline(np.full((120, 160, 3), 60, np.uint8), time_seconds=0.0, pose=look_at((-0.2, -0.5, 0.5)))
            added[asked] = pipeline.arrays["added_light"].numpy()
    off = np.abs(added[method] - added["brute_force"]) / added["brute_force"].mean()
    assert 0.0 < off.mean() < CELL_MEAN, off.mean()
    assert np.quantile(off, 0.99) < CELL_WORST, np.quantile(off, 0.99)
