"""Parts of the documentation that are made from the code when the site is built.

A page says ``<!-- made: NAME -->`` where the part belongs.
"""

from __future__ import annotations

import argparse
import functools
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


def paper_figures() -> str:
    """The paper's figures as ``python -m warp_ar.paper --out docs/paper`` wrote them."""
    return (pathlib.Path(__file__).parent / "paper" / "figures.md").read_text(encoding="utf-8")


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


def example(name: str) -> str:
    """A worked example as the changes that it makes."""
    text = (pathlib.Path(__file__).parent / "examples" / f"{name}.diff").read_text(encoding="utf-8")
    parts = re.split(r"^diff --git a/(\S+) b/\S+\n", text, flags=re.M)[1:]
    shown = []
    for path, change in zip(parts[::2], parts[1::2], strict=True):
        lines = [line for line in change.splitlines() if not line.startswith(("index ", "--- ", "+++ ", "new file"))]
        shown += [f'??? example "`{path}`"', "", "    ```diff", *(f"    {line}" for line in lines), "    ```", ""]
    return "\n".join(shown)


PARTS = {
    "scene-keys": scene_keys,
    "command-line": command_line,
    "stages": stages,
    "presets": presets,
    "paper-figures": paper_figures,
} | {f"example-{name}": functools.partial(example, name) for name in ("stage", "method", "scene-key", "source")}


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Put the made parts into a page."""
    return re.sub(r"<!-- made: ([\w-]+) -->", lambda match: PARTS[match[1]](), markdown)
