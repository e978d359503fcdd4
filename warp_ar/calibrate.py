"""``python -m warp_ar.calibrate``: print a marker, and measure the camera, its response, and where the ball stands.

card      writes the card, or a marker or board, as a PDF or PNG that prints at true size
camera    pictures of a ChArUco board to an OpenCV YAML file, which ``--calibration`` and a scene's ``calibration``
          read
ball      frames of a scene to its mirror ball's centre, for the scene's ``[probe]``
response  pictures of the card's greys, or of any scene at several exposures, to a response curve, for the scene's
          ``transfer``
"""

from __future__ import annotations

if __name__ == "__main__":
    from warp_ar.begin import begin

    begin("warp_ar.calibrate")

import argparse
import dataclasses
import itertools
import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from warp_ar.ball.ball import posed_frames
from warp_ar.ball.ball_measure import measure_ball
from warp_ar.calibration.camera_calibration import calibrate_camera, write_camera
from warp_ar.calibration.card import PAPERS, write_card
from warp_ar.calibration.response import MOST_DEVIATION, measure_grey_response, measure_response, write_response
from warp_ar.checks.check_ball import DULL, inside_contrast
from warp_ar.command_line import EXIT_DONE, EXIT_FAILED, FROM_0, Parser, count, file_to_amend, run_command, seconds
from warp_ar.errors import UsageError, say
from warp_ar.output.places import check_places, check_replaceable
from warp_ar.scene import CharucoBoard, Marker, load_scene, loads_scene
from warp_ar.scene.description import INTRINSICS
from warp_ar.scene.starter import amend_scene, camera_guess
from warp_ar.sources.sources import open_source, source_of
from warp_ar.tracking.card_layout import CARD_MARKER

Image = NDArray[np.uint8]


def _marker(options: argparse.Namespace) -> Marker | None:
    """Return the marker that the options describe, checked like a marker of a scene; None if no option is given."""
    given = {key: getattr(options, key, None) for key in ("dictionary", "board", "id", "size")}
    if all(value is None for value in given.values()):
        return None
    lines = [f"dictionary = {json.dumps(given['dictionary'] or Marker.dictionary)}"]
    if given["board"] is not None:
        lines.append(f"board = {json.dumps(given['board'])}")
    else:
        lines += [f"id = {given['id'] or 0}", f"size = {Marker.size if given['size'] is None else given['size']}"]
    return loads_scene("\n".join(["schema = 1", 'name = "options"', _CAMERA, "[marker]", *lines]), "options").marker


_CAMERA = "[camera]\nwidth = 2\nheight = 2\nfx = 2.0\nfy = 2.0\ncx = 0.5\ncy = 0.5"


