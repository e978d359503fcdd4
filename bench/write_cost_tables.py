"""``python -m bench.write_cost_tables``: the measured cost table into ``docs/accuracy.md``.

It reads ``bench/results/*_costs.jsonl``, which ``python -m bench costs`` prints, and the errors of
``warp_ar/accuracy/cost_table.json`` and ``bench/results/presets.json``, both of ``python -m warp_ar.tradeoff``, and
replaces what stands between ``<!-- costs:NAME -->`` and ``<!-- /costs:NAME -->``, there and in ``README.md``. It prints
for every preset what the rule of ``quality.BUDGETS`` would choose.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

from warp_ar.accuracy.cost_table import SETTINGS, WORDS, Choice, MethodCost, choose, chosen, load_errors, pareto_front
from warp_ar.accuracy.costs import BASE
from warp_ar.stages.quality import BUDGETS, PRESETS, SHARE

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "bench" / "results"
OVERLAP = 1.65
"""Processor time over time by the clock of a frame on two cores, measured with nothing else running (78 over 47 ms)."""
TRACKING_MS = 3.0
"""Of a frame: the marker, found before the stages run."""


def read(pattern: str) -> list[dict[str, Any]]:
    """Lines of the newest file that matches; none where there is none."""
    files = sorted(RESULTS.glob(pattern))
    return [json.loads(line) for line in files[-1].read_text().splitlines() if line.startswith("{")] if files else []


def methods(lines: list[dict[str, Any]]) -> dict[tuple[str, str], dict[str, Any]]:
    return {(line["setting"], line["method"]): line for line in lines if "method" in line}


def table(head: list[str], rows: list[list[str]], left: int) -> str:
    # A device that was not measured has no column.
    if all(not row[-1] for row in rows):
        head, rows = head[:-1], [row[:-1] for row in rows]
    marks = ["---"] * left + ["--:"] * (len(head) - left)
    return "\n".join("| " + " | ".join(cells) + " |" for cells in [head, marks, *rows])


def milliseconds(line: dict[str, Any] | None, key: str = "median_ms") -> str:
    if line is None:
        return ""
    value = line[key]
    return f"{value:.3f}" if value < 0.995 else f"{value:.1f}" if value < 99.5 else f"{value:,.0f}"


def device_of(lines: list[dict[str, Any]]) -> str:
    if not lines:
        return "not measured"
    if lines[0]["device"] != "CPU":
        return str(lines[0]["device"])
    return "one CPU core's work" if lines[0].get("clock") == "processor" else "two CPU cores"


def method_table(cpu: list[dict[str, Any]], cuda: list[dict[str, Any]], listed: dict[str, Any]) -> str:
    errors, arrays = load_errors(), listed.get("stage_errors", {})
    rows = []
    ours, theirs = methods(cpu), methods(cuda)
    for setting in SETTINGS:
        if setting.name not in listed["errors"]:
            continue
        what, words = WORDS.get(setting.name, ("", {}))
        rows.append([f"**{setting.name.replace('_', ' ')}**", what, "", "", "", ""])
        for method in setting.methods:
            known = method in listed["errors"][setting.name]
            error = f"{errors[setting.name][method]:.4f}"
            if not known and not any((setting.name, method) in found for found in (ours, theirs)):
                continue  # between two others; never measured
            apart = arrays.get(setting.name, {}).get(method)
            rows.append(
                [
                    f"`{method}`",
                    words.get(method, ""),
                    error if known else "0" if method == "brute_force" else f"({error})",
                    f"{apart:.1%}" if apart else "",
                    milliseconds(ours.get((setting.name, method))),
                    milliseconds(theirs.get((setting.name, method))),
                ]
            )
    head = ["method", "what it does", "error (FLIP)", "rel. RMSE", f"ms, {device_of(cpu)}", f"ms, {device_of(cuda)}"]
    return table(head, rows, 2)


def preset_table(
    cpu: list[dict[str, Any]], cuda: list[dict[str, Any]], presets: dict[str, Any], scenes: list[str]
) -> str:
    rows = []
    for scene in scenes:
        for name in ("paper", "low", "medium", "high"):
            found = [
                next((line for line in lines if line.get("preset") == name and line["scene"] == scene), None)
                for lines in (cpu, cuda)
            ]
            flip = presets["errors"].get(scene, {}).get(name)
            cells = ["" if flip is None else f"{flip:.3f}", *(milliseconds(line) for line in found)]
            rows.append([f"`{scene}`" if name == "paper" else "", f"`{name}`", *cells])
    head = ["scene", "preset", "error (FLIP)", f"ms, {device_of(cpu)}", f"ms, {device_of(cuda)}"]
    return table(head, rows, 2)


def extract(cpu: list[dict[str, Any]], cuda: list[dict[str, Any]], presets: dict[str, Any]) -> str:
    """The presets on ``desk``, for the README."""
    lines = preset_table(cpu, cuda, presets, ["desk"]).splitlines()
    return "\n".join("|" + line.split("|", 2)[2] for line in lines)  # without the scene's column


def front_of(lines: list[dict[str, Any]]) -> tuple[list[Choice], float, dict[tuple[str, str], MethodCost]]:
    """Choices by what ``desk`` calls for, milliseconds relative to the base; the base's; the costs."""
    errors = load_errors()
    found = methods([line for line in lines if line["scene"] == "desk"])
    method_costs = []
    for setting in SETTINGS:
        own = {method: found[setting.name, method] for method in setting.methods if (setting.name, method) in found}
        if not own:
            continue
        start = own[chosen(BASE, setting)]["median_ms"]
        method_costs += [
            MethodCost(setting.name, method, line["median_ms"] - start, errors[setting.name][method])
            for method, line in own.items()
            if method != "brute_force"
        ]
    frame = next(line["base_ms"] for line in lines if line.get("setting") == "irradiance")
    return (
        pareto_front(method_costs),
        frame,
        {(method_cost.setting, method_cost.method): method_cost for method_cost in method_costs},
    )


