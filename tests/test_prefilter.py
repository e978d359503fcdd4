import math

import numpy as np
import pytest
import warp as wp

from tests.error_model import check_error
from tests.kernel_rig import SMALL_DESK, launch_passes
from tests.twins import latlong
from tests.twins import prefilter as reference
from warp_ar.kernels.environment.lobes import (
    level_from_roughness,
    level_from_shininess,
    lobe_alpha,
    lobe_count,
    lobe_offset,
    lobe_size,
    lobe_texels,
)
from warp_ar.kernels.split_sum import energy_compensation, integrate_dfg, sample_dfg
from warp_ar.scene import loads_scene
from warp_ar.stages.base import Arrays
from warp_ar.stages.features import find_features
from warp_ar.stages.prefilter import Prefilter, scene_lobe
from warp_ar.stages.quality import PRESETS
from warp_ar.stages.request import Request

# Float32 sums over a map, relative.
ROUNDING = 2e-5
# Split-sum table: 1024 Hammersley directions against quadrature.
DFG = 4e-3

METHODS = [method for method in Prefilter.methods if method != "sphere_mip"]  # which filters the frame
LOBES = ("ggx", "phong")
MATERIALS = {
    "ggx": 'model = "metallic_roughness"\nbase_color = [1.0, 0.8, 0.3]\nmetallic = 1.0\nroughness = 0.4',
    "phong": 'model = "phong"\nspecular = [0.5, 0.5, 0.5]\nshininess = 30.0',
    "mirror": 'model = "mirror"',
    "lambert": 'model = "lambert"',
}


def scene(*materials):
    return loads_scene(
        SMALL_DESK
        + "".join(
            f'[[object]]\nshape = "sphere"\nradius = 0.05\n[object.material]\n{MATERIALS[m]}\n' for m in materials
        )
    )


@wp.kernel(enable_backward=False)
def level_kernel(values: wp.array[wp.float32], height: wp.int32, out: wp.array2d[wp.float32]):
    i = wp.tid()
    out[0, i] = level_from_roughness(values[i], height)
    out[1, i] = level_from_shininess(values[i], height)


@wp.kernel(enable_backward=False)
def dfg_kernel(
    table: wp.array2d[wp.vec2], at: wp.array[wp.vec2], out: wp.array[wp.vec2], factor_out: wp.array[wp.vec3]
):
    i = wp.tid()
    out[i] = sample_dfg(table, at[i][0], at[i][1])
    factor_out[i] = energy_compensation(out[i], wp.vec3(1.0, 0.5, 0.0))


def run(radiance, method, lobe="ggx", bands=1):
    """Packed levels as the stage makes them."""
    environment = wp.array(np.ascontiguousarray(radiance, np.float32), dtype=wp.vec3)
    quality = PRESETS["medium"].with_methods(prefilter=method)
    quality = type(quality)(**{**vars(quality), "environment_height": environment.shape[0]})
    request = Request(scene(lobe), quality, (64, 48))
    assert scene_lobe(request.scene) == ("ggx" if lobe == "mirror" else lobe)
    features = find_features(request)
    stage = Prefilter(features, Prefilter.wire(features))
    arrays = Arrays()
    arrays.add("environment", environment)
    for name, spec in stage.arrays().items():
        arrays.add(name, wp.full(spec.shape, spec.fill, dtype=spec.dtype))
    launch_passes(stage.build(arrays, environment.device), bands)
    return arrays["prefilter_levels"]


def unpack(levels, height):
    texels = levels.numpy().astype(np.float64)
    result = []
    for level in range(lobe_count(height)):
        size, start = lobe_size(height, level), lobe_offset(height, level)
        result.append(texels[start : start + size[0] * size[1]].reshape(*size, 3))
    return result


# --- Where levels lie -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("height", [1, 2, 3, 7, 33, 64, 256])
def test_levels_and_widths_fit_the_map(device, height):
    count = lobe_count(height)
    assert lobe_alpha(height, count - 1) == 1.0
    assert lobe_texels(height) == sum(math.prod(lobe_size(height, level)) for level in range(count))
    for level in range(1, count):
        rows, alpha = lobe_size(height, level)[0], lobe_alpha(height, level)
        assert rows >= 1
        assert rows >= min(height, 8 / alpha - 1)  # eight texels per unit of alpha, or all that there are
        # The kernels find the same level.
        out = wp.zeros((2, 1), dtype=wp.float32)
        wp.launch(level_kernel, 1, [wp.array([math.sqrt(alpha)], dtype=wp.float32), height], [out])
        assert out.numpy()[0, 0] == pytest.approx(level, abs=1e-5)
        wp.launch(level_kernel, 1, [wp.array([1 / alpha**2], dtype=wp.float32), height], [out])
        assert out.numpy()[1, 0] == pytest.approx(level, abs=1e-5)


