"""``python -m warp_ar.environment FILE --output OTHER``: converts an environment to other axes and formats."""

from __future__ import annotations

if __name__ == "__main__":
    from warp_ar.begin import begin

    begin("warp_ar.environment")

import argparse
import dataclasses
import datetime
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_ar.command_line import EXIT_DONE, EXIT_FAILED, Parser, count, ending, run_command
from warp_ar.errors import SinkError, UsageError, say
from warp_ar.light.latlong_axes import AXES
from warp_ar.output.environment_axes import LAYOUTS
from warp_ar.output.environment_file import (
    COLOR_SPACES,
    ENVIRONMENT_SUFFIXES,
    EnvironmentInfo,
    grey_card_scale,
    read_environment,
    read_environment_info,
    write_environment,
)
from warp_ar.output.places import check_places, claim_places

Radiance = npt.NDArray[np.float32]


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command's options."""
    parser = Parser(
        prog="python -m warp_ar.environment",
        description="Write an environment in the axes and format of another program.",
    )
    add = parser.add_argument
    add("environment", type=Path, metavar="FILE", help="a latlong .exr or .hdr")
    parser.add_common("--light-axes")
    text = "an .exr, .hdr, or .json of spherical harmonics"
    add("--output", type=ending(*ENVIRONMENT_SUFFIXES), required=True, metavar="FILE", help=text)
    text = "z-up: this program's; blender: also three.js; y-up: OpenEXR, USD (default: y-up)"
    add("--axes", choices=AXES, default="y-up", help=text)
    add("--layout", choices=LAYOUTS, default="latlong", help="latlong, or a cube's six faces (default: latlong)")
    add("--size", type=count, metavar="TEXELS", help="edge of a cube's faces (default: half the rows)")
    add("--taken", type=_time, metavar="TIME", help="time of capture, such as 2026-05-01T12:00:00+02:00")
    text = "longitude, latitude in degrees, altitude in metres"
    add("--place", type=float, nargs=3, metavar=("EAST", "NORTH", "ALTITUDE"), help=text)
    add("--white-luminance", type=float, metavar="CD", help="luminance of the value 1, cd/m^2 (default: the file's)")
    text = "primaries; acescg for .exr only (default: rec709)"
    add("--color-space", choices=tuple(COLOR_SPACES), default="rec709", help=text)
    add("--grey-card", action="store_true", help="scale the light: a grey card on the marker becomes 0.18")
    parser.add_common("--overwrite")
    return parser


def _time(text: str) -> datetime.datetime:
    try:
        return datetime.datetime.fromisoformat(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r}: expected a time such as 2026-05-01T12:00:00+02:00") from None


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    return run_command(lambda: convert(make_parser().parse_args(arguments)))


def convert(options: argparse.Namespace) -> int:
    """Read an environment, rotate it and write it.

    Raises:
        SinkError: A file cannot be read or written.
        UsageError: The output has no ending of an environment, or options do not fit each other.
    """
    output: Path = options.output
    if options.size is not None and options.layout != "cube":
        raise UsageError(f"--size {options.size} is the edge of a cube's faces; add --layout cube")
    check_places({"the environment": [options.environment]}, {"--output": output})
    given = {
        "taken": options.taken,
        "place": None if options.place is None else tuple(options.place),
        "white_luminance": options.white_luminance,
    }
    info = read_environment_info(options.environment)
    info = dataclasses.replace(info, **{name: value for name, value in given.items() if value is not None})
    radiance = read_environment(options.environment, axes=options.light_axes)
    if options.grey_card:
        radiance, info = _scaled(radiance, info)
    claim_places({}, {"--output": output}, overwrite=options.overwrite)
    form: dict[str, Any] = {"axes": options.axes, "layout": options.layout, "size": options.size, "info": info}
    form["color_space"] = options.color_space
    try:
        write_environment(output, radiance, overwrite=options.overwrite, **form)
    except SinkError as error:
        say(error)
        return EXIT_FAILED
    return EXIT_DONE


def _scaled(radiance: Radiance, info: EnvironmentInfo) -> tuple[Radiance, EnvironmentInfo]:
    """Return the environment scaled so that a grey card under it has radiance 0.18, and its info with scaled levels."""
    scale = grey_card_scale(radiance)
    say(f"the light is multiplied by {scale:.6g}")
    luminance = info.luminance_of_one()
    info = dataclasses.replace(
        info,
        white_level=scale * info.white_level,
        white_luminance=None if luminance is None else luminance / scale,
    )
    return np.ascontiguousarray(radiance * np.float32(scale)), info
