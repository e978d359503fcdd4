import math

import numpy as np
import pytest
import warp as wp
from scipy import stats

from tests.twins import sampling as reference
from warp_ar.kernels import sampling

COUNT = 200_000
# Chance that a right sampler fails one histogram test; the seed is fixed, so it fails always or never.
SIGNIFICANCE = 1e-4
# Float32 formulas of a few operations, relative.
ROUNDING = 1e-5


@wp.kernel(enable_backward=False)
def hash_kernel(values: wp.array[wp.vec3ui], triple_out: wp.array[wp.vec3ui]):
    i = wp.tid()
    triple_out[i] = sampling.pcg3d_hash(values[i][0], values[i][1], values[i][2])


@wp.kernel(enable_backward=False)
def uniform_kernel(bits: wp.array[wp.uint32], inverse_out: wp.array[wp.float32], uniform_out: wp.array[wp.float32]):
    i = wp.tid()
    inverse_out[i] = sampling.radical_inverse(bits[i])
    uniform_out[i] = sampling.uniform_from_bits(bits[i])


@wp.kernel(enable_backward=False)
def hammersley_kernel(out: wp.array[wp.vec2]):
    i = wp.tid()
    out[i] = sampling.hammersley(i, out.shape[0])


@wp.kernel(enable_backward=False)
def frame_kernel(normals: wp.array[wp.vec3], out: wp.array[wp.mat33]):
    i = wp.tid()
    out[i] = sampling.frame_from_normal(normals[i])


DISK, COSINE, PHONG, GGX, VISIBLE = range(5)


@wp.kernel(enable_backward=False)
def sample_kernel(
    kind: wp.int32,
    u: wp.array[wp.vec2],
    width: wp.float32,
    wo: wp.vec3,
    out: wp.array[wp.vec3],
    pdf_out: wp.array[wp.float32],
):
    i = wp.tid()
    if kind == 0:
        p = sampling.sample_disk(u[i])
        out[i] = wp.vec3(p[0], p[1], 0.0)
        pdf_out[i] = 1.0 / wp.pi
    elif kind == 1:
        out[i] = sampling.sample_cosine_hemisphere(u[i])
        pdf_out[i] = out[i][2] / wp.pi
    elif kind == 2:
        out[i] = sampling.sample_phong_lobe(u[i], width)
        pdf_out[i] = sampling.phong_lobe_pdf(out[i][2], width)
    else:
        out[i] = sampling.sample_ggx_visible(u[i], wo, width)
        pdf_out[i] = sampling.ggx_visible_pdf(out[i], wo, width)


@wp.kernel(enable_backward=False)
def pdf_kernel(kind: wp.int32, w: wp.array[wp.vec3], width: wp.float32, wo: wp.vec3, out: wp.array[wp.float32]):
    i = wp.tid()
    if kind == 2:
        out[i] = sampling.phong_lobe_pdf(w[i][2], width)
    elif kind == 3:
        out[i] = sampling.ggx_distribution(w[i], width)
    elif kind == 4:
        out[i] = sampling.ggx_visible_pdf(w[i], wo, width)


@wp.kernel(enable_backward=False)
def masking_kernel(w: wp.array[wp.vec3], alpha: wp.float32, out: wp.array[wp.float32], joint_out: wp.array[wp.float32]):
    i = wp.tid()
    out[i] = sampling.ggx_masking(w[i], alpha)
    joint_out[i] = sampling.ggx_masking_shadowing(w[i], wp.vec3(0.0, 0.0, 1.0), alpha)


def draw(kind, width=0.0, wo=(0.0, 0.0, 1.0), u=None):
    u = np.random.default_rng(1).random((COUNT, 2)) if u is None else np.asarray(u)
    u = np.minimum(u, 1 - 2.0**-24).astype(np.float32)
    out, pdf = wp.zeros(len(u), dtype=wp.vec3), wp.zeros(len(u), dtype=wp.float32)
    wp.launch(sample_kernel, len(u), [kind, wp.array(u, dtype=wp.vec2), width, wp.vec3(*wo)], [out, pdf])
    return out.numpy().astype(np.float64), pdf.numpy().astype(np.float64)


def density(kind, w, width, wo=(0.0, 0.0, 1.0)):
    out = wp.zeros(len(w), dtype=wp.float32)
    wp.launch(pdf_kernel, len(w), [kind, wp.array(w.astype(np.float32), dtype=wp.vec3), width, wp.vec3(*wo)], [out])
    return out.numpy().astype(np.float64)


