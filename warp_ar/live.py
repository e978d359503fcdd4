"""The command: ``python -m warp_ar.live [SCENE]`` turns camera frames into consistently lit frames."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import faulthandler
import functools
import gc
import itertools
import json
import os
import secrets
import signal
import sys
import threading
import time
import webbrowser
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from warp_ar.command_line import (
    EXIT_DONE,
    EXIT_INTERRUPTED,
    EXIT_TERMINATED,
    EXIT_USAGE,
    Parser,
    Terminated,
    handling,
    leave,
    loading,
    run_command,
    say,
)
from warp_ar.errors import UsageError, WarpArError, printable, reason
from warp_ar.files import write_whole
from warp_ar.output.encoders import CODINGS, describe_encoders, parse_options
from warp_ar.output.places import check_places, check_replaceable, files_of
from warp_ar.output.sink import make_folder
from warp_ar.output.sinks import FOLDER_CODINGS, NullSink, Sink, open_sink
from warp_ar.scene import Scene, bundled_scenes, load_scene
from warp_ar.signature import PROGRAM
from warp_ar.stages.quality import AUTO, DEFAULT_BUDGET_MS, DEFAULT_PRESET, PRESETS
from warp_ar.stages.request import LAYERS

if TYPE_CHECKING:
    from warp_ar.accuracy.budget import AutoPipeline
    from warp_ar.accuracy.traced_frames import TracedFrames
    from warp_ar.output.report import RunLog
    from warp_ar.output.side_files import SideFiles
    from warp_ar.session import Session
    from warp_ar.viewer.address import Address

DEFAULT_PORT = 8720
PORT_TRIES = 20

# A clip that shows no marker for this many frames is not going to: say so instead of running on.
MARKER_PATIENCE = 100


class RunError(WarpArError):
    """Something failed after frames had begun to flow."""


def make_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = Parser(
        prog="python -m warp_ar.live",
        description="Camera frames of a desk with a marker and a mirror ball in, consistently lit frames out. "
        "Without --output or --headless they go to a page in the browser.",
    )
    add = parser.add_argument
    add(
        "scene",
        nargs="?",
        default="desk",
        metavar="SCENE",
        help="a scene file, a folder with one, or a bundled scene's name (default: desk)",
    )
    add("--list", action="store_true", help="list the bundled scenes and stop")
    add(
        "--source",
        metavar="PATH|INDEX",
        help="frames from this folder, video file or capture device, not the scene's own",
    )
    add(
        "--calibration",
        metavar="FILE|exif",
        help="OpenCV camera calibration, YAML or JSON, instead of the scene's numbers; exif: the first picture's",
    )
    add("--light", metavar="FILE", help="captured light (OpenEXR) instead of what a mirror ball in the frames shows")
    add("--device", default="auto", metavar="auto|cpu|cuda:0", help="where the kernels run (default: auto)")
    add(
        "--quality",
        default=DEFAULT_PRESET,
        metavar="NAME",
        help=f"{', '.join(PRESETS)}, or {AUTO}: what errs least within a budget (default: {DEFAULT_PRESET})",
    )
    add(
        "--budget-ms",
        type=float,
        metavar="X",
        help=f"milliseconds per frame for --quality {AUTO} (default: {DEFAULT_BUDGET_MS:g})",
    )
    add("--frames", type=int, metavar="N", help="stop after N frames")
    add("--loop", action="store_true", help="start the clip again when it ends; on the page it always does")
    add(
        "--refine-ball",
        action="store_true",
        help="with --output or --headless: first find the mirror ball by the desk that it mirrors, in some seconds",
    )
    text = (
        "with --output or --headless: frames by path tracing with N samples a pixel, in the light that --quality finds"
    )
    add("--samples", type=int, metavar="N", help=text)
    text = (
        "with --samples: stop at this relative standard error of what virtual objects and lights change, such as 0.05"
    )
    add("--error", type=float, metavar="E", help=text)
    _add_file_options(parser.add_argument_group("files"))
    _add_page_options(parser.add_argument_group("the page"))
    return parser


def _add_file_options(group: argparse._ArgumentGroup) -> None:
    """What is written instead of the page."""
    add = group.add_argument
    add(
        "--output",
        type=Path,
        metavar="FILE.mp4|DIR",
        help="write frames instead of serving the page: a folder gets NNNN.png, a file H.264",
    )
    add(
        "--coding",
        choices=tuple(dict.fromkeys((*CODINGS, *FOLDER_CODINGS))),
        default="8bit",
        help="with --output: a video of 10bit, pq or hlg; a folder of 16bit (PNG) or exr (default: 8bit)",
    )
    add("--encoder", metavar="NAME|list", help="with --output FILE: FFmpeg's encoder; list: show those of this machine")
    add(
        "--encoder-option",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="an option of the encoder by FFmpeg's name, such as crf=23; may be given again",
    )
    add(
        "--virtual-camera",
        nargs="?",
        const="",
        metavar="DEVICE",
        help="show frames as a camera that other programs open, such as /dev/video4 (default: the first there is)",
    )
    add(
        "--headless",
        action="store_true",
        help="no page, no progress bar, no table; writes only what other options name",
    )
    add(
        "--overwrite",
        action="store_true",
        help="replace files that this program did not write; those that it wrote are replaced anyway",
    )
    add("--save-environment", type=Path, metavar="DIR", help="write the captured light of every frame as NNNN.exr")
    add("--save-layers", type=Path, metavar="DIR", help="write the layers of every frame as NNNN.exr of several parts")
    add(
        "--layers",
        metavar="NAMES|all",
        help=f"with --save-layers: which, separated by commas (default: all): {', '.join(LAYERS)}",
    )
    add("--layer-pictures", action="store_true", help="with --save-layers: those that PNG can hold, as PNG besides")
    add("--report", type=Path, metavar="FILE.json", help="write poses and timings of every frame")


def _add_page_options(group: argparse._ArgumentGroup) -> None:
    """Where the page is served, and to whom."""
    add = group.add_argument
    add("--port", type=int, metavar="N", help=f"port to serve at (default: {DEFAULT_PORT}, or the next free one)")
    add(
        "--host",
        default="127.0.0.1",
        metavar="ADDRESS",
        help="address to serve at (default: 127.0.0.1); one that others reach, such as 0.0.0.0, asks for a token",
    )
    add("--token", metavar="SECRET", help="ask for this token (default: a new one where other machines reach the page)")
    add(
        "--tls",
        nargs="?",
        const=True,
        metavar="FILE.pem",
        help="serve over TLS, without which browsers keep their camera from other machines; makes its own certificate",
    )
    add("--no-browser", action="store_true", help="only print the page's address")
    add(
        "--allow-origin",
        action="append",
        default=[],
        metavar="ORIGIN",
        help="let pages of this site, such as http://localhost:5173, ask for the light; may be given again",
    )


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
    wanted = f"board {marker.board!r}" if marker.board else f"id {marker.id}"
    message = (
        f"no marker in the first {log.count} frames: expected {marker.dictionary} {wanted}; "
        "check the scene's [marker], "
        "that the whole marker with its white border is in view, sharp and not mirrored"
    )
    if not live:
        raise RunError(message)
    say(message)


def _quick_check(options: argparse.Namespace, scene: Scene) -> bool:
    """Say in one line each what is guessed, and the worst of what is wrong with the set-up.

    Frames of a capture device are left to the run itself: a device is not opened twice.

    Returns:
        Whether a mirror ball was seen where the scene has one.
    """
    from warp_ar.input.quick_check import quick_check

    try:
        checked = quick_check(scene, options.source, files_of(scene))
    except WarpArError:
        return False  # the run meets it too, and says it
    # What the run itself cannot start with, it says itself.
    told = ("source.", "camera.aspect")
    found = [finding for finding in checked.findings if not finding.name.startswith(told)]
    worst = [finding for finding in found if finding.name != "camera.guessed"][:1]
    for finding in [*worst, *(finding for finding in found if finding.name == "camera.guessed")]:
        more = f"; all there is to say: python -m warp_ar.doctor {options.scene}" if finding in worst else ""
        own = None if scene.path in bundled_scenes().values() else options.scene
        say(f"{finding.text}; to do: {finding.remedy_for(own)}{more}")
    return checked.ball_seen


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
    from warp_ar.input.checkup import ball_is_seen

    _check_marker(log, session.scene, live=False)
    scene, source = session.scene, session.scene.source
    generated = source is not None and source.synthetic is not None
    reads_ball = any(stage.name == "unwrap" for stage, _ in session.pipeline.plan.stages)
    if reads_ball and evidence.views and not generated:
        camera = scene.camera.scaled_to(*session.source.size)
        if not ball_is_seen(scene, camera, evidence.views):
            raise RunError(
                "no mirror ball was found where [probe] has it, so its light is not that of the desk; "
                "check center and radius, and see python -m warp_ar.doctor"
            )
    if log.count > 0 and not evidence.changed and (scene.objects or scene.lights):
        raise RunError(
            "no frame was changed: no [[object]] and no [[light]] reaches the picture; check their at, in metres"
        )


def _page_scene(options: argparse.Namespace) -> Scene:
    """The scene of a page.

    Raises:
        UsageError: An option is for files only, or has an impossible value.
    """
    from warp_ar.session import calibrated, with_light

    for name in ("save_environment", "save_layers", "report", "samples", "error"):
        if getattr(options, name) is not None:
            raise UsageError(f"--{name.replace('_', '-')} needs --headless or --output: the page saves on its own")
    if options.refine_ball:
        raise UsageError("--refine-ball needs --headless or --output; before the page, run warp_ar.calibrate ball")
    if options.port is not None and not 0 <= options.port <= 65535:
        raise UsageError(f"--port {options.port}: expected a port, 0 to 65535; 0 takes a free one")
    if options.token is not None and not (options.token.isascii() and options.token.isalnum()):
        raise UsageError("--token: expected letters and digits, for it stands in an address")
    scene = load_scene(options.scene)
    if options.calibration is not None:
        scene = calibrated(scene, options.calibration, options.source)
    return scene if options.light is None else with_light(scene, options.light)


def _page_address(options: argparse.Namespace) -> Address:
    """Where the page is served, and with which token and certificate."""
    from warp_ar.viewer.address import EVERYWHERE, LOOPBACK, Address, own_address
    from warp_ar.viewer.shared_light import check_origin
    from warp_ar.viewer.tls import load_context, make_context

    known = options.token is not None or options.host in LOOPBACK
    tls = None
    if options.tls is True:
        tls = make_context((options.host in EVERYWHERE and own_address()) or options.host)
    elif options.tls is not None:
        tls = load_context(Path(options.tls))
    port = DEFAULT_PORT if options.port is None else options.port
    origins = tuple(map(check_origin, options.allow_origin))
    return Address(options.host, port, options.token if known else secrets.token_hex(16), tls, origins)


def _hurry_compilers(device: str) -> None:
    """Start Warp; what can be done for its compilers beside the imports that follow, and before them, is."""
    import warp as wp

    from warp_ar.device import start_warp
    from warp_ar.engine.modules import parse_headers_ahead, remember_references

    start_warp()
    remember_references()
    if device == "cpu" or not wp.is_cuda_available():
        parse_headers_ahead()


def _make_page_host(options: argparse.Namespace, scene: Scene, **callbacks: Any) -> Any:
    """The host of a page that is served already, on its own thread: it loads Warp and all that uses it."""
    with loading():
        from warp_ar.device import bound_arenas

        _hurry_compilers(options.device)
        from warp_ar.viewer.host import Host

        bound_arenas()
    # What is imported stays: looking through it for garbage would hold up a frame for a tenth of a second.
    gc.collect()
    gc.freeze()
    return Host(
        scene,
        source=options.source,
        device=options.device,
        quality=options.quality,
        budget_ms=options.budget_ms,
        frames=options.frames,
        **callbacks,
    )


def serve_page(options: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C, or until ``--frames`` have been lit."""
    # Here, for what only writes files should not wait for a web server to load.
    from warp_ar.viewer.address import LOOPBACK
    from warp_ar.viewer.server import Server

    scene = _page_scene(options)
    address = _page_address(options)
    # Beside the page, which does not wait for it.
    threading.Thread(target=_quick_check, args=(options, scene), daemon=True).start()

    def ready(address: Address) -> None:
        print(f"warp_ar: {printable(scene.name)} is at {address.url} (Ctrl-C ends it)", flush=True)
        if (outside := address.outside_url) is not None:
            print(f"warp_ar: from other machines, {outside}", flush=True)
        if not options.no_browser and options.host in LOOPBACK and _has_display():
            webbrowser.open(address.url)

    # A shell that starts this in the background has it ignore the signal; here it is the only way to end.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    server = Server(functools.partial(_make_page_host, options, scene), address)
    code = EXIT_DONE
    try:
        asyncio.run(server.serve(ready, tries=PORT_TRIES if options.port is None else 1))
    except KeyboardInterrupt as error:
        code = EXIT_TERMINATED if isinstance(error, Terminated) else EXIT_INTERRUPTED
    except WarpArError as error:
        if server.ended:
            raise
        say(error)
        code = EXIT_USAGE
    if not server.ended or code in (EXIT_INTERRUPTED, EXIT_TERMINATED):
        # A frame of the reference, or a kernel that is compiled, takes many seconds and cannot be stopped, and Python
        # would wait for its thread, or end it within native code, which aborts. All files are closed and temporary
        # folders gone by now.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    return code


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


