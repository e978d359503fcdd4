"""Parts of the documentation that are made from the code and from what it measured: keys, commands, presets, figures.

    python -m docs.tables            # name the pages that are out of date; exits with 1 if there are any
    python -m docs.tables --write    # bring them up to date

A page holds such a part between ``<!-- made: NAME -->`` and ``<!-- /made -->``.
"""

from __future__ import annotations

import argparse
import ast
import collections
import importlib
import inspect
import json
import pathlib
import re
from collections.abc import Iterator
from typing import Any

COMMANDS = (
    "init",
    "live",
    "doctor",
    "calibrate",
    "capture",
    "pose",
    "environment",
    "export",
    "explain",
    "keys",
    "farm.cli",
    "tradeoff",
    "paper",
    "reference",
)
"""Commands whose options are listed, in the order of the page."""


def scene_keys() -> str:
    """Tables of a scene file's keys."""
    from warp_ar.scene.key_tables import as_markdown

    return as_markdown()


def command_line() -> str:
    """Every command with its options; what several have alike stands first, and is named after the others' own."""
    parsers = dict(all_parsers())
    count = collections.Counter(row for parser in parsers.values() for row in _options(parser).items())
    common = {argument: text for (argument, text), times in sorted(count.items()) if times > 1}
    parts = ["## Common arguments", "", *_listed(common)]
    for name, parser in parsers.items():
        options = _options(parser)
        own = {argument: text for argument, text in options.items() if common.get(argument) != text}
        others = ", ".join(f"`{argument.split()[0]}`" for argument in options if argument not in own)
        text = (parser.description or "").rstrip(".")
        parts += [f"{'###' if ' ' in name else '##'} `{name}`", "", f"{text[:1].upper()}{text[1:]}.", ""]
        parts += [*_listed(own), *([f"Common: {others}.", ""] if others else [])]
    return "\n".join(parts)


def all_parsers() -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """Yield the parser of every command, and of every command of a command."""
    for name in COMMANDS:
        parser = importlib.import_module(f"warp_ar.{name}").make_parser()
        name = name.removesuffix(".cli")  # of a package that is a command
        yield name, parser
        for action in parser._actions:
            if isinstance(action, argparse._SubParsersAction):
                yield from ((f"{name} {sub}", own) for sub, own in action.choices.items())


def _options(parser: argparse.ArgumentParser) -> dict[str, str]:
    """Return the meaning of every argument, by its name and values."""
    rows = {}
    for action in parser._actions:
        if action.dest not in ("help", "help_all") and not isinstance(action, argparse._SubParsersAction):
            rows[" ".join([*action.option_strings[-1:], values_of(action)]).strip()] = action.help or ""
    return rows


def _listed(arguments: dict[str, str]) -> list[str]:
    return [*(f"- `{argument}`: {text}" for argument, text in arguments.items()), ""] if arguments else []


def values_of(action: argparse.Action) -> str:
    """What stands behind an option, or for an argument; in brackets what may be left out."""
    if action.nargs == 0:
        return ""
    if isinstance(action.metavar, tuple):
        return " ".join(action.metavar)
    name = action.metavar or ("|".join(map(str, action.choices)) if action.choices else action.dest.upper())
    if isinstance(action.nargs, int) and action.nargs <= 5:
        return " ".join([name] * action.nargs)
    return {"?": f"[{name}]", "*": f"[{name} ...]", None: name}.get(action.nargs, f"{name} ...")


def stages() -> str:
    """Return every stage with its work."""
    from warp_ar.stages import STAGES

    return "\n".join(f"- `{stage.name}`: {stage.summary}" for stage in STAGES)


def figures() -> list[dict[str, Any]]:
    """Return what ``python -m warp_ar.tradeoff`` measured: the package's own file, then those of other devices."""
    root = pathlib.Path(__file__).resolve().parents[1]
    files = [root / "warp_ar/accuracy/cost_table.json", *sorted(root.glob("bench/results/*_cost_table.json"))]
    return [json.loads(file.read_text(encoding="utf-8")) for file in files]