def view(cosine):
    return (math.sqrt(1 - cosine**2), 0.0, cosine)


# --- Numbers ----------------------------------------------------------------------------------------------------------


def test_hashed_numbers_are_uniform(device):
    grid = np.stack(np.meshgrid(np.arange(64), np.arange(64), np.arange(16), indexing="ij"), -1).reshape(-1, 3)
    triple = wp.zeros(len(grid), dtype=wp.vec3ui)
    wp.launch(hash_kernel, len(grid), [wp.array(grid.astype(np.uint32), dtype=wp.vec3ui)], [triple])
    for bits in triple.numpy().T:
        assert stats.chisquare(np.bincount(bits >> 24, minlength=256)).pvalue > SIGNIFICANCE
    joint = np.bincount((triple.numpy()[:, 0] >> 28) * 16 + (triple.numpy()[:, 1] >> 28), minlength=256)
    assert stats.chisquare(joint).pvalue > SIGNIFICANCE


def test_radical_inverse_mirrors_bits_and_stays_below_one(device):
    bits = np.concatenate([np.arange(5000), [2**31, 2**32 - 1, 0x80000001]]).astype(np.uint32)
    inverse, uniform = wp.zeros(len(bits), dtype=wp.float32), wp.zeros(len(bits), dtype=wp.float32)
    wp.launch(uniform_kernel, len(bits), [wp.array(bits, dtype=wp.uint32)], [inverse, uniform])
    # 24 of 32 bits are kept.
    np.testing.assert_allclose(inverse.numpy(), [reference.radical_inverse(int(b)) for b in bits], atol=2.0**-24)
    assert inverse.numpy().max() < 1
    assert uniform.numpy().max() < 1


@pytest.mark.parametrize("count", [1, 8, 32, 128, 1024])
def test_hammersley_fills_every_stratum_once(device, count):
    out = wp.zeros(count, dtype=wp.vec2)
    wp.launch(hammersley_kernel, count, [], [out])
    points = out.numpy()
    assert ((points > 0) & (points < 1)).all()
    for axis in (0, 1):  # powers of two: both axes are stratified
        assert sorted((points[:, axis] * count).astype(int)) == list(range(count))


