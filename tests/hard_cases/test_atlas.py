"""No cell of the atlas is empty."""

from __future__ import annotations

import json
import pathlib
import subprocess
import sys

from tests.hard_cases import atlas, measure_errors
from tests.hard_cases.rig import METHODS, SIZE, make_quality, make_scene
from warp_ar import explain
from warp_ar.engine.graph import make_plan
from warp_ar.stages import STAGES
from warp_ar.stages.request import Request

ROOT = pathlib.Path(__file__).resolve().parents[2]


def collect_all(folder: pathlib.Path) -> dict[str, list[str]]:
    """What all tests of the checkout cover, collected by a process of its own."""
    file = folder / "atlas.json"
    command = [sys.executable, "-m", "pytest", "tests", "--collect-only", "-q", "-p", "no:cacheprovider"]
    run = subprocess.run([*command, "--atlas", str(file)], cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout[-2000:] + run.stderr[-2000:]
    return dict(json.loads(file.read_text()))


def test_every_row_is_covered_at_every_method_of_every_stage(request, tmp_path: pathlib.Path) -> None:
    options = request.config.option
    whole = request.config.args in (["tests"], [str(ROOT)], [str(ROOT / "tests")])
    # A run of everything has collected everything already.
    here = whole and not (options.keyword or options.markexpr or getattr(options, "lf", False))
    covered = atlas.coverage(atlas.collected) if here else collect_all(tmp_path)
    empty = [cell for cell in atlas.cells() if "/".join(map(str, cell)) not in covered]
    assert not empty, f"{len(empty)} cells of the atlas have no test: {empty}"


def test_the_error_model_names_every_stage(capsys) -> None:
    assert explain.main(["--numerics"]) == 0
    printed = capsys.readouterr().out
    assert all(stage.name in printed for stage in STAGES)


def test_every_stage_is_compared_with_its_twin() -> None:
    """The bounds that the error model states are checked where the twins are, on every device."""
    checked = set().union(*measure_errors.find_twins().values())
    assert checked == {stage.name for stage in STAGES}


def test_a_stage_on_a_method_that_has_no_row_does_not_run() -> None:
    """Methods without cells mean that the stage is left out, with a reason; what is left out has no hard cases."""
    for stage in STAGES:
        for method in set(stage.methods) - set(METHODS[stage.name]):
            plan = make_plan(Request(make_scene(), make_quality(**{stage.name: method}), SIZE))
            assert dict(plan.left_out)[stage.name], f"{stage.name} on {method}"
