"""What several tests of the page need: messages, a printed card in view, a host that runs, a server and its clients."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import functools
import json
import math
import random
import struct
import threading
import time
from collections.abc import AsyncIterator, Iterator
from typing import Any
from unittest import mock

import aiohttp
import cv2
import numpy as np

from tests.test_pipeline import make_scene
from warp_ar.calibration.card import card_size, draw_card
from warp_ar.scene import Camera, Marker, Scene, SourceSpec
from warp_ar.scene.pixel_rays import pixel_rays
from warp_ar.sources import sources
from warp_ar.viewer.address import Address
from warp_ar.viewer.gate import HEADER_SECONDS
from warp_ar.viewer.host import Host, Lit
from warp_ar.viewer.protocol import parse_text
from warp_ar.viewer.server import Server, encode_jpeg

SIZE = (320, 240)
PATIENCE = 180.0  # seconds that anything may take on a busy machine


def small_frames() -> contextlib.AbstractContextManager[Any]:
    """Let generated clips have ``SIZE``, a quarter of their usual pixels, all of which are lit while a test waits."""
    return mock.patch.object(sources, "Synthetic", functools.partial(sources.Synthetic, size=SIZE))


def page_scene(**changes: Any) -> Scene:
    return make_scene(source=SourceSpec(synthetic="card"), **changes)


GOOD = [
    {"type": "ack", "id": 3},
    {"type": "ping", "sent": 12.5},
    {"type": "pick", "x": 12.5, "y": -3, "reach": 8},
    {"type": "set", "part": "light", "index": 0, "key": "at", "value": [0.1, 0.2, 0.3]},
    {"type": "set", "part": "exposure", "index": 0, "key": "scale", "value": "auto"},
    {"type": "add", "part": "object", "kind": "sphere"},
    {"type": "remove", "part": "light", "index": 0},
    {"type": "show", "part": "object", "index": 1, "on": False},
    {"type": "effect", "name": "relief", "on": False},
    {"type": "quality", "name": "low"},
    {"type": "method", "stage": "prefilter", "method": "fis128"},
    {"type": "budget", "ms": 20.0},
    {"type": "budget", "ms": None},
    {"type": "compare", "other": "camera"},
    {"type": "play", "on": True},
    {"type": "animate", "index": 0, "key": "speed", "value": 2.0},
    {"type": "scene", "name": "torus"},
    {"type": "reset"},
    {"type": "duplicate", "part": "light", "index": 0},
    {"type": "snap", "index": 0},
    {"type": "undo"},
    {"type": "redo"},
    {"type": "outline", "kind": "wall", "points": [[1, 2], [3, 4], [5, 6.5], [7, 8]]},
    {"type": "card", "radius": 0.03, "ruler": 0.097},
    {"type": "setup", "step": "check"},
    {"type": "setup", "step": "light"},
    {"type": "camera", "width": 640, "height": 480},
    {"type": "no_camera"},
    {"type": "calibrate", "step": "start"},
]


def jpeg(width: int = 64, height: int = 48) -> bytes:
    return encode_jpeg(np.full((height, width, 3), 128, np.uint8))


def picture_message(data: bytes, stamp: float = 1.0, number: int = 1) -> bytes:
    return struct.pack("<dI", stamp, number) + data


def mutated(rng: random.Random) -> str | bytes:
    """A message as a broken or hostile page might send it."""
    if rng.random() < 0.2:
        return rng.randbytes(rng.randrange(200))
    message = dict(rng.choice(GOOD))
    junk = [None, True, -1, 1e308, "", "../../etc/passwd", "x" * 70, [], [1] * 50, {}, {"a": {"b": 1}}, 2**70]
    for _ in range(rng.randrange(3)):
        message[rng.choice([*message, "extra"])] = rng.choice(junk)
    text = json.dumps(message)
    if rng.random() < 0.3:
        place = rng.randrange(len(text))
        text = text[:place] + chr(rng.randrange(0x20, 0x2FF)) + text[place + rng.randrange(3) :]
    return text


def rendered_cards(camera: Camera, count: int, seed: int, marker: Marker = Marker(size=0.08)) -> Iterator[np.ndarray]:  # noqa: B008
    """A printed card as ``camera`` sees it from around, hand-held, with noise and packed as the page packs it."""
    rng = np.random.default_rng(seed)
    pixels_per_metre = 5000.0
    card = cv2.GaussianBlur(draw_card(marker, pixels_per_metre), (0, 0), 2.0)
    # Two by two samples a pixel, whose centres lie at half-integers of the finer grid.
    double = Camera(
        *(2 * camera.width, 2 * camera.height, 2 * camera.fx, 2 * camera.fy),
        *(2 * camera.cx + 0.5, 2 * camera.cy + 0.5),
        camera.distortion,
    )
    rays = pixel_rays(double)
    rays = np.concatenate([rays, np.ones_like(rays[..., :1])], -1)
    # A marker is a fifth of the picture's width, a board more than half.
    distance = card_size(marker)[0] * camera.fx / ((0.22 if marker.board is None else 0.6) * camera.width)
    for index in range(count):
        slant, around = math.radians(rng.uniform(20, 55)), 2 * math.pi * index / count
        eye = np.array([math.sin(slant) * math.cos(around), math.sin(slant) * math.sin(around), math.cos(slant)])
        eye *= distance * rng.uniform(0.8, 1.25)
        forward = np.array([*rng.uniform(-0.04, 0.04, 2), 0.0]) - eye
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        ways = rays @ np.stack([right, np.cross(forward, right), forward]).astype(np.float32)
        desk = eye[:2] - eye[2] / ways[..., 2:] * ways[..., :2]
        at = ((desk * [1, -1] * pixels_per_metre) + 0.5 * np.array(card.shape[::-1]) - 0.5).astype(np.float32)
        fine = cv2.remap(card, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=90)
        image = cv2.resize(fine, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        image = np.clip(0.7 * image + 20.0 + rng.normal(0, 3, image.shape), 0, 255).astype(np.uint8)
        packed = encode_jpeg(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB))
        yield cv2.imdecode(np.frombuffer(packed, np.uint8), cv2.IMREAD_COLOR_RGB)


class Running:
    """A host that runs on a thread, and what it has published."""

    def __init__(self, scene: Scene, **options: Any) -> None:
        self.frames: list[Lit] = []
        self.messages: list[dict[str, Any]] = []
        options = {"quality": "low", "device": "cpu", **options}
        with contextlib.ExitStack() as stack:
            stack.enter_context(small_frames())
            self.host = Host(scene, publish=self.frames.append, notify=self.messages.append, **options)
            self._sources = stack.pop_all()
        self.thread = threading.Thread(target=self.host.run)

    def __enter__(self) -> Running:
        self.host.watch(1)
        self.thread.start()
        self.until(lambda: self.settled)
        return self

    @property
    def settled(self) -> bool:
        """Whether frames are lit by what was asked for last."""
        return bool(self.frames) and self.frames[-1].plan > 0 and not self.host.state_message()["building"]

    def __exit__(self, *_: object) -> None:
        self.host.stop()
        self.thread.join(PATIENCE)
        assert not self.thread.is_alive()
        self.host.close()
        self._sources.close()

    def until(self, condition: Any) -> Any:
        deadline = time.monotonic() + PATIENCE
        while not (value := condition()):
            assert time.monotonic() < deadline, f"waited in vain; last messages: {self.messages[-5:]}"
            time.sleep(0.01)
        return value

    def next(self, count: int = 3) -> Lit:
        """A frame that was begun after now."""
        start = len(self.frames)
        self.until(lambda: len(self.frames) >= start + count)
        return self.frames[-1]

    def edit(self, **message: Any) -> None:
        self.host.edit(parse_text(json.dumps(message)), "me")


class Page:
    """A client as the page is one."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self.socket = socket
        self.frames = 0

    async def say(self, **message: Any) -> None:
        await self.socket.send_str(json.dumps(message))

    async def hear(self, *, ack: bool = True) -> tuple[dict[str, Any], list[bytes]]:
        message = await asyncio.wait_for(self.socket.receive(), PATIENCE)
        if message.type is aiohttp.WSMsgType.TEXT:
            return json.loads(message.data), []
        if message.type is not aiohttp.WSMsgType.BINARY:
            raise ConnectionError(f"{message.type} {self.socket.close_code} {message.extra}")
        (length,) = struct.unpack_from("<I", message.data)
        header, place, pictures = json.loads(message.data[4 : 4 + length]), 4 + length, []
        for size in header["sizes"]:
            pictures.append(message.data[place : place + size])
            place += size
        assert place == len(message.data)
        if header["type"] == "frame":
            self.frames += 1
            if ack:
                await self.say(type="ack", id=header["id"])
        return header, pictures

    async def until(self, kind: str) -> tuple[dict[str, Any], list[bytes]]:
        while True:
            header, pictures = await self.hear()
            if header["type"] == kind:
                return header, pictures

    async def closed(self) -> tuple[int | None, str]:
        """Code and reason with which the server closed."""
        while True:
            message = await asyncio.wait_for(self.socket.receive(), PATIENCE)
            if message.type is aiohttp.WSMsgType.CLOSE:
                return message.data, message.extra
            if message.type in (aiohttp.WSMsgType.CLOSED, aiohttp.WSMsgType.ERROR):
                return self.socket.close_code, ""


