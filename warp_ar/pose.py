"""``python -m warp_ar.pose PLATE``: finds a photograph's camera pose, and writes a scene of it in captured light."""

from __future__ import annotations

if __name__ == "__main__":
    from warp_ar.begin import begin

    begin("warp_ar.pose")

import argparse
import functools
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from warp_ar.calibration.chart import measure_chart
from warp_ar.command_line import EXIT_DONE, LEAST, Parser, ending, number, pixel, run_command
from warp_ar.errors import SinkError, UsageError, say
from warp_ar.files import store
from warp_ar.kernels.color import decode_table
from warp_ar.light.captured import Light, irradiance_above
from warp_ar.output.places import claim_places
from warp_ar.photographs.photographs import Photograph, read_photograph
from warp_ar.photographs.support import (
    Support,
    card_points,
    focal_range,
    plane_from_colmap,
    plane_from_points,
    plane_from_rectangle,
    plane_from_vanishing,
    scene_on,
)
from warp_ar.photographs.table_seen import exposure_by_paper
from warp_ar.scene import Camera, CapturedLight, dumps_scene
from warp_ar.scene.exif import FULL_FRAME_DIAGONAL

HARDLY_KNOWN = 1.2
"""Ratio of the largest to the least focal length that fits, above which the focal length counts as uncertain."""

POSE_OPTIONS = ("--rectangle", "--point", "--vanishing-x, -y, -z", "--colmap")
"""Options that give the pose of a plate without the printed card."""
AXES = ("x", "y", "z")

LEVEL = "its axes must have z up and the ground at z = 0 before the camera, as colmap model_aligner makes them"
"""Requirement on a COLMAP model."""


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command's options."""
    parser = Parser(
        prog="python -m warp_ar.pose",
        description="Write a scene with two balls in a photograph, posed by the printed card in it or as given.",
    )
    add = parser.add_argument
    add("plate", type=Path, metavar="PLATE", help="photograph to put objects into")
    add("--light", type=Path, required=True, metavar="FILE", help="captured light, such as light.exr")
    add("--scene", type=ending(".toml"), default=Path("plate.toml"), metavar="FILE.toml", help="default: plate.toml")
    parser.add_common("--overwrite")
    text = "corners of a rectangle, as for capture"
    add("--rectangle", type=pixel, nargs=8, metavar="N", help=text)
    parser.add_common("--rectangle-size")
    text = "a known point (metres, z up) and its pixel; four or more"
    shown = ("X", "Y", "Z", "COLUMN", "ROW")
    add("--point", type=number(-1e9, 1e9, "metres or pixels"), nargs=5, action="append", metavar=shown, help=text)
    for axis in AXES:
        text = "2 or 3 segments along x: column, row of both ends" if axis == "x" else f"the same along {axis}"
        add(f"--vanishing-{axis}", type=pixel, nargs="+", metavar="N", help=text)
    text = "origin, another point of the ground, metres between"
    shown = ("X1", "Y1", "X2", "Y2", "METRES")
    add("--length", type=number(-1e9, 1e9, "pixels, and metres"), nargs=5, metavar=shown, help=text)
    text = "COLMAP model with the plate: z up, ground at 0"
    add("--colmap", type=Path, metavar="FOLDER", help=text)
    text = "metres per unit of it (default: 1)"
    add("--colmap-scale", type=number(LEAST, 1e9, "metres above 0"), metavar="M", help=text)
    parser.add_common("--focal-35mm")
    text = "colour chart, if the plate's camera differs"
    add("--chart", type=Path, metavar="PHOTO", help=text)
    text = "radius of the two balls, metres (default: 0.04)"
    add("--object-radius", type=number(LEAST, 1e9, "metres above 0"), default=0.04, metavar="M", help=text)
    return parser


def _lines(options: argparse.Namespace) -> dict[str, list[list[float]]]:
    """Return the segments of each axis that ``--vanishing`` gives: columns and rows of both ends."""
    given = {axis: getattr(options, f"vanishing_{axis}") for axis in AXES}
    for axis, numbers in given.items():
        if numbers is not None and len(numbers) not in (8, 12):
            raise UsageError(f"--vanishing-{axis}: {len(numbers)} numbers; expected 8 or 12, 4 of each segment")
    return {axis: np.reshape(numbers, (-1, 4)).tolist() for axis, numbers in given.items() if numbers is not None}


def _check(options: argparse.Namespace) -> bool:
    """Return True if the pose is to be found by the printed card; raise UsageError if options contradict each other."""
    lines = _lines(options)
    ways = options.rectangle, options.point, lines or None, options.colmap
    given = [name for name, way in zip(POSE_OPTIONS, ways, strict=True) if way is not None]
    if len(given) > 1:
        raise UsageError(f"{' and '.join(given)} each give the pose; expected one of them")
    if (options.rectangle is None) != (options.rectangle_size is None):
        raise UsageError("--rectangle and --rectangle-size belong together: pixels of the corners, metres of the sides")
    if len(lines) == 1 or (not lines) != (options.length is None):
        raise UsageError("--vanishing-x, -y or -z: expected parallel segments of two axes or three, and --length")
    if options.colmap_scale is not None and options.colmap is None:
        raise UsageError(f"--colmap-scale {options.colmap_scale:g}: expected --colmap FOLDER beside it")
    if options.colmap is not None and options.focal_35mm is not None:
        raise UsageError("--focal-35mm and --colmap both give the focal length; expected one of them")
    if options.length is not None and not (options.length[4] > 0.0 and options.length[:2] != options.length[2:4]):
        raise UsageError(f"--length {options.length[4]:g}: expected two different points, and metres above 0")
    if options.point is not None and len(options.point) < 4:
        raise UsageError(f"{len(options.point)} points; expected four or more --point")
    reads = {"the plate": [options.plate], "the light": [options.light]}
    claim_places(reads, {"--scene": options.scene}, overwrite=options.overwrite)
    return not given


