"""Rays: closed forms, the float64 twin, edges that must not leak, origins that must not shadow themselves."""

from __future__ import annotations

import functools

import numpy as np
import pytest
import warp as wp

from tests.error_model import check_error
from tests.twins import visibility as reference
from warp_ar.kernels import structs
from warp_ar.kernels.rays.shapes import FAR
from warp_ar.kernels.rays.trace import TraceConfig, make_trace
from warp_ar.kernels.structs import Hit
from warp_ar.scene.geometry import rotation_matrix
from warp_ar.scene.ray_mesh import make_ray_mesh
from warp_ar.scene.shapes import sphere_mesh, torus_mesh

GENERAL = TraceConfig((), ()).general()

# Float32 positions and directions of order 1 carry 6e-8 each; some twenty roundings reach t and point, and a grazing
# angle of 3 degrees multiplies them by 20.
T_TOLERANCE = 3e-5
# The same roundings over the size of a triangle, here a tenth of its mesh.
NORMAL_TOLERANCE = 1e-5
# A ray within this of an outline may fall on either side of it.
OUTLINE_SHARE = 2e-4


@functools.cache
def make_probe_kernel(config: TraceConfig) -> wp.Kernel:
    """Runs every trace function on one ray per thread."""
    trace = make_trace(config)
    closest_object, closest_proxy = trace.closest_object, trace.closest_proxy
    by_objects, by_proxies, by_any = trace.occluded_by_objects, trace.occluded_by_proxies, trace.occluded

    @wp.kernel(module="unique", enable_backward=False)
    def probe_kernel(
        # In:
        scene: structs.RayScene,
        origins: wp.array[wp.vec3],
        directions: wp.array[wp.vec3],
        t_max: wp.float32,
        # Out:
        objects_out: wp.array[Hit],
        proxies_out: wp.array[Hit],
        occluded_out: wp.array[wp.vec3i],
    ):
        i = wp.tid()
        objects_out[i] = closest_object(scene, origins[i], directions[i], t_max)
        proxies_out[i] = closest_proxy(scene, origins[i], directions[i], t_max)
        occluded_out[i] = wp.vec3i(
            wp.where(by_objects(scene, origins[i], directions[i], t_max), 1, 0),
            wp.where(by_proxies(scene, origins[i], directions[i], t_max), 1, 0),
            wp.where(by_any(scene, origins[i], directions[i], t_max), 1, 0),
        )

    return probe_kernel


# A scene holds meshes by number only; these keep them until the test ends.
_ALIVE: list = []


@pytest.fixture(autouse=True)
def _release_meshes():
    yield
    _ALIVE.clear()


class World:
    """Shapes on a device and their twins."""

    def __init__(self, device: str) -> None:
        self.device = device
        self.bodies: list[reference.Body] = []
        self.records: list[np.ndarray] = []
        self._meshes: list = []
        self._corners = 0

    def add(self, kind, extent=(1.0, 1.0, 1.0), at=(0.0, 0.0, 0.0), rotate=(0.0, 0.0, 0.0), scale=1.0, mesh=None):
        record = np.zeros((), np.dtype(structs.Shape.numpy_dtype()))
        rotation, position = rotation_matrix(rotate), np.array(at, np.float64)
        record["rotation"], record["scale"], record["smooth"], record["material"] = rotation, scale, 1, -1
        if mesh is not None:
            made = make_ray_mesh(mesh, self.device)
            record["mesh"] = made.mesh.id
            record["first_vertex"], extent = self._corners, made.half
            position = position + scale * rotation @ made.center
            triangles = (mesh.vertices.astype(np.float64) - made.center)[mesh.faces]
            self._corners += len(made.normals)
            self._meshes.append(made)
            _ALIVE.append(made)
        else:
            triangles = None
        kinds = {"plane": structs.PLANE, "box": structs.BOX, "mesh": structs.MESH, "sphere": structs.SPHERE}
        record["kind"], record["extent"], record["position"] = kinds[kind], extent, position
        self.records.append(record)
        # The twin sees the rounded numbers that the device sees.
        self.bodies.append(
            reference.Body(
                kind,
                record["rotation"].astype(np.float64),
                record["position"].astype(np.float64),
                float(record["scale"]),
                record["extent"].astype(np.float64),
                triangles,
            )
        )
        return self

    def scene(self, *, proxies: bool = False) -> structs.RayScene:
        records = np.zeros(len(self.records), self.records[0].dtype)
        for index, record in enumerate(self.records):
            records[index] = record
        shapes = wp.array(records, dtype=structs.Shape, device=self.device)
        nothing = wp.zeros(0, dtype=structs.Shape, device=self.device)
        scene = structs.RayScene()
        scene.objects, scene.proxies = (nothing, shapes) if proxies else (shapes, nothing)
        normals = np.concatenate([np.zeros((0, 3), np.float32), *(mesh.normals for mesh in self._meshes)])
        uvs = np.concatenate([np.zeros((0, 2), np.float32), *(mesh.uvs for mesh in self._meshes)])
        scene.vertex_normals = wp.array(normals, dtype=wp.vec3, device=self.device)
        scene.vertex_uvs = wp.array(uvs, dtype=wp.vec2, device=self.device)
        return scene


