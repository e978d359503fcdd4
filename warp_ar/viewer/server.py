"""Server of the page, over HTTP and one WebSocket per viewer.

At most two frames are under way to a viewer: the next is sent after the viewer has shown one, and always the newest.
Pictures are encoded once for all viewers, and only if a viewer is ready for one. Messages are not trusted: a viewer
that breaks the protocol is disconnected with a reason, without effect on others. Other programs can request the light:

    GET /light.json                 harmonics, key light, interval, exposure, pose
    GET /light.exr, /light.hdr      the environment: ``?axes=``, ``?layout=cube``, ``?size=``, ``?ball=``
    GET /light/px.hdr ... nz.hdr    one face of the cube
    WS  /light                      the same JSON, when it has changed; text, no answer expected

All take ``?axes=`` (z-up, blender, opengl, and the default, y-up) and the page's token. Each request counts as a viewer
for some seconds, so that frames are lit even if no page is open. ``light_record``, which makes the answers, is imported
late: it loads Warp, for which the page should not wait.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import functools
import hmac
import html
import importlib.resources
import io
import json
import secrets
import time
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, Final, TypeVar

import cv2
import numpy as np
import numpy.typing as npt
import segno
from aiohttp import WSCloseCode, WSMsgType, web

from warp_ar.errors import SinkError, UsageError, WarpArError
from warp_ar.light.latlong_axes import AXES
from warp_ar.output.environment_axes import FACES
from warp_ar.scene import bundled_scenes
from warp_ar.srgb import encode_srgb
from warp_ar.stages.quality import PRESETS
from warp_ar.viewer import protocol
from warp_ar.viewer.address import LOOPBACK, Address, listen
from warp_ar.viewer.gate import HEADER_SECONDS, Gate
from warp_ar.viewer.protocol import MOST_BYTES, failure

if TYPE_CHECKING:
    from warp_ar.scene import Pose
    from warp_ar.viewer.host import (
        Host,  # imported late elsewhere: it loads Warp, for which the page should not wait
        Lit,
    )
    from warp_ar.viewer.light_record import LightState

_T = TypeVar("_T")

JPEG_QUALITY: Final = 85
"""JPEG quality: a frame of ``desk`` at 640x480 takes 60 KB, at quality 95 twice as much."""
IN_FLIGHT: Final = 2
"""Frames sent to a viewer that it has not shown yet: one under way while another is decoded."""
SEND_SECONDS: Final = 20.0
"""Time after which a viewer that receives nothing is disconnected, seconds."""
STATE_SECONDS: Final = 0.5
STOP_SECONDS: Final = 0.7
"""Longest wait at the end for the present frame, and again for pipelines that are being built, seconds."""
MOST_VIEWERS: Final = 8
MESSAGES_PER_SECOND: Final = 240.0
BYTES_PER_SECOND: Final = 8e6
"""Data rate of a viewer, bytes / s: 30 pictures per second of a camera at 1920x1080."""

DROP_SECONDS: Final = 60.0
"""Longest time to receive a dropped file, seconds."""
DROPS: Final = 4
"""Files that may be received at once, so that a slow one does not delay the others."""
_TYPES: Final = {
    "html": "text/html; charset=utf-8",
    "css": "text/css; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "svg": "image/svg+xml",
    "jpg": "image/jpeg",
    "exr": "image/x-exr",
    "hdr": "image/vnd.radiance",
}


WATCH_SECONDS: Final = 5.0
"""Time for which a request for the light keeps frames going, seconds."""
PUSH_SECONDS: Final = 0.1
"""Time between two checks for changes of pose and light, seconds; the light changes at most four times a second."""
MOST_LISTENERS: Final = 8
LARGEST_FACE: Final = 1024

_POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' blob: data:; "
    "media-src 'self' blob:; connect-src 'self' ws: wss:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_RUN: Final = secrets.token_hex(4)
"""Identifier of this run. A page that reconnects to another run has lost its edits."""
HEADERS: Final = {
    "Content-Security-Policy": _POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",  # the address holds the token
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
"""Headers of every answer, refusals included."""


def encode_jpeg(image: npt.NDArray[np.uint8]) -> bytes:
    """Return the JPEG of an RGB picture."""
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    return bytes(cv2.imencode(".jpg", bgr, (cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY))[1])


@functools.lru_cache(maxsize=2)
def pack_light(light: LightState | None) -> bytes:
    """Return the message of an environment as a PNG of x / (1 + x), which shows clipped light too, in sRGB codes."""
    if light is None:
        return protocol.pack({"type": "light", "known": False}, b"")
    value = np.maximum(light.radiance, 0.0)
    codes = np.uint8(np.round(encode_srgb(value / (1.0 + value))[..., ::-1] * 255.0))
    return protocol.pack({"type": "light", "known": True}, bytes(cv2.imencode(".png", codes)[1]))


@functools.lru_cache(maxsize=4)
def pack_frame(lit: Lit) -> bytes:
    """Return the message of a frame, its pictures encoded once for all viewers."""
    start = time.perf_counter()
    pictures = [encode_jpeg(image) for image in (lit.image, lit.other) if image is not None]
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
        "encode_ms": round((time.perf_counter() - start) * 1e3, 3),
        "plan": lit.plan,
    }
    return protocol.pack(header, *pictures)


class _Viewer:
    """Connection to one viewer over a WebSocket, with the queue of its messages."""

    def __init__(self, socket: web.WebSocketResponse) -> None:
        self.socket = socket
        self.wake = asyncio.Event()
        self.queue: asyncio.Queue[str | bytes] = asyncio.Queue(64)
        self.sent = 0
        """Number of the newest frame sent."""
        self.unshown: set[int] = set()
        self.messages = protocol.Bucket(MESSAGES_PER_SECOND, 2 * MESSAGES_PER_SECOND)
        self.bytes = protocol.Bucket(BYTES_PER_SECOND, 2 * BYTES_PER_SECOND)
        self.picture: asyncio.Task[None] | None = None

    def tell(self, message: str | bytes | dict[str, Any]) -> None:
        """Queue a message; drop it if 64 messages wait already."""
        with contextlib.suppress(asyncio.QueueFull):
            self.queue.put_nowait(json.dumps(message) if isinstance(message, dict) else message)
        self.wake.set()

    async def send(self, message: str | bytes) -> None:
        """Send a message now.

        Raises:
            TimeoutError: The viewer receives nothing.
        """
        send = self.socket.send_str if isinstance(message, str) else self.socket.send_bytes
        await asyncio.wait_for(send(message), SEND_SECONDS)  # type: ignore[arg-type]

    async def drop(self, code: int, reason: str, seconds: float = 5.0) -> None:
        """Close the connection with a reason."""
        with contextlib.suppress(ConnectionError, TimeoutError):
            await asyncio.wait_for(self.socket.close(code=code, message=reason.encode()[:120]), seconds)


class Server:
    """Server of one host's page. The host is made in a thread, and other threads do the work of requests."""

    def __init__(
        self, make_host: Callable[..., Host], address: Address, *, header_seconds: float = HEADER_SECONDS
    ) -> None:
        """Build the application.

        Args:
            make_host: Function that returns the host, called with ``publish`` and ``notify`` once the page is served.
            address: Address to serve at.
            header_seconds: Longest time for a request's header, seconds.
        """
        self.address = address
        """Address of the page, with the actual port once it is served."""
        self._make_host = make_host
        self._host: Host | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._encoder = ThreadPoolExecutor(1, "warp-ar-encode")
        self._hands = ThreadPoolExecutor(2, "warp-ar-page")
        self._frames = ThreadPoolExecutor(1, "warp-ar-frames")
        self._ending = False
        self._viewers: set[_Viewer] = set()
        self._latest: Lit | None = None
        self.ended = True
        """False if ``serve`` returned while a thread of the frames was still running."""
        self.gate = Gate(HEADERS, header_seconds=header_seconds)
        self.app = web.Application(client_max_size=1024, middlewares=[self._guard])
        self.app.on_response_prepare.append(self._add_headers)
        # Read once, so that no request's path is ever used as a file path.
        folder = importlib.resources.files("warp_ar.viewer") / "static"
        self._static = {item.name: item.read_bytes() for item in folder.iterdir() if item.name.split(".")[-1] in _TYPES}
        self._coming = self._listeners = 0
        lights = [*(f"/light.{kind}" for kind in ("json", "exr", "hdr")), *(f"/light/{name}.hdr" for name in FACES)]
        self.app.add_routes(
            [
                web.get("/", self._page),
                web.get("/static/{name}", self._page),
                web.get("/address.svg", self._code),
                web.get("/download/{name}", self._download),
                web.post("/drop/{name}", self._drop),
                web.get("/live", self._live),
                web.get("/light", self._channel),
                *(web.get(path, self._light) for path in lights),
            ]
        )

    # ------------------------------------------------------------------------------------------------------- admission

    @web.middleware
    async def _guard(
        self, request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
    ) -> web.StreamResponse:
        """Refuse requests from other sites and, if a token is set, requests without the token."""
        name = (request.host if request.host.endswith("]") else request.host.rsplit(":", 1)[0]).strip("[]")
        token, public = self.address.token, request.path.startswith("/static/")
        # A site whose name resolves to this machine (DNS rebinding) would pass every other check.
        if self.address.loopback and token is None and name not in LOOPBACK:
            return self._refuse(request, f"this page is at {self.address.url}")
        origin = request.headers.get("Origin")
        if not self._is_welcome(request):
            foreign = origin is not None and origin != f"{request.scheme}://{request.host}"
            embedded = request.headers.get("Sec-Fetch-Site", "none") not in ("none", "same-origin")
            if foreign or (embedded and request.path != "/"):
                return self._refuse(request, "requests from other sites are refused")
        given = request.query.get("token", "").encode("utf-8", "surrogateescape")
        if token is not None and not public and not hmac.compare_digest(given, token.encode()):
            return self._refuse(request, "a token is needed: open the whole address that the program printed")
        with self.gate.answering(request, admitted=not public or token is None):
            return await handler(request)

    def _is_welcome(self, request: web.Request) -> bool:
        """Return True for a request for the light from an allowed origin."""
        return request.headers.get("Origin") in self.address.origins and request.path.startswith("/light")

    def _refuse(self, request: web.Request, reason: str) -> web.Response:
        """Return a refusal: a page if the request accepts HTML, else one line of text."""
        response = web.Response(status=403, text=f"warp_ar: {reason}\n")
        if "text/html" in request.headers.get("Accept", ""):
            page = self._static["refused.html"].decode()
            response = web.Response(
                status=403, text=page.replace("{reason}", html.escape(reason)), content_type="text/html"
            )
        response.force_close()
        return response

    async def _add_headers(self, request: web.Request, response: web.StreamResponse) -> None:
        response.headers.update(HEADERS)
        if self._is_welcome(request):
            allowed = {"Access-Control-Allow-Origin": request.headers["Origin"], "Vary": "Origin"}
            response.headers.update({**allowed, "Cross-Origin-Resource-Policy": "cross-origin"})

    # ------------------------------------------------------------------------------------------------ the host, threads

    async def started(self) -> Host:
        """Wait until the host is made, and return it."""
        while self._host is None:
            await asyncio.sleep(0.05)
        return self._host

    def aside(
        self, function: Callable[..., _T], *arguments: Any, pool: ThreadPoolExecutor | None = None
    ) -> asyncio.Future[_T]:
        """Run a function that may take long in a thread of ``pool``, by default of ``_hands``.

        Raises:
            asyncio.CancelledError: The server is ending.
        """
        if self._ending:
            raise asyncio.CancelledError
        loop = asyncio.get_running_loop()
        return loop.run_in_executor(pool or self._hands, functools.partial(function, *arguments))

    async def websocket(self, request: web.Request, largest: int) -> web.WebSocketResponse:
        """Upgrade a request to a WebSocket whose incoming messages have at most ``largest`` bytes."""
        socket = web.WebSocketResponse(max_msg_size=largest, heartbeat=30.0, compress=False)
        await socket.prepare(request)
        self.gate.connection_of(request).deadline = float("inf")  # dead WebSockets are found by their heartbeat
        return socket

    # ---------------------------------------------------------------------------------------------------------- frames

    def _publish(self, lit: Lit) -> None:
        """Pass a new frame to the event loop; called on the host's thread."""
        if self._loop is not None:
            self._loop.call_soon_threadsafe(self._arrived, lit)

    def _arrived(self, lit: Lit) -> None:
        self._latest = lit
        for viewer in self._viewers:
            viewer.wake.set()

    def _notify(self, message: dict[str, Any]) -> None:
        """Pass a message for all viewers to the event loop; called on any thread."""
        if self._loop is not None:
            self._loop.call_soon_threadsafe(self._tell_all, json.dumps(message))

    def _tell_all(self, message: str | bytes) -> None:
        for viewer in self._viewers:
            viewer.tell(message)

    async def _send(self, viewer: _Viewer) -> None:
        """Send a viewer its queued messages and the newest frame, as fast as it receives them."""
        try:
            while True:
                await viewer.wake.wait()
                viewer.wake.clear()
                while not viewer.queue.empty():
                    await viewer.send(viewer.queue.get_nowait())
                lit = self._latest
                if lit is None or lit.id <= viewer.sent or len(viewer.unshown) >= IN_FLIGHT:
                    continue
                viewer.sent = lit.id
                viewer.unshown.add(lit.id)
                await viewer.send(await self.aside(pack_frame, lit, pool=self._encoder))
                # A newer frame may have arrived meanwhile.
                viewer.wake.set()
        except (TimeoutError, ConnectionError):
            await viewer.drop(WSCloseCode.POLICY_VIOLATION, "nothing was taken for too long")

    async def _tick(self, host: Host) -> None:
        """Send viewers the state message twice a second, and the environment when it has changed."""
        shown: LightState | None = None
        while True:
            await asyncio.sleep(STATE_SECONDS)
            if not self._viewers:
                continue
            self._tell_all(json.dumps(host.state_message()))
            if (light := host.light_state) is not shown:
                shown = light
                self._tell_all(await self.aside(pack_light, light, pool=self._encoder))

    # --------------------------------------------------------------------------------------------------------- viewers

    async def _live(self, request: web.Request) -> web.StreamResponse:
        if len(self._viewers) >= MOST_VIEWERS:
            return web.Response(status=503, text=f"{MOST_VIEWERS} viewers are here already\n")
        host = await self.started()
        viewer = _Viewer(await self.websocket(request, protocol.MAX_MESSAGE))
        self._viewers.add(viewer)  # from here on messages wait in its queue, to be sent after the greetings
        host.watch(1)
        sender: asyncio.Task[None] | None = None
        try:
            # In a thread: the greetings contain the sizes of meshes, whose files must be read.
            for message in (self._hello(), *await self.aside(host.greetings)):
                await viewer.send(json.dumps(message))
            await viewer.send(await self.aside(pack_light, host.light_state, pool=self._encoder))
            sender = asyncio.create_task(self._send(viewer))
            await self._receive(host, viewer)
        except (TimeoutError, ConnectionError):
            await viewer.drop(WSCloseCode.POLICY_VIOLATION, "nothing was taken for too long")
        finally:
            self._viewers.discard(viewer)
            host.watch(-1)
            for task in (sender, viewer.picture):
                if task is not None:
                    task.cancel()
            if not self._ending:  # at the end the host closes all cameras itself
                await self.aside(host.leave_camera, viewer)
        return viewer.socket

    def _hello(self) -> dict[str, Any]:
        return {
            "type": "hello",
            "run": _RUN,
            "scenes": list(bundled_scenes()),
            "presets": list(PRESETS),
            "outside": self.address.outside_url,
        }

    async def _receive(self, host: Host, viewer: _Viewer) -> None:
        """Handle a viewer's messages until it leaves or breaks the protocol."""
        async for message in viewer.socket:
            now = time.monotonic()
            size = len(message.data) if message.type in (WSMsgType.TEXT, WSMsgType.BINARY) else 0
            try:
                if not viewer.messages.take(1.0, now) or not viewer.bytes.take(size, now):
                    limit = f"{MESSAGES_PER_SECOND:g} messages or {BYTES_PER_SECOND / 1e6:g} MB a second"
                    raise protocol.ProtocolError(f"more than {limit}")
                if message.type is WSMsgType.TEXT:
                    await self._command(host, viewer, protocol.parse_text(message.data))
                elif message.type is WSMsgType.BINARY:
                    self._camera_picture(host, viewer, message.data)
                else:  # aiohttp has already closed the connection, with the standard's reason
                    return
            except protocol.ProtocolError as error:
                await viewer.drop(WSCloseCode.POLICY_VIOLATION, str(error))
                return

    async def _command(self, host: Host, viewer: _Viewer, command: protocol.Command) -> None:
        if command.type == "ack":
            viewer.unshown = {id for id in viewer.unshown if id > command.fields["id"]}
            viewer.wake.set()
        elif command.type == "ping":
            viewer.tell({"type": "pong", **command.fields, "clock": time.monotonic() * 1e3})
        elif command.type == "pick":
            object_seen = await self.aside(functools.partial(host.pick, **command.fields))
            viewer.tell({"type": "picked", **command.fields, "object": object_seen})
        else:
            try:
                await self.aside(host.edit, command, viewer)
            except Exception as error:
                viewer.tell(failure(error, "nothing was changed"))
                viewer.tell(host.scene_message())

    def _camera_picture(self, host: Host, viewer: _Viewer, data: bytes) -> None:
        size = host.camera_size(viewer)
        if size is None:
            return  # the picture was under way when the camera was switched off
        picture = protocol.parse_picture(data, size)
        # The page waits for "taken" before its next picture. Pictures of a viewer that does not wait are skipped.
        if viewer.picture is None or viewer.picture.done():
            viewer.picture = asyncio.create_task(self._push(host, picture, viewer))

    async def _push(self, host: Host, picture: protocol.Picture, viewer: _Viewer) -> None:
        try:
            await self.aside(host.push, picture, viewer)
        except protocol.ProtocolError as error:
            await viewer.drop(WSCloseCode.POLICY_VIOLATION, str(error))
        except Exception as error:
            viewer.tell(failure(error))

    # -------------------------------------------------------------------------------------- files, downloads, the light

    async def _page(self, request: web.Request) -> web.Response:
        name = request.match_info.get("name", "index.html")
        if name not in self._static:
            raise web.HTTPNotFound(text="no such file\n")
        return _answer(self._static[name], name)

    async def _code(self, request: web.Request) -> web.Response:
        """Return the page's address for other machines as a QR code."""
        buffer = io.BytesIO()
        segno.make_qr(self.address.outside_url or self.address.url).save(buffer, "svg", scale=5, border=3, light="#fff")
        return _answer(buffer.getvalue(), "code.svg")

    async def _download(self, request: web.Request) -> web.Response:
        host = await self.started()
        name = request.match_info["name"]
        if (found := host.downloads(full_paths=self.address.loopback).get(name)) is None:
            raise web.HTTPNotFound(text="no such download\n")
        kind, make = found
        try:
            body = await self.aside(make)
        except WarpArError as error:
            raise web.HTTPConflict(text=f"{error}\n") from error
        headers = {"Content-Type": kind, "Content-Disposition": f'attachment; filename="{name}"'}
        return web.Response(body=body, headers=headers)

    async def _drop(self, request: web.Request) -> web.Response:
        """Receive a file that was dropped onto the picture; answer with a description of the change."""
        host, name = await self.started(), request.match_info["name"]
        if self._coming >= DROPS:
            return web.Response(status=429, text=f"{DROPS} files are on their way already: wait until one is there\n")
        self._coming += 1
        try:
            # Limits of its own in size and time: other requests have no body of this size.
            async with asyncio.timeout(DROP_SECONDS):
                data = await request.clone(client_max_size=MOST_BYTES).read()
            words = await self.aside(host.drop, name, data)
        except web.HTTPRequestEntityTooLarge:
            refused = web.Response(status=413, text=f"{name}: more than {MOST_BYTES >> 20} MB, the most of one file\n")
            refused.force_close()
            return refused
        except TimeoutError:
            return web.Response(status=408, text=f"{name} took too long\n")
        except ConnectionError:  # the sender has gone; the answer only ends the request
            return web.Response(status=400, text=f"{name} did not come whole\n")
        except SinkError as error:
            return web.Response(status=507, text=f"{error}\n")
        except Exception as error:
            return web.Response(status=422, text=failure(error, "nothing was changed")["text"] + "\n")
        finally:
            self._coming -= 1
        return web.Response(text=f"{words}\n")

    async def _light(self, request: web.Request) -> web.Response:
        """Answer a request for the light: its record, its picture, or one face of its cube map."""
        stem, _, kind = request.path.rpartition("/")[2].partition(".")
        layout, options = request.query.get("layout", "latlong"), {"axes": _axes(request)}
        if kind != "json":
            options |= _numbers(request)
        host = await self.started()
        host.watch(1)
        asyncio.get_running_loop().call_later(WATCH_SECONDS, host.watch, -1)
        if host.light_state is None:
            words = "the environment is not captured: no stage of this scene reads it, or the marker was not seen\n"
            raise web.HTTPConflict(text=words)
        from warp_ar.viewer.light_record import describe, encode_face, encode_picture

        make: Any = functools.partial(encode_picture, kind=kind, layout=layout)
        if stem in FACES:
            make = functools.partial(encode_face, face=stem)
        elif kind == "json":
            make = functools.partial(describe, pose=_pose(host))
        try:
            made = await self.aside(functools.partial(make, host.light_state, **options))
        except WarpArError as error:
            raise web.HTTPBadRequest(text=f"{error}\n") from error
        return web.json_response(made) if kind == "json" else _answer(made, f"{stem}.{kind}")

    async def _channel(self, request: web.Request) -> web.StreamResponse:
        axes = _axes(request)
        if self._listeners >= MOST_LISTENERS:
            return web.Response(status=503, text=f"{MOST_LISTENERS} programs listen already\n")
        host = await self.started()
        socket = await self.websocket(request, 1024)
        self._listeners += 1
        host.watch(1)
        pusher = asyncio.create_task(self._push_light(host, socket, axes))
        try:
            async for message in socket:
                if message.type in (WSMsgType.TEXT, WSMsgType.BINARY):
                    await socket.close(code=1008, message=b"this channel takes no messages")
        finally:
            self._listeners -= 1
            host.watch(-1)
            pusher.cancel()
            with contextlib.suppress(asyncio.CancelledError, ConnectionError):
                await pusher
        return socket

    async def _push_light(self, host: Host, socket: web.WebSocketResponse, axes: str) -> None:
        """Send the light's record whenever light or pose have changed; the heartbeat closes a dead listener."""
        from warp_ar.viewer.light_record import describe

        sent: tuple[LightState | None, Any] = (None, None)
        while not socket.closed:
            state, pose = host.light_state, _pose(host)
            now = (state, None if pose is None else (*pose.rotation.ravel(), *pose.translation))
            if state is not None and (now[0] is not sent[0] or now[1] != sent[1]):
                sent = now
                await socket.send_str(json.dumps(await self.aside(describe, state, pose, axes)))
            await asyncio.sleep(PUSH_SECONDS)

    # --------------------------------------------------------------------------------------------------------- running

    async def serve(self, ready: Callable[[Address], None] = lambda address: None, *, tries: int = 1) -> None:
        """Serve until the host ends or the task is cancelled.

        Args:
            ready: Function called with the address once the page can be opened.
            tries: Number of ports to try, beginning with the address's port.

        Raises:
            UsageError: No tried port of the address is available.
        """
        self._loop = asyncio.get_running_loop()
        runner = web.AppRunner(self.app, access_log=None, handle_signals=False, shutdown_timeout=0.5)
        starting: asyncio.Future[Host] | None = None
        running: asyncio.Future[None] | None = None
        ticker: asyncio.Task[None] | None = None
        try:
            await runner.setup()
            assert runner.server is not None
            listener = await self.aside(listen, self.address.host, self.address.port, tries)
            self.address = dataclasses.replace(self.address, port=listener.getsockname()[1])
            self.gate.start(runner.server, listener, self.address.tls)
            ready(self.address)
            # The page is served before Warp and the kernels are loaded.
            starting = self.aside(functools.partial(self._make_host, publish=self._publish, notify=self._notify))
            self._host = host = await asyncio.shield(starting)
            ticker = asyncio.create_task(self._tick(host))
            running = self.aside(host.run, pool=self._frames)
            await asyncio.shield(running)
        finally:
            self._ending = True
            if self._host is not None:
                self._host.stop()
            if ticker is not None:
                ticker.cancel()
            reason = "the program has ended"
            drops = [viewer.drop(WSCloseCode.GOING_AWAY, reason, 0.5) for viewer in tuple(self._viewers)]
            await asyncio.gather(*drops)
            await self.gate.close()
            await runner.cleanup()
            self.ended = await self._end(starting, running)
            self._loop = None

    async def _end(self, starting: asyncio.Future[Host] | None, running: asyncio.Future[None] | None) -> bool:
        """End the host and all threads; return False if a thread still runs after ``STOP_SECONDS``."""
        ended, waited = True, running or starting
        if waited is not None:
            done, _ = await asyncio.wait({waited}, timeout=STOP_SECONDS)
            ended = bool(done)
        host = self._host
        if host is None and starting is not None and starting.done() and starting.exception() is None:
            host = starting.result()
        for pool in (self._encoder, self._hands, self._frames):
            pool.shutdown(wait=ended, cancel_futures=True)
        if host is not None:
            ended = host.close(wait_seconds=STOP_SECONDS, frames_ended=ended)
        return ended


