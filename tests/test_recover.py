"""Light that clipping lost: the two sides of the equations, their solution, and the stage."""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import itertools
import os
import subprocess
import sys
import time

import numpy as np
import pytest
import warp as wp
from scipy.optimize import nnls

from tests.error_model import check_error
from tests.reference import recover as reference
from warp_ar.engine.pipeline import Pipeline
from warp_ar.input.plate import srgb8
from warp_ar.kernels import recover as kernels
from warp_ar.kernels import structs
from warp_ar.kernels.color import decode_table
from warp_ar.kernels.recover_cells import CELL_COLUMNS, CELL_ROWS, Cell, add_recovered, cell_shape, condense_cells
from warp_ar.kernels.saturation_boundaries import weigh_boundaries
from warp_ar.light import fit, noise, recovery, regions
from warp_ar.light import solver as light_solver
from warp_ar.light import surfaces as light_surfaces
from warp_ar.light.config import CONFIG, Kind
from warp_ar.light.problem import mirroring_points
from warp_ar.scene import Pose, Proxy, load_scene, loads_scene
from warp_ar.scene.geometry import rotation_matrix
from warp_ar.scene.kinds import trace_config
from warp_ar.scene.ray_scene import HostScene
from warp_ar.session import Session
from warp_ar.stages.quality import PRESETS
from warp_ar.stages.recover import LATENCY, Recover

ROWS, COLUMNS = CELL_ROWS, CELL_COLUMNS
QUADRATURE = 0.003
"""A sum over cells of 5.6 degrees against an integral of a cosine: their middles stand for them."""
FURNACE = 0.02
"""The same where the ball hides and mirrors: its outline crosses cells, and its edge is taken as straight."""
SOLVED = 1e-8
"""Two exact methods on one quadratic problem."""

SCENE = """
schema = 1
name = "recover"
[camera]
width = 320
height = 240
fx = 320.0
fy = 320.0
cx = 159.5
cy = 119.5
transfer = "linear"
[marker]
dictionary = "DICT_4X4_50"
size = 0.08
[probe]
center = [-0.12, 0.03, 0.035]
radius = 0.035
reflectance = [0.85, 0.85, 0.85]
[[proxy]]
shape = "plane"
size = [1.6, 1.2]
[[proxy]]
shape = "box"
at = [0.05, 0.2, 0.05]
size = [0.2, 0.08, 0.1]
rotate = [0.0, 0.0, 15.0]
[[object]]
shape = "sphere"
radius = 0.03
at = [0.1, 0.0, 0.03]
"""


@pytest.fixture(scope="module")
def scene():
    return loads_scene(SCENE)


def probes_of(device, center=(-0.12, 0.03, 0.035), radius=0.035, reflectance=0.85):
    values = np.zeros(1, np.dtype(structs.Probe.numpy_dtype()))
    values["center"], values["radius"], values["reflectance"] = center, radius, reflectance
    return wp.array(values, dtype=structs.Probe, device=device)


def empty_scene():
    return HostScene(loads_scene(SCENE.split("[[proxy]]")[0] + "[[object]]" + SCENE.split("[[object]]")[1]), "cpu")


def points_of(device, positions, normals):
    values = np.zeros(len(positions), np.dtype(kernels.SurfacePoint.numpy_dtype()))
    values["position"], values["normal"], values["half"] = positions, normals, 0.002
    for value in values:
        other = np.eye(3)[np.argmin(np.abs(value["normal"]))]
        tangent = np.cross(value["normal"], other)
        value["tangent"] = tangent / np.linalg.norm(tangent)
    return wp.array(values, dtype=kernels.SurfacePoint, device=device)


def seen(device, count):
    values = np.zeros(count, np.dtype(kernels.Observation.numpy_dtype()))
    values["visible"] = 1.0
    return wp.array(values, dtype=kernels.Observation, device=device)


def cells_of(device, radiance=1.0, clipped=0.0):
    d, solid_angle = reference.cell_directions(ROWS, COLUMNS)
    values = np.zeros((ROWS, COLUMNS), np.dtype(Cell.numpy_dtype()))
    values["middle"] = values["direction"] = d.reshape(ROWS, COLUMNS, 3)
    values["solid_angle"] = solid_angle.reshape(ROWS, COLUMNS)
    values["radiance"], values["clipped"], values["missing"] = radiance, clipped, clipped
    return values, wp.array(values, dtype=Cell, device=device)


def transfer_of(device, points, cells, probes, scene, proxies=()):
    out = [wp.zeros((len(points), ROWS * COLUMNS), dtype=wp.float32, device=device) for _ in range(2)]
    traced = wp.zeros(len(points), dtype=wp.int32, device=device)
    kernels.trace_transfer(points, seen(device, len(points)), cells, probes, scene, traced, *out, proxies=proxies)
    return [array.numpy().astype(float) for array in out]


# ---- kernels ------------------------------------------------------------------------------------------------------


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
    d, solid_angle = reference.cell_directions(ROWS, COLUMNS)
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
    m = 10 * COLUMNS + 20
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


def ball_of(device, pixels):
    """Camera and ball of which it sees as many pixels to each side."""
    params = np.zeros(1, np.dtype(structs.FrameParams.numpy_dtype()))
    params["camera_position"], params["focal"] = (-0.12, -0.47, 0.035), 500.0
    probes = np.zeros(1, np.dtype(structs.Probe.numpy_dtype()))
    probes["center"], probes["radius"] = (-0.12, 0.03, 0.035), pixels * 0.5 / 500.0
    return (
        wp.array(params, dtype=structs.FrameParams, device=device),
        wp.array(probes, dtype=structs.Probe, device=device),
    )


