"""The page's server: what it serves, what it refuses, and that nobody can spoil it for others."""

from __future__ import annotations

import asyncio
import contextlib
import io
import json
import tempfile
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import aiohttp
import cv2
import numpy as np
import pytest

from tests.viewer_rig import Page, jpeg, picture_message, run, served
from warp_ar.light.captured import Light as CapturedMap
from warp_ar.viewer import uploads
from warp_ar.viewer.protocol import MOST_BYTES

pytestmark = pytest.mark.slow


def encode_exr() -> bytes:
    """A captured light."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "light.exr"
        CapturedMap(np.full((8, 16, 3), 0.5, np.float32), np.ones((8, 16), np.float32)).save(path)
        return path.read_bytes()


@run
async def test_a_page_is_told_all_and_sees_frames() -> None:
    async with served() as site, site.page() as page:
        kinds = set()
        while not {"hello", "plan", "scene", "state", "light", "frame"} <= kinds:
            header, pictures = await page.hear()
            kinds.add(header["type"])
            if header["type"] == "frame" and not header["plan"]:
                kinds.discard("frame")  # the camera's own picture: nothing is built yet
            elif header["type"] == "frame":
                image = cv2.imdecode(np.frombuffer(pictures[0], np.uint8), cv2.IMREAD_COLOR_RGB)
                assert image.shape == (header["camera"][1], header["camera"][0], 3)
                assert len(header["pose"]) == 12
            if header["type"] == "plan" and header["run"]:
                assert {"stage", "reason", "methods"} == set(header["left_out"][0])
        await page.say(type="ping", sent=5.0)
        header, _ = await page.until("pong")
        assert header["sent"] == 5.0
        assert header["clock"] > 0


@run
async def test_files_of_the_page_and_nothing_else() -> None:
    async with served() as site:
        async with site.session.get(f"{site.url}/") as response:
            assert response.status == 200
            assert "warp_ar" in await response.text()
            assert "script-src 'self'" in response.headers["Content-Security-Policy"]
            assert response.headers["X-Content-Type-Options"] == "nosniff"
        async with site.session.get(f"{site.url}/static/app.js") as response:
            assert response.headers["Content-Type"].startswith("text/javascript")
        for path in (
            "/static/../server.py",
            "/static/%2e%2e/server.py",
            "/static/..%2fserver.py",
            "/static//etc/passwd",
            "/static/",
            "/download/../../etc/passwd",
            "/download/%2fetc%2fpasswd",
            "/download/scene.toml%00",
            "/nothing",
        ):
            async with site.session.get(aiohttp.client.URL(site.url + path, encoded=True)) as response:
                assert response.status in (400, 404), path
        async with site.session.post(f"{site.url}/") as response:
            assert response.status == 405


@run
async def test_downloads() -> None:
    async with served() as site, site.page() as page:
        await page.until("frame")
        while not (await page.until("light"))[0]["known"]:
            pass
        for name, start in [("frame.png", b"\x89PNG"), ("scene.toml", b"schema = 1")]:
            async with site.session.get(f"{site.url}/download/{name}") as response:
                assert response.status == 200
                assert name in response.headers["Content-Disposition"]
                assert (await response.read()).startswith(start)
        async with site.session.get(f"{site.url}/light.exr?&axes=z-up") as response:
            assert (await response.read()).startswith(b"v/1\x01")
        async with site.session.get(f"{site.url}/download/camera.yml") as response:
            assert response.status == 409


@run
async def test_files_are_dropped() -> None:
    async with served() as site, site.page() as page:
        await page.until("frame")
        light = encode_exr()
        async with site.session.post(f"{site.url}/drop/my%20light.exr", data=light) as response:
            assert response.status == 200
            assert "16x8" in await response.text()
        while (told := (await page.until("scene"))[0]["scene"]["captured"]) is None:
            pass
        assert told.endswith("my_light.exr")
        async with site.session.post(f"{site.url}/drop/x.exr", data=light[:60]) as response:
            assert response.status == 422
            assert (await response.text()).startswith("x.exr")
        for error, status, said in (
            (OSError(28, "No space left on device"), 507, "No space left"),
            (ZeroDivisionError("broken"), 422, "ZeroDivisionError: broken"),
        ):
            with pytest.MonkeyPatch.context() as patched:
                patched.setattr(uploads, "load_mesh", Mock(side_effect=error))
                async with site.session.post(f"{site.url}/drop/x.ply", data=b"ply") as response:
                    assert response.status == status
                    assert said in await response.text()
        too_large = io.BytesIO(bytes(MOST_BYTES + 1))
        with contextlib.suppress(aiohttp.ClientError, ConnectionError):  # refused before all of it was sent
            async with site.session.post(f"{site.url}/drop/large.ply", data=too_large) as response:
                assert response.status == 413
        async with site.session.post(
            f"{site.url}/drop/x.exr", data=light, headers={"Origin": "http://evil.example"}
        ) as response:
            assert response.status == 403
        # The page goes on.
        await page.until("frame")


@run
async def test_other_sites_are_refused() -> None:
    async with served() as site:
        for headers in (
            {"Origin": "https://evil.example"},
            {"Origin": "null"},
            {"Origin": "http://127.0.0.1:1"},
            {"Host": "evil.example"},  # whose name resolves to this machine
            {"Sec-Fetch-Site": "cross-site"},
        ):
            with pytest.raises(aiohttp.WSServerHandshakeError) as error:
                async with site.page(headers=headers):
                    pass
            assert error.value.status == 403, headers
            async with site.session.get(f"{site.url}/download/frame.png", headers=headers) as response:
                assert response.status == 403
        async with site.page(headers={"Origin": site.url}) as page:
            await page.until("hello")


@run
async def test_token() -> None:
    async with served(token="5ec2e7") as site:
        paths = ("/", "/live", "/light.json", "/download/frame.png", "/?token=", "/?token=5ec2e", "/live?token=%ff")
        for path in paths:
            async with site.session.get(aiohttp.client.URL(site.url + path, encoded=True)) as response:
                assert response.status == 403, path
                assert "token" in await response.text()
        async with site.session.get(f"{site.url}/", headers={"Accept": "text/html"}) as response:
            assert response.status == 403
            assert response.content_type == "text/html"
            assert "token" in await response.text()
        async with site.session.get(f"{site.url}/address.svg?token=5ec2e7") as response:
            assert (await response.read()).startswith(b"<?xml")
        async with site.session.get(f"{site.url}/?token=5ec2e7") as response:
            assert response.status == 200
            assert response.headers["Referrer-Policy"] == "no-referrer"
        async with site.session.ws_connect(f"{site.url}/live?token=5ec2e7", max_msg_size=1 << 24) as socket:
            await Page(socket).until("frame")


BAD_MESSAGES: list[tuple[Any, int, str]] = [
    ("{", 1008, "no JSON"),
    ('{"type": "exec"}', 1008, "no known type"),
    ("x" * 5000, 1008, "no JSON"),
    (b"\0" * ((1 << 20) + 200), 1009, ""),
    (json.dumps({"type": "ack", "id": "1"}), 1008, "ack: id"),
]


@run
async def test_a_bad_message_closes_its_sender_with_a_reason_and_touches_no_other() -> None:
    async with served() as site, site.page() as good:
        await good.until("frame")
        for message, code, reason in BAD_MESSAGES:
            async with site.page() as bad:
                if isinstance(message, bytes):
                    await bad.socket.send_bytes(message)
                else:
                    await bad.socket.send_str(message)
                got, text = await bad.closed()
                assert got == code
                assert reason in text
        await good.until("frame")
        async with site.page() as bad:  # a picture that was never announced is left aside, a wrong one is not
            await bad.socket.send_bytes(picture_message(jpeg()))
            await bad.say(type="camera", width=64, height=48)
            await bad.until("scene")
            await asyncio.sleep(0.3)
            await bad.socket.send_bytes(picture_message(jpeg(32, 32)))
            assert (await bad.closed())[0] == 1008
        await good.until("frame")


@run
async def test_too_many_messages_close_their_sender() -> None:
    async with served() as site, site.page() as good, site.page() as bad:
        with contextlib.suppress(ConnectionError, aiohttp.ClientError):
            for _ in range(5000):
                await bad.say(type="ping", sent=1.0)
        code, reason = await bad.closed()
        assert code == 1008 or "messages" in reason
        await good.until("frame")


@run
async def test_only_so_many_viewers() -> None:
    async with served() as site, contextlib.AsyncExitStack() as stack:
        for _ in range(8):
            await stack.enter_async_context(site.page())
        with pytest.raises(aiohttp.WSServerHandshakeError) as error:
            await stack.enter_async_context(site.page())
        assert error.value.status == 503


@run
async def test_a_viewer_that_shows_nothing_gets_two_frames_and_slows_nobody() -> None:
    async with served() as site, site.page() as good, site.page() as slow:
        await good.until("frame")
        seen = 0
        while good.frames < 14:
            with contextlib.suppress(TimeoutError):
                while True:
                    message = await asyncio.wait_for(slow.socket.receive(), 0.02)
                    seen += message.type is aiohttp.WSMsgType.BINARY and b'"type":"frame"' in message.data[:400]
            await good.until("frame")
        assert seen == 2
