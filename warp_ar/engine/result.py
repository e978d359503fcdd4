"""Results of a frame."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ar.device import exclusive
from warp_ar.engine.layers import LayerArrays, compose_layers, copied
from warp_ar.engine.scheduler import StageTiming
from warp_ar.engine.transfer import Image, Picture
from warp_ar.errors import UsageError
from warp_ar.kernels.structs import struct_values
from warp_ar.scene import Pose
from warp_ar.stages.request import PICTURE_LAYERS
from warp_ar.tracking.tracking import TrackState

TRACK = "track"
"""Name of the tracking of markers, which runs on the host, among the stages in timings."""


@dataclasses.dataclass(frozen=True)
class Rendered:
    """Output of the stages for one frame."""

    image_array: Any
    """Lit frame, or the frame itself if the marker is lost; on device or host."""
    environment_array: Any
    """Environment on the device; None if it is not an output or has not been captured yet."""
    stages: Mapping[str, StageTiming]
    """Time of every stage, by name."""
    render_ms: float = 0.0
    """Milliseconds that the host took to run the stages (CPU) or to launch them (CUDA)."""
    layers: LayerArrays | None = None
    """Requested layers, in the pipeline's memory or copied to the host; None if none was requested."""
    image: Picture | Image | None = None
    """Picture on the host, or its transfer to the host in progress; None if neither was made."""
    environment: npt.NDArray[np.float32] | None = None
    """Host copy of the environment, if one was made."""
    others_array: Any = None
    """Environments of the mirror balls after the first, if light is interpolated between balls."""
    others: npt.NDArray[np.float32] | None = None
    """Host copy of ``others_array``, if one was made."""
    emitters_array: Any = None
    """Emitters of the environment with positions, records of ``Emitter``; None if the quality does not find them."""
    emitters: npt.NDArray[Any] | None = None
    """Host copy of ``emitters_array``, if one was made."""

    def with_light_kept(self) -> Rendered:
        """Return this output with host copies of the environments and the emitters."""
        light, others = (None if one is None else copied(one) for one in (self.environment_array, self.others_array))
        emitters = None if self.emitters_array is None else struct_values(self.emitters_array)
        return dataclasses.replace(self, environment=light, others=others, emitters=emitters)

    def at_once(self) -> Future[Rendered]:
        """Return a completed future that holds this output."""
        future: Future[Rendered] = Future()
        future.set_result(self)
        return future


def done_at_once(work: Callable[[], Rendered]) -> Future[Rendered]:
    """Run ``work`` on this thread and return its outcome as a completed future, which raises its error when read."""
    future: Future[Rendered] = Future()
    try:
        future.set_result(work())
    except Exception as error:
        future.set_exception(error)
    return future