def find_pose(plate: Photograph, options: argparse.Namespace) -> tuple[Camera, Support, tuple[float, float]]:
    """Return a plate's camera, the plane z = 0 with its pose, and a visible place on it; print the accuracy."""
    if options.colmap is not None:
        camera, support = plane_from_colmap(options.colmap, plate.path, options.colmap_scale or 1.0)
        camera = camera.scaled_to(plate.info.width, plate.info.height)
        back = support.pose.inverse()
        x, y, _ = back.translation - back.translation[2] / min(back.rotation[2, 2], -LEAST) * back.rotation[:, 2]
        if back.translation[2] <= 0.0 or back.rotation[2, 2] >= 0.0:
            raise UsageError(f"--colmap {options.colmap}: {LEVEL}")
        _tell(support, "the light must have the model's axes")
        return camera, support, (float(x), float(y))
    middle, count = (0.0, 0.0), 4
    if options.rectangle is not None:
        corners = np.array(options.rectangle).reshape(4, 2).tolist()
        find = functools.partial(plane_from_rectangle, corners=corners, size=tuple(options.rectangle_size))
    elif lines := _lines(options):
        count = 2 * sum(map(len, lines.values()))
        find = functools.partial(plane_from_vanishing, lines=lines, length=options.length)
    else:
        card = card_points(plate.image) if options.point is None else np.split(np.array(options.point), [3], 1)
        if card is None:
            right = f"expected it in the picture, or one of {'; '.join(POSE_OPTIONS)}"
            raise UsageError(f"{options.plate} does not show the printed card: {right}")
        points, pixels = card
        count = len(points)
        if options.point is not None:
            middle = tuple(points[:, :2].mean(0).tolist())
        find = functools.partial(plane_from_points, points=points, pixels=pixels)
    camera = find_camera(plate, find, count, options.focal_35mm)
    support = find(camera)
    _tell(support, f"the given points are off by {support.error:.1f} pixels")
    return camera, support, middle


def _tell(support: Support, more: str) -> None:
    x, y, z = support.pose.inverse().translation
    say(f"the camera is at ({x:.3f}, {y:.3f}, {z:.3f}) m; {more}")


def find_camera(plate: Photograph, find: Callable[[Camera], Support], count: int, focal_35mm: float | None) -> Camera:
    """Return the camera of a plate; print its focal length if neither EXIF nor the user gives it."""
    height, width = plate.image.shape[:2]
    unit = math.hypot(width, height) / FULL_FRAME_DIAGONAL
    camera = plate.info.camera()
    if focal_35mm is None and camera is not None:
        return camera
    focal = unit * (focal_35mm or 35.0)
    camera = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    if focal_35mm is not None:
        return camera
    camera, least, most = focal_range(camera, find, count)
    doubt = "; it is uncertain: give --focal-35mm, or points in depth" * (most > HARDLY_KNOWN * least)
    say(f"the focal length is {camera.fx / unit:.0f} mm (35 mm; {least / unit:.0f} to {most / unit:.0f}){doubt}")
    return camera


def place(options: argparse.Namespace) -> int:
    """Find the camera's pose, scale the light to the plate's exposure, and write the scene."""
    seen = _check(options)
    plate, light, codes = read_photograph(options.plate), Light.load(options.light), decode_table("srgb")
    colors = light.colors
    if options.chart is not None:
        matrix, note = measure_chart(read_photograph(options.chart).image, codes, str(options.chart))
        colors = tuple(np.linalg.inv(matrix).ravel().tolist())
        say(note)
    if colors is not None:
        light = light.recolored(np.reshape(colors, (3, 3)))
    camera, support, middle = find_pose(plate, options)
    scale, by_card = 1.0, None
    if seen:
        by_card = exposure_by_paper(plate.image, camera, support, codes, irradiance_above(light.radiance))
    if light.exposure is not None and plate.info.exposure is not None:
        scale = plate.info.exposure / light.exposure
        say(f"the plate has {scale:.3g} times the light's exposure")
    elif by_card is not None:
        scale = by_card
        say(f"the plate has {scale:.3g} times the light's exposure, by the card's paper")
    else:
        whose = options.light if light.exposure is None else options.plate
        say(f"{whose} states no exposure: the plate's is assumed for the light; [light] scale corrects it")
    captured = CapturedLight(options.light.resolve(), scale=scale, colors=colors)
    scene = scene_on(support, camera, options.plate, captured, middle, options.object_radius)
    store(options.scene, dumps_scene(scene, options.scene.parent).encode())
    print(f"{options.scene}: python -m warp_ar.live {options.scene} --output out/")
    return EXIT_DONE


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    return run_command(lambda: place(make_parser().parse_args(arguments)), SinkError)
