"""Cells of the desk: the share of the environment that reaches them, and how pixels look cells up."""

import numpy as np
import pytest
import trimesh
import warp as wp

from tests.environment_shadow_rig import ONE_BALL, draw, lamp_at, list_texels, sky, with_sun
from tests.error_model import check_error
from tests.kernel_rig import shape, tables
from tests.receiver_cells_rig import (
    FOCAL,
    GREY,
    OUTLINE,
    SIZE_OF_FRAME,
    SUM_ERROR,
    View,
    ball,
    box,
    cells_of,
    middles,
    pixel_rays,
)
from tests.relight_rig import CAMERA, DESK, FLOAT_ERROR, LOOK_DOWN, POINTS, point
from tests.twins import receiver_cells as reference
from tests.twins import relight as reference_relight
from tests.twins.environment_shadow import sphere_form_factor
from warp_ar.kernels import cells as frame_cells
from warp_ar.kernels.environment import environment_samples
from warp_ar.kernels.structs import BOX, DIRECTIONAL, LAMBERT, MIRROR, PHONG, PLANE, filled
from warp_ar.scene import Camera, Proxy, Scene
from warp_ar.scene.ray_scene import HostScene

pytestmark = pytest.mark.slow

# --- Share: closed forms ----------------------------------------------------------------------------------------------


def test_planes_leave_all_of_the_light_to_the_bit(device):
    wall = {**shape(PLANE, (0, 0.2, 0.2), (0.3, 0.3, 0)), "rotation": np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0.0]])}
    samples = draw(with_sun(6, 20, 500.0))[2]
    share, surface = View((DESK, wall)).share(samples)
    assert (share[surface >= 0] == 1.0).all()
    assert set(np.unique(surface)) == {-1, 0, 8} or set(np.unique(surface)) == {0, 8}
    below = View((DESK, box((-1, -1, -3), (1, 1, -2))), [ball((0, 0, -2), 0.05)]).share(samples)[0]
    assert (below == 1.0).all()


@pytest.mark.parametrize("height", [0.06, 0.2], ids=["touching", "above"])
def test_a_ball_takes_its_form_factor(device, height):
    """White environment; the ball reflects 0.2 of what it faces, which is white."""
    center, radius = (0.05, -0.02, height), 0.06
    share, surface = View(probes=[ball(center, radius, 0.2)]).share(list_texels(sky(1.0, (64, 128)))[2])
    expected = 1 - sphere_form_factor(POINTS, center, radius) * (1 - 0.2)
    seen = surface >= 0
    assert 0.9 < seen.mean() < 1.0, "the ball hides some of the desk"
    np.testing.assert_allclose(share[seen][:, 0], expected[middles(4)][seen], atol=OUTLINE)
    assert share[seen].min() < 0.95


@pytest.mark.parametrize("code", [20, 128, 230])
def test_a_box_sends_what_the_camera_sees_of_it(device, code):
    """A wall of height h at distance d hides (1 - d / sqrt(d^2 + h^2)) / 2 of an even sky; the frame has its light."""
    h, frame = 0.1, np.empty((*SIZE_OF_FRAME, 3), np.uint8)
    frame[:] = code, code // 2, 0
    shapes, samples = (DESK, box((0.2, -5, 0), (0.4, 5, h))), list_texels(sky(1.0, (64, 128)))[2]
    view = View(shapes, frame=frame, camera=(0, 0, 1.2), sees_boxes=True)
    share, surface = view.share(samples)
    points = reference_relight.plane_points(np.array([0, 0, 1.2]), pixel_rays(SIZE_OF_FRAME), LOOK_DOWN)
    d = 0.2 - points[middles(4)][..., 0]
    # What lies far along the wall is out of the frame, and is grey paper: cells in the middle row face what is in it.
    middle = np.abs(points[middles(4)][..., 1]) < 0.15
    seen = (surface == 0) & (d > 0.01) & (d < 0.25) & middle
    assert seen.sum() > 8
    sent = tables()[0].numpy()[frame[0, 0]].diagonal()
    expected = 1 - (1 - sent) * 0.5 * (1 - d / np.hypot(d, h))[..., None]
    far = 0.5 * np.abs(sent - GREY).max() * 0.1
    np.testing.assert_allclose(share[seen], expected[seen], atol=OUTLINE + far)
    unseen = View(shapes, frame=frame, camera=(0, 0, 1.2)).share(samples)[0]
    np.testing.assert_allclose(
        unseen[..., 0][seen], (1 - (1 - GREY) * 0.5 * (1 - d / np.hypot(d, h)))[seen], atol=OUTLINE
    )


