"""Reflection models: energy, the float64 twins, and the ends of every range."""

from __future__ import annotations

import functools

import numpy as np
import pytest
import warp as wp

from tests.error_model import check_error
from tests.kernel_rig import TEXTURES, records
from tests.twins import materials as reference
from warp_ar.kernels.materials import (
    MIN_ALPHA,
    ggx_lobe,
    make_reflect_direct,
    make_surface,
    phong_lobe,
)
from warp_ar.kernels.split_sum import integrate_dfg
from warp_ar.kernels.structs import LAMBERT, METALLIC_ROUGHNESS, MIRROR, PHONG, Hit, Material, RayScene, Shape

MODELS = (LAMBERT, PHONG, METALLIC_ROUGHNESS, MIRROR)

# Unit vectors are rounded to 6e-8. At exponent n the lobe falls by n sin(theta) per radian, so its relative error grows
# as that; at 1e5 and the angles where the lobe is not yet nothing (0.02) it reaches 1e5 * 0.02 * 1e-7.
LOBE_TOLERANCE = 5e-4
# The half vector is rounded to 1e-7, and near mirror roughness (alpha 1e-3) that is
# a ten-thousandth of the peak's width.
GGX_TOLERANCE = 2e-3
# Quadrature of the hemisphere against the table of directional albedos: the table's own bilinear error is about 1e-3.
ALBEDO_TOLERANCE = 4e-3
# Sums of a handful of float32 products.
SUM_TOLERANCE = 1e-5

surface_at = make_surface(MODELS, True)
reflect_direct = make_reflect_direct(MODELS)
reflect_lambert = make_reflect_direct((LAMBERT,))
lambert_at = make_surface((LAMBERT,), False)


@wp.kernel(enable_backward=False, module="unique")
def lobes_kernel(
    # In:
    wi: wp.array[wp.vec3],
    wo: wp.array[wp.vec3],
    parameter: wp.float32,
    # Out:
    phong_out: wp.array[wp.float32],
    ggx_out: wp.array[wp.float32],
):
    i = wp.tid()
    normal = wp.vec3(0.0, 0.0, 1.0)
    phong_out[i] = phong_lobe(wo[i], wi[i], parameter)
    half = wp.normalize(wi[i] + wo[i])
    ggx_out[i] = ggx_lobe(normal, half, wi[i][2], wo[i][2], parameter)


@wp.kernel(enable_backward=False, module="unique")
def reflect_kernel(
    # In:
    scene: RayScene,
    dfg: wp.array2d[wp.vec2],
    wi: wp.array[wp.vec3],
    wo: wp.array[wp.vec3],
    # Out:
    direct_out: wp.array[wp.vec3],
    diffuse_out: wp.array[wp.vec3],
    reflectance_out: wp.array[wp.vec3],
    lambert_out: wp.array[wp.vec3],
):
    i = wp.tid()
    normal = wp.vec3(0.0, 0.0, 1.0)
    hit = Hit()
    hit.corner = -1
    surface = surface_at(scene, dfg, hit, wo[i][2], 0.0)
    direct_out[i] = reflect_direct(surface, normal, wo[i], wi[i])
    diffuse_out[i] = surface.diffuse
    reflectance_out[i] = surface.reflectance
    lambert = lambert_at(scene, dfg, hit, wo[i][2], 0.0)
    lambert_out[i] = reflect_lambert(lambert, normal, wo[i], wi[i])


def vectors(values, device):
    return wp.array(np.ascontiguousarray(values, np.float32), dtype=wp.vec3, device=device)


def lobes(wi, wo, parameter, device):
    outputs = [wp.zeros(len(wi), dtype=wp.float32, device=device) for _ in range(2)]
    wp.launch(
        lobes_kernel,
        dim=len(wi),
        inputs=[vectors(wi, device), vectors(wo, device), parameter],
        outputs=outputs,
        device=device,
    )
    return [output.numpy() for output in outputs]


def material(**fields):
    return records(Material, {**dict.fromkeys(TEXTURES, -1), "base_color": 1.0, "specular": 1.0, **fields}).numpy()


@functools.cache
def dfg_table(device):
    table = wp.zeros((32, 32), dtype=wp.vec2, device=device)
    integrate_dfg(table)
    return table


def reflected(record, wi, wo, device):
    """Direct reflection, diffuse and lobe reflectance, and the direct reflection of a Lambert-only build."""
    wi, wo = np.broadcast_arrays(wi, wo)
    scene = RayScene()
    scene.materials = wp.array(record, dtype=Material, device=device)
    scene.objects = wp.zeros(1, dtype=Shape, device=device)
    outputs = [wp.zeros(len(wi), dtype=wp.vec3, device=device) for _ in range(4)]
    wp.launch(
        reflect_kernel,
        dim=len(wi),
        inputs=[scene, dfg_table(device), vectors(wi, device), vectors(wo, device)],
        outputs=outputs,
        device=device,
    )
    return [output.numpy() for output in outputs]


