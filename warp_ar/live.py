"""The command: ``python -m warp_ar.live [SCENE]`` turns camera frames into consistently lit frames."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import dataclasses
import faulthandler
import itertools
import json
import os
import secrets
import signal
import sys
import time
import webbrowser
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from warp_ar.accuracy.budget import AUTO, DEFAULT_BUDGET_MS, AutoPipeline
from warp_ar.command_line import EXIT_DONE, EXIT_FAILED, EXIT_INTERRUPTED, EXIT_USAGE, Parser
from warp_ar.errors import UsageError, WarpArError
from warp_ar.output.report import RunLog, print_plan
from warp_ar.output.sinks import NullSink, open_sink, write_environment
from warp_ar.scene import Scene, bundled_scenes, load_calibration, load_scene
from warp_ar.session import Session
from warp_ar.stages.quality import DEFAULT_PRESET, PRESETS

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
        help="a scene file or a bundled scene's name (default: desk)",
    )
    add("--list", action="store_true", help="list the bundled scenes and stop")
    add(
        "--source",
        metavar="PATH|INDEX",
        help="frames from this folder, video file or capture device, not the scene's own",
    )
    add("--calibration", metavar="FILE", help="OpenCV camera calibration, YAML or JSON, instead of the scene's numbers")
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
    add(
        "--output",
        type=Path,
        metavar="FILE.mp4|DIR",
        help="write frames instead of serving the page: a folder gets NNNN.png, a file H.264",
    )
    add(
        "--headless",
        action="store_true",
        help="no page, no progress bar, no table; writes only what other options name",
    )
    add("--save-environment", type=Path, metavar="DIR", help="write the captured light of every frame as NNNN.exr")
    add("--report", type=Path, metavar="FILE.json", help="write poses and timings of every frame")
    add(
        "--refine-ball",
        action="store_true",
        help="with --output or --headless: first find the mirror ball by the desk that it mirrors, in some seconds",
    )
    add("--loop", action="store_true", help="start the clip again when it ends; on the page it always does")
    page = parser.add_argument_group("the page")
    page.add_argument(
        "--port", type=int, metavar="N", help=f"port to serve at (default: {DEFAULT_PORT}, or the next free one)"
    )
    page.add_argument(
        "--host",
        default="127.0.0.1",
        metavar="ADDRESS",
        help="address to serve at (default: 127.0.0.1); one that others reach, such as 0.0.0.0, asks for a token",
    )
    page.add_argument(
        "--token", metavar="SECRET", help="ask for this token (default: a new one where other machines reach the page)"
    )
    page.add_argument(
        "--tls",
        nargs="?",
        const=True,
        metavar="FILE.pem",
        help="serve over TLS, without which browsers keep their camera from other machines; makes its own certificate",
    )
    page.add_argument("--no-browser", action="store_true", help="only print the page's address")
    return parser


@contextlib.contextmanager
def _interruptible() -> Iterator[Callable[[], bool]]:
    """Let Ctrl-C finish the frame in hand; a second one stops at once."""
    requested = False

    def handle(*_: object) -> None:
        nonlocal requested
        if requested:
            raise KeyboardInterrupt
        requested = True

    previous = signal.signal(signal.SIGINT, handle)
    try:
        yield lambda: requested
    finally:
        signal.signal(signal.SIGINT, previous)


def _prepare_file(path: Path) -> None:
    """Fail now, not after an hour of frames, where a file cannot be written."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    except OSError as error:
        raise UsageError(
            f"cannot write {path}: {error.strerror}; name a file in a folder that you may write to"
        ) from error


def _prepare_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(
            f"cannot make the folder {path}: {error.strerror}; name a folder that you may write to"
        ) from error


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
    print(f"warp_ar: {message}", file=sys.stderr)