def weighed_boundaries(device, clipped, pixels):
    out = wp.full(clipped.shape[:2], wp.vec3(np.nan), dtype=wp.vec3, device=device)
    source = wp.array(clipped.astype(np.float32), dtype=wp.vec3, device=device)
    weigh_boundaries(source, *ball_of(device, pixels), out)
    return out.numpy()


def test_boundaries_count_less_and_the_inside_in_full(device):
    height, pixels = 128, 20.0
    d = reference.cell_directions(height, 2 * height)[0].reshape(height, 2 * height, 3)
    everywhere = np.ones((height, 2 * height, 3))
    assert weighed_boundaries(device, everywhere, pixels) == pytest.approx(1.0, abs=1e-5)
    assert not weighed_boundaries(device, 0.0 * everywhere, pixels).any()
    # A hemisphere is as wide as can be: it keeps its rim.
    depth = np.arcsin(d @ np.array([0.6, 0.0, 0.8]))
    got = weighed_boundaries(device, (depth > 0.0)[..., None] * everywhere, pixels)[..., 0]
    assert got[depth > 0.0].min() > 0.8
    # An emitter of two pixels across: the integral of a Gaussian over a disc is 1 - exp(-(radius / deviation)^2 / 2) in
    # its middle, for either deviation.
    half_pixel = 1.0 / pixels
    away = np.arccos(np.clip(d @ np.array([0.6, 0.0, 0.8]), -1.0, 1.0)) / half_pixel
    got = weighed_boundaries(device, (away < 2.0)[..., None] * everywhere, pixels)[..., 0]
    near, wide = (1.0 - np.exp(-0.5 * (2.0 / deviation) ** 2) for deviation in (1.0, 6.0))
    assert got[away < 0.3].mean() == pytest.approx(near ** (2.0 * (1.0 - 2.0 * wide)), abs=0.05)
    assert got[np.abs(away - 1.8) < 0.2].mean() < 0.65 * got[away < 0.3].mean()
    assert not got[away > 2.0].any()


def test_boundaries_weigh_the_same_everywhere_on_the_sphere(device):
    height, pixels = 256, 20.0
    d, area = reference.cell_directions(height, 2 * height)
    shares = []
    for toward in (
        (0, 0, 1),
        (0, 0, -1),
        (1, 0, 0),
        (-1, 0.001, 0),
        (0.6, 0.5, 0.62),
        (0.3, 0, 0.954),
        (0, 0.15, -0.98),
    ):
        toward = np.array(toward) / np.linalg.norm(toward)
        disc = (d @ toward > np.cos(0.12)).astype(float)
        got = weighed_boundaries(device, disc.reshape(height, -1, 1) * np.ones(3), pixels).reshape(-1, 3)[:, 0]
        shares.append((area @ got) / (area @ disc))
    assert 0.2 < min(shares) < 0.8
    assert np.ptp(shares) < 0.03


def test_large_pictures_of_a_ball_have_no_boundaries(device):
    clipped = np.zeros((32, 64, 3))
    clipped[10:14, 20:24] = 1.0
    assert weighed_boundaries(device, clipped, 1e5) == pytest.approx(clipped, abs=1e-3)
    assert np.isfinite(weighed_boundaries(device, clipped, 1e-9)).all()


@pytest.mark.parametrize("height", [16, 32, 48, 128])
def test_cells_keep_energy_and_recovered_returns_it(device, height, scene):
    rng = np.random.default_rng(1)
    shape = (height, 2 * height)
    radiance, clipped = rng.uniform(0, 1, (*shape, 3)), (rng.uniform(0, 1, (*shape, 3)) > 0.7).astype(float)
    confidence = (rng.uniform(0, 1, shape) > 0.2).astype(float)
    to = {"dtype": wp.vec3, "device": device}
    arrays = wp.array(radiance, **to), wp.array(confidence, dtype=wp.float32, device=device), wp.array(clipped, **to)
    weighed = wp.zeros(shape, **to)
    weigh_boundaries(arrays[2], *ball_of(device, 40.0), weighed)
    cells = wp.zeros(cell_shape(*shape), dtype=Cell, device=device)
    host = HostScene(dataclasses.replace(scene, objects=()), device)
    proxies = trace_config(scene).proxies
    condense_cells(*arrays, weighed, probes_of(device), host.ray_scene, cells, proxies=proxies)
    got = cells.numpy()
    area = reference.cell_directions(*shape)[1].reshape(shape)[..., None]
    weight = got["solid_angle"][..., None]
    assert (weight * got["radiance"]).sum((0, 1)) == pytest.approx((area * radiance).sum((0, 1)), rel=1e-4)
    # The ball stands on the table: it sees it below, and the box or the environment above.
    assert got["modelled"][-1].all()
    assert not got["modelled"][0].any()
    recovered = rng.uniform(0, 5, (*got.shape, 3)).astype(np.float32)
    put_back = wp.zeros(shape, **to)
    add_recovered(*arrays[:2], weighed, cells, wp.array(recovered, **to), put_back)
    added = (area * (put_back.numpy() - radiance)).sum((0, 1))
    meant = (weight * got["missing"] * recovered).sum((0, 1))
    assert (got["missing"] <= got["clipped"] * (1 + 1e-5)).all()
    assert added == pytest.approx(meant, rel=1e-4)
    # More clips a frame later, or less: the energy stays. Of less than a quarter it fades.
    for share in (1.0, 0.3, 0.1, 0.01, 0.0):
        later = wp.array(np.full((*shape, 3), share), **to)
        now = wp.zeros_like(cells)
        condense_cells(*arrays, later, probes_of(device), host.ray_scene, now, proxies=proxies)
        add_recovered(*arrays[:2], later, cells, wp.array(recovered, **to), put_back)
        added = (area * (put_back.numpy() - radiance)).sum((0, 1))
        left = np.minimum(got["missing"], 4.0 * now.numpy()["missing"])
        assert added == pytest.approx((weight * left * recovered).sum((0, 1)), rel=1e-4, abs=1e-6)


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


