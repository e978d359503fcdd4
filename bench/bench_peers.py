"""Side by side with other programs in one run; what is not installed is left out and said so.

Summed-area table: OpenCV (CPU), PyTorch and CuPy (CUDA) get the intensities ready-made, ours computes them from RGB.
Resampling: PyTorch's ``grid_sample`` gets ready-made coordinates. Rays: Embree, one thread each; OptiX through
Mitsuba's ``cuda_ad_rgb``, whose kernels are timed on the device. Unwrapping: skylibs on the host's processor.
"""

from __future__ import annotations

import functools
import importlib
import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any

import cv2
import numpy as np
import warp as wp

from bench.bench_unwrap import empty_scene
from bench.common import measure, paired_ratio, report
from warp_ar.kernels.color import decode_table
from warp_ar.kernels.environment import unwrap
from warp_ar.kernels.picture import summed_area
from warp_ar.kernels.picture.summed_area_strips import strip_shapes, sum_area_by_strips
from warp_ar.kernels.rays.wide_bvh import walk_closest
from warp_ar.kernels.structs import FrameParams, Probe, make_environment_view
from warp_ar.scene.ray_mesh import make_ray_mesh
from warp_ar.scene.shapes import torus_mesh

SIZES = {"480p": (480, 640), "1080p": (1080, 1920), "4K": (2160, 3840)}
RAYS = (480, 640)
RUNS = 50
BALL_RADIUS = 128
"""Pixels from the centre of the ball that is unwrapped to its edge."""
SAME_MAP = 0.02
"""Mean difference of two unwrapped maps of one smooth picture, of values up to 1: ours sees a ball at a distance of
500 radii, skylibs one from infinitely far; they round positions in a picture differently."""


def optional(name: str) -> Any | None:
    """A module, or None where it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError:
        print(f"{name} is not installed: left out", flush=True)
        return None


def in_turn(functions: Mapping[str, Callable[[], Callable[[], float]]]) -> dict[str, list[float]]:
    """Time contenders A B A B; each starts its work and returns what waits for it and gives milliseconds."""
    times: dict[str, list[float]] = {name: [] for name in functions}
    for run in range(RUNS + 5):
        for name, begin in functions.items():
            value = begin()()
            if run >= 5:
                times[name].append(value)
    return times


def with_warp(function: Callable[[], object], device: str) -> Callable[[], Callable[[], float]]:
    """Contender that replays a captured graph of ``function``."""
    function()
    with wp.ScopedCapture(device=device) as capture:
        function()
    begin, end = wp.Event(device, enable_timing=True), wp.Event(device, enable_timing=True)

    def start() -> Callable[[], float]:
        wp.record_event(begin)
        wp.capture_launch(capture.graph)
        wp.record_event(end)
        return lambda: wp.get_event_elapsed_time(begin, end)

    return start


def with_torch(torch: Any, function: Callable[[], object]) -> Callable[[], Callable[[], float]]:
    """Contender that replays a captured graph of ``function``."""
    side = torch.cuda.Stream()
    with torch.cuda.stream(side):
        for _ in range(3):
            function()
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        kept = function()
    begin, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)

    def start() -> Callable[[], float]:
        begin.record()
        graph.replay()
        end.record()

        def wait() -> float:
            torch.cuda.synchronize()
            assert kept is not None
            return float(begin.elapsed_time(end))

        return wait

    return start


def with_cupy(cupy: Any, function: Callable[[], object]) -> Callable[[], Callable[[], float]]:
    """Contender that is launched from Python, as CuPy's own scans cannot be captured everywhere."""
    begin, end = cupy.cuda.Event(), cupy.cuda.Event()

    def start() -> Callable[[], float]:
        begin.record()
        function()
        end.record()

        def wait() -> float:
            end.synchronize()
            return float(cupy.cuda.get_elapsed_time(begin, end))

        return wait

    return start


