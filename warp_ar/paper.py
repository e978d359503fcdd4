"""``python -m warp_ar.paper [FIGURE ...]``: reproduces the paper's figures, and compares readings of its text.

FIGURE is 1 or 3 to 9, or ``readings``; without any, all are made. Each figure is a picture, a table of numbers and a
plot. It compares the preset ``paper``, our presets and the ground truth on bundled clips.
"""

from __future__ import annotations

if __name__ == "__main__":
    from warp_ar.begin import begin

    begin("warp_ar.paper")

import argparse
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy.typing as npt
from PIL import Image
from rich.console import Console
from rich.progress import track

from warp_ar.accuracy.charts import require_plots
from warp_ar.accuracy.report import MIN_COLUMNS, print_table
from warp_ar.command_line import EXIT_DONE, Parser, count, run_command
from warp_ar.device import resolve_device
from warp_ar.errors import SceneError, SinkError, SourceError, UsageError
from warp_ar.files import store
from warp_ar.output.places import claim_places
from warp_ar.signature import COMMENT, software_exif

try:
    from bench.paper_figures import FIGURES, READING_SCENES, Context, PaperFigure, compare_readings
except ImportError as error:
    raise SystemExit("warp_ar: the paper's figures are made in a checkout, from its folder") from error

READINGS = "readings"
QUALITY = 88
"""Quality setting of WebP."""
ENDINGS = (".webp", ".svg", "a.svg", "b.svg")
"""Endings of a figure's files: the picture, then one plot or two."""
PAGE = "figures.md"


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command's options."""
    parser = Parser(prog="python -m warp_ar.paper", description="Reproduce the paper's figures, beside ours.")
    add = parser.add_argument
    names = ", ".join(map(str, FIGURES))
    add("figures", nargs="*", metavar="FIGURE", help=f"{names} or {READINGS} (default: all)")
    add("--frames", type=count, default=12, metavar="N", help="frames per run, the last is shown (default: 12)")
    parser.add_common("--shrink", "--device", "--overwrite")
    add("--out", type=Path, metavar="DIR", help="folder of figureN.webp, figureN.svg and figures.md")
    return parser


def asked_figures(names: Sequence[str]) -> list[str]:
    """Return the names of figures, checked; all of them if none is given.

    Raises:
        UsageError: A name is unknown.
    """
    known = [*map(str, FIGURES), READINGS]
    for name in names:
        if name not in known:
            raise UsageError(f"figure {name}: expected {', '.join(known)}")
    return list(names) or known


def as_markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    lines = [head, ["---", *["--:"] * (len(head) - 1)], *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def encode_webp(picture: npt.NDArray[Any]) -> bytes:
    """Return a signed WebP of an RGB picture, uint8 (height, width, 3)."""
    data = io.BytesIO()
    Image.fromarray(picture).save(data, "WEBP", quality=QUALITY, exif=software_exif())
    return data.getvalue()


def write_figure(figure: PaperFigure, out: Path) -> str:
    """Write a figure's picture and plots; return its section of the Markdown page, which links into the folder."""
    name = f"figure{figure.number}"
    store(out / f"{name}.webp", encode_webp(figure.picture))
    parts = [f"## Figure {figure.number}: {figure.title}", figure.text, f"![{figure.title}]({out.name}/{name}.webp)"]
    below = "; below each its FLIP to the truth" if "truth" in figure.labels and figure.number not in (5, 6) else ""
    parts += [f"From left to right: {', '.join(figure.labels)}{below}.", as_markdown(figure.head, figure.rows)]
    for index, plot in enumerate(figure.plots):
        file = f"{name}{'ab'[index] if len(figure.plots) > 1 else ''}.svg"
        store(out / file, f"{COMMENT}\n{plot}".encode())
        parts.append(f"![{figure.head[-1]}]({out.name}/{file})")
    return "\n\n".join(parts)


def reading_rows(context: Context) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Return the head and the rows of the table that compares readings of the paper."""
    found = compare_readings(context)
    head = ("section", "open", "reading", *(f"`{scene}`" for scene in READING_SCENES))
    rows = [
        (
            reading.section,
            reading.question,
            reading.answer,
            *(f"{errors[scene]:.3f}" if scene in errors else "" for scene in READING_SCENES),
        )
        for reading, errors in found
    ]
    return head, rows


def make_all(options: argparse.Namespace) -> int:
    """Make the requested figures, print their tables and write the files.

    Raises:
        UsageError: An option has an impossible value, or a library is missing.
    """
    names = asked_figures(options.figures)
    require_plots()
    context = Context(str(resolve_device(options.device)), options.frames, options.shrink)
    console = Console()
    console.width = max(console.width, MIN_COLUMNS)
    made = [f"figure{name}{ending}" for name in names if name != READINGS for ending in ENDINGS]
    out: Path | None = options.out
    if out is not None:
        claim_places({}, {f"--out, {name}": out / name for name in (*made, PAGE)}, overwrite=options.overwrite)
    sections = []
    for name in track(names, "figures", console=console):
        if name == READINGS:
            head, rows = reading_rows(context)
            title = "Readings of the open text"
            print_table(console, f"{title}: FLIP of the preset paper to the truth", head, rows)
            sections.append(f"## {title}\n\n{as_markdown(head, rows)}")
            continue
        figure = FIGURES[int(name)](context)
        print_table(console, f"Figure {name}: {figure.title}", figure.head, figure.rows)
        if out is not None:
            sections.append(write_figure(figure, out))
    if out is not None:
        store(out / PAGE, ("\n\n".join([COMMENT, *sections]) + "\n").encode())
        console.print(f"written to {out}", highlight=False)
    return EXIT_DONE


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code: 0 done, 1 failed while running, 2 bad usage."""
    return run_command(lambda: make_all(make_parser().parse_args(arguments)), (SceneError, SourceError, SinkError))
