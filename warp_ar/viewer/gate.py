"""Who may connect: silent and slow connections are cut, and never take the places of those who have shown the token.

A connection is *admitted* once one whole request of it has passed the server's checks (its site, and the token where
there is one). Until then it has ``HEADER_SECONDS``, the TLS handshake included; afterwards as long between requests,
and as long as it likes on a WebSocket, whose heartbeat looks after it. Connections of both kinds have places of their
own, all in all and for each address. Where those are taken, the connection that has waited longest goes: whoever opens
many in silence cuts his own, and whoever sends his request at once comes in.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import errno
import itertools
import socket
import ssl
import time
from collections.abc import Iterable
from typing import Any, Final

from aiohttp import web

from warp_ar.errors import say
from warp_ar.viewer import protocol

HEADER_SECONDS: Final = 10.0
"""How long a connection may take for its handshake and a request's header, and may rest between requests."""
REQUEST_SECONDS: Final = 300.0
"""How long the answer to one request may take: a recording of five minutes over a phone's network."""
MOST_WAITING: Final = 48
"""Connections that have shown nothing yet."""
MOST_ADMITTED: Final = 48
"""Connections whose request was let in: a page takes up to seven."""
SHARE: Final = 0.125
"""Of the files that this process may open, for either kind of connection."""
MOST_PER_ADDRESS: Final = 24
"""Connections of either kind from one address."""
ACCEPTED_PER_SECOND: Final = 200.0
"""Connections taken from the system's queue; each takes 0.2 ms, over TLS two."""
BACKLOG: Final = 64
"""Connections that wait in the system's queue."""
FULL_SECONDS: Final = 0.2
"""Rest where the process has no file left for another connection."""
SWEEP_SECONDS: Final = 0.5
TOLD_SECONDS: Final = 60.0
"""Shortest time between two lines about connections that were cut."""


@dataclasses.dataclass(eq=False)
class Connection:
    """One connection."""

    address: str
    deadline: float
    """When it is cut, seconds of ``time.monotonic``."""
    socket: socket.socket
    transport: asyncio.Transport | None = None
    """None until the handshake is done."""
    handshake: asyncio.Task[None] | None = None
    begun: bool = False
    """Whether the handshake, if only in name, has begun: the socket then belongs to the event loop."""
    admitted: bool = False
    answering: bool = False
    """Whether a request of it is being answered."""

    def cut(self) -> None:
        """Close it without waiting for its other end."""
        if self.transport is not None:
            self.transport.abort()
        elif not self.begun:
            self.socket.close()
        elif self.handshake is not None:
            self.handshake.cancel()