def bench_table_cuda(device: str) -> None:
    torch, cupy = optional("torch"), optional("cupy")
    for name, (height, width) in SIZES.items():
        values = np.random.default_rng(0).integers(0, 256, (height, width), dtype=np.uint8)
        exact = values.cumsum(0, dtype=np.uint32).cumsum(1, dtype=np.uint32)
        frame = wp.array(np.repeat(values[..., None], 3, axis=2), dtype=wp.vec3ub, device=device)
        table = wp.zeros((height, width), wp.uint32, device=device)
        scratch = [wp.zeros(s, wp.uint32, device=device) for s in strip_shapes(height, width)]
        sum_area_by_strips(frame, *scratch, table)
        np.testing.assert_array_equal(table.numpy(), exact)
        # A plain copy that reads and writes as many bytes as the table must: 3 + 4 per pixel.
        half = height * width * 7 // 2
        source, target = (wp.zeros(half, wp.uint8, device=device) for _ in range(2))
        contenders = {
            "strips": with_warp(functools.partial(sum_area_by_strips, frame, *scratch, table), device),
            "copy": with_warp(functools.partial(wp.copy, target, source), device),
            "rows_columns": with_warp(functools.partial(summed_area.sum_area, frame, table), device),
        }
        if torch is not None:
            gray = torch.from_numpy(values).cuda()

            def double_cumsum(gray: Any = gray) -> Any:
                return gray.cumsum(0, dtype=torch.int32).cumsum(1, dtype=torch.int32)

            np.testing.assert_array_equal(double_cumsum().cpu().numpy().view(np.uint32), exact)
            contenders["torch"] = with_torch(torch, double_cumsum)
        if cupy is not None:
            codes = cupy.asarray(values)

            def scan(codes: Any = codes) -> Any:
                return cupy.cumsum(cupy.cumsum(codes, 0, dtype=cupy.uint32), 1, dtype=cupy.uint32)

            np.testing.assert_array_equal(cupy.asnumpy(scan()), exact)
            contenders["cupy"] = with_cupy(cupy, scan)
        times = in_turn(contenders)
        start = time.perf_counter()
        for _ in range(10):
            cv2.integral(values)
        times["cv2_host"] = [(time.perf_counter() - start) * 100.0]
        for contender, measured in times.items():
            ratio = statistics.median(measured) / statistics.median(times["copy"])
            report(f"table {name} {contender}", measured, device, over_copy=round(ratio, 2))


def bench_table_cpu(device: str) -> None:
    for name, (height, width) in SIZES.items():
        values = np.random.default_rng(0).integers(0, 256, (height, width), dtype=np.uint8)
        frame = wp.array(np.repeat(values[..., None], 3, axis=2), dtype=wp.vec3ub, device=device)
        rgb = frame.numpy()
        table = wp.zeros((height, width), wp.uint32, device=device)
        cv2.setNumThreads(1)
        contenders = {
            "ours": lambda frame=frame, table=table: summed_area.sum_area(frame, table),
            "cv2_ready_gray": lambda values=values: cv2.integral(values),
            "cv2_from_rgb": lambda rgb=rgb: cv2.integral(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)),
        }
        times = measure(contenders, device)
        for contender, measured in times.items():
            report(
                f"table {name} {contender}",
                measured,
                device,
                over_ours=round(paired_ratio(times, contender, "ours"), 2),
            )


def bench_resample_cuda(device: str) -> None:
    torch = optional("torch")
    if torch is None:
        return
    for name, (height, width) in SIZES.items():
        rng = np.random.default_rng(0)
        image = rng.random((height, width, 3), dtype=np.float32)
        rows, columns = np.meshgrid(np.linspace(0.3, 0.7, 512), np.linspace(0.3, 0.7, 1024), indexing="ij")
        grid = np.stack([columns * 2 - 1, rows * 2 - 1], -1).astype(np.float32)
        source = torch.from_numpy(image).permute(2, 0, 1)[None].contiguous().cuda()
        at = torch.from_numpy(grid)[None].cuda()
        contender = with_torch(torch, lambda source=source, at=at: torch.nn.functional.grid_sample(source, at))
        picture = wp.array(image, dtype=wp.vec3, device=device)
        places = wp.array(grid, dtype=wp.vec2, device=device)
        out = wp.zeros(grid.shape[:2], dtype=wp.vec3, device=device)

        def ours(picture: Any = picture, places: Any = places, out: Any = out) -> None:
            wp.launch(resample_kernel, out.shape, [picture, places], [out], device=device)

        ours()
        theirs = torch.nn.functional.grid_sample(source, at)[0].permute(1, 2, 0).cpu().numpy()
        np.testing.assert_allclose(out.numpy(), theirs, atol=1e-3)
        times = in_turn({"ours": with_warp(ours, device), "torch": contender})
        for key, measured in times.items():
            report(f"resample 1024x512 from {name} {key}", measured, device)


@wp.kernel(enable_backward=False)
def resample_kernel(picture: wp.array2d[wp.vec3], places: wp.array2d[wp.vec2], out: wp.array2d[wp.vec3]):
    """Bilinear samples at places in -1..1, as ``grid_sample`` takes them."""
    i, j = wp.tid()
    height = picture.shape[0]
    width = picture.shape[1]
    x = ((places[i, j][0] + 1.0) * wp.float32(width) - 1.0) * 0.5
    y = ((places[i, j][1] + 1.0) * wp.float32(height) - 1.0) * 0.5
    c = wp.int32(wp.floor(x))
    r = wp.int32(wp.floor(y))
    fx = x - wp.floor(x)
    fy = y - wp.floor(y)
    top = wp.lerp(picture[r, c], picture[r, c + 1], fx)
    bottom = wp.lerp(picture[r + 1, c], picture[r + 1, c + 1], fx)
    out[i, j] = wp.lerp(top, bottom, fy)


