"""Frames of other exposures than the one that is shown: what they say of the environment, and nothing else of them.

A source that alternates between exposures gives pictures that must not be shown in turn: they would flicker. The
longest exposure, or the one that was chosen, is the reference: its frames are lit and shown, and all radiance is in its
camera values. From the others the ball is unwrapped; stage ``bracket`` merges what they say.
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
"""Seconds for which a frame of another exposure is believed: the light may have changed since."""


class ShortFrames:
    """Takes frames of every exposure but the reference's."""

    def __init__(self, features: Features, arrays: Arrays, device: Any) -> None:
        """Allocate and build.

        Args:
            features: Of the plan; its stages hold ``bracket``.
            arrays: Of the pipeline.
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
            self._own.add("params", wp.zeros(1, dtype=FrameParams))
            for name, spec in stage.arrays().items():
                self._own.add(name, wp.full(spec.shape, spec.fill, dtype=spec.dtype))
            self._passes = stage.build(self._own, device)

    def take(self, image: Any, index: int, pose: Pose, params: npt.NDArray[Any], now: float) -> None:
        """Unwrap one frame.

        Args:
            image: As a pipeline takes it.
            index: Which exposure.
            pose: ``camera_from_world``.
            params: The pipeline's own, of which only the pose is another.
            now: Seconds.
        """
        values = params.copy()
        inverse = pose.inverse()
        values["camera_position"], values["world_from_camera"] = inverse.translation, inverse.rotation
        self._own["params"].assign(values)
        if isinstance(image, wp.array):
            wp.copy(self._own["frame"], image)
        else:
            self._own["frame"].assign(image)
        for step in self._passes:
            step.launch(None)
        for part in UNWRAPPED:
            wp.copy(self._arrays[f"bracket_{part}"][index], self._own[f"probe_{part}"])
        self._taken[index] = now
        self._arrays.touch("short_frames")

    def refresh(self, now: float) -> bool:
        """Say which exposures are to be believed, before the reference's frame of time ``now``.

        Returns:
            Whether one has come in that was not there before: what was accumulated until then had clipped without it,
            and is no mean to start from.
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
        """Go on from what another pipeline was given; its arrays have been copied where they fit."""
        if self._ratios == other._ratios:
            self._taken, self._merged = list(other._taken), other._merged
