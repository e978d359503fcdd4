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
