"""Cells of the frame: blocks of ``stride x stride`` pixels. Each is estimated at one pixel near its middle."""

from __future__ import annotations

import math

import warp as wp

wp.set_module_options({"enable_backward": False})

STRIDE_ROWS = 480
"""Rows of the frame for which strides are set; ``cell_stride`` converts them to other frames."""


@wp.func
def cell_pixel(cell: wp.int32, stride: wp.int32, size: wp.int32) -> wp.int32:
    """Return the row (or column) of the pixel at which a cell is estimated, in a frame of ``size`` rows (columns)."""
    return wp.min(cell * stride + stride / 2, size - 1)


@wp.func
def cell_place(pixel: wp.int32, stride: wp.int32, size: wp.int32) -> wp.float32:
    """Return the fractional cell index of a pixel's row or column.

    It is an integer at the pixel that ``cell_pixel`` returns for a cell, linear between such pixels, and clamped to the
    first and last cell.
    """
    last = (size - 1) / stride
    low = wp.clamp((pixel - stride / 2) / stride, 0, last)
    here = cell_pixel(low, stride, size)
    there = cell_pixel(wp.min(low + 1, last), stride, size)
    if pixel <= here or there <= here:
        return wp.float32(low)
    return wp.float32(low) + wp.min(wp.float32(pixel - here) / wp.float32(there - here), 1.0)


@wp.struct
class SurfaceCells:
    """Values of cells, and the surface on which each cell lies."""

    values: wp.array2d[wp.vec3]
    surface: wp.array2d[wp.int32]  # ``surface_key`` of the cell; -1: none, and its value is not valid
    stride: wp.int32  # pixels along a cell


@wp.func
def look_up_cells(cells: SurfaceCells, key: wp.int32, size: wp.vec2i, row: wp.int32, col: wp.int32) -> wp.vec4:
    """Interpolate cells bilinearly at a pixel, using only those that show the pixel's surface.

    ``key`` is the ``surface_key`` of the pixel, ``size`` the rows and columns of the frame. Return (RGB, 1), or zero if
    none of the four cells around the pixel shows that surface. If all that show it have a bilinear weight of 0, return
    (their mean, 1).
    """
    y = cell_place(row, cells.stride, size[0])
    x = cell_place(col, cells.stride, size[1])
    i0 = wp.int32(y)
    j0 = wp.int32(x)
    total = wp.vec3()
    weights = float(0.0)
    beside = wp.vec3()
    count = float(0.0)
    for a in range(2):
        for b in range(2):
            i = wp.min(i0 + a, cells.values.shape[0] - 1)
            j = wp.min(j0 + b, cells.values.shape[1] - 1)
            if cells.surface[i, j] == key:
                weight = (1.0 - wp.abs(y - wp.float32(i0 + a))) * (1.0 - wp.abs(x - wp.float32(j0 + b)))
                if weight > 0.0:
                    total += weight * cells.values[i, j]
                    weights += weight
                else:
                    beside += cells.values[i, j]
                    count += 1.0
    if weights <= 0.0:
        if count <= 0.0:
            return wp.vec4()
        total = beside
        weights = count
    mean = total / weights
    return wp.vec4(mean[0], mean[1], mean[2], 1.0)


@wp.func
def any_cell_above_zero(cells: SurfaceCells, size: wp.vec2i, row: wp.int32, col: wp.int32) -> wp.bool:
    """Return whether any cell that ``look_up_cells`` may read for a pixel holds more than zero."""
    i0 = wp.int32(cell_place(row, cells.stride, size[0]))
    j0 = wp.int32(cell_place(col, cells.stride, size[1]))
    for a in range(2):
        for b in range(2):
            i = wp.min(i0 + a, cells.values.shape[0] - 1)
            j = wp.min(j0 + b, cells.values.shape[1] - 1)
            if cells.surface[i, j] >= 0 and wp.max(cells.values[i, j]) > 0.0:
                return True
    return False


def cell_stride(stride: int, rows: int, *, slowly: bool = False) -> int:
    """Return the side of a cell in pixels, for a frame of ``rows`` rows.

    Args:
        stride: Side of a cell in a frame of ``STRIDE_ROWS`` rows; 1 means every pixel, in any frame.
        rows: Rows of the frame.
        slowly: If True, cells grow with the square root of the rows, so that larger frames have more cells. If False,
            they grow with the rows, and the number of cells stays the same.
    """
    grown = stride * math.sqrt(rows / STRIDE_ROWS) if slowly else stride * rows / STRIDE_ROWS
    return 1 if stride == 1 else max(1, round(grown))


def cell_shape(size: tuple[int, int], stride: int) -> tuple[int, int]:
    """Return the rows and columns of cells in a frame of ``size`` (width, height)."""
    width, height = size
    return -(-height // stride), -(-width // stride)
