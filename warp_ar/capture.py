"""``python -m warp_ar.capture PHOTO...``: photographs of a mirror ball become light in a file, without a marker."""

from __future__ import annotations

if __name__ == "__main__":
    from warp_ar.begin import begin

    begin("warp_ar.capture")

import argparse
import math
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np

from warp_ar.ball.ball_finder import BallOutline
from warp_ar.checks.check_objects import check_objects, written_poses
from warp_ar.command_line import EXIT_DONE, Parser, run_command
from warp_ar.errors import SinkError, UsageError, reason, say
from warp_ar.files import write_whole
from warp_ar.output.places import check_places, check_replaceable
from warp_ar.output.sink import make_folder
from warp_ar.photo_capture import PIXELS, Capture, capture_light
from warp_ar.photographs.support import Support, plane_from_contact, plane_from_rectangle
from warp_ar.scene import (
    Camera,
    CapturedLight,
    LambertMaterial,
    MetallicRoughnessMaterial,
    Object,
    PoseSpec,
    Proxy,
    Scene,
    SourceSpec,
    dumps_scene,
)
from warp_ar.signature import sign_png

SUFFIXES = {"--output": ".exr", "--outline": ".png", "--scene": ".toml"}
"""What the names of written files end in."""
LARGEST_BALL = 1.0
"""Metres of the radius: beyond that another unit was meant."""


def _seconds(text: str) -> float:
    try:
        value = float(Fraction(text))
    except (ValueError, ZeroDivisionError):
        value = 0.0
    if value <= 0.0:
        raise argparse.ArgumentTypeError(f"{text!r}: expected a time in seconds, such as 0.02 or 1/50")
    return value


def _exposure(text: str) -> float | str:
    return PIXELS if text == PIXELS else _seconds(text)


def make_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = Parser(
        prog="python -m warp_ar.capture",
        description="Photographs of a mirror ball, one or a bracket, become an environment in an OpenEXR file, which a "
        "scene's [light] file and live --light read.",
    )
    add = parser.add_argument
    add("photos", nargs="+", type=Path, metavar="PHOTO", help="photographs of the ball, from one place")
    add("--output", type=Path, default=Path("light.exr"), metavar="FILE", help="default: light.exr")
    add("--overwrite", action="store_true", help="also replace files that this program did not write")
    add(
        "--ball", type=float, nargs=3, metavar=("X", "Y", "RADIUS"),
        help="a rough circle around the ball in pixels, where it is not found",
    )  # fmt: skip
    add(
        "--outline", type=Path, metavar="FILE.png", help="also write the shown photograph with the ball's outline on it"
    )
    add(
        "--exposures", type=_exposure, nargs="+", metavar="S",
        help="seconds of each photograph, not what EXIF says; pixels: what the pictures themselves tell",
    )  # fmt: skip
    add("--shown", type=Path, metavar="PHOTO", help="whose camera values the light is in (default: the best exposed)")
    add(
        "--transfer",
        default="srgb",
        metavar="NAME",
        help='response that is tried first: "srgb", "gamma:2.2" (default: srgb)',
    )
    add("--focal-35mm", type=float, metavar="MM", help="focal length for a full frame, if EXIF does not tell")
    add(
        "--as-clipped", action="store_true",
        help="leave what clips in a single photograph at the level of clipping; else it is raised by what nearly every "
        "place lacks",
    )  # fmt: skip
    add("--reflectance", type=float, default=0.85, metavar="R", help="of the ball (default: 0.85)")
    add("--device", default="auto", metavar="auto|cpu|cuda:0", help="where the kernels run (default: auto)")
    support = parser.add_argument_group("the plane under the ball, from the shown photograph")
    support.add_argument(
        "--rectangle", type=float, nargs=8, metavar="N",
        help="columns and rows of the four corners of a rectangle on it, in order round it, such as a sheet of paper",
    )  # fmt: skip
    support.add_argument("--rectangle-size", type=float, nargs=2, metavar=("W", "H"), help="its sides in metres")
    support.add_argument("--contact", type=float, nargs=2, metavar=("X", "Y"), help="pixel where the ball touches it")
    support.add_argument("--ball-radius", type=float, metavar="M", help="of the ball, metres; else lengths are radii")
    support.add_argument(
        "--scene",
        type=Path,
        metavar="FILE.toml",
        help="also write a scene of photograph, camera, plane and light",
    )
    return parser


