"""The page's library half: takes what viewers ask for, runs their frames, and has what they can save."""

from __future__ import annotations

import contextlib
import dataclasses
import tempfile
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.checks.pointed_shape import point_out
from warp_ar.engine.pipeline import resolve_quality
from warp_ar.errors import SourceError, UsageError, WarpArError
from warp_ar.output.sinks import write_environment
from warp_ar.scene import Scene, bundled_scenes, dumps_scene, load_scene
from warp_ar.stages.quality import AUTO, DEFAULT_PRESET, PRESETS, Quality
from warp_ar.viewer import calibration, edits, protocol
from warp_ar.viewer.browser_camera import BrowserCamera
from warp_ar.viewer.budget import BudgetSetting
from warp_ar.viewer.bundle import pack_scene
from warp_ar.viewer.calibration import CalibrationSession
from warp_ar.viewer.controls import Controls, Feed, open_feed
from warp_ar.viewer.edits import Wanted
from warp_ar.viewer.frames import FrameLoop, Helpers, Lit
from warp_ar.viewer.light_record import LightState
from warp_ar.viewer.lighting import Lighting, make_target
from warp_ar.viewer.messages import Notify, failure, notice
from warp_ar.viewer.no_camera import NoCamera
from warp_ar.viewer.recorder import Recorder
from warp_ar.viewer.setup import SetupChecks
from warp_ar.viewer.uploads import DroppedFiles


