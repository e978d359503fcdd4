"""Admission of connections: silent and slow ones are closed, and cannot displace those that have sent the token.

A connection is *admitted* once one whole request of it has passed the server's checks (its site, and the token where
there is one). Until then it has ``HEADER_SECONDS``, the TLS handshake included; afterwards as long between requests,
and as long as it likes on a WebSocket, which its heartbeat looks after. Places are counted in all and for each address.
Where they are taken, the connection goes that has waited longest, those that are not admitted first: whoever opens
many in silence cuts his own, and whoever sends his request at once comes in.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import socket
import ssl
import time
from collections.abc import Iterator
from typing import Any, Final

from aiohttp import web

from warp_ar.errors import say
from warp_ar.viewer import protocol

HEADER_SECONDS: Final = 10.0
"""Longest time for a connection's handshake and a request's header, and longest rest between requests."""
REQUEST_SECONDS: Final = 300.0
"""Longest time for the answer to one request: a scene with its files over a phone's network."""
MOST_CONNECTIONS: Final = 96
"""Connections in all; a page takes up to seven."""
SHARE: Final = 0.25
"""Largest share of the files that this process may open."""
MOST_PER_ADDRESS: Final = 24
ACCEPTED_PER_SECOND: Final = 150.0
"""Connections taken from the system's queue; each takes 0.2 ms, over TLS two."""
BACKLOG: Final = 64
"""Connections that wait in the system's queue."""
FULL_SECONDS: Final = 0.2
"""Rest where the process has no file left for another connection."""
SWEEP_SECONDS: Final = 0.5
TOLD_SECONDS: Final = 60.0
"""Shortest time between two lines about connections that were cut."""


class Connection(web.RequestHandler):
    """HTTP of one connection, and its place at the gate."""

    def __init__(self, gate: Gate, taken: socket.socket, address: str, **options: Any) -> None:
        super().__init__(gate.server, loop=asyncio.get_running_loop(), **options)
        self.gate, self.socket, self.address = gate, taken, address
        self.deadline = time.monotonic() + gate.header_seconds
        """Time at which it is cut, seconds of ``time.monotonic``."""
        self.handshake: asyncio.Task[None] | None = None
        self.admitted = False
        self.answering = False
        """True while a request of it is answered."""

    def cut(self) -> None:
        """Close it without waiting for its other end."""
        self.gate.connections.pop(self, None)
        if self.transport is not None:
            self.transport.abort()
        elif self.handshake is not None:
            self.handshake.cancel()

    def connection_lost(self, exc: BaseException | None) -> None:
        """Leave the gate."""
        self.gate.connections.pop(self, None)
        super().connection_lost(exc)

    def handle_error(
        self, request: Any, status: int = 500, exc: BaseException | None = None, message: str | None = None
    ) -> web.StreamResponse:
        """Answer an error with the headers of all answers."""
        if status < 500:
            # Requests that are no HTTP are their sender's affair, and no line of the log.
            answer: web.StreamResponse = web.Response(status=status, text="not understood\n")
            answer.force_close()
        else:
            answer = super().handle_error(request, status, exc, message)
        answer.headers.update(self.gate.headers)
        return answer

    def log_exception(self, *args: Any, **options: Any) -> None:
        """Log an exception, unless it is of a body that is not what its header says."""
        if not isinstance(options.get("exc_info"), web.RequestPayloadError):
            super().log_exception(*args, **options)


def file_limit() -> int:
    """Return how many files this process may open."""
    try:
        import resource
    except ImportError:  # Windows, where sockets are no files
        return 8192
    soft = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    return 8192 if soft == resource.RLIM_INFINITY else soft


