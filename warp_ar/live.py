"""The command: ``python -m warp_ar.live [SCENE]`` turns camera frames into consistently lit frames."""

from __future__ import annotations

if __name__ == "__main__":
    from warp_ar.begin import begin

    begin("warp_ar.live")

import argparse
from collections.abc import Sequence
from pathlib import Path

from warp_ar.command_line import EXIT_DONE, Parser, run_command
from warp_ar.errors import UsageError
from warp_ar.live_clip import RunError, light_clip
from warp_ar.live_page import DEFAULT_PORT, serve_page
from warp_ar.output.encoders import CODINGS, describe_encoders
from warp_ar.output.sinks import FOLDER_CODINGS
from warp_ar.scene import bundled_scenes
from warp_ar.scene.description import LATLONG_AXES
from warp_ar.stages.quality import AUTO, DEFAULT_BUDGET_MS, DEFAULT_PRESET, PRESETS
from warp_ar.stages.request import LAYERS


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
        help="frames from this folder, picture, video file, capture device or stream (rtsp://..., http://...), "
        "not the scene's own",
    )
    add(
        "--calibration",
        metavar="FILE|exif",
        help="OpenCV camera calibration, YAML or JSON, instead of the scene's numbers; exif: the first picture's",
    )
    add("--light", metavar="FILE", help="captured light (.exr, .hdr) instead of what a mirror ball in the frames shows")
    text = "axes of --light (default: as the file says, else y-up of .exr and blender of .hdr)"
    add("--light-axes", choices=LATLONG_AXES, help=text)
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


def run(options: argparse.Namespace) -> int:
    """Build everything that ``options`` ask for, then let frames flow until they end.

    Raises:
        UsageError: Options make no sense, or do not fit each other.
    """
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code.

    0 done, 1 failed while running, 2 bad usage or scene, 130 interrupted, 143 terminated.
    """
    return run_command(lambda: run(make_parser().parse_args(arguments)), RunError)
