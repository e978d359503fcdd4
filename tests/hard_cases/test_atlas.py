"""No cell of the atlas is empty."""

from __future__ import annotations

import json
import pathlib
import subprocess
import sys

from tests.hard_cases import atlas
from warp_ar import explain
from warp_ar.numerics import NUMERICS
from warp_ar.stages import STAGES

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


def test_the_error_model_names_every_stage_and_its_rows(capsys) -> None:
    for name in (stage.name for stage in STAGES):
        numbers = NUMERICS[name]
        assert numbers.rows == tuple(row for row, stages in atlas.CONCERNS.items() if name in stages), name
        assert numbers.measured is None or 0 <= numbers.measured < 0.01
    assert explain.main(["--numerics"]) == 0
    printed = capsys.readouterr().out
    assert all(stage.name in printed for stage in STAGES)


def test_tests_that_stand_elsewhere_exist() -> None:
    for name in atlas.ELSEWHERE:
        file, function = name.split("::")
        assert f"def {function}(" in (ROOT / "tests" / file).read_text(), (
            f"{name} is named in the atlas and does not exist"
        )
