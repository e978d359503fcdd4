"""Host copies of device arrays, for work on the host concurrent with the frames.

On CUDA the copies are pinned and filled on a separate stream, so that neither the kernels nor the host wait. On CPU the
arrays are host memory already: a caller that reads them here must be sure that nothing writes them meanwhile.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy.typing as npt
import warp as wp

from warp_ar.device import wait_for


class HostCopies:
    """Host copies of some device arrays, which are fetched or sent."""

    def __init__(self, arrays: Mapping[str, Any], device: Any) -> None:
        """Allocate the host copies.

        Args:
            arrays: Warp arrays on ``device``, contiguous.
            device: Warp device.
        """
        self._arrays = dict(arrays)
        self._done: Any = None
        self._hosts = self._arrays
        if device.is_cuda:
            self._hosts = {
                name: wp.zeros(array.shape, dtype=array.dtype, device="cpu", pinned=True)
                for name, array in arrays.items()
            }
            self._done, self._begun = wp.Event(device), wp.Event(device)
            self._used, self._frames = False, wp.get_stream(device)
        self._views: dict[str, npt.NDArray[Any]] = {name: host.numpy() for name, host in self._hosts.items()}

    def fetch(self, stream: Any, after: Any, count: int | None = None) -> None:
        """Start a copy from the device on ``stream``, of the values after the work so far on the stream ``after``.

        Args:
            stream: Stream that copies.
            after: Stream that writes the arrays; it does not wait for the copy.
            count: Number of elements of each array to copy; None means all.
        """
        if self._done is None:
            return
        after.record_event(self._begun)
        stream.wait_event(self._begun)
        for name, host in self._hosts.items():
            wp.copy(host, self._arrays[name], count=count or 0, stream=stream)
        stream.record_event(self._done)

    def fetched(self) -> Mapping[str, npt.NDArray[Any]]:
        """Wait for ``fetch`` and return the host arrays, which the next fetch overwrites."""
        if self._done is not None:
            wait_for(self._done)
        return self._views

    def send(self, values: Mapping[str, npt.NDArray[Any]], stream: Any = None) -> None:
        """Start a copy of ``values`` to the device on a stream; None: the stream of the frames."""
        if self._done is not None and self._used:
            wait_for(self._done)
        for name, value in values.items():
            self._views[name][...] = value
        if self._done is None:
            return
        stream = stream or self._frames
        for name in values:
            wp.copy(self._arrays[name], self._hosts[name], stream=stream)
        stream.record_event(self._done)
        self._used = True
