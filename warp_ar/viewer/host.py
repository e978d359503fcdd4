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

from warp_ar.checks.pointed_shape import point_out
from warp_ar.engine.pipeline import resolve_quality
from warp_ar.errors import SourceError, UsageError, WarpArError
from warp_ar.output.sinks import write_environment
from warp_ar.scene import Camera, Scene, bundled_scenes, dumps_scene, load_scene
from warp_ar.stages.quality import AUTO, DEFAULT_PRESET, PRESETS, Quality
from warp_ar.viewer import edits
from warp_ar.viewer.budget import BudgetSetting
from warp_ar.viewer.camera import BrowserCamera, CalibrationSession, card_pdf, written
from warp_ar.viewer.controls import Controls, Feed, NoCamera, open_feed
from warp_ar.viewer.edits import Wanted
from warp_ar.viewer.frames import FrameLoop, Helpers, Lit, Recorder
from warp_ar.viewer.light_record import LightState
from warp_ar.viewer.lighting import Lighting, make_target
from warp_ar.viewer.messages import Notify, failure, notice
from warp_ar.viewer.protocol import Command
from warp_ar.viewer.setup import SetupChecks
from warp_ar.viewer.uploads import DroppedFiles, pack_scene


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
        self._doing: dict[str, Callable[..., None]] = {
            "undo": self._controls.undo,
            "redo": self._controls.redo,
            "outline": self._point_out,
            "quality": self._choose_quality,
            "budget": self._set_budget,
            "scene": self._open_scene,
            "compare": self._controls.set_compare,
            "play": self._controls.play,
            "record": self._record,
            "calibrate": self._calibration.step,
            "setup": self._setup.step,
        }
        self.run = self._loop.run
        """Light frames until told to stop; blocks."""
        self.stop = self._controls.stop
        """End ``run`` after the frame in hand."""
        self.watch = self._controls.watch
        """Count one viewer more (1) or less (-1): without any, no frame is lit."""
        self.push, self.camera_size = self._camera.push, self._camera.size
        """Take a picture of a browser's camera; size of the pictures that a viewer may push."""
        self.scene_message, self.plan_message = self._controls.scene_message, self._lighting.plan_message
        """Messages of the scene as it is edited, and of the stages that run."""

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

    def wanted(self) -> Wanted:
        """What viewers see now, or will once it is built."""
        return self._controls.wanted

    def edit(self, command: Command, owner: object = None) -> None:
        """Carry out a command of a page.

        Args:
            command: Command, checked.
            owner: Viewer that asks; matters for the camera only.

        Raises:
            WarpArError: It cannot be done; nothing has changed.
        """
        if (made := edits.make_edit(command, self._original, self._loop.seconds)) is not None:
            self._controls.change(*made)
        elif command.type in ("camera", "no_camera"):
            use = self._camera.use if command.type == "camera" else self.leave_camera
            use(**command.fields, owner=owner)
        else:
            self._doing[command.type](**command.fields)
            if command.type in ("compare", "play", "record", "quality", "budget"):
                self._notify(self.state_message())

    def _record(self, on: bool) -> None:
        if on:
            self._recorder.start(self._controls.feed.source.fps)
        else:
            self._recorder.stop()

    def _choose_quality(self, name: str) -> None:
        self._set_budget(self._budget.last_budget if name == AUTO else None, name)

    def _set_budget(self, ms: float | None, preset: str | None = None) -> None:
        """Keep to a budget, or with None show a preset: the last one that was chosen, if none is named."""
        with self._controls.changed:  # of two viewers who ask at once, both parts are those of one
            if ms is None:
                quality = self._preset = resolve_quality(preset or self._preset.name)
            else:
                running = self._controls.wanted.quality
                quality = running if self._budget.rules(running) else self._budget.start_quality()
            self._budget.switch(ms)
            self._controls.change(lambda w: dataclasses.replace(w, quality=quality))

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
        """Go back to the scene's own source, if ``owner``'s camera is the source."""
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

    def _use_calibrated(self, camera: Camera) -> None:
        known = self._controls.camera_of(self._controls.feed)
        self._camera.stop_estimating()
        camera = dataclasses.replace(camera, transfer=known.transfer)  # which a board does not tell
        self._controls.change(lambda w: w.with_camera(camera), "calibrate the camera")

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

    def downloads(self, *, full_paths: bool) -> dict[str, tuple[str, Callable[[], bytes]]]:
        """Return the type and the maker of every file that can be saved, by its name.

        A maker raises a WarpArError where there is no such file yet.

        Args:
            full_paths: Write the paths of a scene's files in full, as for ``scene_toml``.
        """
        return {
            "frame.png": ("image/png", self.snapshot),
            "environment.exr": ("image/x-exr", self.environment_exr),
            "scene.toml": ("application/toml", lambda: self.scene_toml(full_paths=full_paths).encode()),
            "scene.zip": (
                "application/zip",
                lambda: pack_scene(make_target(self._controls.wanted, self._controls.feed).scene),
            ),
            "recording.mp4": ("video/mp4", self._recorder.video),
            "camera.yml": ("application/yaml", self._calibration.camera_file),
            "response.txt": ("text/plain", self._setup.response_file),
            "card-a4.pdf": ("application/pdf", lambda: card_pdf("a4")),
            "card-letter.pdf": ("application/pdf", lambda: card_pdf("letter")),
        }

    def snapshot(self) -> bytes:
        """Return the newest frame as a PNG.

        Raises:
            UsageError: There was none.
        """
        latest = self._loop.latest
        if latest is None:
            raise UsageError("no frame has been lit yet")
        return cv2.imencode(".png", latest.image[..., ::-1])[1].tobytes()

    def environment_exr(self) -> bytes:
        """Return the environment as an EXR.

        Raises:
            UsageError: It is not known.
        """
        state = self._loop.light_state
        if state is None:
            raise UsageError(
                "the environment is not captured: no stage of this scene reads it, or the marker was not seen"
            )
        return written("environment.exr", lambda path: write_environment(path, state.radiance))

    def scene_toml(self, *, full_paths: bool) -> str:
        """Return the scene as it is shown, as a scene file.

        Args:
            full_paths: Write the paths of files in full; else relative to the scene's folder where they lie in it.
        """
        scene = make_target(self._controls.wanted, self._controls.feed).scene
        # What was measured or dropped here is saved beside the scene.
        scene = edits.beside(scene, Path(self._folder.name))
        folder = None if full_paths or scene.path is None else scene.path.parent
        return dumps_scene(dataclasses.replace(scene, path=None), folder)

    # ---------------------------------------------------------------------------------------------------- what is told

    @property
    def light_state(self) -> LightState | None:
        """The environment as it was a moment ago, and what is known of it; None while it is not captured."""
        return self._loop.light_state

    def greetings(self) -> list[dict[str, Any]]:
        """All that a new viewer should know."""
        return [
            self.plan_message(),
            self.scene_message(),
            self._budget.record(),
            self._calibration.message(),
            self._setup.message(),
            self.state_message(),
        ]

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
