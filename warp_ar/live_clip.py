"""``python -m warp_ar.live`` without a page: a source's frames are lit, and what options name is written."""

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

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from warp_ar.begin import EXIT_INTERRUPTED, EXIT_TERMINATED, handling, importing
from warp_ar.command_line import EXIT_DONE, loading
from warp_ar.errors import UsageError, WarpArError, printable, reason, say
from warp_ar.files import is_folder, write_whole
from warp_ar.live_start import say_quick_check, start_device
from warp_ar.output.encoders import parse_options
from warp_ar.output.places import check_places, check_replaceable, folder_to_oneself
from warp_ar.output.sink import make_folder
from warp_ar.output.sinks import NullSink, Sink, open_sink
from warp_ar.scene import Probe, Scene, load_scene
from warp_ar.scene.scene_files import files_of
from warp_ar.signature import PROGRAM
from warp_ar.stages.quality import AUTO

if TYPE_CHECKING:
    from warp_ar.accuracy.budget import AutoPipeline
    from warp_ar.accuracy.traced_frames import TracedFrames
    from warp_ar.output.report import RunLog
    from warp_ar.output.side_files import SideFiles
    from warp_ar.session import Session

# A clip that shows no marker for this many frames is not going to: say so instead of running on.
MARKER_PATIENCE = 100
NO_BALL = "no mirror ball was found where [probe] has it"


class RunError(WarpArError):
    """Something failed after frames had begun to flow."""


class _Stop:
    """Whether a signal has asked the run to end, and the exit code that this gives."""

    def __init__(self) -> None:
        self.code: int | None = None

    def handle(self, number: int, _: object) -> None:
        """Note the first signal; a second one stops at once."""
        if self.code is not None:
            raise KeyboardInterrupt
        self.code = EXIT_INTERRUPTED if number == signal.SIGINT else EXIT_TERMINATED


def _prepare_file(path: Path, *, overwrite: bool) -> str:
    """Fail now, not after an hour of frames, where a file cannot be written; returns what it replaces, in words."""
    replaced = check_replaceable(path, overwrite=overwrite)
    make_folder(path.parent)
    return replaced


def _check_places(options: argparse.Namespace, scene: Scene) -> None:
    """See to it that nothing is written over what is read, or twice."""
    source = options.source
    if source is None:
        source = None if scene.source is None else scene.source.path
    reads: dict[str, list[Path]] = {"the scene": [] if scene.path is None else [scene.path]}
    reads["what the scene names,"] = [path for path in files_of(scene) if path != scene.path]
    if options.calibration is not None:
        reads["--calibration"] = [Path(options.calibration)]
    if options.light is not None:
        reads["--light"] = [Path(options.light)]
    if source is not None and "://" not in str(source):
        reads["the source"] = [Path(source)]
    names = {
        "output": "--output",
        "report": "--report",
        "save_environment": "--save-environment",
        "save_layers": "--save-layers",
    }
    writes = {option: Path(path) for name, option in names.items() if (path := getattr(options, name)) is not None}
    check_places(reads, writes)


def _check_marker(log: RunLog, scene: Scene, *, live: bool) -> None:
    """Complain where no frame so far showed the marker: an error for a clip, a note for a camera."""
    if not log.never_posed or log.count == 0:
        return
    marker = scene.marker
    message = (
        f"no marker in the first {_counted(log.count, 'frame')}: expected {marker.dictionary} "
        f"{marker.board or f'id {marker.id}'}; check the scene's [marker], that the whole marker with its white border "
        "is in view, sharp and not mirrored"
    )
    if log.count == MARKER_PATIENCE:
        message += "; where it comes later, cut off what is before"
    if not live:
        raise RunError(message)
    say(message)


class _Evidence:
    """What frames show of a run: whether any was changed, and some by which to look for a ball not seen before."""

    def __init__(self, *, ball_seen: bool) -> None:
        self.changed = False
        self.ball_seen = ball_seen
        self.views: list[tuple[Any, Any]] = []
        self._count = 0

    def add(self, image: Any, result: Any) -> None:
        """Note a frame and what it became."""
        self._count += 1
        self.changed = self.changed or bool((result.image != image).any())
        # The first, second, fourth, eighth, ...: all parts of a run, in few frames.
        if not self.ball_seen and result.pose is not None and self._count & (self._count - 1) == 0:
            self.views = [*self.views, (image.copy(), result.pose)][-4:]


