"""``python -m warp_ar.doctor my_desk``: finds faults of a set-up, their effects and their remedies."""

from __future__ import annotations

if __name__ == "__main__":
    from warp_ar.begin import begin

    begin("warp_ar.doctor")

import argparse
import dataclasses
import math
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from warp_ar.begin import importing
from warp_ar.checks.check_pictures import Look
from warp_ar.checks.checkup import FRAMES, check_and_look
from warp_ar.checks.finding import Finding, worst_first
from warp_ar.command_line import EXIT_DONE, EXIT_FAILED, Parser, count, file_to_amend, run_command
from warp_ar.errors import printable, say
from warp_ar.scene import Pose, Scene, bundled_scenes, load_scene
from warp_ar.scene.starter import amend_scene
from warp_ar.sources.sources import source_of

DEVICES = Path("/dev")
"""Folder in which the system lists capture devices."""
FEW_SIDES = 5
"""Directions from which a table must be seen to measure its reflection."""
APART = 4.0
"""Least angle between directions from which a table is seen, degrees."""
MISLEADING = ("units.", "source.", "camera.", "marker.", "ball.outside", "ball.unfound", "ball.place", "ball.radius")
"""Prefixes of the names of findings that make measurements of the table's reflection unreliable."""
STEP = 0.5
"""Seconds between two directions on the clock that gathers light; light of the last direction no longer counts then."""


@dataclasses.dataclass(frozen=True)
class TablePolish:
    """Reflection of the scene's table, estimated from frames."""

    values: dict[str, float]
    """Rounded values of the keys of ``[proxy.material]``."""
    proxy: int
    """Index of the ``[[proxy]]``."""
    lines: tuple[str, ...]
    """The result in words, one string per line."""


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command's options."""
    parser = Parser(
        prog="python -m warp_ar.doctor",
        description="Check units, camera, card, mirror ball, light and this machine; print all faults. The exit code "
        "is 1 if there are any.",
    )
    text = "scene file, its folder, or a bundled scene's name"
    parser.add_argument("scene", metavar="SCENE", help=text)
    parser.add_common("--source")
    text = f"frames to check (default: {FRAMES})"
    parser.add_argument("--frames", type=count, default=FRAMES, metavar="N", help=text)
    text = "write [proxy.material] into the scene file if the table mirrors"
    parser.add_argument("--write", action="store_true", help=text)
    return parser


def check_machine() -> tuple[list[str], list[Finding]]:
    """Return a description of this machine, one line per part, and the faults found."""
    # Imported here: it loads Warp.
    with importing():
        import av
        import warp as wp

        from warp_ar.device import resolve_device, usable_cores

    device = resolve_device("auto")
    told = [f"device: {device.name} ({usable_cores()} cores)" if device.is_cpu else f"device: {device.name}"]
    driver = wp.get_cuda_driver_version()
    version = "none for CUDA, so kernels run on the CPU" if driver is None else f"CUDA {driver[0]}.{driver[1]}"
    told.append(f"driver: {version}")
    cache = str(wp.config.kernel_cache_dir)
    told.append(f"kernels: kept in {printable(cache)}; the first run of a kind of scene compiles them")
    missing = ", ".join(sorted({"libx264", "h264"} - av.codecs_available))
    told.append(f"codecs: {'without ' + missing if missing else 'H.264 is written and read'}")
    remedy = "install PyAV's own wheel: pip install av"
    return told, [Finding("machine.codec", f"PyAV has no {missing}", remedy)] if missing else []


def check_access(scene: Scene, source: str | int | Path | None) -> list[Finding]:
    """Return findings about the capture device: it must exist and be accessible. Only Linux lists devices."""
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