def _support_of(options: argparse.Namespace, outline: BallOutline, camera: Camera) -> Support:
    if options.rectangle is not None:
        corners = np.array(options.rectangle).reshape(4, 2).tolist()
        return plane_from_rectangle(camera, corners, tuple(options.rectangle_size))
    return plane_from_contact(outline.sphere, camera, options.contact, options.ball_radius or 1.0)


def _check(options: argparse.Namespace) -> None:
    if (options.rectangle is None) != (options.rectangle_size is None):
        raise UsageError("--rectangle and --rectangle-size belong together: pixels of the corners, metres of the sides")
    if options.rectangle is not None and options.contact is not None:
        raise UsageError("--rectangle and --contact both tell the plane; give one of the two")
    if options.scene is not None and options.rectangle is None and options.contact is None:
        raise UsageError("--scene needs the plane: give --rectangle and --rectangle-size, or --contact")
    if options.shown is not None and options.shown not in options.photos:
        raise UsageError(f"--shown {options.shown}: expected one of the photographs")
    if options.exposures == [PIXELS]:
        options.exposures = PIXELS
    elif options.exposures is not None and PIXELS in options.exposures:
        raise UsageError(f"--exposures {PIXELS} stands alone; expected no seconds beside it")
    elif options.exposures is not None and len(options.exposures) != len(options.photos):
        number = _count(len(options.photos), "photograph")
        raise UsageError(f"{_count(len(options.exposures), 'exposure')} for {number}; expected one for each")
    _check_numbers(options)
    writes = {"--output": options.output, "--outline": options.outline, "--scene": options.scene}
    writes = {name: path for name, path in writes.items() if path is not None}
    for name, path in writes.items():
        if path.suffix.lower() != SUFFIXES[name]:
            raise UsageError(f"{name} {path}: expected a name that ends in {SUFFIXES[name]}")
    check_places({"the photographs": list(options.photos)}, writes)
    for path in writes.values():
        if words := check_replaceable(path, overwrite=options.overwrite):
            say(words)
    for path in writes.values():
        make_folder(path.parent)


def _check_numbers(options: argparse.Namespace) -> None:
    if not 0.01 <= options.reflectance <= 1.0:
        raise UsageError(f"--reflectance {options.reflectance:g}: expected a share from 0.01 to 1")
    if options.focal_35mm is not None and not 1.0 <= options.focal_35mm <= 10_000.0:
        raise UsageError(f"--focal-35mm {options.focal_35mm:g}: expected millimetres from 1 to 10000, such as 26")
    radius = options.ball_radius
    if radius is not None and not 0.0 < radius <= LARGEST_BALL:
        meant = [(unit, per * radius) for unit, per in (("cm", 1e-2), ("mm", 1e-3)) if per * radius <= 0.1]
        hint = f"; {radius:g} {meant[0][0]} are {meant[0][1]:g}" if meant and radius > 0.0 else ""
        raise UsageError(f"--ball-radius {radius:g}: expected metres above 0, {LARGEST_BALL:g} at most{hint}")
    for name, place in (("--contact", options.contact), ("--rectangle", options.rectangle)):
        if place is not None and not all(map(math.isfinite, place)):
            raise UsageError(f"{name} {' '.join(f'{value:g}' for value in place)}: expected pixels")


