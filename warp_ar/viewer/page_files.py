"""Files of the page's server: the page itself, what can be downloaded from it, and what is dropped onto it."""

from __future__ import annotations

import asyncio
import importlib.resources
from collections.abc import Callable
from typing import Final

from aiohttp import web

from warp_ar.errors import SinkError, WarpArError
from warp_ar.viewer.backend import Backend
from warp_ar.viewer.messages import failure
from warp_ar.viewer.uploads import MOST_BYTES

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
        makers: dict[str, tuple[str, Callable[[], bytes]]] = {
            "frame.png": ("image/png", host.snapshot),
            "environment.exr": ("image/x-exr", host.environment_exr),
            "scene.toml": (
                "application/toml",
                lambda: host.scene_toml(full_paths=self._backend.address.loopback).encode(),
            ),
            "scene.zip": ("application/zip", host.scene_bundle),
            "recording.mp4": ("video/mp4", host.recording),
            "camera.yml": ("application/yaml", host.camera_file),
            "response.txt": ("text/plain", host.response_file),
            "card-a4.pdf": ("application/pdf", lambda: host.card("a4")),
            "card-letter.pdf": ("application/pdf", lambda: host.card("letter")),
        }
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
