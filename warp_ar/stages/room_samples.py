"""The room's light as samples, for shadows and reflections."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels import pyramid, room_samples
from warp_ar.kernels.room_samples import RoomSample
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Pass, Request, Rows, Stage, Wiring
from warp_ar.stages.composite import shades_room, shares_room
from warp_ar.stages.recover import knows_lamps
from warp_ar.stages.reflect import room_config
from warp_ar.stages.shade import sees_near

SAMPLES = 1024
"""Of all sets together: what an 8-bit picture of their mean can tell apart, four times over."""
REFERENCE_SIZE = (32, 64)
"""Texels of the map that the reference sums over."""


def lists_texels(request: Request) -> bool:
    """Whether the reference asks for every texel of the room, beside the samples that follow its light."""
    return request.quality.rung("room_shadow") == "brute_force"


def sample_names(request: Request) -> tuple[str, str, str]:
    """Arrays that shadows read: directions, flux, samples."""
    listed = "room_samples_texel_directions", "room_samples_texel_flux", "room_samples_texels"
    return listed if lists_texels(request) else ("room_samples_directions", "room_samples_flux", "room_samples")


class RoomSamples(Stage):
    """Draws directions by the light that comes from them, anew whenever the environment changes."""

    name: ClassVar[str] = "room_samples"
    rungs: ClassVar[tuple[str, ...]] = ("default",)
    summary: ClassVar[str] = "the room's light as directions, drawn by what they send to the desk"

    @classmethod
    def wire(cls, request: Request) -> Wiring | LeftOut:
        """Read the environment, write samples."""
        gathers = sees_near(request) and room_config(request).diffuse != "none"
        if not shades_room(request) and not shares_room(request) and not gathers:
            return LeftOut("nothing traces rays to the room's light")
        lamps = ("lamps",) if knows_lamps(request) else ()
        return Wiring(("environment", *lamps), ("room_samples",))

    def arrays(self) -> Mapping[str, ArraySpec]:
        """The samples, and the sums that are inverted to draw them; for the reference a small map's texels as well."""
        height = self.request.quality.environment_height
        specs = {
            "room_samples": ArraySpec((SAMPLES,), RoomSample, RoomSample()),
            "room_samples_directions": ArraySpec((SAMPLES,), wp.vec3),
            "room_samples_flux": ArraySpec((SAMPLES,), wp.vec3),
            "room_samples_cumulative": ArraySpec((height, 2 * height), wp.float32),
            "room_samples_rows": ArraySpec((height,), wp.vec2),
        }
        if not lists_texels(self.request):
            return specs
        texels = REFERENCE_SIZE[0] * REFERENCE_SIZE[1]  # a smaller room leaves the rest without measure
        return {
            **specs,
            "room_samples_map": ArraySpec(
                (min(REFERENCE_SIZE[0], height), min(REFERENCE_SIZE[1], 2 * height)), wp.vec3
            ),
            "room_samples_texels": ArraySpec((texels,), RoomSample, RoomSample()),
            "room_samples_texel_directions": ArraySpec((texels,), wp.vec3),
            "room_samples_texel_flux": ArraySpec((texels,), wp.vec3),
        }

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Sum, then invert; and list the texels of a small map."""
        environment, samples = arrays["environment"], arrays["room_samples"]
        cumulative, sums = arrays["room_samples_cumulative"], arrays["room_samples_rows"]
        out = arrays["room_samples_directions"], arrays["room_samples_flux"], samples
        origin = wp.vec3(*self.request.scene.probes[0].center)
        passes = [
            Pass(lambda rows: room_samples.sum_environment(environment, cumulative, sums)),
            Pass(lambda rows: room_samples.draw_samples(environment, cumulative, sums, origin, *out)),
        ]
        found = [samples]
        if lists_texels(self.request):
            small, texels = arrays["room_samples_map"], [arrays[name] for name in sample_names(self.request)]
            passes += [
                Pass(lambda rows: pyramid.reduce_latlong(environment, small)),
                Pass(lambda rows: room_samples.list_texels(small, origin, *texels)),
            ]
            found.append(texels[-1])
        if knows_lamps(self.request):

            def place(rows: Rows | None) -> None:
                for one in found:
                    room_samples.place_lamps(arrays["lamps"], one)

            passes.append(Pass(place))
        return passes
