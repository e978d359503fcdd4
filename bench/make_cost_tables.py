"""Every figure of the cost tables by today's code, in one command: ``python -m bench.make_cost_tables``.

It runs, one after another, and says what each took:

  errors    what each method errs, at half size over ten frames: ``warp_ar/accuracy/cost_table.json``
  presets   what each preset errs, over whole clips: ``bench/results/presets.json``
  costs     milliseconds of every method and preset: ``bench/results/cpu_costs.jsonl``
  tables    all of it into ``docs/accuracy.md`` and ``README.md``

Errors do not depend on what else runs: they and the costs of other devices can be made at other times (``--only``), and
on another machine or device (``--device``, ``--keep``). They run in as many processes as the machine has cores; costs
run alone, and want a machine with nothing else to do.
``--processor-time`` counts the work of one thread instead, for a busy one.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from bench.common import commit
from warp_ar.scene import bundled_scenes
from warp_ar.stages.quality import PRESETS

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "bench" / "results"
ERROR_OPTIONS = ("--shrink", "2", "--frames", "10")
PRESET_OPTIONS = ("--presets", "--frames", "1000")
KEYS = ("case", "setting", "method", "quality")
"""Of a line: what it is about."""
STEPS = ("errors", "presets", "costs", "tables")


@dataclasses.dataclass(frozen=True)
class Runs:
    """How ``warp_ar.tradeoff`` is run."""

    device: str = "cpu"
    folder: Path | None = None
    """Keeps what it writes; what is there is not made again. None keeps nothing."""

    def tradeoff(self, options: Sequence[str], scene: str, name: str) -> dict[str, str]:
        """Run it on a scene, or ``all``; texts of the files that it wrote into a folder of this name."""
        with contextlib.ExitStack() as stack:
            folder = self.folder or Path(stack.enter_context(tempfile.TemporaryDirectory()))
            out = folder / name
            if not (out / "tradeoff.jsonl").exists():
                command = [sys.executable, "-m", "warp_ar.tradeoff", scene, *options]
                command += ["--device", self.device, "--out", str(out)]
                subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
                print(f"  {name}: done", flush=True)
            return {path.name: path.read_text(encoding="utf-8") for path in out.iterdir() if path.suffix != ".html"}

    def every(self, asked: Mapping[str, tuple[str, Sequence[str]]]) -> list[dict[str, str]]:
        """The same for scenes and options by name, as many at a time as there are cores."""
        with ThreadPoolExecutor(os.cpu_count() or 1) as workers:
            runs = [workers.submit(self.tradeoff, options, scene, name) for name, (scene, options) in asked.items()]
            return [run.result() for run in runs]


def merge_errors(tables: Sequence[dict[str, Any]], lines: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The cost table of several scenes from those of each: means over the scenes that call for a method.

    Args:
        tables: As ``warp_ar.tradeoff`` writes them for one scene.
        lines: Their JSON lines.
    """
    rows = [line for line in lines if line["kind"] == "method"]
    merged = {key: tables[0][key] for key in ("program", "made")}
    cases = dict.fromkeys(row["case"] for row in rows)
    merged["made"] = {**merged["made"], "by": f"python -m warp_ar.tradeoff {' '.join(cases)}", "commit": commit()}
    found: dict[str, dict[str, list[dict[str, Any]]]] = {}
    for row in rows:
        found.setdefault(row["setting"], {}).setdefault(row["method"], []).append(row)
    for table in ("errors", "stage_errors", "dominated"):
        merged[table] = {}
    for setting, methods in found.items():
        means = {method: statistics.fmean(row["error"] for row in own) for method, own in methods.items()}
        best = min(means.values())
        merged["errors"][setting] = {method: round(mean - best, 5) for method, mean in means.items()}
        arrays = {
            method: [row["relative_rmse"] for row in own if "relative_rmse" in row] for method, own in methods.items()
        }
        merged["stage_errors"][setting] = {name: round(statistics.fmean(own), 5) for name, own in arrays.items() if own}
        beaten = [method for method, own in methods.items() if all(row["dominated"] for row in own)]
        merged["dominated"] |= {setting: beaten} if beaten else {}
    return merged


def make_errors(runs: Runs, stage: str | None, scenes: Sequence[str]) -> None:
    """Errors of methods; where one stage is asked for, the others' stay as they are.

    Args:
        runs: How they are made.
        stage: Or another setting that is turned.
        scenes: Names of the bundled scenes that call for it, if it is given.
    """
    options = (*ERROR_OPTIONS, *(("--stage", stage) if stage else ()))
    names = scenes if stage else bundled_scenes()
    asked: dict[str, tuple[str, Sequence[str]]] = {f"{stage or 'errors'}_{scene}": (scene, options) for scene in names}
    if not stage:
        # Lights with a size are in no bundled scene; ``all`` brings a copy of one that has them.
        asked["errors_sized"] = ("all", (*ERROR_OPTIONS, "--stage", "light_shadow"))
    written = runs.every(asked)
    found = [json.loads(line) for files in written for line in files["tradeoff.jsonl"].splitlines()]
    lines = list({(line["kind"], *(line.get(key) for key in KEYS)): line for line in found}.values())
    merged = merge_errors([json.loads(files["cost_table.json"]) for files in written], lines)
    path = ROOT / "warp_ar" / "accuracy" / "cost_table.json"
    if stage:
        merged = renew_stage(json.loads(path.read_text(encoding="utf-8")), merged)
    path.write_text(json.dumps(merged, indent=1) + "\n", encoding="utf-8")


