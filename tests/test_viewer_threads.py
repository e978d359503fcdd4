"""What the page's threads do at once: two viewers that edit, sources that change, work beside the frames that fails."""

from __future__ import annotations

import asyncio
import dataclasses
import errno
import json
import math
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.test_viewer_budget import known_errors  # noqa: F401  (a fixture)
from tests.viewer_rig import PATIENCE, SIZE, Running, jpeg, page_scene, run, served
from warp_ar.engine.pipeline import Pipeline
from warp_ar.errors import SinkError, SourceError, UsageError
from warp_ar.output.sinks import VideoSink
from warp_ar.sources.sources import Synthetic
from warp_ar.stages.quality import PRESETS
from warp_ar.viewer import budget as budget_setting
from warp_ar.viewer import camera as camera_module
from warp_ar.viewer import setup as setup_checks
from warp_ar.viewer.budget import BudgetSetting
from warp_ar.viewer.camera import BrowserCamera, CalibrationSession, FocalEstimate
from warp_ar.viewer.controls import Controls, Feed, NoCamera
from warp_ar.viewer.edits import Wanted
from warp_ar.viewer.frames import Recorder
from warp_ar.viewer.host import Host
from warp_ar.viewer.lighting import Lighting
from warp_ar.viewer.protocol import Command, Picture
from warp_ar.viewer.routes import DROPS
from warp_ar.viewer.server import Server

# How long the one of two threads is given that comes too early where nothing holds it back.
AHEAD = 0.5


def make_controls(notify: Any) -> Controls:
    return Controls(Feed(Synthetic("card", size=SIZE)), Wanted(page_scene(), PRESETS["low"]), notify)


def with_quality(name: str) -> Any:
    return lambda wanted: dataclasses.replace(wanted, quality=PRESETS[name])


@pytest.fixture
def resting() -> Iterator[Host]:
    """A host whose frames do not run."""
    host = Host(page_scene(), device="cpu", quality="low")
    yield host
    host.close()


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


def test_an_edit_that_cannot_be_built_takes_no_later_one_with_it() -> None:
    controls = make_controls(lambda message: None)
    good = controls.wanted
    controls.change(with_quality("high"))
    refused = controls.wanted
    controls.change(with_quality("paper"))
    controls.give_back(good, refused)
    assert controls.wanted.quality.name == "paper"
    controls.give_back(good, controls.wanted)
    assert controls.wanted is good
    controls.close()


