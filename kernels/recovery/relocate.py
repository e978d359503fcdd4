"""Light that clips in the mirror balls, put back in the maps of the balls after the first.

It is recovered in the first ball's map, M, from F, that map as captured: the recovered radiance is M - F. Another
ball, at c, sees the part of it that comes from near emitters along other directions, and stronger or weaker. Where such
emitters are known by their places, it is turned (``relocate``):

    M'(d) = F'(d) + g(d) max(M - F, 0)(turned(d)),

with ``correct_parallax`` for the turn and ``solid_angle_gain`` for g.

Where none is, the other ball tells itself in which directions its light clips, and what it lacks is taken to be as much
as the first one does, as of light far away (``share_recovered``). With a' the solid angle and s' the share of its
texels that lack light, and e_k what was found in cell k of the first ball's map, radiance times solid angle,

    M'(d) = F'(d) + s'(d) sum over k of w_k(d) e_k / sum over d of a' s' w_k,
    w_k(d) = 1 / (|d - d_k|^2 + NEARBY^2)^2:

of one lamp all goes where the other ball sees it, of several each to the nearest. What nothing in the other map clips
for, and what was found where the first ball sees nothing, stays in its direction. Shares are no measure of how large a
lamp is: one of a pixel or two has another share in every picture.
"""

from __future__ import annotations

import warp as wp

from warp_ar.kernels.emitters import MAX_DISTANCE, correct_parallax, seen_from, solid_angle_gain
from warp_ar.kernels.latlong import direction_from_latlong, sample_latlong, texel_solid_angle
from warp_ar.kernels.launch import launch, row_launcher
from warp_ar.kernels.recovery.recover_cells import Cell, trust
from warp_ar.kernels.structs import Emitter

wp.set_module_options({"enable_backward": False})


NEARBY = wp.constant(wp.float32(0.2))
"""Distance of unit directions within which cells count alike: a lamp's own, and the next beside it."""


@wp.func
def any_near(emitters: wp.array[Emitter]) -> wp.bool:
    """Return whether an emitter is known by its place."""
    near = bool(False)
    for k in range(emitters.shape[0]):
        near = near or (emitters[k].distance > 0.0 and emitters[k].distance < MAX_DISTANCE)
    return near


@wp.kernel(enable_backward=False)
def relocate_kernel(
    # In:
    row_start: wp.int32,
    filled: wp.array2d[wp.vec3],
    environment: wp.array2d[wp.vec3],
    captured: wp.array2d[wp.vec3],
    emitters: wp.array[Emitter],
    places: wp.array[wp.vec4],
    ball: wp.int32,
    # Out:
    environment_out: wp.array2d[wp.vec3],
):
    """A texel, where an emitter is known by its place; else all is left as it is."""
    i, j = wp.tid()
    i += row_start
    if not any_near(emitters):
        return
    direction = direction_from_latlong(wp.float32(i) + 0.5, wp.float32(j) + 0.5, filled.shape[0], filled.shape[1])
    place = places[ball]
    center = wp.vec3(place[0], place[1], place[2])
    gain = solid_angle_gain(emitters, center, direction)
    turned = correct_parallax(emitters, center, direction)
    recovered = sample_latlong(environment, turned) - sample_latlong(captured, turned)
    environment_out[i, j] = filled[i, j] + gain * wp.max(recovered, wp.vec3(0.0))


@wp.func
def kinship(a: wp.vec3, b: wp.vec3) -> wp.float32:
    """Weight of a unit direction for another."""
    away = a - b
    near = wp.dot(away, away) + NEARBY * NEARBY
    return 1.0 / (near * near)


@wp.kernel(enable_backward=False)
def send_recovered_kernel(
    # In:
    row_start: wp.int32,
    share: wp.array2d[wp.vec3],
    confidence: wp.array2d[wp.float32],
    cells: wp.array2d[Cell],
    recovered: wp.array2d[wp.vec3],
    # Out:
    sent_out: wp.array2d[wp.vec3],
):
    """A cell's e over the sum that it is shared by; -1 where it stays in its direction."""
    i, j = wp.tid()
    i += row_start
    cell = cells[i, j]
    sent_out[i, j] = wp.vec3(0.0)
    power = cell.solid_angle * wp.cw_mul(cell.missing, recovered[i, j])
    if not wp.max(power) > 0.0:
        return
    whole = wp.vec3(0.0)
    if cell.hidden == 0.0:
        height = share.shape[0]
        width = share.shape[1]
        for row in range(height):
            area = texel_solid_angle(row, height, width)
            for column in range(width):
                lost = trust(confidence[row, column]) * share[row, column]
                if wp.max(lost) > 0.0:
                    toward = direction_from_latlong(wp.float32(row) + 0.5, wp.float32(column) + 0.5, height, width)
                    whole += area * kinship(toward, cell.direction) * lost
    sent = wp.vec3(-1.0)
    for channel in range(3):
        if whole[channel] > 0.0:
            sent[channel] = power[channel] / whole[channel]
    sent_out[i, j] = sent