def test_frames_are_orthonormal_everywhere(device):
    normals = np.random.default_rng(3).standard_normal((1000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals[:4] = [[0, 0, 1], [0, 0, -1], [1e-8, 0, -1], [1, 0, 0]]
    out = wp.zeros(1000, dtype=wp.mat33)
    wp.launch(frame_kernel, 1000, [wp.array(normals.astype(np.float32), dtype=wp.vec3)], [out])
    frames = out.numpy().astype(np.float64)
    np.testing.assert_allclose(np.swapaxes(frames, 1, 2) @ frames, np.broadcast_to(np.eye(3), frames.shape), atol=2e-6)
    np.testing.assert_allclose(frames[:, :, 2], normals, atol=1e-7)
    np.testing.assert_allclose(np.linalg.det(frames), 1, atol=2e-6)


# --- Distributions: histograms against pdfs ---------------------------------------------------------------------------


def histogram_test(kind, width=0.0, wo=(0.0, 0.0, 1.0), upper=math.pi / 2):
    """Chi-square of samples in (cos theta, phi) bins against the pdf integrated over each bin."""
    w, _ = draw(kind, width, wo)
    # Bins of equal count in theta, from the samples themselves kept apart.
    edges = np.quantile(np.arctan2(np.hypot(w[::7, 0], w[::7, 1]), w[::7, 2]), np.linspace(0, 1, 11))
    edges[0], edges[-1] = 0.0, upper
    bins_phi = 8
    nodes, weights = np.polynomial.legendre.leggauss(24)
    theta = edges[:-1, None] + (nodes + 1) / 2 * np.diff(edges)[:, None]
    measure_theta = weights / 2 * np.diff(edges)[:, None] * np.sin(theta)
    phi = (np.arange(bins_phi)[:, None] + (nodes + 1) / 2) * 2 * np.pi / bins_phi - np.pi
    t, p = theta[:, None, :, None], phi[None, :, None, :]
    grid = np.stack(np.broadcast_arrays(np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t) + 0 * p), -1)
    values = density(kind, grid.reshape(-1, 3), width, wo).reshape(grid.shape[:-1])
    expected = np.einsum("ijab,ia,b->ij", values, measure_theta, weights * np.pi / bins_phi).ravel()
    assert expected.sum() == pytest.approx(1.0, abs=2e-3)
    rows = np.clip(np.searchsorted(edges, np.arctan2(np.hypot(w[:, 0], w[:, 1]), w[:, 2]), side="right") - 1, 0, 9)
    columns = np.clip(((np.arctan2(w[:, 1], w[:, 0]) + np.pi) / (2 * np.pi) * bins_phi).astype(int), 0, bins_phi - 1)
    found = np.bincount(rows * bins_phi + columns, minlength=10 * bins_phi)
    keep = expected * len(w) > 20
    expected_count = expected[keep] / expected[keep].sum() * found[keep].sum()
    assert stats.chisquare(found[keep], expected_count).pvalue > SIGNIFICANCE


@pytest.mark.parametrize("exponent", [0.0, 1.0, 20.0, 1000.0])
def test_phong_samples_follow_their_pdf(device, exponent):
    histogram_test(PHONG, exponent)


@pytest.mark.parametrize("cosine", [1.0, 0.7, 0.2])
@pytest.mark.parametrize("alpha", [0.1, 0.4, 1.0])
def test_visible_ggx_samples_follow_their_pdf(device, alpha, cosine):
    histogram_test(VISIBLE, alpha, view(cosine))


def test_hemisphere_and_disk_have_their_moments(device):
    limit = 5 / math.sqrt(COUNT)
    w, _ = draw(COSINE)
    assert w[:, 2].mean() == pytest.approx(2 / 3, abs=limit * 0.24)
    assert (w[:, 2] ** 2).mean() == pytest.approx(1 / 2, abs=limit * 0.3)
    p, _ = draw(DISK)
    assert (np.hypot(p[:, 0], p[:, 1]) ** 2).mean() == pytest.approx(1 / 2, abs=limit * 0.3)
    np.testing.assert_allclose(p[:, :2].mean(0), 0, atol=limit * 0.5)
    angle = ((np.arctan2(p[:, 1], p[:, 0]) + np.pi) / (2 * np.pi) * 32).astype(int) % 32
    assert stats.chisquare(np.bincount(angle, minlength=32)).pvalue > SIGNIFICANCE


# --- Formulas and their ends ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("alpha", [1e-3, 0.02, 0.3, 1.0])
def test_ggx_is_the_published_one(device, alpha):
    theta = np.linspace(0, 1.5, 200)
    w = np.stack([np.sin(theta), 0 * theta, np.cos(theta)], 1)
    ours = density(GGX, w, alpha)
    np.testing.assert_allclose(ours, reference.ggx_distribution(np.cos(theta), alpha), rtol=1e-4)
    one, joint = wp.zeros(200, dtype=wp.float32), wp.zeros(200, dtype=wp.float32)
    wp.launch(masking_kernel, 200, [wp.array(w.astype(np.float32), dtype=wp.vec3), alpha], [one, joint])
    np.testing.assert_allclose(one.numpy(), reference.ggx_masking(np.cos(theta), alpha), rtol=1e-4)
    np.testing.assert_allclose(joint.numpy(), one.numpy(), rtol=ROUNDING)  # the other direction is never masked


def test_every_lobe_is_finite_at_its_ends(device):
    # Atlas row 8: exponents 0 to 1e5, roughness 0 and 1, grazing views; and both ends of the sample square.
    u = [[a, b] for a in (0.0, 0.5, 1.0) for b in (0.0, 0.25, 0.5, 0.75, 1.0)]
    cases = [(kind, 0.3, 1.0) for kind in (DISK, COSINE)]
    cases += [(PHONG, exponent, 1.0) for exponent in (0.0, 1.0, 1e3, 1e5)]
    cases += [(VISIBLE, alpha, cosine) for alpha in (0.0, 1e-4, 0.5, 1.0) for cosine in (0.0, 1e-6, 0.5, 1.0)]
    for kind, width, cosine in cases:
        w, pdf = draw(kind, width, view(cosine), u)
        assert np.isfinite(w).all(), (kind, width, cosine)
        assert np.isfinite(pdf).all(), (kind, width, cosine)
        assert (pdf >= 0).all()
        if kind != DISK:
            np.testing.assert_allclose(np.linalg.norm(w, axis=1), 1, atol=1e-5, err_msg=str((kind, width, cosine)))
