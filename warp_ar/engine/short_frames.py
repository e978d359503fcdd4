"""Frames of exposures other than the shown one, which only contribute to the environment.

If a source alternates between exposures, showing all frames would flicker. The reference is the longest exposure, or
the one that the caller chose. Only its frames are lit and shown, and all radiance is in units of its pixel values. From
the other frames, only the mirror ball is unwrapped to an environment map. The stage ``bracket`` merges the maps of all
exposures.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ar.kernels.environment.bracket import BracketExposure
from warp_ar.kernels.structs import FrameParams, struct_dtype
from warp_ar.scene import Pose
from warp_ar.stages.base import Arrays, Wiring
from warp_ar.stages.features import Features
from warp_ar.stages.shared.probe_maps import UNWRAPPED
from warp_ar.stages.unwrap import Unwrap

KEPT_SECONDS = 3.0
"""Seconds for which the map of a frame of another exposure is used; it may be outdated afterwards."""


class ShortFrames:
    """Environment maps from the latest frames of every exposure except the reference."""

    def __init__(self, features: Features, arrays: Arrays, device: Any) -> None:
        """Allocate arrays, and build the passes of ``unwrap``.

        Args:
            features: Features of the plan, whose stages include ``bracket``.
            arrays: Arrays of the pipeline.
            device: Warp device.
        """
        self._ratios = features.request.exposures
        self._reference = self._ratios.index(1.0)
        self._arrays = arrays
        self._own = Arrays()
        self._taken = [-math.inf] * len(self._ratios)
        self._told: tuple[bool, ...] | None = None
        self._merged = 1
        wiring = Unwrap.wire(features)
        assert isinstance(wiring, Wiring)
        stage = Unwrap(features, wiring)
        for name in ("probes", "ray_scene", "decode", "rays"):
            self._own.add(name, arrays[name])
        with wp.ScopedDevice(device):
            self._own.add("frame", wp.zeros(arrays["frame"].shape, dtype=wp.vec3ub))
            self._own.add("linear_frame", wp.zeros(arrays["linear_frame"].shape, dtype=wp.vec3))
            self._own.add("linear_clip", wp.zeros(2, dtype=wp.vec3))
            self._own.add("params", wp.zeros(1, dtype=FrameParams))
            for name, spec in stage.arrays().items():
                self._own.add(name, wp.full(spec.shape, spec.fill, dtype=spec.dtype))
            self._passes = stage.build(self._own, device)

    def take(
        self,
        image: Any,
        index: int,
        pose: Pose,
        params: npt.NDArray[Any],
        now: float,
        linear: tuple[npt.NDArray[Any], npt.NDArray[Any]] | None = None,
    ) -> None:
        """Unwrap the mirror ball of one frame.

        Args:
            image: Frame, uint8 RGB (height, width, 3) or a Warp array (height, width) of ``wp.vec3ub``.
            index: Index of its exposure in the bracket.
            pose: ``camera_from_world``.
            params: Frame constants of the pipeline, in a copy of which the pose is replaced.
            now: Time of the frame, seconds.
            linear: Linear radiance of a frame with more than 8 bits, and its ``clip_levels``; else None.
        """
        values = params.copy()
        inverse = pose.inverse()
        values["camera_position"], values["world_from_camera"] = inverse.translation, inverse.rotation
        self._own["params"].assign(values)
        if isinstance(image, wp.array):
            wp.copy(self._own["frame"], image)
        else:
            self._own["frame"].assign(image)
        if linear is not None:
            self._own["linear_frame"].assign(linear[0])
            self._own["linear_clip"].assign(linear[1])
        for step in self._passes:
            step.launch(None)
        for part in UNWRAPPED:
            wp.copy(self._arrays[f"bracket_{part}"][index], self._own[f"probe_{part}"])
        self._taken[index] = now
        self._arrays.touch("short_frames")

    def refresh(self, now: float) -> bool:
        """Mark the exposures that are recent enough to merge with the reference frame of time ``now``.

        Returns:
            True if more exposures are merged than before. The environment accumulated so far lacks the light that only
            the new exposure shows, so the running mean must start again.
        """
        recent = [abs(now - taken) < KEPT_SECONDS for taken in self._taken]
        told = tuple(index == self._reference or new for index, new in enumerate(recent))
        if told == self._told:
            return False
        self._told = told
        before, self._merged = self._merged, sum(told)
        values = np.zeros(len(told), struct_dtype(BracketExposure))
        values["ratio"], values["trust"] = self._ratios, told
        self._arrays["bracket_exposures"].assign(values)
        self._arrays.touch("short_frames")
        return self._merged > before

    def resume(self, other: ShortFrames) -> None:
        """Take over the times of another pipeline's frames, if its exposures are equal.

        The maps themselves are copied before, by ``Scheduler.continue_from``.
        """
        if self._ratios == other._ratios:
            self._taken, self._merged = list(other._taken), other._merged