# ---- the solution -------------------------------------------------------------------------------------------------


def test_nonnegative_solution_is_the_reference_one():
    rng = np.random.default_rng(2)
    for size in (1, 5, 30):
        for _ in range(20):
            matrix, target = rng.normal(size=(2 * size, size)), rng.normal(size=2 * size)
            want = nnls(matrix, target)[0]
            got = light_solver.solve_nonnegative(matrix.T @ matrix, matrix.T @ target)
            assert got == pytest.approx(want, abs=SOLVED * 1e2)
            warm = light_solver.solve_nonnegative(matrix.T @ matrix, matrix.T @ target, got)
            assert warm == pytest.approx(got, abs=SOLVED)


def test_regions_join_across_seam_and_poles():
    mask = np.zeros((16, 32), bool)
    mask[5, 0] = mask[6, 31] = True  # across the seam, diagonally
    mask[0, 3] = mask[0, 20] = True  # both touch the pole
    mask[10, 10] = True
    labels = regions.connected_regions(mask)
    assert labels[5, 0] == labels[6, 31] >= 0
    assert labels[0, 3] == labels[0, 20] >= 0
    assert len(np.unique(labels[mask])) == 3
    assert (labels[~mask] == -1).all()


def test_wide_regions_are_split_into_compact_parts():
    d, area = reference.cell_directions(ROWS, COLUMNS)
    labels = np.where(d[:, 2] > 0.5, 0, np.where(d[:, 2] < -0.99, 1, -1))
    parts, count = regions.split_regions(labels, d, area)
    sizes = np.bincount(parts[parts >= 0], area[parts >= 0])
    assert count == len(sizes) == parts.max() + 1
    assert (parts >= 0).tolist() == (labels >= 0).tolist()
    assert sizes.max() < 3 * CONFIG.priors.region
    assert len(np.unique(parts[labels == 1])) == 1


class DistantLight:
    """Surfaces lit by cells and emitters exactly as the equations have it, seen by a camera that clips."""

    def __init__(self, device, scene, *, table=0.4, box=0.3, noise=0.0):
        self.device, self.scene = device, scene
        self.host = HostScene(dataclasses.replace(scene, objects=()), device)
        self.proxies = trace_config(scene).proxies
        self.surfaces = light_surfaces.find_surfaces(scene)
        records = self.surfaces.points
        self.points = wp.array(records, dtype=kernels.SurfacePoint, device=device)
        self.seen = seen(device, len(records))
        self.probes = probes_of(device)
        rng = np.random.default_rng(4)
        known = np.array([scene.marker.white, 0.04, table, box])[self.surfaces.kinds[self.surfaces.surface]]
        self.reflectance = known * np.exp(noise * rng.normal(size=len(known)) * (known == table))
        # Faces that no camera above and in front sees.
        self.hidden = (records["normal"][:, 1] > 0.5) | (records["normal"][:, 2] < -0.5)

    def trace(self, emitters):
        out = wp.zeros((len(self.surfaces.points), len(emitters)), dtype=wp.float32, device=self.device)
        emitters = wp.array(emitters, dtype=wp.vec4, device=self.device)
        kernels.trace_emitters(
            self.points, self.seen, emitters, self.probes, self.host.ray_scene, out, proxies=self.proxies
        )
        return out.numpy().astype(float)

    def estimate(self, radiance, method="shading", extra=0.0, exposure=1.0, frames=1, camera=None):
        """Estimate from the true radiance of cells, (m, 3); ``extra`` is irradiance that does not come from cells."""
        values, _ = cells_of(self.device, np.minimum(radiance, 1.0).reshape(ROWS, COLUMNS, 3))
        values["clipped"] = values["missing"] = (radiance >= 1.0).reshape(ROWS, COLUMNS, 3)
        down = values["direction"][..., 2] < -0.05
        values["modelled"] = down
        cells = wp.array(values, dtype=Cell, device=self.device)
        straight, mirrored = transfer_of(
            self.device, self.points, cells, self.probes, self.host.ray_scene, self.proxies
        )
        irradiance = (straight + mirrored) @ radiance + extra
        shown = exposure * self.reflectance[:, None] * irradiance / np.pi
        observed = np.zeros(len(shown), np.dtype(kernels.Observation.numpy_dtype()))
        observed["radiance"], observed["clipped"] = np.minimum(shown, 1.0), shown >= 1.0
        observed["visible"] = ~self.hidden
        solver = recovery.Recovery(
            self.surfaces, self.scene.marker.white, (-0.12, 0.03, 0.035), radius=0.035, method=method
        )
        for _ in range(frames):
            estimate = solver.update(values, straight, mirrored, observed, self.trace, camera)
        return estimate, values


