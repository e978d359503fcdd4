"""``python -m warp_ar.live`` without a page: lights the frames of a source and writes the outputs that options name."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import itertools
import json
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from warp_ar.begin import EXIT_INTERRUPTED, EXIT_TERMINATED, handling, importing
from warp_ar.command_line import EXIT_DONE
from warp_ar.errors import UsageError, WarpArError, counted, printable, reason, say
from warp_ar.files import is_folder, write_whole
from warp_ar.live_start import say_quick_check, start_device
from warp_ar.output.encoders import parse_options
from warp_ar.output.places import check_places, check_replaceable, folder_to_oneself, reads_of
from warp_ar.output.sink import NullSink, Sink, make_folder
from warp_ar.output.sinks import open_sink
from warp_ar.scene import Probe, Scene, load_scene
from warp_ar.signature import PROGRAM
from warp_ar.stages.quality import AUTO

if TYPE_CHECKING:
    from warp_ar.accuracy.traced_frames import TracedFrames
    from warp_ar.session import Session

# Number of frames after which a clip that has shown no marker is given up.
MARKER_PATIENCE = 100
NO_BALL = "no mirror ball was found where [probe] has it"


class RunError(WarpArError):
    """Failure after the first frame was begun."""


def _check_places(options: argparse.Namespace, scene: Scene) -> None:
    """Check that no output replaces a file that is read or another output."""
    names = ("output", "report", "save_environment", "save_layers")
    writes = {f"--{name.replace('_', '-')}": path for name in names if (path := getattr(options, name)) is not None}
    check_places(reads_of(scene, options), {option: Path(path) for option, path in writes.items()})


def reflectances_told(probes: Sequence[Probe], status: Callable[[], Mapping[str, Any]] | None) -> list[str]:
    """Return a line for each ball whose measured reflectance differs from the scene's.

    Args:
        probes: Mirror balls of the scene.
        status: Function that returns the status of the stage ``recover``; None if the stage does not run.
    """
    told = None if status is None else status().get("ball_reflectance")
    lines = []
    for index, (probe, found) in enumerate(zip(probes, told or (), strict=False)):
        if tuple(found) != tuple(round(value, 3) for value in probe.reflectance):
            said, taken = (", ".join(f"{value:.2f}" for value in values) for values in (probe.reflectance, found))
            lines.append(
                f"mirror ball {index} reflects {taken} in the frames; this is used instead of {said} from [probe]"
            )
    return lines


def light_clip(options: argparse.Namespace) -> int:
    """Light a source's frames without a page, and write the outputs that options name.

    Raises:
        UsageError: Options of layers have no folder, or a file to replace was not written by this program.
        RunError: Something failed after the first frame was begun.
    """
    scene = load_scene(options.scene)
    _check_places(options, scene)
    # Imported here because they load Warp: a scene's errors are reported first.
    with importing():
        start_device(options.device)
        import warp_ar.output.report  # noqa: F401
    with contextlib.ExitStack() as stack:
        return _Clip(options, scene, stack).run()


class _Clip:
    """A run to files: the session, its sinks and its checks."""

    def __init__(self, options: argparse.Namespace, scene: Scene, stack: contextlib.ExitStack) -> None:
        """Open the session and all sinks; ``stack`` closes them."""
        from warp_ar.output.report import RunLog

        self.options, self.stack = options, stack
        self.outputs = self._open_side_files()
        self.session = stack.enter_context(self._open_session(scene))
        self.notes = self._report_balls(scene)
        self.ball_seen, self.worst = say_quick_check(options, self.session.scene)
        if not self.ball_seen and options.light is None and self._are_balls_missing():
            self._leave_balls_out()
        for note in (*self.session.notes, self.session.source.note):
            if note:
                say(note)
        self.traced: TracedFrames | None = None
        if options.samples is not None:
            with importing():  # the path tracer's kernels, which other runs do not declare
                from warp_ar.accuracy.traced_frames import TracedFrames
            self.traced = TracedFrames(self.session.pipeline, options.samples, options.error)  # type: ignore[arg-type]
            self.session.ahead = False
        self._compile()
        self.sink = self._open_output()
        if options.output is not None and is_folder(options.output):
            stack.enter_context(folder_to_oneself(Path(options.output)))
        self.camera = self._open_camera()
        for words in (*self.replaced, self.sink.replaced):
            if words:
                say(words)
        self.log = RunLog(self.session.pipeline)
        self.changed = False
        """True once a frame differed from its input."""
        self.views: list[tuple[Any, Any]] = []
        """Some frames with their poses, to search for a ball that the quick check has not seen."""
        self.code: int | None = None
        """Exit code of the signal that asked the run to end; None if there was none."""

    def _open_side_files(self) -> tuple[str, ...]:
        """Open the outputs other than pictures; return the pipeline outputs that they need."""
        from warp_ar.engine.layers import RADIANCE
        from warp_ar.output.layer_file import SideFiles, parse_layers

        options = self.options
        if options.save_layers is None and (options.layers is not None or options.layer_pictures):
            which = "--layer-pictures" if options.layers is None else f"--layers {options.layers}"
            raise UsageError(f"{which} needs --save-layers DIR, the folder to write them to")
        self.side = SideFiles(
            environment=options.save_environment,
            layers=options.save_layers,
            names=parse_layers(options.layers),
            pictures=options.layer_pictures,
            overwrite=options.overwrite,
        )
        self.stack.enter_context(self.side)
        outputs, self.replaced = ["image", *self.side.outputs], list(self.side.replaced)
        if options.coding != "8bit":
            outputs.append(RADIANCE)
        if options.report is not None:
            # A report that cannot be written fails here, before the first frame.
            self.replaced.append(check_replaceable(options.report, overwrite=options.overwrite))
            make_folder(options.report.parent)
            outputs.append("pose")
        return tuple(outputs)

    def _open_session(self, scene: Scene, **changes: Any) -> Session:
        from warp_ar.session import Session

        names = ("source", "calibration", "light", "light_axes", "device", "quality", "budget_ms", "loop")
        given = {name: getattr(self.options, name) for name in names}
        given["refine_ball"] = self.options.refine_ball
        return Session(scene, outputs=self.outputs, **{**given, **changes})

    def _are_balls_missing(self) -> bool:
        from warp_ar.checks.checkup import are_balls_missing

        try:
            return are_balls_missing(self.session.scene, self.options.source)
        except WarpArError:
            return False  # the run itself meets the same error and reports it

    def _leave_balls_out(self) -> None:
        """Continue with the light estimated from the card if the scene's mirror balls are not in the frames.

        Raises:
            RunError: The frames show neither the balls nor the card.
        """
        self.session.close()
        scene = dataclasses.replace(self.session.scene, probes=())
        try:
            given = {"calibration": None, "refine_ball": False, "light": "card"}
            self.session = self.stack.enter_context(self._open_session(scene, **given))
        except (UsageError, ValueError) as error:
            raise RunError(f"{NO_BALL}: {error}") from error
        self.notes["balls_missing"] = f"{NO_BALL}; the card's light is used instead"

    def _report_balls(self, scene: Scene) -> dict[str, Any]:
        """Print how far the mirror balls are from their places in the scene; return the distances for the report."""
        session, found = self.session, []
        balls = zip(session.ball_fits, scene.probes, session.scene.probes, strict=False)
        for index, (fit, before, after) in enumerate(balls):
            offset = [round(1e3 * (b - a), 2) for a, b in zip(before.center, after.center, strict=True)]
            good = fit is not None and fit.is_good
            found.append({"offset_mm": offset, "deviation_mm": round(1e3 * fit.deviation, 2) if fit and good else None})
            left = "kept at the scene's place: it shows too little of the desk"
            say(f"mirror ball {index} {f'moved by {offset} mm' if good else left}")
        return {"balls": found} if found else {}

    def _compile(self) -> None:
        """Load all kernels, with a progress bar if some must be compiled."""
        words = TextColumn("compiling kernels, once for this kind of scene")
        bar = Progress(words, BarColumn(), MofNCompleteColumn(), disable=self.options.headless)
        task = bar.add_task("compile")

        def tell(done: int, total: int) -> None:
            bar.start()
            bar.update(task, completed=done, total=total)

        try:
            self.session.warm_up(tell)
        finally:
            bar.stop()

    def _open_output(self) -> Sink:
        options, session = self.options, self.session
        if options.output is None:
            return NullSink()
        return open_sink(
            options.output,
            fps=session.source.fps,
            size=session.pipeline.size,
            overwrite=options.overwrite,
            coding=options.coding,
            transfer=str(session.scene.camera.transfer),
            encoder=options.encoder,
            encoder_options=parse_options(options.encoder_option),
            tick=session.source.tick,
        )

    def _open_camera(self) -> Sink:
        """Open the virtual camera if the options name one."""
        from warp_ar.output.virtual_camera import VirtualCameraSink

        if (device := self.options.virtual_camera) is None:
            return NullSink()
        source, size = self.session.source, self.session.pipeline.size
        # Frames of a clip are shown at its rate, frames of a live camera as they come.
        camera = VirtualCameraSink(device or None, fps=source.fps, size=size, paced=not source.live)
        say(f"frames are sent to {camera.description}")
        return camera

    # ---------------------------------------------------------------------------------------------------------- frames

    def run(self) -> int:
        """Light all frames, write the report and print the summary; return the exit code."""
        try:
            with handling(self._stop, "SIGINT", "SIGTERM", "SIGHUP"), self.side, self.sink, self.camera:
                self._light_frames()
            if self.code is None:
                self._check()
            for words in reflectances_told(
                self.session.scene.probes, self.session.pipeline.arrays.get("recover_status")
            ):
                say(words)
        except WarpArError as error:
            problem = self._write_report()
            also = f"; and {problem}" if problem else ""
            raise RunError(f"{error} ({self._count()}){also}") from error
        except BaseException:
            self._write_report()
            raise
        if problem := self._write_report():
            raise RunError(f"{problem} ({self._count()})")
        if not self.options.headless:
            self._tell_end()
        return EXIT_DONE if self.code is None else self.code

    def _stop(self, number: int, _: object) -> None:
        """Record the first signal; end at once at a second one."""
        if self.code is not None:
            raise KeyboardInterrupt
        self.code = EXIT_INTERRUPTED if number == signal.SIGINT else EXIT_TERMINATED

    def _light_frames(self) -> None:
        """Light frames until they end or a signal asks to stop."""
        options, session, log = self.options, self.session, self.log
        source = session.source
        total = options.frames
        if not options.loop and source.length is not None:
            total = min(options.frames or source.length, source.length)
        name, rate = TextColumn(printable(session.scene.name), markup=False), TextColumn("{task.fields[fps]:.1f} fps")
        columns = (name, BarColumn(), MofNCompleteColumn(), rate, TimeRemainingColumn())
        with Progress(*columns, disable=options.headless) as progress:
            bar = progress.add_task("frames", total=total, fps=0.0)
            for frame, result in itertools.islice(session, options.frames):
                image, decode_ms = result.image, session.decode_ms
                if self.traced is not None:
                    image = self.traced(frame, result)
                self.changed = self.changed or bool((result.image != frame.image).any())
                # Keep frames 1, 2, 4, 8, ...: few frames from all parts of a run.
                if not self.ball_seen and result.pose is not None and (log.count + 1).bit_count() == 1:
                    self.views = [*self.views, (frame.image.copy(), result.pose)][-4:]
                start = time.perf_counter()
                self.sink.write_at(image if options.coding == "8bit" else result.radiance, frame.time)
                self.camera.write(image)
                encode_ms = (time.perf_counter() - start) * 1e3
                self.side.write(frame.image, result, session.scene)
                log.add(result, decode_ms=decode_ms, encode_ms=encode_ms)
                progress.update(bar, advance=1, fps=log.fps)
                if log.count == MARKER_PATIENCE:
                    self._check_marker(live=source.live)
                if self.code is not None:
                    return

    def _check_marker(self, *, live: bool) -> None:
        """Report that no frame so far showed the marker: as an error for a clip, as a note for a camera."""
        log, marker = self.log, self.session.scene.marker
        if not log.never_posed or log.count == 0:
            return
        message = (
            f"no marker in the first {counted(log.count, 'frame')}: expected {marker.dictionary} "
            f"{marker.board or f'id {marker.id}'}; check the scene's [marker], that the whole marker with its white "
            "border is in view, sharp and not mirrored"
        )
        if log.count == MARKER_PATIENCE:
            message += "; if it appears later, cut off the frames before it"
        if not live:
            raise RunError(message)
        say(message)

    def _check(self) -> None:
        """Check that frames showed the marker and the ball and were changed, each where the scene needs it.

        Raises:
            RunError: A check failed.
        """
        from warp_ar.checks.checkup import ball_is_seen

        self._check_marker(live=False)
        scene, source = self.session.scene, self.session.scene.source
        generated = source is not None and source.synthetic is not None
        reads_ball = any(stage.name == "unwrap" for stage, _ in self.session.pipeline.plan.stages)
        see = "check center and radius, and see python -m warp_ar.doctor"
        if reads_ball and self.views and not generated:
            camera = scene.camera.scaled_to(*self.session.source.size)
            if not ball_is_seen(scene, camera, self.views):
                raise RunError(f"{NO_BALL}, so the light does not fit the desk; {see}")
        if self.log.count > 0 and not self.changed and (scene.objects or scene.lights):
            raise RunError(
                "no frame was changed: no [[object]] and no [[light]] reaches the picture; check their at, in metres"
            )
        if "balls_missing" in self.notes:
            raise RunError(f"{self.notes['balls_missing']}; {see}")

    # ------------------------------------------------------------------------------------------------------------- end

    def _count(self) -> str:
        """Return the number of frames of a failed run in words."""
        bare = isinstance(self.sink, NullSink)
        count, how = (self.log.count, "lit") if bare else (self.sink.written, "written")
        return f"{counted(count, 'frame')} {'was' if count == 1 else 'were'} {how}{self.side.written}"

    def _write_report(self) -> str:
        """Write the report if the options name one; return the message of a failure."""
        if (path := self.options.report) is None:
            return ""
        text = json.dumps({"program": PROGRAM, **self.log.report(), **self.notes}, indent=1)
        try:
            write_whole(path, text.encode())
        except OSError as error:
            return f"--report {path} cannot be written: {reason(error)}"
        return ""

    def _tell_end(self) -> None:
        """Print the summary in at most five lines: frames, outputs, faults and the most expensive stages."""
        from warp_ar.output.report import print_plan, stage_names

        pipeline, log = self.session.pipeline, self.log
        if self.options.verbose:
            print_plan(pipeline.plan, log)
            print("side by side, in ms:", ", ".join(f"{name} {ms:.1f}" for name, ms in log.steps().items()))
        name, (width, height) = printable(self.session.scene.name), pipeline.size
        frames = f"{counted(log.count, 'frame')}, {log.fps:.1f} fps"
        print(f"{name}: {width}x{height}, {frames}, quality {pipeline.quality.name}, {pipeline.device}")
        where = self.camera.description if self.options.output is None else self.options.output
        print(f"written to {printable(where)}")
        print(f"worst finding: {printable(self.worst)}" if self.worst else "nothing wrong was found")
        costs = {stage: ms for stage in stage_names(pipeline.plan) if (ms := log.median_ms(stage)) is not None}
        if costs:
            stage = max(costs, key=costs.__getitem__)
            print(f"cost most: {stage}, {costs[stage]:.1f} of {sum(costs.values()):.1f} ms a frame (--verbose: all)")
        if self.options.quality == AUTO:
            print(_choice(pipeline.status()))  # type: ignore[union-attr]


def _choice(status: Mapping[str, Any]) -> str:
    """Return the settings that a budget has chosen, in words."""
    if "settings" not in status:
        return f"{AUTO}: no marker was seen, so no methods were chosen"
    if not status["changes"]:
        return f"{AUTO}: too few frames to choose methods"
    chosen = ", ".join(f"{setting} {method}" for setting, method in status["settings"].items())
    return (
        f"{AUTO}: {chosen}; {status['expected_ms']:.1f} of {status['budget_ms']:g} ms, expected error "
        f"{status['expected_error']:.4f} FLIP above the best, changed {len(status['changes']) - 1} times"
    )