def hemisphere(count_z, count_phi, *, about, width):
    """Directions of the sphere and their solid angles; nodes gather within about ``width`` around ``about``."""
    nodes, weights = np.polynomial.legendre.leggauss(count_z)
    s, ds = 0.5 * (nodes + 1), 0.5 * weights
    power = 2.0 + 2.0 * np.log10(1.0 / width)
    z, dz = 1 - 2 * s**power, 2 * power * s ** (power - 1) * ds
    phi = 2 * np.pi * (np.arange(count_phi) + 0.5) / count_phi
    sine = np.sqrt(np.maximum(1 - z * z, 0))[:, None]
    local = np.stack(np.broadcast_arrays(sine * np.cos(phi), sine * np.sin(phi), z[:, None]), -1).reshape(-1, 3)
    side = np.cross(about, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    return local @ np.stack([side, np.cross(about, side), about]), np.repeat(dz * 2 * np.pi / count_phi, count_phi)


def upper(rng, count):
    v = rng.normal(size=(count, 3))
    v[:, 2] = np.abs(v[:, 2]) + 1e-3
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


# --- Closed form ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("roughness", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("metallic", [0.0, 0.3, 1.0])
def test_white_furnace(device, model, roughness, metallic):
    """A white surface in a white environment is white, from every side."""
    record = material(model=model, roughness=roughness, metallic=metallic, shininess=10.0)
    if model == PHONG:
        record["base_color"], record["specular"] = 0.25, 0.75
    wo = upper(np.random.default_rng(0), 200)
    _, diffuse, reflectance, _ = reflected(record, wo, wo, device)
    np.testing.assert_allclose(diffuse + reflectance, 1.0, atol=SUM_TOLERANCE)


# --- Twins and integrals ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("exponent", [0.0, 0.5, 1.0, 32.0, 1e3, 1e5])
def test_phong_matches_reference(device, exponent):
    """Across the lobe, also where it underflows."""
    rng = np.random.default_rng(1)
    mirror = upper(rng, 4000).astype(np.float32).astype(np.float64)
    wi = mirror + rng.normal(size=mirror.shape) * rng.choice([1.0, 0.1, 1e-2, 1e-3], size=(4000, 1))
    wi = (wi / np.linalg.norm(wi, axis=-1, keepdims=True)).astype(np.float32).astype(np.float64)
    lobe, _ = lobes(wi, mirror, exponent, device)
    # The kernel measures the angle by the distance of unit vectors; so does the twin, whose vectors are rounded too.
    cosine = 1 - 0.5 * np.sum((mirror - wi) ** 2, -1)
    expected = reference.phong_lobe(np.stack([cosine], -1), np.ones((4000, 1)), exponent)
    np.testing.assert_allclose(lobe, expected, rtol=LOBE_TOLERANCE, atol=1e-6)
    check_error("shade", lobe, expected)


@pytest.mark.parametrize("roughness", [0.0, 0.03, 0.1, 0.35, 0.7, 1.0])
def test_ggx_matches_reference(device, roughness):
    """From the peak to grazing, at every roughness."""
    rng = np.random.default_rng(2)
    wo = upper(rng, 4000)
    mirror = wo * [-1, -1, 1]
    wi = mirror + rng.normal(size=wo.shape) * rng.choice([1.0, 0.1, 1e-2, 1e-3], size=(4000, 1))
    wi[:, 2] = np.abs(wi[:, 2]) + 1e-3
    wi = (wi / np.linalg.norm(wi, axis=-1, keepdims=True)).astype(np.float32).astype(np.float64)
    wo = wo.astype(np.float32).astype(np.float64)
    half = wi + wo
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    _, lobe = lobes(wi, wo, roughness, device)
    expected = reference.ggx_lobe(np.array([0.0, 0.0, 1.0]), half, wi, wo, roughness, float(MIN_ALPHA))
    np.testing.assert_allclose(lobe, expected, rtol=GGX_TOLERANCE, atol=1e-6 * expected.max())
    check_error("shade", lobe, expected)


@pytest.mark.parametrize("metallic", [0.0, 1.0])
@pytest.mark.parametrize("roughness", [0.2, 1.0])
@pytest.mark.parametrize("cos_o", [1.0, 0.15])
def test_virtual_lights_from_everywhere_are_a_white_environment(device, metallic, roughness, cos_o):
    """The integral of direct reflection over all lights is the environment's reflectance: the two ways of lighting
    agree."""
    record = material(model=METALLIC_ROUGHNESS, roughness=roughness, metallic=metallic, base_color=(0.9, 0.5, 0.1))
    wo = np.array([np.sqrt(1 - cos_o**2), 0.0, cos_o])
    wi, solid = hemisphere(600, 256, about=wo * [-1, -1, 1] + [1e-9, 0, 0], width=roughness**2)
    direct, diffuse, reflectance, _ = reflected(record, wi, [wo], device)
    total = np.sum(direct.astype(np.float64) * solid[:, None], axis=0)
    np.testing.assert_allclose(total, diffuse[0] + reflectance[0], atol=ALBEDO_TOLERANCE)


# --- Hard cases -------------------------------------------------------------------------------------------------------