def rule_table(cpu: list[dict[str, Any]]) -> str:
    """Every preset beside what its budget would buy at best."""
    front, base, method_costs = front_of(cpu)
    scale = OVERLAP if cpu[0].get("clock") == "processor" else 1.0
    rows = []
    for name, budget in BUDGETS.items():
        best = choose(front, (SHARE * budget - TRACKING_MS) * scale - base)
        own = {
            setting: chosen(PRESETS[name], next(k for k in SETTINGS if k.name == setting))
            for setting, _ in method_costs
        }
        milliseconds_ = (base + sum(method_costs[pair].milliseconds for pair in own.items())) / scale + TRACKING_MS
        error = sum(method_costs[pair].error for pair in own.items())
        rows.append([f"`{name}`", f"{budget:.0f}", f"{milliseconds_:.0f}", f"{error:.4f}", f"{best.error:.4f}"])
        other = {setting: method for setting, method in best.settings if own[setting] != method}
        print(
            f"{name}: {milliseconds_:.1f} of {budget:.0f} ms, error {error:.4f}; the best errs {best.error:.4f} in "
            f"{(base + best.milliseconds) / scale + TRACKING_MS:.1f} ms with {other or 'the same methods'}"
        )
    return table(["preset", "budget, ms", "expected ms", "expected error", "least error within the budget"], rows, 1)


def replace(path: Path, name: str, text: str) -> None:
    old = path.read_text(encoding="utf-8")
    block = f"<!-- costs:{name} -->\n{text}\n<!-- /costs:{name} -->"
    new, count = re.subn(rf"<!-- costs:{name} -->.*?<!-- /costs:{name} -->", lambda _: block, old, flags=re.S)
    if count != 1:
        sys.exit(f"write_cost_tables: {path.name} has {count} blocks {name!r}; expected 1")
    path.write_text(new, encoding="utf-8")


def main() -> None:
    cpu, cuda = read("cpu_costs.jsonl"), read("h*_costs.jsonl")
    listed = json.loads((ROOT / "warp_ar" / "accuracy" / "cost_table.json").read_text(encoding="utf-8"))
    presets = json.loads((ROOT / "bench" / "results" / "presets.json").read_text(encoding="utf-8"))
    if not cpu:
        sys.exit("write_cost_tables: no bench/results/cpu_costs.jsonl; make it with python -m bench costs --device cpu")
    page = ROOT / "docs" / "accuracy.md"
    replace(ROOT / "README.md", "readme", extract(cpu, cuda, presets))
    scenes = list(dict.fromkeys(line["scene"] for line in cpu if "preset" in line))
    replace(page, "presets", preset_table(cpu, cuda, presets, scenes))
    replace(page, "methods", method_table(cpu, cuda, listed))
    replace(page, "rule", rule_table(cpu))


if __name__ == "__main__":
    main()