def _pictures(paths: Sequence[str], most: int | None = None) -> Iterable[Image]:
    for path in paths:
        if (Path(path) / "scene.toml").is_file():
            raise UsageError(f"{path}: is the folder of a scene; expected photographs or a film that you took")
        with open_source(path) as source:
            for frame in itertools.islice(source, most):
                yield frame.image


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command's options."""
    parser = Parser(
        prog="python -m warp_ar.calibrate", description="Print a marker; measure the camera, its response, the ball."
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="card|camera|ball|response")

    def add(name: str, text: str, output: str | None) -> Any:
        command = commands.add_parser(name, help=text, description=text)
        if output is not None:
            command.add_argument(
                "--output", type=Path, default=Path(output), metavar="FILE", help=f"file to write (default: {output})"
            )
            command.add_common("--overwrite")
        return command.add_argument

    board = f'a board, as in a scene: "{CARD_MARKER.board}", "grid 4x3 0.04 0.01" (metres)'
    option = add("card", "write the card, or a marker or board of your own, to print at true size", "card.pdf")
    option("--dictionary", metavar="NAME", help=f"OpenCV dictionary of a single marker (default: {Marker.dictionary})")
    option("--id", type=FROM_0, metavar="N", help="print this marker instead of the card (default: 0)")
    option("--size", type=float, metavar="X", help="side of the marker's black square, metres (default: 0.08)")
    option("--board", metavar="TEXT", help=board)
    option("--paper", default="a4", metavar="|".join(PAPERS), help="size of the page (default: a4)")
    option("--dpi", type=float, default=600.0, help="dots per inch (default: 600)")
    option = add("camera", "calibrate the camera from pictures of a ChArUco board", "camera.yml")
    option("pictures", nargs="+", metavar="PATH|INDEX", help="folders, pictures, videos or a capture device")
    option("--dictionary", metavar="NAME", help="OpenCV dictionary (default: the pictured board's)")
    option("--board", metavar="TEXT", help=board + " (default: the pictured one)")
    text = "write camera.yml beside this scene and into its [camera]"
    option("--write", type=Path, metavar="SCENE", help=text)
    option("--frames", type=count, metavar="N", help="stop after N frames of each video or device")
    option("--fisheye", action="store_true", help="for fisheye lenses: action cameras, phones' widest")
    option = add("ball", "measure the place and radius of a scene's mirror ball", None)
    option("scene", metavar="SCENE", help="a scene with camera, marker and a rough [probe] with radius")
    option("--source", metavar="PATH|INDEX", help="frames instead of the scene's own")
    option("--frames", type=count, default=60, metavar="N", help="frames to use (default: 60)")
    option("--keep-radius", action="store_true", help="keep the scene's radius")
    option("--write", action="store_true", help="write center and radius into the scene file")
    text = "measure the response curve from the card's greys or a still scene"
    option = add("response", text, "response.txt")
    text = "the card under several exposures or lights; with --exposures any still scene"
    option("pictures", nargs="+", metavar="PATH|INDEX", help=text)
    text = "exposure times of the pictures in order, seconds, such as 1/200 1/50 0.08"
    option("--exposures", nargs="+", type=seconds, metavar="S", help=text)
    text = "frames of each video or device, without --exposures (default: 24)"
    option("--frames", type=count, default=24, metavar="N", help=text)
    text = "write response.txt beside this scene and into its [camera]"
    option("--write", type=Path, metavar="SCENE", help=text)
    return parser


def _run_camera(options: argparse.Namespace, target: Path | None) -> int:
    marker, pictures = _marker(options), _pictures(options.pictures, options.frames)
    if marker is not None and options.dictionary is None and isinstance(marker.board, CharucoBoard):
        report = calibrate_camera(pictures, board=marker.board, fisheye=options.fisheye)
    else:
        report = calibrate_camera(pictures, marker, fisheye=options.fisheye)
    c, interval = report.camera, 2 * report.focal_deviation
    for warning in report.warnings:
        say(warning)
    if target is not None and report.doubt:
        say(
            f"{report.doubt}, in {len(report.view_errors)} views: nothing is written. Take more pictures of the card, "
            "from other sides"
        )
        return EXIT_FAILED
    write_camera(report, options.output)
    print(f"{options.output}: fx {c.fx:.2f} fy {c.fy:.2f} (+/- {interval:.2f}) cx {c.cx:.2f} cy {c.cy:.2f}")
    print(f"board: {report.marker.board} ({report.marker.dictionary})")
    print(
        f"reprojection error {report.error:.3f} pixels over {len(report.view_errors)} views "
        f"(worst {max(report.view_errors):.3f}), {report.coverage:.0%} of the picture covered"
    )
    if target is not None:
        amend_scene(target, "camera", {"calibration": options.output.name}, remove=(*INTRINSICS, "field_of_view"))
        then = f"; next: python -m warp_ar.calibrate ball {options.write} --write"
        print(f"{target}: [camera] uses it now{then if load_scene(target).probes else ''}")
    return EXIT_DONE


