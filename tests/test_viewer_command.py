"""The command that serves the page: its address, its arguments, its beginning and its end."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import functools
import os
import signal
import subprocess
import sys
import threading
import types
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np
import pytest

from tests.viewer_rig import PATIENCE, Page, Running, page_scene, run
from warp_ar import live, live_page
from warp_ar.errors import SourceError, UsageError
from warp_ar.scene import dumps_scene, load_scene
from warp_ar.viewer.address import Address, own_address
from warp_ar.viewer.host import Host
from warp_ar.viewer.server import Server

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def process_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """A command whose threads outlast it ends its process, on a busy machine: here that of all tests."""
    others = {name: getattr(os, name) for name in dir(os) if name != "_exit"}
    monkeypatch.setattr(live_page, "os", types.SimpleNamespace(**others, _exit=lambda code: None))


def test_the_page_is_served_before_warp_is_loaded() -> None:
    served = "from warp_ar.live_page import _page_address, _page_scene; from warp_ar.viewer.server import Server"
    asked = "o = make_parser().parse_args(['desk']); _page_scene(o); _page_address(o)"
    code = f"import sys; from warp_ar.live import make_parser; {served}; {asked}; sys.exit('warp' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=PATIENCE, check=False).returncode == 0


def test_address() -> None:
    assert Address().url == "http://127.0.0.1:8720/"
    assert Address("0.0.0.0", 80, "abc").url == "http://localhost:80/?token=abc"
    assert Address("::1", 80).url == "http://[::1]:80/"
    assert not Address("0.0.0.0").loopback
    # What a phone can open is no name of this machine for itself.
    outside = Address("0.0.0.0", 80, "abc").outside_url
    if own_address() is None:
        assert outside is None
    else:
        assert outside == f"http://{own_address()}:80/?token=abc"
        assert not own_address().startswith("127.")
    assert Address("127.0.0.1").outside_url is None


def test_without_a_camera_frames_that_are_counted_never_come(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["desk", "--source", "1023", "--device", "cpu", "--quality", "low", "--port", "0", "--no-browser"]
    assert live.main([*arguments, "--frames", "1"]) == 2
    assert "capture device 1023 cannot be opened" in capsys.readouterr().err
    with pytest.raises(SourceError, match="numbered from 0 to 1023"):
        Host(page_scene(), source=1024, device="cpu", quality="low")


def test_without_a_camera_the_page_says_so() -> None:
    with Running(page_scene(), source=1023) as running:
        missing = running.host.state_message()["missing"]
        assert missing["name"] == "source.absent"
        assert "capture device 1023 cannot be opened" in missing["text"]
        assert "My camera" in missing["remedy"]
        assert np.ptp(running.next().frame) == 0, "more than a grey picture"


def test_names_do_not_reach_the_terminal_as_they_are(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = dataclasses.replace(load_scene("desk"), name="d\x1b]0;owned\x07esk")
    (tmp_path / "scene.toml").write_text(dumps_scene(scene))
    arguments = [str(tmp_path / "scene.toml"), "--device", "cpu", "--quality", "low"]
    assert live.main([*arguments, "--port", "0", "--no-browser", "--frames", "1"]) == 0
    out = capsys.readouterr().out
    assert "http://127.0.0.1:" in out
    assert "\x1b" not in out
    assert "\x07" not in out


# The command, with frames that take ten minutes each, in a thread that has compiled.
ENDLESS = """
import sys, time
from warp._src import context
from warp_ar.engine.pipeline import Pipeline
def light(self, *arguments, **options):
    context.runtime.get_clang_pch_dir()
    print("lighting", flush=True)
    time.sleep(600)
Pipeline.__call__ = light
from warp_ar.live import main
sys.exit(main(sys.argv[1:]))
"""


def test_ctrl_c_does_not_wait_for_the_frame_in_hand(tmp_path: Path) -> None:
    """Nor does it leave a folder behind, the compiler's among them."""
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    command = [sys.executable, "-c", ENDLESS, "desk", "--device", "cpu", "--quality", "low", "--port", "0"]
    with subprocess.Popen(
        [*command, "--no-browser", "--frames", "1"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    ) as process:
        assert process.stdout is not None
        assert "http://" in process.stdout.readline()
        assert process.stdout.readline() == "lighting\n"
        process.send_signal(signal.SIGINT)
        try:
            _, errors = process.communicate(timeout=PATIENCE)
        finally:
            process.kill()
    assert process.returncode == 130
    assert errors == ""
    assert not list(tmp_path.iterdir())


@run
async def test_the_page_is_there_before_anything_is_built() -> None:
    go_on = threading.Event()

    def make(**callbacks: Any) -> Host:
        assert go_on.wait(PATIENCE)
        return Host(page_scene(), device="cpu", quality="low", **callbacks)

    ready: asyncio.Event = asyncio.Event()
    server = Server(make, Address(port=0))
    task = asyncio.create_task(server.serve(lambda _: ready.set()))
    try:
        await ready.wait()
        async with aiohttp.ClientSession() as session:
            for path in ("", "static/app.js"):
                async with session.get(server.address.url + path) as response:
                    assert response.status == 200
            connecting = asyncio.create_task(session.ws_connect(f"{server.address.url}live", max_msg_size=1 << 24))
            await asyncio.sleep(0.2)
            go_on.set()
            async with await connecting as socket:
                await Page(socket).until("frame")
    finally:
        go_on.set()
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


@run
async def test_a_host_that_cannot_be_built_ends_the_server_with_its_reason() -> None:
    make = functools.partial(Host, dataclasses.replace(page_scene(), source=None), device="cpu")
    with pytest.raises(UsageError, match="names no source"):
        await Server(make, Address(port=0)).serve()