class Host:
    """Lights frames for viewers. Every method may be called from any thread."""

    def __init__(
        self,
        scene: Scene,
        *,
        source: str | int | Path | None = None,
        device: str = "auto",
        quality: str | Quality = DEFAULT_PRESET,
        budget_ms: float | None = None,
        frames: int | None = None,
        publish: Callable[[Lit], None] = lambda lit: None,
        notify: Notify = lambda message: None,
    ) -> None:
        """Open the source; pipelines are built while ``run`` shows its frames.

        Args:
            scene: What to show first.
            source: Frames instead of the scene's own.
            device: ``auto``, ``cpu`` or ``cuda:N``.
            quality: A preset's name, a value, or ``auto``.
            budget_ms: Milliseconds per frame for ``auto``; None means 33.
            frames: End after so many lit frames.
            publish: Takes every frame, on the host's own thread.
            notify: Takes what else viewers should know, on any thread.

        Raises:
            WarpArError: The source cannot be opened, or no plan be made for it. A capture device that is not there is
                waited for, unless ``frames`` are counted: a viewer may bring a camera.
        """
        self._notify = notify
        self._given_source = source
        self._budget = BudgetSetting(notify)
        if quality == AUTO:
            self._budget.switch(budget_ms or self._budget.last_budget)
        self._preset = PRESETS[DEFAULT_PRESET] if quality == AUTO else resolve_quality(quality)
        wanted = Wanted(scene, self._budget.start_quality() if quality == AUTO else self._preset)
        self._original = wanted
        feed = open_feed(scene, source)
        if isinstance(feed.source, NoCamera) and frames is not None:
            raise feed.source.error
        self._controls = Controls(feed, wanted, notify)
        self._folder = tempfile.TemporaryDirectory(prefix="warp_ar_live_")
        self._recorder = Recorder(Path(self._folder.name))
        self._dropped, self._dropping = DroppedFiles(Path(self._folder.name)), threading.Lock()
        try:
            self._lighting = Lighting(self._controls, device, notify, lambda: self._budget.switch(None))
        except BaseException:
            self._controls.close()
            self._folder.cleanup()
            raise
        self._camera = BrowserCamera(self._controls, notify)
        self._looker = ThreadPoolExecutor(1, "warp-ar-board")
        self._calibration = CalibrationSession(self._looker, notify, self._use_calibrated)
        self._setup = SetupChecks(self._controls, self._looker, notify, Path(self._folder.name))
        helpers = Helpers(self._lighting, self._budget, self._camera, self._calibration, self._recorder, self._setup)
        self._loop = FrameLoop(self._controls, helpers, frames=frames, publish=publish, notify=notify)
        self.run = self._loop.run
        """Light frames until told to stop; blocks."""

    # ------------------------------------------------------------------------------------------------- what viewers ask

    @property
    def latest(self) -> Lit | None:
        """The newest frame."""
        return self._loop.latest

    @property
    def no_camera(self) -> NoCamera | None:
        """What is said while there is no camera; None while there are frames."""
        source = self._controls.feed.source
        return source if isinstance(source, NoCamera) else None

    @property
    def description(self) -> str:
        """The source in one line, without its folder."""
        return self._controls.feed.source.description.rsplit("/", 1)[-1]

    def watch(self, change: int) -> None:
        """One viewer more (1) or less (-1): without any, no frame is lit."""
        self._controls.watch(change)

    def stop(self) -> None:
        """End ``run`` after the frame in hand."""
        self._controls.stop()

    def wanted(self) -> Wanted:
        """What viewers see now, or will once it is built."""
        return self._controls.wanted

    def edit(self, command: protocol.Command, owner: object = None) -> None:
        """Do what a page asks for.

        Args:
            command: What.
            owner: Who asks; matters for the camera only.

        Raises:
            WarpArError: It cannot be done; nothing has changed.
        """
        controls = self._controls
        match command:
            case protocol.Undo():
                controls.undo()
            case protocol.Redo():
                controls.redo()
            case protocol.Outline(kind, points):
                self._point_out(kind, points)
            case protocol.SetQuality(name):
                self._set_budget(self._budget.last_budget if name == AUTO else None, name)
            case protocol.Budget(ms):
                self._set_budget(ms, self._preset.name)
            case protocol.OpenScene(name):
                self._open_scene(name)
            case _:
                if (made := edits.make_edit(command, self._original, self._loop.seconds)) is not None:
                    controls.change(*made)
                else:
                    self._control(command, owner)

    def _control(self, command: protocol.Command, owner: object) -> None:
        """Do what is no edit of the scene."""
        match command:
            case protocol.Compare(other):
                self._controls.set_compare(other)
            case protocol.Play(on):
                self._controls.play(on)
            case protocol.Record(on):
                if on:
                    self._recorder.start(self._controls.feed.source.fps)
                else:
                    self._recorder.stop()
            case protocol.UseCamera(width, height):
                self._camera.use(width, height, owner)
                return
            case protocol.LeaveCamera():
                self.leave_camera(owner)
                return
            case protocol.Calibrate(step):
                self._calibration.step(step)
                return
            case protocol.Setup(step):
                self._setup.step(step)
                return
        self._notify(self.state_message())

    def _set_budget(self, budget: float | None, preset: str) -> None:
        """Keep to a budget, or with None show a preset."""
        with self._controls.changed:  # of two viewers who ask at once, both parts are those of one
            if budget is None:
                quality = self._preset = resolve_quality(preset)
            else:
                running = self._controls.wanted.quality
                quality = running if self._budget.rules(running) else self._budget.start_quality()
            self._budget.switch(budget)
            self._controls.change(lambda w: dataclasses.replace(w, quality=quality))
        self._notify(self.state_message())

    def _point_out(self, kind: str, points: tuple[tuple[float, float], ...]) -> None:
        """Model a part of the desk that four points of the newest frame outline."""
        lit = self._loop.latest
        if lit is None or lit.pose is None:
            raise UsageError("the marker is not seen, so no point of the picture has a place: show it first")
        proxy = point_out(lit.camera, lit.pose, kind, points)
        self._controls.change(
            lambda w: dataclasses.replace(w, scene=edits.add_item(w.scene, "proxy", proxy)), f"point out a {kind}"
        )
        sides = " x ".join(f"{1e3 * side:.0f}" for side in proxy.size)
        text = f"{kind.capitalize()} of {sides} mm: as the four points have it; its numbers and handles edit it."
        self._notify(notice(text))

    def _open_scene(self, name: str) -> None:
        if name not in bundled_scenes():
            raise UsageError(f"no bundled scene {name!r}; expected {', '.join(bundled_scenes())}")
        scene = load_scene(name)
        running = self._controls.wanted.quality
        quality = self._budget.start_quality() if self._budget.rules(running) else running
        wanted = self._original = Wanted(scene, quality, cameras=self._controls.wanted.cameras)
        self._budget.forget_costs()
        if self._controls.feed.is_browser or self._given_source is not None:
            self._controls.start_anew(wanted)
        else:
            self._controls.switch(open_feed(scene, None, wanted))

    # ----------------------------------------------------------------------------------------------- the page's camera

    def leave_camera(self, owner: object) -> None:
        """Back to the scene's own source, if ``owner``'s camera is the source."""
        if not self._camera.is_of(owner):
            return
        scene = self._controls.wanted.scene
        try:
            feed = open_feed(scene, self._given_source)
        except WarpArError as error:
            # Such as a scene without a source, or one whose file has gone: others may bring a camera.
            self._notify(failure(error))
            absent = error if isinstance(error, SourceError) else SourceError(str(error))
            feed = Feed(NoCamera((scene.camera.width, scene.camera.height), absent))
        self._camera.leave(feed)

    def camera_size(self, owner: object) -> tuple[int, int] | None:
        """Size of the pictures that ``owner`` may push now; None if it is not the source."""
        return self._camera.size(owner)

    def push(self, taken: protocol.Picture, owner: object) -> None:
        """Take a picture of a browser's camera; blocks while it is decoded.

        Raises:
            ProtocolError: It cannot be decoded.
        """
        self._camera.push(taken, owner)

    def _use_calibrated(self, camera: Any) -> None:
        known = self._controls.camera_of(self._controls.feed)
        self._camera.stop_estimating()
        self._controls.change(lambda w: w.with_camera(calibration.with_transfer(camera, known)), "calibrate the camera")

    def drop(self, name: str, data: bytes) -> str:
        """Take a file that a viewer dropped onto the picture; what is to be said about it.

        Raises:
            WarpArError: It cannot be used; nothing has changed.
        """
        with self._dropping:
            make, label, words = self._dropped.take(name, data, self._controls.wanted)
            self._controls.change(make, label)
        return words

    # ------------------------------------------------------------------------------------------------ what can be saved

    def camera_file(self) -> bytes:
        """The calibrated camera as OpenCV's YAML.

        Raises:
            UsageError: None was calibrated.
        """
        return self._calibration.camera_file()

    def card(self, paper: str) -> bytes:
        """The card to print, a PDF of a paper that ``input.card`` knows."""
        return calibration.card_pdf(paper)

    def response_file(self) -> bytes:
        """The response that was measured by the card's greys, as text.

        Raises:
            UsageError: None was measured.
        """
        return self._setup.response_file()

    def recording(self) -> bytes:
        """The finished recording, an MP4.

        Raises:
            UsageError: There is none.
        """
        return self._recorder.video()

    def snapshot(self) -> bytes:
        """The newest frame as a PNG.

        Raises:
            UsageError: There was none.
        """
        latest = self._loop.latest
        if latest is None:
            raise UsageError("no frame has been lit yet")
        return bytes(cv2.imencode(".png", latest.image[..., ::-1])[1])

    def environment_exr(self) -> bytes:
        """The environment as an EXR.

        Raises:
            UsageError: It is not known.
        """
        light = self._loop.light
        if light is None:
            raise UsageError(
                "the environment is not captured: no stage of this scene reads it, or the marker was not seen"
            )
        return calibration.written("environment.exr", lambda path: write_environment(path, light))

    def light_state(self) -> LightState | None:
        """The environment with what is known of it; None while it is not captured."""
        return self._loop.light_state

    def scene_toml(self, *, full_paths: bool) -> str:
        """The scene as it is shown, as a scene file.

        Args:
            full_paths: Write the paths of files in full; else relative to the scene's folder where they lie in it.
        """
        scene = make_target(self._controls.wanted, self._controls.feed).scene
        # What was measured or dropped here is saved beside the scene.
        scene = edits.beside(scene, Path(self._folder.name))
        folder = None if full_paths or scene.path is None else scene.path.parent
        return dumps_scene(dataclasses.replace(scene, path=None), folder)

    def scene_bundle(self) -> bytes:
        """The scene as it is shown, with all files that it names, as a ZIP.

        Raises:
            WarpArError: One of them cannot be read any more.
        """
        return pack_scene(make_target(self._controls.wanted, self._controls.feed).scene)

    # ---------------------------------------------------------------------------------------------------- what is told

    def greetings(self) -> list[dict[str, Any]]:
        """All that a new viewer should know."""
        return [
            self.plan_message(),
            self.scene_message(),
            self._budget.record(),
            self.calibration_message(),
            self._setup.message(),
            self.state_message(),
        ]

    def scene_message(self) -> dict[str, Any]:
        """The scene as it is edited."""
        return self._controls.scene_message()

    def plan_message(self) -> dict[str, Any]:
        """The stages that run, and why the others do not."""
        return self._lighting.plan_message()

    def calibration_message(self) -> dict[str, Any]:
        """How far the calibration of the camera has come."""
        return self._calibration.message()

    def state_message(self) -> dict[str, Any]:
        """What changes by itself."""
        controls, lighting, budget = self._controls, self._lighting, self._budget
        return {
            "type": "state",
            "fps": round(self._loop.fps, 2),
            "source": self.description,
            "camera": controls.feed.is_browser,
            "estimating": self._camera.estimating,
            "lens": self._lens(),
            "missing": self._missing(),
            "playing": controls.playing,
            "recording": self._recorder.count,
            "building": lighting.doing(),
            "compare": controls.compare,
            "compare_ready": lighting.compare_ready or self._loop.convergence.status is not None,
            "convergence": self._loop.convergence.status,
            "budget": budget.budget,
            "auto": budget.state(),
            "costs": budget.costs(),
            "watchers": controls.watchers,
            "difference": self._loop.difference,
        }

    def _missing(self) -> dict[str, str] | None:
        """Why there are no frames, why the marker is not seen in them, or why no object is."""
        absent = self.no_camera  # once: another source may come meanwhile
        missing = (self._setup.missing or self._setup.outside) if absent is None else absent.finding
        return None if missing is None else {"name": missing.name, "text": missing.text, "remedy": missing.remedy}

    def _lens(self) -> str:
        """Where the camera's numbers come from: calibrated, given by the scene, estimated, or guessed."""
        controls = self._controls
        feed, wanted = controls.feed, controls.wanted
        if wanted.camera_of(feed.source.size) is not None:
            return "calibrated"
        if feed.camera is not None:
            return "estimated" if self._camera.estimated else "guessed"
        return "given" if wanted.scene.camera.field_of_view is None else "guessed"

    def light(self) -> npt.NDArray[np.float32] | None:
        """The environment, latlong linear RGB, as it was a moment ago."""
        return self._loop.light

    def close(self, *, wait_seconds: float | None = None, frames_ended: bool = True) -> bool:
        """Let the source, the pipelines and all temporary files go.

        Args:
            wait_seconds: How long to wait for pipelines that are being built; None waits until they are.
            frames_ended: Whether ``run`` has ended; if it is at a frame still, its pipeline is left to it.

        Returns:
            Whether all threads have ended; those that have not end with what they are at.
        """
        self._budget.stop()
        with contextlib.suppress(WarpArError):  # a recording that cannot be finished goes with its folder
            self._recorder.stop()
        self._controls.close()
        ended = frames_ended and self._lighting.close(wait_seconds)
        self._looker.shutdown(wait=ended)
        with contextlib.suppress(OSError):  # a thread that has not ended may still write into it
            self._folder.cleanup()
        return ended
