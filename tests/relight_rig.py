"""A camera above a desk that virtual light falls on."""

import numpy as np
import warp as wp

from tests.kernel_rig import constant_environment, records, shape, tables, trace_of
from tests.twins import relight as reference
from warp_ar.kernels.edges import EdgeLists
from warp_ar.kernels.receiver import relight
from warp_ar.kernels.receiver.receiver import RelightConfig, make_receiver
from warp_ar.kernels.structs import PLANE, POINT, FrameParams, KeyLight, Light, Probe, RayScene, Shape, make_picture

H, W = 48, 64
# Points on the desk are computed in float32, 1e-7 of a metre or so; lights are decimetres away and 1/d^2 doubles that.
FLOAT_ERROR = 2e-5
# What the prior takes from a white desk under irradiance pi: half of 0.002.
PRIOR = 1.1e-3
# Half a code is at most this share of the darkest radiance tested, 0.03 (code 48); the prior is the rest.
HALF_CODE = 0.03
# Shadow rays that pass a sphere's rim nearer than this share of its radius may fall on either side.
RIM = 1e-3

# A camera 0.6 m above the desk that looks straight down: x right, y down the picture is -y in the world.
LOOK_DOWN = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
CAMERA = np.array([0.0, 0.0, 0.6])
COLUMNS, ROWS = np.meshgrid((np.arange(W) - (W - 1) / 2) / 60, (np.arange(H) - (H - 1) / 2) / 60)
RAYS = np.stack([COLUMNS, ROWS], -1).astype(np.float32)
POINTS = reference.plane_points(CAMERA, RAYS, LOOK_DOWN)


def turn_z(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


DESK = shape(PLANE, (0, 0, 0), (5, 5, 0))


def point(at, intensity=(0.3, 0.3, 0.3), **more):
    return {"kind": POINT, "position": at, "intensity": intensity, "attenuation": (0, 0, 1), **more}


def run(
    method,
    lights,
    frame=None,
    objects=(),
    proxies=(DESK,),
    probes=(),
    key=((0, 0, 1), 0.0),
    sh=None,
    irradiance_map=None,
    rect=(0, H, 0, W),
    out=None,
    rows=None,
    linear=None,
    others=None,
):
    frame = np.full((H, W, 3), 128, np.uint8) if frame is None else frame
    config = RelightConfig(
        method,
        trace_of(objects, proxies),
        "sh" if irradiance_map is None else "map",
        several=others is not None,
    )
    params = records(FrameParams, {"camera_position": CAMERA, "world_from_camera": LOOK_DOWN, "light_rect": rect})
    scene = RayScene()
    scene.objects, scene.proxies = records(Shape, *objects), records(Shape, *proxies)
    frame_array = wp.array(frame, dtype=wp.vec3ub)
    keys = records(KeyLight, {"direction": key[0], "directionality": key[1]})
    surroundings = wp.array(constant_environment((1, 1, 1)) if sh is None else sh, dtype=wp.vec3)
    if irradiance_map is not None:
        surroundings = wp.array(irradiance_map, dtype=wp.vec3)
    out = wp.full((H, W), wp.vec3(9.0, 9.0, 9.0), dtype=wp.vec3) if out is None else out
    receiver = make_receiver(
        config,
        make_picture(
            frame_array,
            tables()[0],
            wp.array(RAYS, dtype=wp.vec2),
            None if linear is None else wp.array(np.float32(linear), dtype=wp.vec3),
        ),
        probes=records(Probe, *probes),
        key_lights=keys,
        irradiance=surroundings,
        others=others,
    )
    relight.relight(config, params, scene, records(Light, *lights), receiver, out, None, rows=rows)
    return out.numpy()


def run_edges(
    samples,
    lights,
    objects=(),
    proxies=(DESK,),
    probes=(),
    rect=(0, H, 0, W),
    detail=1,
    soft=False,
    rows=None,
    listed=0,
):
    """``relight`` on a white desk in a white environment, and ``smooth_edges`` where samples are more than one.

    ``detail`` times as many pixels along each axis see the same view.
    """
    height, width = H * detail, W * detail
    columns, lines = np.meshgrid(
        (np.arange(width) - (width - 1) / 2) / (60 * detail), (np.arange(height) - (height - 1) / 2) / (60 * detail)
    )
    config = RelightConfig("reflectance", trace_of(objects, proxies), "sh", soft=soft, edge_samples=samples)
    place = {"camera_position": CAMERA, "world_from_camera": LOOK_DOWN, "light_rect": rect, "focal": (60, 60)}
    params = records(FrameParams, place)
    scene = RayScene()
    scene.objects, scene.proxies = records(Shape, *objects), records(Shape, *proxies)
    frame = wp.full((height, width), wp.vec3ub(255, 255, 255), dtype=wp.vec3ub)
    keys = records(KeyLight, {"direction": (0, 0, 1), "directionality": 0.0})
    rays = wp.array(np.stack([columns, lines], -1).astype(np.float32), dtype=wp.vec2)
    receiver = make_receiver(
        config,
        make_picture(frame, tables()[0], rays),
        probes=records(Probe, *probes),
        key_lights=keys,
        irradiance=wp.array(constant_environment((1, 1, 1)), dtype=wp.vec3),
    )
    inputs = config, params, scene, records(Light, *lights), receiver
    out, visibility = wp.zeros((height, width), dtype=wp.vec3), wp.zeros((height, width), dtype=wp.int32)
    relight.relight(*inputs, out, visibility)
    if samples > 1:
        lists = None
        if listed:
            sizes = ((1, wp.int32), (listed, wp.vec2i), (listed * samples, wp.vec4))
            lists = EdgeLists.of(*(wp.zeros(size, dtype=kind) for size, kind in sizes))
        for band in rows or (None,):
            relight.smooth_edges(*inputs, visibility, out, edge_lists=lists, rows=band)
    return out.numpy()


def pixel_means(image, detail):
    return image.reshape(H, detail, W, detail, 3).mean((1, 3))


def noise_frame(low=60, high=200, seed=0):
    return np.random.default_rng(seed).integers(low, high, (H, W, 3)).astype(np.uint8)


def unit(*v):
    return np.asarray(v) / np.linalg.norm(v)
