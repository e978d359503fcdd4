"""Cells of the environment: the unknowns of recovery, blocks of texels that may lack light by clipping.

The environment is condensed to ``CELL_ROWS`` x ``CELL_COLUMNS`` cells of a latlong grid (5.6 degrees), each with its
mean radiance, its clipped share, and the mean direction of that share (``condense_cells``). ``add_recovered`` adds
recovered radiance to the map.
"""

from __future__ import annotations

import functools

import warp as wp

from warp_ar.kernels.latlong import direction_from_latlong, latlong_from_direction, texel_solid_angle
from warp_ar.kernels.launch import row_launcher
from warp_ar.kernels.rays.shapes import FAR
from warp_ar.kernels.rays.trace import TraceConfig, make_trace
from warp_ar.kernels.structs import Probe, RayScene

wp.set_module_options({"enable_backward": False})

CELL_ROWS = wp.constant(32)
CELL_COLUMNS = 64
FULL_TRUST = wp.constant(wp.float32(0.5))
"""Confidence above which a texel counts as observed."""
LOST = 0.02
"""Clipped share from which on a cell belongs to a clipped region, and its missing light is that of clipped texels."""
_LOST = wp.constant(wp.float32(LOST))
BEYOND = wp.constant(wp.float32(0.25))
"""Share of a cell's clipped light beyond all proxies from which on its clipped texels on proxies are left out."""
MOST_LEFT = wp.constant(wp.float32(4.0))
"""Largest factor on a cell's recovered radiance if fewer of its texels clip than in the frame of the estimate."""


@wp.struct
class Cell:
    """A part of the environment."""

    radiance: wp.vec3  # mean, as captured
    clipped: wp.vec3  # mean share that may lack light: clipped, or, in a cell that shows no light, not observed
    missing: wp.vec3  # ``clipped`` with less weight on saturation boundaries
    hidden: wp.float32  # mean share that is not observed; 0 in a cell that shows some light
    modelled: wp.float32  # 1 if the first ball sees a proxy in this direction, 0 if the environment beyond
    middle: wp.vec3  # unit, direction of the cell's centre
    direction: wp.vec3  # unit, mean direction of the clipped share, or of the centre
    solid_angle: wp.float32


def cell_shape(height: int, width: int) -> tuple[int, int]:
    """Return the rows and columns of cells for a map of this size."""
    return min(CELL_ROWS, height), min(CELL_COLUMNS, width)


@wp.func
def trust(confidence: wp.float32) -> wp.float32:
    """Return the degree, 0..1, to which a texel of this confidence counts as observed; 0 for NaN."""
    t = wp.clamp(confidence / FULL_TRUST, 0.0, 1.0)
    return wp.where(confidence > 0.0, t * t * (3.0 - 2.0 * t), 0.0)