def _check_run(log: RunLog, session: Session, evidence: _Evidence) -> None:
    """Complain about a run that showed no marker, no ball, or changed nothing, though its scene calls for it.

    Raises:
        RunError: It did.
    """
    from warp_ar.checks.checkup import ball_is_seen

    _check_marker(log, session.scene, live=False)
    scene, source = session.scene, session.scene.source
    generated = source is not None and source.synthetic is not None
    reads_ball = any(stage.name == "unwrap" for stage, _ in session.pipeline.plan.stages)
    if reads_ball and evidence.views and not generated:
        camera = scene.camera.scaled_to(*session.source.size)
        if not ball_is_seen(scene, camera, evidence.views):
            raise RunError(
                f"{NO_BALL}, so its light is not that of the desk; "
                "check center and radius, and see python -m warp_ar.doctor"
            )
    if log.count > 0 and not evidence.changed and (scene.objects or scene.lights):
        raise RunError(
            "no frame was changed: no [[object]] and no [[light]] reaches the picture; check their at, in metres"
        )


def _print_choice(pipeline: AutoPipeline) -> None:
    """Say what the budget bought."""
    status = pipeline.status()
    if "settings" not in status:
        print(f"{AUTO}: no marker was seen, so nothing was chosen")
        return
    if not status["changes"]:
        print(f"{AUTO}: too few frames to choose by")
        return
    chosen = ", ".join(f"{setting} {method}" for setting, method in status["settings"].items())
    print(
        f"{AUTO}: {chosen}; {status['expected_ms']:.1f} of {status['budget_ms']:g} ms, expected error "
        f"{status['expected_error']:.4f} FLIP above the best, changed {len(status['changes']) - 1} times"
    )


def _ball_report(scene: Scene, session: Session) -> dict[str, Any]:
    """Say how far from where the scene has them the mirror balls were found."""
    given = scene.probes
    found = []
    for index, (fit, before, after) in enumerate(zip(session.ball_fits, given, session.scene.probes, strict=False)):
        offset = [round(1e3 * (b - a), 2) for a, b in zip(before.center, after.center, strict=True)]
        good = fit is not None and fit.is_good
        found.append({"offset_mm": offset, "deviation_mm": round(1e3 * fit.deviation, 2) if fit and good else None})
        what = f"moved by {offset} mm" if good else "left where the scene has it: too little of the desk shows in it"
        say(f"mirror ball {index} {what}")
    return {"balls": found} if found else {}


def reflectances_told(probes: Sequence[Probe], status: Callable[[], Mapping[str, Any]] | None) -> list[str]:
    """A line for each ball whose reflectance frames have told otherwise than the scene.

    Args:
        probes: The scene's.
        status: Of recovered light; None where none is recovered.
    """
    told = None if status is None else status().get("ball_reflectance")
    lines = []
    for index, (probe, found) in enumerate(zip(probes, told or (), strict=False)):
        if tuple(found) != tuple(round(value, 3) for value in probe.reflectance):
            said, taken = (", ".join(f"{value:.2f}" for value in values) for values in (probe.reflectance, found))
            lines.append(
                f"mirror ball {index} was taken to reflect {taken}, as frames show it, not {said}, as [probe] has it"
            )
    return lines


def _compile(session: Session, *, shown: bool) -> None:
    """Have the kernels ready, with a bar where some must be compiled."""
    words = TextColumn("compiling kernels, once for this kind of scene")
    bar = Progress(words, BarColumn(), MofNCompleteColumn(), disable=not shown)
    task: TaskID | None = None

    def tell(done: int, total: int) -> None:
        nonlocal task
        if task is None:
            bar.start()
            task = bar.add_task("compile", total=total)
        bar.update(task, completed=done)

    try:
        session.warm_up(tell)
    finally:
        bar.stop()


def light_clip(options: argparse.Namespace) -> int:
    """Light a source's frames without a page, and write what options name."""
    with loading() as loaded:
        return _light_clip(options, loaded)