@wp.kernel(enable_backward=False)
def trace_kernel(mesh: wp.uint64, origin: wp.vec3, directions: wp.array2d[wp.vec3], depth_out: wp.array2d[wp.float32]):
    """Closest hit of each ray, by Warp's own tree."""
    i, j = wp.tid()
    query = wp.mesh_query_ray(mesh, origin, directions[i, j], 1.0e3)
    depth_out[i, j] = wp.where(query.result, query.t, -1.0)


@wp.kernel(enable_backward=False)
def walk_kernel(tree: wp.uint64, origin: wp.vec3, directions: wp.array2d[wp.vec3], depth_out: wp.array2d[wp.float32]):
    """Closest hit of each ray, by the tree for CPUs."""
    i, j = wp.tid()
    near = walk_closest(tree, origin, directions[i, j], 1.0e3)
    depth_out[i, j] = wp.where(near[0] < 1.0e3, near[0], -1.0)


def bench_unwrap(device: str) -> None:
    envmap = optional("envmap")
    if envmap is None:
        return
    size, distance = 2 * BALL_RADIUS, 500.0
    focal = BALL_RADIUS * np.sqrt(distance**2 - 1.0)
    rng = np.random.default_rng(0)
    smooth = cv2.resize(rng.integers(0, 256, (8, 8, 3), dtype=np.uint8), (size, size), interpolation=cv2.INTER_CUBIC)
    params = np.zeros(1, np.dtype(FrameParams.numpy_dtype()))
    params["camera_position"], params["world_from_camera"] = (distance, 0, 0), [[0, 0, -1], [1, 0, 0], [0, -1, 0]]
    params["focal"], params["principal"] = focal, (size - 1) / 2
    ball = np.zeros(1, np.dtype(Probe.numpy_dtype()))
    ball["radius"], ball["reflectance"] = 1.0, 1.0
    x, y = np.meshgrid(*2 * [np.arange(size) - (size - 1) / 2])
    with wp.ScopedDevice(device):
        scene, config = empty_scene(0), unwrap.ProjectConfig(())
        params, ball = wp.array(params, dtype=FrameParams), wp.array(ball, dtype=Probe)
        rays = wp.array(np.stack([x, y], -1) / focal, dtype=wp.vec2)
        table, frame = wp.array(decode_table("linear"), dtype=wp.vec3), wp.array(smooth, dtype=wp.vec3ub)
        for height in (64, 128):
            shape = (height, 2 * height)
            corners = wp.zeros((shape[0] + 1, shape[1] + 1, 1), dtype=wp.vec3)
            radiance, clipped = (wp.zeros(shape, dtype=wp.vec3) for _ in range(2))
            confidence = wp.zeros(shape, dtype=wp.float32)

            view = make_environment_view(radiance, confidence, clipped)

            def ours(corners=corners, view=view) -> None:
                unwrap.project_corners(params, ball, rays, scene, corners, config=config)
                unwrap.gather_probe(frame, table, ball, corners, view, method="bilinear")

            def theirs(height=height) -> Any:
                return envmap.EnvironmentMap(smooth / np.float32(255), "sphere").convertTo("latlong", height).data

            ours()
            known = confidence.numpy() > 0.5
            assert known.mean() > 0.5
            assert np.abs(radiance.numpy() - theirs())[known].mean() < SAME_MAP
            times = measure({"ours": ours}, device)["ours"]
            hosts = []
            for _ in range(RUNS):
                start = time.perf_counter()
                theirs()
                hosts.append((time.perf_counter() - start) * 1e3)
            label = f"unwrap {height}x{2 * height}"
            report(f"{label} ours", times, device)
            ratio = round(statistics.median(hosts) / statistics.median(times), 1)
            report(f"{label} skylibs_host", hosts, device, over_ours=ratio)


