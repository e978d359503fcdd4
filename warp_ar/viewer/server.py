"""Serves the page, over HTTP and one WebSocket per viewer.

A viewer is sent a frame only after it has shown an earlier one: two are under way at most, and the newest wins.
Pictures are encoded once for all viewers, and only if one is ready for them. Nothing that a viewer sends is trusted;
one that breaks the rules is dropped with a reason, and no other notices.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import functools
import hmac
import json
import socket
import threading
import time
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any, Final

import cv2
import numpy as np
import numpy.typing as npt
from aiohttp import WSCloseCode, WSMsgType, web

from warp_ar.errors import UsageError
from warp_ar.scene import bundled_scenes
from warp_ar.srgb import encode_srgb
from warp_ar.stages.quality import PRESETS
from warp_ar.viewer import protocol
from warp_ar.viewer.address import LOOPBACK, Address, listen
from warp_ar.viewer.backend import MOST_VIEWERS, Backend
from warp_ar.viewer.gate import HEADER_SECONDS, Gate
from warp_ar.viewer.messages import failure
from warp_ar.viewer.routes import PageFiles, SharedLight

if TYPE_CHECKING:
    from warp_ar.viewer.frames import Lit
    from warp_ar.viewer.host import Host
    from warp_ar.viewer.light_record import LightState


JPEG_QUALITY: Final = 85
"""At 640x480 a desk takes 60 KB; at 95 it takes twice that."""


def encode_jpeg(image: npt.NDArray[np.uint8]) -> bytes:
    """JPEG of an RGB picture."""
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    return bytes(cv2.imencode(".jpg", bgr, (cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY))[1])


def encode_light(light: npt.NDArray[np.float32]) -> bytes:
    """PNG of an environment: x / (1 + x), so that what clips in the camera still shows, encoded as sRGB."""
    value = np.maximum(light, 0.0)
    value = value / (1.0 + value)
    return bytes(cv2.imencode(".png", np.uint8(np.round(encode_srgb(value)[..., ::-1] * 255.0)))[1])


IN_FLIGHT: Final = 2
"""Frames that a viewer may have unshown: one on the way while another is decoded."""
SEND_SECONDS: Final = 20.0
"""A viewer that takes nothing for so long is dropped."""
STATE_SECONDS: Final = 0.5
MESSAGES_PER_SECOND: Final = 240.0
BYTES_PER_SECOND: Final = 8e6
"""Thirty pictures a second of a camera at 1920x1080."""
LARGEST_MESSAGE: Final = protocol.MAX_PICTURE + 64

_POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' blob: data:; "
    "media-src 'self' blob:; connect-src 'self' ws: wss:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_HEADERS: Final = {
    "Content-Security-Policy": _POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",  # the address holds the token
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}


def own_headers() -> dict[str, str]:
    """Headers of every answer, refusals too."""
    return dict(_HEADERS)


class _Viewer:
    """One WebSocket."""

    def __init__(self, socket: web.WebSocketResponse) -> None:
        self.socket = socket
        self.wake = asyncio.Event()
        self.queue: asyncio.Queue[str | bytes] = asyncio.Queue(64)
        self.sent = 0
        """Number of the newest frame sent."""
        self.unshown: set[int] = set()
        self.compare = ""
        self.messages = protocol.Bucket(MESSAGES_PER_SECOND, 2 * MESSAGES_PER_SECOND)
        self.bytes = protocol.Bucket(BYTES_PER_SECOND, 2 * BYTES_PER_SECOND)
        self.picture: asyncio.Task[None] | None = None
        self.early: list[str | bytes] | None = []
        """What all were told while its greetings were made, which may be older; None once it has those."""

    def tell(self, message: str | bytes) -> None:
        """Send a message when there is room for it; a viewer that lets 64 pile up misses some."""
        with contextlib.suppress(asyncio.QueueFull):
            self.queue.put_nowait(message)
        self.wake.set()


class Server:
    """The page of one host."""

    def __init__(
        self, make_host: Callable[..., Host], address: Address, *, header_seconds: float = HEADER_SECONDS
    ) -> None:
        """Build the application.

        Args:
            make_host: Called with ``publish`` and ``notify`` once the page is served; gives the host.
            address: Where to serve.
            header_seconds: How long a connection may take for a request's header.
        """
        self._loop: asyncio.AbstractEventLoop | None = None
        self._viewers: set[_Viewer] = set()
        self._latest: Lit | None = None
        self._jpegs: dict[tuple[int, str], asyncio.Future[bytes]] = {}
        self._packed_light: tuple[LightState, asyncio.Future[bytes]] | None = None
        self._encode_ms = 0.0
        self._make_host = make_host
        self.ended = True
        """Whether all threads of the frames have ended; False when ``serve`` was not to wait for them."""
        self.gate = Gate(own_headers(), header_seconds=header_seconds)
        self.backend = Backend(address, self.gate)
        self.app = web.Application(client_max_size=1024, middlewares=[self._guard])
        PageFiles(self.app, self.backend)
        SharedLight(self.app, self.backend)
        self.app.on_response_prepare.append(self._add_headers)
        self.app.add_routes([web.get("/live", self._live)])

    @property
    def address(self) -> Address:
        """Where the page is served; with the port that was taken, once it is."""
        return self.backend.address

    # ------------------------------------------------------------------------------------------------------- admission

    @web.middleware
    async def _guard(
        self, request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
    ) -> web.StreamResponse:
        """Refuse what comes from other sites, and beyond this machine whoever does not know the token."""
        name = (
            request.host.rsplit(":", 1)[0].strip("[]") if not request.host.endswith("]") else request.host.strip("[]")
        )
        # A foreign site that has its name resolve to this machine would pass every other check.
        if self.address.loopback and self.address.token is None and name not in LOOPBACK:
            return self._refuse(f"this page is at {self.address.url}")
        origin = request.headers.get("Origin")
        welcome = origin in self.address.origins and request.path.startswith("/light")
        if not welcome and origin is not None and origin != f"{request.scheme}://{request.host}":
            return self._refuse("requests from other sites are refused")
        if (
            not welcome
            and request.headers.get("Sec-Fetch-Site", "none") not in ("none", "same-origin")
            and request.path != "/"
        ):
            return self._refuse("requests from other sites are refused")
        given = request.query.get("token", "")
        public = request.path.startswith("/static/")
        if self.address.token is not None and not public and not _same(given, self.address.token):
            return self._refuse("a token is needed: open the whole address that the program printed")
        if not public or self.address.token is None:
            self.gate.admit(request)
        with self.gate.answering(request):
            return await handler(request)

    @staticmethod
    def _refuse(reason: str) -> web.Response:
        response = web.Response(status=403, text=f"warp_ar: {reason}\n")
        response.force_close()
        return response

    async def _add_headers(self, request: web.Request, response: web.StreamResponse) -> None:
        response.headers.update(_HEADERS)
        origin = request.headers.get("Origin")
        if origin in self.address.origins and request.path.startswith("/light"):
            allowed = {"Access-Control-Allow-Origin": str(origin), "Vary": "Origin"}
            response.headers.update({**allowed, "Cross-Origin-Resource-Policy": "cross-origin"})

    # ---------------------------------------------------------------------------------------------------------- frames

    def _publish(self, lit: Lit) -> None:
        """On the host's thread."""
        loop = self._loop
        if loop is not None:
            loop.call_soon_threadsafe(self._arrived, lit)

    def _arrived(self, lit: Lit) -> None:
        self._latest = lit
        for key in [key for key in self._jpegs if key[0] < lit.id - 1]:
            del self._jpegs[key]
        for viewer in self._viewers:
            viewer.wake.set()

    def _notify(self, message: dict[str, Any]) -> None:
        """On any thread."""
        loop = self._loop
        if loop is not None:
            loop.call_soon_threadsafe(self._tell_all, json.dumps(message))

    def _tell_all(self, message: str | bytes) -> None:
        for viewer in self._viewers:
            viewer.tell(message) if viewer.early is None else viewer.early.append(message)

    async def _jpeg(self, lit: Lit, which: str) -> bytes:
        """A picture of a frame, encoded when first asked for."""
        key = (lit.id, which)
        if key not in self._jpegs:
            image = lit.image if which == "image" else lit.other

            def encode() -> bytes:
                start = time.perf_counter()
                assert image is not None
                data = encode_jpeg(image)
                self._encode_ms = (time.perf_counter() - start) * 1e3
                return data

            self._jpegs[key] = self.backend.aside(encode, pool=self.backend.encoder)
        return await asyncio.shield(self._jpegs[key])

    async def _message(self, lit: Lit) -> bytes:
        pictures = [await self._jpeg(lit, "image")]
        if lit.other is not None:
            pictures.append(await self._jpeg(lit, "other"))
        camera, pose = lit.camera, lit.pose
        header = {
            "type": "frame",
            "id": lit.id,
            "taken": lit.taken * 1e3,
            "stamp": lit.stamp,
            "state": None if lit.state is None else lit.state.value,
            "pose": None if pose is None else [*pose.rotation.ravel().tolist(), *pose.translation.tolist()],
            "camera": [camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion],
            "stages": lit.stages,
            "light_ms": round(lit.light_ms, 3),
            "encode_ms": round(self._encode_ms, 3),
            "plan": lit.plan,
        }
        return protocol.pack(header, *pictures)

    async def _send(self, viewer: _Viewer) -> None:
        """Send a viewer what is new, as fast as it takes it."""
        while True:
            await viewer.wake.wait()
            viewer.wake.clear()
            while not viewer.queue.empty():
                message = viewer.queue.get_nowait()
                send = viewer.socket.send_str if isinstance(message, str) else viewer.socket.send_bytes
                await asyncio.wait_for(send(message), SEND_SECONDS)  # type: ignore[arg-type]
            lit = self._latest
            if lit is None or lit.id <= viewer.sent or len(viewer.unshown) >= IN_FLIGHT:
                continue
            viewer.sent = lit.id
            viewer.unshown.add(lit.id)
            data = await self._message(lit)
            await asyncio.wait_for(viewer.socket.send_bytes(data), SEND_SECONDS)
            # A newer one may have come meanwhile.
            viewer.wake.set()

    async def _send_safely(self, viewer: _Viewer) -> None:
        try:
            await self._send(viewer)
        except (TimeoutError, ConnectionError):
            await self._drop(viewer, WSCloseCode.POLICY_VIOLATION, "nothing was taken for too long")

    async def _tick(self) -> None:
        """Tell viewers what changes by itself."""
        shown: LightState | None = None
        while True:
            await asyncio.sleep(STATE_SECONDS)
            if not self._viewers:
                continue
            self._tell_all(json.dumps(self.backend.host.state_message()))
            light = self.backend.host.light_state
            if light is not shown:
                shown = light
                self._tell_all(await self._light_message(light))

    async def _light_message(self, light: LightState | None) -> bytes:
        """The environment as a picture, packed once for all who ask."""
        if light is None:
            return protocol.pack({"type": "light", "known": False}, b"")
        if self._packed_light is None or self._packed_light[0] is not light:
            packing = self.backend.aside(encode_light, light.radiance, pool=self.backend.encoder)
            self._packed_light = (light, packing)
        data = await asyncio.shield(self._packed_light[1])
        return protocol.pack({"type": "light", "known": True}, data)

    # --------------------------------------------------------------------------------------------------------- viewers

    async def _live(self, request: web.Request) -> web.StreamResponse:
        if len(self._viewers) >= MOST_VIEWERS:
            return web.Response(status=503, text=f"{MOST_VIEWERS} viewers are here already\n")
        if not await self.backend.may_come(request.remote or ""):
            return web.Response(status=429, text="too many connections\n")
        host = await self.backend.started()
        socket = web.WebSocketResponse(max_msg_size=LARGEST_MESSAGE, heartbeat=30.0, compress=False)
        await socket.prepare(request)
        self.gate.upgrade(request)
        viewer = _Viewer(socket)
        self._viewers.add(viewer)
        host.watch(1)
        sender = asyncio.create_task(self._send_safely(viewer))
        try:
            viewer.tell(json.dumps(self._hello()))
            # Not here: to tell how large a mesh is, its file is read.
            for message in await self.backend.aside(host.greetings):
                viewer.tell(json.dumps(message))
            viewer.tell(await self._light_message(host.light_state))
            early, viewer.early = viewer.early or [], None
            for told in early:
                viewer.tell(told)
            await self._receive(viewer)
        finally:
            self._viewers.discard(viewer)
            host.watch(-1)
            sender.cancel()
            if viewer.picture is not None:
                viewer.picture.cancel()
            try:
                with contextlib.suppress(asyncio.CancelledError):
                    await sender
            finally:
                if not self.backend.ending:  # else the host gives up its camera by itself
                    await self.backend.aside(host.leave_camera, viewer)
        return socket

    def _hello(self) -> dict[str, Any]:
        return {
            "type": "hello",
            "protocol": protocol.SCHEMA,
            "scenes": list(bundled_scenes()),
            "presets": list(PRESETS),
            "effects": list(protocol.EFFECTS),
            "largest_camera": list(protocol.LARGEST_CAMERA),
        }

    async def _receive(self, viewer: _Viewer) -> None:
        """Take a viewer's messages until it leaves or breaks a rule."""
        async for message in viewer.socket:
            now = time.monotonic()
            size = len(message.data) if message.type in (WSMsgType.TEXT, WSMsgType.BINARY) else 0
            if not viewer.messages.take(1.0, now) or not viewer.bytes.take(size, now):
                limit = f"{MESSAGES_PER_SECOND:g} messages or {BYTES_PER_SECOND / 1e6:g} MB a second"
                await self._drop(viewer, WSCloseCode.POLICY_VIOLATION, f"more than {limit}")
                return
            try:
                if message.type is WSMsgType.TEXT:
                    await self._command(viewer, protocol.parse_text(message.data))
                elif message.type is WSMsgType.BINARY:
                    self._camera_picture(viewer, message.data)
                else:  # aiohttp has closed it already, with the reason that the protocol has for it
                    return
            except protocol.ProtocolError as error:
                await self._drop(viewer, WSCloseCode.POLICY_VIOLATION, str(error))
                return

    async def _command(self, viewer: _Viewer, command: protocol.Command) -> None:
        if command.type == "ack":
            viewer.unshown = {id for id in viewer.unshown if id > command.fields["id"]}
            viewer.wake.set()
        elif command.type == "ping":
            viewer.tell(json.dumps({"type": "pong", **command.fields, "clock": time.monotonic() * 1e3}))
        else:
            try:
                await self.backend.aside(self.backend.host.edit, command, viewer)
            except Exception as error:
                viewer.tell(json.dumps(failure(error, "nothing was changed")))
                viewer.tell(json.dumps(self.backend.host.scene_message()))

    def _camera_picture(self, viewer: _Viewer, data: bytes) -> None:
        size = self.backend.host.camera_size(viewer)
        if size is None:
            # What was on the way when the camera was switched off.
            if len(data) > protocol.MAX_PICTURE:
                raise protocol.ProtocolError("picture too large")
            return
        picture = protocol.parse_picture(data, size)
        # The page waits for "taken"; whoever does not has pictures left out.
        if viewer.picture is None or viewer.picture.done():
            viewer.picture = asyncio.create_task(self._push(viewer, picture))

    async def _push(self, viewer: _Viewer, picture: protocol.Picture) -> None:
        try:
            await self.backend.aside(self.backend.host.push, picture, viewer)
        except protocol.ProtocolError as error:
            await self._drop(viewer, WSCloseCode.POLICY_VIOLATION, str(error))
        except Exception as error:
            viewer.tell(json.dumps(failure(error)))

    @staticmethod
    async def _drop(viewer: _Viewer, code: int, reason: str, seconds: float = 5.0) -> None:
        with contextlib.suppress(ConnectionError, TimeoutError):
            await asyncio.wait_for(viewer.socket.close(code=code, message=reason.encode()[:120]), seconds)

    # --------------------------------------------------------------------------------------------------------- running

    async def serve(self, ready: Callable[[Address], None] = lambda address: None, *, tries: int = 1) -> None:
        """Serve until the host ends or the task is cancelled.

        Args:
            ready: Called with the address once the page can be opened.
            tries: Ports to try from the address's on.

        Raises:
            UsageError: The address cannot be listened on.
        """
        self._loop = asyncio.get_running_loop()
        runner = web.AppRunner(self.app, access_log=None, handle_signals=False, shutdown_timeout=0.5)
        running: asyncio.Future[None] | None = None
        ticker: asyncio.Task[None] | None = None
        try:
            await runner.setup()
            assert runner.server is not None
            self.gate.start(runner.server, await self._listen(tries), self.address.tls)
            ready(self.address)
            # The page is there before kernels, and even their libraries, are loaded.
            make_host = functools.partial(self._make_host, publish=self._publish, notify=self._notify)
            host = await self.backend.start(make_host)
            ticker = asyncio.create_task(self._tick())
            running = self._run_frames(host)
            await asyncio.shield(running)
        finally:
            self.backend.stop()
            if ticker is not None:
                ticker.cancel()
            reason = "the program has ended"
            drops = [self._drop(viewer, WSCloseCode.GOING_AWAY, reason, 0.5) for viewer in tuple(self._viewers)]
            await asyncio.gather(*drops)
            await self.gate.close()
            await runner.cleanup()
            self.ended = await self.backend.end(running)
            self._loop = None

    def _run_frames(self, host: Host) -> asyncio.Future[None]:
        """Start the thread of the frames."""
        loop = asyncio.get_running_loop()
        done: asyncio.Future[None] = loop.create_future()

        def finish(error: BaseException | None) -> None:
            if not done.done():
                done.set_result(None) if error is None else done.set_exception(error)

        def run() -> None:
            error: BaseException | None = None
            try:
                host.run()
            except BaseException as raised:
                error = raised
            with contextlib.suppress(RuntimeError):  # the loop has closed: nobody waits for this any more
                loop.call_soon_threadsafe(finish, error)

        # A frame of many seconds must not keep the program: the thread is left behind if need be.
        threading.Thread(target=run, name="warp-ar-frames", daemon=True).start()
        return done

    async def _listen(self, tries: int) -> list[socket.socket]:
        first = self.address.port
        for port in range(first, first + max(tries, 1)):
            try:
                listeners = await listen(self.address.host, port)
            except OSError as error:
                if port + 1 < first + tries:
                    continue
                raise UsageError(
                    f"cannot serve at {self.address.host} port {port}: {error.strerror or error}; choose another --port"
                ) from error
            self.backend.address = dataclasses.replace(self.address, port=listeners[0].getsockname()[1])
            return listeners
        raise AssertionError("a port was tried at least")


def _same(given: str, expected: str) -> bool:
    return hmac.compare_digest(given.encode("utf-8", "surrogateescape"), expected.encode())
