"""Primary rays of a 640x480 frame in which one object covers a twentieth or a quarter of the picture."""

from __future__ import annotations

import numpy as np
import warp as wp

from bench.common import measure, report
from warp_ar.kernels import structs
from warp_ar.kernels.rays.trace import TraceConfig
from warp_ar.kernels.rays.visibility import make_visible, trace_pixels
from warp_ar.kernels.structs import Hit
from warp_ar.scene.ray_mesh import make_ray_mesh
from warp_ar.scene.shapes import torus_mesh

H, W = 480, 640
FOCAL = 600.0

# (kind, share of the picture)
CASES = (("sphere", 0.05), ("mesh", 0.05), ("mesh", 0.25))


class Frame:
    """A object at depth 1 that covers a share of the picture, and the arrays of a frame."""

    def __init__(self, kind: str, share: float, device: str) -> None:
        # A ball covers pi (f tan)^2 pixels; a torus with a tube of half its radius, seen along its axis, 8/9 of that.
        tangent = np.sqrt(share * H * W / np.pi) / FOCAL
        radius = float(np.sin(np.arctan(tangent)))
        record = np.zeros(1, np.dtype(structs.Shape.numpy_dtype()))
        record["rotation"], record["scale"], record["position"], record["smooth"] = np.eye(3), 1.0, (0, 0, 1), 1
        record["kind"], record["extent"] = structs.SPHERE, radius
        normals, uvs = np.zeros((0, 3), np.float32), np.zeros((0, 2), np.float32)
        if kind == "mesh":
            self.mesh = make_ray_mesh(torus_mesh(radius * 2 / 3, radius / 3, radius * 3e-4), device)
            record["kind"], record["extent"] = structs.MESH, self.mesh.half
            record["mesh"], record["tree"] = self.mesh.mesh.id, self.mesh.tree_address
            normals, uvs = self.mesh.normals, self.mesh.uvs
        self.config = TraceConfig((int(record["kind"][0]),), ())
        self.scene = structs.RayScene()
        self.scene.objects = wp.array(record, dtype=structs.Shape, device=device)
        self.scene.vertex_normals = wp.array(normals, dtype=wp.vec3, device=device)
        self.scene.vertex_uvs = wp.array(uvs, dtype=wp.vec2, device=device)
        reach = int(np.ceil(FOCAL * tangent)) + 2
        self.rows = (H // 2 - reach, H // 2 + reach)
        params = np.zeros(1, np.dtype(structs.FrameParams.numpy_dtype()))
        params["world_from_camera"], params["focal"] = np.eye(3), FOCAL
        params["object_rect"] = (*self.rows, W // 2 - reach, W // 2 + reach)
        self.params = wp.array(params, dtype=structs.FrameParams, device=device)
        x, y = np.meshgrid((np.arange(W) - 319.5) / FOCAL, (np.arange(H) - 239.5) / FOCAL)
        self.rays = wp.array(np.stack([x, y], -1).astype(np.float32), dtype=wp.vec2, device=device)
        self.found = wp.full((H, W), -1, dtype=wp.int32, device=device)
        self.hits = wp.zeros((H, W), dtype=Hit, device=device)
        # As the pipeline runs it: on CPU over the rows that matter, on CUDA over the frame.
        self.launch_rows = self.rows if device == "cpu" else None

    def trace(self) -> None:
        """Trace the frame's rows."""
        inputs = (self.params, self.rays, self.scene, make_visible(self.found, self.hits))
        trace_pixels(self.config, *inputs, rows=self.launch_rows)


def main(device: str) -> None:
    for kind, share in CASES:
        frame = Frame(kind, share, device)
        frame.trace()
        covered = float((frame.found.numpy() >= 0).mean())
        expected = share * (8 / 9 if kind == "mesh" else 1.0)
        assert abs(covered / expected - 1) < 0.1, (kind, covered, expected)
        depth = frame.hits.numpy()["t"][frame.found.numpy() >= 0]
        assert np.isfinite(depth).all()
        report(
            f"visibility {W}x{H} {kind} covering {share:.0%}", measure({"ours": frame.trace}, device)["ours"], device
        )
