"""``python -m warp_ar.reference SCENE``: path-traces one frame, with the standard error of every pixel.

The pipeline lights the frames before it to find the light. Then the path tracer adds samples until the requested number
or error is reached. ``--compare`` shows the difference between the pipeline's picture and the reference.
"""

from __future__ import annotations

if __name__ == "__main__":
    from warp_ar.begin import begin

    begin("warp_ar.reference")

import argparse
import re
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import OpenEXR
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from warp_ar.accuracy.known_frame import KnownFrame, light_up_to
from warp_ar.accuracy.path_tracer import DEFAULT_SAMPLES, PathTracer, TracedPicture
from warp_ar.command_line import EXIT_DONE, FROM_0, LEAST, Parser, count, ending, number, run_command
from warp_ar.errors import SinkError, SourceError, UsageError, say
from warp_ar.exr_file import exr_header, store_exr
from warp_ar.files import store
from warp_ar.light.captured import Light
from warp_ar.output.places import claim_places, reads_of
from warp_ar.scene import Scene
from warp_ar.session import chosen_scene
from warp_ar.signature import encode_png

STEP = 8
"""Samples per pixel between two progress reports."""
MAGNIFIED = 8
"""Factor by which shown differences are magnified."""


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command's options."""
    parser = Parser(
        prog="python -m warp_ar.reference",
        description="Path-trace one frame with the light that the pipeline estimates, with standard errors.",
    )
    add = parser.add_argument
    parser.add_common("scene", "--source", "--light", "--light-axes", "--calibration", "--device", "--overwrite")
    add("--frame", type=FROM_0, default=0, metavar="N", help="the frame's number, from 0; earlier frames add light")
    text = f"largest mean number of paths per pixel (default: {DEFAULT_SAMPLES})"
    add("--samples", type=count, default=DEFAULT_SAMPLES, metavar="N", help=text)
    text = "relative standard error to stop at, such as 0.01"
    add("--error", type=number(LEAST, 1e9, "a number above 0, such as 0.01"), metavar="E", help=text)
    text = "picture (.png), or radiance and standard error (.exr)"
    add("--output", type=ending(".png", ".exr"), metavar="FILE", help=text)
    text = "write the pipeline's picture, the reference and their difference"
    add("--compare", type=ending(".png"), metavar="FILE.png", help=text)
    text = "preset that estimates the light (default: high)"
    add("--quality", default="high", metavar="NAME", help=text)
    text = "estimate from the frame the distances of the light file's emitters"
    add("--places", action="store_true", help=text)
    text = "write the light, with distances of --places, for live --light"
    add("--save-light", type=ending(".exr"), metavar="FILE.exr", help=text)
    add("--size", type=_size, metavar="WxH", help="size of the picture (default: the frames')")
    add("--seed", type=FROM_0, default=0, metavar="N", help="seed of the random numbers (default: 0)")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    return run_command(lambda: trace(make_parser().parse_args(arguments)), (SourceError, SinkError))


def trace(options: argparse.Namespace) -> int:
    """Find the light, trace paths, and write the requested files."""
    scene = chosen_scene(options.scene, options.source, options.calibration, options.light, options.light_axes)
    if options.save_light is not None:
        _check_axes(scene)
    writes = {f"--{name}": getattr(options, name.replace("-", "_")) for name in ("output", "compare", "save-light")}
    writes = {name: path for name, path in writes.items() if path is not None}
    claim_places(reads_of(scene, options), writes, overwrite=options.overwrite)
    console = Console(stderr=True)
    known = light_up_to(scene, options.frame, quality=options.quality, device=options.device, source=options.source)
    if options.places:
        known = known.placed(device=options.device)
        say(places_found(known.light))
    if options.save_light is not None:
        known.light.save(options.save_light)
    tracer = known.tracer(device=options.device, size=options.size, seed=options.seed)
    pictures: list[TracedPicture] = []
    try:
        render(tracer, options.samples, options.error, console, pictures)
    except KeyboardInterrupt:
        if pictures and writes:
            _write_all(options, known, pictures[-1])
            say(f"ended early: the written picture has {pictures[-1].samples} samples a pixel")
        raise
    picture = pictures[-1]
    _write_all(options, known, picture)
    print(summary(known, picture, str(tracer.device)))
    return EXIT_DONE