def lit_environment(*lights):
    """Radiance 0.2 above, 0.1 below, and lights: (direction, cosine of the radius, radiance)."""
    d, area = reference.cell_directions(ROWS, COLUMNS)
    radiance = np.where(d[:, 2:] > 0.0, 0.2, 0.1) * np.ones(3)
    masks = []
    for direction, cosine, value in lights:
        mask = d @ (np.array(direction) / np.linalg.norm(direction)) > cosine
        radiance[mask] = value
        masks.append(mask)
    return radiance, masks, area


def test_white_card_finds_the_only_light(device, scene):
    radiance, (mask,), area = lit_environment(((-0.5, -0.6, 0.6), 0.985, 30.0))
    for method in ("white_card", "shading"):
        estimate, values = DistantLight(device, scene).estimate(radiance, method)
        recovered = estimate.recovered.reshape(-1, 3) * values["clipped"].reshape(-1, 3)
        assert (area @ recovered) == pytest.approx(area[mask].sum() * np.full(3, 29.0), rel=0.05)
        assert not recovered[~mask].any()
        assert estimate.lower_bound == (False, False, False)


def test_shading_shares_energy_between_lights_where_the_card_cannot(device, scene):
    """Two lights of one size, one ten times the other: the card's answer is to make them equal."""
    lights = (((-0.5, -0.6, 0.5), 0.985, 40.0), ((0.7, -0.5, 0.5), 0.985, 5.0))
    radiance, masks, area = lit_environment(*lights)
    ratios = {}
    for method in ("white_card", "shading"):
        estimate, values = DistantLight(device, scene, noise=0.1).estimate(radiance, method)
        recovered = (estimate.recovered.reshape(-1, 3) * values["clipped"].reshape(-1, 3))[:, 1]
        ratios[method] = (area[masks[0]] @ recovered[masks[0]]) / (area[masks[1]] @ recovered[masks[1]])
    assert ratios["white_card"] == pytest.approx(1.0, abs=0.2)
    # The truth is 39 / 4; noise of 10 % on the table leaves the weak light uncertain by about a third.
    assert 6.0 < ratios["shading"] < 16.0


@pytest.mark.parametrize("distance", [0.35, 0.5])
def test_shading_finds_how_far_an_emitter_is(device, scene, distance):
    center = np.array([-0.12, 0.03, 0.035])
    direction = np.array([-0.45, 0.35, 0.82]) / np.linalg.norm([-0.45, 0.35, 0.82])
    radiance, _, _ = lit_environment((direction, 0.996, 1.0))
    surroundings = DistantLight(device, scene, noise=0.1)
    power = 2.5
    emitter = np.array([[*(center + distance * direction), 0.03]], np.float32)
    extra = surroundings.trace(emitter) * distance**2 * power * np.ones(3)
    estimate, _ = surroundings.estimate(radiance, extra=extra)
    assert estimate.emitters
    found = estimate.emitters[0]
    # The grid of directions is 5.6 degrees wide, and distances are refined in steps of a tenth.
    assert found.distance == pytest.approx(distance, rel=0.15)
    assert found.direction @ direction > np.cos(0.1)
    total = sum(emitter.power for emitter in estimate.emitters)
    assert total == pytest.approx(np.full(3, power), rel=0.15)


def test_an_emitter_is_where_the_ball_mirrors_it_to_the_camera(device, scene):
    """The ball shows a near emitter from a point of its surface, not from its middle: two centimetres beside it
    here."""
    center, camera = np.array([-0.12, 0.03, 0.035]), np.array([0.1, -0.6, 0.5])
    emitter = np.array([-0.35, 0.25, 0.4])
    direction = emitter - center
    for _ in range(30):  # the direction in which the ball shows it
        direction /= np.linalg.norm(direction)
        mirrors = mirroring_points(direction[None], center, 0.035, camera)[0]
        direction = emitter - mirrors
    distance = np.linalg.norm(direction)
    direction /= distance
    # The law of reflection, and the ball's surface.
    normal, view = (mirrors - center) / 0.035, (camera - center) / np.linalg.norm(camera - center)
    assert np.linalg.norm(normal) == pytest.approx(1.0)
    assert 2.0 * (normal @ view) * normal - view == pytest.approx(direction, abs=1e-6)
    assert np.linalg.norm(mirrors - center - (mirrors - center) @ direction * direction) > 0.018
    radiance, _, _ = lit_environment((direction, 0.997, 1.0))
    surroundings = DistantLight(device, scene, noise=0.1)
    extra = surroundings.trace(np.array([[*emitter, 0.03]], np.float32)) * distance**2 * 2.5 * np.ones(3)
    off = {}
    for name, seen_from in (("its surface", camera), ("its middle", None)):
        found = surroundings.estimate(radiance, extra=extra, camera=seen_from)[0].emitters[0]
        off[name] = np.linalg.norm(found.origin + found.distance * found.direction - emitter)
    # Directions are known to half a cell, 2.8 degrees; distances are refined in steps of a tenth.
    assert off["its surface"] < 0.03
    assert off["its surface"] < off["its middle"]


