"""Latlong maps in the axes of other programs: what files call them, and texels moved from one to another.

``output.environment_axes`` has the table of all axes, and cubes.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from warp_ar.errors import UsageError

Radiance = npt.NDArray[np.float32]
Array = npt.NDArray[np.float64]

AXES = ("z-up", "blender", "y-up", "opengl")
"""What a file's directions are told in; ``z-up`` is this program's own."""

DESCRIPTIONS = {
    "z-up": "latlong, row 0 toward +z (up), centre column toward +x, columns grow toward +y",
    "blender": "latlong, row 0 toward +z (up), centre column toward +x, columns grow toward -y",
    "y-up": "latlong, row 0 toward +y (up), centre column toward +z, columns grow toward -x",
    "opengl": "latlong, row 0 toward +y (up), centre column toward -z, columns grow toward +x",
}
"""What a latlong's attribute ``axes`` says."""

_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def world_from_marker(axes: str) -> Array:
    """Rotation from the marker's axes to those of a file's world, (3, 3).

    Raises:
        UsageError: There are no axes of this name.
    """
    _check(axes)
    return _Y_UP.copy() if axes in ("y-up", "opengl") else np.eye(3)


def _check(axes: str) -> None:
    if axes not in AXES:
        raise UsageError(f"axes {axes!r}: expected {', '.join(AXES)} for a latlong")


def to_axes(radiance: Radiance, axes: str) -> Radiance:
    """A latlong of this program in other axes, texel by texel.

    Args:
        radiance: (height, width, 3), z-up.
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


def from_axes(radiance: Radiance, axes: str) -> Radiance:
    """A latlong in other axes as this program's own; arguments and errors as `to_axes`."""
    _check(axes)
    if axes == "z-up":
        return radiance
    return np.ascontiguousarray(np.roll(radiance, -_quarter(radiance, axes), 1)[:, ::-1])


def _quarter(radiance: Radiance, axes: str) -> int:
    """Columns by which a map that is centred on +x must go right to be centred as ``axes`` say.

    ``y-up`` is centred on -y of the marker, which the map holds a quarter right of +x; ``opengl`` on +y.
    """
    if axes == "blender":
        return 0
    width = int(radiance.shape[1])
    if width % 4:
        raise UsageError(f"a latlong of {width} columns has no whole quarter; axes {axes} need a width divisible by 4")
    return -width // 4 if axes == "y-up" else width // 4
