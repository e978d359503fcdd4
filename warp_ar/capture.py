"""``python -m warp_ar.capture PHOTO...``: captures light from photographs of a mirror ball, without a marker."""

from __future__ import annotations

if __name__ == "__main__":
    from warp_ar.begin import begin

    begin("warp_ar.capture")

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from warp_ar.ball.ball_finder import BallOutline
from warp_ar.calibration.response import write_response
from warp_ar.checks.check_objects import check_objects, written_poses
from warp_ar.command_line import EXIT_DONE, Parser, ending, number, pixel, run_command, seconds
from warp_ar.errors import SinkError, UsageError, counted, say
from warp_ar.files import store
from warp_ar.light.latlong_axes import AXES
from warp_ar.output.places import claim_places
from warp_ar.photo_capture import PIXELS, Capture, capture_light
from warp_ar.photographs.support import Support, plane_from_contact, plane_from_rectangle, scene_on
from warp_ar.scene import Camera, CapturedLight, Scene, dumps_scene
from warp_ar.signature import encode_png

OUTLINE, PREVIEW, RESPONSE = ".outline.png", ".preview.png", ".response.txt"
"""Endings of the files that are written next to the light."""
LARGEST_BALL = 1.0
"""Largest plausible radius, metres; a larger number is probably in another unit."""


def _exposure(text: str) -> Any:
    return PIXELS if text == PIXELS else seconds(text)


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command's options."""
    parser = Parser(
        prog="python -m warp_ar.capture",
        description="Make an environment from photographs of a mirror ball, for [light] file and live --light.",
    )
    add = parser.add_argument
    add("photos", nargs="+", type=Path, metavar="PHOTO", help="photographs of the ball from one place")
    add(
        "--output",
        type=ending(".exr"),
        default=Path("light.exr"),
        metavar="FILE",
        help="file to write (default: light.exr)",
    )
    parser.add_common("--overwrite")
    text = "rough circle around the ball, pixels, if it is not found"
    add("--ball", type=float, nargs=3, metavar=("X", "Y", "RADIUS"), help=text)
    text = "picture of the found outline (default: beside the light)"
    add("--outline", type=ending(".png"), metavar="FILE.png", help=text)
    add("--circle", type=float, nargs=3, metavar=("X", "Y", "RADIUS"), help="exact outline of the ball, pixels")
    text = "exposure times, seconds, instead of EXIF's; pixels: estimate them from the pictures"
    add("--exposures", type=_exposure, nargs="+", metavar="S", help=text)
    add(
        "--shown",
        type=Path,
        metavar="PHOTO",
        help="photograph in whose camera values light is written (default: the best exposed)",
    )
    text = 'response tried first, such as "gamma:2.2" (default: srgb)'
    add("--transfer", default="srgb", metavar="NAME", help=text)
    parser.add_common("--focal-35mm")
    add("--as-clipped", action="store_true", help="do not raise the clipped light of a single photograph")
    text = "the ball's reflectance (default: measured from the plane, else 0.85)"
    add("--reflectance", type=number(0.01, 1.0, "a share from 0.01 to 1"), metavar="R", help=text)
    text = "colour chart: light becomes linear sRGB"
    add("--chart", type=Path, metavar="PHOTO", help=text)
    text = "rows of the written map (default: by the ball's size)"
    add("--height", type=number(16, 4096, "16 to 4096 rows", int), metavar="N", help=text)
    add("--axes", choices=AXES, default="z-up", help="axes of the written map (default: z-up)")
    parser.add_common("--device")
    support = parser.add_argument_group("the plane under the ball, from the shown photograph")
    add = support.add_argument
    text = "columns and rows of a rectangle's corners, in order around it"
    add("--rectangle", type=pixel, nargs=8, metavar="N", help=text)
    parser.add_common("--rectangle-size", add=add)
    add("--contact", type=pixel, nargs=2, metavar=("X", "Y"), help="pixel where the ball touches the plane")
    add("--ball-radius", type=float, metavar="M", help="the ball's radius in metres (default: lengths are in radii)")
    text = "height of a stand under the ball (--contact)"
    add("--stand", type=number(0.0, 100.0, "metres from 0 to 100"), metavar="M", help=text)
    add("--scene", type=ending(".toml"), metavar="FILE.toml", help="also write a scene of the photograph")
    return parser


def _support_of(options: argparse.Namespace, outline: BallOutline, camera: Camera) -> Support:
    if options.rectangle is not None:
        corners = np.array(options.rectangle).reshape(4, 2).tolist()
        return plane_from_rectangle(camera, corners, tuple(options.rectangle_size))
    radius, stand = options.ball_radius or 1.0, options.stand or 0.0
    return plane_from_contact(outline.sphere, camera, options.contact, radius, stand=stand)


def _check(options: argparse.Namespace) -> None:
    if (options.rectangle is None) != (options.rectangle_size is None):
        raise UsageError("--rectangle and --rectangle-size belong together: pixels of the corners, metres of the sides")
    if options.rectangle is not None and options.contact is not None:
        raise UsageError("--rectangle and --contact both define the plane; give one of the two")
    if options.stand is not None and (options.contact is None or options.ball_radius is None):
        raise UsageError(f"--stand {options.stand:g}: expected --contact and --ball-radius beside it")
    if options.ball is not None and options.circle is not None:
        raise UsageError("--ball is a rough circle and --circle an exact one; give one of the two")
    if options.shown is not None and options.shown not in options.photos:
        raise UsageError(f"--shown {options.shown}: expected one of the photographs")
    if options.exposures == [PIXELS]:
        options.exposures = PIXELS
    elif options.exposures is not None and PIXELS in options.exposures:
        raise UsageError(f"--exposures {PIXELS} cannot be combined with exposure times")
    _check_radius(options)
    options.outline = options.outline or options.output.with_suffix(OUTLINE)
    writes = {"--output": options.output, "--outline": options.outline, "--scene": options.scene}
    writes = {name: path for name, path in writes.items() if path is not None}
    writes |= {f"*{end}": options.output.with_suffix(end) for end in (PREVIEW, RESPONSE)}
    reads = [*options.photos, *filter(None, [options.chart])]
    claim_places({"the photographs": reads}, writes, overwrite=options.overwrite)


