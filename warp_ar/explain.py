"""``python -m warp_ar.explain SCENE``: prints the stages that a scene needs, and why the others are left out.

No frame is rendered.
"""

from __future__ import annotations

if __name__ == "__main__":
    from warp_ar.begin import begin

    begin("warp_ar.explain")

import argparse
import sys
from collections.abc import Sequence

from rich.console import Console
from rich.table import Table

from warp_ar.command_line import EXIT_DONE, Parser, run_command
from warp_ar.engine.graph import make_plan
from warp_ar.engine.pipeline import resolve_quality
from warp_ar.output.report import print_plan
from warp_ar.scene import load_scene
from warp_ar.sources.exposures import plan_bracket
from warp_ar.stages import STAGES
from warp_ar.stages.quality import DEFAULT_PRESET, PRESETS
from warp_ar.stages.request import Request


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command's options."""
    parser = Parser(
        prog="python -m warp_ar.explain", description="List the stages that a scene needs, and why others are left out."
    )
    parser.add_common("scene")
    text = f"{', '.join(PRESETS)} (default: {DEFAULT_PRESET})"
    parser.add_argument("--quality", default=DEFAULT_PRESET, metavar="NAME", help=text)
    parser.add_argument("--numerics", action="store_true", help="print each stage's precision and worst error")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    return run_command(lambda: explain(make_parser().parse_args(arguments)))


def explain(options: argparse.Namespace) -> int:
    """Print the plan, or the tables that the options name."""
    if options.numerics:
        print_numerics()
        return EXIT_DONE
    scene = load_scene(options.scene)
    size = (scene.camera.width, scene.camera.height)
    spec = scene.source
    exposures = plan_bracket(spec.exposures or (), spec.shown).ratios if spec is not None else ()
    print_plan(make_plan(Request(scene, resolve_quality(options.quality), size, exposures=exposures)))
    return EXIT_DONE


def print_numerics() -> None:
    """Print the error model: precision and expected worst error of each stage."""
    table = Table("stage", "precision", "expected worst error")
    for stage in STAGES:
        table.add_row(stage.name, stage.numerics.precision, stage.numerics.expected)
    Console(width=None if sys.stdout.isatty() else 160).print(table)
