"""``python -m warp_ar.init my_desk``: makes a folder to start from, with a scene, a teapot and the card to print.

The scene runs at once with a guessed camera; each run prints which values are guessed.
"""

from __future__ import annotations

if __name__ == "__main__":
    from warp_ar.begin import begin

    begin("warp_ar.init")

import argparse
import math
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

from warp_ar.calibration.card import write_card
from warp_ar.command_line import EXIT_DONE, Parser, run_command
from warp_ar.errors import SinkError, UsageError, printable, reason
from warp_ar.files import take_name
from warp_ar.scene import bundled_scenes, load_scene
from warp_ar.scene.starter import starter_scene
from warp_ar.tracking.card_layout import CARD_MARKER, RINGS, ball_center

SCENE, MESH = "scene.toml", "teapot.ply"
CARDS = tuple(
    (f"card-{paper}.{kind}", paper, dpi) for paper in ("a4", "letter") for kind, dpi in (("pdf", 600), ("png", 300))
)
"""Files of the card: name, paper size and dots per inch of each."""
DEFAULT_RADIUS = 0.035
"""Radius of the ball, metres."""


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command's options."""
    parser = Parser(
        prog="python -m warp_ar.init",
        description="Make a folder to start from: a scene file, a teapot, the card to print.",
    )
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="the new folder")
    text = "a capture device's index, a video or a folder (default: 0)"
    parser.add_argument("--source", default="0", metavar="PATH|INDEX", help=text)
    parser.add_argument(
        "--radius", type=float, metavar="X", help=f"the ball's radius in metres (default: {DEFAULT_RADIUS})"
    )
    return parser


def make_desk(folder: Path, source: str | int, radius: float) -> None:
    """Make the folder with all its files, or nothing on an error.

    Args:
        folder: Path of the folder, which must not exist yet.
        source: A capture device's index, or a path.
        radius: The ball's radius in metres.

    Raises:
        UsageError: The folder exists, or no ball of this radius fits on the card.
        SinkError: The folder cannot be written.
    """
    if folder.exists() or folder.is_symlink():
        raise UsageError(f"{folder}: is there already; expected the name of a new folder")
    if not folder.absolute().parent.is_dir():
        raise UsageError(f"{folder}: its parent folder {folder.absolute().parent} does not exist")
    largest = 1.25 * max(RINGS)
    if not (math.isfinite(radius) and 0.005 <= radius <= largest):
        meant = [(unit, per * radius) for unit, per in (("cm", 1e-2), ("mm", 1e-3)) if 0.005 <= per * radius <= largest]
        hint = "".join(f"; {radius:g} {unit} are {metres:g}" for unit, metres in meant)
        right = f"expected metres from 0.005 to {largest:g}, which stands on the card"
        raise UsageError(f"--radius {radius:g}: {right}{hint}")
    text = starter_scene(folder.absolute().name, source, CARD_MARKER, ball_center(radius), radius, MESH)
    try:
        with tempfile.TemporaryDirectory(prefix=".warp_ar_init_", dir=folder.absolute().parent) as aside:
            made = Path(aside) / "desk"
            made.mkdir()
            (made / SCENE).write_text(text, encoding="utf-8")
            shutil.copyfile(bundled_scenes()["desk"].parent / "meshes" / MESH, made / MESH)
            for name, paper, dpi in CARDS:
                write_card(CARD_MARKER, made / name, paper, dpi)
            load_scene(made)
            take_name(made, folder)
    except OSError as error:
        raise SinkError(f"{folder}: cannot be made: {reason(error)}") from error


def _run(options: argparse.Namespace) -> int:
    folder, given = options.folder, options.source
    source = int(given) if given.isdecimal() else str(Path(given).absolute())
    make_desk(folder, source, DEFAULT_RADIUS if options.radius is None else options.radius)
    shown = printable(folder)
    print(f"{shown}: {SCENE}, {MESH}, {', '.join(name for name, _, _ in CARDS)}")
    print(f"1. Print {shown}/card-a4.pdf (or card-letter.pdf) at 100 %; both rulers on it must be 100 mm.")
    print("2. Lay it flat, stand the mirror ball on its cross, and have all of it in the camera's picture.")
    if options.radius is None:
        print(f"3. Write the ball's radius into {shown}/{SCENE}, [probe]; it says {DEFAULT_RADIUS:g} m.")
    print(f"next: python -m warp_ar.live {shown}")
    return EXIT_DONE


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    return run_command(lambda: _run(make_parser().parse_args(arguments)))