@wp.kernel(enable_backward=False)
def share_recovered_kernel(
    # In:
    row_start: wp.int32,
    filled: wp.array2d[wp.vec3],
    share: wp.array2d[wp.vec3],
    confidence: wp.array2d[wp.float32],
    environment: wp.array2d[wp.vec3],
    captured: wp.array2d[wp.vec3],
    emitters: wp.array[Emitter],
    cells: wp.array2d[Cell],
    sent: wp.array2d[wp.vec3],
    # Out:
    environment_out: wp.array2d[wp.vec3],
):
    """A texel, where no emitter is known by its place."""
    i, j = wp.tid()
    i += row_start
    if any_near(emitters):
        return
    height = filled.shape[0]
    width = filled.shape[1]
    light = filled[i, j]
    lost = trust(confidence[i, j]) * share[i, j]
    if wp.max(lost) > 0.0:
        toward = direction_from_latlong(wp.float32(i) + 0.5, wp.float32(j) + 0.5, height, width)
        for row in range(cells.shape[0]):
            for column in range(cells.shape[1]):
                arriving = wp.max(sent[row, column], wp.vec3(0.0))
                if wp.max(arriving) > 0.0:
                    light += kinship(toward, cells[row, column].direction) * wp.cw_mul(lost, arriving)
    stays = sent[i * cells.shape[0] / height, j * cells.shape[1] / width]
    for channel in range(3):
        if stays[channel] < 0.0:
            light[channel] += wp.max(environment[i, j][channel] - captured[i, j][channel], 0.0)
    environment_out[i, j] = light


@wp.kernel(enable_backward=False)
def move_emitters_kernel(
    # In:
    emitters: wp.array[Emitter],
    places: wp.array[wp.vec4],
    ball: wp.int32,
    # Out:
    emitters_out: wp.array[Emitter],
):
    """One emitter a thread."""
    k = wp.tid()
    place = places[ball]
    emitters_out[k] = seen_from(emitters[k], wp.vec3(place[0], place[1], place[2]))


relocate = row_launcher(relocate_kernel)
"""Add what was recovered in the first ball's map to another's, turned, where an emitter is known by its place.

Args:
    filled: (h, w) the other ball's light as captured and completed.
    environment: (h, w) the first ball's, with what was recovered.
    captured: (h, w) the first ball's without.
    emitters: Of the first ball's map.
    places: (P,) of ``probe_weights.update_places``.
    environment_out: (h, w) ``wp.vec3``.
    ball: The other one's number.
"""


send_recovered = row_launcher(send_recovered_kernel)
"""Compute the light that each cell of the first ball's map sends to a unit of what clips in another's.

Args:
    share: (h, w) what clips in the other map, of ``weigh_boundaries``.
    confidence: (h, w) how well each of its texels was seen.
    cells: ``Cell`` of the first ball's map when light was recovered in it.
    recovered: Radiance that a wholly clipped texel of a cell lacks, as many.
    sent_out: ``wp.vec3``, as many.
"""


share_recovered = row_launcher(share_recovered_kernel)
"""Add what was recovered in the first ball's map where another's clips; not if an emitter has a place.

Args:
    other: (h, w) ``wp.vec3``, the other ball's light as captured and completed.
    missing: As for ``send_recovered``.
    confidence: Likewise.
    environment: (h, w) the first ball's, with what was recovered.
    captured: (h, w) the first ball's without.
    emitters: Of the first ball's map; None: the method knows none.
    cells: As for ``send_recovered``.
    sent: From there.
    environment_out: (h, w) ``wp.vec3``.
"""


def move_emitters(emitters: wp.array, places: wp.array, emitters_out: wp.array, *, ball: int) -> None:
    """Emitters as another ball's map holds them.

    Args:
        emitters: ``Emitter``, of the first ball's map.
        places: (P,) of ``probe_weights.update_places``.
        emitters_out: As many.
        ball: The other one's number.
    """
    launch(move_emitters_kernel, emitters.shape[0], [emitters, places, ball], [emitters_out])
