"""Stage ``captured``: the environment from a file in place of a mirror ball in the frames."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ar.errors import UsageError
from warp_ar.kernels.structs import Emitter, struct_dtype
from warp_ar.light.captured import Light, placed_emitters
from warp_ar.light.config import CONFIG
from warp_ar.scene.geometry import rotation_matrix
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Numerics, Pass, Rows, Stage, Wiring
from warp_ar.stages.features import Features
from warp_ar.stages.shared.host_copies import HostCopies


class Captured(Stage):
    """Loads the light of a file, at the quality's size and in the scene's axes; runs once."""

    name: ClassVar[str] = "captured"
    summary: ClassVar[str] = "reads the environment from a file"
    unread: ClassVar[str] = "nothing asks for the environment"
    settings: ClassVar[tuple[str, ...]] = ("environment_height",)
    numerics: ClassVar[Numerics] = Numerics(
        "float32; four bilinear samples a texel where the light is turned",
        2e-3,
        "bilinear between texels of 2.8 degrees where it is turned, a copy where it is not",
    )

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Return the resources read and written for a scene that names a light file."""
        if features.request.scene.captured is None:
            return LeftOut("the scene names no captured light")
        return Wiring(("captured_light",), ("environment", "emitters") if features.emitters else ("environment",))

    def arrays(self) -> Mapping[str, ArraySpec]:
        """Declare the arrays of the environment map, and of its emitters if their positions are given."""
        specs = {"environment": ArraySpec(self.map_shape, wp.vec3)}
        if self.features.emitters:
            specs["emitters"] = ArraySpec((CONFIG.search.most,), Emitter)
        return specs

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Read the file and return the pass that copies it to the device."""
        spec = self.request.scene.captured
        assert spec is not None
        light = Light.load(spec.file, spec.axes)
        if spec.colors is not None:
            light = light.recolored(np.reshape(spec.colors, (3, 3)))
        turn = rotation_matrix(spec.rotate)
        self._radiance = spec.scale * light.resampled(self.map_height, turn)

        self._emitters = np.zeros(CONFIG.search.most, struct_dtype(Emitter))
        placed = placed_emitters(light.emitters, spec.scale, turn)[: CONFIG.search.most]
        self._emitters[: len(placed)] = placed
        copies = HostCopies({name: arrays[name] for name in self.arrays()}, device)

        def copy(rows: Rows | None) -> None:
            values = {"environment": self._radiance}
            if self.features.emitters:
                values["emitters"] = self._emitters
            # Pinned memory, so that the host does not wait until the device has rendered the previous frame.
            copies.send(values)

        return [Pass(copy, on_host=True)]

    def resume(self, other: Stage) -> None:
        """Take over the map of the same stage in another pipeline, if both have the same light file and size."""
        assert isinstance(other, Captured)
        before, now = other.request.scene.captured, self.request.scene.captured
        if before == now and other._radiance.shape == self._radiance.shape:
            self._radiance, self._emitters = other._radiance, other._emitters

    def replace(self, radiance: npt.NDArray[np.float32], emitters: npt.NDArray[Any] | None = None) -> None:
        """Replace the map that lights the next frames, at the quality's size and in the scene's axes.

        Args:
            radiance: Linear RGB, float32 (height, 2 height, 3); it is referenced, not copied.
            emitters: Records of ``Emitter``, as many as ``Recover`` writes; None: no positions are known.

        Raises:
            UsageError: The map has another size.
        """
        if radiance.shape != self._radiance.shape:
            raise UsageError(f"light is {radiance.shape}; this pipeline's environment is {self._radiance.shape}")
        self._radiance = radiance
        self._emitters = np.zeros_like(self._emitters) if emitters is None else emitters
