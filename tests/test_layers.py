"""Who may import whom: the layers of the package, and stages, which know nothing of each other."""

from __future__ import annotations

import ast
import graphlib
import pathlib
import tomllib

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


def stages_imported(path: pathlib.Path) -> set[str]:
    own = ".".join(path.relative_to(ROOT).with_suffix("").parts)
    return (imported(path.read_text(encoding="utf-8")) & MODULES) - {own}


def test_no_stage_imports_another() -> None:
    """Nor does anything that stages share: one stage would come in by that way."""
    files = [path for path in (ROOT / "warp_ar" / "stages").rglob("*.py") if path.name != "__init__.py"]
    assert {".".join(path.relative_to(ROOT).with_suffix("").parts) for path in files} >= MODULES
    assert {path.name: found for path in files if (found := stages_imported(path))} == {}


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
    told = (ROOT / "docs" / "developing.md").read_text(encoding="utf-8").partition("Five stages lack a file.")[2]
    assert all(f"`{name}`" in told[:400] for name in LACKING[place])


def test_the_contracts_name_every_room_and_let_no_stage_through() -> None:
    """``lint-imports`` holds the contracts of ``pyproject.toml``; they are only worth what they name."""
    linter = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]
    layers, independence, no_circle, farm = linter["contracts"]
    named = {name.strip() for layer in layers["layers"] for name in layer.split("|")}
    folders = {f"warp_ar.{path.parent.name}" for path in (ROOT / "warp_ar").glob("*/__init__.py")}
    files = {f"warp_ar.{path.stem}" for path in (ROOT / "warp_ar").glob("*.py")} - {"warp_ar.__init__"}
    assert (folders | files) - named <= {"warp_ar.scenes"}, "data, which imports nothing of the package"
    excused = {line.split(" -> ")[1] for line in independence["ignore_imports"]}
    assert not excused & MODULES
    assert independence["modules"] == ["warp_ar.stages.*"]
    assert no_circle == {**no_circle, "type": "acyclic_siblings", "ancestors": ["warp_ar"]}
    assert farm["source_modules"] == ["warp_ar.farm"]
    assert "exclude_type_checking_imports" not in linter, "a reader follows those imports too"
