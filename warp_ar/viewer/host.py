"""Host of the page: executes viewers' commands, renders frames, and makes files for download."""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import tempfile
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final

import numpy as np

from warp_ar.checks.pointed_shape import point_out
from warp_ar.device import exclusive
from warp_ar.engine.pipeline import TRACK, Pipeline, Result, resolve_quality
from warp_ar.errors import SourceError, UsageError, WarpArError
from warp_ar.scene import Camera, Pose, Scene, bundled_scenes, dumps_scene, load_scene
from warp_ar.scene.object_shapes import object_shapes
from warp_ar.signature import encode_png
from warp_ar.sources.source import Frame, Source
from warp_ar.stages.quality import AUTO, DEFAULT_PRESET, PRESETS, Quality
from warp_ar.tracking.tracking import TrackState, given_pose, tell_missing_poses
from warp_ar.viewer import edits
from warp_ar.viewer.budget import START, BudgetSetting
from warp_ar.viewer.controls import (
    BrowserCamera,
    Controls,
    Feed,
    Image,
    NoCamera,
    Pushed,
    guessed_camera,
    open_feed,
)
from warp_ar.viewer.edits import Wanted
from warp_ar.viewer.light_record import LightState
from warp_ar.viewer.lighting import Convergence, Lighting, make_target
from warp_ar.viewer.protocol import CONVERGING, Command, Notify, failure, notice
from warp_ar.viewer.setup import CalibrationSession, SetupChecks, card_pdf, page_record
from warp_ar.viewer.uploads import DroppedFiles, pack_scene

PLAY_RATE: Final = 30.0
"""Frame rate assumed at a change of source: the new source's frames start 1 / PLAY_RATE s after the last frame."""
_LIGHT_SECONDS: Final = 0.25
"""Shortest time between two copies of the environment to the host, seconds."""
_MEASURING_REST: Final = 0.15
"""Pause between frames while methods are timed, as concurrent work distorts the times, seconds."""
_STILL_SECONDS: Final = 0.25
"""Time between renderings of a held frame without edits, seconds."""
_BUILDING_SECONDS: Final = 0.03
"""Time between renderings of a held frame while a pipeline is built, seconds."""
_NOTICE_SECONDS: Final = 5.0
"""Shortest time between two notices of frames that cannot be lit, seconds."""


@dataclasses.dataclass(frozen=True, eq=False)
class Lit:
    """Lit frame with its metadata, as sent to viewers."""

    id: int
    """Number of the frame since the page was started."""
    taken: float
    """Time of capture, or for a recorded frame the time at which it was due, seconds of ``time.monotonic``."""
    stamp: float | None
    """Time of capture by a browser's camera, milliseconds on the browser's own clock; None from other sources."""
    image: Image
    """Lit picture, uint8 RGB; the camera's picture while no pipeline is ready."""
    other: Image | None
    """Picture to compare with."""
    frame: Image
    """Picture of the camera."""
    pose: Pose | None
    """``camera_from_world``."""
    state: TrackState | None
    camera: Camera
    stages: tuple[tuple[str, float, bool], ...]
    """(name, milliseconds, True if the stage was skipped) of each stage."""
    light_ms: float
    """Time to render the frame, milliseconds."""
    plan: int
    """Number of the plan that lit the frame; 0 if none did."""