def shoot(scene, origins, directions, device, *, config=GENERAL, t_max=float(FAR)):
    """Hits on objects and proxies as structured arrays, and the three answers of the any-hit functions."""
    origins, directions = np.broadcast_arrays(np.asarray(origins, np.float32), np.asarray(directions, np.float32))
    count = len(origins)
    outputs = [
        wp.zeros(count, dtype=Hit, device=device),
        wp.zeros(count, dtype=Hit, device=device),
        wp.zeros(count, dtype=wp.vec3i, device=device),
    ]
    inputs = [
        scene,
        wp.array(np.ascontiguousarray(origins), dtype=wp.vec3, device=device),
        wp.array(np.ascontiguousarray(directions), dtype=wp.vec3, device=device),
        t_max,
    ]
    wp.launch(make_probe_kernel(config), dim=count, inputs=inputs, outputs=outputs, device=device)
    return tuple(output.numpy() for output in outputs)


def unit(rng, count):
    v = rng.normal(size=(count, 3))
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


# --- Closed form ------------------------------------------------------------------------------------------------------


def test_closed_form(device):
    """One ray each at a sphere, a box, a plane and a mesh, turned, moved and scaled."""
    cases = [
        ("sphere", {"extent": (0.5, 0.5, 0.5), "scale": 2.0, "at": (1, 2, 3)}, (1, 2, 10), (0, 0, -2), 3.0, (0, 0, 1)),
        ("sphere", {"extent": (0.5, 0.5, 0.5), "scale": 2.0}, (0, 0, 0), (0, 1, 0), 1.0, (0, 1, 0)),
        ("box", {"extent": (1, 2, 3), "rotate": (0, 0, 90)}, (5, 0, 0), (-1, 0, 0), 3.0, (1, 0, 0)),
        ("box", {"extent": (1, 2, 3)}, (0, 0, 0), (0, 0, -1), 3.0, (0, 0, -1)),
        ("plane", {"extent": (1, 1, 0), "at": (0, 0, 1)}, (0.9, 0.9, 3), (0, 0, -1), 2.0, (0, 0, 1)),
        ("plane", {"extent": (1, 1, 0), "at": (0, 0, 1)}, (0.9, 0.9, 0), (0, 0, 1), 1.0, (0, 0, 1)),
    ]
    for kind, shape, origin, direction, t, normal in cases:
        hits, _, occluded = shoot(World(device).add(kind, **shape).scene(), [origin], [direction], device)
        assert hits["shape"][0] == 0
        np.testing.assert_allclose(hits["t"][0], t, rtol=1e-6)
        np.testing.assert_allclose(hits["point"][0], np.add(origin, np.multiply(t, direction)), atol=2e-6)
        np.testing.assert_allclose(hits["geometric_normal"][0], normal, atol=1e-6)
        assert occluded[0].tolist() == [1, 0, 1]
        hits, _, occluded = shoot(
            World(device).add(kind, **shape).scene(), [origin], [direction], device, t_max=t - 0.01
        )
        assert hits["shape"][0] == -1
        assert occluded[0].tolist() == [0, 0, 0]
    hits, _, _ = shoot(World(device).add("plane", extent=(1, 1, 0)).scene(), [(1.1, 0, 1)], [(0, 0, -1)], device)
    assert hits["shape"][0] == -1