def _open_side_files(options: argparse.Namespace) -> tuple[SideFiles, tuple[str, ...], list[str]]:
    """What is written beside the pictures; what the pipeline must give for all that is written, and what is replaced.

    Raises:
        UsageError: Options of layers have no folder, or a file is somebody else's.
    """
    from warp_ar.engine.layers import RADIANCE
    from warp_ar.output.side_files import SideFiles, parse_layers

    if options.save_layers is None and (options.layers is not None or options.layer_pictures):
        which = "--layer-pictures" if options.layers is None else f"--layers {options.layers}"
        raise UsageError(f"{which} needs --save-layers DIR, the folder to write them to")
    side = SideFiles(
        environment=options.save_environment,
        layers=options.save_layers,
        names=parse_layers(options.layers),
        pictures=options.layer_pictures,
        overwrite=options.overwrite,
    )
    outputs, replaced = ["image", *side.outputs], list(side.replaced)
    if options.coding != "8bit":
        outputs.append(RADIANCE)
    if options.report is not None:
        replaced.append(_prepare_file(options.report, overwrite=options.overwrite))
        outputs.append("pose")
    return side, tuple(outputs), replaced


def _open_output(options: argparse.Namespace, session: Session) -> Sink:
    """Where the lit frames go."""
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


def _tell_end(options: argparse.Namespace, session: Session, log: RunLog, camera: Sink) -> None:
    """Say what ran, what it took, and where the frames are."""
    from warp_ar.accuracy.budget import AutoPipeline
    from warp_ar.output.report import print_plan

    print_plan(session.pipeline.plan, log)
    if isinstance(session.pipeline, AutoPipeline):
        _print_choice(session.pipeline)
    steps = ", ".join(f"{name} {milliseconds:.1f}" for name, milliseconds in log.steps().items())
    Console().print(f"side by side, in ms: {steps}", highlight=False)
    where = printable(camera.description if options.output is None else options.output)
    told = f"{_counted(log.count, 'frame')}, {log.fps:.1f} fps, written to {where}"
    Console().print(told, highlight=False, markup=False)


def _light_clip(options: argparse.Namespace, loaded: Callable[[], None]) -> int:
    scene = load_scene(options.scene)
    _check_places(options, scene)
    # Here, for they load Warp: the page is to be there before, and what is wrong with a scene is told before.
    with importing():
        start_device(options.device)
        from warp_ar.output.report import RunLog

    side, outputs, replaced = _open_side_files(options)
    stop = _Stop()
    with contextlib.ExitStack() as stack:
        stack.enter_context(side)
        session = stack.enter_context(_open_session(options, scene, outputs))
        balls = _ball_report(scene, session)
        ball_seen = say_quick_check(options, session.scene)
        if not ball_seen and options.light is None and _are_balls_missing(options, session.scene):
            session.close()
            session = stack.enter_context(_open_session_without_balls(options, session.scene, outputs))
            balls["balls_missing"] = f"{NO_BALL}; no light of a ball is used"
        for note in (*session.bracket_notes, session.source.note):
            if note:
                say(note)
        traced = None
        if options.samples is not None:
            with importing():  # the path tracer's kernels, which no other run declares
                from warp_ar.accuracy.traced_frames import TracedFrames
            traced = TracedFrames(session.pipeline, options.samples, options.error)  # type: ignore[arg-type]
            session.ahead = False
        _compile(session, shown=not options.headless)
        loaded()
        sink = _open_output(options, session)
        if options.output is not None and is_folder(options.output):
            stack.enter_context(folder_to_oneself(Path(options.output)))
        camera = _open_camera(options, session)
        for words in (*replaced, sink.replaced):
            if words:
                say(words)
        log, evidence = RunLog(session.pipeline), _Evidence(ball_seen=ball_seen)
        try:
            with handling(stop.handle, "SIGINT", "SIGTERM", "SIGHUP"), side, sink, camera:
                _light_frames(options, session, log, (sink, camera), side, stop, evidence, traced)
            if stop.code is None:
                _check_run(log, session, evidence)
            if "balls_missing" in balls and stop.code is None:
                raise RunError(f"{balls['balls_missing']}; check center and radius, and see python -m warp_ar.doctor")
            for words in reflectances_told(session.scene.probes, session.pipeline.arrays.get("recover_status")):
                say(words)
        except WarpArError as error:
            problem = _write_report(options.report, log, balls)
            also = f"; and {problem}" if problem else ""
            raise RunError(f"{error} ({_count(log, sink, side)}){also}") from error
        except BaseException:
            _write_report(options.report, log, balls)
            raise
        if problem := _write_report(options.report, log, balls):
            raise RunError(f"{problem} ({_count(log, sink, side)})")
    if not options.headless:
        _tell_end(options, session, log, camera)
    return EXIT_DONE if stop.code is None else stop.code


