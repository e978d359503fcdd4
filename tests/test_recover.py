"""The equations by which clipped light is recovered: transfer from cells to surfaces, and what is observed."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import warp as wp

from tests.error_model import check_error
from tests.recover_rig import cells_of, empty_scene, points_of, probes_of, scene, seen, transfer_of  # noqa: F401
from tests.reference import recover as reference
from warp_ar.kernels import structs
from warp_ar.kernels.color import decode_table
from warp_ar.kernels.recovery import recover as kernels
from warp_ar.kernels.recovery.recover_cells import CELL_COLUMNS, CELL_ROWS
from warp_ar.scene.geometry import rotation_matrix
from warp_ar.scene.kinds import trace_config
from warp_ar.scene.ray_scene import HostScene
from warp_ar.sources.deep_frame import srgb8

QUADRATURE = 0.003
"""A sum over cells of 5.6 degrees against an integral of a cosine: their middles stand for them."""
FURNACE = 0.02
"""The same where the ball hides and mirrors: its outline crosses cells, and its edge is taken as straight."""


@pytest.mark.parametrize("normal", [(0, 0, 1), (1, 0, 0), (0, -0.6, 0.8), (0, 0, -1)])
def test_open_sky_gives_pi(device, normal):
    host = empty_scene()
    points = points_of(device, [(5.0, 5.0, 0.0)], [normal])
    straight, mirrored = transfer_of(device, points, cells_of(device)[1], probes_of(device), host.ray_scene)
    assert straight.sum() == pytest.approx(np.pi, rel=QUADRATURE)
    assert mirrored.sum() < 1e-4


@pytest.mark.parametrize("distance", [1.3, 1.7, 2.5, 5.0])
def test_white_furnace_beside_a_perfect_mirror(device, distance):
    """What a perfectly reflecting ball hides of a uniform environment it replaces: the irradiance stays pi."""
    host = empty_scene()
    center = np.array([0.0, 0.0, 0.035])
    points = points_of(device, [center + 0.035 * distance * np.array([0.6, 0.48, -0.64])], [(0, 0, 1)])
    probes = probes_of(device, center, 0.035, 1.0)
    straight, mirrored = transfer_of(device, points, cells_of(device)[1], probes, host.ray_scene)
    assert straight.sum() + mirrored.sum() == pytest.approx(np.pi, rel=FURNACE)
    assert mirrored.sum() > 0.002 * np.pi


def test_transfer_agrees_with_its_twin(device):
    """The twin measures how a mirrored beam widens by tracing rays: it knows no focal lengths."""
    center, radius = np.array([-0.12, 0.03, 0.035]), 0.035
    positions = np.array([(-0.05, 0.03, 0.0), (-0.12, -0.03, 0.0), (0.2, 0.1, 0.05)])
    normals = np.array([(0, 0, 1.0), (0, 0, 1.0), (-1.0, 0, 0)])
    host = empty_scene()
    points = points_of(device, positions, normals)
    straight, mirrored = transfer_of(device, points, cells_of(device)[1], probes_of(device), host.ray_scene)
    d, solid_angle = reference.cell_directions(CELL_ROWS, CELL_COLUMNS)
    for k in range(3):
        expected = reference.trace_transfer(positions[k], normals[k], d, solid_angle, center, radius, 0.85)
        for got, want in zip((straight[k], mirrored[k]), expected, strict=True):
            check_error("recover", got, want)


def test_proxies_send_the_share_to_where_the_ball_sees_them(device, scene):
    """Under a face that looks at the table, all irradiance comes from cells in which the ball sees the table."""
    host = HostScene(dataclasses.replace(scene, objects=()), device)
    proxies = trace_config(scene).proxies
    points = points_of(device, [(0.0, 0.1, 0.02)], [(0, 0, -1)])
    values, cells = cells_of(device)
    straight, _ = transfer_of(device, points, cells, probes_of(device), host.ray_scene, proxies)
    below = values["direction"].reshape(-1, 3)[:, 2] < 0
    assert straight[0].sum() == pytest.approx(np.pi, rel=QUADRATURE)
    assert straight[0][below].sum() == pytest.approx(straight[0].sum(), rel=0.01)
    # From 2 cm above it the table right below fills the view; the ball sees that place 13 cm away in +x, +y, low.
    main = values["direction"].reshape(-1, 3)[np.argmax(straight[0])]
    toward = np.array([0.12, 0.07, -0.035])
    assert main @ toward / np.linalg.norm(toward) > 0.9


def test_emitters_fall_off_and_are_shadowed(device):
    host = empty_scene()
    center = np.array([0.0, 0.0, 0.035])
    probes = probes_of(device, center, 0.035, 1e-6)
    emitter = np.array([0.3, 0.0, 0.335])
    shadow = center + (center - emitter) * (center[2] / (emitter[2] - center[2]))
    positions = [(0.3, 0.0, 0.0), (0.3, 0.4, 0.0), shadow]
    points = points_of(device, positions, [(0, 0, 1)] * 3)
    out = wp.zeros((3, 1), dtype=wp.float32, device=device)
    emitters = wp.array([[*emitter, 0.01]], dtype=wp.vec4, device=device)
    kernels.trace_emitters(points, seen(device, 3), emitters, probes, host.ray_scene, out, proxies=())
    got = out.numpy()[:, 0]
    assert got[0] == pytest.approx(1 / 0.335**2, rel=1e-4)
    assert got[1] == pytest.approx(0.335 / (0.335**2 + 0.4**2) ** 1.5, rel=1e-4)
    assert got[2] < 1e-4


def test_far_emitters_are_distant_light(device):
    """An emitter a kilometre away lights as its cell does, ball included."""
    host = empty_scene()
    probes = probes_of(device)
    values, cells = cells_of(device)
    m = 10 * CELL_COLUMNS + 20
    direction = values["direction"].reshape(-1, 3)[m].astype(float)
    angle = np.sqrt(values["solid_angle"].ravel()[m] / np.pi)
    positions = [(0.0, 0.0, 0.0), (-0.1, 0.1, 0.0), (-0.17, -0.02, 0.0)]
    points = points_of(device, positions, [(0, 0, 1)] * 3)
    emitters = wp.array([[*(1e3 * direction), 1e3 * np.sin(angle)]], dtype=wp.vec4, device=device)
    out = wp.zeros((3, 1), dtype=wp.float32, device=device)
    kernels.trace_emitters(points, seen(device, 3), emitters, probes, host.ray_scene, out, proxies=())
    straight, mirrored = transfer_of(device, points, cells, probes, host.ray_scene)
    want = (straight + mirrored)[:, m] / values["solid_angle"].ravel()[m]
    assert out.numpy()[:, 0] * 1e6 == pytest.approx(want, rel=1e-3)


def look_down(device, scene, image):
    params = np.zeros(1, np.dtype(structs.FrameParams.numpy_dtype()))
    params["camera_position"] = (0.0, 0.0, 0.6)
    params["world_from_camera"] = rotation_matrix((180.0, 0.0, 0.0))
    camera = scene.camera
    params["focal"], params["principal"] = (camera.fx, camera.fy), (camera.cx, camera.cy)
    return (
        wp.array(image, dtype=wp.vec3ub, device=device),
        wp.array(decode_table("linear"), dtype=wp.vec3, device=device),
        wp.array(params, dtype=structs.FrameParams, device=device),
    )


def test_observation_reads_surfaces_and_nothing_else(device, scene):
    image = np.full((240, 320, 3), 51, np.uint8)
    image[:, 160:, 0] = 255
    host = HostScene(dataclasses.replace(scene, objects=()), device)
    proxies = trace_config(scene).proxies
    # Left and right on the table, under the ball, under the box, beyond the frame, and facing away.
    positions = [(-0.1, -0.1, 0), (0.1, -0.1, 0), (-0.12, 0.03, 0), (0.05, 0.2, 0), (2.0, 0, 0), (-0.1, -0.1, 0)]
    points = points_of(device, positions, [(0, 0, 1)] * 5 + [(0, 0, -1)])
    out = wp.zeros(6, dtype=kernels.Observation, device=device)
    frame, table, params = look_down(device, scene, image)
    kernels.observe_surfaces(frame, table, params, probes_of(device), host.ray_scene, points, out, proxies=proxies)
    got = out.numpy()
    assert got["visible"] == pytest.approx([1, 1, 0, 0, 0, 0])
    assert got["radiance"][0] == pytest.approx(np.full(3, 0.2), abs=1e-6)
    assert got["clipped"][:2] == pytest.approx(np.array([[0, 0, 0], [1, 0, 0]]))
    assert not got["radiance"][2:].any()


def test_observation_of_a_linear_frame_reads_light_as_it_is(device, scene):
    """Darker than 1/255 and brighter than white, against the same in 8 bits."""
    light = np.full((240, 320, 3), 0.0021, np.float32)
    light[:, 160:] = 3.5
    light[:, 160:, 0] = 6.0
    host = HostScene(dataclasses.replace(scene, objects=()), device)
    points = points_of(device, [(-0.1, -0.1, 0), (0.1, -0.1, 0)], [(0, 0, 1)] * 2)
    out = wp.zeros(2, dtype=kernels.Observation, device=device)
    codes, table, params = look_down(device, scene, srgb8(light))
    seen = params, probes_of(device), host.ray_scene, points, out
    clip = wp.array(np.float32([[5.0] * 3, [3.0] * 3]), dtype=wp.vec3, device=device)
    frame = wp.array(light, dtype=wp.vec3, device=device)
    kernels.observe_surfaces(frame, clip, *seen, proxies=trace_config(scene).proxies)
    np.testing.assert_allclose(out.numpy()["radiance"], [[0.0021] * 3, [6.0, 3.5, 3.5]], rtol=1e-6)
    # Red is at clipping by itself, the others beside it.
    np.testing.assert_array_equal(out.numpy()["clipped"], [[0.0] * 3, [1.0] * 3])
    kernels.observe_surfaces(codes, table, *seen, proxies=trace_config(scene).proxies)
    assert abs(out.numpy()["radiance"][0, 0] / 0.0021 - 1.0) > 0.005
    assert out.numpy()["radiance"][1].max() == 1.0


def test_points_are_traced_once_when_they_come_into_view(device):
    """What a row holds stays as it is: the environment does not move."""
    points = points_of(device, [(5.0, 5.0, 0.0), (4.0, 5.0, 0.0)], [(0, 0, 1)] * 2)
    views, rows = np.zeros(2, np.dtype(kernels.Observation.numpy_dtype())), []
    traced = wp.zeros(2, dtype=wp.int32, device=device)
    out = [wp.full((2, CELL_ROWS * CELL_COLUMNS), -1.0, dtype=wp.float32, device=device) for _ in range(2)]
    surroundings = cells_of(device)[1], probes_of(device), empty_scene().ray_scene
    for visible in ((1, 0), (1, 1)):
        views["visible"] = visible
        seen_now = wp.array(views, dtype=kernels.Observation, device=device)
        kernels.trace_transfer(points, seen_now, *surroundings, traced, *out, proxies=())
        rows.append(out[0].numpy().sum(axis=1))
        out[0][:1].fill_(-1.0)
    assert rows[0] == pytest.approx([np.pi, -CELL_ROWS * CELL_COLUMNS], rel=QUADRATURE)
    assert rows[1] == pytest.approx([-CELL_ROWS * CELL_COLUMNS, np.pi], rel=QUADRATURE)
