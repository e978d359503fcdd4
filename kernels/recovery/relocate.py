"""Recovered light in the maps of the mirror balls after the first.

Clipped light is recovered in the first ball's map: F is the map as captured, M with recovered light, so the recovered
radiance is M - F. At another ball the light of near emitters comes from other directions, stronger or weaker. If the
positions of such emitters are known, recovered light is moved by their parallax (``relocate``):

    M'(d) = F'(d) + g(d) max(M - F, 0)(turned(d)),

with ``correct_parallax`` for the turned direction and ``solid_angle_gain`` for g.

If no position is known, the other ball's clipped texels give the directions, and the missing energy is taken to be that
of the first ball, as for distant light (``share_recovered``). With a' the solid angle and s' the missing share of a
texel of the other ball, and e_k the energy recovered in cell k of the first ball, radiance times solid angle,

    M'(d) = F'(d) + s'(d) sum over k of w_k(d) e_k / sum over d of a' s' w_k,
    w_k(d) = 1 / (|d - d_k|^2 + NEARBY^2)^2.

So the energy of a single lamp goes to the clipped texels of the other map, and that of several lamps each to the
nearest ones. Energy without clipped texels in the other map, and energy recovered where the first ball shows nothing,
keeps its direction. The energy, not the radiance, is transferred, because the clipped share is no measure of a lamp's
size: that of a lamp of one or two pixels differs between frames.
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
"""Distance of unit directions below which weights of cells are nearly equal: about the size of one lamp's image."""


@wp.func
def any_near(emitters: wp.array[Emitter]) -> wp.bool:
    """Return whether the position of any emitter is known."""
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
    """Write one texel of the other ball's map if an emitter's position is known: light is moved by its parallax."""
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
    """Return the weight w, by which energy from the direction ``a`` is given to the direction ``b``, both unit."""
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
    """Write a cell's recovered energy over the sum of its weights, or -1 if the energy keeps its direction."""
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
    """Write one texel of the other ball's map, with its part of the recovered energy, unless ``relocate`` writes it."""
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
    """Write one emitter with its direction, distance and power seen from another ball."""
    k = wp.tid()
    place = places[ball]
    emitters_out[k] = seen_from(emitters[k], wp.vec3(place[0], place[1], place[2]))


relocate = row_launcher(relocate_kernel)
"""Add light recovered in the first ball's map to another ball's map, with parallax, if a position is known.

Args:
    filled: (h, w) map of the other ball, as captured and completed.
    environment: (h, w) map of the first ball, with recovered light.
    captured: (h, w) map of the first ball, without recovered light.
    emitters: Emitters of the first ball's map.
    places: (P,) from ``probe_weights.update_places``.
    environment_out: (h, w) ``wp.vec3``, map of the other ball with recovered light.
    ball: Index of the other ball.
"""


send_recovered = row_launcher(send_recovered_kernel)
"""Compute the factors e_k / (sum of a' s' w_k), by which cells of the first ball's map light another ball's texels.

Args:
    share: (h, w) missing share in the other map, from ``weigh_boundaries``.
    confidence: (h, w) confidence of its texels.
    cells: (rows, columns) ``Cell`` of the first ball's map, of the frame from which light was recovered.
    recovered: (rows, columns) radiance that a wholly clipped texel of each cell lacks.
    sent_out: (rows, columns) ``wp.vec3``; -1 in channels whose energy keeps its direction.
"""


share_recovered = row_launcher(share_recovered_kernel)
"""Add light recovered in the first ball's map to clipped texels of another map, if no emitter's position is known.

Args:
    filled: (h, w) ``wp.vec3``, map of the other ball, as captured and completed.
    share: (h, w) missing share in the other map, as for ``send_recovered``.
    confidence: (h, w) confidence of its texels.
    environment: (h, w) map of the first ball, with recovered light.
    captured: (h, w) map of the first ball, without recovered light.
    emitters: Emitters of the first ball's map; None if the method finds no positions.
    cells: (rows, columns) ``Cell`` of the first ball's map, of the frame from which light was recovered.
    sent: (rows, columns) from ``send_recovered``.
    environment_out: (h, w) ``wp.vec3``, map of the other ball with recovered light.
"""


def move_emitters(emitters: wp.array, places: wp.array, emitters_out: wp.array, *, ball: int) -> None:
    """Write the emitters as another ball's map shows them.

    Args:
        emitters: (k,) ``Emitter`` of the first ball's map.
        places: (P,) from ``probe_weights.update_places``.
        emitters_out: (k,) ``Emitter`` of the other ball's map.
        ball: Index of the other ball.
    """
    launch(move_emitters_kernel, emitters.shape[0], [emitters, places, ball], [emitters_out])