def _check_radius(options: argparse.Namespace) -> None:
    radius = options.ball_radius
    if radius is not None and not 0.0 < radius <= LARGEST_BALL:
        meant = [(unit, per * radius) for unit, per in (("cm", 1e-2), ("mm", 1e-3)) if per * radius <= 0.1]
        hint = f"; {radius:g} {meant[0][0]} are {meant[0][1]:g}" if meant and radius > 0.0 else ""
        raise UsageError(f"--ball-radius {radius:g}: expected metres above 0, {LARGEST_BALL:g} at most{hint}")


def make_scene(found: Capture, light: Path) -> Scene:
    """Return a scene of the photograph in the captured light, with a virtual ball on each side of the mirror ball."""
    assert found.support is not None
    unit = found.support.radius_of(found.outline.sphere)
    x, y, _ = map(float, found.support.pose.inverse().apply(unit * np.array(found.outline.sphere)))
    captured = CapturedLight(light.resolve(), colors=found.light.colors)
    return scene_on(found.support, found.camera, found.shown, captured, (x, y), unit)


def draw_outline(found: Capture) -> bytes:
    """Return a PNG of the photograph with the ball's outline, drawn thick enough to be visible in the whole picture."""
    picture = np.ascontiguousarray(found.picture)
    width = max(1, round(max(picture.shape[:2]) / 600))
    # Coordinates in sixteenths of a pixel, as OpenCV takes them.
    points = np.round(16.0 * found.outline.points()).astype(np.int32)[:, None]
    cv2.polylines(picture, [points], isClosed=True, color=(255, 0, 0), thickness=width, lineType=cv2.LINE_AA, shift=4)
    return encode_png(picture)


def draw_preview(found: Capture) -> bytes:
    """Return a PNG of the light in this program's axes, tone-mapped by Reinhard's operator."""
    shown = cv2.createTonemapReinhard(gamma=2.2).process(np.ascontiguousarray(found.light.radiance))
    codes = np.round(255.0 * np.clip(np.nan_to_num(shown), 0.0, 1.0)).astype(np.uint8)
    return encode_png(codes)


def capture(options: argparse.Namespace) -> int:
    """Capture the light, write the files and print a summary."""
    _check(options)
    say(f"looking for the ball in {counted(len(options.photos), 'photograph')}")
    wanted = options.rectangle is not None or options.contact is not None
    found = capture_light(
        options.photos,
        ball=options.ball,
        circle=options.circle,
        exposures=options.exposures,
        shown=None if options.shown is None else options.photos.index(options.shown),
        transfer=options.transfer,
        focal_35mm=options.focal_35mm,
        support=(lambda outline, camera: _support_of(options, outline, camera)) if wanted else None,
        ball_radius=options.ball_radius,
        reflectance=options.reflectance,
        device=options.device,
        height=options.height,
        raises=not options.as_clipped,
        chart=options.chart,
    )
    for note in found.notes:
        say(note)
    if options.scene is not None and found.support is None:
        right = "give --rectangle and --rectangle-size, or --contact, or show the printed card"
        raise UsageError(f"--scene {options.scene} needs the plane: {right}")
    found.light.save(options.output, options.axes)
    emitters = counted(len(found.light.emitters), "emitter")
    colors = "camera values" if options.chart is None else "linear sRGB at the exposure"
    print(f"{options.output}: light in {colors} of {found.shown.name}, {emitters}")
    for emitter in found.light.emitters:
        x, y, z = emitter.direction
        most = "or more" if emitter.high is None else f"to {sum(emitter.high) / 3:.3g}"
        print(
            f"  toward ({x:+.2f}, {y:+.2f}, {z:+.2f}): power {sum(emitter.low) / 3:.3g} {most}, "
            f"{emitter.solid_angle:.3f} sr"
        )
    preview, response = (options.output.with_suffix(end) for end in (PREVIEW, RESPONSE))
    store(options.outline, draw_outline(found))
    print(f"{options.outline}: {found.shown.name} with the ball's outline in red")
    store(preview, draw_preview(found))
    print(f"{preview}: the light, tone-mapped")
    if found.response is not None:
        write_response(found.response, response)
        print(f"{response}: the camera's response, for [camera] transfer")
        found = dataclasses.replace(found, camera=dataclasses.replace(found.camera, transfer=response.resolve()))
    if options.scene is not None:
        scene = make_scene(found, options.output)
        store(options.scene, dumps_scene(scene, options.scene.parent).encode())
        for finding in check_objects(scene, scene.camera, written_poses(scene)):
            say(f"{options.scene}: {finding.text}; to do: {finding.remedy}")
        print(f"{options.scene}: python -m warp_ar.live {options.scene} --output out/")
    return EXIT_DONE


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    return run_command(lambda: capture(make_parser().parse_args(arguments)), SinkError)
