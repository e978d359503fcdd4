"""What tests of recovered light share: a desk, its points, cells of the environment, and light that is known."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import warp as wp

from tests.kernel_rig import proxies_of, records, trace_of
from tests.twins import recover as reference
from warp_ar.kernels import structs
from warp_ar.kernels.recovery import recover as kernels
from warp_ar.kernels.recovery.recover_cells import CELL_COLUMNS, CELL_ROWS, Cell
from warp_ar.light import recovery, solving
from warp_ar.light import surfaces as light_surfaces
from warp_ar.scene import loads_scene
from warp_ar.scene.ray_scene import HostScene

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


def solve_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let this process make all estimates of a test: one that another test has left would count for itself."""
    process = solving.SolvingProcess()
    process.close()
    monkeypatch.setattr(solving, "PROCESS", process)


def probes_of(device, center=(-0.12, 0.03, 0.035), radius=0.035, reflectance=0.85):
    return records(structs.Probe, {"center": center, "radius": radius, "reflectance": reflectance}, device=device)


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
    return records(kernels.Observation, *[{"visible": 1.0}] * count, device=device)


def cells_of(device, radiance=1.0, clipped=0.0):
    d, solid_angle = reference.cell_directions(CELL_ROWS, CELL_COLUMNS)
    values = np.zeros((CELL_ROWS, CELL_COLUMNS), np.dtype(Cell.numpy_dtype()))
    values["middle"] = values["direction"] = d.reshape(CELL_ROWS, CELL_COLUMNS, 3)
    values["solid_angle"] = solid_angle.reshape(CELL_ROWS, CELL_COLUMNS)
    values["radiance"], values["clipped"], values["missing"] = radiance, clipped, clipped
    return values, wp.array(values, dtype=Cell, device=device)


def transfer_of(device, points, cells, probes, scene):
    out = [wp.zeros((len(points), CELL_ROWS * CELL_COLUMNS), dtype=wp.float32, device=device) for _ in range(2)]
    traced = wp.zeros(len(points), dtype=wp.int32, device=device)
    kinds = trace_of((), scene.proxies.numpy()).proxies
    kernels.trace_transfer(kinds, points, seen(device, len(points)), cells, probes, scene, traced, *out)
    return [array.numpy().astype(float) for array in out]


class DistantLight:
    """Surfaces lit by cells and emitters exactly as the equations have it, seen by a camera that clips."""

    def __init__(self, device, scene, *, table=0.4, box=0.3, noise=0.0):
        self.device, self.scene = device, scene
        self.host = HostScene(dataclasses.replace(scene, objects=()), device)
        self.proxies = proxies_of(scene)
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
        kernels.trace_emitters(self.proxies, self.points, self.seen, emitters, self.probes, self.host.ray_scene, out)
        return out.numpy().astype(float)

    def equations(self, radiance, extra=0.0, exposure=1.0):
        """What a solver is given of a frame; arguments as for ``estimate``."""
        values, _ = cells_of(self.device, np.minimum(radiance, 1.0).reshape(CELL_ROWS, CELL_COLUMNS, 3))
        values["clipped"] = values["missing"] = (radiance >= 1.0).reshape(CELL_ROWS, CELL_COLUMNS, 3)
        down = values["direction"][..., 2] < -0.05
        values["modelled"] = down
        cells = wp.array(values, dtype=Cell, device=self.device)
        straight, mirrored = transfer_of(self.device, self.points, cells, self.probes, self.host.ray_scene)
        irradiance = (straight + mirrored) @ radiance + extra
        shown = exposure * self.reflectance[:, None] * irradiance / np.pi
        observed = np.zeros(len(shown), np.dtype(kernels.Observation.numpy_dtype()))
        observed["radiance"], observed["clipped"] = np.minimum(shown, 1.0), shown >= 1.0
        observed["visible"] = ~self.hidden
        return values, straight, mirrored, observed

    def solver(self, method="shading"):
        """One that has seen nothing yet."""
        return recovery.Recovery(
            self.surfaces, self.scene.marker.white, (-0.12, 0.03, 0.035), radius=0.035, method=method
        )

    def estimate(self, radiance, method="shading", extra=0.0, exposure=1.0, frames=1, camera=None):
        """Estimate from the true radiance of cells, (m, 3); ``extra`` is irradiance that does not come from cells."""
        given, solver = self.equations(radiance, extra, exposure), self.solver(method)
        for _ in range(frames):
            estimate = solver.update(*given, self.trace, camera)
        return estimate, given[0]


def lit_environment(*lights):
    """Radiance 0.2 above, 0.1 below, and lights: (direction, cosine of the radius, radiance)."""
    d, area = reference.cell_directions(CELL_ROWS, CELL_COLUMNS)
    radiance = np.where(d[:, 2:] > 0.0, 0.2, 0.1) * np.ones(3)
    masks = []
    for direction, cosine, value in lights:
        mask = d @ (np.array(direction) / np.linalg.norm(direction)) > cosine
        radiance[mask] = value
        masks.append(mask)
    return radiance, masks, area