def milliseconds(value: float | None) -> str:
    """Return a time with three digits; nothing where it was not measured."""
    return "" if value is None else f"{value:.2f}" if value < 10 else f"{value:.0f}"


def ladder() -> str:
    """Every bundled scene at every preset: its error, and what a whole frame takes; bold where a budget is exceeded."""
    from warp_ar.stages.quality import BUDGETS

    devices = figures()
    scenes = devices[0]["presets"]
    names = list(next(iter(scenes.values())))
    head = f"error (ms, {'; '.join(one['made']['device'] for one in devices)})"
    rows = [["scene: " + head, *(f"`{name}`" for name in names)], ["---", *["--:"] * len(names)]]
    for scene in scenes:
        cells = []
        for name in names:
            times = [one["presets"].get(scene, {}).get(name, {}).get("ms") for one in devices]
            over = times[0] is not None and times[0] > BUDGETS.get(name, times[0])
            told = "; ".join(map(milliseconds, times))
            cells.append(f"{scenes[scene][name]['error']:.3f} ({f'**{told}**' if over else told})")
        rows.append([f"`{scene}`", *cells])
    return "\n".join("| " + " | ".join(cells) + " |" for cells in rows)


def desk_ladder() -> str:
    """The presets on the bundled desk: error, and what a whole frame takes."""
    devices = figures()
    rows = [["preset", "error", *(f"ms, {one['made']['device']}" for one in devices)]]
    rows.append(["---", *["--:"] * (len(rows[0]) - 1)])
    for name, whole in devices[0]["presets"]["desk"].items():
        times = [one["presets"].get("desk", {}).get(name, {}).get("ms") for one in devices]
        rows.append([f"`{name}`", f"{whole['error']:.3f}", *map(milliseconds, times)])
    return "\n".join("| " + " | ".join(cells) + " |" for cells in rows)


def methods() -> str:
    """Return every method: its presets and its error."""
    from warp_ar.accuracy.cost_table import SETTINGS, WORDS, chosen
    from warp_ar.stages.quality import PRESETS

    known = figures()[0]["errors"]
    rows = [["method", "meaning", "presets", "error"], ["---", "---", "---", "--:"]]
    for setting in SETTINGS:
        errors = known.get(setting.name, {})
        what, words = WORDS.get(setting.name, ("", {}))
        rows.append([f"**{setting.name.replace('_', ' ')}**", what, "", ""])
        for method in [method for method in setting.methods if method in errors]:
            names = [name for name, quality in PRESETS.items() if chosen(quality, setting) == method]
            own = f"from {names[0]}" if len(names) > 2 and names == list(PRESETS)[-len(names) :] else ", ".join(names)
            rows.append([f"`{method}`", words.get(method, ""), own, f"{errors[method]:.4f}"])
    return "\n".join("| " + " | ".join(cells) + " |" for cells in rows)


def measured() -> str:
    """On what the figures were measured."""
    lines = []
    for one in figures():
        made = one["made"]
        lines.append(f"- {made['device']}, commit {made['commit']}, Warp {made['warp']}")
    return "\n".join(lines)


def plot(path: pathlib.Path | None = None) -> str:
    """The picture of error over milliseconds on ``desk``, where they are measured; drawn into a file that is given."""
    presets = figures()[0]["presets"]["desk"]
    if any("ms" not in whole for whole in presets.values()):
        return ""
    if path is not None:
        from warp_ar.accuracy.charts import Point, scatter

        points = [Point(name, whole["ms"], whole["error"], False) for name, whole in presets.items()]
        chart = scatter(points, "milliseconds per frame", "error: FLIP to the truth, per changed pixel", 1e3 / 30.0)
        path.write_text(chart, encoding="utf-8")
    return "![Error over milliseconds of the presets on the bundled desk](accuracy.svg)"


