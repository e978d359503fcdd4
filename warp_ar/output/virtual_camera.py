"""Frames as a virtual camera that other programs open, by ``pyvirtualcam`` from the extra ``virtual-camera``.

On Linux this is a v4l2loopback device, on macOS and Windows the virtual camera of OBS. Frames are shown immediately.
"""

from __future__ import annotations

from typing import Any

import numpy.typing as npt

from warp_ar.errors import SinkError, import_extra, reason
from warp_ar.output.sink import Sink, check_image


class VirtualCameraSink(Sink):
    """Virtual camera of this machine.

    Args:
        device: Name of the device, such as ``/dev/video4``; None: the first one.
        fps: Frames per second reported by the device.
        size: (width, height) in pixels.
        paced: True if `write` waits for the frame's time.

    Raises:
        SinkError: There is no such device, or it is in use.
        UsageError: ``pyvirtualcam`` is not installed.
    """

    def __init__(self, device: str | None, *, fps: float, size: tuple[int, int], paced: bool = False) -> None:
        library = import_extra("virtual-camera", "a virtual camera needs pyvirtualcam", "pyvirtualcam")
        width, height = size
        try:
            self._camera: Any = library.Camera(width, height, fps, device=device)
        except (RuntimeError, OSError, ValueError) as error:
            which = "a virtual camera" if device is None else f"the virtual camera {device}"
            raise SinkError(f"{which} cannot be opened: {reason(error)}") from error
        self._size, self._paced = size, paced
        self.description = f"{self._camera.device} (virtual camera, {width}x{height}, {fps:g} fps)"

    def write(self, image: npt.NDArray[Any]) -> None:
        """Show the frame.

        Raises:
            SinkError: The image is no frame of the camera's size, the camera is closed, or the device refuses it.
        """
        check_image(image)
        if image.shape[1::-1] != self._size:
            had, got = (f"{width}x{height}" for width, height in (self._size, image.shape[1::-1]))
            raise SinkError(f"{self.description}: frame {self.written} is {got}, not {had}")
        if self._camera is None:
            raise SinkError(f"{self.description} is closed; open another one to write to")
        try:
            self._camera.send(image)
            if self._paced:
                self._camera.sleep_until_next_frame()
        except (RuntimeError, OSError) as error:
            raise SinkError(f"{self.description}: frame {self.written} cannot be shown: {reason(error)}") from error
        self.written += 1

    def close(self) -> None:
        """Close the device."""
        camera, self._camera = self._camera, None
        if camera is not None:
            camera.close()
