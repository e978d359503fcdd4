"""``python -m warp_ar.doctor my_desk``: what is wrong with a set-up, what it spoils, and what to do about it."""

from __future__ import annotations

if __name__ == "__main__":
    from warp_ar.begin import begin

    begin("warp_ar.doctor")

import argparse
import dataclasses
import itertools
import math
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from warp_ar.begin import importing
from warp_ar.command_line import EXIT_DONE, EXIT_FAILED, Parser, run_command
from warp_ar.errors import UsageError, printable
from warp_ar.input.checkup import FRAMES, check_up, source_of
from warp_ar.input.finding import Finding, worst_first
from warp_ar.scene import Camera, Pose, Scene, bundled_scenes, load_scene

DEVICES = Path("/dev")
"""Where the system lists capture devices."""
FEW_SIDES = 5
"""Directions from which a table must be seen to tell whether it mirrors."""
APART = 4.0
"""Degrees between these."""
MISLEADING = ("units.", "source.", "camera.", "marker.", "ball.outside", "ball.unfound", "ball.place", "ball.radius")
"""Beginnings of names of findings with which pictures do not say what a table mirrors."""


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


def look_for_polish(scene: Scene, source: str | int | Path | None, frames: int) -> str | None:
    """A line that says how a table mirrors its surroundings, and what to write of it.

    Args:
        scene: With a card, a mirror ball and a plane.
        source: A recording; what else it may be is not asked.
        frames: How many to look at.

    Returns:
        None where they do not tell that it does, or the scene says it already.
    """
    planes = [proxy for proxy in scene.proxies if proxy.shape == "plane"]
    asked = scene.probes and scene.has_marker and planes and not any(proxy.material for proxy in scene.proxies)
    if not asked or source is None or not Path(str(source)).exists():
        return None
    with importing():
        from warp_ar.kernels.color import decode_table
        from warp_ar.light.polish import estimate_polish

    camera, views, environment = _see_from_sides(scene, source, frames)
    if environment is None or len(views) < FEW_SIDES:
        return None
    polish = estimate_polish(scene, camera, views, environment, decode_table(camera.transfer))
    if polish is None:
        return None
    said = "roughness = {:.2g} ({:.2g} to {:.2g}), ".format(*polish.roughness)
    if polish.reflectance is None:
        said += "reflectance = 0.04, as lacquer has it: only lamps that clip in the ball are mirrored"
    else:
        said += "reflectance = {:.2g} ({:.2g} to {:.2g})".format(*polish.reflectance)
    return f"table: it mirrors its surroundings, as {len(views)} views tell; [proxy.material] shows it: {said}"


def _see_from_sides(scene: Scene, source: str | int | Path, frames: int) -> tuple[Camera, list[Any], Any]:
    """The camera, views that differ in direction, and the environment as the ball shows it; None: it shows none."""
    with importing():
        import numpy as np

        from warp_ar.session import Session
        from warp_ar.stages.quality import PRESETS

    quality = PRESETS["medium"].with_methods(recover="clipped")
    bare = dataclasses.replace(scene, objects=(), lights=())
    views: list[tuple[Any, Pose]] = []
    environment = None
    with Session(bare, source=source, quality=quality, outputs=("environment",)) as session:
        camera = scene.camera.scaled_to(*session.source.size)
        for frame, result in itertools.islice(session, frames):
            if result.pose is None or result.environment is None or frame.image.dtype != np.uint8:
                continue
            environment = np.array(result.environment)
            ahead = result.pose.rotation[2]
            if all(ahead @ pose.rotation[2] < math.cos(math.radians(APART)) for _, pose in views):
                views.append((np.array(frame.image), result.pose))
    return camera, views, environment


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
    if not any(finding.name.startswith(MISLEADING) for finding in found):
        told += [line for line in (look_for_polish(scene, source, options.frames),) if line]
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
