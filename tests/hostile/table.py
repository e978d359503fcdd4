"""Writes what was tried and what held into docs/hostile-inputs.md: ``python -m tests.hostile.table``."""

from __future__ import annotations

import collections
import json
import pathlib
import re
import subprocess
import sys

from tests.hostile.cases import all_cases
from tests.hostile.corpus import READERS
from tests.hostile.mutate import EXAMPLES, HELD, ROW, Worker, mutate_all

ROOT = pathlib.Path(__file__).resolve().parents[2]
FILE = ROOT / "docs" / "hostile-inputs.md"
BEGIN, END = "<!-- table -->", "<!-- /table -->"
MADE = "sound, damaged and made-up inputs of every reader and sink"
MOST_DEATHS = 5
"""Processes that may die of an input before the rest is given up."""

Outcome = tuple[str, str, str, str]
"""Row, what was tried, what became of it, the message."""


def attack() -> list[Outcome]:
    """Try every input, each in a process that may die of it."""
    outcomes: list[Outcome] = []
    for _ in range(MOST_DEATHS):
        command = [sys.executable, "-m", "tests.hostile.attack", str(len(outcomes))]
        done = subprocess.run(command, cwd=ROOT, check=False, stdout=subprocess.PIPE, text=True, timeout=1200)
        lines = [json.loads(line) for line in done.stdout.splitlines()]
        outcomes += [
            (case["row"], case["what"], result["outcome"], result.get("message", ""))
            for case, result in zip(lines[::2], lines[1::2], strict=False)
        ]
        if done.returncode == 0:
            return outcomes
        died = lines[-1] if len(lines) % 2 else {"row": "none", "what": "before the first input"}
        outcomes.append((died["row"], died["what"], f"the process ended with {done.returncode}", ""))
    return outcomes


def mutate(examples: int = EXAMPLES) -> list[Outcome]:
    """Hand so many mutations of each file to its reader."""
    outcomes: list[Outcome] = []
    worker = Worker()
    try:
        for number, reader in enumerate(READERS):

            def note(data: bytes, result: dict[str, str], name: str = reader.name) -> None:
                outcomes.append((ROW, f"{name}, {len(data)} bytes", result["outcome"], result.get("message", "")))

            mutate_all(worker, number, note, examples)
    finally:
        worker.close()
    return outcomes


def make_table(outcomes: list[Outcome]) -> str:
    """One line for what was made, one for what was mutated, and the sum."""
    rows: dict[str, collections.Counter[str]] = collections.defaultdict(collections.Counter)
    for row, _, outcome, _ in outcomes:
        for name in (row if row == ROW else MADE, "all"):
            rows[name][outcome if outcome in HELD else "broke"] += 1
    rows["all"] = rows.pop("all")
    lines = ["| what takes it in | tried | accepted | refused in one line | broke |", "| --- | --: | --: | --: | --: |"]
    for name, counts in rows.items():
        lines.append(f"| {name} | {counts.total()} | {counts['read']} | {counts['refused']} | {counts['broke']} |")
    return "\n".join(lines)


def tried() -> dict[str, int]:
    """How many inputs each row of the table has."""
    made, mutated = sum(1 for _ in all_cases()), EXAMPLES * len(READERS)
    return {MADE: made, ROW: mutated, "all": made + mutated}


def tried_in_docs() -> dict[str, int]:
    """The same as the table says."""
    body = FILE.read_text().split(BEGIN)[1].split(END)[0]
    return {row: int(count) for row, count in re.findall(r"(?m)^\| ([^|]+) \| (\d+) \|", body)}


def main() -> None:
    """Attack, and write the table."""
    outcomes = [*attack(), *mutate()]
    text = FILE.read_text()
    before, rest = text.split(BEGIN)
    FILE.write_text(f"{before}{BEGIN}\n{make_table(outcomes)}\n{END}{rest.split(END)[1]}")
    for outcome in outcomes:
        if outcome[2] not in HELD:
            print(*outcome, sep=" | ", file=sys.stderr)


if __name__ == "__main__":
    main()
