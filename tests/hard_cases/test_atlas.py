"""No cell of the atlas is empty."""

from __future__ import annotations

import collections
import json
import pathlib
import subprocess
import sys

from tests.hard_cases import atlas, measure_errors, mutations, table
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


def test_the_error_model_names_every_stage_and_its_rows(capsys) -> None:
    for stage in STAGES:
        name, numbers = stage.name, stage.numerics
        assert numbers.rows == tuple(row for row, stages in atlas.CONCERNS.items() if name in stages), name
        assert 0 <= numbers.measured <= numbers.bound, name
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


def test_tests_that_stand_elsewhere_exist() -> None:
    for name in atlas.ELSEWHERE:
        file, function = name.split("::")
        assert f"def {function}(" in (ROOT / "tests" / file).read_text(), (
            f"{name} is named in the atlas and does not exist"
        )


def test_every_row_has_breaks_that_still_apply() -> None:
    """What ``python -m tests.hard_cases.mutations`` would replace stands there once, and the test it names exists."""
    count = collections.Counter(mutation.row for mutation in mutations.MUTATIONS)
    assert set(count) == set(atlas.ROWS)
    assert min(count.values()) > 1, "a row whose tests were tried by one break only"
    for mutation in mutations.MUTATIONS:
        found = (ROOT / mutation.file).read_text().count(mutation.old)
        assert found == 1, f"{mutation.what!r}: its text occurs {found} times in {mutation.file}; expected once"
        file, function = mutation.test.split("[")[0].split("::")
        assert f"def {function}(" in (ROOT / file).read_text(), f"{mutation.test} does not exist"


REPORT = """<testsuites><testsuite><testcase classname="a" name="test_one[{device}-bilinear]"><properties>
<property name="atlas" value="1/unwrap/bilinear"/></properties>{inner}</testcase></testsuite></testsuites>"""


def test_the_table_adds_reports_up(tmp_path: pathlib.Path) -> None:
    """One report a file, both devices in one; a test that was run again counts once."""
    paths = []
    for number, (device, inner) in enumerate((("cpu", ""), ("cuda:0", "<failure/>"), ("cuda:0", ""), ("cpu", ""))):
        paths.append(tmp_path / f"r_{number}.xml")
        paths[-1].write_text(REPORT.format(device=device, inner=inner).replace('"a"', f'"a{number % 2}"'))
    found = table.read_reports(paths)
    # The failure in the second report counts until the same test passes in a later one: here it never does.
    assert found["CUDA"][1, "unwrap", "bilinear"] == [False, True]
    assert found["CPU"][1, "unwrap", "bilinear"] == [True, True]
    made = table.make_table(found, "")
    assert "| 1 | unwrap | sphere_map bilinear area | 1/3 (2 tests) | FAILED: bilinear |" in made
    assert "| 15 | track | default |  | on the host |" in made
    assert table.make_table({"CPU": {}, "CUDA": {}}, made).splitlines()[2] == made.splitlines()[2], "kept"
