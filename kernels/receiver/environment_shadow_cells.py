"""Cells of the shadows of the environment: where they are estimated, with which samples, and what is kept of them.

One pixel of every ``stride x stride`` is estimated. The cells of a tile of ``side x side`` use one set of samples each,
and every set in turn; a filter then averages over one tile's worth of cells (``environment_shadow_filter``), so that
each set counts the same [KH01]. All of it is a function of the frame alone: nothing flickers and nothing lags.

References:
    [KH01] Keller, Heidrich 2001, Interleaved Sampling.
"""

from __future__ import annotations

import dataclasses
from typing import Literal

import warp as wp

from warp_ar.kernels.objects.reflect import DistantLightConfig
from warp_ar.kernels.rays.visibility import inside_rect

wp.set_module_options({"enable_backward": False})

SHADED_TILE = wp.constant(4)
"""Cells along a tile that notes whether something in it is shaded."""
CHUNK = wp.constant(64)
"""Samples that are culled together: the bits of a mask."""
WARP_LANES = 32
"""Threads of a CUDA device that go the same way or wait for each other."""
TILE_ROWS, TILE_COLUMNS = 4, 8
"""Cells of a warp, where it takes a square of the frame."""
MIN_IRRADIANCE = wp.constant(wp.float32(1.0e-6))
"""Irradiance, in camera values, below which a surface is dark and a shadow on it means nothing."""
MAX_RATIO = wp.constant(wp.float32(4.0))
"""Largest factor: what objects bounce onto a dark place is bounded, as the picture of it is mostly noise."""
MAX_RETURN = wp.constant(wp.float32(0.99))
"""Largest share of its light that the receiver gets back from objects, estimated: what goes to and fro stays finite."""


@dataclasses.dataclass(frozen=True)
class EnvironmentShadowConfig:
    """What is compiled into the kernels."""

    distant: DistantLightConfig
    """Kinds of shape and forms of light."""
    count: int
    """Samples per set: up to 64, or a multiple of it."""
    side: int
    """Cells along a tile; there are side^2 sets."""
    bounce: Literal["estimated", "traced"]
    """How what objects reflect onto the receiver is found."""
    secondary: float = 1.0
    """Share of a set, its first samples, whose rays ask what an object that they meet sends; others stop there."""
    emitters: bool = False
    """Whether some samples are emitters at a known distance."""
    partials: int = 1
    """Partial sums per cell of the wavefront, a thread each: a divisor of count."""

    def __post_init__(self) -> None:
        if self.count > CHUNK and self.count % CHUNK:
            raise ValueError(f"count is {self.count}; expected up to {CHUNK} or a multiple of it")
        if not 1 <= self.secondary_count <= self.count:
            raise ValueError(f"secondary is {self.secondary}; expected a share of {self.count} samples")
        if self.count % self.partials:
            raise ValueError(f"partials is {self.partials}; expected a divisor of {self.count}")

    @property
    def secondary_count(self) -> int:
        """Samples of a set that send secondary rays."""
        return round(self.count * self.secondary)


@wp.struct
class ShadowCells:
    """Estimates of all cells and what the filter makes of them; shaded and changed may be empty."""

    stride: wp.int32  # pixels from one estimate to the next
    ratio: wp.array2d[wp.vec4]  # RGB share of the environment that is not hidden, and depth; 1 where no surface is
    bounced: wp.array2d[wp.vec3]  # what objects send there, relative to the environment
    surface: wp.array2d[wp.int32]  # number of the surface that the cell shows; -1: none, and ratio holds nothing
    shaded: wp.array2d[wp.int32]  # per tile: number of the last frame in which something in it was shaded
    filtered: wp.array2d[wp.vec3]  # factor on the frame; written only where a surface is seen
    changed: wp.array2d[wp.int32]  # per tile: number of the last frame in which some factor in it was not 1


@wp.func
def ratio_of(without: wp.vec3, hidden: wp.vec3, depth: wp.float32) -> wp.vec4:
    """Share of the environment that is left, and the depth beside it."""
    ratio = wp.vec4(1.0, 1.0, 1.0, depth)
    for channel in range(3):
        if without[channel] > MIN_IRRADIANCE:
            ratio[channel] = wp.clamp(1.0 - hidden[channel] / without[channel], 0.0, 1.0)
    return ratio


