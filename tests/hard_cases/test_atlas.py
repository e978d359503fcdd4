"""No cell of the atlas is empty."""

from __future__ import annotations

import json
import pathlib
import subprocess
import sys

from tests.hard_cases import atlas

ROOT = pathlib.Path(__file__).resolve().parents[2]


def test_every_row_is_covered_at_every_rung_of_every_stage(tmp_path: pathlib.Path) -> None:
    collected = tmp_path / "atlas.json"
    command = [
        sys.executable,
        "-m",
        "pytest",
        "tests",
        "--collect-only",
        "-q",
        "-p",
        "no:cacheprovider",
        "--atlas",
        str(collected),
    ]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout[-2000:] + run.stderr[-2000:]
    covered = json.loads(collected.read_text())
    empty = [cell for cell in atlas.cells() if "/".join(map(str, cell)) not in covered]
    assert not empty, f"{len(empty)} cells of the atlas have no test: {empty}"


def test_tests_that_stand_elsewhere_exist() -> None:
    for name in atlas.ELSEWHERE:
        file, function = name.split("::")
        assert f"def {function}(" in (ROOT / "tests" / file).read_text(), (
            f"{name} is named in the atlas and does not exist"
        )
