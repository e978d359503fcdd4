"""``python -m warp_ar.pose PLATE``: finds a photograph's camera pose, and writes a scene of it in captured light."""

from __future__ import annotations

if __name__ == "__main__":
    from warp_ar.begin import begin

    begin("warp_ar.pose")

import argparse
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from warp_ar.command_line import EXIT_DONE, LEAST, Parser, ending, number, pixel, run_command
from warp_ar.errors import SinkError, UsageError, say
from warp_ar.files import store
from warp_ar.light.captured import Light
from warp_ar.output.places import claim_places
from warp_ar.photographs.photographs import Photograph, read_photograph
from warp_ar.photographs.support import Support, focal_range, plane_from_points, plane_from_rectangle, scene_on
from warp_ar.scene import Camera, CapturedLight, dumps_scene
from warp_ar.scene.exif import FULL_FRAME_DIAGONAL

HARDLY_KNOWN = 1.2
"""Ratio of the largest to the least focal length that fits, above which the focal length counts as uncertain."""


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command's options."""
    parser = Parser(
        prog="python -m warp_ar.pose",
        description="Find a photograph's camera from a rectangle or known points; write a scene with two balls in "
        "light that capture wrote.",
    )
    add = parser.add_argument
    add("plate", type=Path, metavar="PLATE", help="photograph to put objects into")
    add("--light", type=Path, required=True, metavar="FILE", help="captured light, such as light.exr")
    add("--scene", type=ending(".toml"), default=Path("plate.toml"), metavar="FILE.toml", help="default: plate.toml")
    parser.add_common("--overwrite")
    text = "corners of a rectangle, the same as for capture, so that light fits"
    add("--rectangle", type=pixel, nargs=8, metavar="N", help=text)
    parser.add_common("--rectangle-size")
    text = "a known point (metres, z up) and its pixel; four or more"
    shown = ("X", "Y", "Z", "COLUMN", "ROW")
    add("--point", type=number(-1e9, 1e9, "metres or pixels"), nargs=5, action="append", metavar=shown, help=text)
    parser.add_common("--focal-35mm")
    text = "radius of the two balls, metres (default: 0.04)"
    add("--object-radius", type=number(LEAST, 1e9, "metres above 0"), default=0.04, metavar="M", help=text)
    return parser


def _check(options: argparse.Namespace) -> None:
    if (options.rectangle is None) == (options.point is None):
        raise UsageError("give --rectangle with --rectangle-size, or four or more --point")
    if (options.rectangle is None) != (options.rectangle_size is None):
        raise UsageError("--rectangle and --rectangle-size belong together: pixels of the corners, metres of the sides")
    if options.point is not None and len(options.point) < 4:
        raise UsageError(f"{len(options.point)} points; expected four or more --point")
    reads = {"the plate": [options.plate], "the light": [options.light]}
    claim_places(reads, {"--scene": options.scene}, overwrite=options.overwrite)


def find_camera(plate: Photograph, options: argparse.Namespace) -> tuple[Camera, Support]:
    """Return the camera of a plate and the plane z = 0 with its pose; print both with their accuracy."""

    def find(camera: Camera) -> Support:
        if options.rectangle is not None:
            corners = np.array(options.rectangle).reshape(4, 2).tolist()
            return plane_from_rectangle(camera, corners, tuple(options.rectangle_size))
        points = np.array(options.point)
        return plane_from_points(camera, points[:, :3].tolist(), points[:, 3:].tolist())

    height, width = plate.image.shape[:2]
    unit = math.hypot(width, height) / FULL_FRAME_DIAGONAL
    camera = plate.info.camera()
    if options.focal_35mm is not None or camera is None:
        focal = unit * (options.focal_35mm or 35.0)
        camera = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
        if options.focal_35mm is None:
            camera, least, most = focal_range(camera, find)
            doubt = "; it is uncertain: give --focal-35mm, or points in depth" * (most > HARDLY_KNOWN * least)
            say(
                f"the focal length is {camera.fx / unit:.0f} mm (35 mm; {least / unit:.0f} to {most / unit:.0f}){doubt}"
            )
    support = find(camera)
    x, y, z = support.pose.inverse().translation
    say(f"the camera is at ({x:.3f}, {y:.3f}, {z:.3f}) m; the given points are off by {support.error:.1f} pixels")
    return camera, support


def place(options: argparse.Namespace) -> int:
    """Find the camera's pose, scale the light to the plate's exposure, and write the scene."""
    _check(options)
    plate, light = read_photograph(options.plate), Light.load(options.light)
    camera, support = find_camera(plate, options)
    scale = 1.0
    if light.exposure is None or plate.info.exposure is None:
        whose = options.light if light.exposure is None else options.plate
        say(f"{whose} states no exposure: the plate's is assumed for the light; [light] scale corrects it")
    else:
        scale = plate.info.exposure / light.exposure
        say(f"the plate has {scale:.3g} times the light's exposure")
    captured = CapturedLight(options.light.resolve(), scale=scale)
    middle = (0.0, 0.0) if options.point is None else tuple(np.mean(options.point, 0)[:2].tolist())
    scene = scene_on(support, camera, options.plate, captured, middle, options.object_radius)
    store(options.scene, dumps_scene(scene, options.scene.parent).encode())
    print(f"{options.scene}: python -m warp_ar.live {options.scene} --output out/")
    return EXIT_DONE


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    return run_command(lambda: place(make_parser().parse_args(arguments)), SinkError)