def test_texture_coordinates(device):
    """Spheres as a latlong map, boxes 0 to 1 on every face, meshes interpolated."""
    hits, _, _ = shoot(
        World(device).add("sphere").scene(),
        [(3, 0, 0), (0, 3, 0), (0, 0, 3)],
        [(-1, 0, 0), (0, -1, 0), (0, 0, -1)],
        device,
    )
    np.testing.assert_allclose(hits["uv"][0], [0.5, 0.5], atol=1e-6)
    np.testing.assert_allclose(hits["uv"][1], [0.75, 0.5], atol=1e-6)
    assert hits["uv"][2][1] == pytest.approx(1.0, abs=1e-6)
    box = World(device).add("box", extent=(1, 2, 4)).scene()
    hits, _, _ = shoot(box, [(5, 1, 2), (-5, 1, 2)], [(-1, 0, 0), (1, 0, 0)], device)
    np.testing.assert_allclose(hits["uv"], [[0.75, 0.75], [0.25, 0.75]], atol=1e-6)
    ball = sphere_mesh(1.0)
    rng = np.random.default_rng(5)
    directions = unit(rng, 500)
    hits, _, _ = shoot(World(device).add("mesh", mesh=ball).scene(), 3 * directions, -directions, device)
    u = 0.5 + np.arctan2(directions[:, 1], directions[:, 0]) / (2 * np.pi)
    away_from_poles = np.abs(directions[:, 2]) < 0.9
    assert (hits["shape"] == 0).all()
    # Interpolated over triangles of 1/100 turn; what is wrong is far more.
    np.testing.assert_allclose(hits["uv"][away_from_poles, 0], u[away_from_poles], atol=2e-3)
    np.testing.assert_allclose(hits["normal"], directions, atol=2e-3)


# --- The float64 twin -------------------------------------------------------------------------------------------------


def test_matches_reference(device):
    """A crowd of all kinds, as objects and as proxies, against brute force in double precision."""
    rng = np.random.default_rng(1)
    world = World(device)
    torus = torus_mesh(0.5, 0.2, tolerance=0.02)
    for kind in ("sphere", "box", "plane", "mesh") * 3:
        world.add(
            kind,
            extent=rng.uniform(0.2, 0.6, 3) if kind != "sphere" else np.full(3, rng.uniform(0.2, 0.6)),
            at=rng.uniform(-1.5, 1.5, 3),
            rotate=rng.uniform(-180, 180, 3),
            scale=rng.uniform(0.5, 1.5),
            mesh=torus if kind == "mesh" else None,
        )
    origins = rng.uniform(-3, 3, (20000, 3)).astype(np.float32)
    directions = (rng.uniform(-1, 1, (20000, 3)) - origins * 0.3).astype(np.float32)
    t, which, normal = reference.closest(world.bodies, origins.astype(np.float64), directions.astype(np.float64))
    objects, none, occluded = shoot(world.scene(), origins, directions, device)
    assert (none["shape"] == -1).all()
    same = objects["shape"] == which
    assert (which >= 0).mean() > 0.15
    assert (~same).mean() < OUTLINE_SHARE
    hit = same & (which >= 0)
    np.testing.assert_array_equal(occluded[:, 0], objects["shape"] >= 0)
    np.testing.assert_array_equal(occluded[:, 1], 0)
    facing = np.abs(np.sum(normal * directions, -1)) / np.linalg.norm(directions, axis=-1)
    steep = hit & (facing > 0.05)
    np.testing.assert_allclose(objects["t"][steep], t[steep], rtol=T_TOLERANCE, atol=T_TOLERANCE)
    turned = np.abs(objects["geometric_normal"] - normal).max(-1)[steep]
    assert (turned > NORMAL_TOLERANCE).mean() < 2e-3  # rays at the edge between two faces
    points = origins + t[:, None] * directions
    np.testing.assert_allclose(objects["point"][steep], points[steep], atol=1e-4)
    check_error("visibility", objects["t"][steep], t[steep])

    nothing, proxies, occluded = shoot(world.scene(proxies=True), origins, directions, device)
    assert (nothing["shape"] == -1).all()
    np.testing.assert_array_equal(proxies["shape"], objects["shape"])
    np.testing.assert_array_equal(occluded[:, 1], objects["shape"] >= 0)


@pytest.mark.parametrize("kind", ["sphere", "mesh"])
def test_specialised_equals_general(device, kind):
    """A config that knows only the kinds that exist gives the same hits, bit for bit."""
    rng = np.random.default_rng(2)
    mesh = torus_mesh(0.5, 0.2, tolerance=0.02) if kind == "mesh" else None
    scene = World(device).add(kind, mesh=mesh, extent=(0.6, 0.6, 0.6)).add(kind, mesh=mesh, at=(0.5, 0, 0)).scene()
    directions = unit(rng, 2000)
    origins = 2 * unit(rng, 2000)
    special = TraceConfig((structs.SPHERE if kind == "sphere" else structs.MESH,), ())
    general = shoot(scene, origins, directions, device)
    specialised = shoot(scene, origins, directions, device, config=special)
    for field in ("shape", "t", "point", "normal", "geometric_normal", "uv"):
        np.testing.assert_allclose(
            specialised[0][field], general[0][field], rtol=0, atol=0 if device == "cpu" else 1e-6
        )
    np.testing.assert_array_equal(specialised[2], general[2])