def _are_balls_missing(options: argparse.Namespace, scene: Scene) -> bool:
    from warp_ar.checks.checkup import are_balls_missing

    try:
        return are_balls_missing(scene, options.source)
    except WarpArError:
        return False  # the run meets it too, and says it


def _open_session_without_balls(options: argparse.Namespace, scene: Scene, outputs: tuple[str, ...]) -> Session:
    """Open a session that takes no light from where the scene has mirror balls that are not there.

    Raises:
        RunError: What is to be written is the light of a ball.
    """
    lone = argparse.Namespace(**{**vars(options), "calibration": None, "refine_ball": False})
    try:
        return _open_session(lone, dataclasses.replace(scene, probes=()), outputs)
    except (UsageError, ValueError) as error:
        raise RunError(f"{NO_BALL}: {error}") from error


def _open_session(options: argparse.Namespace, scene: Scene, outputs: tuple[str, ...]) -> Session:
    from warp_ar.session import Session

    return Session(
        scene,
        source=options.source,
        calibration=options.calibration,
        light=options.light,
        light_axes=options.light_axes,
        device=options.device,
        quality=options.quality,
        budget_ms=options.budget_ms,
        outputs=outputs,
        loop=options.loop,
        refine_ball=options.refine_ball,
    )


def _light_frames(
    options: argparse.Namespace,
    session: Session,
    log: RunLog,
    sinks: tuple[Sink, Sink],
    side: SideFiles,
    stop: _Stop,
    evidence: _Evidence,
    traced: TracedFrames | None = None,
) -> None:
    """Let frames flow until they end, or until a signal asks to stop; ``traced`` makes other pictures of them."""
    source, (sink, camera) = session.source, sinks
    total = (
        options.frames if options.loop or source.length is None else min(options.frames or source.length, source.length)
    )
    progress = Progress(
        TextColumn(printable(session.scene.name), markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[fps]:.1f} fps"),
        TimeRemainingColumn(),
        disable=options.headless,
    )
    bar = progress.add_task("frames", total=total, fps=0.0)
    with progress:
        for frame, result in itertools.islice(session, options.frames):
            image, decode_ms = result.image, session.decode_ms
            if traced is not None:
                image = traced(frame, result)
            evidence.add(frame.image, result)
            start = time.perf_counter()
            sink.write_at(image if options.coding == "8bit" else result.radiance, frame.time)
            camera.write(image)
            encode_ms = (time.perf_counter() - start) * 1e3
            side.write(frame.image, result, session.scene)
            log.add(result, decode_ms=decode_ms, encode_ms=encode_ms)
            progress.update(bar, advance=1, fps=log.fps)
            if log.count == MARKER_PATIENCE:
                _check_marker(log, session.scene, live=source.live)
            if stop.code is not None:
                return


def _open_camera(options: argparse.Namespace, session: Session) -> Sink:
    """The virtual camera, if one is asked for."""
    from warp_ar.output.virtual_camera import VirtualCameraSink

    if options.virtual_camera is None:
        return NullSink()
    source, size = session.source, session.pipeline.size
    # A clip's frames are shown at its rate; a camera's come at theirs.
    camera = VirtualCameraSink(options.virtual_camera or None, fps=source.fps, size=size, paced=not source.live)
    say(f"frames go to {camera.description}")
    return camera


def _count(log: RunLog, sink: Sink, side: SideFiles) -> str:
    """What there is of a run that failed."""
    count, how = (log.count, "lit") if isinstance(sink, NullSink) else (sink.written, "written")
    return f"{_counted(count, 'frame')} {'was' if count == 1 else 'were'} {how}{side.written}"


def _counted(number: int, what: str) -> str:
    return f"{number} {what}{'s' * (number != 1)}"


def _write_report(path: Path | None, log: RunLog, balls: dict[str, Any]) -> str:
    """Write the report if one is asked for; returns what went wrong, in words."""
    if path is None:
        return ""
    text = json.dumps({"program": PROGRAM, **log.report(), **balls}, indent=1)
    try:
        write_whole(path, text.encode())
    except OSError as error:
        return f"--report {path} cannot be written: {reason(error)}"
    return ""
