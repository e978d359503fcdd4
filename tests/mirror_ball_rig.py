"""A mirror ball on a desk before a camera, and what it mirrors."""

from __future__ import annotations

import math

import numpy as np
import warp as wp

from tests.kernel_rig import (
    TEXTURES,
    as_compiled,
    camera_fields,
    constant_environment,
    look_at,
    records,
    shape,
    tables,
    trace_of,
)
from tests.twins import color as reference_color
from warp_ar.kernels import color
from warp_ar.kernels.objects.reflect import DistantLight, DistantLightConfig
from warp_ar.kernels.objects.shade import ShadeConfig
from warp_ar.kernels.receiver import mirror_ball
from warp_ar.kernels.receiver.receiver import RelightConfig, make_receiver
from warp_ar.kernels.structs import (
    DIRECTIONAL,
    LAMBERT,
    PLANE,
    POINT,
    SPHERE,
    FrameParams,
    KeyLight,
    Light,
    Material,
    Probe,
    RayScene,
    Shape,
    make_picture,
)

H, W, FOCAL = 48, 64, 150.0
# Positions on what is mirrored carry 1e-7 of a metre, times the ball's curvature; lights are decimetres away.
FLOAT_ERROR = 1e-4
# What the prior gives a desk of reflectance 0.3 under irradiance pi / 2.
PRIOR = 3e-3
# Half a code of the frame at radiance 0.06, the darkest that is tried, and the prior.
HALF_CODE = 0.02
# Pixels by which a ray is moved to see whether it passes close to an edge.
NUDGE = 2e-3

EYE = np.array([0.02, -0.45, 0.3])
CENTER, RADIUS = np.array([0.0, 0.0, 0.06]), 0.06
POSE = look_at(EYE, CENTER)
X, Y = np.meshgrid((np.arange(W) - (W - 1) / 2) / FOCAL, (np.arange(H) - (H - 1) / 2) / FOCAL)
RAYS = np.stack([X, Y], -1).astype(np.float32)
RHO = (0.85, 0.8, 0.7)
BALL = {"center": CENTER, "radius": RADIUS, "reflectance": RHO}
KEY, DIRECTIONALITY = np.array([-0.48, 0.36, 0.8]), 0.7
ENVIRONMENT = np.array([0.8, 0.7, 0.5])


DESK = shape(PLANE, (0.0, 0.0, 0.0), (5.0, 5.0, 0.0))
BESIDE = shape(SPHERE, (0.11, -0.04, 0.04), (0.04,) * 3, 0)
CHALK = {"model": LAMBERT, "base_color": (0.9, 0.7, 0.4)}
LAMP = {"kind": POINT, "position": (-0.1, -0.15, 0.3), "intensity": (0.3, 0.2, 0.1), "attenuation": (0, 0, 1)}
SUN = {"kind": DIRECTIONAL, "direction": (0.0, 0.0, -1.0), "intensity": (0.9, 0.6, 0.3)}


def noise_frame(seed=0):
    return np.random.default_rng(seed).integers(60, 200, (H, W, 3)).astype(np.uint8)


def grey_frame(code=128):
    return np.full((H, W, 3), code, np.uint8)


def linear(frame):
    return reference_color.decode(color.decode_table("srgb"), frame)


def kinds(shapes):
    return tuple(sorted({one["kind"] for one in shapes}))


def even_light(light):
    """An environment of the same radiance everywhere."""
    surroundings = DistantLight()
    surroundings.irradiance_sh = wp.array(constant_environment(light), dtype=wp.vec3)
    surroundings.levels = wp.full(4096, wp.vec3(*map(float, light)), dtype=wp.vec3)
    surroundings.level_height = 8
    surroundings.dfg = wp.full((8, 8), wp.vec2(0.9, 0.05), dtype=wp.vec2)
    return surroundings


def run(
    frame=None,
    objects=(),
    proxies=(DESK,),
    balls=(BALL,),
    lights=(),
    materials=(CHALK,),
    ratio=None,
    samples=1,
    method="flat",
    pose=POSE,
    rays=RAYS,
    rect=(0, H, 0, W),
    rows=None,
    out=None,
    irradiance=None,
):
    """The change of radiance, (H, W, 3); objects are lit by ``lights`` and the even environment ``irradiance``."""
    frame = grey_frame() if frame is None else frame
    trace = trace_of(objects, proxies)
    models = tuple(sorted({one["model"] for one in materials}))
    lit = irradiance is not None
    forms = DistantLightConfig(trace, models, False, "sh" if lit else "none", lit, lit)
    shading = as_compiled(ShadeConfig(forms, kinds(lights), 1), form="sh", soft=False)
    config = mirror_ball.MirrorBallConfig(trace, shading, RelightConfig(method, trace, "sh"), ratio=True)
    inverse = pose.inverse()
    camera = camera_fields(inverse.translation, inverse.rotation, FOCAL, (H, W))
    params = records(FrameParams, {**camera, "ball_rect": rect})
    scene = RayScene()
    scene.objects, scene.proxies = records(Shape, *objects), records(Shape, *proxies)
    scene.materials = records(Material, *[{**dict.fromkeys(TEXTURES, -1), **one} for one in materials])
    receiver = make_receiver(
        config.relight,
        make_picture(wp.array(frame, dtype=wp.vec3ub), tables()[0], wp.array(rays, dtype=wp.vec2)),
        probes=records(Probe, *balls),
        key_lights=records(KeyLight, {"direction": KEY, "directionality": DIRECTIONALITY}),
        irradiance=wp.array(constant_environment(ENVIRONMENT), dtype=wp.vec3),
    )
    out = wp.full((H, W), wp.vec3(9.0, 9.0, 9.0), dtype=wp.vec3) if out is None else out
    surroundings = even_light(np.ones(3) if irradiance is None else irradiance)
    given = config, params, scene, records(Light, *lights), surroundings, receiver
    ratio = None if ratio is None else wp.array(ratio.astype(np.float32), dtype=wp.vec3)
    mirror_ball.mirror_ball(*given, ratio, math.isqrt(samples), out, rows=rows)
    return out.numpy()


def mirrored_rays(rays=RAYS, center=CENTER, radius=RADIUS):
    """Where a pixel's ray meets a ball and which way it goes then, and whether it does; (H, W, 3) and (H, W)."""
    inverse = POSE.inverse()
    d = np.concatenate([rays, np.ones_like(rays[..., :1])], -1).astype(float) @ inverse.rotation.T
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    to = inverse.translation - center
    b, c = d @ to, to @ to - radius**2
    hit = b * b > c
    t = -b - np.sqrt(np.where(hit, b * b - c, 0.0))
    normal = (to + t[..., None] * d) / radius
    return center + radius * normal, d - 2 * (d * normal).sum(-1, keepdims=True) * normal, hit


def on_desk(points, directions):
    """Where rays meet z = 0, and whether they do within the desk."""
    with np.errstate(divide="ignore", invalid="ignore"):
        met = points - directions * (points[..., 2:] / directions[..., 2:])
    down = (directions[..., 2] < 0) & (np.abs(np.nan_to_num(met)[..., :2]).max(-1) < 5.0)
    return met, down


POINTS, OUTWARD, ON_BALL = mirrored_rays()
MET, DOWN = on_desk(POINTS, OUTWARD)
# Beneath its widest circle the ball stands on the desk: both lie in each other's way there.
assert (ON_BALL & DOWN).sum() > 100
assert (ON_BALL & ~DOWN).sum() > 100