def _has_display() -> bool:
    """Whether a browser can open a window here."""
    return sys.platform in ("win32", "darwin") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def run(options: argparse.Namespace) -> int:
    """Build everything that ``options`` ask for, then let frames flow until they end."""
    if options.list:
        for name, path in bundled_scenes().items():
            print(f"{name:16s} {path}")
        return EXIT_DONE
    if options.encoder == "list":
        print("\n".join(describe_encoders()))
        return EXIT_DONE
    if options.output is None and (options.coding != "8bit" or options.encoder or options.encoder_option):
        raise UsageError("--coding, --encoder and --encoder-option need --output, the file or folder to write")
    if options.frames is not None and options.frames < 1:
        raise UsageError(f"--frames {options.frames}: expected a number of frames, 1 or more")
    if options.budget_ms is not None and not 0.0 < options.budget_ms < float("inf"):
        raise UsageError(f"--budget-ms {options.budget_ms:g}: expected milliseconds above 0")
    if options.budget_ms is not None and options.quality != AUTO:
        raise UsageError(f"--budget-ms {options.budget_ms:g} needs --quality {AUTO}")
    if options.error is not None and options.samples is None:
        raise UsageError(f"--error {options.error:g} needs --samples N, the most that a pixel may take")
    if options.samples is not None and options.coding != "8bit":
        raise UsageError(f"--coding {options.coding} with --samples: traced frames have 8 bits; expected --coding 8bit")
    if options.output is None and options.virtual_camera is None and not options.headless:
        return serve_page(options)
    return light_clip(options)