def _answer(body: bytes, name: str) -> web.Response:
    return web.Response(body=body, headers={"Content-Type": _TYPES[name.split(".")[-1]]})


def _pose(host: Host) -> Pose | None:
    return None if host.latest is None else host.latest.pose


def _axes(request: web.Request) -> str:
    axes = request.query.get("axes", "y-up")
    if axes not in AXES:
        raise web.HTTPBadRequest(text=f"axes = {axes[:40]!r}: expected {', '.join(AXES)}\n")
    return axes


def _numbers(request: web.Request) -> dict[str, Any]:
    """Return the keys ``size`` (texels; None if not given) and ``ball`` (index of a mirror ball) of a request."""
    numbers: dict[str, Any] = {"size": None, "ball": 0}
    for name, least, most in (("size", 1, LARGEST_FACE), ("ball", 0, 999)):
        if (text := request.query.get(name)) is not None:
            if not (text.isascii() and text.isdigit() and len(text) < 6 and least <= int(text) <= most):
                raise web.HTTPBadRequest(text=f"{name} = {text[:40]!r}: expected {least} to {most}\n")
            numbers[name] = int(text)
    return numbers


def check_origin(origin: str) -> str:
    """Return the origin if it is valid: a scheme and a host without a path.

    Raises:
        UsageError: The origin is not valid.
    """
    scheme, _, rest = origin.partition("://")
    if scheme not in ("http", "https") or not rest or any(c in rest for c in "/?#*@ "):
        raise UsageError(f"--allow-origin {origin}: expected an origin such as http://localhost:5173, without a path")
    return origin