def _run_ball(options: argparse.Namespace) -> int:
    scene = load_scene(options.scene)
    if options.write:
        file_to_amend(scene, options.scene)
    if not scene.probes:
        raise UsageError(f"{options.scene}: expected a [probe] with a rough center and the radius")
    spec = source_of(scene, options.source)
    if spec is None:
        raise UsageError(f"{options.scene}: names no frames; give --source")
    with open_source(spec) as source:
        camera = scene.camera.scaled_to(*source.size)
        views = posed_frames(source, scene.marker, camera, options.frames)
    if not views:
        count = min(source.length or options.frames, options.frames)
        looked = "the only frame" if count == 1 else f"the first {count} frames"
        raise UsageError(f"{spec}: no marker in {looked}; see [marker] in {options.scene}")
    if guess := camera_guess(scene):
        say(f"{guess}; until then the results are no better than this guess")
    views, code = views[:: -(-len(views) // 12)], EXIT_DONE
    say(f"measuring the ball in {len(views)} frames, which takes some seconds")
    for index, probe in enumerate(scene.probes):
        others = [other for other in scene.probes if other is not probe]
        with Console(stderr=True).status("looking at the frames") as status:
            report = measure_ball(
                views, camera, probe, scene.proxies, others, keep_radius=options.keep_radius, tell=status.update
            )
        moved = 1e3 * math.dist(report.center, probe.center)
        x, y, z = report.center
        print(
            f"probe {index}: center = [{x:.5f}, {y:.5f}, {z:.5f}]  +/- {2e3 * report.deviation:.1f} mm "
            f"({moved:.1f} mm off the scene's; {report.how})"
        )
        known = "assumed" if report.radius_deviation is None else f"+/- {2e3 * report.radius_deviation:.1f} mm"
        print(f"probe {index}: radius = {report.radius:.5f}  {known}")
        if report.radius_deviation is None and not options.keep_radius:
            say(
                f"probe {index}: the frames are too similar to measure the radius; the scene's is kept. Move the "
                "camera around"
            )
        if inside_contrast(views, camera, dataclasses.replace(probe, center=report.center)) < DULL:
            say(f"probe {index}: its picture shows no reflections: is the ball there, uncovered and polished?")
            code = EXIT_FAILED
        elif not report.is_usable:
            say(
                f"probe {index}: this interval is too wide to be used: have the whole ball in every frame, where "
                "[probe] has it, and move the camera around it"
            )
            code = EXIT_FAILED
        elif options.write and scene.path is not None:
            center = [round(value, 5) for value in report.center]
            amend_scene(scene.path, "probe", {"center": center, "radius": round(report.radius, 5)}, index=index)
            print(f"{scene.path}: [probe] has these values now; next: python -m warp_ar.doctor {options.scene}")
    return code


def _run_response(options: argparse.Namespace, target: Path | None) -> int:
    told = "sRGB: 0.2159"
    if options.exposures is None:
        found = measure_grey_response(_pictures(options.pictures, options.frames))
        curve, interval, (low, high) = found.curve, 2 * found.deviation[128].max(), found.span
        if target is not None and interval > MOST_DEVIATION:
            say(
                f"the curve is known only to +/- {interval:.0%} from {found.views} pictures, so it may be sRGB: "
                "nothing is written. Take pictures of the card under exposures or lamps that differ more"
            )
            return EXIT_FAILED
        told += f"; +/- {interval:.0%}, by {found.views} pictures with codes {low:.0f} to {high:.0f}"
    else:
        curve = measure_response(list(_pictures(options.pictures)), options.exposures)
    write_response(curve, options.output)
    middle = ", ".join(f"{v:.4f}" for v in curve[128])
    print(f"{options.output}: code 128 is {middle} of clipping ({told})")
    if target is not None:
        amend_scene(target, "camera", {"transfer": options.output.name})
        print(f"{target}: [camera] uses it now")
    return EXIT_DONE


def _target(options: argparse.Namespace) -> Path | None:
    """Return the scene file to write a camera or response into; None without ``--write``."""
    if options.command not in ("camera", "response") or options.write is None:
        return None
    path = file_to_amend(load_scene(options.write), options.write)
    options.output = path.parent / options.output.name
    return path


def _run(options: argparse.Namespace) -> int:
    target = _target(options)
    if options.command != "ball":
        pictures = [Path(path) for path in getattr(options, "pictures", ())]
        check_places({"the picture": pictures}, {"--output": options.output})
        if replaced := check_replaceable(options.output, overwrite=options.overwrite):
            say(replaced)
    if options.command == "card":
        write_card(_marker(options) or CARD_MARKER, options.output, options.paper, options.dpi)
        print(
            f"{options.output}: print at 100 %, not fitted to the page, and check with a ruler that 100 mm are 100 mm"
        )
    elif options.command == "camera":
        return _run_camera(options, target)
    elif options.command == "response":
        return _run_response(options, target)
    else:
        return _run_ball(options)
    return EXIT_DONE


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    return run_command(lambda: _run(make_parser().parse_args(arguments)))