def scattered(kind, count, scatter, *, emitter=None, stains=0):
    """Points of one surface and what they show: a constant or an emitter's light, times noise."""
    rng = np.random.default_rng(2)
    points = np.zeros(count, np.dtype(kernels.SurfacePoint.numpy_dtype()))
    points["position"][:, :2] = rng.uniform(-0.1, 0.1, (count, 2))
    points["normal"], points["tangent"] = (0, 0, 1), (1, 0, 0)
    light = np.ones(count)
    if emitter is not None:
        away = np.array(emitter) - points["position"]
        light = away[:, 2] / np.linalg.norm(away, axis=1) ** 3
    light = light * np.exp(scatter * rng.normal(size=count))
    light[:stains] *= 0.3
    exact = np.ones((count, 3), bool)
    surface = np.zeros(count, np.int64)
    return noise.measured_noise(points, surface, np.array([kind]), light[:, None] * np.ones(3), exact)[0][0]


@pytest.mark.parametrize("emitter", [None, (-0.2, 0.1, 0.4)])
@pytest.mark.parametrize("scatter", [0.015, 0.03])
def test_noise_is_how_far_points_scatter(scatter, emitter):
    # 40 points tell a deviation to about a seventh, robustly measured; a fifth of them in shadow change little.
    for stains in (0, 8):
        assert scattered(Kind.FACE, 40, scatter, emitter=emitter, stains=stains) == pytest.approx(scatter, rel=0.4)


def test_noise_is_bounded_and_needs_points():
    usual = CONFIG.surfaces.noise[Kind.FACE]
    assert scattered(Kind.FACE, 40, 0.0) == CONFIG.surfaces.least_noise
    assert scattered(Kind.FACE, 40, 0.5) == usual
    assert scattered(Kind.FACE, CONFIG.surfaces.scatter_points - 1, 0.001) == usual


def test_a_card_that_clips_is_a_lower_bound(device, scene):
    """The method ``white_card`` must not exceed the truth, and says so; ``shading`` goes on by ink and table."""
    radiance, (mask,), area = lit_environment(((-0.5, -0.6, 0.6), 0.985, 300.0))
    truth = area[mask].sum() * 299.0
    totals = {}
    for method in ("white_card", "shading"):
        estimate, values = DistantLight(device, scene, table=0.3).estimate(radiance, method, exposure=1.0, extra=0.0)
        assert estimate.lower_bound == (True, True, True)
        recovered = (estimate.recovered.reshape(-1, 3) * values["clipped"].reshape(-1, 3))[:, 1]
        totals[method] = area @ recovered
    assert totals["white_card"] < 0.95 * truth
    # Ink is assumed to reflect 4 %, as it does here; the table's 30 % is not known.
    assert totals["shading"] == pytest.approx(truth, rel=0.3)
    assert totals["shading"] > totals["white_card"]


# Surfaces are of the reflectance that is assumed; of 52 parts of the sky none is seen alone.
WIDE_SKY_TOLERANCE = 0.15


@pytest.mark.parametrize("colour", [(2.5, 2.5, 2.5), (0.9, 2.5, 4.0)])
def test_a_sky_that_clips_is_not_shrunk_to_what_the_card_proves(device, scene, colour):
    """Relative deviations must not draw the light down: the card clips from 1.2 on, and ink tells how far beyond."""
    d, area = reference.cell_directions(ROWS, COLUMNS)
    radiance = np.where(d[:, 2:] > 0.0, np.array(colour), 0.1)
    estimate, values = DistantLight(device, scene, table=0.35, box=0.35).estimate(radiance)
    assert estimate.lower_bound == tuple(value * scene.marker.white > 1.0 for value in colour)
    recovered = estimate.recovered.reshape(-1, 3) * values["clipped"].reshape(-1, 3)
    found, truth = area @ recovered, area @ np.maximum(radiance - 1.0, 0.0)
    assert found == pytest.approx(truth, rel=WIDE_SKY_TOLERANCE)


def test_errors_are_shared_by_what_is_near():
    """A point alone on a table has an error of its own; a hundred within a centimetre share one."""
    apart = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [1.0, 0.0, 0.0]])
    together = np.array([0.2, 0.3, 0.0]) + 1e-4 * np.arange(100)[:, None] * [1.0, 0.0, 0.0]
    plane = np.full(103, int(Kind.PLANE))
    overlap = light_surfaces.texture_overlap(np.concatenate([apart, together]), np.zeros(103, int), plane)
    shared = noise.shared_errors(overlap, plane, np.ones(103, bool))
    assert shared[:3] == pytest.approx(2.0)
    assert (shared[3:] > 80.0).all()
    half = noise.shared_errors(overlap, plane, np.arange(103) % 2 == 0)
    assert len(half) == 52
    assert half[2:] == pytest.approx(0.5 * shared[4::2], rel=0.03)


def boxed(scene, count, side=0.01):
    """The scene with so many boxes more, each a little farther from the ball than the last."""
    x, y, _ = scene.probes[0].center
    boxes = [Proxy("box", at=(x + 0.1 + 0.02 * k, y, 0.5 * side), size=(side, side, side)) for k in range(count)]
    return dataclasses.replace(scene, proxies=(*scene.proxies, *boxes))