READERS = {
    "`.obj`": ("scene.polygon_files.read_obj",),
    "MTL": ("scene.mtl.read_library",),
    "`.ply`": ("scene.polygon_files.read_ply",),
    "`.off`": ("scene.polygon_files.read_off",),
    "`.stl`": ("scene.polygon_files.read_stl",),
    "`.gltf` `.glb`": ("scene.gltf.load_gltf",),
    "pictures": ("pictures.decode_picture",),
    "`.exr` `.hdr`": ("exr_file.read_linear_picture",),
    "video": ("sources.video_file.VideoFile",),
    "EXIF": ("scene.exif.read_exif",),
    "calibrations": ("scene.calibration_file.load_calibration",),
    "poses": ("scene.pose_file.load_pose_file",),
}
"""Readers by format; the first one's docstring tells of the format."""
NAMED = ("_NOT_SHOWN", "_NOT_FOLLOWED")
"""Tables of readers' modules, whose keys are the format's own names of what is noted."""


def formats() -> str:
    """Every format: what its reader's docstring says, and the notes that its code takes."""
    rows = ["| format | followed | refused | named and left out |", "| --- | --- | --- | --- |"]
    for name, places in READERS.items():
        told: dict[str, str] = {}
        named: list[str] = []
        for place in reversed(places):
            module, _, reader = f"warp_ar.{place}".rpartition(".")
            source = importlib.import_module(module)
            parts = re.split(r"^(\w+):\n", inspect.getdoc(getattr(source, reader)) or "", flags=re.MULTILINE)
            told = dict(zip(parts[1::2], parts[2::2], strict=True))
            named = [*notes_of(source, reader), *named]
        errors = re.split(r"\w+Error: (?:As ``error``: )?", told.get("Raises", ""))[1:]
        refused = "; ".join(error[:1].lower() + error[1:].strip().rstrip(".") for error in errors)
        last = "; ".join(
            [*told.get("Names", "").strip().rstrip(".").split("; "), *dict.fromkeys(filter(None, named))]
        ).strip("; ")
        refused = re.sub(r"^damaged(; |$)", "", refused)  # as the page says of all
        cells = [" ".join(text.split()).rstrip(".").replace("``", "`") for text in (told["Follows"], refused, last)]
        rows.append("| " + " | ".join([name, *cells]) + " |")
    return "\n".join(rows)


def notes_of(module: Any, name: str) -> list[str]:
    """Return all that a reader notes, whatever it calls in its module."""
    tree = ast.parse(inspect.getsource(module))
    found = {node.name: node for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    words: list[str] = []
    waiting, seen = [name], set()
    while waiting:
        if (one := waiting.pop()) in seen:
            continue
        seen.add(one)
        if one in NAMED:
            words.append(", ".join(getattr(module, one)))
        for node in ast.walk(found[one]) if one in found else ():
            if isinstance(node, ast.Name):
                waiting.append(node.id)
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "note":
                parts = node.args[0].values if isinstance(node.args[0], ast.JoinedStr) else node.args[:1]
                told = ["…" if isinstance(part, ast.FormattedValue) else getattr(part, "value", "") for part in parts]
                if all(isinstance(text, str) for text in told) and told[0] != "…":  # else it says nothing here
                    words.append("".join(told))
    return words


PARTS = {
    "formats": formats,
    "scene-keys": scene_keys,
    "command-line": command_line,
    "stages": stages,
    "plot": plot,
    "ladder": ladder,
    "ladder-desk": desk_ladder,
    "methods": methods,
    "measured": measured,
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
    folder = pathlib.Path(__file__).parent
    for page in (folder.parent / "README.md", *sorted(folder.glob("*.md"))):
        text = page.read_text(encoding="utf-8")
        if (made := with_parts(text)) != text:
            stale.append(page.name)
            if options.write:
                page.write_text(made, encoding="utf-8")
    if options.write:
        plot(folder / "accuracy.svg")
    for name in stale:
        print(f"{name}: {'written' if options.write else 'out of date; python -m docs.tables --write mends it'}")
    return int(bool(stale) and not options.write)


if __name__ == "__main__":
    raise SystemExit(main())