def light_clip(options: argparse.Namespace) -> int:
    """Light a source's frames without a page, and write what options name."""
    with loading() as loaded:
        return _light_clip(options, loaded)


def _light_clip(options: argparse.Namespace, loaded: Callable[[], None]) -> int:
    if options.save_layers is None and (options.layers is not None or options.layer_pictures):
        which = "--layer-pictures" if options.layers is None else f"--layers {options.layers}"
        raise UsageError(f"{which} needs --save-layers DIR, the folder to write them to")

    scene = load_scene(options.scene)
    _check_places(options, scene)
    # Here, for they load Warp: the page is to be there before, and what is wrong with a scene is told before.
    _hurry_compilers(options.device)
    from warp_ar.accuracy.budget import AutoPipeline
    from warp_ar.accuracy.traced_frames import TracedFrames
    from warp_ar.engine.layers import RADIANCE
    from warp_ar.output.report import RunLog, print_plan
    from warp_ar.output.side_files import SideFiles, parse_layers

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

    stop = _Stop()
    with contextlib.ExitStack() as stack:
        stack.enter_context(side)
        session = stack.enter_context(_open_session(options, scene, tuple(outputs)))
        balls = _ball_report(scene, session)
        ball_seen = _quick_check(options, session.scene)
        for note in session.bracket_notes:
            say(note)
        traced = None
        if options.samples is not None:
            traced = TracedFrames(session.pipeline, options.samples, options.error)  # type: ignore[arg-type]
            session.ahead = False
        _compile(session, shown=not options.headless)
        loaded()
        source = session.source
        sink: Sink = NullSink()
        if options.output is not None:
            size = session.pipeline.size
            sink = open_sink(
                options.output,
                fps=source.fps,
                size=size,
                overwrite=options.overwrite,
                coding=options.coding,
                transfer=str(session.scene.camera.transfer),
                encoder=options.encoder,
                encoder_options=parse_options(options.encoder_option),
            )
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
        print_plan(session.pipeline.plan, log)
        if isinstance(session.pipeline, AutoPipeline):
            _print_choice(session.pipeline)
        steps = ", ".join(f"{name} {milliseconds:.1f}" for name, milliseconds in log.steps().items())
        Console().print(f"side by side, in ms: {steps}", highlight=False)
        shown = printable(camera.description)
        where = shown if options.output is None else printable(options.output)
        Console().print(f"{log.count} frames, {log.fps:.1f} fps, written to {where}", highlight=False, markup=False)
    return EXIT_DONE if stop.code is None else stop.code


def _open_session(options: argparse.Namespace, scene: Scene, outputs: tuple[str, ...]) -> Session:
    from warp_ar.session import Session

    return Session(
        scene,
        source=options.source,
        calibration=options.calibration,
        light=options.light,
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
            sink.write(image if options.coding == "8bit" else result.radiance)
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
    frames = f"{log.count} frames were lit" if isinstance(sink, NullSink) else f"{sink.written} frames were written"
    return frames + side.written


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


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code.

    0 done, 1 failed while running, 2 bad usage or scene, 130 interrupted, 143 terminated.
    """
    return run_command(lambda: run(make_parser().parse_args(arguments)), RunError)


if __name__ == "__main__":
    faulthandler.enable()  # should native code crash, the report says what it was at
    leave(main())
