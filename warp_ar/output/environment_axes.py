"""Environments in the axes and layouts of other programs, and as spherical harmonics.

A latlong map of this program (``z-up``) has row 0 toward +z and its centre column toward +x, and its columns advance
toward +y. Seen from inside, this is a mirror image. The other latlong layouts are pictures as seen from inside, with
columns advancing to the right:

    name      world                            centre column   columns grow toward
    z-up      z up, of the marker              +x              +y
    blender   the same                         +x              -y
    y-up      y up, (x, z, -y) of the marker   +z              -x
    opengl    the same                         -z              +x

``y-up`` is OpenEXR's convention for latlongs and cubes, and that of USD's dome light. ``blender`` is the convention of
Blender's world. three.js, whose world is that of ``y-up``, expects the same picture. All four have the marker's +z at
the top, so the maps differ only by reflection and rotation by quarter turns: texels are permuted, not filtered.

Spherical harmonics are the real orthonormal basis in the order l = 0; l = 1: y, z, x; l = 2: xy, yz, 3z^2 - 1, xz,
x^2 - y^2, all signs positive (three.js and Filament have the same order and signs). ``radiance`` holds

    L_i = integral of L(w) Y_i(w) dw,   L(w) about sum_i L_i Y_i(w),

and ``irradiance`` A_l L_i, with A = pi, 2 pi/3, pi/4 for the clamped cosine ([RH01] eq. 8), so that the irradiance of a
surface with normal n is E(n) = sum_i E_i Y_i(n). The coefficients are not windowed, so E may be negative opposite a
small emitter.

References:
    OpenEXR, Technical Introduction, Environment Maps, and ``ImfEnvmap``.
    [RH01] Ramamoorthi, Hanrahan 2001, An Efficient Representation for Irradiance Environment Maps.
    OpenGL 4.6 core profile, table 8.19: directions within the faces of a cube map.
"""

from __future__ import annotations

import json
import math

import numpy as np
import numpy.typing as npt

from warp_ar.errors import UsageError
from warp_ar.files import limits, too_much
from warp_ar.light.latlong_axes import AXES, world_from_marker
from warp_ar.signature import PROGRAM

Radiance = npt.NDArray[np.float32]
Array = npt.NDArray[np.float64]

LAYOUTS = ("latlong", "cube")

FACES = ("px", "nx", "py", "ny", "pz", "nz")
"""Faces of a cube in their order in a picture, with the names that three.js and others use for files."""

CUBES = {
    "y-up": "cube, faces +x -x +y -y +z -z from the top, y up, each as seen from inside (OpenEXR)",
    "opengl": "cube, faces +x -x +y -y +z -z from the top, y up, each as a face of OpenGL's cube map",
}
"""Values of the attribute ``axes`` for a cube."""
BASIS = ("1", "y", "z", "x", "xy", "yz", "3zz-1", "xz", "xx-yy")
"""Names of the harmonic basis functions."""
LOBE = math.pi * np.array([1.0, *[2.0 / 3.0] * 3, *[0.25] * 5])
"""Coefficient A_l of each harmonic."""
_NORMS = np.sqrt(np.array([1.0, 3.0, 3.0, 3.0, 15.0, 15.0, 1.25, 15.0, 3.75]) / (4.0 * math.pi))

# Along a row, down a column, for +x, -x, +y, -y, +z, -z.
_X, _Y, _Z = np.eye(3)
_FACES = (_X, -_X, _Y, -_Y, _Z, -_Z)
_SPANS = {
    "y-up": ((_Z, -_Y), (-_Z, -_Y), (_X, -_Z), (_X, _Z), (-_X, -_Y), (_X, -_Y)),
    "opengl": ((-_Z, -_Y), (_Z, -_Y), (_X, _Z), (_X, -_Z), (_X, -_Y), (-_X, -_Y)),
}


def check_axes(axes: str, layout: str = "latlong") -> None:
    """Check that the axes exist and are defined for the layout.

    Raises:
        UsageError: The axes or the layout do not exist, or do not fit together.
    """
    if layout not in LAYOUTS:
        raise UsageError(f"layout {layout!r}: expected {' or '.join(LAYOUTS)}")
    allowed = AXES if layout == "latlong" else tuple(CUBES)
    if axes not in allowed:
        raise UsageError(f"axes {axes!r}: expected {', '.join(allowed)} for a {layout}")