@wp.func
def bounced_of(without: wp.vec3, hidden: wp.vec3, sent: wp.vec3, returned: wp.vec3) -> wp.vec3:
    """What objects send, relative to the environment; ``returned`` is the part that the receiver itself must light."""
    ratio = wp.vec3(0.0)
    for channel in range(3):
        if without[channel] > MIN_IRRADIANCE:
            left = wp.clamp(1.0 - hidden[channel] / without[channel], 0.0, 1.0)
            back = wp.min(returned[channel] / without[channel], MAX_RETURN)
            total = (left + sent[channel] / without[channel]) / (1.0 - back)
            ratio[channel] = wp.min(total - left, MAX_RATIO)
    return ratio


@wp.func
def cell_column(thread: wp.int32, columns: wp.int32, side: wp.int32, lanes: wp.int32) -> wp.int32:
    """Column of the cell that a thread takes: neighbours take those of one set, so that their rays go the same way."""
    group = lanes * side
    place = thread % group
    if thread - place + group > columns:
        return thread
    return thread - place + (place % lanes) * side + place / lanes


@wp.func
def tiled_cell(i: wp.int32, thread: wp.int32, side: wp.int32, columns: wp.int32) -> wp.vec2i:
    """Row and column of the cell of a thread, of those that ``tiled_shape`` asks for; ``columns`` is its second.

    A warp takes cells of one set, so that their rays go the same way, from a square of the frame, so that they meet the
    same or nothing: TILE_ROWS x TILE_COLUMNS of them, ``side`` apart. The warps that follow take the other sets there.
    """
    number = i * columns + thread
    lane = number % WARP_LANES
    one_of = number / WARP_LANES % (side * side)
    tile = number / (WARP_LANES * side * side)
    across = columns / (TILE_COLUMNS * side)
    row = (tile / across * TILE_ROWS + lane / TILE_COLUMNS) * side + one_of / side
    return wp.vec2i(row, (tile % across * TILE_COLUMNS + lane % TILE_COLUMNS) * side + one_of % side)


def tiled_shape(rows: int, columns: int, side: int) -> tuple[int, int]:
    """Rows and columns of threads with which ``tiled_cell`` reaches all cells, and some beyond."""
    down, across = side * int(TILE_ROWS), side * int(TILE_COLUMNS)
    return -(-rows // down) * down, -(-columns // across) * across


@wp.func
def first_of_set(i: wp.int32, j: wp.int32, side: wp.int32, count: wp.int32) -> wp.int32:
    """First sample of a cell's set; ``count`` are all sets together."""
    return count / (side * side) * ((i % side) * side + j % side)


@wp.func
def can_matter(row: wp.int32, column: wp.int32, margin: wp.int32, rect: wp.vec4i) -> wp.bool:
    """Whether the filter may read a cell estimated at this pixel: it reads ``margin`` beyond the rectangle."""
    wide = wp.vec4i(rect[0] - margin, rect[1] + margin, rect[2] - margin, rect[3] + margin)
    return rect[0] < rect[1] and inside_rect(row, column, wide)


@wp.func
def any_shaded(shaded: wp.array2d[wp.int32], frame_index: wp.int32, rows: wp.vec2i, columns: wp.vec2i) -> wp.bool:
    """Whether a tile of cells from the first to the last row and column is noted in this frame."""
    for a in range(wp.max(rows[0], 0) / SHADED_TILE, wp.min(rows[1] / SHADED_TILE + 1, shaded.shape[0])):
        for b in range(wp.max(columns[0], 0) / SHADED_TILE, wp.min(columns[1] / SHADED_TILE + 1, shaded.shape[1])):
            if shaded[a, b] == frame_index:
                return True
    return False


def shaded_shape(rows: int, columns: int) -> tuple[int, int]:
    """Shape of the arrays that note tiles, for so many cells."""
    return -(-rows // int(SHADED_TILE)), -(-columns // int(SHADED_TILE))
