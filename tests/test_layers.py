"""Files of stages have their names, and files beside the package import each other in no circle."""

from __future__ import annotations

import ast
import graphlib
import pathlib

import pytest

import warp_ar
from warp_ar.stages import STAGES

ROOT = pathlib.Path(warp_ar.__file__).parents[1]
MODULES = {stage.__module__ for stage in STAGES}


def imported(text: str) -> set[str]:
    """Modules that a file's text names in imports, those inside functions included."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found


@pytest.mark.parametrize("folder", ["bench", "scenes", "tests"])
def test_no_two_files_beside_the_package_import_each_other(folder: str) -> None:
    """``lint-imports`` looks after the package alone."""
    files = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in (ROOT / folder).rglob("*.py")}
    graph = {name: imported(path.read_text(encoding="utf-8")) & files.keys() - {name} for name, path in files.items()}
    assert len(graph) > 5
    graphlib.TopologicalSorter(graph).prepare()


def test_a_stage_has_a_file_of_its_name() -> None:
    assert {stage.__module__ for stage in STAGES} == {f"warp_ar.stages.{stage.name}" for stage in STAGES}
    assert len(MODULES) == len(STAGES)


LACKING = {
    "kernels/*/{}.py": {"captured", "coverage"},
    "tests/twins/{}.py": {"captured", "environment_samples", "motion", "separate"},
    "tests/test_{}.py": set(),
}
"""By place, the stages that have no file there; docs/developing.md says why."""


@pytest.mark.parametrize("place", LACKING)
def test_what_belongs_to_a_stage_has_its_name(place: str) -> None:
    assert {stage.name for stage in STAGES if not any(ROOT.glob(place.format(stage.name)))} == LACKING[place]