def test_a_budget_and_a_preset_that_are_asked_for_at_once(resting: Host, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both parts of what is then are one viewer's: no budget goes with a preset, no preset with a budget."""
    switch = resting._budget.switch
    others: list[threading.Thread] = []

    def slow(budget: float | None) -> None:
        switch(budget)
        if not others:
            others.append(threading.Thread(target=resting.edit, args=(Command("quality", {"name": "paper"}),)))
            others[0].start()
            others[0].join(AHEAD)

    monkeypatch.setattr(resting._budget, "switch", slow)
    resting.edit(Command("budget", {"ms": 20.0}))
    others[0].join(PATIENCE)
    assert (resting._budget.budget is not None) == BudgetSetting.rules(resting.wanted().quality)


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


class LateEstimator:
    """Tells the focal length when its camera has been left already."""

    full = False
    ripe = True

    def __init__(self, *_: Any) -> None:
        self.leave: Any = None

    def look(self, picture: Any) -> bool:
        return True

    def estimate(self) -> FocalEstimate:
        self.leave()
        return FocalEstimate(1234.0, 0.01, 8)


@pytest.mark.parametrize("adopted", [True, False])
def test_an_estimate_that_comes_late_is_not_the_next_source_s(monkeypatch: pytest.MonkeyPatch, adopted: bool) -> None:
    """A viewer that goes while its picture is looked at: the scene's own source keeps the scene's camera."""
    monkeypatch.setattr(camera_module, "FocalEstimator", LateEstimator)
    told: list[Any] = []
    controls = make_controls(told.append)
    camera = BrowserCamera(controls, told.append)
    camera.use(*SIZE, "me")
    controls.adopt()

    def leave() -> None:
        camera.leave(Feed(Synthetic("card", size=SIZE)))
        if adopted:
            controls.adopt()

    assert isinstance(camera._estimator, LateEstimator)
    camera._estimator.leave = leave
    camera.push(Picture(1, 1.0, jpeg(*SIZE)), "me")
    controls.adopt()
    assert controls.feed.camera is None
    assert not camera.estimated
    assert not [message for message in told if message["type"] == "intrinsics"]
    controls.close()


def test_an_estimate_is_of_the_camera_that_comes_next(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its pictures are looked at before the frame in hand is lit, after which it is the source."""
    monkeypatch.setattr(camera_module, "FocalEstimator", LateEstimator)
    controls = make_controls(lambda message: None)
    camera = BrowserCamera(controls, lambda message: None)
    camera.use(*SIZE, "me")
    assert isinstance(camera._estimator, LateEstimator)
    camera._estimator.leave = lambda: None
    camera.push(Picture(1, 1.0, jpeg(*SIZE)), "me")
    assert controls.feed.camera is None, "the scene's own source has the scene's camera"
    controls.adopt()
    assert controls.feed.camera is not None
    assert math.isclose(controls.feed.camera.fx, 1234.0)
    controls.close()


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


@run
async def test_who_goes_in_the_midst_of_a_file_is_no_fault_of_the_program(caplog: pytest.LogCaptureFixture) -> None:
    """Nothing is said of it, and another file is taken."""
    async with served() as site:
        await site.server.backend.started()
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


@run
async def test_a_camera_is_left_whatever_becomes_of_its_viewer() -> None:
    """What is sent to it fails in a way that nobody has thought of, and it goes: the camera is free."""

    async def fail(*_: Any) -> None:
        raise RuntimeError("nobody has thought of this")

    async with served() as site:
        host = await site.server.backend.started()
        with pytest.MonkeyPatch.context() as patch:
            async with site.page() as page:
                await page.until("frame")
                await page.say(type="camera", width=SIZE[0], height=SIZE[1])
                while not host._controls.newest_feed.is_browser:
                    await page.hear()
                patch.setattr(Server, "_message", fail)
                (viewer,) = site.server._viewers
                viewer.sent = -1
                viewer.unshown.clear()
                viewer.wake.set()
                await asyncio.sleep(AHEAD)
            deadline = time.monotonic() + 0.1 * PATIENCE
            while host._controls.newest_feed.is_browser and time.monotonic() < deadline:
                await asyncio.sleep(0.02)
            assert not host._controls.newest_feed.is_browser


def test_what_changes_while_the_page_is_told_of_it(resting: Host, monkeypatch: pytest.MonkeyPatch) -> None:
    """A source, and what is built, that are there at one look and gone at the next: the ticker goes on."""
    seen = [NoCamera(SIZE, SourceError("no device")), None]
    with monkeypatch.context() as patch:
        patch.setattr(Host, "no_camera", property(lambda host: seen.pop(0) if seen else None))
        assert resting.state_message()["missing"]["name"] == "source.absent"
    lighting = resting._lighting

    def changing(self: Lighting) -> bool:
        self._then = None
        return False

    monkeypatch.setattr(Lighting, "changing", property(changing))
    monkeypatch.setattr(Lighting, "busy", property(lambda self: True))
    lighting._then = lighting._now
    doing = lighting.doing()
    assert doing is not None
    assert doing["quality"] == "low"


# ----------------------------------------------------------------------------------------------------------- recordings


def test_a_recording_that_is_being_finished_is_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    finishing, go_on, close = threading.Event(), threading.Event(), VideoSink.close

    def slow(sink: VideoSink) -> None:
        finishing.set()
        assert go_on.wait(PATIENCE)
        close(sink)

    monkeypatch.setattr(VideoSink, "close", slow)
    recorder = Recorder(tmp_path)
    recorder.start(30.0)
    for level in range(40):
        recorder.add(np.full((48, 64, 3), 4 * level, np.uint8))
    with ThreadPoolExecutor(2) as others:
        stopping = others.submit(recorder.stop)
        assert finishing.wait(PATIENCE)
        reading = others.submit(recorder.video)
        time.sleep(AHEAD)
        early = reading.done()
        go_on.set()
        stopping.result(PATIENCE)
        assert not early
        assert reading.result(PATIENCE) == (tmp_path / "recording.mp4").read_bytes()


def test_a_recording_that_cannot_be_finished_keeps_nothing_open(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> None:
        raise SinkError("recording.mp4 cannot be finished: no space left on device")

    host = Host(page_scene(), device="cpu", quality="low")
    folder = Path(host._folder.name)
    monkeypatch.setattr(host._recorder, "stop", fail)
    assert host.close()
    assert not folder.exists()
    with pytest.raises(SourceError, match="closed"):
        iter(host._controls.feed.source)


def test_a_file_that_is_still_being_written_does_not_hinder_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    host = Host(page_scene(), device="cpu", quality="low")
    cleanup = host._folder.cleanup

    def fail() -> None:
        cleanup()
        raise OSError(errno.ENOTEMPTY, "Directory not empty", host._folder.name)

    monkeypatch.setattr(host._folder, "cleanup", fail)
    assert host.close()


# ---------------------------------------------------------------------------------------------- work beside the frames


def test_a_calibration_that_another_viewer_stops_is_finished_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    class Views:
        def solve(self) -> None:
            raise UsageError("too few views")

    session = CalibrationSession(ThreadPoolExecutor(1), lambda message: None, lambda camera: None)
    seen = [Views(), None]
    monkeypatch.setattr(CalibrationSession, "_views", property(lambda self: seen.pop(0)), raising=False)
    with pytest.raises(UsageError, match="too few views"):
        session.step("finish")


def test_checks_are_told_of_while_another_is_noted(resting: Host) -> None:
    checks = resting._setup

    class Noted:
        """Has another step's result noted as it is looked at."""

        def __eq__(self, other: object) -> bool:
            checks._made["ball"] = None
            return False

        __hash__ = None  # type: ignore[assignment]

    checks._made["check"] = Noted()
    assert checks.message()["measured"] == {}


def test_a_check_that_fails_is_told(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """In a way that is a fault of the program: the page hears of it, the terminal where it was, and frames go on."""

    def fail(*_: Any) -> None:
        raise ZeroDivisionError("a fault")

    monkeypatch.setattr(setup_checks, "look_at", fail)
    with Running(page_scene()) as running:
        running.edit(type="setup", step="check")
        notice = running.until(lambda: next((m for m in running.messages if m["type"] == "notice"), None))
        assert "ZeroDivisionError: a fault" in notice["text"]
        assert running.host._setup.message()["busy"] is None
        running.next()
    assert "in fail" in capsys.readouterr().err


@pytest.mark.parametrize("fault", [RuntimeError("Failed to allocate 12 bytes"), ZeroDivisionError("a fault")])
def test_costs_that_cannot_be_measured_are_told_once(
    known_errors: None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    fault: Exception,
) -> None:
    began: list[None] = []

    def steps(*_: Any) -> Iterator[float]:
        began.append(None)
        yield 0.5
        raise fault

    monkeypatch.setattr(budget_setting, "measure_steps", steps)
    told: list[dict[str, Any]] = []
    setting = BudgetSetting(told.append, tmp_path)
    setting.switch(50.0)
    frame = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    with Pipeline(page_scene(), device="cpu", quality="low") as pipeline:
        for _ in range(3):
            with ThreadPoolExecutor(1) as helper:
                setting.look(pipeline, frame, None, helper)
                while setting.measuring:
                    time.sleep(0.01)
    notices = [message["text"] for message in told if message["type"] == "notice"]
    assert len(notices) == 1
    assert str(fault) in notices[0]
    assert len(began) == 1


def test_a_comparison_that_cannot_be_built_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    warm_up = Lighting._warm_up

    def fail(self: Lighting, pipeline: Pipeline) -> None:
        if pipeline.quality.name == "paper":
            raise RuntimeError("Failed to allocate 10 GB")
        warm_up(self, pipeline)

    monkeypatch.setattr(Lighting, "_warm_up", fail)
    with Running(page_scene()) as running:
        running.edit(type="compare", other="paper")
        running.until(lambda: [m for m in running.messages if m["type"] == "notice"])
        running.next(5)
        notices = [message["text"] for message in running.messages if message["type"] == "notice"]
        assert len(notices) == 1, "once, not with every frame"
        assert "'paper' cannot run here" in notices[0]
        assert json.dumps(running.host.state_message())
