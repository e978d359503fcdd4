"""Latlong maps in the axes of other programs.

A latlong map of this program (``z-up``) has row 0 toward +z and its centre column toward +x, and its columns grow
toward +y: seen from the ball's place it is a mirror image. Every other latlong here is a picture as it is seen from
the inside, with the columns growing to the right of who looks at the centre:

    name      world                            centre column   columns grow toward
    z-up      z up, of the marker              +x              +y
    blender   the same                         +x              -y
    y-up      y up, (x, z, -y) of the marker   +z              -x
    opengl    the same                         -z              +x

All four have +z of the marker above, so the maps differ by a mirror image and a turn by quarters: texels change places,
none is filtered.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from warp_ar.errors import UsageError

Map = npt.NDArray[np.float32]

AXES = ("z-up", "blender", "y-up", "opengl")
"""What a file's directions are told in; ``z-up`` is this program's own."""

DESCRIPTIONS = {
    "z-up": "latlong, row 0 toward +z (up), centre column toward +x, columns grow toward +y",
    "blender": "latlong, row 0 toward +z (up), centre column toward +x, columns grow toward -y",
    "y-up": "latlong, row 0 toward +y (up), centre column toward +z, columns grow toward -x",
    "opengl": "latlong, row 0 toward +y (up), centre column toward -z, columns grow toward +x",
}
"""What a latlong's attribute ``axes`` says."""


def to_axes(radiance: Map, axes: str) -> Map:
    """A latlong of this program in other axes, texel by texel.

    Args:
        radiance: (height, width, 3) or (height, width), z-up.
        axes: One of ``AXES``.

    Returns:
        The same shape.

    Raises:
        UsageError: There are no such axes, or a quarter of the map is no whole number of columns.
    """
    _check(axes)
    if axes == "z-up":
        return radiance
    mirrored = radiance[:, ::-1]  # columns grow toward -y, the centre stays between the two middle ones
    return np.ascontiguousarray(np.roll(mirrored, _quarter(mirrored, axes), 1))


def from_axes(radiance: Map, axes: str) -> Map:
    """A latlong in other axes as this program's own; arguments and errors as `to_axes`."""
    _check(axes)
    if axes == "z-up":
        return radiance
    return np.ascontiguousarray(np.roll(radiance, -_quarter(radiance, axes), 1)[:, ::-1])


def _check(axes: str) -> None:
    if axes not in AXES:
        raise UsageError(f"axes {axes!r}: expected {', '.join(AXES)} for a latlong")


def _quarter(radiance: Map, axes: str) -> int:
    """Columns by which a map that is centred on +x must go right to be centred as ``axes`` say.

    ``y-up`` is centred on -y of the marker, which the map holds a quarter right of +x; ``opengl`` on +y.
    """
    if axes == "blender":
        return 0
    width = int(radiance.shape[1])
    if width % 4:
        raise UsageError(f"a latlong of {width} columns has no whole quarter; axes {axes} need a width divisible by 4")
    return -width // 4 if axes == "y-up" else width // 4