def to_cube(radiance: Radiance, axes: str, size: int | None = None) -> Radiance:
    """Return the six faces of a cube, one below the other.

    Each texel is the mean of 4 x 4 bilinear samples: at the default size, no texel is skipped or blurred.

    Args:
        radiance: Latlong (height, width, 3), z-up.
        axes: ``y-up`` (OpenEXR's faces) or ``opengl`` (faces of OpenGL's cube maps).
        size: Texels along an edge; None means half the map's rows, for equal texel sizes at the centre of a face.

    Returns:
        (6 size, size, 3), in the order +x, -x, +y, -y, +z, -z.

    Raises:
        UsageError: There are no such axes for a cube, or the size is below 1 or too large.
    """
    check_axes(axes, "cube")
    size = max(radiance.shape[0] // 2, 1) if size is None else size
    if size < 1:
        raise UsageError(f"size {size}: expected 1 texel or more along an edge")
    if 6 * size * size > limits().picture_pixels:
        raise UsageError(too_much(f"a cube of size {size}", 6 * size * size, "texels", "picture_pixels"))
    marker_from_world = world_from_marker(axes).T
    faces = np.zeros((6, size, size, 3), np.float64)
    places = (np.arange(4) + 0.5) / 4.0
    for dy in places:
        for dx in places:
            directions = cube_directions(axes, size, dy, dx) @ marker_from_world.T
            faces += sample_latlong(radiance, directions)
    return np.ascontiguousarray((faces / 16.0).astype(np.float32).reshape(6 * size, size, 3))


def cube_directions(axes: str, size: int, dy: float = 0.5, dx: float = 0.5) -> Array:
    """Return unnormalized directions, in a file's world, within each texel of a cube, (6, size, size, 3)."""
    check_axes(axes, "cube")
    right = ((np.arange(size) + dx) / size * 2.0 - 1.0)[None, :, None]
    down = ((np.arange(size) + dy) / size * 2.0 - 1.0)[:, None, None]
    spans = zip(_FACES, _SPANS[axes], strict=True)
    return np.stack([face + right * along + down * below for face, (along, below) in spans])


def sample_latlong(radiance: Radiance, directions: Array) -> Array:
    """Return bilinear samples of a z-up latlong, continuous across seam and poles.

    Args:
        radiance: (height, width, 3).
        directions: (..., 3), need not be unit.

    Returns:
        (..., 3), float64.
    """
    height, width = radiance.shape[:2]
    x, y, z = np.moveaxis(directions, -1, 0)
    row = np.arctan2(np.hypot(x, y), z) / math.pi * height - 0.5
    column = (np.arctan2(y, x) / math.pi + 1.0) * 0.5 * width - 0.5
    top, left = np.floor(row).astype(int), np.floor(column).astype(int)
    down, right = (row - top)[..., None], (column - left)[..., None]

    def at(rows: npt.NDArray[np.int_], columns: npt.NDArray[np.int_]) -> Array:
        # Beyond a pole, the same row continues half a turn away.
        beyond = (rows < 0) | (rows >= height)
        columns = np.where(beyond, columns + width // 2, columns) % width
        return np.asarray(radiance[np.clip(rows, 0, height - 1), columns], np.float64)

    above = at(top, left) * (1.0 - right) + at(top, left + 1) * right
    below = at(top + 1, left) * (1.0 - right) + at(top + 1, left + 1) * right
    return np.asarray(above * (1.0 - down) + below * down)


def project_radiance(radiance: Radiance, axes: str = "z-up") -> Array:
    """Return the coefficients L_i of a latlong, (9, 3).

    The radiance of a texel is constant, and Y_i is a product of functions of theta and phi. Its integral is the product
    of an integral over the columns (in closed form) and one over the rows (Gauss-Legendre over theta with 8 points,
    exact to rounding).

    Args:
        radiance: (height, width, 3), z-up.
        axes: One of ``AXES``; the basis functions use its x, y and z.

    Raises:
        UsageError: There are no such axes.
    """
    height, width = radiance.shape[:2]
    nodes, weights = np.polynomial.legendre.leggauss(8)
    half = 0.5 * math.pi / height
    theta = (np.arange(height)[:, None] * 2 + 1 + nodes) * half
    s, c, one = np.sin(theta), np.cos(theta), np.ones_like(theta)
    rows = (np.stack([one, s, c, s, s * s, s * c, 3.0 * c * c - 1.0, s * c, s * s]) * s * weights * half).sum(-1)
    phi = (np.arange(width + 1) * 2.0 / width - 1.0) * math.pi
    sin, cos = np.sin(phi), -np.cos(phi)
    columns = np.diff(np.stack([phi, cos, phi, sin, -np.cos(2 * phi) / 4, cos, phi, sin, np.sin(2 * phi) / 2]))
    own = _NORMS[:, None] * np.einsum("kh,hwc,kw->kc", rows, radiance.astype(np.float64), columns, optimize=True)
    # The basis of rotated directions is linear in the basis of the original ones; nine directions in general position
    # determine the matrix.
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    turned, *_ = np.linalg.lstsq(basis(directions), basis(directions @ world_from_marker(axes).T), rcond=None)
    return np.asarray(turned.T @ own)


def basis(directions: Array) -> Array:
    """Return Y_i of unit directions (n, 3), as (n, 9)."""
    x, y, z = directions.T
    own = [np.ones_like(x), y, z, x, x * y, y * z, 3.0 * z * z - 1.0, x * z, x * x - y * y]
    return np.asarray(_NORMS * np.stack(own, 1))


def encode_harmonics(radiance: Radiance, axes: str, white_level: float) -> bytes:
    """Return a latlong's harmonics as JSON.

    Args:
        radiance: (height, width, 3), z-up.
        axes: As in `project_radiance`.
        white_level: Value at which the camera clips.

    Raises:
        UsageError: There are no such axes.
    """
    coefficients = project_radiance(radiance, axes)
    z_up = world_from_marker(axes)[1, 1] == 1.0
    content = {
        "program": PROGRAM,
        "kind": "spherical harmonics",
        "axes": "x, y, z of the marker, z up" if z_up else "x, y, z = x, z, -y of the marker, y up",
        "basis": list(BASIS),
        "normalization": "orthonormal, all signs positive",
        "color": "linear, sRGB primaries, camera values",
        "whiteLevel": white_level,
        "radiance": coefficients.tolist(),
        "irradiance": (coefficients * LOBE[:, None]).tolist(),
    }
    return (json.dumps(content, indent=1) + "\n").encode()
