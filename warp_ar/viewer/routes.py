"""Routes of the page's server: the page's files, downloads, uploads, and the light for other programs.

    GET /light.json                 harmonics, key light, interval, exposure, pose
    GET /light.exr, /light.hdr      the environment: ``?axes=``, ``?layout=cube``, ``?size=``, ``?ball=``
    GET /light/px.hdr ... nz.hdr    one face of the cube
    WS  /light                      the same JSON, when it has changed; text, no answer expected

All take ``?axes=`` (z-up, blender, opengl, and the default, y-up) and the token as the page does. Who asks counts as a
viewer for some seconds, so that frames are lit though nobody looks at the page. What makes the answers loads Warp, for
which the page does not wait: it is in ``light_record``.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib.resources
import json
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

from aiohttp import WSMsgType, web

from warp_ar.errors import SinkError, UsageError, WarpArError
from warp_ar.output.environment_axes import AXES, FACES, LAYOUTS
from warp_ar.viewer.backend import Backend
from warp_ar.viewer.messages import failure
from warp_ar.viewer.uploads import MOST_BYTES

if TYPE_CHECKING:
    from warp_ar.viewer.light_record import LightState


DROP_SECONDS: Final = 60.0
"""How long a dropped file may be on its way."""
DROPS: Final = 4
"""Files that may be on their way at once: a slow one does not hold up the others."""
_TYPES: Final = {
    "html": "text/html; charset=utf-8",
    "css": "text/css; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "svg": "image/svg+xml",
}


class PageFiles:
    """The routes of one server."""

    def __init__(self, app: web.Application, backend: Backend) -> None:
        """Add them to the server's application."""
        self._backend = backend
        self._coming = 0
        # Read once: no request's path ever becomes a file's.
        folder = importlib.resources.files("warp_ar.viewer") / "static"
        self._static = {item.name: item.read_bytes() for item in folder.iterdir() if item.name.split(".")[-1] in _TYPES}
        app.add_routes(
            [
                web.get("/", self._page),
                web.get("/static/{name}", self._file),
                web.get("/download/{name}", self._download),
                web.post("/drop/{name}", self._drop_file),
            ]
        )

    async def _page(self, request: web.Request) -> web.Response:
        return web.Response(body=self._static["index.html"], headers={"Content-Type": _TYPES["html"]})

    async def _file(self, request: web.Request) -> web.Response:
        name = request.match_info["name"]
        if name not in self._static:
            raise web.HTTPNotFound(text="no such file\n")
        return web.Response(body=self._static[name], headers={"Content-Type": _TYPES[name.split(".")[-1]]})

    async def _download(self, request: web.Request) -> web.Response:
        host = await self._backend.started()
        makers = host.downloads(full_paths=self._backend.address.loopback)
        name = request.match_info["name"]
        if name not in makers:
            raise web.HTTPNotFound(text="no such download\n")
        kind, make = makers[name]
        try:
            body = await self._backend.aside(make)
        except WarpArError as error:
            raise web.HTTPConflict(text=f"{error}\n") from error
        headers = {"Content-Type": kind, "Content-Disposition": f'attachment; filename="{name}"'}
        return web.Response(body=body, headers=headers)

    async def _drop_file(self, request: web.Request) -> web.Response:
        """Take a file that was dropped onto the picture; its answer says in words what became of it."""
        host = await self._backend.started()
        name = request.match_info["name"]
        if self._coming >= DROPS:
            return web.Response(status=429, text=f"{DROPS} files are on their way already: wait until one is there\n")
        self._coming += 1
        try:
            # Its own bound, for all other requests have none worth the name; and not for ever.
            async with asyncio.timeout(DROP_SECONDS):
                parts, size = [], 0
                async for part in request.content.iter_chunked(1 << 16):
                    size += len(part)
                    if size > MOST_BYTES:
                        refused = web.Response(status=413, text=f"{size:,} bytes and more; {MOST_BYTES:,} are taken\n")
                        refused.force_close()
                        return refused
                    parts.append(part)
            words = await self._backend.aside(host.drop, name, b"".join(parts))
        except TimeoutError:
            return web.Response(status=408, text="the file took too long\n")
        except ConnectionError:
            return web.Response(
                status=400, text="the file did not come whole\n"
            )  # nobody hears it: the sender has gone
        except SinkError as error:
            return web.Response(status=507, text=f"{error}\n")
        except Exception as error:
            return web.Response(status=422, text=failure(error, "nothing was changed")["text"] + "\n")
        finally:
            self._coming -= 1
        return web.Response(text=f"{words}\n")


WATCH_SECONDS: Final = 5.0
"""How long a request keeps frames going."""
PUSH_SECONDS: Final = 0.1
"""How often the channel looks for changes; the light itself is looked at four times a second."""
MOST_LISTENERS: Final = 8
LARGEST_FACE: Final = 1024


