"""Environments in the axes and layouts of other programs.

A latlong map of this program (``z-up``) has row 0 toward +z and its centre column toward +x, and its columns grow
toward +y: seen from the ball's place it is a mirror image. Every other latlong here is a picture as it is seen from
the inside, with the columns growing to the right of who looks at the centre:

    name      world                            centre column   columns grow toward
    z-up      z up, of the marker              +x              +y
    blender   the same                         +x              -y
    y-up      y up, (x, z, -y) of the marker   +z              -x
    opengl    the same                         -z              +x

``y-up`` is what OpenEXR means by a latlong and a cube, and USD's dome light takes it. ``blender`` is what Blender's
world takes; three.js, whose world is that of ``y-up``, shows the same picture in the right place. All four have +z of
the marker above, so the maps differ by a mirror image and a turn by quarters: texels change places, none is filtered.

References:
    OpenEXR, Technical Introduction, Environment Maps, and ``ImfEnvmap``.
    OpenGL 4.6 core profile, table 8.19: directions within the faces of a cube map.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from warp_ar.errors import UsageError
from warp_ar.files import limits, too_much
from warp_ar.light.latlong_axes import AXES, DESCRIPTIONS, from_axes, to_axes, world_from_marker

__all__ = [
    "AXES",
    "CUBES",
    "DESCRIPTIONS",
    "FACES",
    "LAYOUTS",
    "check_axes",
    "from_axes",
    "to_axes",
    "to_cube",
    "world_from_marker",
]

Radiance = npt.NDArray[np.float32]
Array = npt.NDArray[np.float64]

LAYOUTS = ("latlong", "cube")

FACES = ("px", "nx", "py", "ny", "pz", "nz")
"""Faces of a cube in the order in which they lie, as three.js and others name their files."""

CUBES = {
    "y-up": "cube, faces +x -x +y -y +z -z from the top, y up, each as seen from inside (OpenEXR)",
    "opengl": "cube, faces +x -x +y -y +z -z from the top, y up, each as a face of OpenGL's cube map",
}
"""What a cube's attribute ``axes`` says."""

# Along a row, down a column, for +x, -x, +y, -y, +z, -z.
_X, _Y, _Z = np.eye(3)
_FACES = (_X, -_X, _Y, -_Y, _Z, -_Z)
_SPANS = {
    "y-up": ((_Z, -_Y), (-_Z, -_Y), (_X, -_Z), (_X, _Z), (-_X, -_Y), (_X, -_Y)),
    "opengl": ((-_Z, -_Y), (_Z, -_Y), (_X, _Z), (_X, -_Z), (_X, -_Y), (-_X, -_Y)),
}


def check_axes(axes: str, layout: str = "latlong") -> None:
    """Check that these axes are known, and told for this layout.

    Raises:
        UsageError: They are not, or there is no such layout.
    """
    if layout not in LAYOUTS:
        raise UsageError(f"layout {layout!r}: expected {' or '.join(LAYOUTS)}")
    allowed = AXES if layout == "latlong" else tuple(CUBES)
    if axes not in allowed:
        raise UsageError(f"axes {axes!r}: expected {', '.join(allowed)} for a {layout}")


def to_cube(radiance: Radiance, axes: str, size: int | None = None) -> Radiance:
    """The six faces of a cube, one below the other.

    Each texel is the mean of 4 x 4 bilinear samples: a cube of the usual size neither skips a texel nor blurs one.

    Args:
        radiance: Latlong (height, width, 3), z-up.
        axes: ``y-up`` (faces as OpenEXR has them) or ``opengl`` (as OpenGL's cube maps have them).
        size: Texels along an edge; None means half the map's rows, for like texels at the centre of a face.

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
    """Directions, not unit, in a file's world at a place within each texel of a cube, (6, size, size, 3)."""
    check_axes(axes, "cube")
    right = ((np.arange(size) + dx) / size * 2.0 - 1.0)[None, :, None]
    down = ((np.arange(size) + dy) / size * 2.0 - 1.0)[:, None, None]
    spans = zip(_FACES, _SPANS[axes], strict=True)
    return np.stack([face + right * along + down * below for face, (along, below) in spans])


def sample_latlong(radiance: Radiance, directions: Array) -> Array:
    """Bilinear samples of a z-up latlong, continuous across seam and poles.

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
        # Beyond a pole lies the same row, half a turn away.
        beyond = (rows < 0) | (rows >= height)
        columns = np.where(beyond, columns + width // 2, columns) % width
        return np.asarray(radiance[np.clip(rows, 0, height - 1), columns], np.float64)

    above = at(top, left) * (1.0 - right) + at(top, left + 1) * right
    below = at(top + 1, left) * (1.0 - right) + at(top + 1, left + 1) * right
    return np.asarray(above * (1.0 - down) + below * down)