@dataclasses.dataclass(frozen=True)
class Result:
    """Result of one frame.

    ``pose``, ``state`` and ``shown`` are known at once. For a submitted frame, all other attributes wait for rendering.
    """

    pose: Pose | None
    """Pose ``camera_from_world``; None while the marker is lost, or if no stage or output needs it."""
    state: TrackState | None
    """State of the marker's track: tracked, held or lost; None if a ``Pose`` was given, or no pose is needed."""
    _rendered: Future[Rendered]
    shown: bool = True
    """False for a frame of another exposure than the shown one. It only measures light; ``image`` is then the previous
    picture."""

    @property
    def image_array(self) -> Any:
        """Lit frame on the pipeline's device, (height, width) of ``wp.vec3ub``; valid until the next call."""
        return self._rendered.result().image_array

    @property
    def environment_array(self) -> Any:
        """Environment, latlong linear RGB (rows, columns); None if it is not an output or has not been captured yet."""
        return self._rendered.result().environment_array

    @property
    def stages(self) -> Mapping[str, StageTiming]:
        """Time in milliseconds of every stage of the plan, and whether it was skipped."""
        return self._rendered.result().stages

    @property
    def steps(self) -> Mapping[str, float]:
        """Time in milliseconds of each step of the frame; steps overlap with those of other frames.

        Host steps are ``track`` and ``render`` (on CUDA: launching the kernels). A frame submitted on CUDA also has the
        device steps ``upload``, ``kernels`` and ``download``.
        """
        rendered = self._rendered.result()
        tracking = rendered.stages.get(TRACK)
        steps = {TRACK: tracking.milliseconds} if tracking is not None else {}
        steps["render"] = rendered.render_ms
        return steps | rendered.image.steps() if isinstance(rendered.image, Picture) else steps

    @functools.cached_property
    def image(self) -> Image:
        """Lit frame as an independent NumPy array, uint8 RGB (height, width, 3)."""
        rendered = self._rendered.result()
        if rendered.image is not None:
            return rendered.image.result() if isinstance(rendered.image, Picture) else rendered.image
        return copied(rendered.image_array)

    @functools.cached_property
    def environment(self) -> npt.NDArray[np.float32] | None:
        """Environment at the first ball as an independent NumPy array, float32 RGB (rows, columns, 3)."""
        rendered = self._rendered.result()
        if rendered.environment is not None or rendered.environment_array is None:
            return rendered.environment
        return copied(rendered.environment_array)

    @functools.cached_property
    def environments(self) -> tuple[npt.NDArray[np.float32], ...]:
        """Environments at the mirror balls between which light is interpolated; the first one is ``environment``.

        The tuple has one map if light is not interpolated, and is empty if ``environment`` is None.
        """
        rendered = self._rendered.result()
        others = rendered.others
        if others is None and rendered.others_array is not None:
            others = copied(rendered.others_array)
        return () if self.environment is None else (self.environment, *(() if others is None else others))

    @functools.cached_property
    def emitters(self) -> npt.NDArray[Any] | None:
        """Emitters of the environment and their positions, as a copy that ``Pipeline.take_light`` accepts.

        None if the environment is not among the requested outputs or has not been captured yet, or if the quality's
        method does not locate emitters.
        """
        rendered = self._rendered.result()
        if rendered.emitters is not None or rendered.emitters_array is None:
            return rendered.emitters
        with exclusive(rendered.emitters_array.device):
            values: npt.NDArray[Any] = struct_values(rendered.emitters_array)
            return values

    @property
    def layer_arrays(self) -> Mapping[str, Any]:
        """Requested layers by name, in the pipeline's memory; arrays on the device are valid until the next call."""
        layers = self._rendered.result().layers
        return {} if layers is None else layers.arrays

    @functools.cached_property
    def _host_layers(self) -> LayerArrays:
        layers = self._rendered.result().layers
        return LayerArrays({}) if layers is None else layers.to_host()

    @property
    def layers(self) -> Mapping[str, npt.NDArray[Any]]:
        """Requested layers as independent NumPy arrays, by the names of ``warp_ar.LAYERS``.

        Arrays are float32 (height, width[, components]); ``ids`` is int32. Read them before the next call.
        """
        return self._host_layers.arrays

    @functools.cached_property
    def radiance(self) -> npt.NDArray[np.float32]:
        """Lit frame as linear radiance, float32 RGB (height, width, 3), scaled by the exposure and not yet encoded.

        It is composed of the layers on the host, at the bit depth of the input frame.

        Raises:
            UsageError: ``radiance`` is not among the outputs.
        """
        if missing := [name for name in PICTURE_LAYERS if name not in self.layers]:
            raise UsageError(f'radiance needs outputs=("radiance",): {", ".join(missing)} were not asked for')
        return np.asarray(np.float32(self.exposure_scale) * compose_layers(self.layers))

    @property
    def exposure_scale(self) -> float:
        """Factor from the radiance of the layers to that of the picture; 1 if no layer was requested."""
        scale = self._host_layers.scale
        return 1.0 if scale is None else float(scale[0])

    def _picture(self) -> Any:
        """Return the lit frame on the device; on the host if it was transferred, or if the frame stayed unlit."""
        rendered = self._rendered.result()
        if rendered.image is not None or not isinstance(rendered.image_array, wp.array):
            return self.image
        return rendered.image_array

    def __dlpack__(
        self,
        *,
        stream: Any = None,
        max_version: tuple[int, int] | None = None,
        dl_device: tuple[int, int] | None = None,
        copy: bool | None = None,
    ) -> Any:
        """Export the lit frame, uint8 RGB (height, width, 3), by DLPack without a copy: ``torch.from_dlpack(result)``.

        The picture is on the pipeline's device, and the next call overwrites it: clone it to keep it. For a submitted
        frame, as in a ``Session``, the picture is on the host and is not overwritten.

        Args:
            stream: Stream of the consumer; on the device it waits for the kernels.
            max_version: Largest DLPack version that the consumer reads.
            dl_device: Device that the consumer requests; it must be the picture's.
            copy: True if the consumer requests a copy, which is refused.

        Raises:
            BufferError: The consumer requests a copy, or another device.
        """
        picture = self._picture()
        if not isinstance(picture, wp.array):
            return picture.__dlpack__(stream=stream, max_version=max_version, dl_device=dl_device, copy=copy)
        if copy or (dl_device is not None and tuple(map(int, dl_device)) != self.__dlpack_device__()):
            raise BufferError("a result is handed over without a copy, where it lies; copy it afterwards")
        with exclusive(picture.device):
            return picture.__dlpack__(stream=stream)

    def __dlpack_device__(self) -> tuple[int, int]:
        """Return DLPack's device type and number of the picture's memory."""
        kind, number = self._picture().__dlpack_device__()
        return int(kind), int(number)

    @property
    def __cuda_array_interface__(self) -> dict[str, Any]:
        """Lit frame by the CUDA Array Interface, without a copy; absent if the picture is not on a CUDA device.

        The interface names Warp's stream, for which a reader of version 3 waits.
        """
        picture = self._picture()
        if not isinstance(picture, wp.array):
            raise AttributeError("__cuda_array_interface__: the picture is on the host")
        interface: dict[str, Any] = dict(picture.__cuda_array_interface__)
        return interface | {"version": 3, "stream": picture.device.stream.cuda_stream or 1}

    def _repr_png_(self) -> bytes:
        """Return the lit frame as PNG, which notebooks display."""
        done, data = cv2.imencode(".png", cv2.cvtColor(self.image, cv2.COLOR_RGB2BGR))
        assert done
        return bytes(data)
