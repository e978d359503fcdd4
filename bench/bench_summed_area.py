"""Summed-area table against OpenCV's, from 640x480 to 8K.

On CPU both run on one thread and are timed by its processor time, ours as frames launch it: recorded.
"""

from __future__ import annotations

import statistics

import cv2
import numpy as np
import warp as wp

from bench.common import copy_bandwidth, measure, paired_ratio, recorded, report
from warp_ar.kernels.picture import summed_area

SIZES = ((480, 640), (1080, 1920), (2160, 3840), (4320, 7680))


def main(device: str) -> None:
    for height, width in SIZES:
        values = np.random.default_rng(0).integers(0, 256, (height, width), dtype=np.uint8)
        frame = wp.array(np.repeat(values[..., None], 3, axis=2), dtype=wp.vec3ub, device=device)
        table = wp.zeros((height, width), wp.uint32, device=device)

        def ours(frame=frame, table=table):
            summed_area.sum_area(frame, table)

        ours()
        exact = values.cumsum(0, dtype=np.uint32).cumsum(1, dtype=np.uint32)
        np.testing.assert_array_equal(table.numpy(), exact)
        table.zero_()
        contenders = {"ours": recorded(ours) if frame.device.is_cpu else ours}
        more = {}
        if wp.get_device(device).is_cpu:
            cv2.setNumThreads(1)
            contenders["cv2"] = lambda values=values: cv2.integral(values)
        times = measure(contenders, device, one_thread=True)
        np.testing.assert_array_equal(table.numpy(), exact)
        if "cv2" in times:
            more["over_cv2"] = round(paired_ratio(times, "ours", "cv2"), 2)
        # What any way must move: the frame is read, the table written.
        moved = height * width * (3 + 4)
        share = moved / (statistics.median(times["ours"]) * 1e-3) / copy_bandwidth(device)
        report(f"summed_area {width}x{height}", times["ours"], device, of_copy_bandwidth=round(share, 3), **more)