class SharedLight:
    """The routes of one server."""

    def __init__(self, app: web.Application, backend: Backend) -> None:
        """Add them to the server's application."""
        self._backend = backend
        self._watching: asyncio.TimerHandle | None = None
        self._listeners = 0
        app.add_routes(
            [
                web.get("/light.json", self._json),
                web.get("/light.exr", self._picture),
                web.get("/light.hdr", self._picture),
                *(web.get(f"/light/{face}.hdr", self._face) for face in FACES),
                web.get("/light", self._channel),
            ]
        )

    # ------------------------------------------------------------------------------------------------------- requests

    async def _state(self) -> LightState:
        host = await self._backend.started()
        self._keep_watching()
        state = host.light_state
        if state is None:
            raise web.HTTPConflict(
                text="the environment is not captured: no stage of this scene reads it, or the marker was not seen\n"
            )
        return state

    def _keep_watching(self) -> None:
        """Count as a viewer from now on for some seconds."""
        if self._watching is None:
            self._backend.host.watch(1)
        else:
            self._watching.cancel()
        self._watching = asyncio.get_running_loop().call_later(WATCH_SECONDS, self._rest)

    def _rest(self) -> None:
        self._watching = None
        self._backend.host.watch(-1)

    async def _json(self, request: web.Request) -> web.Response:
        axes = _axes(request)
        state = await self._state()
        latest = self._backend.host.latest
        pose = None if latest is None else latest.pose
        from warp_ar.viewer.light_record import describe

        return web.json_response(await self._made(describe, state, pose, axes))

    async def _picture(self, request: web.Request) -> web.Response:
        layout, size, ball = request.query.get("layout", "latlong"), _size(request), _ball(request)
        axes, kind = _axes(request), request.path.rpartition(".")[2]
        if layout not in LAYOUTS:
            raise web.HTTPBadRequest(text=f"layout = {layout!r}: expected {' or '.join(LAYOUTS)}\n")
        state = await self._state()

        from warp_ar.viewer.light_record import encode_picture

        return self._answer(await self._made(encode_picture, state, kind, axes, layout, size, ball), kind)

    async def _face(self, request: web.Request) -> web.Response:
        axes, size, ball = _axes(request), _size(request), _ball(request)
        state = await self._state()
        from warp_ar.viewer.light_record import encode_face

        face = request.path.rpartition("/")[2].removesuffix(".hdr")
        return self._answer(await self._made(encode_face, state, axes, size, face, ball), "hdr")

    async def _made(self, make: Callable[..., Any], *arguments: Any) -> Any:
        """What a function makes beside the loop; what it refuses is the request's fault."""
        try:
            return await self._backend.aside(make, *arguments)
        except WarpArError as error:
            raise web.HTTPBadRequest(text=f"{error}\n") from error

    @staticmethod
    def _answer(body: bytes, kind: str) -> web.Response:
        types = {"exr": "image/x-exr", "hdr": "image/vnd.radiance"}
        return web.Response(body=body, headers={"Content-Type": types[kind]})

    # -------------------------------------------------------------------------------------------------------- channel

    async def _channel(self, request: web.Request) -> web.StreamResponse:
        axes = _axes(request)
        if self._listeners >= MOST_LISTENERS:
            return web.Response(status=503, text=f"{MOST_LISTENERS} programs listen already\n")
        if not await self._backend.may_come(request.remote or ""):
            return web.Response(status=429, text="too many connections\n")
        await self._backend.started()
        socket = web.WebSocketResponse(max_msg_size=1024, heartbeat=30.0, compress=False)
        await socket.prepare(request)
        self._backend.gate.upgrade(request)
        self._listeners += 1
        self._backend.host.watch(1)
        pusher = asyncio.create_task(self._push(socket, axes))
        try:
            async for message in socket:
                if message.type in (WSMsgType.TEXT, WSMsgType.BINARY):
                    await socket.close(code=1008, message=b"this channel takes no messages")
        finally:
            self._listeners -= 1
            self._backend.host.watch(-1)
            pusher.cancel()
            with contextlib.suppress(asyncio.CancelledError, ConnectionError):
                await pusher
        return socket

    async def _push(self, socket: web.WebSocketResponse, axes: str) -> None:
        """Send what has changed; a listener that takes nothing is closed by the heartbeat."""
        from warp_ar.viewer.light_record import describe

        sent: tuple[Any, ...] = ()
        while not socket.closed:
            host = self._backend.host
            state, latest = host.light_state, host.latest
            pose = None if latest is None else latest.pose
            now = (state, None if pose is None else (*pose.rotation.ravel(), *pose.translation))
            if state is not None and (not sent or now[0] is not sent[0] or now[1] != sent[1]):
                sent = now
                content = await self._backend.aside(describe, state, pose, axes)
                await socket.send_str(json.dumps(content))
            await asyncio.sleep(PUSH_SECONDS)


def _axes(request: web.Request) -> str:
    axes = request.query.get("axes", "y-up")
    if axes not in AXES:
        raise web.HTTPBadRequest(text=f"axes = {axes[:40]!r}: expected {', '.join(AXES)}\n")
    return axes


def _size(request: web.Request) -> int | None:
    text = request.query.get("size")
    if text is None:
        return None
    if not (text.isascii() and text.isdigit() and len(text) < 6 and 1 <= int(text) <= LARGEST_FACE):
        raise web.HTTPBadRequest(text=f"size = {text[:40]!r}: expected 1 to {LARGEST_FACE} texels\n")
    return int(text)


def _ball(request: web.Request) -> int:
    text = request.query.get("ball", "0")
    if not (text.isascii() and text.isdigit() and len(text) < 4):
        raise web.HTTPBadRequest(text=f"ball = {text[:40]!r}: expected the number of a mirror ball, counted from 0\n")
    return int(text)


def check_origin(origin: str) -> str:
    """An origin that may ask for the light, as browsers name it.

    Raises:
        UsageError: It is none.
    """
    scheme, _, rest = origin.partition("://")
    if scheme not in ("http", "https") or not rest or any(c in rest for c in "/?#*@ "):
        raise UsageError(f"--allow-origin {origin}: expected an origin such as http://localhost:5173, without a path")
    return origin