def test_a_face_that_the_camera_does_not_see_is_grey_paper(device):
    """Turned away, behind another box, behind a ball: the frame, bright or dark, says nothing of it."""
    hidden, screen = box((0.1, -0.1, 0), (0.2, 0.1, 0.1)), box((-0.05, -0.3, 0.2), (0.6, 0.3, 0.3))
    lid = ball((0.06, 0.0, 0.3), 0.15)
    samples = list_texels(sky(1.0, (32, 64)))[2]
    points = POINTS[middles(4)]
    for proxies, balls, first in (
        ((DESK, hidden), [], 0.21),
        ((DESK, hidden, screen), [], -1),
        ((DESK, hidden), [lid], -1),
    ):
        dark, bright = (
            View(proxies, balls, frame=np.full((*SIZE_OF_FRAME, 3), code, np.uint8), sees_boxes=True).share(samples)
            for code in (0, 255)
        )
        np.testing.assert_array_equal(dark[1], bright[1])
        told = (dark[1] == 0) & (points[..., 0] > first)
        assert told.sum() > 10
        assert dark[0][told].min() < 0.99
        np.testing.assert_array_equal(dark[0][told], bright[0][told])


def test_the_end_of_a_long_box_is_not_passed_by(device):
    """Beside the end of a bar, inside the ball around it: rays that leave its middle behind still meet it."""
    bar = box((-0.5, 0.02, 0.0), (0.1, 0.06, 0.1))
    samples = list_texels(sky(1.0, (32, 64)))[2]
    share, surface = View((DESK, bar)).share(samples)
    expected = brute_force(samples, View().size, boxes=[((-0.5, 0.02, 0.0), (0.1, 0.06, 0.1))])
    at = surface == 0
    np.testing.assert_allclose(share[at], expected[at], atol=2e-3)


def test_only_where_light_may_fall(device):
    """Not where lights shine away, and not outside the rectangle; then where bounced light is."""
    samples = draw(sky())[2]
    away = {"kind": DIRECTIONAL, "direction": (0.0, 0.0, 1.0), "intensity": (1.0,) * 3}
    assert (View(lights=[away]).share(samples)[1] == -1).all()
    view = View(lights=[away], ambient_visibility=True)
    out = wp.zeros(view.cells(4), wp.vec3), wp.full(view.cells(4), -1, dtype=wp.int32)
    bounced = np.zeros((*view.cells(4), 3))
    bounced[5, 6] = 0.1
    _, surface = view.share(samples, out=out, bounced=True, cells=cells_of(view, 4, bounced=bounced))
    assert np.argwhere(surface >= 0).tolist() == [[5, 6]]
    rect = 10, 20, 30, 40
    i, j = (4 * grid + 2 for grid in np.indices(view.cells(4)))  # pixels at which cells are estimated
    near = (i >= 10 - 8) & (i < 20 + 8) & (j >= 30 - 8) & (j < 40 + 8)
    np.testing.assert_array_equal(View(rect=rect).share(samples)[1] >= 0, near)


# --- Share: twins -----------------------------------------------------------------------------------------------------


def brute_force(samples, size, boxes=(), balls=(), facing=1.0, stride=4):
    """Shares of a plane's cells, and no ball in front."""
    found = samples.numpy()
    points = reference_relight.plane_points(CAMERA, pixel_rays(size), LOOK_DOWN)[middles(stride, size)]
    out = np.ones((*points.shape[:2], 3))
    for index in np.ndindex(points.shape[:2]):
        directions = found["direction"].astype(float)
        measure, distances = found["measure"].astype(float), np.full(len(found), np.inf)
        near = found["distance"] < 1e29
        way = found["origin"] + found["distance"][:, None].astype(float) * directions - points[index]
        distance = np.linalg.norm(way, axis=-1)
        directions = np.where(near[:, None], way / distance[:, None], directions)
        measure = np.where(near, measure * (found["distance"].astype(float) / distance) ** 2, measure)
        distances = np.where(near, distance, np.inf)
        out[index] = reference.share_environment(
            points[index],
            np.array([0, 0, 1.0]),
            directions,
            measure,
            found["radiance"],
            distances,
            boxes,
            balls,
            lambda normals: np.broadcast_to(facing, normals.shape),
        )
    return out


