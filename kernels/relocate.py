"""Light that clips in the mirror balls, put back in the maps of the balls after the first.

It is recovered in the first ball's map, M, from F, that map as captured: its excess is M - F. Another ball, at c, sees
the part of it that comes from near emitters along other directions, and stronger or weaker:

    M'(d) = F'(d) + g(d) max(M - F, 0)(turned(d)),

with ``correct_parallax`` for the turn and ``solid_angle_gain`` for g. Where no emitter's place is known, the excess is
taken to be as far as the environment.
"""

from __future__ import annotations

import functools

import warp as wp

from warp_ar.kernels.emitters import correct_parallax, seen_from, solid_angle_gain
from warp_ar.kernels.latlong import direction_from_latlong, sample_latlong
from warp_ar.kernels.launch import Rows, launch, launch_rows
from warp_ar.kernels.structs import Emitter

wp.set_module_options({"enable_backward": False})


@functools.cache
def make_relocate_kernel(placed: bool) -> wp.Kernel:
    """Kernel for emitters whose places are known, or for none."""

    @wp.kernel(module="unique", enable_backward=False)
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
        i, j = wp.tid()
        i += row_start
        height = filled.shape[0]
        width = filled.shape[1]
        direction = direction_from_latlong(wp.float32(i) + 0.5, wp.float32(j) + 0.5, height, width)
        gain = wp.float32(1.0)
        excess = environment[i, j] - captured[i, j]
        if wp.static(placed):
            place = places[ball]
            center = wp.vec3(place[0], place[1], place[2])
            gain = solid_angle_gain(emitters, center, direction)
            turned = correct_parallax(emitters, center, direction)
            excess = sample_latlong(environment, turned) - sample_latlong(captured, turned)
        environment_out[i, j] = filled[i, j] + gain * wp.max(excess, wp.vec3(0.0))

    return relocate_kernel


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
    emitters: wp.array | None,
    places: wp.array,
    environment_out: wp.array,
    *,
    ball: int,
    rows: Rows | None = None,
) -> None:
    """Add what was recovered in the first ball's map to another's.

    Args:
        filled: (h, w) the other ball's light as captured and completed.
        environment: (h, w) the first ball's, with what was recovered.
        captured: (h, w) the first ball's without.
        emitters: Of the first ball's map; None: the places of none are known.
        places: (P,) of ``probe_weights.update_places``.
        environment_out: (h, w) ``wp.vec3``.
        ball: The other one's number.
        rows: Band of rows, None for all.
    """
    launch_rows(
        make_relocate_kernel(emitters is not None),
        filled.shape,
        [filled, environment, captured, wp.array(dtype=Emitter) if emitters is None else emitters, places, ball],
        [environment_out],
        rows=rows,
        device=filled.device,
    )


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