def test_what_is_read_is_bounded_however_many_boxes_there_are(scene):
    """Ten boxes are read at 25 points a face; of a hundred the largest share as many points; a plane keeps its own."""
    bare = dataclasses.replace(scene, proxies=tuple(p for p in scene.proxies if p.shape == "plane"))
    config = CONFIG.surfaces

    def faces(count):
        surfaces = light_surfaces.find_surfaces(boxed(bare, count))
        on_faces = surfaces.kinds[surfaces.surface] == Kind.FACE
        return np.count_nonzero(on_faces), np.unique(surfaces.groups[surfaces.kinds == Kind.FACE])

    assert faces(10)[0] == 10 * 6 * 25
    for count in (16, 17, 100):
        points, groups = faces(count)
        assert 0 < points <= config.box_points
        # The nearest ones, which come first here; proxy 0 is the plane.
        assert list(groups - 2) == list(range(1, 1 + config.boxes))


def test_many_planes_share_points_as_well(scene):
    planes = [Proxy("plane", at=(0.0, 0.0, -0.01 * k), size=(1.0, 1.0)) for k in range(40)]
    surfaces = light_surfaces.find_surfaces(dataclasses.replace(scene, proxies=tuple(planes)))
    on_planes = surfaces.kinds[surfaces.surface] == Kind.PLANE
    assert np.count_nonzero(surfaces.kinds == Kind.PLANE) == CONFIG.surfaces.planes
    # Every k-th point is left.
    assert 0.5 * CONFIG.surfaces.plane_points < np.count_nonzero(on_planes) <= CONFIG.surfaces.plane_points + 8


def test_equations_agree_with_their_matrix():
    """Products that leave zeros out are those with them: surfaces without an equation among others."""
    rng = np.random.default_rng(5)
    light, surface, first, count = rng.random((9, 3)), np.array([0, 0, 1, 1, 1, 3, 4, 4, 4]), 5, 6
    matrix = np.zeros((9, first + count))
    matrix[:, :3] = light
    matrix[np.arange(9), first + surface] = -1.0
    equations = fit.Equations(light, surface, first, count)
    z, weights, values = rng.random(first + count), rng.random(9), rng.random((9, 4))
    assert equations.times(z) == pytest.approx(matrix @ z)
    assert equations.transposed(values) == pytest.approx(matrix.T @ values)
    assert equations.transposed(values[:, 0]) == pytest.approx(matrix.T @ values[:, 0])
    hessian = np.eye(first + count)
    equations.add_normal(hessian, weights)
    assert hessian == pytest.approx(np.eye(first + count) + matrix.T @ (weights[:, None] * matrix))
    none = fit.Equations(light[:0], surface[:0], first, count)
    assert not none.transposed(values[:0]).any()


TWO_SOLVERS = """
from threadpoolctl import threadpool_info
from warp_ar.light import solver

def threads():
    return [library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"]

one = solver.OneBlasThread()
before = threads()
assert before == [2] * len(before)
one.__enter__()
one.__enter__()
assert threads() == [1] * len(before)
one.__exit__()
assert threads() == [1] * len(before)
one.__exit__()
assert threads() == before
"""


def test_two_solvers_leave_blas_as_it_was():
    """The first that begins ends first: the second must not set back what it found.

    In a process of its own: the number is the process's, and other tests have solvers.
    """
    two = {**os.environ, "OPENBLAS_NUM_THREADS": "2"}
    done = subprocess.run([sys.executable, "-c", TWO_SOLVERS], capture_output=True, text=True, check=False, env=two)
    assert done.returncode == 0, done.stderr


def test_nothing_clipped_nothing_added(device, scene):
    radiance, _, _ = lit_environment()
    estimate, _ = DistantLight(device, scene).estimate(radiance)
    assert not estimate.recovered.any()
    assert estimate.emitters == ()


def test_estimates_are_reproducible_and_steady(device, scene):
    lights = (((-0.5, -0.6, 0.5), 0.985, 40.0), ((0.7, -0.5, 0.5), 0.985, 5.0))
    radiance, _, _ = lit_environment(*lights)
    surroundings = DistantLight(device, scene, noise=0.1)
    once, again = (surroundings.estimate(radiance)[0].recovered for _ in range(2))
    assert (once == again).all()
    later = surroundings.estimate(radiance, frames=5)[0].recovered
    # Later searches may add a candidate; the same frame must not drift.
    assert later.sum() == pytest.approx(once.sum(), rel=0.05)


def test_all_that_is_estimated_is_finite_for_absurd_frames(device, scene):
    """Everything clipped, and everything black."""
    for value in (0.0, 1e6):
        for method in ("white_card", "shading"):
            estimate, _ = DistantLight(device, scene).estimate(np.full((ROWS * COLUMNS, 3), value), method)
            assert np.isfinite(estimate.recovered).all()
            assert (estimate.recovered >= 0).all()


def test_unknown_method_is_named(scene):
    with pytest.raises(ValueError, match=r"'guess'.*white_card or shading"):
        recovery.Recovery(light_surfaces.find_surfaces(scene), 0.85, (0, 0, 0), method="guess")


# ---- the stage ----------------------------------------------------------------------------------------------------


def test_stage_is_left_out_where_the_quality_says_so(scene):
    quality = PRESETS["low"].with_methods(recover="clipped")
    with Pipeline(scene, device="cpu", quality=quality, outputs=("environment",)) as pipeline:
        assert "recover" in dict(pipeline.plan.left_out)
        assert "filled_radiance" not in pipeline.arrays


