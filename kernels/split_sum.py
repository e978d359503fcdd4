"""Split sum: directional albedo of a rough specular surface, as a table over roughness and angle.

``sample_dfg`` returns (scale, bias): the directional albedo of the GGX surface is F0 scale + bias [Karis13]. A model of
single scattering loses energy on rough surfaces. ``energy_compensation`` adds it back, so that a white metal keeps a
white furnace white.

References:
    [Heitz14] Heitz 2014, Understanding the Masking-Shadowing Function in Microfacet-Based BRDFs.
    [Karis13] Karis 2013, Real Shading in Unreal Engine 4.
    [FA19] Fdez-Aguera 2019, A Multiple-Scattering Microfacet Model for Real-Time Image-based Lighting, JCGT 8(1).
    [Turquin19] Turquin 2019, Practical Multiple Scattering Compensation for Microfacet Models.
"""

from __future__ import annotations

import warp as wp

from warp_ar.kernels.launch import launch
from warp_ar.kernels.sampling import ggx_masking, ggx_masking_shadowing, hammersley, sample_ggx_visible

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def integrate_dfg_kernel(
    # In:
    samples: wp.int32,
    # Out:
    dfg_out: wp.array2d[wp.vec2],
):
    """Write scale and bias of F0 for one roughness (row) and one n_dot_v (column), each from 0 to 1 over the table.

    With half vectors visible from wo, D and one masking cancel: the estimate is F(wo.wh) G2 / G1(wo) [Heitz14].
    """
    i, j = wp.tid()
    roughness = wp.float32(i) / wp.float32(dfg_out.shape[0] - 1)
    alpha = roughness * roughness
    # The limit at grazing view exists, but the formulas divide by 0 there.
    cos_theta = wp.max(wp.float32(j) / wp.float32(dfg_out.shape[1] - 1), 1.0e-3)
    wo = wp.vec3(wp.sqrt(1.0 - cos_theta * cos_theta), 0.0, cos_theta)
    masking = ggx_masking(wo, alpha)
    total = wp.vec2(0.0, 0.0)
    for s in range(samples):
        wh = sample_ggx_visible(hammersley(s, samples), wo, alpha)
        cosine = wp.clamp(wp.dot(wo, wh), 0.0, 1.0)
        wi = wh * (2.0 * cosine) - wo
        if wi[2] > 0.0:
            visibility = ggx_masking_shadowing(wi, wo, alpha) / masking
            m = 1.0 - cosine
            fresnel = m * m * m * m * m
            total += wp.vec2((1.0 - fresnel) * visibility, fresnel * visibility)
    dfg_out[i, j] = total / wp.float32(samples)


@wp.func
def sample_dfg(table: wp.array2d[wp.vec2], n_dot_v: wp.float32, roughness: wp.float32) -> wp.vec2:
    """Return (scale, bias) such that the specular reflectance under a white sky is F0 scale + bias.

    Args:
        table: (roughness, n_dot_v), as ``integrate_dfg`` writes.
        n_dot_v: Cosine between normal and viewer; clamped to [0, 1].
        roughness: Perceptual; clamped to [0, 1].
    """
    y = wp.clamp(roughness, 0.0, 1.0) * wp.float32(table.shape[0] - 1)
    x = wp.clamp(n_dot_v, 0.0, 1.0) * wp.float32(table.shape[1] - 1)
    i = wp.min(wp.int32(y), table.shape[0] - 2)
    j = wp.min(wp.int32(x), table.shape[1] - 2)
    fy = y - wp.float32(i)
    fx = x - wp.float32(j)
    top = table[i, j] * (1.0 - fx) + table[i, j + 1] * fx
    bottom = table[i + 1, j] * (1.0 - fx) + table[i + 1, j + 1] * fx
    return top * (1.0 - fy) + bottom * fy


# A share E of the light that meets the facets leaves after one scattering. The rest is multiplied by F0 at each further
# scattering, after which a share s of it leaves. The sum over all scatterings is
#
#     E F0 + (1 - E) F0^2 (s + s (1 - s) F0 + ...) = E F0 (1 + F0 (1 / E - 1) s / (1 - F0 (1 - s))).
#
# With s = 1, all light leaves at the second scattering, it is [Turquin19]; with s = E, the chance to leave does not
# change, [FA19]. The truth lies between, because scattered light is on its way up. With
#
#     | s = sqrt(E) |
#
# the sum is within 3 % of a random walk between the facets (Heitz et al. 2016) at roughness 1, where the two are off by
# +18 and -12 %. At F0 = 1 the bracket is 1 / E, whatever s is: a white furnace stays white.
@wp.func
def energy_compensation(dfg: wp.vec2, f0: wp.vec3) -> wp.vec3:
    """Return the factor, per channel, by which multiple scattering increases specular reflection.

    E = scale + bias is the single-scattering albedo of a surface with F0 = 1. The factor holds for environment light
    and virtual lights alike.
    """
    once = wp.max(dfg[0] + dfg[1], 1.0e-3)
    later = wp.sqrt(wp.min(once, 1.0))
    result = wp.vec3(0.0)
    for channel in range(3):
        f = f0[channel]
        result[channel] = 1.0 + f * (1.0 / once - 1.0) * later / (1.0 - f * (1.0 - later))
    return result


def integrate_dfg(dfg_out: wp.array2d[wp.vec2], *, samples: int = 1024) -> None:
    """Fill the split-sum table; once, when a pipeline is built.

    Args:
        dfg_out: (R, V): roughness and n_dot_v from 0 to 1, at least (2, 2); 32 x 32 is what shading uses.
        samples: Directions per entry.
    """
    launch(integrate_dfg_kernel, dim=dfg_out.shape, inputs=[samples], outputs=[dfg_out], device=dfg_out.device)