@pytest.mark.parametrize("threads", [1, 8])
def test_share_matches_twin(device, threads):
    """A sun, a lamp at a place, a box and a ball; the twin asks every sample at every cell."""
    environment = with_sun(9, 40, 300.0, np.float32(np.random.default_rng(1).uniform(0.2, 1, (32, 64, 3))))
    samples = draw(environment, 256)[2]
    environment_samples.place_emitters(lamp_at((0.2, 0.1, 0.4)), ONE_BALL, samples)
    corners, (center, radius) = ((0.1, -0.1, 0), (0.22, 0.14, 0.08)), ((-0.1, 0.03, 0.05), 0.04)
    facing = np.array([0.6, 0.5, 0.4])
    share, surface = View((DESK, box(*corners)), [ball(center, radius)], surroundings=facing).share(
        samples, threads=threads
    )
    expected = brute_force(samples, SIZE_OF_FRAME, [corners], [(center, radius, 0.85)], facing)
    on_desk = surface == 0
    # A sample at an outline falls to either side in float32: a few cells of the desk differ by one of them.
    off = np.abs(share - expected)[on_desk].max(-1)
    assert (off > SUM_ERROR).mean() < 0.02
    assert off.max() < 0.05
    check_error("relight", share[on_desk][off <= SUM_ERROR], expected[on_desk][off <= SUM_ERROR])
    assert expected[on_desk].min() < 0.7


def test_a_mesh_hides_as_the_box_that_it_is(device, tmp_path):
    trimesh.creation.box(bounds=[(0.1, -0.1, 0.0), (0.2, 0.1, 0.08)]).export(tmp_path / "box.ply")
    camera = Camera(64, 48, FOCAL, FOCAL, 31.5, 23.5)
    items = Proxy("plane", size=(10.0, 10.0)), Proxy("mesh", file=tmp_path / "box.ply")
    host = HostScene(Scene(camera, proxies=items), wp.get_device(device))
    samples = draw(sky())[2]
    share, surface = View(scene=host.ray_scene).share(samples)
    expected, boxed = View((DESK, box((0.1, -0.1, 0), (0.2, 0.1, 0.08)))).share(samples)
    both = (surface == 0) & (boxed == 0)
    assert both.mean() > 0.8
    np.testing.assert_allclose(share[both], expected[both], atol=2e-3)
    assert expected[both].min() < 0.9
    assert set(np.unique(surface)) == {0, 15}


# --- Looking cells up -------------------------------------------------------------------------------------------------


@wp.kernel(enable_backward=False)
def look_up_kernel(cells: frame_cells.SurfaceCells, key: wp.int32, found_out: wp.array2d[wp.vec4]):
    i, j = wp.tid()
    size = wp.vec2i(found_out.shape[0], found_out.shape[1])
    found_out[i, j] = frame_cells.look_up_cells(cells, key, size, i, j)


def look_up(values, surface, stride, key, size):
    out = wp.zeros(size, wp.vec4)
    arrays = {"values": wp.array(np.asarray(values, np.float32), dtype=wp.vec3), "surface": wp.array(surface, wp.int32)}
    cells = filled(frame_cells.SurfaceCells(), **arrays, stride=stride)
    wp.launch(look_up_kernel, size, [cells, key], [out])
    return out.numpy()


FRAMES = [(48, 64, 4), (47, 61, 4), (45, 66, 8), (30, 40, 3), (9, 7, 1), (1, 1, 4), (2, 3, 16), (1, 17, 5)]


@pytest.mark.parametrize("frame", FRAMES)
def test_a_ramp_is_where_it_belongs(device, frame):
    """Between the middles of the outermost cells to a rounding, constant beyond."""
    *size, stride = frame
    i, j = middles(stride, size)
    values = np.stack(np.broadcast_arrays(i, j, 2.0 * i - j), -1).astype(float)
    found = look_up(values, np.zeros(values.shape[:2], np.int32), stride, 0, size)
    rows, columns = np.clip(np.arange(size[0]), i.min(), i.max()), np.clip(np.arange(size[1]), j.min(), j.max())
    expected = np.stack(np.broadcast_arrays(rows[:, None], columns[None], 2.0 * rows[:, None] - columns), -1)
    np.testing.assert_allclose(found[..., :3], expected, atol=1e-4)
    assert (found[..., 3] == 1).all()


