"""How far float32 kernels are from their float64 twins: the errors that the stages' ``Numerics`` bound.

python -m tests.hard_cases.measure_errors

runs the twin tests, which note every comparison's worst error, and prints the largest of each stage as JSON.
"""

from __future__ import annotations

import ast
import json
import pathlib
import sys

import pytest

from tests.error_model import worst

ROOT = pathlib.Path(__file__).resolve().parents[2]


def find_twins() -> dict[str, set[str]]:
    """Tests that compare a stage with its float64 twin, themselves or by a function of their file.

    Returns:
        Their ids, and the stages that ``check_error`` is told.
    """
    found: dict[str, set[str]] = {}
    for path in sorted((ROOT / "tests").glob("test_*.py")):
        functions = [node for node in ast.parse(path.read_text("utf-8")).body if isinstance(node, ast.FunctionDef)]
        checked = {function.name: _checked_stages(function) for function in functions}
        for function in functions:
            if function.name.startswith("test_"):
                helpers = (checked.get(name, set()) for name in _called_names(function))
                if stages := checked[function.name].union(*helpers):
                    found[f"{path.relative_to(ROOT).as_posix()}::{function.name}"] = stages
    return found


def _calls(function: ast.FunctionDef) -> list[tuple[str, ast.Call]]:
    calls = [node for node in ast.walk(function) if isinstance(node, ast.Call)]
    return [(call.func.id, call) for call in calls if isinstance(call.func, ast.Name)]


def _called_names(function: ast.FunctionDef) -> set[str]:
    return {name for name, _ in _calls(function)}


def _checked_stages(function: ast.FunctionDef) -> set[str]:
    stages = [call.args[0] for name, call in _calls(function) if name == "check_error"]
    return {str(stage.value) for stage in stages if isinstance(stage, ast.Constant)}


def main() -> int:
    code = pytest.main([*find_twins(), "-q", "-p", "no:cacheprovider"])
    print(json.dumps({stage: float(f"{error:.2g}") for stage, error in worst.items()}, indent=1))
    return int(code)


if __name__ == "__main__":
    sys.exit(main())
