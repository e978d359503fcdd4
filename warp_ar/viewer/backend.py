"""What all routes of the page's server stand on: its host, threads beside the loop, and who may connect how often."""

from __future__ import annotations

import asyncio
import functools
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, Final, TypeVar

from warp_ar.viewer.address import Address
from warp_ar.viewer.gate import Gate
from warp_ar.viewer.protocol import Bucket

if TYPE_CHECKING:
    from warp_ar.viewer.host import Host  # loads Warp, for which the page does not wait

_T = TypeVar("_T")

MOST_VIEWERS: Final = 8
STOP_SECONDS: Final = 0.7
"""How long the end waits for a frame in hand, and as long for what is being built."""
CONNECTIONS_PER_SECOND: Final = 50.0
"""From one address; each takes about a millisecond."""
_MOST_ADDRESSES: Final = 256


class Backend:
    """The host of one server, made beside the loop, and the threads that work for its requests."""

    def __init__(self, address: Address, gate: Gate) -> None:
        """Start nothing yet.

        Args:
            address: Where the page is served.
            gate: Takes its connections.
        """
        self.address = address
        self.gate = gate
        self.encoder = ThreadPoolExecutor(1, "warp-ar-encode")
        """Packs pictures."""
        self._hands = ThreadPoolExecutor(2, "warp-ar-page")
        self.ending = False
        """Whether the threads take nothing more."""
        self._host: Host | None = None
        self._starting: asyncio.Future[Host] | None = None
        self._arrivals: dict[str, Bucket] = {}
        self._waiting = 0

    async def start(self, make_host: Callable[[], Host]) -> Host:
        """Make the host on a thread, and give it to all who wait for it."""
        self._starting = self.aside(make_host)
        self._host = await asyncio.shield(self._starting)
        return self._host

    async def started(self) -> Host:
        """The host, once it is there."""
        while self._host is None:
            await asyncio.sleep(0.05)
        return self._host

    @property
    def host(self) -> Host:
        """The host; there is one as soon as a viewer has been let in."""
        assert self._host is not None
        return self._host

    def aside(
        self, function: Callable[..., _T], *arguments: Any, pool: ThreadPoolExecutor | None = None
    ) -> asyncio.Future[_T]:
        """Begin what may take long beside the loop.

        Raises:
            asyncio.CancelledError: The server is ending, and its threads take nothing more.
        """
        if self.ending:
            raise asyncio.CancelledError
        loop = asyncio.get_running_loop()
        return loop.run_in_executor(pool or self._hands, functools.partial(function, *arguments))

    async def may_come(self, address: str) -> bool:
        """Let an address connect now and then: whoever is dropped and comes back at once takes the frames' time."""
        if address not in self._arrivals:
            while len(self._arrivals) >= _MOST_ADDRESSES:
                del self._arrivals[next(iter(self._arrivals))]
            self._arrivals[address] = Bucket(CONNECTIONS_PER_SECOND, 2 * CONNECTIONS_PER_SECOND)
        bucket = self._arrivals[address]
        if self._waiting >= MOST_VIEWERS:
            return False
        self._waiting += 1
        try:
            while not bucket.take(1.0, time.monotonic()):
                await asyncio.sleep(1.0 / CONNECTIONS_PER_SECOND)
        finally:
            self._waiting -= 1
        return True

    def stop(self) -> None:
        """Begin the end: threads take nothing more, and the host stops after the frame in hand."""
        self.ending = True
        if self._host is not None:
            self._host.stop()

    async def end(self, running: asyncio.Future[None] | None) -> bool:
        """End the host and all threads; what takes too long is left behind.

        Args:
            running: Done when the frames have ended; None where they never began.

        Returns:
            Whether all threads have ended.
        """
        host = self._host
        ended = True
        waited: asyncio.Future[Any] | None = running if running is not None else self._starting
        if waited is not None:
            done, _ = await asyncio.wait({waited}, timeout=STOP_SECONDS)
            ended = bool(done)
            if done and not waited.cancelled() and waited.exception() is None and host is None:
                host = waited.result()
        for pool in (self.encoder, self._hands):
            pool.shutdown(wait=ended, cancel_futures=True)
        if host is not None:
            ended = host.close(wait_seconds=STOP_SECONDS, frames_ended=ended)
        return ended
