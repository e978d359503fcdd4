"""Spherical harmonics of an environment in JSON, for engines that light diffuse surfaces by nine colours.

With Y_i the real orthonormal basis in the order l = 0; l = 1: y, z, x; l = 2: xy, yz, 3z^2 - 1, xz, x^2 - y^2, all
signs positive (three.js and Filament have the same order and signs), ``radiance`` holds

    L_i = integral of L(w) Y_i(w) dw,   L(w) about sum_i L_i Y_i(w),

and ``irradiance`` A_l L_i, with A = pi, 2 pi/3, pi/4 for the clamped cosine ([RH01] eq. 8), so that a surface with the
normal n receives E(n) = sum_i E_i Y_i(n). Nothing is windowed: beside a small emitter E may come out negative.

A texel's radiance is constant. Y_lm = N P_l|m|(cos theta) times cos m phi or sin |m| phi, so its integral is one over
the columns (a closed form) times one over the rows (Gauss-Legendre over theta with 8 points, exact to rounding).

References:
    [RH01] Ramamoorthi, Hanrahan 2001, An Efficient Representation for Irradiance Environment Maps.
"""

from __future__ import annotations

import json
import math

import numpy as np
import numpy.typing as npt

from warp_ar.kernels.environment.irradiance import basis_row, cosine_lobe
from warp_ar.output.environment_axes import world_from_marker
from warp_ar.signature import PROGRAM

Array = npt.NDArray[np.float64]

BASIS = ("1", "y", "z", "x", "xy", "yz", "3zz-1", "xz", "xx-yy")
_DEGREES = ((0, 0), (1, -1), (1, 0), (1, 1), (2, -2), (2, -1), (2, 0), (2, 1), (2, 2))
_WORLDS = {False: "x, y, z of the marker, z up", True: "x, y, z = x, z, -y of the marker, y up"}


def project_radiance(radiance: npt.NDArray[np.float32], axes: str = "z-up") -> Array:
    """Coefficients L_i of a latlong, (9, 3).

    Args:
        radiance: (height, width, 3), z-up.
        axes: Whose x, y and z the basis is told in; one of ``AXES`` of `environment_axes`.

    Raises:
        UsageError: There are no such axes.
    """
    height, width = radiance.shape[:2]
    nodes, weights = np.polynomial.legendre.leggauss(8)
    half = 0.5 * math.pi / height
    theta = (np.arange(height)[:, None] * 2 + 1 + nodes) * half
    z, area = np.cos(theta), np.sin(theta) * weights * half
    edges = (np.arange(width + 1) * 2.0 / width - 1.0) * math.pi
    own = np.empty((9, 3))
    for index, (l, m) in enumerate(_DEGREES):
        rows = (basis_row(l, m, z) * area).sum(1)
        if m == 0:
            columns = np.diff(edges)
        else:
            k = abs(m)
            columns = np.diff(np.sin(k * edges) if m > 0 else -np.cos(k * edges)) / k
        own[index] = np.einsum("h,hwc,w->c", rows, radiance.astype(np.float64), columns)
    # What Y is of turned directions is linear in what it is of these; any nine in general position tell how.
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    turned, *_ = np.linalg.lstsq(basis(directions), basis(directions @ world_from_marker(axes).T), rcond=None)
    return np.asarray(turned.T @ own)


def basis(directions: Array) -> Array:
    """Y_i of unit directions (n, 3), as (n, 9)."""
    x, y, z = directions.T
    columns = (
        *(0.28209479177387814 + 0.0 * x, 0.4886025119029199 * y, 0.4886025119029199 * z, 0.4886025119029199 * x),
        *(1.0925484305920792 * x * y, 1.0925484305920792 * y * z, 0.31539156525252005 * (3.0 * z * z - 1.0)),
        *(1.0925484305920792 * x * z, 0.5462742152960396 * (x * x - y * y)),
    )
    return np.stack(columns, 1)


def encode_harmonics(radiance: npt.NDArray[np.float32], axes: str, white_level: float) -> bytes:
    """The JSON of a latlong's harmonics.

    Args:
        radiance: (height, width, 3), z-up.
        axes: As of `project_radiance`.
        white_level: Value at which the camera clips.

    Raises:
        UsageError: There are no such axes.
    """
    coefficients = project_radiance(radiance, axes)
    lobe = np.array([cosine_lobe(l) for l, _ in _DEGREES])
    content = {
        "program": PROGRAM,
        "kind": "spherical harmonics",
        "axes": _WORLDS[bool(world_from_marker(axes)[1, 1] == 0.0)],
        "basis": list(BASIS),
        "normalization": "orthonormal, all signs positive",
        "color": "linear, sRGB primaries, camera values",
        "whiteLevel": white_level,
        "radiance": coefficients.tolist(),
        "irradiance": (coefficients * lobe[:, None]).tolist(),
    }
    return (json.dumps(content, indent=1) + "\n").encode()
