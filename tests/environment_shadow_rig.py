"""Environments and their samples, and shadows that virtual objects throw in them."""

import numpy as np
import warp as wp

from tests.kernel_rig import (
    TEXTURES,
    as_compiled,
    camera_fields,
    constant_environment,
    records,
    shape,
    tables,
    trace_of,
)
from tests.relight_rig import CAMERA, DESK, LOOK_DOWN, RAYS, H, W
from warp_ar.kernels.environment import environment_samples
from warp_ar.kernels.environment.environment_samples import EnvironmentSample, SampleSets
from warp_ar.kernels.objects.reflect import DistantLight, DistantLightConfig
from warp_ar.kernels.receiver import environment_shadow, environment_shadow_filter
from warp_ar.kernels.receiver.environment_shadow import EnvironmentShadowConfig, ShadowCells, ShadowQueue
from warp_ar.kernels.structs import (
    LAMBERT,
    MESH,
    SPHERE,
    Emitter,
    FrameParams,
    Material,
    Probe,
    RayScene,
    Shape,
    make_picture,
)
from warp_ar.scene.ray_scene import HostScene

COUNT, SIDE = 64, 4
# Turn of the only ball.
ONE_BALL = 0, 1
ORIGIN = (0.0, 0.0, 0.035)
# Sums of float32 over up to 2048 terms of like size.
SUM_ERROR = 2e-5
# Rays that pass a sphere's rim nearer than this share of its radius may fall on either side of it.
RIM = 1e-3
# 1024 stratified samples of a smooth integrand: far below the 1 / sqrt 1024 of independent ones.
STRATIFIED = 0.01
# One set has 64 samples, of which half follow the light: a step of its visibility is 1/32, a few of them its error.
SET_ERROR = 0.12
# Mean over all pixels: 192 tiles of all 1024 samples each.
MEAN_ERROR = 2e-3


def draw(environment, count=COUNT * SIDE * SIDE):
    environment = np.asarray(environment, np.float32)
    height, width = environment.shape[:2]
    cumulative, sums = wp.zeros((height, width), wp.float32), wp.zeros(height, wp.vec2)
    directions, flux = wp.zeros(count, wp.vec3), wp.zeros(count, wp.vec3)
    samples = wp.zeros(count, EnvironmentSample)
    source = wp.array(environment, dtype=wp.vec3)
    environment_samples.sum_environment(source, cumulative, sums)
    environment_samples.draw_samples(source, cumulative, sums, wp.vec3(*ORIGIN), ONE_BALL, directions, flux, samples)
    return directions, flux, samples


def list_texels(environment):
    environment = np.asarray(environment, np.float32)
    count = environment.shape[0] * environment.shape[1]
    out = wp.zeros(count, wp.vec3), wp.zeros(count, wp.vec3), wp.zeros(count, EnvironmentSample)
    environment_samples.list_texels(wp.array(environment, dtype=wp.vec3), wp.vec3(*ORIGIN), ONE_BALL, *out)
    return out


def sky(radiance=1.0, size=(32, 64)):
    return np.full((*size, 3), radiance, np.float32)


def with_sun(row, column, radiance, environment=None):
    environment = sky() if environment is None else environment
    environment[row, column] = radiance
    return environment


def sphere(center, radius):
    return shape(SPHERE, center, (radius, 0, 0))


def shadow_cells(shape, stride=1):
    """Cells with nothing in them yet."""
    cells = ShadowCells()
    cells.stride = stride
    cells.ratio, cells.bounced = wp.zeros(shape, wp.vec4), wp.zeros(shape, wp.vec3)
    cells.surface, cells.filtered = wp.full(shape, 7, wp.int32), wp.zeros(shape, wp.vec3)
    return cells


def run(
    drawn,
    objects=(),
    proxies=(DESK,),
    probes=(),
    count=COUNT,
    side=SIDE,
    stride=1,
    bounce="estimated",
    secondary=1.0,
    albedo=0.0,
    rect=(0, H, 0, W),
    rows=None,
    filtered=True,
    out=None,
    emitters=False,
    partials=1,
    queued=False,
    others=None,
    loaded=None,
    single_sided=0,
):
    """Shade a desk; ``loaded`` is a scene whose objects are there in place of ``objects``."""
    several = others is not None
    trace = trace_of(objects, proxies) if loaded is None else trace_of([{"kind": MESH}], proxies, detail=True)
    forms = as_compiled(DistantLightConfig(trace, (LAMBERT,), False, "sh", False, True, several=several), form="sh")
    config = EnvironmentShadowConfig(forms, count, side, bounce, secondary, emitters, partials, queued)
    camera = camera_fields(CAMERA, LOOK_DOWN, 60, (H, W))
    params = records(FrameParams, {**camera, "shadow_rect": rect})
    scene = RayScene()
    if loaded is None:
        objects = [{**item, "material": 0} for item in objects]
        scene.objects = records(Shape, *objects)
    else:
        host = HostScene(loaded, wp.get_device())  # holds the meshes
        scene = host.ray_scene
    material = {"model": LAMBERT, "base_color": (albedo,) * 3, "single_sided": single_sided}
    scene.materials = records(Material, {**material, **dict.fromkeys(TEXTURES, -1)})
    scene.proxies = records(Shape, *proxies)
    surroundings = DistantLight()
    surroundings.environment = wp.array(sky(), dtype=wp.vec3)
    surroundings.probes = records(Probe, *probes)
    surroundings.irradiance_sh = wp.array(constant_environment(1.0), dtype=wp.vec3)
    if several:
        surroundings.others = others
    frame = wp.full((H, W), wp.vec3ub(255, 255, 255), dtype=wp.vec3ub)
    shape = -(-H // stride), -(-W // stride)
    cells = shadow_cells(shape, stride)
    rays = wp.array(RAYS, dtype=wp.vec2)
    queue = environment_shadow.make_queue(config, *shape, rays.device) if queued else None
    assert queued == (queue is not None)
    picture = make_picture(frame, tables()[0], rays)
    sets = SampleSets()
    sets.directions, sets.flux, sets.samples = drawn
    given = params, picture, scene, surroundings, sets
    if queue is None:
        environment_shadow.shade_environment(config, *given, cells, ShadowQueue(), rows=rows)
    else:
        environment_shadow.shade_by_queue(config, *given, cells, queue)
    if not filtered:
        return cells.ratio.numpy()[..., :3], cells.surface.numpy()
    out = wp.full((H, W), wp.vec3(9.0, 9.0, 9.0), dtype=wp.vec3) if out is None else out
    environment_shadow_filter.filter_ratio(config, cells, rows=rows)
    environment_shadow_filter.spread_ratio(config, params, rays, scene, surroundings.probes, cells, out)
    return out.numpy()


def lamp_at(*positions, origin=ORIGIN):
    """Records of lamps at positions in the world, and an unused one; None stands for a distant lamp straight up."""
    values = []
    for at in positions:
        offset = np.array([0, 0, 1.0]) if at is None else np.asarray(at) - origin
        distance = np.linalg.norm(offset)
        far = np.inf if at is None else distance
        values.append({"origin": origin, "direction": offset / distance, "distance": far})
    return records(Emitter, *values, {})