def optix_rays(mitsuba: Any, mesh: Any, center: Any, directions: np.ndarray) -> tuple[np.ndarray, list[float]]:
    """Which rays hit, and milliseconds of the kernel that traces them, by Mitsuba's own clock of the device."""
    drjit = importlib.import_module("drjit")
    shape = mitsuba.Mesh("mesh", len(mesh.vertices), len(mesh.faces))
    parameters = mitsuba.traverse(shape)
    parameters["vertex_positions"] = mitsuba.Float((mesh.vertices - np.asarray(center)).astype(np.float32).ravel())
    parameters["faces"] = mitsuba.UInt32(mesh.faces.astype(np.uint32).ravel())
    parameters.update()
    scene = mitsuba.load_dict({"type": "scene", "mesh": shape})
    flat = np.ascontiguousarray(directions.reshape(-1, 3).T)
    ray = mitsuba.Ray3f(mitsuba.Point3f(0.0, 0.0, -1.2), mitsuba.Vector3f(*(mitsuba.Float(axis) for axis in flat)))
    drjit.eval(ray)
    times = []
    with drjit.scoped_set_flag(drjit.JitFlag.KernelHistory, True):
        for run in range(RUNS + 5):
            drjit.kernel_history_clear()
            depth = scene.ray_intersect_preliminary(ray, coherent=True).t
            drjit.eval(depth)
            drjit.sync_thread()
            kernels = drjit.kernel_history([drjit.KernelType.JIT])
            assert kernels, "a run without a kernel has traced nothing"
            if run >= 5:
                times.append(sum(entry["execution_time"] for entry in kernels))
    return np.isfinite(np.array(depth)), times


def bench_rays(device: str) -> None:
    mitsuba = None if wp.get_device(device).is_cpu else optional("mitsuba")
    if mitsuba is not None:
        mitsuba.set_variant("cuda_ad_rgb")
    embree = optional("embreex") if wp.get_device(device).is_cpu else None
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, RAYS[1]), np.linspace(-0.375, 0.375, RAYS[0]))
    directions = np.stack([x, y, np.ones_like(x)], -1).astype(np.float32)
    origin = wp.vec3(0.0, 0.0, -1.2)
    for tolerance in (1e-3, 1e-5, 3e-6):
        torus = torus_mesh(0.3, 0.12, tolerance)
        mesh = make_ray_mesh(torus, device)
        rays = wp.array(directions, dtype=wp.vec3, device=device)
        depth = wp.zeros(RAYS, dtype=wp.float32, device=device)

        def by_warp(mesh: Any = mesh, rays: Any = rays, depth: Any = depth) -> None:
            wp.launch(trace_kernel, RAYS, [mesh.mesh.id, origin, rays], [depth], device=device)

        def by_walk(mesh: Any = mesh, rays: Any = rays, depth: Any = depth) -> None:
            wp.launch(walk_kernel, RAYS, [mesh.tree_address, origin, rays], [depth], device=device)

        by_warp()
        hit = depth.numpy() >= 0.0
        contenders: dict[str, Callable[[], object]] = {"ours": by_warp}
        if mesh.tree is not None:
            by_walk()
            assert ((depth.numpy() >= 0.0) == hit).all()
            # The best tree that Warp builds for a CPU: that of the mesh itself is not meant to be walked.
            walked = wp.Mesh(mesh.mesh.points, mesh.mesh.indices, bvh_constructor="sah", bvh_leaf_size=4)

            def by_sah(mesh: Any = walked, rays: Any = rays, depth: Any = depth) -> None:
                wp.launch(trace_kernel, RAYS, [mesh.id, origin, rays], [depth], device=device)

            contenders = {"ours": by_walk, "warp": by_sah}
        if embree is not None:
            scenes = importlib.import_module("embreex.rtcore_scene")
            meshes = importlib.import_module("embreex.mesh_construction")
            scene = scenes.EmbreeScene()
            triangles = (torus.vertices[torus.faces] - mesh.center).astype(np.float32)
            meshes.TriangleMesh(scene, triangles)
            start = np.tile(np.array([[0.0, 0.0, -1.2]], np.float32), (directions.size // 3, 1))
            flat = np.ascontiguousarray(directions.reshape(-1, 3))
            found = scene.run(start, flat).reshape(RAYS) >= 0
            assert (found == hit).mean() > 0.999
            contenders["embree"] = lambda scene=scene, start=start, flat=flat: scene.run(start, flat)
        times = measure(contenders, device, RUNS)
        if mitsuba is not None:
            found, times["optix"] = optix_rays(mitsuba, torus, mesh.center, directions)
            assert (found == hit.ravel()).mean() > 0.999
        for name, measured in times.items():
            rate = directions.size / 3 / statistics.median(measured) / 1e3
            ratio = round(paired_ratio(times, name, "ours"), 2)
            faces = len(torus.faces)
            report(f"rays {faces} triangles {name}", measured, device, mrays=round(rate, 1), over_ours=ratio)


def main(device: str) -> None:
    if wp.get_device(device).is_cpu:
        bench_table_cpu(device)
    else:
        bench_table_cuda(device)
        bench_resample_cuda(device)
    bench_unwrap(device)
    bench_rays(device)
