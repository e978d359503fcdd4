"""Light that clips in the mirror balls, put back in the maps of the balls after the first.

It is recovered in the first ball's map, M, from F, that map as captured: its excess is M - F. Another ball, at c, sees
the part of it that comes from near emitters along other directions, and stronger or weaker. Where such emitters are
known by their places, it is turned (``relocate``):

    M'(d) = F'(d) + g(d) max(M - F, 0)(turned(d)),

with ``correct_parallax`` for the turn and ``solid_angle_gain`` for g.

Where none is, the other ball tells itself where its light clips, and a lamp has one radiance wherever it is seen from
(``share_radiance``): with s'(d) the share of a texel that lacks light, and the cells k of the first ball's map, each of
solid angle a, share s and radiance R that what clips lacks,

    M'(d) = F'(d) + s'(d) sum w a s R / sum w a s,    w = 1 / (|d - d_k|^2 + NEARBY^2)^2.

Of one lamp this is its R, however far apart the two balls see it; of several, those in like directions count most.
What the first ball cannot see, and light was found in, is as far as the environment.
"""

from __future__ import annotations

import warp as wp

from warp_ar.kernels.emitters import MAX_DISTANCE, correct_parallax, seen_from, solid_angle_gain
from warp_ar.kernels.latlong import direction_from_latlong, sample_latlong
from warp_ar.kernels.launch import Rows, launch, launch_rows
from warp_ar.kernels.recover_cells import Cell, trust
from warp_ar.kernels.structs import Emitter

wp.set_module_options({"enable_backward": False})


NEARBY = wp.constant(wp.float32(0.2))
"""Distance of unit directions within which cells count alike: a lamp's own, and the next beside it."""


@wp.func
def any_near(emitters: wp.array[Emitter]) -> wp.bool:
    """Whether an emitter is known by its place."""
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
    excess = sample_latlong(environment, turned) - sample_latlong(captured, turned)
    environment_out[i, j] = filled[i, j] + gain * wp.max(excess, wp.vec3(0.0))


@wp.func
def missing_radiance(cells: wp.array2d[Cell], recovered: wp.array2d[wp.vec3], direction: wp.vec3) -> wp.vec3:
    """Radiance that what clips in a direction lacks, by the first ball's cells, the nearer the more."""
    total = wp.vec3(0.0)
    whole = wp.vec3(0.0)
    for row in range(cells.shape[0]):
        for column in range(cells.shape[1]):
            share = cells[row, column].missing
            if wp.max(share) > 0.0:
                away = direction - cells[row, column].direction
                near = wp.dot(away, away) + NEARBY * NEARBY
                weight = cells[row, column].solid_angle / (near * near)
                total += weight * wp.cw_mul(share, recovered[row, column])
                whole += weight * share
    return wp.cw_div(total, wp.max(whole, wp.vec3(1.0e-12)))


@wp.kernel(enable_backward=False)
def share_radiance_kernel(
    # In:
    row_start: wp.int32,
    filled: wp.array2d[wp.vec3],
    share: wp.array2d[wp.vec3],
    confidence: wp.array2d[wp.float32],
    environment: wp.array2d[wp.vec3],
    captured: wp.array2d[wp.vec3],
    emitters: wp.array[Emitter],
    cells: wp.array2d[Cell],
    recovered: wp.array2d[wp.vec3],
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
        direction = direction_from_latlong(wp.float32(i) + 0.5, wp.float32(j) + 0.5, height, width)
        light += wp.cw_mul(lost, missing_radiance(cells, recovered, direction))
    if cells[i * cells.shape[0] / height, j * cells.shape[1] / width].hidden > 0.0:
        light += wp.max(environment[i, j] - captured[i, j], wp.vec3(0.0))
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


def relocate(
    filled: wp.array,
    environment: wp.array,
    captured: wp.array,
    emitters: wp.array,
    places: wp.array,
    environment_out: wp.array,
    *,
    ball: int,
    rows: Rows | None = None,
) -> None:
    """Add what was recovered in the first ball's map to another's, turned, where an emitter is known by its place.

    Args:
        filled: (h, w) the other ball's light as captured and completed.
        environment: (h, w) the first ball's, with what was recovered.
        captured: (h, w) the first ball's without.
        emitters: Of the first ball's map.
        places: (P,) of ``probe_weights.update_places``.
        environment_out: (h, w) ``wp.vec3``.
        ball: The other one's number.
        rows: Band of rows, None for all.
    """
    launch_rows(
        relocate_kernel,
        filled.shape,
        [filled, environment, captured, emitters, places, ball],
        [environment_out],
        rows=rows,
        device=filled.device,
    )


def share_radiance(
    other: tuple[wp.array, wp.array, wp.array],
    environment: wp.array,
    captured: wp.array,
    emitters: wp.array | None,
    cells: wp.array,
    recovered: wp.array,
    environment_out: wp.array,
    *,
    rows: Rows | None = None,
) -> None:
    """Give what clips in another ball's map the radiance of what clips in the first's; not if an emitter has a place.

    Args:
        other: (h, w) the other ball's light as captured and completed, its share that clips, of ``weigh_boundaries``,
            and how well each texel was seen.
        environment: (h, w) the first ball's, with what was recovered.
        captured: (h, w) the first ball's without.
        emitters: Of the first ball's map; None: the method knows none.
        cells: ``Cell`` of when that was recovered.
        recovered: Radiance that a wholly clipped texel of a cell lacks, as many.
        environment_out: (h, w) ``wp.vec3``.
        rows: Band of rows, None for all.
    """
    device = environment.device
    emitters = wp.empty(0, dtype=Emitter, device=device) if emitters is None else emitters
    inputs = [*other, environment, captured, emitters, cells, recovered]
    launch_rows(share_radiance_kernel, environment.shape, inputs, [environment_out], rows=rows, device=device)


def move_emitters(emitters: wp.array, places: wp.array, emitters_out: wp.array, *, ball: int) -> None:
    """Emitters as another ball's map holds them.

    Args:
        emitters: ``Emitter``, of the first ball's map.
        places: (P,) of ``probe_weights.update_places``.
        emitters_out: As many.
        ball: The other one's number.
    """
    launch(
        move_emitters_kernel, emitters.shape[0], [emitters, places, ball], [emitters_out], device=emitters_out.device
    )
