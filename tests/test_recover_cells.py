"""Cells of the environment in which light is missing, and the boundaries of what clips."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import warp as wp

from tests.recover_rig import probes_of, scene  # noqa: F401
from tests.reference import recover as reference
from warp_ar.kernels import structs
from warp_ar.kernels.recovery.recover_cells import Cell, add_recovered, cell_shape, condense_cells, leave_out_edges
from warp_ar.kernels.recovery.saturation_boundaries import weigh_boundaries
from warp_ar.scene.kinds import trace_config
from warp_ar.scene.ray_scene import HostScene


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


@pytest.mark.parametrize("height", [32, 128])
def test_what_clips_on_a_proxy_beside_light_behind_its_edge_is_left_out(device, height, scene):
    plane = dataclasses.replace(scene, objects=(), proxies=tuple(one for one in scene.proxies if one.shape == "plane"))
    shape = (height, 2 * height)
    d, area = reference.cell_directions(*shape)
    d, area = d.reshape(*shape, 3), area.reshape(shape)
    # The plane lies in z = 0 and reaches .8 and .6 metres from the origin.
    center, half = np.array([-0.12, 0.03, 0.035]), np.array([0.8, 0.6])
    reach = np.where(d[..., 2] < 0.0, -center[2] / np.minimum(d[..., 2], -1e-9), np.inf)
    on = (np.abs(center[:2] + reach[..., None] * d[..., :2]) < half).all(axis=-1) & np.isfinite(reach)
    clipped = (np.random.default_rng(2).uniform(0, 1, shape) > 0.5).astype(float)[..., None] * np.ones(3)
    # Below, all clips that is the plane, and nothing else is there.
    clipped[d[..., 2] < -0.3] = 1.0
    weight = area * clipped[..., 0]
    rows, columns = cell_shape(*shape)
    sums = [(weight * of).reshape(rows, height // rows, columns, -1).sum(axis=(1, 3)) for of in (on, ~on)]
    is_edge = (sums[0] > 0.0) & (sums[1] > 0.25 * (sums[0] + sums[1]))
    assert is_edge.any() == (height > 32)
    left = np.kron(is_edge, np.ones((height // rows, height // rows))).astype(bool) & on
    missing = wp.array(clipped.astype(np.float32), dtype=wp.vec3, device=device)
    host, proxies = HostScene(plane, device), trace_config(plane).proxies
    source = wp.array(clipped.astype(np.float32), dtype=wp.vec3, device=device)
    leave_out_edges(source, probes_of(device), host.ray_scene, missing, proxies=proxies)
    assert (missing.numpy() == np.where(left[..., None], 0.0, clipped)).all()
    # A cell's light is what is left: it lies beyond the plane, and the cell is no part of that.
    seen = wp.full(shape, 1.0, dtype=wp.float32, device=device)
    cells = wp.zeros((rows, columns), dtype=Cell, device=device)
    condense_cells(source, seen, source, missing, probes_of(device), host.ray_scene, cells, proxies=proxies)
    got = cells.numpy()
    assert not got["modelled"][is_edge].any()
    kept = (area * clipped[..., 0] * ~left).reshape(rows, height // rows, columns, -1).sum(axis=(1, 3))
    total = area.reshape(rows, height // rows, columns, -1).sum(axis=(1, 3))
    assert got["clipped"][is_edge] == pytest.approx((kept / total)[is_edge][:, None] * np.ones(3), rel=1e-4)
    assert got["missing"][is_edge] == pytest.approx((kept / total)[is_edge][:, None] * np.ones(3), rel=1e-4)