class _Handler(web.RequestHandler):
    """A connection's HTTP, told of where it ends; errors of its parser get the same headers as all answers."""

    def __init__(self, gate: Gate, connection: Connection, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.gate, self.connection = gate, connection

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self.connection.transport = transport
        super().connection_made(transport)

    def connection_lost(self, exc: BaseException | None) -> None:
        self.gate.forget(self.connection)
        super().connection_lost(exc)

    def handle_error(
        self, request: Any, status: int = 500, exc: BaseException | None = None, message: str | None = None
    ) -> web.StreamResponse:
        if status < 500:
            # What somebody sent who speaks no HTTP is his affair, and no line of the log.
            response = web.Response(status=status, text="not understood\n", headers=self.gate.headers)
            response.force_close()
            return response
        answer = super().handle_error(request, status, exc, message)
        answer.headers.update(self.gate.headers)
        return answer

    def log_exception(self, *args: Any, **options: Any) -> None:
        # Nor is a body that is not what its header says.
        if not isinstance(options.get("exc_info"), web.RequestPayloadError):
            super().log_exception(*args, **options)


def file_limit() -> int:
    """How many files this process may open."""
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
        self.headers = headers
        self._header_seconds = header_seconds
        share = max(int(SHARE * file_limit()), 4)
        self._most = {False: min(MOST_WAITING, share), True: min(MOST_ADMITTED, share)}
        self._connections: dict[Connection, None] = {}
        self._rate = protocol.Bucket(ACCEPTED_PER_SECOND, ACCEPTED_PER_SECOND)
        self._tasks: set[asyncio.Task[Any]] = set()
        self._listeners: list[socket.socket] = []
        self._cut = 0
        self._told = 0.0
        self._server: web.Server | None = None
        self._tls: ssl.SSLContext | None = None

    def __len__(self) -> int:
        return len(self._connections)

    def start(self, server: web.Server, listeners: Iterable[socket.socket], tls: ssl.SSLContext | None) -> None:
        """Take connections from sockets that listen."""
        self._server, self._tls = server, tls
        self._listeners = list(listeners)
        for listener in self._listeners:
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
        for listener in self._listeners:
            asyncio.get_running_loop().remove_reader(listener)
        for task in tuple(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        for listener in self._listeners:
            listener.close()
        for connection in tuple(self._connections):
            connection.cut()

    async def _accept(self, listener: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        while True:
            while not self._rate.take(1.0, time.monotonic()):
                await asyncio.sleep(2.0 / ACCEPTED_PER_SECOND)
            try:
                taken, address = await loop.sock_accept(listener)
            except OSError as error:
                # Nothing left to open files with, or a connection that was gone again.
                if error.errno in (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM):
                    self._note()
                    self._evict(None)
                    await asyncio.sleep(FULL_SECONDS)
                continue
            connection = Connection(str(address[0]), time.monotonic() + self._header_seconds, taken)
            self._connections[connection] = None
            self._make_room(connection)
            connection.handshake = self._spawn(self._hand_over(connection))
            await asyncio.sleep(0)  # requests of others are read meanwhile

    async def _hand_over(self, connection: Connection) -> None:
        """Have the server speak HTTP with a connection, after the handshake where there is one."""
        server, loop = self._server, asyncio.get_running_loop()
        assert server is not None
        if connection.socket.fileno() < 0:
            return  # cut already
        connection.begun = True

        def make() -> _Handler:
            options = {"access_log": None, "keepalive_timeout": self._header_seconds, "lingering_time": 1.0}
            return _Handler(self, connection, server, loop=loop, **options)

        patience: dict[str, Any] = {}
        if self._tls is not None:
            patience = {"ssl_handshake_timeout": self._header_seconds, "ssl_shutdown_timeout": 1.0}
        try:
            await loop.connect_accepted_socket(make, connection.socket, ssl=self._tls, **patience)
        except OSError:  # no TLS, or too slow: ssl.SSLError is one
            self.forget(connection)

    def forget(self, connection: Connection) -> None:
        """A connection has ended."""
        self._connections.pop(connection, None)

    # ------------------------------------------------------------------------------------------- what the server says

    @contextlib.contextmanager
    def answering(self, request: web.Request) -> Any:
        """Entered while a request is answered."""
        connection = self.connection_of(request)
        if connection is None:
            yield
            return
        connection.answering, connection.deadline = True, time.monotonic() + REQUEST_SECONDS
        try:
            yield
        finally:
            connection.answering = False
            connection.deadline = time.monotonic() + self._header_seconds
            if connection in self._connections:
                self._connections[connection] = self._connections.pop(connection)  # who was answered last goes last

    def admit(self, request: web.Request) -> None:
        """A request has passed the server's checks."""
        connection = self.connection_of(request)
        if connection is not None and not connection.admitted:
            connection.admitted = True
            # The latest last.
            self.forget(connection)
            self._connections[connection] = None
            self._make_room(connection)

    def upgrade(self, request: web.Request) -> None:
        """A request has become a WebSocket."""
        connection = self.connection_of(request)
        if connection is not None:
            connection.deadline = float("inf")

    @staticmethod
    def connection_of(request: web.Request) -> Connection | None:
        """The connection that a request came by."""
        return getattr(request.protocol, "connection", None)

    # ------------------------------------------------------------------------------------------------------------- room

    def _make_room(self, newest: Connection) -> None:
        same = [other for other in self._connections if other.admitted == newest.admitted]
        near = [other for other in same if other.address == newest.address]
        if len(near) > min(MOST_PER_ADDRESS, self._most[newest.admitted]):
            self._evict(newest, near)
        elif len(same) > self._most[newest.admitted]:
            self._evict(newest, same)

    def _evict(self, newest: Connection | None, among: list[Connection] | None = None) -> None:
        """Cut who has waited longest; if nobody does, the newest."""
        known = list(self._connections) if among is None else among
        resting = (other for other in known if not other.answering and other is not newest)
        goes = next(itertools.chain(resting, [] if newest is None else [newest]), None)
        if goes is not None:
            self._end(goes)

    def _end(self, connection: Connection) -> None:
        self.forget(connection)
        connection.cut()
        self._cut += 1
        self._note()

    async def _sweep(self) -> None:
        while True:
            await asyncio.sleep(SWEEP_SECONDS)
            now = time.monotonic()
            for connection in tuple(self._connections):
                if connection.deadline < now:
                    # A browser's spare connection, or one that rests between requests: nothing to tell.
                    self.forget(connection)
                    connection.cut()

    def _note(self) -> None:
        """Say now and then that connections are being cut."""
        now = time.monotonic()
        if now - self._told >= TOLD_SECONDS:
            self._told = now
            say(f"too many connections are open; those that wait longest are cut ({self._cut} so far)")
