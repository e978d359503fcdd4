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
"""Name of the host's own stage in reports: the marker's pose."""


@dataclasses.dataclass(frozen=True)
class Rendered:
    """Output of the stages for one frame."""

    image_array: Any
    environment_array: Any
    stages: Mapping[str, StageTiming]
    render_ms: float = 0.0
    """Milliseconds of the host: to run the stages on CPU, to launch them on CUDA."""
    layers: LayerArrays | None = None
    """The layers that were asked for, on the device or kept; None: none were."""
    image: Picture | Image | None = None
    """The picture, or that it is on its way to the host, where it was sent ahead."""
    environment: npt.NDArray[np.float32] | None = None
    """The environment where it was kept."""
    others_array: Any = None
    """Those of the mirror balls after the first, where the light is interpolated."""
    others: npt.NDArray[np.float32] | None = None
    """The same where they were kept."""
    emitters_array: Any = None
    """Emitters of the environment with their places, records of ``Emitter``; None: the quality does not find them."""
    emitters: npt.NDArray[Any] | None = None
    """The same where they were kept."""

    def with_light_kept(self) -> Rendered:
        """The same with arrays of its own for all that is known of the light."""
        light, others = (None if one is None else copied(one) for one in (self.environment_array, self.others_array))
        emitters = None if self.emitters_array is None else struct_values(self.emitters_array)
        return dataclasses.replace(self, environment=light, others=others, emitters=emitters)

    def at_once(self) -> Future[Rendered]:
        """The same as something that nobody needs to wait for."""
        future: Future[Rendered] = Future()
        future.set_result(self)
        return future


def done_at_once(work: Callable[[], Rendered]) -> Future[Rendered]:
    """A future of what this thread does now; an error is left to who asks for the result."""
    future: Future[Rendered] = Future()
    try:
        future.set_result(work())
    except Exception as error:
        future.set_exception(error)
    return future


