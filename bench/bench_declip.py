"""Radiance above clipping in a 640x480 frame: nothing clips, a small lamp, a tenth of the frame."""

from __future__ import annotations

import numpy as np
import warp as wp

from bench.common import measure, report
from warp_ar.kernels.color import decode_table
from warp_ar.kernels.picture import declip
from warp_ar.kernels.structs import FrameParams, Probe, RayScene, make_picture

H, W = 480, 640


def time_case(case: str, radius: float, device: str) -> None:
    """Check and time a frame with a clipped disc of ``radius`` pixels."""
    decode = wp.array(decode_table("srgb"), dtype=wp.vec3, device=device)
    y, x = np.mgrid[:H, :W]
    picture = np.random.default_rng(0).integers(60, 180, (H, W, 3), dtype=np.uint8)
    picture[np.hypot(x - W / 2, y - H / 2) < radius] = 255
    frame = wp.array(picture, dtype=wp.vec3ub, device=device)
    out = wp.zeros((H, W), wp.vec3, device=device)
    levels = wp.zeros(declip.level_texels(H, W), wp.vec4, device=device)
    marked, active = (wp.zeros(declip.tile_shape(H, W), wp.int32, device=device) for _ in range(2))
    params, rays = wp.zeros(1, FrameParams, device=device), wp.zeros((H, W), wp.vec2, device=device)
    picture = make_picture(frame, None, rays)
    probes, scene = wp.zeros(0, Probe, device=device), RayScene()

    def run() -> None:
        declip.mark_tiles(frame, marked)
        declip.widen_tiles(marked, active)
        declip.pull_frame(active, frame, decode, levels)
        declip.fill_levels(active, (H, W), levels)
        declip.complete(active, frame, decode, levels, out)
        declip.pull_completed(active, frame, out, levels)
        declip.fill_levels(active, (H, W), levels)
        declip.complete_core(declip.DeclipConfig(), picture, levels, params, scene, probes, None, out)

    run()
    assert (out.numpy().max() > 1.5) == (radius > 0.0)
    report(f"declip {W}x{H} {case}", measure({case: run}, device)[case], device)


def main(device: str) -> None:
    for case, radius in (("nothing clips", 0.0), ("lamp", 30.0), ("tenth", 99.0)):
        time_case(case, radius, device)
