"""Copies of a device's arrays on the host, for work there beside the frames.

On CUDA they are pinned and filled by a stream of their own, so that neither the kernels nor the host wait. On CPU the
arrays are on the host already: who reads them here must know that nothing writes them meanwhile.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy.typing as npt
import warp as wp

from warp_ar.device import wait_for


class HostCopies:
    """The host's side of some device arrays: fetched from there, or sent there."""

    def __init__(self, arrays: Mapping[str, Any], device: Any) -> None:
        """Allocate.

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
        """Begin to copy from the device on ``stream``, as objects stand when ``after``'s work so far is done.

        Args:
            stream: Copies.
            after: Writes the arrays; it is not held up.
            count: Elements of each array to copy; None means all.
        """
        if self._done is None:
            return
        after.record_event(self._begun)
        stream.wait_event(self._begun)
        for name, host in self._hosts.items():
            wp.copy(host, self._arrays[name], count=count or 0, stream=stream)
        stream.record_event(self._done)

    def fetched(self) -> Mapping[str, npt.NDArray[Any]]:
        """The host's arrays once ``fetch`` is done; the next one overwrites them."""
        if self._done is not None:
            wait_for(self._done)
        return self._views

    def send(self, values: Mapping[str, npt.NDArray[Any]], stream: Any = None) -> None:
        """Begin to copy ``values`` to the device on a stream; None: that of the frames."""
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
