"""The room's light as samples, for shadows and reflections."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels import pyramid, room_samples
from warp_ar.kernels.room_samples import RoomSample
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Pass, Request, Stage, Wiring
from warp_ar.stages.composite import shades_room
from warp_ar.stages.recover import Recover
from warp_ar.stages.shade import sees_near, shade_config

SAMPLES = 1024
"""Of all sets together: what an 8-bit picture of their mean can tell apart, four times over."""
REFERENCE_SIZE = (32, 64)
"""Texels of the map that the reference sums over."""


def sample_count(request: Request) -> int:
    """Samples that the rungs of a request read."""
    reference = request.quality.rung("room_shadow") == "brute_force"
    return REFERENCE_SIZE[0] * REFERENCE_SIZE[1] if reference else SAMPLES


def knows_lamps(request: Request) -> bool:
    """Whether a stage finds lamps at a distance: a resource ``lamps`` of ``RoomLamp``."""
    wiring = Recover.wire(request)
    return isinstance(wiring, Wiring) and "lamps" in wiring.writes


class RoomSamples(Stage):
    """Draws directions by the light that comes from them, anew whenever the environment changes."""

    name: ClassVar[str] = "room_samples"
    rungs: ClassVar[tuple[str, ...]] = ("default",)
    summary: ClassVar[str] = "the room's light as directions, drawn by what they send to the desk"

    @classmethod
    def wire(cls, request: Request) -> Wiring | LeftOut:
        """Read the environment, write samples."""
        gathers = sees_near(request) and shade_config(request).room_diffuse != "none"
        if not shades_room(request) and not gathers:
            return LeftOut("nothing traces rays to the room's light")
        lamps = ("lamps",) if knows_lamps(request) else ()
        return Wiring(("environment", *lamps), ("room_samples",))

    def arrays(self) -> Mapping[str, ArraySpec]:
        """The samples, and the sums that are inverted to draw them."""
        height = self.request.quality.environment_height
        count = sample_count(self.request)
        specs = {
            "room_samples": ArraySpec((count,), RoomSample, RoomSample()),
            "room_samples_directions": ArraySpec((count,), wp.vec3),
            "room_samples_flux": ArraySpec((count,), wp.vec3),
        }
        if self.request.quality.rung("room_shadow") == "brute_force":
            size = min(REFERENCE_SIZE[0], height), min(REFERENCE_SIZE[1], 2 * height)
            return {**specs, "room_samples_map": ArraySpec(size, wp.vec3)}
        return {
            **specs,
            "room_samples_cumulative": ArraySpec((height, 2 * height), wp.float32),
            "room_samples_rows": ArraySpec((height,), wp.vec2),
        }

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Sum, then invert; or list the texels of a small map."""
        environment, samples = arrays["environment"], arrays["room_samples"]
        directions, flux = arrays["room_samples_directions"], arrays["room_samples_flux"]
        origin = wp.vec3(*self.request.scene.probes[0].center)
        small = arrays.get("room_samples_map")
        if small is not None:
            passes = [
                Pass(lambda rows: pyramid.reduce_latlong(environment, small)),
                Pass(lambda rows: room_samples.list_texels(small, origin, directions, flux, samples)),
            ]
        else:
            cumulative, sums = arrays["room_samples_cumulative"], arrays["room_samples_rows"]
            out = directions, flux, samples
            passes = [
                Pass(lambda rows: room_samples.sum_environment(environment, cumulative, sums)),
                Pass(lambda rows: room_samples.draw_samples(environment, cumulative, sums, origin, *out)),
            ]
        if knows_lamps(self.request):
            passes.append(Pass(lambda _: room_samples.place_lamps(arrays["lamps"], samples)))
        return passes