class Host:
    """Renderer of frames as viewers request them.

    Every method may be called from any thread, except ``run``, which lights the frames.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        source: str | int | Path | None = None,
        device: str = "auto",
        quality: str | Quality = DEFAULT_PRESET,
        budget_ms: float | None = None,
        frames: int | None = None,
        by_card: bool = False,
        publish: Callable[[Lit], None] = lambda lit: None,
        notify: Notify = lambda message: None,
    ) -> None:
        """Open the source; pipelines are built while ``run`` shows its frames.

        Args:
            scene: The scene to begin with.
            source: Source of frames that replaces the scene's own.
            device: ``auto``, ``cpu`` or ``cuda:N``.
            quality: A preset's name, a ``Quality``, or ``auto``.
            budget_ms: Milliseconds per frame for ``auto``; None means 33.
            frames: Number of lit frames after which ``run`` ends; None sets no end.
            by_card: True lights the scene by the printed card as soon as frames show it.
            publish: Receiver of every frame, called on the thread of ``run``.
            notify: Receiver of other messages for viewers, called on any thread.

        Raises:
            WarpArError: The source cannot be opened, or no plan can be made for it. An absent capture device is an
                error only if ``frames`` is given; otherwise a viewer may use its own camera.
        """
        self._given_source = source
        self._budget = BudgetSetting(notify)
        if quality == AUTO:
            self._budget.switch(budget_ms or self._budget.last_budget)
        self._preset = PRESETS[DEFAULT_PRESET] if quality == AUTO else resolve_quality(quality)
        wanted = Wanted(scene, START if quality == AUTO else self._preset)
        self._original = wanted
        feed = open_feed(scene, source)
        if isinstance(feed.source, NoCamera) and frames is not None:
            raise feed.source.error
        self._folder = tempfile.TemporaryDirectory(prefix="warp_ar_live_")
        folder, controls = Path(self._folder.name), Controls(feed, wanted, notify)
        try:
            self._lighting = Lighting(controls, device, notify, lambda: self._budget.switch(None))
        except BaseException:
            controls.close()
            self._folder.cleanup()
            raise
        self._controls, self._camera = controls, BrowserCamera(controls, notify)
        self._looker = ThreadPoolExecutor(1, "warp-ar-board")
        self._calibration = CalibrationSession(self._looker, notify, self._use_calibrated)
        self._setup = SetupChecks(controls, self._looker, notify, folder)
        self._frames, self._publish, self._notify = frames, publish, notify
        self._id = self._lit = self._plan = 0
        self._base = self._at = self._busy_ms = 0.0
        self._light_time = self._notice_time = 0.0
        self.seconds = 0.0
        """Time of the newest lit frame since the first, seconds: the time of animations."""
        self._times: collections.deque[float] = collections.deque(maxlen=60)
        self._compared = ""
        self._hits: tuple[Any, Scene] | None = None
        """Index of the shape in each pixel of the newest frame, and the scene that these indices refer to."""
        self.convergence = Convergence()
        """Reference of a held frame."""
        self.latest: Lit | None = None
        """Newest frame."""
        self.light_state: LightState | None = None
        """Newest copy of the environment with its status; None while unknown."""
        if by_card:
            self._setup.step("light")
        self._uploads, self._uploading = DroppedFiles(folder), threading.Lock()
        self._doing: dict[str, Callable[..., None]] = {
            "undo": controls.undo,
            "redo": controls.redo,
            "outline": self._point_out,
            "quality": self._choose_quality,
            "budget": self._set_budget,
            "scene": self._open_scene,
            "compare": controls.set_compare,
            "play": controls.play,
            "calibrate": self._calibration.step,
            "setup": self._setup.step,
        }
        self.stop = controls.stop
        """End ``run`` after the present frame."""
        self.watch = controls.watch
        """Count one viewer more (1) or less (-1). Frames are lit only while there is a viewer."""
        self.push, self.camera_size = self._camera.push, self._camera.size
        """Queue a picture of a browser's camera; return the size of pictures that a viewer may push."""
        self.scene_message, self.plan_message = controls.scene_message, self._lighting.plan_message
        """Return the message of the edited scene; return the message of the running stages."""

    # ------------------------------------------------------------------------------------------------ viewers' commands

    @property
    def no_camera(self) -> NoCamera | None:
        """Substitute source of an absent camera; None while there are frames."""
        source = self._controls.feed.source
        return source if isinstance(source, NoCamera) else None

    def wanted(self) -> Wanted:
        """Return the state that viewers see, at the latest once its pipeline is built."""
        return self._controls.wanted

    def edit(self, command: Command, owner: object = None) -> None:
        """Carry out a command of a page.

        Args:
            command: Checked command.
            owner: Viewer that sent the command; used only by commands for its camera.

        Raises:
            WarpArError: The command cannot be carried out; nothing has changed.
        """
        if (made := edits.make_edit(command, self._original, self.seconds)) is not None:
            self._controls.change(*made)
        elif command.type in ("camera", "no_camera"):
            use = self._camera.use if command.type == "camera" else self.leave_camera
            use(**command.fields, owner=owner)
        else:
            self._doing[command.type](**command.fields)
            if command.type in ("compare", "play", "quality", "budget"):
                self._notify(self.state_message())

    def _choose_quality(self, name: str) -> None:
        self._set_budget(self._budget.last_budget if name == AUTO else None, name)

    def _set_budget(self, ms: float | None, preset: str | None = None) -> None:
        """Set a budget, milliseconds per frame, or with None use a preset: the named one, else the last chosen one."""
        with self._controls.changed:  # so that two viewers' changes of budget and quality cannot mix
            if ms is None:
                quality = self._preset = resolve_quality(preset or self._preset.name)
            else:
                running = self._controls.wanted.quality
                quality = running if running.name == AUTO else START
            self._budget.switch(ms)
            self._controls.change(lambda w: dataclasses.replace(w, quality=quality))

    def _point_out(self, kind: str, points: tuple[tuple[float, float], ...]) -> None:
        """Add a proxy for the part of the desk that four points of the newest frame outline, pixels."""
        lit = self.latest
        if lit is None or lit.pose is None:
            raise UsageError("the marker is not seen, so points of the picture cannot be located: show it first")
        proxy = point_out(lit.camera, lit.pose, kind, points)
        self._controls.change(
            lambda w: dataclasses.replace(w, scene=edits.add_item(w.scene, "proxy", proxy)), f"point out a {kind}"
        )
        sides = " x ".join(f"{1e3 * side:.0f}" for side in proxy.size)
        text = f"{kind.capitalize()} of {sides} mm: from the four points; edit it by its numbers and handles."
        self._notify(notice(text))

    def _open_scene(self, name: str) -> None:
        if name not in bundled_scenes():
            raise UsageError(f"no bundled scene {name!r}; expected {', '.join(bundled_scenes())}")
        scene = load_scene(name)
        running = self._controls.wanted.quality
        quality = START if running.name == AUTO else running
        wanted = self._original = Wanted(scene, quality, cameras=self._controls.wanted.cameras)
        self._budget.forget_costs()
        if self._controls.feed.is_browser or self._given_source is not None:
            self._controls.start_anew(wanted)
        else:
            self._controls.switch(open_feed(scene, None, wanted))

    # ----------------------------------------------------------------------------------------------- the page's camera

    def leave_camera(self, owner: object) -> None:
        """Return to the scene's own source if the camera of the viewer ``owner`` is the source."""
        if not self._camera.is_of(owner):
            return
        scene = self._controls.wanted.scene
        try:
            feed = open_feed(scene, self._given_source)
        except WarpArError as error:
            # For example a scene without a source, or with a deleted file. Another viewer may use its camera.
            self._notify(failure(error))
            absent = error if isinstance(error, SourceError) else SourceError(str(error))
            feed = Feed(NoCamera((scene.camera.width, scene.camera.height), absent))
        self._controls.switch(feed)

    def drop(self, name: str, data: bytes) -> str:
        """Add a file that a viewer dropped onto the picture to the scene.

        Returns:
            Description of the change, for the viewer.

        Raises:
            WarpArError: The file cannot be used; nothing has changed.
        """
        with self._uploading:
            make, label, words = self._uploads.take(name, data, self._controls.wanted)
            self._controls.change(make, label)
        return words

    # -------------------------------------------------------------------------------------------------------- downloads

    def downloads(self, *, full_paths: bool) -> dict[str, tuple[str, Callable[[], bytes]]]:
        """Return a dictionary from file name to (media type, function that makes the content).

        The function raises a WarpArError if the content does not exist yet.

        Args:
            full_paths: True writes full paths of a scene's files, see ``scene_toml``.
        """
        return {
            "frame.png": ("image/png", self.snapshot),
            "scene.toml": ("application/toml", lambda: self.scene_toml(full_paths=full_paths).encode()),
            "scene.zip": (
                "application/zip",
                lambda: pack_scene(make_target(self._controls.wanted, self._controls.feed).scene),
            ),
            "camera.yml": ("application/yaml", self._calibration.camera_file),
            "response.txt": ("text/plain", self._setup.response_file),
            "card-a4.pdf": ("application/pdf", lambda: card_pdf("a4")),
            "card-letter.pdf": ("application/pdf", lambda: card_pdf("letter")),
        }

    def snapshot(self) -> bytes:
        """Return the newest frame as a PNG.

        Raises:
            UsageError: No frame has been lit yet.
        """
        if (latest := self.latest) is None:
            raise UsageError("no frame has been lit yet")
        return encode_png(latest.image)

    def scene_toml(self, *, full_paths: bool) -> str:
        """Return the shown scene as the text of a scene file.

        Args:
            full_paths: True writes full paths of files; False writes them relative to the scene's folder if they lie
                in it.
        """
        scene = make_target(self._controls.wanted, self._controls.feed).scene
        # Measured and dropped files are named as files of the scene's own folder, where users will save them.
        scene = edits.with_bare_names(scene, Path(self._folder.name))
        folder = None if full_paths or scene.path is None else scene.path.parent
        return dumps_scene(dataclasses.replace(scene, path=None), folder)

    # --------------------------------------------------------------------------------------------------------- messages

    def greetings(self) -> list[dict[str, Any]]:
        """Return the messages for a new viewer."""
        return [
            self.plan_message(),
            self.scene_message(),
            self._budget.record(),
            self._calibration.message(),
            self._setup.message(),
            self.state_message(),
        ]

    def state_message(self) -> dict[str, Any]:
        """Return the message of values that change without a viewer's command."""
        controls, lighting, budget = self._controls, self._lighting, self._budget
        return {
            "type": "state",
            "fps": round(self.fps, 2),
            "source": controls.feed.source.description.rsplit("/", 1)[-1],  # a file without its folders
            "camera": controls.feed.is_browser,
            "lens": self._lens(),
            "missing": self._missing(),
            "ball": self._setup.ball,
            "playing": controls.playing,
            "building": lighting.doing(),
            "compare": controls.compare,
            "compare_ready": lighting.compare_ready or self.convergence.status is not None,
            "convergence": self.convergence.status,
            "budget": budget.budget,
            "load": budget.load,
            "costs": budget.costs(),
        }

    def _missing(self) -> dict[str, str] | None:
        """Return the reason for missing frames, a marker that is not visible, or objects outside the picture."""
        absent = self.no_camera  # read once, as another thread may change the source
        return self._setup.guide() if absent is None else page_record(absent.finding)

    def _lens(self) -> str:
        """Return the origin of the camera's numbers: calibrated, given by the scene, estimated, or guessed."""
        controls = self._controls
        feed, wanted = controls.feed, controls.wanted
        if wanted.camera_of(feed.source.size) is not None:
            return "calibrated"
        if feed.camera is not None:
            return "estimated" if feed.estimated else "guessed"
        return "given" if wanted.scene.camera.field_of_view is None else "guessed"

    def close(self, *, wait_seconds: float | None = None, frames_ended: bool = True) -> bool:
        """Close the source and the pipelines, and delete all temporary files.

        Args:
            wait_seconds: Longest wait for pipelines that are being built; None waits until they are.
            frames_ended: False while ``run`` still renders a frame; pipelines are then not closed.

        Returns:
            True if all threads have ended. Remaining threads end after their present task.
        """
        self._budget.stopped = True
        self._controls.close()
        ended = frames_ended and self._lighting.close(wait_seconds)
        self._looker.shutdown(wait=ended)
        with contextlib.suppress(OSError):  # a thread that has not ended may still write into it
            self._folder.cleanup()
        return ended

    # ---------------------------------------------------------------------------------------------------------- frames

    def _use_calibrated(self, camera: Camera) -> None:
        controls = self._controls
        transfer = controls.feed.camera_for(controls.wanted).transfer  # a board does not measure it
        camera = dataclasses.replace(camera, transfer=transfer)
        controls.change(lambda w: w.with_camera(camera), "calibrate the camera")

    @property
    def fps(self) -> float:
        """Mean frame rate of the last 60 frames, 1 / s."""
        times = list(self._times)
        return (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 and times[-1] > times[0] else 0.0

    def pick(self, x: float, y: float, reach: float) -> int | None:
        """Return the index of the object at a pixel of the newest frame, or nearest to it. From any thread.

        Args:
            x: Column of the pixel; centres lie at integers.
            y: Row of the pixel.
            reach: Largest distance from the pixel to the object, pixels.

        Returns:
            Index of the object; None if none is within reach.
        """
        if self._hits is None:
            return None
        hits, scene = self._hits
        with exclusive(hits.device):
            seen = hits.numpy()
        left, top = (max(int(value - reach) - 1, 0) for value in (x, y))
        near = seen[top : max(int(y + reach) + 2, 0), left : max(int(x + reach) + 2, 0)]
        rows, columns = np.nonzero(near >= 0)
        distances = np.hypot(columns + left - x, rows + top - y)
        if not len(distances) or distances.min() > max(reach, 0.75):  # half of a pixel's diagonal, and rounding
            return None
        nearest = distances.argmin()
        wanted = self._controls.wanted
        shown = [index for index in range(len(wanted.scene.objects)) if ("object", index) not in wanted.hidden]
        # Pixels hold indices of shapes. An object that its file moves in parts has several shapes.
        number = object_shapes(scene)[near[rows[nearest], columns[nearest]]].index
        return shown[number] if number < len(shown) else None

    def run(self) -> None:
        """Light frames until ``stop`` is called. After a failure of a source, notify viewers and await another one."""
        controls = self._controls
        while not controls.stopped:
            try:
                with controls.feed.source as source:
                    self._run_source(source)
            except Exception as error:
                self._notify(failure(error, "no more frames come from this source"))
            controls.wait()
            controls.adopt()

    def _run_source(self, source: Source) -> None:
        due, previous = time.monotonic(), 0.0
        start: float | None = None
        still: Frame | None = None
        if words := tell_missing_poses(self._controls.wanted.scene.pose, source):
            self._notify(notice(words))
        for frame in source:
            if still is None or frame.exposure_time in (None, *source.exposures[:1]):
                still = frame  # of a bracket's frames, only those of the shown exposure can be held
            if start is None:
                start = self._base - frame.time  # the pipeline's clock never runs back
            if not source.live:
                # A recorded frame waits until it is due. A late frame delays all that follow.
                due = max(due + max(frame.time - previous, 0.0), time.monotonic())
                previous = frame.time
                self._controls.wait(max(due - time.monotonic(), 0.0))
            if not (self._light_frame(frame, frame.time + start) and self._hold(still, frame.time + start)):
                return
            if self._frames is not None and self._lit >= self._frames:
                self._controls.stop()
                return

    def _hold(self, frame: Frame, now: float) -> bool:
        """Wait without viewers; while the page holds a frame, light it again after edits.

        Returns:
            False if the source shall be left, True to continue with the next frame.
        """
        controls = self._controls
        while True:
            with controls.changed:
                idle = controls.watchers == 0 and self._frames is None
                if controls.leaving:
                    return False
                if controls.playing and not idle:
                    return True
                seen = controls.edits
                controls.changed.wait_for(
                    lambda seen=seen, idle=idle: (  # type: ignore[misc]
                        controls.leaving or controls.edits != seen or (controls.playing and not idle)
                    ),
                    timeout=self._rest(idle),
                )
            if controls.watchers == 0:
                self._lighting.follow()  # the wanted pipeline should be ready for the next viewer
            elif not controls.playing and not (self._converge() or self._light_frame(frame, now)):
                return False

    def _rest(self, idle: bool) -> float | None:
        """Return the seconds until a held frame is rendered again; None waits for a viewer."""
        if idle and not self._lighting.busy:
            return None
        if not idle and self._progress() == "running":
            return 0.0
        return _BUILDING_SECONDS if self._lighting.busy else _STILL_SECONDS

    def _held(self) -> tuple[Wanted, int, float]:
        """Return the key of the held picture: state, plan and time. A reference of another key is outdated."""
        return self._controls.wanted, self._plan, self._at

    def _progress(self) -> str:
        """Return the progress of the held frame's reference; empty if none is requested or the lighting changes."""
        controls, latest = self._controls, self.latest
        asked = controls.compare in CONVERGING and not controls.playing and latest is not None and latest.plan != 0
        return self.convergence.progress(self._held()) if asked and not self._lighting.changing else ""

    def _converge(self) -> bool:
        """Add a slice of samples to the reference and publish the pictures.

        The lit picture is kept, because a new one would use light that was captured after the reference began.

        Returns:
            False if the frame must be lit instead.
        """
        progress, compare, latest = self._progress(), self._controls.compare, self.latest
        if latest is None or not progress:
            return False
        shows = compare != self._compared
        if progress == "running":
            try:
                shows = self.convergence.step()
            except Exception as error:
                self._notify(failure(error, "the picture goes on without a reference"))
                return True
        if shows:
            self._id += 1
            other, self._compared = self.convergence.other(self._held(), compare), compare
            self.latest = dataclasses.replace(latest, id=self._id, taken=time.monotonic(), stamp=None, other=other)
            self._publish(self.latest)
        return True

    def _compare_with(self, pipeline: Pipeline, frame: Frame, result: Result, now: float) -> Image | None:
        """Return the picture to compare with the lit one; None if there is none yet."""
        controls, lighting = self._controls, self._lighting
        converges = controls.compare in CONVERGING
        if not converges or controls.playing or lighting.changing:
            self.convergence.drop()
        elif result.pose is not None:
            self.convergence.begin(self._held(), pipeline, frame.image, result, now, lighting.builder)
        self._compared = controls.compare
        if converges:
            return self.convergence.other(self._held(), controls.compare)
        start, other = time.perf_counter(), lighting.other(frame, now)
        if other is not None and controls.playing and controls.compare in PRESETS:
            self._budget.note(controls.compare, (time.perf_counter() - start) * 1e3)
        return other

    def _light_frame(self, frame: Frame, now: float) -> bool:
        """Light one frame and publish it; return False if the source shall be left."""
        if self._controls.leaving:
            return False
        begin = time.perf_counter()
        self._at = now  # seconds on the pipeline's clock, which never runs back: unique for each frame
        pushed = self._camera.begin(frame.image, self._busy_ms)
        plain = self._plain(frame, pushed)
        self._calibration.look(frame.image)
        pipeline = self._lighting.follow()
        if self._lighting.swaps != self._plan:
            self._plan = self._lighting.swaps
            self._budget.restart()
        lit = plain
        try:
            if pipeline is not None and pipeline.size == (frame.image.shape[1], frame.image.shape[0]):
                lit = self._lit_by(pipeline, frame, now, plain)
        except Exception as error:
            self._tell_failure(error)
        self.latest, self._hits = lit, None
        if lit.plan and pipeline is not None and "hit_object" in pipeline.arrays:
            self._hits = pipeline.arrays["hit_object"], pipeline.scene
        self._times.append(time.monotonic())
        if lit.plan:
            self._lighting.note_lit()
            self._setup.note(frame.image, lit.state, lit.pose, self._times[-1], rests=self._calibration.on)
        self._publish(lit)
        self._busy_ms = (time.perf_counter() - begin) * 1e3
        if self._budget.measuring:
            self._controls.wait(_MEASURING_REST)
        return True

    def _tell_failure(self, error: Exception) -> None:
        """Notify viewers of a frame that cannot be lit, and undo the edit that caused the failure.

        Only an unexpected exception undoes the edit since the last lit frame. A ``WarpArError``, for example of an
        unannounced exposure time, concerns the frame and not the edit.
        """
        taken_back = not isinstance(error, WarpArError) and self._lighting.take_back()
        if taken_back or time.monotonic() - self._notice_time > _NOTICE_SECONDS:
            self._notice_time = time.monotonic()
            then = "the edit is taken back and the frames go on" if taken_back else "the frames go on"
            self._notify(failure(error, then))

    def _lit_by(self, pipeline: Pipeline, frame: Frame, now: float, plain: Lit) -> Lit:
        """Return the lit frame."""
        start = time.perf_counter()
        pose = given_pose(pipeline.scene.pose, frame)
        result = pipeline(frame.image, time_seconds=now, pose=pose, exposure_time=frame.exposure_time)
        image = result.image
        light_ms = (time.perf_counter() - start) * 1e3
        self.seconds = float(pipeline.arrays["seconds"]())
        self._base = now + 1.0 / PLAY_RATE
        self._lit += 1
        other = self._compare_with(pipeline, frame, result, now)
        self._look_at_light(pipeline)
        self._watch_cost(pipeline, frame, result, light_ms)
        return dataclasses.replace(
            plain,
            image=image,
            other=other,
            pose=result.pose,
            state=result.state,
            camera=pipeline.camera,
            stages=tuple((name, round(t.milliseconds, 3), t.skipped) for name, t in result.stages.items()),
            light_ms=light_ms,
            plan=self._plan,
        )

    def _plain(self, frame: Frame, pushed: Pushed | None) -> Lit:
        """Return the unlit record of a frame, with its number and time of capture."""
        self._id += 1
        taken, stamp = time.monotonic(), None
        if pushed is not None:
            taken, stamp = pushed.taken, pushed.stamp
        elif self._controls.feed.source.live and self._controls.playing:
            taken = self._controls.feed.source.start + frame.time  # earlier than now if the frame has waited
        camera = self._controls.feed.camera_for(self._controls.wanted)
        size = frame.image.shape[1], frame.image.shape[0]
        if (camera.width, camera.height) != size:
            camera = guessed_camera(*size)
        return Lit(self._id, taken, stamp, frame.image, None, frame.image, None, None, camera, (), 0.0, 0)

    def _look_at_light(self, pipeline: Pipeline) -> None:
        now = time.monotonic()
        if now - self._light_time < _LIGHT_SECONDS:
            return
        self._light_time = now
        arrays = pipeline.arrays
        if (light := arrays.get("environment")) is None:
            self.light_state = None
            return
        with exclusive(pipeline.device):
            values = np.array(light.numpy())
            others = arrays.get("others_environment")
            others = () if others is None else tuple(np.array(others.numpy()))
            scale = arrays.get("expose_scale")
            exposure = 1.0 if scale is None else float(scale.numpy()[0])
        known = arrays.get("recover_status", dict)()
        places = tuple(probe.center for probe in pipeline.scene.probes[: len(others) + 1])
        seen = values.any()  # the map is black until the ball has been seen once
        self.light_state = LightState(values, exposure, known, others, places) if seen else None

    def _watch_cost(self, pipeline: Pipeline, frame: Frame, result: Result, light_ms: float) -> None:
        """Record the frame's time as the preset's cost; under a budget, change to the methods that it chooses."""
        if not result.shown or (result.pose is None and pipeline.plan.needs("pose")):
            return
        controls, budget = self._controls, self._budget
        wanted = controls.wanted
        # Times of held frames, and of a pipeline that is about to be replaced, are not representative.
        steady = not self._lighting.changing and controls.playing and pipeline.quality == wanted.shown_quality()
        budget.look(pipeline, frame.image, result.pose, self._lighting.builder)
        tracking = result.stages[TRACK].milliseconds if TRACK in result.stages else 0.0
        chosen = budget.observe(wanted.quality.name, light_ms if steady else None, tracking)
        if chosen is not None and chosen != wanted.quality:
            budget.forget_costs(chosen.name)
            controls.change(lambda w: dataclasses.replace(w, quality=chosen) if w.quality.name == AUTO else w)
