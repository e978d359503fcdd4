"""Virtual light on a desk of one plane and one box, 640x480, every method, light on the whole frame; cells; edges."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping

import numpy as np
import warp as wp

from bench.common import measure, report
from tests.kernel_rig import records, shape
from warp_ar.kernels import color
from warp_ar.kernels.edges import EdgeLists
from warp_ar.kernels.environment import environment_samples
from warp_ar.kernels.environment.environment_samples import EnvironmentSample
from warp_ar.kernels.launch import count_partials
from warp_ar.kernels.picture import summed_area
from warp_ar.kernels.rays.trace import TraceConfig
from warp_ar.kernels.receiver import receiver_cells, relight
from warp_ar.kernels.receiver.receiver import METHODS, ReceiverCells, RelightConfig, make_receiver
from warp_ar.kernels.structs import (
    BOX,
    PLANE,
    POINT,
    SPHERE,
    FrameParams,
    KeyLight,
    Light,
    Picture,
    Probe,
    RayScene,
    Shape,
    make_picture,
)

H, W = 480, 640


@dataclasses.dataclass(frozen=True)
class World:
    """What is relit."""

    device: str
    params: wp.array
    picture: Picture
    scene: RayScene
    lights: wp.array
    known: Mapping[str, wp.array]
    """What ``make_receiver`` takes beside the picture."""


def _cells(world: World, out: wp.array) -> dict[str, Callable[[], None]]:
    """Passes of the method ``bounce``, in their order, in a white environment."""
    device, trace = world.device, TraceConfig((SPHERE,), (PLANE, BOX))
    config = RelightConfig("reflectance", trace, "sh", True, ambient_visibility=True, bounced=True)
    place, ambient_stride, stride, patch_stride = receiver_cells.CellConfig(config), 4, 8, 16
    environment = wp.full((64, 128), wp.vec3(1.0, 1.0, 1.0), dtype=wp.vec3, device=device)
    cumulative = wp.zeros((64, 128), wp.float32, device=device)
    sums, samples = wp.zeros(64, wp.vec2, device=device), wp.zeros(1024, EnvironmentSample, device=device)
    unused = [wp.zeros(1024, wp.vec3, device=device) for _ in range(2)]
    environment_samples.sum_environment(environment, cumulative, sums)
    environment_samples.draw_samples(environment, cumulative, sums, wp.vec3(-0.1, 0.0, 0.04), *unused, samples)

    def grid(size: int, dtype: type) -> wp.array:
        return wp.zeros((-(-H // size), -(-W // size)), dtype, device=device)

    cells = ReceiverCells()
    cells.ambient_visibility, cells.ambient_surface = grid(ambient_stride, wp.vec3), grid(ambient_stride, wp.int32)
    cells.bounced, cells.bounced_surface = grid(stride, wp.vec3), grid(stride, wp.int32)
    cells.ambient_stride, cells.bounced_stride = ambient_stride, stride
    patches, listed = grid(patch_stride, receiver_cells.Patch), grid(patch_stride, receiver_cells.Patch)
    count = wp.zeros(patches.shape[0], wp.int32, device=device)
    receiver = make_receiver(config, world.picture, cells=cells, **world.known)
    inputs = world.params, world.scene, world.lights, receiver
    shape, on_cuda = cells.ambient_visibility.shape, wp.get_device(device).is_cuda
    partials = count_partials(*shape, receiver_cells.MAX_PARTIALS) if on_cuda else 1
    scratch = None
    if partials > 1:
        scratch = wp.zeros(receiver_cells.partial_sums_shape(partials, *shape), wp.vec3, device=device)
    passes: dict[str, Callable[[], None]] = {
        "ambient_visibility": lambda: receiver_cells.estimate_ambient_visibility(
            place, *inputs, samples[:128], cells, sums_out=scratch
        ),
        "send_light": lambda: receiver_cells.send_light(place, *inputs, patch_stride, patches),
        "list_patches": lambda: receiver_cells.list_patches(patches, listed, count),
        "gather_light": lambda: receiver_cells.gather_light(
            place, world.params, world.scene, receiver, listed, count, patch_stride, cells
        ),
        "bounce, with cells": lambda: relight.relight(config, *inputs, out),
    }
    for call in passes.values():
        call()
    on_desk, share = cells.ambient_surface.numpy() == 0, cells.ambient_visibility.numpy()
    assert on_desk.any()
    assert ((share[on_desk] > 0.4) & (share[on_desk] <= 1.0)).all(), "half is what grey paper leaves at least"
    assert share[on_desk].min() < 0.95, "the ball and the box hide some of the environment"
    assert 0.0 < cells.bounced.numpy()[cells.bounced_surface.numpy() >= 0].max() < 0.3 / 0.02
    return passes


def _edges(world: World) -> dict[str, Callable[[], None]]:
    """Edges at 4 and 16 samples: each pixel's one after another, or listed and side by side."""
    contenders: dict[str, Callable[[], None]] = {}
    device = world.device
    for samples in (4, 16):
        trace = TraceConfig((SPHERE,), (PLANE, BOX))
        config = RelightConfig("reflectance", trace, "sh", True, edge_samples=samples)
        visibility, out = wp.zeros((H, W), wp.int32, device=device), wp.zeros((H, W), wp.vec3, device=device)
        receiver = make_receiver(config, world.picture, **world.known)
        count = wp.zeros(1, wp.int32, device=device)
        edges = wp.zeros(H * W // 16, wp.vec2i, device=device)
        lists = EdgeLists.of(count, edges, wp.zeros(len(edges) * samples, wp.vec4, device=device))
        inputs = config, world.params, world.scene, world.lights, receiver
        relight.relight(*inputs, out, visibility)
        for name, own in (("in place", None), ("listed", lists)):
            call = functools.partial(relight.smooth_edges, *inputs, visibility, out, edge_lists=own)
            call()
            contenders[f"edges, {samples} samples, {name}"] = call
        assert 100 < int(count.numpy()[0]) < len(edges)
    return contenders


def main(device: str) -> None:
    columns, rows = np.meshgrid((np.arange(W) - W / 2) / 600, (np.arange(H) - H / 2) / 600)
    rays = wp.array(np.stack([columns, rows], -1), dtype=wp.vec2, device=device)
    frame = wp.array(np.random.default_rng(0).integers(60, 200, (H, W, 3)), dtype=wp.vec3ub, device=device)
    table = wp.zeros((H, W), wp.uint32, device=device)
    summed_area.sum_area(frame, table)
    look_down = np.diag([1.0, -1.0, -1.0])
    camera = {
        "camera_position": (0, 0, 0.6),
        "world_from_camera": look_down,
        "light_rect": (0, H, 0, W),
        "direct_rect": (0, H, 0, W),
    }
    params = records(FrameParams, {**camera, "focal": (600, 600)}, device=device)
    light = {"kind": POINT, "position": (0.1, 0.1, 0.3), "intensity": (0.3,) * 3, "attenuation": (0, 0, 1)}
    lights = records(Light, light, device=device)
    keys = records(KeyLight, {"direction": (0.6, 0, 0.8), "directionality": 0.5}, device=device)
    probes = records(Probe, {"center": (-0.1, 0, 0.04), "radius": 0.035}, device=device)
    scene = RayScene()
    scene.objects = records(Shape, shape(SPHERE, (0.05, 0, 0.05), (0.03, 0, 0)), device=device)
    scene.proxies = records(
        Shape, shape(PLANE, (0, 0, 0), (2, 2, 0)), shape(BOX, (0, 0.15, 0.05), (0.1, 0.04, 0.05)), device=device
    )
    sh = np.zeros((9, 3), np.float32)
    sh[0] = np.pi / 0.28209479
    surroundings = wp.array(sh, dtype=wp.vec3, device=device)
    decode = wp.array(color.decode_table("srgb"), dtype=wp.vec3, device=device)
    out = wp.zeros((H, W), wp.vec3, device=device)
    known = {"table": table, "probes": probes, "key_lights": keys, "irradiance": surroundings}
    world = World(device, params, make_picture(frame, decode, rays), scene, lights, known)
    contenders: dict[str, Callable[[], None]] = {}
    for method in METHODS:
        config = RelightConfig(method, TraceConfig((SPHERE,), (PLANE, BOX)), "sh", True)
        receiver = make_receiver(config, world.picture, **known)
        call = functools.partial(relight.relight, config, params, scene, lights, receiver, out)
        call()
        bright = 0.3 * 0.3 / (np.pi * (0.02 + 0.09) ** 1.5)  # a white desk at the frame's centre
        centre = out.numpy()[H // 2, W // 2]
        assert ((centre > 0.0) & (centre <= bright * 1.01)).all(), (method, centre)
        contenders[method] = call
    contenders |= _cells(world, out)
    contenders |= _edges(world)
    for method, times in measure(contenders, device).items():
        report(f"relight {W}x{H} {method}", times, device)
