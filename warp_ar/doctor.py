"""``python -m warp_ar.doctor my_desk``: what is wrong with a set-up, what it spoils, and what to do about it."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from warp_ar.command_line import EXIT_DONE, EXIT_FAILED, Parser, run_command
from warp_ar.errors import UsageError, printable
from warp_ar.input.checkup import FRAMES, check_up, source_of
from warp_ar.input.finding import Finding, worst_first
from warp_ar.scene import load_scene


def make_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = Parser(
        prog="python -m warp_ar.doctor",
        description="Say what is wrong with a set-up: units, camera, card, mirror ball, light, and this machine. "
        "Ends with 0 where nothing is found, with 1 where something is.",
    )
    text = "a scene file, a folder with one, or a bundled scene's name"
    parser.add_argument("scene", metavar="SCENE", help=text)
    parser.add_argument("--source", metavar="PATH|INDEX", help="frames, if not the scene's own")
    parser.add_argument(
        "--frames", type=int, default=FRAMES, metavar="N", help=f"frames to look at (default: {FRAMES})"
    )
    return parser


def check_machine() -> tuple[list[str], list[Finding]]:
    """What this machine has, one line each, and what it lacks."""
    # Here, for it loads Warp.
    import av
    import warp as wp

    from warp_ar.device import resolve_device, usable_cores

    device = resolve_device("auto")
    told = [f"device: {device.name} ({usable_cores()} cores)" if device.is_cpu else f"device: {device.name}"]
    cache = str(wp.config.kernel_cache_dir)
    found: list[Finding] = []
    told.append(f"kernels: kept in {printable(cache)}; the first run of a kind of scene compiles them")
    missing = []
    for name in ("libx264", "h264"):
        try:
            av.codec.Codec(name, "w" if name == "libx264" else "r")
        except ValueError:
            missing.append(name)
    told.append(f"codecs: {'H.264 is written and read' if not missing else 'without ' + ', '.join(missing)}")
    if missing:
        found.append(
            Finding("machine.codec", f"PyAV has no {', '.join(missing)}", "install PyAV's own wheel: pip install av")
        )
    return told, found


def _run(options: argparse.Namespace) -> int:
    if options.frames < 1:
        raise UsageError(f"--frames {options.frames}: expected a number of frames, 1 or more")
    scene = load_scene(options.scene)
    told, found = check_machine()
    source = source_of(scene, options.source)
    if source is None:
        told.append("frames: the scene names none, so only its numbers are checked; give --source")
    found = worst_first([*found, *check_up(scene, source, frames=options.frames)])
    for line in told:
        print(line)
    for number, finding in enumerate(found, 1):
        print(f"{number}. {printable(finding.text)} [{finding.name}]")
        print(f"   spoils: {finding.cost}")
        print(f"   do: {printable(finding.remedy)}")
    if not found:
        print("nothing wrong was found")
    return EXIT_FAILED if found else EXIT_DONE


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    return run_command(lambda: _run(make_parser().parse_args(arguments)))


if __name__ == "__main__":
    sys.exit(main())