def renew_stage(old: dict[str, Any], new: dict[str, Any]) -> dict[str, Any]:
    """A cost table with the errors of another one's settings in it; it tells how both were made."""
    tables = {table: old.get(table, {}) | new[table] for table in ("errors", "stage_errors")}
    beaten = {name: own for name, own in old.get("dominated", {}).items() if name not in new["errors"]}
    renewed = [*old.get("renewed", []), new["made"]]
    return {**old, "renewed": renewed, **tables, "dominated": beaten | new["dominated"]}


def make_presets(runs: Runs, only: str | None, scenes: Sequence[str]) -> None:
    """Errors of presets; where only some or some scenes are asked for, the others' stay as they are.

    Args:
        runs: How they are made.
        only: Presets, separated by commas.
        scenes: Names of bundled scenes.
    """
    options = (*PRESET_OPTIONS, *(("--only", only) if only else ()))
    written = runs.every({f"presets_{scene}": (scene, options) for scene in scenes or bundled_scenes()})
    lists = [json.loads(files["presets.json"]) for files in written]
    errors = {scene: own for listed in lists for scene, own in listed["errors"].items()}
    by = f"python -m warp_ar.tradeoff {' '.join(errors)} {' '.join(options)}"
    merged = {**lists[0], "made": {**lists[0]["made"], "by": by, "commit": commit()}, "errors": errors}
    path = RESULTS / "presets.json"
    if only or scenes:
        merged = merge_presets(json.loads(path.read_text(encoding="utf-8")), merged)
    path.write_text(json.dumps(merged, indent=1) + "\n", encoding="utf-8")


def merge_presets(old: dict[str, Any], new: dict[str, Any]) -> dict[str, Any]:
    """A list of presets' errors with those of another one in it; it tells how both were made."""
    both = {
        scene: old["errors"].get(scene, {}) | new["errors"].get(scene, {}) for scene in old["errors"] | new["errors"]
    }
    errors = {scene: {name: own[name] for name in PRESETS if name in own} for scene, own in both.items()}
    return {**old, "renewed": [*old.get("renewed", []), new["made"]], "errors": dict(sorted(errors.items()))}


def make_costs(*, processor_time: bool) -> None:
    """Milliseconds of methods and presets."""
    clock = {"WARP_AR_CLOCK": "processor"} if processor_time else {}
    command = [sys.executable, "-m", "bench", "costs", "--device", "cpu"]
    done = subprocess.run(command, cwd=ROOT, env=os.environ | clock, check=True, stdout=subprocess.PIPE, text=True)
    (RESULTS / "cpu_costs.jsonl").write_text(done.stdout, encoding="utf-8")


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m bench.make_cost_tables", description="All cost tables anew.")
    steps_text = ",".join(STEPS)
    parser.add_argument("--only", default=steps_text, help=f"steps, separated by commas (default: {steps_text})")
    parser.add_argument("--stage", metavar="NAME", help="errors of its methods only, on --scenes; those of others stay")
    parser.add_argument("--presets", metavar="A,B", help="errors of these presets only; those of others stay")
    parser.add_argument(
        "--scenes", default=(), type=lambda text: text.split(","), metavar="A,B", help="the same for scenes"
    )
    parser.add_argument("--processor-time", action="store_true", help="count the work of one thread")
    parser.add_argument("--device", default="cpu", help="where errors are measured")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="go on with errors where a run was ended")
    options = parser.parse_args()
    asked = options.only.split(",")
    if not set(asked) <= set(STEPS):
        parser.error(f"--only {options.only}: expected some of {', '.join(STEPS)}")
    if options.stage and not options.scenes:
        parser.error("--stage: name the scenes that call for it (--scenes)")
    runs = Runs(options.device, options.keep)
    steps: dict[str, Callable[[], object]] = {
        "errors": lambda: make_errors(runs, options.stage, options.scenes),
        "presets": lambda: make_presets(runs, options.presets, options.scenes),
        "costs": lambda: make_costs(processor_time=options.processor_time),
        "tables": lambda: subprocess.run([sys.executable, "-m", "bench.write_cost_tables"], cwd=ROOT, check=True),
    }
    for name in STEPS:
        if name in asked:
            start = time.perf_counter()
            print(f"{name} ...", flush=True)
            steps[name]()
            print(f"{name}: {time.perf_counter() - start:.0f} s", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
