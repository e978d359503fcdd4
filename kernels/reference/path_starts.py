"""Where paths start and end: a sample's random numbers, the camera's ray, what it meets, and what is written of it.

Both ways to follow paths, the loop of ``path_tracer`` and the kernels of ``path_wavefront``, begin and end them so.
"""

from __future__ import annotations

import warp as wp

from warp_ar.kernels.reference.path_following import ENDED, SURFACE, PathPair
from warp_ar.kernels.reference.path_learning import tile_of
from warp_ar.kernels.reference.path_samples import Round
from warp_ar.kernels.reference.path_sampling import NO_DENSITY, PathKey, sky_radiance
from warp_ar.kernels.reference.path_vertices import (
    BALL,
    NOTHING,
    OBJECT,
    PROXY,
    LocalScene,
    Vertex,
    is_glossy,
    is_turned,
)
from warp_ar.kernels.sampling import pcg3d_hash, uniform_from_bits
from warp_ar.kernels.structs import FrameParams

wp.set_module_options({"enable_backward": False})

WHOLE, DIFFERENCE, IRRADIANCE = 0, 1, 2
"""What is asked of pixels: radiance of the scene; what virtual content changes in the frame; or only what makes
reflectance known."""


@wp.func
def sample_key(samples: Round, k: wp.int32, seed: wp.int32, first: wp.int32, done: wp.array2d[wp.int32]) -> PathKey:
    """What makes the random numbers of sample ``k`` of a round its own."""
    pixel = samples.pixels[k]
    i = pixel / done.shape[1]
    j = pixel % done.shape[1]
    key = PathKey()
    key.pixel = wp.uint32(pixel)
    key.seed = wp.uint32(seed)
    key.sample = wp.uint32(first + done[i, j] + k - (samples.ends[pixel] - samples.counts[pixel]))
    return key


@wp.func
def camera_ray(params: FrameParams, rays: wp.array2d[wp.vec2], key: PathKey) -> wp.vec3:
    """Direction through a random point of a pixel, unit."""
    # A stream of its own: the vertices of the path use those from 0 on.
    bits = pcg3d_hash(key.pixel, key.sample, ~key.seed)
    pixel = wp.int32(key.pixel)
    ray = rays[pixel / rays.shape[1], pixel % rays.shape[1]]
    x = ray[0] + (uniform_from_bits(bits[0]) - 0.5) / params.focal[0]
    y = ray[1] + (uniform_from_bits(bits[1]) - 0.5) / params.focal[1]
    return wp.normalize(params.world_from_camera * wp.vec3(x, y, 1.0))


@wp.func
def begin_path(origin: wp.vec3, direction: wp.vec3, asked: wp.int32, lobe: wp.bool) -> PathPair:
    """A path on the camera's ray."""
    pair = PathPair()
    pair.path.throughput = wp.vec3(1.0, 1.0, 1.0)
    pair.path.origin = origin
    pair.path.direction = direction
    pair.path.density = NO_DENSITY
    pair.path.tile = -1
    pair.guided = -1
    pair.lobe = lobe
    pair.only_light = asked == wp.static(IRRADIANCE)
    return pair


@wp.func
def see(
    scene: LocalScene, asked: wp.int32, vertex: Vertex, pair: PathPair, k: wp.int32, samples_out: Round
) -> PathPair:
    """What the camera's ray meets: whether there is a path to follow; writes what needs none."""
    out = pair
    out.next = ENDED
    whole = asked == wp.static(WHOLE)
    z = wp.vec3(0.0, 0.0, 0.0)
    if whole and vertex.kind == NOTHING:
        z = sky_radiance(scene.sky, pair.path.direction, NO_DENSITY)
    elif whole or vertex.kind == OBJECT:
        out.next = wp.where(pair.only_light, ENDED, SURFACE)
    else:
        pixel = samples_out.pixels[k]
        z = scene.radiance[pixel / scene.radiance.shape[1], pixel % scene.radiance.shape[1]]
        out.path.changes_only = True
        # A face that is seen from behind is not the surface that the camera sees.
        if vertex.kind == PROXY and not is_turned(vertex, pair.path.direction):
            out.white = True
            out.glossy = is_glossy(scene, vertex)
            if scene.guides.learned.shape[0] > 0:
                out.path.tile = tile_of(samples_out.pixels[k], scene.radiance.shape[1])
            out.next = SURFACE
        elif vertex.kind == BALL and not pair.only_light:
            out.next = SURFACE
    if not pair.lobe:
        samples_out.z[k] = z
        samples_out.g[k] = wp.vec3(0.0, 0.0, 0.0)
        samples_out.e[k] = wp.vec3(0.0, 0.0, 0.0)
        samples_out.shows[k] = wp.where(out.white, 1.0, 0.0)
        samples_out.rays[k] = 0
        samples_out.bins[k] = -1
    return out


@wp.func
def write_sample(pair: PathPair, k: wp.int32, samples_out: Round):
    """Write what a path that has ended tells of its pixel, as ``add_sample`` takes it."""
    samples_out.rays[k] = samples_out.rays[k] + pair.rays
    if not pair.white or (pair.lobe and not pair.only_light):
        samples_out.z[k] = samples_out.z[k] + pair.radiance
    elif pair.lobe:
        samples_out.g[k] = pair.light  # what the frame shows mirrored
    else:
        samples_out.g[k] = pair.radiance
        samples_out.e[k] = pair.light
        samples_out.bins[k] = pair.guided
        if pair.guided >= 0:
            found = wp.abs(pair.radiance - pair.straight)
            mean = (found[0] + found[1] + found[2]) / 3.0
            samples_out.squares[k] = mean * mean * pair.drawn