@dataclasses.dataclass(frozen=True)
class Result:
    """Result of one frame; of a submitted one, all but the pose waits until it has been rendered."""

    pose: Pose | None
    """Pose from marker to camera; None while the marker is lost or if nothing needed it."""
    state: TrackState | None
    """Tracked, held or lost; None when nothing needed the pose."""
    _rendered: Future[Rendered]
    shown: bool = True
    """False for a frame of another exposure than the shown ones: it only measured light, and the picture is the
    previous one."""

    @property
    def image_array(self) -> Any:
        """The lit frame, (height, width) of 8-bit RGB, on the pipeline's device; valid until the next call."""
        return self._rendered.result().image_array

    @property
    def environment_array(self) -> Any:
        """The environment, latlong linear RGB (rows, columns), or None if it was not asked for or not seen yet."""
        return self._rendered.result().environment_array

    @property
    def stages(self) -> Mapping[str, StageTiming]:
        """Milliseconds of every stage of the plan, and whether it was skipped."""
        return self._rendered.result().stages

    @property
    def steps(self) -> Mapping[str, float]:
        """Milliseconds of the steps of the frame's way, which overlap those of other frames.

        ``track`` and ``render`` (on CUDA: launching) on the host; of a frame that was submitted on CUDA also
        ``upload``, ``kernels`` and ``download``, on the device.
        """
        rendered = self._rendered.result()
        tracking = rendered.stages.get(TRACK)
        steps = {TRACK: tracking.milliseconds} if tracking is not None else {}
        steps["render"] = rendered.render_ms
        return steps | rendered.image.steps() if isinstance(rendered.image, Picture) else steps

    @functools.cached_property
    def image(self) -> Image:
        """The lit frame as a NumPy array of its own, uint8 RGB (height, width, 3)."""
        rendered = self._rendered.result()
        if rendered.image is not None:
            return rendered.image.result() if isinstance(rendered.image, Picture) else rendered.image
        return copied(rendered.image_array)

    @functools.cached_property
    def environment(self) -> npt.NDArray[np.float32] | None:
        """The environment as a NumPy array of its own, float32 RGB (rows, columns, 3); of several balls the first's."""
        rendered = self._rendered.result()
        if rendered.environment is not None or rendered.environment_array is None:
            return rendered.environment
        return copied(rendered.environment_array)

    @functools.cached_property
    def environments(self) -> tuple[npt.NDArray[np.float32], ...]:
        """The environment at every mirror ball whose light is interpolated, as ``environment``, which is the first.

        One where there is one map, none where it was not asked for or not seen yet.
        """
        rendered = self._rendered.result()
        others = rendered.others
        if others is None and rendered.others_array is not None:
            others = copied(rendered.others_array)
        return () if self.environment is None else (self.environment, *(() if others is None else others))

    @functools.cached_property
    def emitters(self) -> npt.NDArray[Any] | None:
        """Emitters of the environment with their places, an array of its own: what ``Pipeline.take_light`` takes.

        None where the environment was not asked for or not seen yet, or the quality does not find their places.
        """
        rendered = self._rendered.result()
        if rendered.emitters is not None or rendered.emitters_array is None:
            return rendered.emitters
        with exclusive(rendered.emitters_array.device):
            values: npt.NDArray[Any] = struct_values(rendered.emitters_array)
            return values

    @property
    def layer_arrays(self) -> Mapping[str, Any]:
        """The layers that were asked for, by name, where they lie; on the device valid until the next call."""
        layers = self._rendered.result().layers
        return {} if layers is None else layers.arrays

    @functools.cached_property
    def _host_layers(self) -> LayerArrays:
        layers = self._rendered.result().layers
        return LayerArrays({}) if layers is None else layers.to_host()

    @property
    def layers(self) -> Mapping[str, npt.NDArray[Any]]:
        """The layers that were asked for as NumPy arrays of their own, by the names of ``warp_ar.LAYERS``.

        float32 (height, width[, components]); ``ids`` int32. Read them before the next call, as ``image``.
        """
        return self._host_layers.arrays

    @functools.cached_property
    def radiance(self) -> npt.NDArray[np.float32]:
        """The lit frame as linear radiance, float32 RGB (height, width, 3), exposure and all, before it is encoded.

        It is composed on the host of the layers, at the depth that the frame came with.

        Raises:
            UsageError: ``radiance`` is not among the outputs.
        """
        if missing := [name for name in PICTURE_LAYERS if name not in self.layers]:
            raise UsageError(f'radiance needs outputs=("radiance",): {", ".join(missing)} were not asked for')
        return np.asarray(np.float32(self.exposure_scale) * compose_layers(self.layers))

    @property
    def exposure_scale(self) -> float:
        """Factor on the radiance of the layers' composition in the picture; known where a layer was asked for."""
        scale = self._host_layers.scale
        return 1.0 if scale is None else float(scale[0])

    def _picture(self) -> Any:
        """The lit frame where it lies: on the device, or on the host if it was sent ahead or passed as it came."""
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
        """The lit frame for ``torch.from_dlpack(result)`` and the like: uint8 RGB (height, width, 3), without a copy.

        It lies on the pipeline's device and is overwritten by the next call: clone what is to last. Of a frame that was
        submitted, as a ``Session`` does, it is the picture that was sent to the host, which lasts.

        Args:
            stream: The consumer's, by the protocol: it waits on the device for the kernels.
            max_version: Of DLPack that the consumer reads.
            dl_device: Where the consumer wants it; only where it lies can it have it.
            copy: Whether it must be a copy.

        Raises:
            BufferError: The consumer wants a copy, or the picture on another device.
        """
        picture = self._picture()
        if not isinstance(picture, wp.array):
            return picture.__dlpack__(stream=stream, max_version=max_version, dl_device=dl_device, copy=copy)
        if copy or (dl_device is not None and tuple(map(int, dl_device)) != self.__dlpack_device__()):
            raise BufferError("a result is handed over without a copy, where it lies; copy it afterwards")
        with exclusive(picture.device):
            return picture.__dlpack__(stream=stream)

    def __dlpack_device__(self) -> tuple[int, int]:
        """DLPack's kind and number of the device that holds what ``__dlpack__`` gives."""
        kind, number = self._picture().__dlpack_device__()
        return int(kind), int(number)

    @property
    def __cuda_array_interface__(self) -> dict[str, Any]:
        """As ``__dlpack__``, for those who read this protocol; absent where the picture is not on a CUDA device.

        It names Warp's stream, which a reader of version 3 waits for.
        """
        picture = self._picture()
        if not isinstance(picture, wp.array):
            raise AttributeError("__cuda_array_interface__: the picture is on the host")
        interface: dict[str, Any] = dict(picture.__cuda_array_interface__)
        return interface | {"version": 3, "stream": picture.device.stream.cuda_stream or 1}

    def _repr_png_(self) -> bytes:
        """The lit frame as PNG: what a notebook shows of a result."""
        done, data = cv2.imencode(".png", cv2.cvtColor(self.image, cv2.COLOR_RGB2BGR))
        assert done
        return bytes(data)
