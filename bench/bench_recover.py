"""Recovery of clipped light: the kernels, and the solution on the host.

The answer is checked first: a uniform environment gives open surface points the irradiance pi.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import warp as wp

from bench.common import measure, report
from warp_ar.kernels import structs
from warp_ar.kernels.recovery import recover as kernels
from warp_ar.kernels.recovery.recover_cells import Cell, add_recovered, cell_shape, condense_cells
from warp_ar.kernels.recovery.saturation_boundaries import weigh_boundaries
from warp_ar.light import recovery
from warp_ar.light.config import Kind
from warp_ar.light.estimate import Estimate
from warp_ar.light.surfaces import find_surfaces
from warp_ar.scene import load_scene
from warp_ar.scene.kinds import trace_config
from warp_ar.scene.ray_scene import HostScene

HEIGHTS = (64, 128)


@dataclasses.dataclass
class Setup:
    """A uniform environment around the bundled desk, with an emitter that clips."""

    height: int
    device: str

    def __post_init__(self) -> None:
        scene = load_scene("desk")
        self.scene = HostScene(dataclasses.replace(scene, objects=()), self.device).ray_scene
        self.proxies = trace_config(scene).proxies
        surfaces = find_surfaces(scene)
        count, shape = len(surfaces.points), (self.height, 2 * self.height)
        probes = np.zeros(1, np.dtype(structs.Probe.numpy_dtype()))
        probe = scene.probes[0]
        probes["center"], probes["radius"], probes["reflectance"] = probe.center, probe.radius, probe.reflectance
        params = np.zeros(1, np.dtype(structs.FrameParams.numpy_dtype()))
        params["camera_position"], params["focal"] = (0.0, -0.5, 0.3), 800.0
        clipped = np.zeros((*shape, 3), np.float32)
        clipped[shape[0] // 4 : shape[0] // 4 + shape[0] // 16, shape[1] // 4 : shape[1] // 4 + shape[0] // 16] = 1.0
        with wp.ScopedDevice(self.device):
            self.points = wp.array(surfaces.points, dtype=kernels.SurfacePoint)
            self.probes = wp.array(probes, dtype=structs.Probe)
            self.radiance = wp.full(shape, wp.vec3(1.0, 1.0, 1.0), dtype=wp.vec3)
            self.clipped = wp.array(clipped, dtype=wp.vec3)
            self.missing = wp.zeros(shape, dtype=wp.vec3)
            self.params = wp.array(params, dtype=structs.FrameParams)
            self.confidence = wp.full(shape, 1.0, dtype=wp.float32)
            self.recovered = wp.zeros(shape, dtype=wp.vec3)
            self.cells = wp.zeros(cell_shape(*shape), dtype=Cell)
            self.recovered = wp.zeros(self.cells.shape, dtype=wp.vec3)
            seen = np.zeros(count, np.dtype(kernels.Observation.numpy_dtype()))
            ink = surfaces.kinds[surfaces.surface] == Kind.INK
            seen["visible"], seen["radiance"] = 1.0, np.where(ink, 0.02, 0.25)[:, None]
            self.seen = wp.array(seen, dtype=kernels.Observation)
            self.transfer = wp.zeros((count, self.cells.size), dtype=wp.float32)
            self.mirrored = wp.zeros_like(self.transfer)
            self.traced = wp.zeros(count, dtype=wp.int32)
        self.solver = recovery.Recovery(surfaces, scene.marker.white, probe.center)

    def weigh(self) -> None:
        """Weigh the saturation boundaries."""
        weigh_boundaries(self.clipped, self.params, self.probes, self.missing)

    def condense(self) -> None:
        """Condense the map."""
        arrays = (self.radiance, self.confidence, self.clipped, self.missing, self.probes, self.scene, self.cells)
        condense_cells(*arrays, proxies=self.proxies)

    def trace(self) -> None:
        """Trace all surface points."""
        self.traced.zero_()
        arrays = (self.points, self.seen, self.cells, self.probes, self.scene)
        kernels.trace_transfer(*arrays, self.traced, self.transfer, self.mirrored, proxies=self.proxies)

    def add(self) -> None:
        """Apply recovered radiance."""
        add_recovered(self.radiance, self.confidence, self.missing, self.cells, self.recovered, self.recovered)

    def solve(self) -> Estimate:
        """Solve on the host, warm after the first call."""
        arrays = (array.numpy() for array in (self.cells, self.transfer, self.mirrored, self.seen))
        return self.solver.update(*arrays)


def check(setup: Setup) -> None:
    setup.weigh()
    setup.condense()
    setup.trace()
    setup.add()
    total = (setup.transfer.numpy() + setup.mirrored.numpy()).sum(axis=1).max()
    if abs(total / np.pi - 1.0) > 0.02 or not np.isfinite(setup.solve().recovered).all():
        raise AssertionError(f"the largest irradiance of a uniform environment is {total}, not pi")


def main(device: str) -> None:
    for height in HEIGHTS:
        setup = Setup(height, device)
        check(setup)
        for name in ("weigh", "condense", "trace", "add"):
            work = getattr(setup, name)
            report(f"recover/{name}/{height}", measure({name: work}, device)[name], device, points=len(setup.points))
        if wp.get_device(device).is_cpu:
            times = measure({"solve": setup.solve}, device)["solve"]
            report(f"recover/solve/{height}", times, device, points=len(setup.points))