def test_surfaces_do_not_mix(device):
    """Two ramps of other heights, one on each surface, and holes: each pixel has a mean of its own."""
    size, stride = (47, 61), 4
    i, j = np.indices((12, 16))
    surface = np.where(j < 8, 0, 9).astype(np.int32)
    surface[4:6, 3] = -1
    values = np.where((surface == 0)[..., None], np.ones(3), 100 + np.stack([i, j, i], -1))
    values[surface == -1] = np.nan
    for key in (0, 9, 5):
        found = look_up(values, surface, stride, key, size)
        for row, col in np.ndindex(size):
            expected = reference.look_up_cells(values, surface, stride, key, size, row, col)
            if expected is None:
                assert (found[row, col] == 0).all()
            else:
                np.testing.assert_allclose(found[row, col], [*expected, 1], rtol=1e-5)


# --- Relighting with cells --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.2, 0.7, 1.0])
def test_reflectance_of_a_shaded_desk(device, share):
    """What the camera sees over what arrives: rho = pi L / (share E), and no more than 1."""
    view = View(ambient_visibility=True)
    got = view.light(cells_of(view, 4, share=share))
    radiance = np.asarray(tables()[0].numpy()[128], float)
    kd = reference_relight.reflectance(radiance, share * np.pi)
    _, n_dot_l, e = reference_relight.point_light(POINTS, np.array([0, 0, 0.5]), 0.3)
    np.testing.assert_allclose(got, kd / np.pi * n_dot_l * e, rtol=2 * FLOAT_ERROR)


MATERIALS = {
    "matt": ({"model": LAMBERT, "base_color": (0.8, 0.4, 0.0)}, (0.8, 0.4, 0.0)),
    "shiny": ({"model": PHONG, "base_color": (0.2, 0.2, 0.9), "specular": (0.3, 0.0, 0.4)}, (0.5, 0.2, 1.0)),
    "picture": ({"model": LAMBERT, "base_color": (1.0, 0.5, 0.0), "base_texture": 0}, (0.5, 0.25, 0.0)),
    "mirror": ({"model": MIRROR, "base_color": (1.0, 1.0, 1.0)}, (0.0, 0.0, 0.0)),
    "unlit": ({"model": LAMBERT, "base_color": (1.0, 1.0, 1.0), "unlit": 1}, (0.0, 0.0, 0.0)),
}


@pytest.mark.parametrize("name", MATERIALS)
def test_an_object_sends_the_light_that_falls_on_it(device, name):
    """The flat top of a box, 0.1 m below a lamp: its colour over pi times I cos / d^2 from each patch, in its place."""
    material, share = MATERIALS[name]
    item = {**shape(BOX, (0.0, 0.0, 0.05), (0.1, 0.1, 0.05)), "material": 0}
    lamp = point((0.03, -0.02, 0.4))
    material = {"base_texture": -1, "specular_texture": -1, **material}
    view = View(lights=[lamp], objects=[item], materials=[material])
    patches = view.send().numpy()
    plain = View(lights=[lamp]).send().numpy()
    at = reference_relight.plane_points(CAMERA - [0, 0, 0.1], pixel_rays(SIZE_OF_FRAME), LOOK_DOWN)[middles(4)]
    on_top = (np.abs(at[..., :2]) < 0.099).all(-1)
    away = np.array(lamp["position"]) - at - [0, 0, 0.1]
    squared = (away**2).sum(-1)
    radiance = 0.3 / squared * (away[..., 2] / np.sqrt(squared)) / np.pi
    if max(share) == 0:
        assert (patches["area"][on_top] == 0).all()
    else:
        np.testing.assert_allclose(patches["position"][on_top], at[on_top] + [0, 0, 0.1], atol=1e-6)
        sent = patches["flux"][on_top] / patches["area"][on_top][:, None]
        np.testing.assert_allclose(sent, radiance[on_top][:, None] * share, rtol=1e-4, atol=1e-7)
        # A pixel's area on the top, which is nearer: (0.5 / 60)^2, times 16 pixels.
        np.testing.assert_allclose(patches["area"][on_top], 16 * (0.5 / FOCAL) ** 2, rtol=1e-3)
    # Beside the box, and out of its shadow, the desk sends what it sends without.
    beside = (np.abs(at[..., :2]) > 0.22).any(-1)
    assert beside.any()
    np.testing.assert_array_equal(patches["flux"][beside], plain["flux"][beside])
