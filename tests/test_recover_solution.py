"""The solution of the equations by which clipped light is recovered."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import nnls

from tests.recover_rig import DistantLight, lit_environment, scene  # noqa: F401
from tests.reference import recover as reference
from warp_ar.kernels.recovery import recover as kernels
from warp_ar.kernels.recovery.recover_cells import CELL_COLUMNS, CELL_ROWS
from warp_ar.light import fit, noise, recovery, regions
from warp_ar.light import solver as light_solver
from warp_ar.light import surfaces as light_surfaces
from warp_ar.light.config import CONFIG, Kind
from warp_ar.light.emitters import EmitterSearch
from warp_ar.light.problem import Candidate, mirroring_points
from warp_ar.scene import Proxy

SOLVED = 1e-8
"""Two exact methods on one quadratic problem."""


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
    d, area = reference.cell_directions(CELL_ROWS, CELL_COLUMNS)
    labels = np.where(d[:, 2] > 0.5, 0, np.where(d[:, 2] < -0.99, 1, -1))
    parts, count = regions.split_regions(labels, d, area)
    sizes = np.bincount(parts[parts >= 0], area[parts >= 0])
    assert count == len(sizes) == parts.max() + 1
    assert (parts >= 0).tolist() == (labels >= 0).tolist()
    assert sizes.max() < 3 * CONFIG.priors.region
    assert len(np.unique(parts[labels == 1])) == 1


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


@pytest.mark.parametrize("distance", [0.3, 0.35, 0.41, 0.55, 0.62, 0.7])
def test_shading_finds_how_far_an_emitter_is(device, scene, distance):
    center = np.array([-0.12, 0.03, 0.035])
    direction = np.array([-0.45, 0.35, 0.82]) / np.linalg.norm([-0.45, 0.35, 0.82])
    radiance, _, _ = lit_environment((direction, 0.996, 1.0))
    surroundings = DistantLight(device, scene, noise=0.1)
    power = 2.5
    emitter = np.array([[*(center + distance * direction), 0.03]], np.float32)
    extra = surroundings.trace(emitter) * distance**2 * power * np.ones(3)
    estimate, _ = surroundings.estimate(radiance, extra=extra)
    (found,) = estimate.emitters
    # Measured at these: 0.032 at most, and 0.067 at 0.9 m, where the costs differ by less than noise. The distances
    # among which it is found first lie up to a quarter apart.
    assert found.distance == pytest.approx(distance, rel=0.04)
    # The grid of directions is 5.6 degrees wide.
    assert found.direction @ direction > np.cos(0.1)
    assert found.power == pytest.approx(np.full(3, power), rel=0.04)


@pytest.mark.parametrize(("start", "least"), [(0.35, 0.29), (0.45, 0.3), (0.35, 0.38), (0.35, 0.36), (0.3, 0.2)])
def test_an_emitter_stands_where_its_cost_is_least(start, least):
    """Between the distances that are tried, from a start some steps off; never nearer than any is looked for."""
    tried = []

    class Search(EmitterSearch):
        def __init__(self):
            self.problem = SimpleNamespace(trace=True)

        def tried(self, candidate, z, iterations):
            tried.append(candidate.distance)
            return SimpleNamespace(cost=50.0 * np.log(candidate.distance / least) ** 2)

    def place_from(distance, worth):
        place = Candidate(7, distance)
        return Search()._at_its_distance(place, Search().cost_at(place, None), SimpleNamespace(z=None), worth)

    place = place_from(start, 1e-6)
    assert place.cell == 7
    assert min(tried) > CONFIG.search.nearest
    # 50 log(d / least)^2 - 6 log d: there is more room farther off.
    if least > CONFIG.search.nearest:
        assert place.distance == pytest.approx(least * np.exp(6.0 / 100.0), rel=1e-3)
    assert len(tried) < 12
    distant = Candidate(7, np.inf)
    assert Search()._at_its_distance(distant, 0.0, SimpleNamespace(z=None), 0.01) is distant
    # What gains no more than is asked for stays where it is.
    assert place_from(start, 1e3) == Candidate(7, start)


@pytest.mark.parametrize(
    ("falls", "is_added"), [((40.0, 6.0, 2.0), False), ((14.0, 9.0, 3.0), True), ((2.0, 9.0, 9.0), True)]
)
def test_two_channels_must_show_an_emitter(falls, is_added):
    """What one says alone, however clearly, is no emitter; what two say is one, where the third clips."""
    candidates = []

    class Search(EmitterSearch):
        def __init__(self):
            self.evidence = CONFIG.search.evidence
            self.problem = SimpleNamespace(
                push=candidates.append, pop=candidates.pop, with_candidate=lambda z: z, candidates=candidates
            )

        def fit(self, z, iterations):
            costs = 100.0 - np.array(falls) * len(candidates)
            return SimpleNamespace(z=z, costs=costs, cost=costs.mean())

        def gains(self, fits, columns):
            return np.array(falls)[:, None]

        def settled(self, candidate, cost, fits, least):
            return candidate

    search = Search()
    added = search.add_candidate(search.fit([None] * 3, 1), [Candidate(7, np.inf)], np.zeros((1, 1)))
    assert (added is not None) == is_added
    assert candidates == [Candidate(7, np.inf)] * is_added


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
    # Directions are known to half a cell, 2.8 degrees.
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
    d, area = reference.cell_directions(CELL_ROWS, CELL_COLUMNS)
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


def factor_of(surroundings, *frames):
    """Share of a solution that is taken, after frames of (radiance, gain of the camera)."""
    solver = surroundings.solver()
    for radiance, gain in frames:
        solver.gain = np.full(3, gain)
        estimate = solver.update(*surroundings.equations(gain * radiance), surroundings.trace)
    return estimate.factor


def test_what_one_exposure_tells_of_light_holds_at_another_of_the_same_light_only(device, scene):
    """At two fifths of the exposure a low sun hardly clips, and what the card then lacks is within its error."""
    surroundings = DistantLight(device, scene, noise=0.1)
    sun, _, _ = lit_environment(((-0.8, -0.5, 0.25), 0.97, 2.8))
    elsewhere, _, _ = lit_environment(((0.8, -0.5, 0.25), 0.97, 2.8))
    alone = factor_of(surroundings, (sun, 0.4))
    assert alone < 0.5
    assert factor_of(surroundings, (sun, 1.0)) > 0.95
    assert factor_of(surroundings, (sun, 1.0), (sun, 0.4)) > 0.95
    # The sun went, another came; nothing is known of it. Nor is one exposure more told by itself.
    assert factor_of(surroundings, (elsewhere, 1.0), (sun, 0.4)) == pytest.approx(alone, abs=0.1)
    assert factor_of(surroundings, (sun, 0.4), (sun, 0.4)) == pytest.approx(alone, abs=0.1)


def test_all_that_is_estimated_is_finite_for_absurd_frames(device, scene):
    """Everything clipped, and everything black."""
    for value in (0.0, 1e6):
        for method in ("white_card", "shading"):
            estimate, _ = DistantLight(device, scene).estimate(np.full((CELL_ROWS * CELL_COLUMNS, 3), value), method)
            assert np.isfinite(estimate.recovered).all()
            assert (estimate.recovered >= 0).all()


def test_unknown_method_is_named(scene):
    with pytest.raises(ValueError, match=r"'guess'.*white_card or shading"):
        recovery.Recovery(light_surfaces.find_surfaces(scene), 0.85, (0, 0, 0), method="guess")


@pytest.mark.parametrize(("whole", "taken"), [(0.5, 0.5), (-1.5, -0.25), (-7.0, -1.0), (1000.0, 1.0 + 999.0 / 16.0)])
def test_a_step_is_halved_while_it_raises_the_cost(whole, taken):
    """From 1, where the cost is the square; four halvings are all."""
    channel = SimpleNamespace(_cost=lambda z: float(z[0] ** 2))
    z, least = fit._Channel._shortened(channel, np.ones(1), np.array([whole]), 1.0)
    assert z[0] == pytest.approx(taken)
    assert least == pytest.approx(min(taken**2, 1.0))