@dataclasses.dataclass
class Site:
    server: Server
    url: str
    session: aiohttp.ClientSession

    @contextlib.asynccontextmanager
    async def page(self, **options: Any) -> AsyncIterator[Page]:
        async with self.session.ws_connect(f"{self.url}/live", max_msg_size=1 << 24, **options) as socket:
            yield Page(socket)


@contextlib.asynccontextmanager
async def served(
    scene: Scene | None = None, header_seconds: float = HEADER_SECONDS, **address: Any
) -> AsyncIterator[Site]:
    ready: asyncio.Event = asyncio.Event()
    make = functools.partial(Host, scene or page_scene(), device="cpu", quality="low")
    server = Server(make, Address(port=0, **address), header_seconds=header_seconds)
    with small_frames():
        task = asyncio.create_task(server.serve(lambda _: ready.set()))
        waiting = asyncio.create_task(ready.wait())
        await asyncio.wait({task, waiting}, return_when=asyncio.FIRST_COMPLETED)
        assert ready.is_set(), task.exception()
        try:
            async with aiohttp.ClientSession() as session:
                yield Site(server, f"http://127.0.0.1:{server.address.port}", session)
        finally:
            # A host that is made after its server has stopped waiting for it is closed by nobody.
            made = asyncio.create_task(server.started())
            await asyncio.wait({task, made}, timeout=PATIENCE, return_when=asyncio.FIRST_COMPLETED)
            made.cancel()
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task


def run(test: Any) -> Any:
    """Run an asynchronous test."""

    @functools.wraps(test)
    def wrapper(*arguments: Any, **keywords: Any) -> None:
        asyncio.run(asyncio.wait_for(test(*arguments, **keywords), 4 * PATIENCE))

    return wrapper