@pytest.mark.parametrize("height", [4, 64, 256])
def test_levels_grow_with_roughness_and_fall_with_shininess(device, height):
    # Atlas row 8: all roughnesses, exponents 0 to 1e5.
    roughness = np.concatenate([np.linspace(0, 1, 200), [1.0]])
    shininess = np.concatenate([[0.0, 0.5], np.logspace(0, 5, 199)])
    for row, values, sign in ((0, roughness, 1), (1, shininess, -1)):
        out = wp.zeros((2, 201), dtype=wp.float32)
        wp.launch(level_kernel, 201, [wp.array(values, dtype=wp.float32), height], [out])
        level = out.numpy()[row]
        assert np.isfinite(level).all()
        assert (np.diff(level) * sign >= -1e-6).all()
        assert np.abs(np.diff(level)).max() < 0.5  # no jump where the narrowest lobe meets the mirror
        assert level.min() >= 0
        assert level.max() == lobe_count(height) - 1


# --- Closed forms -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", [*METHODS, "mirror"])
def test_level_0_is_the_mirror(device, method):
    radiance = np.random.default_rng(1).random((16, 32, 3)).astype(np.float32)
    levels = run(radiance, "energy_mip", "mirror") if method == "mirror" else run(radiance, method)
    np.testing.assert_array_equal(unpack(levels, 16)[0], radiance)


def test_the_widest_lobe_is_irradiance(device):
    # Order-1 light: the cosine lobe keeps two thirds of it.
    directions = latlong.directions(32, 64)
    for axis in range(3):
        radiance = 1.0 + directions[..., axis : axis + 1].repeat(3, 2)
        for lobe in LOBES:
            widest = unpack(run(radiance, "brute_force", lobe), 32)[-1]
            expected = 1.0 + 2 / 3 * latlong.directions(*widest.shape[:2])[..., axis]
            np.testing.assert_allclose(widest[..., 0], expected, atol=2e-3)  # texels of 5.6 degrees: their square / 12


# --- Twins ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lobe", LOBES)
@pytest.mark.parametrize("height", [16, 9])
def test_the_reference_is_the_twin_s(device, lobe, height):
    radiance = np.random.default_rng(2).random((height, 2 * height, 3)) ** 8
    for index, level in enumerate(unpack(run(radiance, "brute_force", lobe), height)[1:], 1):
        directions = latlong.directions(*level.shape[:2]).reshape(-1, 3)
        twin = reference.integrate_lobe(radiance, directions, lobe_alpha(height, index), lobe)
        np.testing.assert_allclose(level.reshape(-1, 3), twin, rtol=1e-4, atol=ROUNDING)
        check_error("prefilter", level.reshape(-1, 3), twin)


def test_compensation_matches_the_twin(device):
    at = wp.array(np.random.default_rng(2).random((500, 2)).astype(np.float32), dtype=wp.vec2)
    table = wp.zeros((32, 32), dtype=wp.vec2)
    integrate_dfg(table)
    out, factor = wp.zeros(500, dtype=wp.vec2), wp.zeros(500, dtype=wp.vec3)
    wp.launch(dfg_kernel, 500, [table, at], [out, factor])
    once = np.minimum(out.numpy().astype(np.float64).sum(axis=1), 1.0)[:, None]
    expected = reference.energy_compensation(once, np.array([1.0, 0.5, 0.0]))
    np.testing.assert_allclose(factor.numpy(), expected, rtol=2e-6)


# --- Energy, seam, poles, hard cases ----------------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
def test_a_ramp_is_not_shifted_or_turned(device, method):
    # Any lobe, being round, keeps the direction of order-1 light: a half-texel shift does not.
    height = 16
    directions = latlong.directions(height, 2 * height)
    for axis in range(3):
        radiance = 2.0 + directions[..., axis : axis + 1].repeat(3, 2)
        for level in unpack(run(radiance, method), height):
            d, areas = latlong.directions(*level.shape[:2]), latlong.solid_angles(*level.shape[:2])
            dipole = np.einsum("hw,hw,hwk->k", areas, level[..., 0], d)
            dipole /= np.linalg.norm(dipole)
            # Eight samples are off by a ninth of a texel; half a one would be 5.6 degrees.
            assert np.degrees(np.arccos(np.clip(dipole[axis], -1, 1))) < 1.5


# --- Split sum --------------------------------------------------------------------------------------------------------


def test_the_split_sum_is_the_quadrature_s(device):
    table = wp.zeros((17, 17), dtype=wp.vec2)
    integrate_dfg(table)
    values = table.numpy()
    assert np.isfinite(values).all()
    for i in (6, 16):
        for j in (2, 9):
            np.testing.assert_allclose(values[i, j], reference.dfg(j / 16, i / 16), atol=DFG)


# --- Wiring -----------------------------------------------------------------------------------------------------------