def make_scene(found: Capture, light: Path, ball_radius: float | None) -> Scene:
    """A scene that shows the photograph with a ball on either side of the mirror ball, lit by what was captured."""
    assert found.support is not None
    unit = ball_radius or 1.0
    pose = found.support.pose
    # Where the mirror ball stands in the world, and from there to the right.
    x, y, _ = (float(v) for v in pose.inverse().apply(unit * np.array(found.outline.sphere)))
    beside = Object(
        "sphere",
        radius=unit,
        at=(x + 3.0 * unit, y, unit),
        material=MetallicRoughnessMaterial((0.95, 0.95, 0.95), 1.0, 0.05),
    )
    chalk = Object("sphere", radius=unit, at=(x - 3.0 * unit, y, unit), material=LambertMaterial((0.8, 0.8, 0.8)))
    a, b, c = (float(v) for v in pose.translation)
    return Scene(
        camera=found.camera,
        name=light.stem,
        source=SourceSpec(path=found.shown.resolve()),
        proxies=(Proxy("plane", at=(x, y, 0.0), size=(40.0 * unit, 40.0 * unit)),),
        objects=(beside, chalk),
        captured=CapturedLight(light.resolve()),
        pose=PoseSpec(((tuple(map(float, pose.rotation.reshape(-1))), (a, b, c)),)),
        has_marker=False,
    )


def draw_outline(found: Capture) -> bytes:
    """A PNG of the photograph with the ball's outline, as wide as one sees it in the whole picture."""
    picture = np.ascontiguousarray(found.picture[..., ::-1])
    width = max(1, round(max(picture.shape[:2]) / 600))
    # With four bits of a fraction of a pixel.
    points = np.round(16.0 * found.outline.points()).astype(np.int32)[:, None]
    cv2.polylines(picture, [points], isClosed=True, color=(0, 0, 255), thickness=width, lineType=cv2.LINE_AA, shift=4)
    return sign_png(bytes(cv2.imencode(".png", picture)[1]))


def _write(path: Path, data: bytes) -> None:
    try:
        write_whole(path, data)
    except OSError as error:
        raise SinkError(f"{path} cannot be written: {reason(error)}") from error


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'s' * (number != 1)}"


def capture(options: argparse.Namespace) -> int:
    """Capture, write, and say what was found."""
    _check(options)
    say(f"looking for the ball in {_count(len(options.photos), 'photograph')}")
    wanted = options.rectangle is not None or options.contact is not None
    found = capture_light(
        options.photos,
        ball=options.ball,
        exposures=options.exposures,
        shown=None if options.shown is None else options.photos.index(options.shown),
        transfer=options.transfer,
        focal_35mm=options.focal_35mm,
        support=(lambda outline, camera: _support_of(options, outline, camera)) if wanted else None,
        reflectance=options.reflectance,
        device=options.device,
        raises=not options.as_clipped,
    )
    for note in found.notes:
        say(note)
    found.light.save(options.output)
    emitters = _count(len(found.light.emitters), "emitter")
    print(f"{options.output}: light in camera values of {found.shown.name}, {emitters}")
    for emitter in found.light.emitters:
        x, y, z = emitter.direction
        most = "or more" if emitter.high is None else f"to {sum(emitter.high) / 3:.3g}"
        print(
            f"  toward ({x:+.2f}, {y:+.2f}, {z:+.2f}): power {sum(emitter.low) / 3:.3g} {most}, "
            f"{emitter.solid_angle:.3f} sr"
        )
    if options.outline is not None:
        _write(options.outline, draw_outline(found))
        print(f"{options.outline}: {found.shown.name} with the ball's outline in red")
    if options.scene is not None:
        scene = make_scene(found, options.output, options.ball_radius)
        _write(options.scene, dumps_scene(scene, options.scene.parent).encode())
        for finding in check_objects(scene, scene.camera, written_poses(scene)):
            say(f"{options.scene}: {finding.text}; to do: {finding.remedy}")
        print(f"{options.scene}: python -m warp_ar.live {options.scene} --output out/")
    return EXIT_DONE


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    return run_command(lambda: capture(make_parser().parse_args(arguments)), SinkError)
