"""Axes of latlong maps in other programs: their names in files, and conversion between them.

``output.environment_axes`` documents all axes and converts to cube maps.
"""

from __future__ import annotations

import pathlib

import numpy as np
import numpy.typing as npt
import OpenEXR

from warp_ar.errors import UsageError, WarpArError
from warp_ar.exr_file import LinearPicture, say_once
from warp_ar.scene.description import LATLONG_AXES
from warp_ar.signature import PROGRAM

Radiance = npt.NDArray[np.float32]
Array = npt.NDArray[np.float64]

AXES = LATLONG_AXES
"""Names of axes."""

DESCRIPTIONS = {
    "z-up": "latlong, row 0 toward +z (up), centre column toward +x, columns grow toward +y",
    "blender": "latlong, row 0 toward +z (up), centre column toward +x, columns grow toward -y",
    "y-up": "latlong, row 0 toward +y (up), centre column toward +z, columns grow toward -x",
    "opengl": "latlong, row 0 toward +y (up), centre column toward -z, columns grow toward +x",
}
"""Values of the attribute ``axes`` of a latlong file, by the names of axes."""

_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def world_from_marker(axes: str) -> Array:
    """Return the rotation from the marker's axes to those of a file's world, (3, 3).

    Raises:
        UsageError: The name of the axes is unknown.
    """
    _check(axes)
    return _Y_UP.copy() if axes in ("y-up", "opengl") else np.eye(3)


def _check(axes: str) -> None:
    if axes not in AXES:
        raise UsageError(f"axes {axes!r}: expected {', '.join(AXES)} for a latlong")


def to_axes(radiance: Radiance, axes: str) -> Radiance:
    """Return a latlong of this program in other axes, without interpolation.

    Args:
        radiance: Latlong map, z-up, (height, width, 3).
        axes: One of ``AXES``.

    Returns:
        The converted map, of the same shape.

    Raises:
        UsageError: The axes are unknown, or a quarter of the map is not a whole number of columns.
    """
    _check(axes)
    if axes == "z-up":
        return radiance
    mirrored = radiance[:, ::-1]  # columns now grow toward -y; the centre stays between the two middle columns
    return np.ascontiguousarray(np.roll(mirrored, _quarter(mirrored, axes), 1))


def from_axes(radiance: Radiance, axes: str) -> Radiance:
    """Return a latlong in other axes converted to this program's.

    If a quarter of the map is not a whole number of columns, the map is interpolated by half a texel.

    Args:
        radiance: Latlong map in axes ``axes``, (height, width, 3).
        axes: One of ``AXES``.

    Raises:
        UsageError: The axes are unknown, or the number of columns is odd.
    """
    _check(axes)
    if axes == "z-up":
        return radiance
    if axes != "blender" and radiance.shape[1] % 4 == 2:
        doubled = np.repeat(radiance, 2, 1)
        turned = np.roll(doubled, -_quarter(doubled, axes), 1)[:, ::-1]
        return np.ascontiguousarray((turned[:, ::2] + turned[:, 1::2]) / 2, radiance.dtype)
    return np.ascontiguousarray(np.roll(radiance, -_quarter(radiance, axes), 1)[:, ::-1])


def axes_of(picture: LinearPicture, path: pathlib.Path, asked: str | None, error: type[WarpArError], label: str) -> str:
    """Return the name of a latlong file's axes, and print them if they are assumed.

    An OpenEXR can state its axes in the attribute ``axes``. Without this attribute, it has the convention of its
    format, y-up. The Radiance format has no convention; its files have the axes with which Blender and three.js read
    them.

    Args:
        picture: Content of the file, from `read_linear_picture`.
        path: Path of the file.
        asked: Axes stated by the user; None: not stated.
        error: Class of the error to raise.
        label: Name of the file in messages.

    Raises:
        WarpArError: The file has the faces of a cube, or its attribute names unknown axes; of the class ``error``.
    """
    if picture.header.get("envmap") == OpenEXR.ENVMAP_CUBE:
        raise error(f"{label} holds the faces of a cube; a latlong is needed")
    if asked is not None:
        return asked
    said = picture.header.get("axes")
    if said is not None:
        known = {text: name for name, text in DESCRIPTIONS.items()}
        if str(said) not in known:
            raise error(f"{label}: its attribute axes is {str(said)[:120]!r}; expected one of: {'; '.join(known)}")
        return known[str(said)]
    if picture.header.get("software") == PROGRAM:
        return "z-up"
    taken, whose = ("blender", "as Blender reads .hdr") if path.suffix.lower() == ".hdr" else ("y-up", "OpenEXR's own")
    say_once(f"{label} does not state its axes: {taken} is assumed, {whose}; else give axes (--light-axes, [light])")
    return taken


def _quarter(radiance: Radiance, axes: str) -> int:
    """Return the number of columns by which a map centred on +x is shifted right to have the centre of other axes.

    Maps in axes ``y-up`` are centred on -y of the marker, a quarter of the map to the right of +x; those in ``opengl``
    on +y.
    """
    if axes == "blender":
        return 0
    width = int(radiance.shape[1])
    if width % 4:
        raise UsageError(f"a latlong of {width} columns cannot be turned to axes {axes}; expected a multiple of 4")
    return -width // 4 if axes == "y-up" else width // 4
