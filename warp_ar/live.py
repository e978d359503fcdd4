"""The command: ``python -m warp_ar.live [SCENE]`` turns camera frames into consistently lit frames."""

from __future__ import annotations

if __name__ == "__main__":
    from warp_ar.begin import begin

    begin("warp_ar.live")

import argparse
import functools
from collections.abc import Sequence
from pathlib import Path

from warp_ar.command_line import EXIT_DONE, LEAST, Parser, count, number, run_command
from warp_ar.errors import UsageError
from warp_ar.live_clip import RunError, light_clip
from warp_ar.live_page import DEFAULT_PORT, serve_page
from warp_ar.output.encoders import CODINGS, describe_encoders
from warp_ar.output.sinks import FOLDER_CODINGS
from warp_ar.scene import bundled_scenes
from warp_ar.stages.quality import AUTO, DEFAULT_BUDGET_MS, DEFAULT_PRESET, PRESETS
from warp_ar.stages.request import LAYERS


def make_parser() -> Parser:
    """Return the parser of the command's options."""
    parser = Parser(
        prog="python -m warp_ar.live",
        usage="%(prog)s [SCENE] [OPTIONS]",
        description="Render virtual objects into frames of a desk with a marker and a mirror ball. Without --output or "
        "--headless, show them on a page in the browser.",
    )
    files, page = parser.add_argument_group("files"), parser.add_argument_group("the page")
    add, rare = parser.add_argument, functools.partial(parser.add_rare, group=parser)
    parser.add_common("scene", "--source", "--calibration", "--light", "--device", "--frames")
    add("--list", action="store_true", help="list the bundled scenes and stop")
    text = f"{', '.join(PRESETS)}, or {AUTO}: smallest error within a budget (default: {DEFAULT_PRESET})"
    add("--quality", default=DEFAULT_PRESET, metavar="NAME", help=text)
    parser.add_common("--light-axes", add=rare)
    text = f"milliseconds per frame for --quality {AUTO} (default: {DEFAULT_BUDGET_MS:g})"
    rare("--budget-ms", type=number(LEAST, 1e9, "milliseconds above 0"), metavar="X", help=text)
    rare("--loop", action="store_true", help="repeat the clip; the page always does")
    text = "with --output or --headless: first measure the ball's place"
    rare("--refine-ball", action="store_true", help=text)
    text = "with --output or --headless: path-trace N samples per pixel"
    rare("--samples", type=count, metavar="N", help=text)
    text = "with --samples: relative standard error to stop at, such as 0.05"
    rare("--error", type=number(LEAST, 1e9, "a number above 0, such as 0.05"), metavar="E", help=text)
    add, rare = files.add_argument, functools.partial(parser.add_rare, group=files)
    add("--output", type=Path, metavar="FILE.mp4|DIR", help="write frames: H.264, or a folder of PNG")
    text = "no page or progress; write only files that options name"
    add("--headless", action="store_true", help=text)
    parser.add_common("--overwrite", add=add)
    add("--report", type=Path, metavar="FILE.json", help="write poses and timings of every frame")
    add("--verbose", action="store_true", help="print a table of all stages at the end")
    text = "10bit, pq, hlg for video; 16bit, exr for folders (default: 8bit)"
    rare("--coding", choices=tuple(dict.fromkeys((*CODINGS, *FOLDER_CODINGS))), default="8bit", help=text)
    text = "FFmpeg encoder of the video; list: print this machine's encoders"
    rare("--encoder", metavar="NAME|list", help=text)
    text = "an option of the encoder, such as crf=23; repeatable"
    rare("--encoder-option", action="append", default=[], metavar="KEY=VALUE", help=text)
    text = "output frames as a virtual camera, such as /dev/video4 (default: the first)"
    rare("--virtual-camera", nargs="?", const="", metavar="DEVICE", help=text)
    text = "write each frame's captured light as NNNN.exr"
    rare("--save-environment", type=Path, metavar="DIR", help=text)
    text = "write each frame's layers as a multi-part NNNN.exr"
    rare("--save-layers", type=Path, metavar="DIR", help=text)
    text = f"with --save-layers, separated by commas: {', '.join(LAYERS)} (default: all)"
    rare("--layers", metavar="NAMES|all", help=text)
    rare("--layer-pictures", action="store_true", help="with --save-layers: also write PNG of layers that it can hold")
    add, rare = page.add_argument, functools.partial(parser.add_rare, group=page)
    text = "address to serve at; 0.0.0.0: also for other machines, with a token"
    add("--host", default="127.0.0.1", metavar="ADDRESS", help=text)
    text = "serve over TLS, needed for phones' cameras; without FILE makes a certificate"
    add("--tls", nargs="?", const=True, metavar="FILE.pem", help=text)
    add("--no-browser", action="store_true", help="only print the page's address")
    text = f"port (default: {DEFAULT_PORT}, or the next free one)"
    rare("--port", type=number(0, 65535, "a port, 0 to 65535; 0 takes a free one", int), metavar="N", help=text)
    text = "secret in the page's address (default: random if others reach the page)"
    rare("--token", metavar="SECRET", help=text)
    text = "site that may read the light, such as http://localhost:5173; repeatable"
    rare("--allow-origin", action="append", default=[], metavar="ORIGIN", help=text)
    return parser


def run(options: argparse.Namespace) -> int:
    """Build the run that ``options`` describe and light frames until they end.

    Raises:
        UsageError: An option has an impossible value, or options do not fit each other.
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