@functools.cache
def make_leave_out_edges_kernel(proxies: tuple[int, ...]) -> wp.Kernel:
    """Return the kernel of ``leave_out_edges`` for the given kinds of proxy."""
    trace = make_trace(TraceConfig(objects=(), proxies=proxies))

    @wp.kernel(module="unique", enable_backward=False)
    def leave_out_edges_kernel(
        # In:
        row_start: wp.int32,
        clipped: wp.array2d[wp.vec3],
        probes: wp.array[Probe],
        scene: RayScene,
        # Out:
        missing_out: wp.array2d[wp.vec3],
    ):
        """Write 0 for the texels of one cell that are left out: they clip by light from behind a proxy's edge."""
        band_row, column = wp.tid()
        row = row_start + band_row
        height = clipped.shape[0]
        width = clipped.shape[1]
        rows = wp.min(CELL_ROWS, height)
        on = wp.float32(0.0)
        beyond = wp.float32(0.0)
        turn = wp.int32(0)
        while turn < 2:
            for i in range(row * height // rows, (row + 1) * height // rows):
                for j in range(column * width // (2 * rows), (column + 1) * width // (2 * rows)):
                    share = clipped[i, j]
                    if wp.max(share) > 0.0:
                        direction = direction_from_latlong(wp.float32(i) + 0.5, wp.float32(j) + 0.5, height, width)
                        area = texel_solid_angle(i, height, width) * (share[0] + share[1] + share[2])
                        if not trace.occluded_by_proxies(scene, probes[0].center, direction, FAR):
                            beyond += area
                        elif turn == 0:
                            on += area
                        else:
                            missing_out[i, j] = wp.vec3(0.0, 0.0, 0.0)
            # A second pass, if texels clip both on proxies and beyond them, and enough of them lie beyond.
            turn += 1
            if not (on > 0.0 and beyond > BEYOND * (on + beyond)):
                turn = wp.int32(2)

    return leave_out_edges_kernel


leave_out_edges = row_launcher(make_leave_out_edges_kernel, like=lambda clipped, *_: cell_shape(*clipped.shape))
"""Leave out clipped texels on proxies whose light comes from behind the proxy's edge.

A pixel of the ball that shows the edge of a table and a light behind it clips, and so may its neighbours. So texels of
the table seem to lack light that comes from beyond it. If at least a quarter of a cell's clipped share lies beyond
proxies, the clipped texels on proxies are left out.

Args:
    proxies: Kinds of proxy in the scene.
    clipped: Clipped share per channel, ``wp.vec3`` (h, w).
    probes: ``Probe`` (P), at least one: the ball.
    scene: Its proxies are known surfaces.
    missing_out: From ``weigh_boundaries``, ``wp.vec3`` (h, w); set to 0 in the texels that are left out.
"""


@functools.cache
def make_condense_cells_kernel(proxies: tuple[int, ...]) -> wp.Kernel:
    """Return the kernel of ``condense_cells`` for the given kinds of proxy."""
    trace = make_trace(TraceConfig(objects=(), proxies=proxies))

    @wp.kernel(module="unique", enable_backward=False)
    def condense_cells_kernel(
        # In:
        row_start: wp.int32,
        radiance: wp.array2d[wp.vec3],
        confidence: wp.array2d[wp.float32],
        clipped: wp.array2d[wp.vec3],
        missing: wp.array2d[wp.vec3],
        probes: wp.array[Probe],
        scene: RayScene,
        # Out:
        cells_out: wp.array2d[Cell],
    ):
        band_row, column = wp.tid()
        row = row_start + band_row
        height = radiance.shape[0]
        width = radiance.shape[1]
        rows = cells_out.shape[0]
        columns = cells_out.shape[1]
        cell = Cell()
        toward = wp.vec3(0.0, 0.0, 0.0)
        lost_toward = wp.vec3(0.0, 0.0, 0.0)
        # Sums over texels that were not left out.
        kept = wp.vec3(0.0, 0.0, 0.0)
        kept_toward = wp.vec3(0.0, 0.0, 0.0)
        for i in range(row * height // rows, (row + 1) * height // rows):
            area = texel_solid_angle(i, height, width)
            for j in range(column * width // columns, (column + 1) * width // columns):
                direction = direction_from_latlong(wp.float32(i) + 0.5, wp.float32(j) + 0.5, height, width)
                trusted = trust(confidence[i, j])
                lost = trusted * clipped[i, j]
                cell.solid_angle += area
                cell.radiance += area * radiance[i, j]
                cell.clipped += area * lost
                cell.missing += area * trusted * missing[i, j]
                cell.hidden += area * (1.0 - trusted)
                toward += area * direction
                lost_toward += area * (lost[0] + lost[1] + lost[2]) * direction
                if wp.max(missing[i, j]) > 0.0:
                    kept += area * lost
                    kept_toward += area * (lost[0] + lost[1] + lost[2]) * direction
        if wp.max(kept) > 0.0:
            cell.clipped = kept
            lost_toward = kept_toward
        cell.radiance /= cell.solid_angle
        cell.clipped /= cell.solid_angle
        cell.missing /= cell.solid_angle
        cell.hidden /= cell.solid_angle
        if wp.max(cell.clipped) > _LOST:
            cell.hidden = 0.0
        else:
            cell.clipped += cell.hidden * wp.vec3(1.0, 1.0, 1.0)
            cell.missing += cell.hidden * wp.vec3(1.0, 1.0, 1.0)
        cell.middle = wp.normalize(toward)
        cell.direction = cell.middle
        if wp.length(lost_toward) > 0.0:
            cell.direction = wp.normalize(lost_toward)
        if trace.occluded_by_proxies(scene, probes[0].center, cell.direction, FAR):
            cell.modelled = 1.0
        cells_out[row, column] = cell

    return condense_cells_kernel


condense_cells = row_launcher(make_condense_cells_kernel)
"""Condense a map to cells. Clipped texels that ``leave_out_edges`` left out do not count.

Args:
    proxies: Kinds of proxy in the scene.
    radiance: ``wp.vec3`` (h, w), completed.
    confidence: Confidence of each texel, ``wp.float32`` (h, w).
    clipped: Clipped share per channel, ``wp.vec3`` (h, w).
    missing: Clipped share from ``weigh_boundaries``, ``wp.vec3`` (h, w).
    probes: ``Probe`` (P), at least one.
    scene: Its proxies are known surfaces: clipped texels on them are lit, not emitters.
    cells_out: ``Cell``, ``cell_shape(h, w)``.
"""


@wp.func
def missing_share(confidence: wp.float32, missing: wp.vec3, unseen: wp.float32) -> wp.vec3:
    """Return the share of a texel that lacks light; ``unseen`` is the weight of the part that is not observed."""
    trusted = trust(confidence)
    return trusted * missing + unseen * (1.0 - trusted) * wp.vec3(1.0, 1.0, 1.0)


@wp.kernel(enable_backward=False)
def add_recovered_kernel(
    # In:
    row_start: wp.int32,
    radiance: wp.array2d[wp.vec3],
    confidence: wp.array2d[wp.float32],
    missing: wp.array2d[wp.vec3],
    cells: wp.array2d[Cell],
    recovered: wp.array2d[wp.vec3],
    # Out:
    recovered_out: wp.array2d[wp.vec3],
):
    """Add a cell's recovered radiance to its texels, to each in proportion to its share that lacks light."""
    band_row, column = wp.tid()
    row = row_start + band_row
    height = radiance.shape[0]
    width = radiance.shape[1]
    top = row * height // recovered.shape[0]
    bottom = (row + 1) * height // recovered.shape[0]
    left = column * width // recovered.shape[1]
    right = (column + 1) * width // recovered.shape[1]
    unseen = wp.where(cells[row, column].hidden > 0.0, 1.0, 0.0)
    now = wp.vec3(0.0, 0.0, 0.0)
    solid_angle = wp.float32(0.0)
    for i in range(top, bottom):
        area = texel_solid_angle(i, height, width)
        for j in range(left, right):
            now += area * missing_share(confidence[i, j], missing[i, j], unseen)
            solid_angle += area
    now /= solid_angle
    more = recovered[row, column]
    then = cells[row, column].missing
    for c in range(3):
        if now[c] > 0.0:
            more[c] *= wp.min(then[c] / now[c], MOST_LEFT)
    for i in range(top, bottom):
        for j in range(left, right):
            share = missing_share(confidence[i, j], missing[i, j], unseen)
            recovered_out[i, j] = radiance[i, j] + wp.cw_mul(share, more)


add_recovered = row_launcher(add_recovered_kernel, like=lambda *given: given[-2])
"""Add recovered radiance to the texels that lack light.

If the clipped share of a cell has changed since its radiance was recovered, its recovered energy stays the same. (A
clipped thousandth of a cell may have a high radiance, and grow to half of the cell in the next frame; a video codec
moves the weakest channel of an emitter across clipping and back.) Only below a quarter of the share does the energy
fall with the share.

Args:
    radiance: As captured and completed, ``wp.vec3`` (h, w).
    confidence: Confidence of each texel, ``wp.float32`` (h, w).
    missing: Clipped share per channel from ``weigh_boundaries``, ``wp.vec3`` (h, w).
    cells: ``Cell``, ``cell_shape(h, w)``, of the frame from which light was recovered.
    recovered: Radiance that a wholly clipped texel lacks, per cell: ``wp.vec3``, ``cell_shape(h, w)``.
    recovered_out: ``wp.vec3`` (h, w).
"""


@wp.func
def cell_of(direction: wp.vec3, rows: wp.int32, columns: wp.int32) -> wp.int32:
    """Return the index of the cell that contains a direction."""
    at = latlong_from_direction(direction, rows, columns)
    row = wp.clamp(wp.int32(at[0]), 0, rows - 1)
    return row * columns + wp.clamp(wp.int32(at[1]), 0, columns - 1)
