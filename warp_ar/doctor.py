"""``python -m warp_ar.doctor my_desk``: what is wrong with a set-up, what it spoils, and what to do about it."""

from __future__ import annotations

if __name__ == "__main__":
    from warp_ar.begin import begin

    begin("warp_ar.doctor")

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from warp_ar.begin import importing
from warp_ar.command_line import EXIT_DONE, EXIT_FAILED, Parser, run_command
from warp_ar.errors import UsageError, printable
from warp_ar.input.checkup import FRAMES, check_up, source_of
from warp_ar.input.finding import Finding, worst_first
from warp_ar.scene import Scene, bundled_scenes, load_scene

DEVICES = Path("/dev")
"""Where the system lists capture devices."""


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
    with importing():
        import av
        import warp as wp

        from warp_ar.device import resolve_device, usable_cores

    device = resolve_device("auto")
    told = [f"device: {device.name} ({usable_cores()} cores)" if device.is_cpu else f"device: {device.name}"]
    driver = wp.get_cuda_driver_version()
    told.append(
        "driver: " + ("none for CUDA, so kernels run on the CPU" if driver is None else f"CUDA {driver[0]}.{driver[1]}")
    )
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


def check_access(scene: Scene, source: str | int | Path | None) -> list[Finding]:
    """Whether the capture device that the frames come from is there and may be opened; on Linux, which lists them."""
    index = source_of(scene, source)
    if isinstance(index, str) and index.isdecimal():
        index = int(index)
    if not isinstance(index, int) or not sys.platform.startswith("linux"):
        return []
    device = DEVICES / f"video{index}"
    if not device.exists():
        numbers = sorted(int(path.name[5:]) for path in DEVICES.glob("video*") if path.name[5:].isdecimal())
        there = f"there are {', '.join(map(str, numbers))}" if numbers else "there is none; plug one in"
        text = f"there is no capture device {index}"
        return [Finding("source.absent", text, f"{there}; set [source] camera, or give --source")]
    if not os.access(device, os.R_OK | os.W_OK):
        text = f"capture device {index} may not be opened by this user"
        return [Finding("source.permission", text, "join its group: sudo usermod -aG video $USER, then log in anew")]
    return []


def _run(options: argparse.Namespace) -> int:
    if options.frames < 1:
        raise UsageError(f"--frames {options.frames}: expected a number of frames, 1 or more")
    scene = load_scene(options.scene)
    told, found = check_machine()
    source = source_of(scene, options.source)
    if source is None:
        told.append("frames: the scene names none, so only its numbers are checked; give --source")
    access = check_access(scene, options.source)
    # What may not be opened is not tried: its own message would say less.
    checked = check_up(scene, None if access else source, frames=options.frames)
    found = worst_first([*found, *access, *checked])
    own = None if scene.path in bundled_scenes().values() else str(options.scene)
    for line in told:
        print(line)
    for number, finding in enumerate(found, 1):
        print(f"{number}. {printable(finding.text)} [{finding.name}]")
        print(f"   spoils: {finding.cost}")
        print(f"   do: {printable(finding.remedy_for(own))}")
    if found:
        print("FLIP is the mean visible difference of the lit picture, 0 to 1, measured for the fault in brackets;")
        print("0.01 is seen only beside the right picture, 0.05 at once")
    else:
        print("nothing wrong was found")
    return EXIT_FAILED if found else EXIT_DONE


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    return run_command(lambda: _run(make_parser().parse_args(arguments)))
