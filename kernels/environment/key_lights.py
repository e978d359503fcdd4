"""The dominant direction of the environment: the paper's "brightest physical lighting vector".

With V = integral of L d over directions d (vector irradiance) and phi = integral of L (scalar irradiance), a surface
with normal n receives, by the first two bands of the cosine lobe (pi and 2 pi / 3),

    E(n) = phi / 4 + n . V / 2.

So a surface that faces s = V / |V| receives most, and the relative difference between surfaces toward and away from s,

    (E(s) - E(-s)) / (E(s) + E(-s)) = 2 |V| / phi,

is the directionality. It is 0 in a uniform environment and between two equal opposite lights, and 1 (clamped) for a sun
and for a bright hemisphere in a black environment. Both values are means over all directions, so they change smoothly
when another light becomes the strongest.
"""

from __future__ import annotations

import warp as wp

from warp_ar.kernels.color import luminance
from warp_ar.kernels.latlong import direction_from_latlong, texel_solid_angle
from warp_ar.kernels.launch import launch
from warp_ar.kernels.structs import KeyLight

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def sum_rows_kernel(
    # In:
    environment: wp.array2d[wp.vec3],
    # Out:
    sums_out: wp.array[wp.vec4],  # luminance times direction, and luminance, over the row's solid angle
):
    """Sum luminance, and luminance times direction, over one row of the environment."""
    i = wp.tid()
    height = environment.shape[0]
    width = environment.shape[1]
    total = wp.vec4(0.0, 0.0, 0.0, 0.0)
    for j in range(width):
        at = direction_from_latlong(wp.float32(i) + 0.5, wp.float32(j) + 0.5, height, width)
        total += luminance(environment[i, j]) * wp.vec4(at[0], at[1], at[2], 1.0)
    sums_out[i] = texel_solid_angle(i, height, width) * total


@wp.kernel(enable_backward=False)
def find_key_light_kernel(
    # In:
    sums: wp.array[wp.vec4],
    # Out:
    key_lights_out: wp.array[KeyLight],
):
    """Find direction and directionality from the sums of all rows."""
    total = wp.vec4(0.0, 0.0, 0.0, 0.0)
    for i in range(sums.shape[0]):
        total += sums[i]
    flow = wp.vec3(total[0], total[1], total[2])
    light = KeyLight()
    light.direction = wp.vec3(0.0, 0.0, 1.0)
    light.directionality = 0.0
    if wp.length(flow) > 0.0:
        light.direction = wp.normalize(flow)
        light.directionality = wp.min(2.0 * wp.length(flow) / total[3], 1.0)
    key_lights_out[0] = light


def find_key_light(environment: wp.array, sums_out: wp.array, key_lights_out: wp.array) -> None:
    """Find the dominant direction of the environment.

    Args:
        environment: ``wp.vec3`` (h, w), finite and not negative.
        sums_out: Scratch, ``wp.vec4`` (h).
        key_lights_out: ``KeyLight`` (1). Without any light its direction is +z and its directionality 0.
    """
    launch(sum_rows_kernel, environment.shape[0], [environment], [sums_out])
    launch(find_key_light_kernel, 1, [sums_out], [key_lights_out])