def serve_page(options: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C, or until ``--frames`` have been lit."""
    # Here, for what only writes files should not wait for a web server to load.
    from warp_ar.viewer.host import Host
    from warp_ar.viewer.server import EVERYWHERE, LOOPBACK, Address, Server, own_address
    from warp_ar.viewer.tls import load_context, make_context

    for name in ("save_environment", "report"):
        if getattr(options, name) is not None:
            raise UsageError(f"--{name.replace('_', '-')} needs --headless or --output: the page saves on its own")
    if options.refine_ball:
        raise UsageError("--refine-ball needs --headless or --output; before the page, run warp_ar.calibrate ball")
    if options.port is not None and not 0 <= options.port <= 65535:
        raise UsageError(f"--port {options.port}: expected a port, 0 to 65535; 0 takes a free one")
    scene = load_scene(options.scene)
    if options.calibration is not None:
        scene = dataclasses.replace(scene, camera=load_calibration(options.calibration, scene.camera.transfer))
    local = options.host in LOOPBACK
    if options.token is not None and not (options.token.isascii() and options.token.isalnum()):
        raise UsageError("--token: expected letters and digits, for it stands in an address")
    token = options.token if options.token is not None or local else secrets.token_hex(16)
    tls = (
        None
        if options.tls is None
        else make_context((options.host in EVERYWHERE and own_address()) or options.host)
        if options.tls is True
        else load_context(Path(options.tls))
    )
    port = DEFAULT_PORT if options.port is None else options.port

    def make_host(**callbacks: Any) -> Host:
        return Host(
            scene,
            source=options.source,
            device=options.device,
            quality=options.quality,
            budget_ms=options.budget_ms,
            frames=options.frames,
            **callbacks,
        )

    def ready(address: Address) -> None:
        print(f"warp_ar: {scene.name} is at {address.url} (Ctrl-C ends it)", flush=True)
        if (outside := address.outside_url) is not None:
            print(f"warp_ar: from other machines, {outside}", flush=True)
        if not options.no_browser and local and _has_display():
            webbrowser.open(address.url)

    # A shell that starts this in the background has it ignore the signal; here it is the only way to end.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    server = Server(make_host, Address(options.host, port, token, tls))
    try:
        asyncio.run(server.serve(ready, tries=PORT_TRIES if options.port is None else 1))
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    return EXIT_DONE


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


def _ball_report(scene: str | Path, session: Session) -> dict[str, Any]:
    """Say how far from where the scene has them the mirror balls were found."""
    given = load_scene(scene).probes
    found = []
    for index, (fit, before, after) in enumerate(zip(session.ball_fits, given, session.scene.probes, strict=False)):
        offset = [round(1e3 * (b - a), 2) for a, b in zip(before.center, after.center, strict=True)]
        good = fit is not None and fit.is_good
        found.append({"offset_mm": offset, "deviation_mm": round(1e3 * fit.deviation, 2) if fit and good else None})
        what = f"moved by {offset} mm" if good else "left where the scene has it: too little of the desk shows in it"
        print(f"warp_ar: mirror ball {index} {what}", file=sys.stderr)
    return {"balls": found} if found else {}


def _compile(session: Session, *, shown: bool) -> None:
    """Have the kernels ready, with a bar where some must be compiled."""
    bar = Progress(
        TextColumn("compiling kernels, once for this kind of scene"),
        BarColumn(),
        MofNCompleteColumn(),
        disable=not shown,
    )
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
    if options.frames is not None and options.frames < 1:
        raise UsageError(f"--frames {options.frames}: expected a number of frames, 1 or more")
    if options.budget_ms is not None and not 0.0 < options.budget_ms < float("inf"):
        raise UsageError(f"--budget-ms {options.budget_ms:g}: expected milliseconds above 0")
    if options.budget_ms is not None and options.quality != AUTO:
        raise UsageError(f"--budget-ms {options.budget_ms:g} needs --quality {AUTO}")
    if options.output is None and not options.headless:
        return serve_page(options)
    output = options.output
    outputs = ["image"]
    if options.save_environment is not None:
        _prepare_folder(options.save_environment)
        outputs.append("environment")
    if options.report is not None:
        _prepare_file(options.report)
        outputs.append("pose")

    with contextlib.ExitStack() as stack:
        session = stack.enter_context(
            Session(
                options.scene,
                source=options.source,
                calibration=options.calibration,
                device=options.device,
                quality=options.quality,
                budget_ms=options.budget_ms,
                outputs=tuple(outputs),
                loop=options.loop,
                refine_ball=options.refine_ball,
            )
        )
        balls = _ball_report(options.scene, session)
        _compile(session, shown=not options.headless)
        source = session.source
        sink = NullSink() if output is None else open_sink(output, fps=source.fps, size=session.pipeline.size)
        log = RunLog(session.pipeline)
        total = (
            options.frames
            if options.loop or source.length is None
            else min(options.frames or source.length, source.length)
        )
        progress = Progress(
            TextColumn(session.scene.name),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[fps]:.1f} fps"),
            TimeRemainingColumn(),
            disable=options.headless,
        )
        bar = progress.add_task("frames", total=total, fps=0.0)
        try:
            with sink, _interruptible() as interrupted, progress:
                for _, result in itertools.islice(session, options.frames):
                    image, decode_ms = result.image, session.decode_ms
                    start = time.perf_counter()
                    sink.write(image)
                    encode_ms = (time.perf_counter() - start) * 1e3
                    if result.environment is not None:
                        write_environment(options.save_environment / f"{log.count:04d}.exr", result.environment)
                    log.add(result, decode_ms=decode_ms, encode_ms=encode_ms)
                    progress.update(bar, advance=1, fps=log.fps)
                    if log.count == MARKER_PATIENCE:
                        _check_marker(log, session.scene, live=source.live)
                    if interrupted():
                        break
                stopped = interrupted()
            if log.count < MARKER_PATIENCE and not stopped:
                _check_marker(log, session.scene, live=source.live)
        except WarpArError as error:
            raise RunError(f"{error} ({log.count} frames were written)") from error
        finally:
            if options.report is not None:
                options.report.write_text(json.dumps({**log.report(), **balls}, indent=1))
    if not options.headless:
        print_plan(session.pipeline.plan, log)
        if isinstance(session.pipeline, AutoPipeline):
            _print_choice(session.pipeline)
        steps = ", ".join(f"{name} {milliseconds:.1f}" for name, milliseconds in log.steps().items())
        Console().print(f"side by side, in ms: {steps}", highlight=False)
        Console().print(f"{log.count} frames, {log.fps:.1f} fps, written to {output}", highlight=False)
    return EXIT_INTERRUPTED if stopped else EXIT_DONE


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code: 0 done, 1 failed while running, 2 bad usage or scene, 130 interrupted."""
    try:
        return run(make_parser().parse_args(arguments))
    except RunError as error:
        print(f"warp_ar: {error}", file=sys.stderr)
        return EXIT_FAILED
    except WarpArError as error:
        print(f"warp_ar: {error}", file=sys.stderr)
        return EXIT_USAGE
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED


if __name__ == "__main__":
    faulthandler.enable()  # should native code crash, the report says what it was at
    sys.exit(main())
