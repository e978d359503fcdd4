"""What the page's threads do at once: two viewers that edit, sources that change, background work that fails."""

from __future__ import annotations

import asyncio
import dataclasses
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

from tests.test_viewer_budget import known_errors  # noqa: F401  (a fixture)
from tests.viewer_rig import PATIENCE, SIZE, Running, page_scene, run, served
from warp_ar.errors import UsageError
from warp_ar.sources.synthetic import Synthetic
from warp_ar.stages.quality import PRESETS
from warp_ar.viewer import setup as setup_checks
from warp_ar.viewer.controls import BrowserCamera, Controls, Feed, guessed_camera
from warp_ar.viewer.edits import Wanted
from warp_ar.viewer.host import Host
from warp_ar.viewer.protocol import Command
from warp_ar.viewer.server import DROPS

pytestmark = pytest.mark.slow

# How long the one of two threads is given that comes too early where nothing holds it back.
AHEAD = 0.5


def make_controls(notify: Any) -> Controls:
    return Controls(Feed(Synthetic("card", size=SIZE)), Wanted(page_scene(), PRESETS["low"]), notify)


def with_quality(name: str) -> Any:
    return lambda wanted: dataclasses.replace(wanted, quality=PRESETS[name])


# ------------------------------------------------------------------------------------------------- two who edit at once


def test_what_is_told_last_is_what_is_wanted() -> None:
    """Another edit comes between a first one and its message."""
    told: list[Any] = []
    others: list[threading.Thread] = []

    def notify(message: Any) -> None:
        if not others:
            others.append(threading.Thread(target=controls.change, args=(with_quality("paper"),)))
            others[0].start()
            others[0].join(AHEAD)
        told.append(message)

    controls = make_controls(notify)
    controls.change(with_quality("high"))
    others[0].join(PATIENCE)
    assert len(told) == 2
    assert controls.wanted.quality.name == "paper"
    assert told[-1] == controls.scene_message()
    controls.close()


def test_of_two_cameras_that_are_offered_at_once_one_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    controls = make_controls(lambda message: None)
    camera, switch = BrowserCamera(controls, lambda message: None), controls.switch
    others: list[Any] = []

    def slow(feed: Feed) -> None:
        if not others:
            others.append(pool.submit(camera.use, *SIZE, "you"))
            time.sleep(AHEAD)
        switch(feed)

    monkeypatch.setattr(controls, "switch", slow)
    with ThreadPoolExecutor(1) as pool:
        camera.use(*SIZE, "me")
        assert isinstance(others[0].exception(PATIENCE), UsageError)
    assert camera.is_of("me")
    controls.close()


@run
async def test_who_comes_while_another_edits_sees_the_edit() -> None:
    """The greetings were made before it, and are sent after it."""
    made, go_on, greetings = threading.Event(), threading.Event(), Host.greetings

    def slow(host: Host) -> list[dict[str, Any]]:
        told = greetings(host)
        made.set()
        assert go_on.wait(PATIENCE)
        return told

    async with served() as site, site.page() as first:
        await first.until("light")
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Host, "greetings", slow)
            async with site.page() as second:
                await asyncio.to_thread(made.wait, PATIENCE)
                await first.say(type="set", part="light", index=0, key="intensity", value=7.5)
                await first.until("scene")
                go_on.set()
                seen = None
                await second.say(type="ping", sent=1.0)
                while (message := (await second.hear())[0])["type"] != "pong":
                    seen = message["scene"] if message["type"] == "scene" else seen
        assert seen is not None
        assert seen["lights"][0]["intensity"] == 7.5


# ------------------------------------------------------------------------------------------------- cameras and sources


def test_an_estimate_that_comes_late_is_not_the_next_source_s() -> None:
    """A viewer that goes while its frames are looked at: the scene's own source keeps the scene's camera."""
    controls = make_controls(lambda message: None)
    camera = BrowserCamera(controls, lambda message: None)
    camera.use(*SIZE, "me")
    controls.adopt()
    feed, found = controls.feed, dataclasses.replace(guessed_camera(*SIZE), fx=1234.0, fy=1234.0)
    assert controls.use_estimate(found, feed)
    assert controls.feed.camera is found
    assert controls.feed.estimated
    left = controls.feed
    controls.switch(Feed(Synthetic("card", size=SIZE)))
    assert not controls.use_estimate(found, left)
    controls.adopt()
    assert not controls.use_estimate(found, left)
    assert controls.feed.camera is None
    controls.close()


@run
async def test_who_goes_in_the_midst_of_a_file_is_no_fault_of_the_program(caplog: pytest.LogCaptureFixture) -> None:
    """Nothing is said of it, and another file is taken."""
    async with served() as site:
        await site.server.started()
        place = site.url.removeprefix("http://")
        head = f"POST /drop/scene.toml HTTP/1.1\r\nHost: {place}\r\nContent-Length: 100000\r\n\r\n"
        writers = []

        async def begin() -> None:
            _, writer = await asyncio.open_connection(*place.split(":"))
            writer.write(head.encode() + b"#" * 5000)
            await writer.drain()
            writers.append(writer)

        async def until(status: int) -> None:
            while True:
                async with site.session.post(f"{site.url}/drop/scene.toml", data=b"x") as response:
                    if response.status == status:
                        return
                await asyncio.sleep(0.02)

        for _ in range(DROPS - 1):
            await begin()
        await asyncio.wait_for(until(422), PATIENCE)  # slow ones hold up no other, which is read, and refused
        await begin()
        await asyncio.wait_for(until(429), PATIENCE)  # as many as may be are on their way
        for writer in writers:
            writer.transport.abort()
        await asyncio.wait_for(until(422), PATIENCE)
    assert not caplog.records


# ------------------------------------------------------------------------------------------------------ background work


def test_a_check_that_fails_is_told(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """In a way that is a fault of the program: the page hears of it, the terminal where it was, and frames go on."""

    def fail(*_: Any) -> None:
        raise ZeroDivisionError("a fault")

    monkeypatch.setattr(setup_checks, "look_at", fail)
    with Running(page_scene()) as running:
        running.edit(type="setup", step="check")
        notice = running.until(lambda: next((m for m in running.messages if m["type"] == "notice"), None))
        assert "ZeroDivisionError: a fault" in notice["text"]
        running.until(lambda: any(m["type"] == "setup" and m["busy"] is None for m in running.messages))
        running.next()
    assert "in fail" in capsys.readouterr().err


def test_a_camera_can_be_left_where_the_scene_has_no_source() -> None:
    """Such a scene may be dropped onto the page. It says so, and others can bring a camera."""
    with Running(page_scene()) as running:
        host = running.host
        running.edit(type="camera", width=SIZE[0], height=SIZE[1])
        host._controls.change(lambda w: dataclasses.replace(w, scene=dataclasses.replace(w.scene, source=None)))
        host.leave_camera("me")
        running.until(lambda: host.no_camera is not None)
        assert any("names no source" in str(message.get("text")) for message in running.messages)
        running.until(lambda: host.state_message()["missing"])
        host.edit(Command("camera", {"width": SIZE[0], "height": SIZE[1]}), "you")
        assert host.camera_size("you") == SIZE