def _check_axes(scene: Scene) -> None:
    """Warn if reading the saved light, in the scene's axes and values, would rotate or scale it again."""
    given = scene.captured
    if given is not None and (given.rotate != (0.0, 0.0, 0.0) or given.scale != 1.0 or given.colors):
        raise UsageError(
            "--save-light: [light] has scale, colors or rotate, which would be applied again; leave them out"
        )


def places_found(light: Light) -> str:
    """Return one line about the emitters of a light that have a distance."""
    found = [
        f"{emitter.distance:.2f} m toward {', '.join(f'{value:.2f}' for value in emitter.direction)}"
        for emitter in light.emitters
        if emitter.distance is not None
    ]
    return f"emitters: {'; '.join(found)}" if found else "emitters: the frame shows the distance of none"


def _write_all(options: argparse.Namespace, known: KnownFrame, picture: TracedPicture) -> None:
    """Write all requested files."""
    if options.output is not None:
        write_picture(options.output, picture)
    if options.compare is not None:
        store(options.compare, encode_png(side_by_side(known, picture)))


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"([1-9][0-9]{0,4})x([1-9][0-9]{0,4})", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"{text}: expected width x height, such as 320x240")
    return int(match[1]), int(match[2])


def render(
    tracer: PathTracer, samples: int, error: float | None, console: Console, pictures: list[TracedPicture]
) -> None:
    """Trace paths and show the progress; after each step, ``pictures`` holds the latest picture alone."""
    text = TextColumn("{task.description}")
    with Progress(text, BarColumn(), TimeRemainingColumn(), console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("reflectance", total=samples)
        tracer.prepare()
        for picture in tracer.render(samples, error=error, step=STEP):
            pictures[:] = [picture]
            shown = f"{picture.samples} samples, error {picture.relative_error:.2%}"
            total = samples
            if error is not None and picture.relative_error > error:
                # The error falls with the square root of the number of samples.
                total = min(samples, round(picture.samples * (picture.relative_error / error) ** 2))
            bar.update(task, completed=picture.samples, description=shown, total=total)


def summary(known: KnownFrame, picture: TracedPicture, device: str) -> str:
    """Return a summary of the run in one line."""
    height, width = picture.image.shape[:2]
    difference = _lit_at(known, picture) - picture.image
    rms = float(np.sqrt((difference**2).mean()))
    return (
        f"{known.scene.name}: {width}x{height}, {picture.samples} samples a pixel on {device} in "
        f"{picture.seconds:.1f} s; relative standard error {picture.relative_error:.2%}; "
        f"the pipeline's picture differs by {rms:.2f} codes rms"
    )


def side_by_side(known: KnownFrame, picture: TracedPicture) -> npt.NDArray[np.uint8]:
    """Return the pipeline's picture, the reference and their magnified difference on grey, (H, 3 W, 3)."""
    lit = _lit_at(known, picture)
    parts = lit, picture.image.astype(np.float64), 127.5 + MAGNIFIED * (lit - picture.image)
    return np.clip(np.round(np.concatenate(parts, axis=1)), 0, 255).astype(np.uint8)


def _lit_at(known: KnownFrame, picture: TracedPicture) -> npt.NDArray[np.float64]:
    """Return the pipeline's picture, resized to the reference."""
    size = picture.image.shape[1::-1]
    return np.asarray(cv2.resize(known.lit.astype(np.float64), size, interpolation=cv2.INTER_AREA))


def write_picture(path: Path, picture: TracedPicture) -> None:
    """Write a picture in the format of ``path``'s ending; an EXR has channels R, G, B and error.R, error.G, error.B.

    Raises:
        SinkError: The file cannot be written.
    """
    if path.suffix.lower() == ".png":
        store(path, encode_png(picture.image))
        return
    channels = {name: np.ascontiguousarray(picture.radiance[..., c]) for c, name in enumerate("RGB")}
    channels |= {f"error.{name}": np.ascontiguousarray(picture.error[..., c]) for c, name in enumerate("RGB")}
    store_exr(path, OpenEXR.File(exr_header(samples=picture.samples), channels))
