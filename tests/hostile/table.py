"""Writes what was tried and what held into docs/hostile-inputs.md: ``python -m tests.hostile.table``."""

from __future__ import annotations

import collections
import json
import pathlib
import subprocess
import sys

from tests.hostile.cases import all_cases

ROOT = pathlib.Path(__file__).resolve().parents[2]
FILE = ROOT / "docs" / "hostile-inputs.md"
BEGIN, END = "<!-- table -->", "<!-- /table -->"
HELD = ("read", "refused")
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


def make_table(outcomes: list[Outcome]) -> str:
    """One line for all that was tried."""
    counts = collections.Counter(outcome if outcome in HELD else "broke" for _, _, outcome, _ in outcomes)
    head = "| input | tried | accepted | refused in one line | broke |\n| --- | --: | --: | --: | --: |\n"
    return head + f"| {MADE} | {counts.total()} | {counts['read']} | {counts['refused']} | {counts['broke']} |"


def tried() -> int:
    """How many inputs the table has."""
    return sum(1 for _ in all_cases())


def tried_in_docs() -> int:
    """The same as the table says."""
    body = FILE.read_text().split(BEGIN)[1].split(END)[0]
    return int(body.split(f"| {MADE} | ")[1].split(" | ")[0])


def main() -> None:
    """Attack, and write the table."""
    outcomes = attack()
    text = FILE.read_text()
    before, rest = text.split(BEGIN)
    FILE.write_text(f"{before}{BEGIN}\n{make_table(outcomes)}\n{END}{rest.split(END)[1]}")
    for outcome in outcomes:
        if outcome[2] not in HELD:
            print(*outcome, sep=" | ", file=sys.stderr)


if __name__ == "__main__":
    main()