def test_points_are_traced_once_when_they_come_into_view(device):
    """What a row holds stays as it is: the environment does not move."""
    points = points_of(device, [(5.0, 5.0, 0.0), (4.0, 5.0, 0.0)], [(0, 0, 1)] * 2)
    views, rows = np.zeros(2, np.dtype(kernels.Observation.numpy_dtype())), []
    traced = wp.zeros(2, dtype=wp.int32, device=device)
    out = [wp.full((2, ROWS * COLUMNS), -1.0, dtype=wp.float32, device=device) for _ in range(2)]
    surroundings = cells_of(device)[1], probes_of(device), empty_scene().ray_scene
    for visible in ((1, 0), (1, 1)):
        views["visible"] = visible
        seen_now = wp.array(views, dtype=kernels.Observation, device=device)
        kernels.trace_transfer(points, seen_now, *surroundings, traced, *out, proxies=())
        rows.append(out[0].numpy().sum(axis=1))
        out[0][:1].fill_(-1.0)
    assert rows[0] == pytest.approx([np.pi, -ROWS * COLUMNS], rel=QUADRATURE)
    assert rows[1] == pytest.approx([-ROWS * COLUMNS, np.pi], rel=QUADRATURE)


@pytest.mark.parametrize(("fps", "expected"), [(12, [0, 1, 2, 5, 8, 11]), (30, [0, 1, 2, 8, 14]), (3, [0, 1, 2, 5, 8])])
def test_estimates_are_a_few_a_second(scene, monkeypatch, fps, expected):
    frames, ask = [], Recover._ask

    def counted(self, rows):
        frames.append(index)
        ask(self, rows)

    monkeypatch.setattr(Recover, "_ask", counted)
    rng = np.random.default_rng(5)
    pose = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.6]))
    quality = PRESETS["low"].with_methods(recover="white_card")
    with Pipeline(scene, device="cpu", quality=quality, outputs=("environment",)) as pipeline:
        for index in range(expected[-1] + 1):
            image = rng.integers(0, 255, (240, 320, 3), np.uint8)
            pipeline(image, time_seconds=index / fps, pose=pose)
    assert frames == expected


def spied_estimates(monkeypatch, seconds=0.0):
    """Let a solver's n-th estimate, from 1 on, put n into every cell; it takes ``seconds``."""
    # By solver: that of a pipeline which is closed already may still be at its last one.
    numbers = collections.defaultdict(lambda: itertools.count(1))

    def update(self, cells, *_):
        time.sleep(seconds)
        return recovery.Estimate(np.full((*cells.shape, 3), next(numbers[self]), np.float32), (False,) * 3)

    monkeypatch.setattr(recovery.Recovery, "update", update)


def shown_estimates(scene, device, count, turns=1, estimates="delayed"):
    """Number of the estimate that each of ``count`` frames, 30 a second, was lit by; pipelines take turns."""
    pose = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.6]))
    rng = np.random.default_rng(6)
    shown = []
    with contextlib.ExitStack() as stack:
        quality = PRESETS["low"].with_methods(recover="white_card")
        arguments = {"device": device, "quality": quality, "outputs": ("environment",), "estimates": estimates}
        pipelines = [stack.enter_context(Pipeline(scene, **arguments)) for _ in range(turns)]
        for index in range(count):
            now, before = pipelines[index % turns], pipelines[(index - 1) % turns]
            if index and turns > 1:
                now.continue_from(before)
            now(rng.integers(0, 255, (240, 320, 3), np.uint8), time_seconds=index / 30, pose=pose)
            shown.append(int(now.arrays["recover_recovered"].numpy()[0, 0, 0]))
    return shown


@pytest.mark.parametrize("turns", [1, 2])
@pytest.mark.parametrize("seconds", [0.0, 0.05])
def test_estimates_take_effect_a_fixed_time_later(scene, device, monkeypatch, seconds, turns):
    """The first frames wait for theirs; however long one takes, and whoever has the frames meanwhile."""
    spied_estimates(monkeypatch, seconds)
    # Begun in frames 0, 1, 2, 8 and 14.
    expected = [1, 2, *[3] * (8 + round(30 * LATENCY) - 2), *[4] * 6, 5, 5]
    assert shown_estimates(scene, device, len(expected), turns) == expected


def test_an_estimate_that_is_waited_for_lights_its_own_frame(scene, device, monkeypatch):
    spied_estimates(monkeypatch, 0.05)
    expected = [1, 2, *[3] * 6, *[4] * 6, 5, 5]
    assert shown_estimates(scene, device, len(expected), estimates="synchronous") == expected


def what_is_seen(surroundings=0.4, table=0.3):
    """Cells and observations of an environment that does not clip."""
    cells = np.zeros((ROWS, COLUMNS), np.dtype(Cell.numpy_dtype()))
    cells["solid_angle"], cells["radiance"] = (
        reference.cell_directions(ROWS, COLUMNS)[1].reshape(ROWS, COLUMNS),
        surroundings,
    )
    observations = np.zeros(40, np.dtype(kernels.Observation.numpy_dtype()))
    observations["visible"], observations["radiance"] = 1.0, table
    return cells, observations


def settled_solver(scene):
    """A solver that has made as many estimates as it takes."""
    solver = recovery.Recovery(light_surfaces.find_surfaces(scene), 0.85, (-0.12, 0.03, 0.035))
    solver._frames = CONFIG.solver.settled
    return solver


def test_what_still_holds_is_solved_for_now_and_then(scene):
    solver = settled_solver(scene)
    rested = [solver.rests(*what_is_seen()) for _ in range(12)]
    assert rested == [False, *[True] * CONFIG.solver.rest, False, *[True] * CONFIG.solver.rest, False, True]


