"""Parts of the documentation that are made from the code: keys, commands, stages, presets.

    python -m docs.tables            # name the pages that are out of date; exits with 1 if there are any
    python -m docs.tables --write    # bring them up to date

A page holds such a part between ``<!-- made: NAME -->`` and ``<!-- /made -->``.
"""

from __future__ import annotations

import argparse
import importlib
import pathlib
import re
from typing import Any

COMMANDS = (
    "init",
    "live",
    "doctor",
    "calibrate",
    "capture",
    "environment",
    "export",
    "explain",
    "farm.cli",
    "tradeoff",
    "paper",
    "reference",
)
"""Commands whose options are listed, in the order of the page."""


def scene_keys() -> str:
    """Tables of a scene file's keys."""
    from warp_ar.scene.reference import as_markdown

    return as_markdown()


def command_line() -> str:
    """Every command with its options."""
    parts = []
    for name in COMMANDS:
        parser = importlib.import_module(f"warp_ar.{name}").make_parser()
        name = name.removesuffix(".cli")  # of a package that is a command
        parts += [f"## `python -m warp_ar.{name}`", "", parser.description or "", "", *_options(parser)]
        for action in parser._actions:
            if isinstance(action, argparse._SubParsersAction):
                for sub, own in action.choices.items():
                    parts += [f"### `{name} {sub}`", "", own.description or "", "", *_options(own)]
    return "\n".join(parts)


def _options(parser: argparse.ArgumentParser) -> list[str]:
    rows = ["| argument | meaning |", "| --- | --- |"]
    for action in parser._actions:
        if isinstance(action, argparse._HelpAction | argparse._SubParsersAction):
            continue
        values = values_of(action)
        name = f"{action.option_strings[-1]} {values}".strip() if action.option_strings else values
        text = (action.help or "").replace("|", "\\|")
        rows.append(f"| `{name.replace('|', ' or ')}` | {text} |")
    return [*rows, ""] if len(rows) > 2 else []


def values_of(action: argparse.Action) -> str:
    """What stands behind an option, or for an argument."""
    if action.nargs == 0:
        return ""
    if isinstance(action.metavar, tuple):
        return " ".join(action.metavar)
    name = action.metavar or ("|".join(map(str, action.choices)) if action.choices else action.dest.upper())
    if isinstance(action.nargs, int):
        return " ".join([name] * action.nargs)
    return f"{name} ..." if action.nargs == "+" else name


def stages() -> str:
    """Every stage: what it does, its methods, and the file of its kernels."""
    from warp_ar.stages import STAGES

    rows = ["| stage | what it does | methods, cheapest first |", "| --- | --- | --- |"]
    for stage in STAGES:
        methods = ", ".join(f"`{method}`" for method in stage.methods) if len(stage.methods) > 1 else "one"
        rows.append(f"| `{stage.name}` | {stage.summary} | {methods} |")
    return "\n".join(rows)


def presets() -> str:
    """What each preset chooses."""
    from warp_ar.stages.quality import PRESETS

    rows = ["| | " + " | ".join(f"`{name}`" for name in PRESETS) + " |", "| --- |" + " --- |" * len(PRESETS)]
    for size in ("environment_height", "edge_samples"):
        cells = [str(getattr(quality, size)) for quality in PRESETS.values()]
        rows.append(f"| {size.replace('_', ' ')} | " + " | ".join(cells) + " |")
    for stage in dict.fromkeys(stage for quality in PRESETS.values() for stage, _ in quality.methods):
        cells = [chosen(stage, quality) for quality in PRESETS.values()]
        rows.append(f"| {stage.replace('_', ' ')} | " + " | ".join(f"`{cell}`" for cell in cells) + " |")
    return "\n".join(rows)


def chosen(stage: str, quality: Any) -> str:
    """The method of a quality for a stage; the last one where the quality names none."""
    from warp_ar.stages import STAGES

    method = str(quality.method(stage))
    methods = next((list(one.methods) for one in STAGES if one.name == stage), [method])
    return methods[-1] if method == "default" else method


PARTS = {
    "scene-keys": scene_keys,
    "command-line": command_line,
    "stages": stages,
    "presets": presets,
}


def with_parts(markdown: str) -> str:
    """Return a page's text with every made part as the code has it today."""
    made = r"<!-- made: ([\w-]+) -->.*?<!-- /made -->"
    return re.sub(
        made,
        lambda match: f"<!-- made: {match[1]} -->\n{PARTS[match[1]]().strip()}\n<!-- /made -->",
        markdown,
        flags=re.DOTALL,
    )


def main(arguments: list[str] | None = None) -> int:
    """Compare the pages with the code, or write them."""
    parser = argparse.ArgumentParser(prog="python -m docs.tables", description="Tables of the pages.")
    parser.add_argument("--write", action="store_true", help="bring the pages up to date")
    options = parser.parse_args(arguments)
    stale = []
    for page in sorted(pathlib.Path(__file__).parent.glob("*.md")):
        text = page.read_text(encoding="utf-8")
        if (made := with_parts(text)) != text:
            stale.append(page.name)
            if options.write:
                page.write_text(made, encoding="utf-8")
    for name in stale:
        print(f"docs/{name}: {'written' if options.write else 'out of date; python -m docs.tables --write mends it'}")
    return int(bool(stale) and not options.write)


if __name__ == "__main__":
    raise SystemExit(main())
