"""Writes the table of hard cases into docs/numerics.md from reports of pytest.

    python -m pytest -q --junitxml=report.xml
    python -m tests.hard_cases.table REPORT.xml [...] [--note "when and on what"]

Reports may be one for each test file: they add up. A report of a machine with a CUDA device holds the tests of both
devices: their names say which (``[cuda:0-...]``). A column that no report fills keeps what stands there. A cell says
how many of a stage's methods passed, and in how many tests.
"""

from __future__ import annotations

import argparse
import collections
import pathlib
import re
import xml.etree.ElementTree as ElementTree

from tests.hard_cases import atlas

FILE = pathlib.Path(__file__).resolve().parents[2] / "docs" / "numerics.md"
BEGIN, END = "<!-- table -->", "<!-- /table -->"

ON_HOST = (atlas.TRACK, atlas.SOURCE)
"""What never runs on a GPU."""

Results = dict[tuple[int, str, str], list[bool]]


def read_reports(paths: list[pathlib.Path]) -> dict[str, Results]:
    """Outcome of every test, by device and cell; skipped tests say nothing, tests run twice what they said last."""
    outcomes: dict[tuple[str, str], tuple[bool, list[str]]] = {}
    for path in paths:
        for case in ElementTree.parse(path).iter("testcase"):
            if case.find("skipped") is None:
                good = case.find("failure") is None and case.find("error") is None
                cells = [entry.get("value", "") for entry in case.iter("property") if entry.get("name") == "atlas"]
                outcomes[case.get("classname", ""), case.get("name", "")] = good, cells
    found: dict[str, Results] = {"CPU": collections.defaultdict(list), "CUDA": collections.defaultdict(list)}
    for (_, name), (good, cells) in outcomes.items():
        for cell in cells:
            row, stage, method = cell.split("/")
            found["CUDA" if "cuda" in name else "CPU"][int(row), stage, method].append(good)
    return found


def cell_text(results: Results, row: int, stage: str) -> str:
    """What one stage's cell says: methods passed of all, or who failed."""
    methods = atlas.methods_of(stage)
    tried = {method: results.get((row, stage, method), []) for method in methods}
    if not any(tried.values()):
        return ""
    failed = [method for method, outcomes in tried.items() if not all(outcomes)]
    if failed:
        return "FAILED: " + ", ".join(failed)
    count = sum(bool(outcomes) for outcomes in tried.values())
    return f"{count}/{len(methods)} ({sum(map(len, tried.values()))} tests)"


def make_table(results: dict[str, Results], before: str) -> str:
    """The table, one line per row and stage, columns of devices that no report fills taken over from ``before``."""
    old = {tuple(line.split("|")[1:3]): line.split("|")[4:6] for line in before.splitlines() if line.startswith("| ")}
    lines = ["| row | stage | methods | CPU | CUDA |", "| --- | --- | --- | --- | --- |"]
    known = {stage for _, stage, _ in atlas.cells()}
    for row, stages in atlas.CONCERNS.items():
        for stage in (stage for stage in stages if stage in known):
            kept = old.get((f" {row} ", f" {stage} "), ["", ""])
            columns = [
                (cell_text(results[device], row, stage) or kept[index].strip())
                for index, device in enumerate(("CPU", "CUDA"))
            ]
            if stage in ON_HOST:
                columns[1] = "on the host"
            lines.append(f"| {row} | {stage} | {' '.join(atlas.methods_of(stage))} | {' | '.join(columns)} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description="Write the table of hard cases from pytest's JUnit reports.")
    parser.add_argument("reports", nargs="+", type=pathlib.Path, metavar="REPORT.xml")
    parser.add_argument("--note", help="when the reports were made, and on what")
    options = parser.parse_args()
    text = FILE.read_text()
    match = re.search(f"{re.escape(BEGIN)}(.*?){re.escape(END)}", text, re.DOTALL)
    assert match is not None, f"{FILE} has no {BEGIN} ... {END}"
    table = make_table(read_reports(options.reports), match.group(1))
    notes = [line for line in match.group(1).splitlines() if line.startswith("- ")]
    if options.note:
        # A note says first what it is about ("CPU: ..."), and takes the place of the one before it.
        about = options.note.split(":")[0]
        notes = [line for line in notes if not line.startswith(f"- {about}:")] + [f"- {options.note}"]
    body = "\n".join([*notes, "", table] if notes else ["", table])
    FILE.write_text(text.replace(match.group(0), f"{BEGIN}\n{body}\n{END}"))


if __name__ == "__main__":
    main()
