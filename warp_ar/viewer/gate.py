"""Admission of connections: silent and slow ones are closed, and cannot displace those that have sent the token.

A connection is *admitted* once one complete request of it has passed the server's checks of origin and token. It has
``HEADER_SECONDS`` to do so, TLS handshake included, and as much time between later requests. WebSockets have no limit;
their heartbeat finds dead ones. The number of connections is limited, in total and per address. At the limit, the
connection that has waited longest is closed, and those not admitted go first. A client that opens many silent
connections thus loses its own, and a client that sends its request at once is served.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import socket
import ssl
import time
from collections.abc import Iterator
from typing import Any, Final

from aiohttp import web

from warp_ar.errors import say
from warp_ar.viewer import protocol

HEADER_SECONDS: Final = 10.0
"""Longest time for a connection's handshake and a request's header, and longest pause between requests, seconds."""
REQUEST_SECONDS: Final = 300.0
"""Longest time for the answer to one request, seconds: enough for a scene with its files over a mobile network."""
MOST_CONNECTIONS: Final = 96
"""Largest number of connections; one page uses up to seven."""
SHARE: Final = 0.25
"""Largest number of connections, as a fraction of the files that this process may open."""
MOST_PER_ADDRESS: Final = 24
ACCEPTED_PER_SECOND: Final = 150.0
"""Connections accepted per second; each takes 0.2 ms, over TLS 2 ms."""
BACKLOG: Final = 64
"""Connections that may wait in the system's queue."""
FULL_SECONDS: Final = 0.2
"""Pause after the process has run out of file descriptors, seconds."""
SWEEP_SECONDS: Final = 0.5
TOLD_SECONDS: Final = 60.0
"""Shortest time between two messages about closed connections, seconds."""


class Connection(web.RequestHandler):
    """HTTP handler of one connection, with the connection's deadline and state of admission."""

    def __init__(self, gate: Gate, taken: socket.socket, address: str, **options: Any) -> None:
        super().__init__(gate.server, loop=asyncio.get_running_loop(), **options)
        self.gate, self.socket, self.address = gate, taken, address
        self.deadline = time.monotonic() + gate.header_seconds
        """Time at which the connection is closed, seconds of ``time.monotonic``."""
        self.handshake: asyncio.Task[None] | None = None
        self.admitted = False
        self.answering = False
        """True while one of its requests is being answered."""

    def cut(self) -> None:
        """Close the connection without waiting for the client."""
        self.gate.connections.pop(self, None)
        if self.transport is not None:
            self.transport.abort()
        elif self.handshake is not None:
            self.handshake.cancel()

    def connection_lost(self, exc: BaseException | None) -> None:
        """Remove the connection from the gate."""
        self.gate.connections.pop(self, None)
        super().connection_lost(exc)

    def handle_error(
        self, request: Any, status: int = 500, exc: BaseException | None = None, message: str | None = None
    ) -> web.StreamResponse:
        """Return the answer to a failed request, with the headers of all answers."""
        if status < 500:
            # A request that is not HTTP is the client's fault and is not logged.
            answer: web.StreamResponse = web.Response(status=status, text="not understood\n")
            answer.force_close()
        else:
            answer = super().handle_error(request, status, exc, message)
        answer.headers.update(self.gate.headers)
        return answer

    def log_exception(self, *args: Any, **options: Any) -> None:
        """Log an exception, unless its cause is a request body that contradicts the request's header."""
        if not isinstance(options.get("exc_info"), web.RequestPayloadError):
            super().log_exception(*args, **options)


def file_limit() -> int:
    """Return how many files this process may open."""
    most = os.sysconf("SC_OPEN_MAX") if hasattr(os, "sysconf") else 0  # Windows, where sockets are no files
    return most if most > 0 else 8192


class Gate:
    """Acceptor of a server's connections, which enforces the limits. All methods run on the event loop."""

    def __init__(self, headers: dict[str, str], *, header_seconds: float = HEADER_SECONDS) -> None:
        """Set the limits.

        Args:
            headers: Headers of the answers to malformed requests.
            header_seconds: Limit in place of ``HEADER_SECONDS``.
        """
        self.headers, self.header_seconds = headers, header_seconds
        self.connections: dict[Connection, None] = {}
        """All connections, the one that has waited longest first."""
        self.server: Any = None
        self._tls: ssl.SSLContext | None = None
        self._most = min(MOST_CONNECTIONS, max(int(SHARE * file_limit()), 8))
        self._rate = protocol.Bucket(ACCEPTED_PER_SECOND, ACCEPTED_PER_SECOND)
        self._tasks: set[asyncio.Task[Any]] = set()
        self._listener: socket.socket | None = None
        self._cut = 0
        self._told = 0.0

    def start(self, server: web.Server, listener: socket.socket, tls: ssl.SSLContext | None) -> None:
        """Accept connections from a listening socket."""
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
        """Accept no more connections, and close the open ones."""
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
                # Out of file descriptors or memory; or the client has left again.
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
        """Start HTTP on a connection, after its TLS handshake if TLS is used."""
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
        """Return the connection of a request."""
        connection = request.protocol
        assert isinstance(connection, Connection)
        return connection

    @contextlib.contextmanager
    def answering(self, request: web.Request, *, admitted: bool) -> Iterator[None]:
        """Protect a connection from being closed while its request is answered.

        Args:
            request: The request.
            admitted: True if the request has passed the checks that admit its connection.
        """
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
        """Close the connection that has waited longest, and report closed connections at most once a minute."""
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
                connection.cut()  # usually a browser's spare connection, or an idle one: nothing worth a message