def test_a_new_solver_does_not_rest(scene):
    solver = settled_solver(scene)
    solver._frames = CONFIG.solver.settled - 1
    assert not any(solver.rests(*what_is_seen()) for _ in range(5))


@pytest.mark.parametrize(
    "changed", [{"surroundings": 0.4 * 1.4}, {"table": 0.3 * 0.7}, {"surroundings": 0.25, "table": 0.2}]
)
def test_a_switched_emitter_is_solved_for_at_once(scene, changed):
    solver = settled_solver(scene)
    assert not solver.rests(*what_is_seen())
    assert not solver.rests(*what_is_seen(**changed))


@pytest.mark.parametrize(
    "changed", [{"surroundings": 0.4 * 1.05}, {"table": 0.3 * 0.9}, {"surroundings": 0.35, "table": 0.25}]
)
def test_other_light_waits_once_at_most(scene, changed):
    solver = settled_solver(scene)
    assert not solver.rests(*what_is_seen())
    assert [solver.rests(*what_is_seen(**changed)) for _ in range(2)] == [True, False]
    solver = settled_solver(scene)
    assert [solver.rests(*what_is_seen()) for _ in range(2)] == [False, True]
    assert not solver.rests(*what_is_seen(**changed))


def test_light_that_changes_slowly_is_followed(scene):
    """What is compared with is what was solved for, not the last frame."""
    solver = settled_solver(scene)
    rested = [solver.rests(*what_is_seen(table=0.3 * 1.009**k)) for k in range(12)]
    assert rested.count(False) >= 4


def test_an_emitter_over_a_part_of_the_desk_is_other_light(scene):
    solver = settled_solver(scene)
    cells, observations = what_is_seen()
    assert not solver.rests(cells, observations)
    observations = observations.copy()
    observations["radiance"][:10] *= 1.3
    assert solver.rests(cells, observations)
    assert not solver.rests(cells, observations)


def test_a_dark_environment_rests_until_it_is_lit(scene):
    solver = settled_solver(scene)
    assert [solver.rests(*what_is_seen(surroundings=0.0)) for _ in range(2)] == [False, True]
    assert not solver.rests(*what_is_seen())


def test_a_frame_without_surfaces_is_no_proof(scene):
    solver = settled_solver(scene)
    cells, observations = what_is_seen()
    observations["visible"] = 0.0
    assert not any(solver.rests(cells, observations) for _ in range(3))


def test_the_stage_lets_an_estimate_stand(scene, device, monkeypatch):
    """The same picture for seconds: fewer estimates, the same light, and no work for those who read it."""
    solved, update = [], recovery.Recovery.update

    def counted(self, *sides):
        solved.append(index)
        return update(self, *sides)

    monkeypatch.setattr(recovery.Recovery, "update", counted)
    image = np.full((240, 320, 3), 90, np.uint8)
    image[:100] = 255
    pose = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.6]))
    quality = PRESETS["low"].with_methods(recover="white_card")
    lit = []
    with Pipeline(scene, device=device, quality=quality, outputs=("environment",), estimates="synchronous") as pipeline:
        for index in range(100):
            result = pipeline(image, time_seconds=index / 30, pose=pose)
            lit.append(result.environment)
    asked = [0, 1, 2, *range(8, 100, 6)]
    rests = [frame for frame in asked[CONFIG.solver.settled :] if frame not in solved]
    assert solved == [frame for frame in asked if frame not in rests]
    assert len(rests) >= 4
    assert all((lit[frame] == lit[frame - 1]).all() for frame in rests)


def test_a_failing_estimate_is_reported_with_its_frame(scene, monkeypatch):
    def update(*_):
        raise ArithmeticError("no such light")

    monkeypatch.setattr(recovery.Recovery, "update", update)
    with pytest.raises(ArithmeticError, match="no such light"):
        shown_estimates(scene, "cpu", 1)


CLIPPED_ERROR = 0.4
"""Of the irradiance that clipping takes at least in the case below."""
SHADING_ERROR = 0.2
"""What may be left: the first frame alone leaves 0.13."""


def test_light_of_a_path_traced_environment_comes_back(shared):
    case = shared / "truth" / "gold_torus_interior"
    truth = np.load(case / "env" / "0000.npy").astype(float)
    d, area = reference.cell_directions(*truth.shape[:2])
    normals = reference.cell_directions(12, 24)[0]
    cosine = np.maximum(normals @ d.T, 0.0) * area

    def irradiance(map_):
        return cosine @ np.asarray(map_, float).reshape(-1, 3)

    errors = {}
    for method in ("clipped", "white_card", "shading"):
        quality = PRESETS["medium"].with_methods(recover=method)
        source = load_scene(case / "scene_object.toml")
        with Session(source, device="cpu", quality=quality, outputs=("environment",)) as session:
            _, result = next(iter(session))
        small = result.environment
        got = np.repeat(np.repeat(small, truth.shape[0] // len(small), 0), truth.shape[0] // len(small), 1)
        errors[method] = np.linalg.norm(irradiance(got) - irradiance(truth)) / np.linalg.norm(irradiance(truth))
    assert errors["clipped"] > CLIPPED_ERROR
    assert errors["white_card"] < errors["clipped"]
    assert errors["shading"] < SHADING_ERROR