def look_for_polish(scene: Scene, look: Look, tell: Callable[[str], object] | None = None) -> TablePolish | None:
    """Measure the reflection of a table from frames; return the result in words and the keys to write.

    Args:
        scene: Scene with a card, a mirror ball and a plane.
        look: Frames of the scene.
        tell: Function that receives a line about the measurement in progress, for people.

    Returns:
        None if the frames show no reflection, or the scene has the keys already.
    """
    planes = [index for index, proxy in enumerate(scene.proxies) if proxy.shape == "plane"]
    asked = scene.probes and scene.has_marker and planes and not any(proxy.material for proxy in scene.proxies)
    views = _sides(look.views) if asked else []
    if len(views) < FEW_SIDES:
        return None
    with importing():
        from warp_ar.light.polish import USUAL, estimate_polish

    environment = _gather_light(scene, views, tell)
    if tell is not None:
        tell("checking whether the table reflects its surroundings")
    polish = estimate_polish(scene, look.camera, views, environment, look.table)
    if polish is None:
        return None
    roughness, reflectance = polish.roughness, polish.reflectance
    values = {"roughness": roughness[0], "reflectance": USUAL if reflectance is None else reflectance[0]}
    values = {name: float(f"{value:.2g}") for name, value in values.items()}
    spread = "only lamps that clip in the ball are mirrored, so the reflectance is lacquer's"
    if reflectance is not None:
        spread = "reflectance {:.2g} to {:.2g}".format(*reflectance[1:])
    spread = "roughness {:.2g} to {:.2g}, ".format(*roughness[1:]) + spread
    lines = f"table: it mirrors its surroundings, as {len(views)} views tell ({spread}); below its [[proxy]]:"
    written = [f"    {name} = {value:g}" for name, value in values.items()]
    return TablePolish(values, planes[0], (lines, "    [proxy.material]", *written))


def _sides(views: Sequence[tuple[Any, Pose]]) -> list[tuple[Any, Pose]]:
    """Return the views whose directions differ by ``APART`` or more."""
    found: list[tuple[Any, Pose]] = []
    for image, pose in views:
        ahead = pose.rotation[2]
        if all(ahead @ other.rotation[2] < math.cos(math.radians(APART)) for _, other in found):
            found.append((image, pose))
    return found


def _gather_light(scene: Scene, views: list[tuple[Any, Pose]], tell: Callable[[str], object] | None) -> Any:
    """Return the environment that the ball shows, without recovered light."""
    with importing():
        import numpy as np

        from warp_ar.engine.pipeline import Pipeline
        from warp_ar.stages.quality import PRESETS

    quality = PRESETS["medium"].with_methods(recover="clipped")
    bare = dataclasses.replace(scene, objects=(), lights=())
    height, width = views[0][0].shape[:2]
    with Pipeline(bare, quality=quality, size=(width, height), outputs=("environment",)) as pipeline:
        for number, (image, pose) in enumerate(views, 1):
            if tell is not None:
                tell(f"gathering light from direction {number} of {len(views)}")
            result = pipeline(image, time_seconds=STEP * number, pose=pose)
        return np.array(result.environment)


def _write_polish(scene: Scene, polish: TablePolish | None, misled: bool) -> None:
    """Write the table's measured reflection into the scene file; if nothing is written, print the reason."""
    if polish is not None and scene.path is not None:
        amend_scene(scene.path, "proxy", {"material": polish.values}, index=polish.proxy)
        print(f"{printable(scene.path)}: its [[proxy]] has these values now")
    elif any(proxy.material for proxy in scene.proxies):
        say("nothing is written: the scene has a [proxy.material]; remove it to have it measured again")
    elif misled:
        say("nothing is written: with the faults above, frames do not show how the table reflects")
    else:
        say("nothing is written: the frames show no reflections in the table; see polished receivers in the docs")


def _run(options: argparse.Namespace) -> int:
    scene = load_scene(options.scene)
    if options.write:
        file_to_amend(scene, options.scene)
    told, found = check_machine()
    source = source_of(scene, options.source)
    if source is None:
        told.append("frames: the scene names none, so only its numbers are checked; give --source")
    access = check_access(scene, options.source)
    polish = None
    with Console(stderr=True).status("looking at the frames") as status:
        # A device without access is not opened: the error of opening it would say less.
        given = None if access else source
        checked, look = check_and_look(scene, given, frames=options.frames, tell=status.update)
        found = worst_first([*found, *access, *checked])
        misled = any(finding.name.startswith(MISLEADING) for finding in found)
        if look is not None and not misled:
            polish = look_for_polish(scene, look, status.update)
    own = None if scene.path in bundled_scenes().values() else str(options.scene)
    if polish is not None:
        told += polish.lines
    for line in told:
        print(line)
    if options.write:
        _write_polish(scene, polish, misled)
    for number, finding in enumerate(found, 1):
        print(f"{number}. {printable(finding.text)} [{finding.name}]")
        print(f"   spoils: {finding.cost}")
        print(f"   do: {printable(finding.remedy_for(own))}")
    if found:
        print("FLIP is the mean visible difference, 0 to 1, that the fault in brackets makes in the picture;")
        print("0.01 is visible only next to the correct picture, 0.05 at once")
    else:
        print("nothing wrong was found")
    return EXIT_FAILED if found else EXIT_DONE


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    return run_command(lambda: _run(make_parser().parse_args(arguments)))