class Gate:
    """Takes connections for a server and looks after them. All of it runs on the event loop."""

    def __init__(self, headers: dict[str, str], *, header_seconds: float = HEADER_SECONDS) -> None:
        """Set the bounds.

        Args:
            headers: Of every answer that the server itself does not give.
            header_seconds: As ``HEADER_SECONDS``.
        """
        self.headers, self.header_seconds = headers, header_seconds
        self.connections: dict[Connection, None] = {}
        """All connections; the one that has waited longest comes first."""
        self.server: Any = None
        self._tls: ssl.SSLContext | None = None
        self._most = min(MOST_CONNECTIONS, max(int(SHARE * file_limit()), 8))
        self._rate = protocol.Bucket(ACCEPTED_PER_SECOND, ACCEPTED_PER_SECOND)
        self._tasks: set[asyncio.Task[Any]] = set()
        self._listener: socket.socket | None = None
        self._cut = 0
        self._told = 0.0

    def start(self, server: web.Server, listener: socket.socket, tls: ssl.SSLContext | None) -> None:
        """Take connections from a socket that listens."""
        self.server, self._tls, self._listener = server, tls, listener
        listener.setblocking(False)
        self._spawn(self._accept(listener))
        self._spawn(self._sweep())

    def _spawn(self, coroutine: Any) -> asyncio.Task[Any]:
        task = asyncio.get_running_loop().create_task(coroutine)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    async def close(self) -> None:
        """Take no more connections, and cut those that are left."""
        if self._listener is not None:
            asyncio.get_running_loop().remove_reader(self._listener)
        for task in tuple(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        if self._listener is not None:
            self._listener.close()
        for connection in tuple(self.connections):
            connection.cut()
            if connection.transport is None:
                connection.socket.close()

    async def _accept(self, listener: socket.socket) -> None:
        while True:
            while not self._rate.take(1.0, time.monotonic()):
                await asyncio.sleep(2.0 / ACCEPTED_PER_SECOND)
            try:
                taken, address = await asyncio.get_running_loop().sock_accept(listener)
            except OSError as error:
                # Nothing left to open files with, or a connection that was gone again.
                if error.errno in (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM):
                    self._evict(list(self.connections))
                    await asyncio.sleep(FULL_SECONDS)
                continue
            options = {"access_log": None, "keepalive_timeout": self.header_seconds, "lingering_time": 1.0}
            connection = Connection(self, taken, str(address[0]), **options)
            self.connections[connection] = None
            connection.handshake = self._spawn(self._hand_over(connection))
            await asyncio.sleep(0)  # the handshake begins: from here on the event loop closes the socket
            self._make_room(connection)

    async def _hand_over(self, connection: Connection) -> None:
        """Speak HTTP with a connection, after the handshake where there is one."""
        patience: dict[str, Any] = {}
        if self._tls is not None:
            patience = {"ssl_handshake_timeout": self.header_seconds, "ssl_shutdown_timeout": 1.0}
        try:
            loop = asyncio.get_running_loop()
            await loop.connect_accepted_socket(lambda: connection, connection.socket, ssl=self._tls, **patience)
        except OSError:  # no TLS, or too slow: ssl.SSLError is one
            self.connections.pop(connection, None)

    @staticmethod
    def connection_of(request: web.Request) -> Connection:
        """Return the connection that a request came by."""
        connection = request.protocol
        assert isinstance(connection, Connection)
        return connection

    @contextlib.contextmanager
    def answering(self, request: web.Request, *, admitted: bool) -> Iterator[None]:
        """Keep a connection while a request of it is answered; ``admitted``: that request shows that it may be here."""
        connection = self.connection_of(request)
        connection.admitted |= admitted
        connection.answering, connection.deadline = True, time.monotonic() + REQUEST_SECONDS
        try:
            yield
        finally:
            connection.answering, connection.deadline = False, time.monotonic() + self.header_seconds
            if connection in self.connections:
                self.connections[connection] = self.connections.pop(connection)  # most recently answered: last

    def _make_room(self, newest: Connection) -> None:
        everyone = list(self.connections)
        near = [other for other in everyone if other.address == newest.address]
        if len(near) > min(MOST_PER_ADDRESS, self._most):
            self._evict(near, newest)
        elif len(everyone) > self._most:
            self._evict(everyone, newest)

    def _evict(self, among: list[Connection], newest: Connection | None = None) -> None:
        """Cut who has waited longest, and say now and then that connections are being cut."""
        resting = [other for other in among if not other.answering and other is not newest] or among[-1:]
        if resting:
            min(resting, key=lambda other: other.admitted).cut()  # the first of equals
            self._cut += 1
        if (now := time.monotonic()) - self._told >= TOLD_SECONDS:
            self._told = now
            say(f"too many connections are open; those that wait longest are cut ({self._cut} so far)")

    async def _sweep(self) -> None:
        while True:
            await asyncio.sleep(SWEEP_SECONDS)
            now = time.monotonic()
            for connection in [one for one in self.connections if one.deadline < now]:
                connection.cut()  # a browser's spare connection, or one that rests between requests: nothing to tell
