"""The package's public face."""

from __future__ import annotations

import ast
import pathlib
import pydoc
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator

import pytest

import warp_ar
from warp_ar import errors

PUBLIC = {
    *(
        "LAYERS",
        "PRESETS",
        "Capture",
        "Light",
        "capture_light",
        "Frame",
        "Pipeline",
        "PipelineSwitcher",
        "Plan",
        "Pose",
        "Quality",
        "Result",
        "Scene",
        "SceneError",
        "Session",
        "SinkError",
    ),
    *(
        "SourceError",
        "TrackState",
        "Tracker",
        "UsageError",
        "WarpArError",
        "bundled_scenes",
        "dumps_scene",
        "load_scene",
    ),
    *("make_plan", "open_sink", "open_source", "read_environment", "write_environment"),
}


def test_all_is_pinned_and_resolves() -> None:
    assert set(warp_ar.__all__) == PUBLIC
    for name in warp_ar.__all__:
        assert name in ("LAYERS", "PRESETS") or getattr(warp_ar, name).__doc__


def test_help_names_the_fields_of_dataclasses() -> None:
    for kind, field in ((warp_ar.Frame, "exposure_time"), (warp_ar.Result, "pose"), (warp_ar.Quality, "edge_samples")):
        shown = pydoc.render_doc(kind, renderer=pydoc.plaintext)
        assert re.search(rf"^ \|      {field}: \w", shown, re.MULTILINE), kind
        assert "Attributes:" not in (pydoc.getdoc(kind.__init__) or "")


def test_import_does_not_initialise_warp() -> None:
    code = (
        "import warp_ar, sys; assert 'warp' not in sys.modules, 'importing the package loads Warp';"
        "import warp_ar.engine.pipeline, warp_ar.live, warp_ar.explain, warp as wp;"
        "assert wp._src.context.runtime is None, 'importing the modules initialises Warp'"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


# --- What a public function raises stands in its docstring, under ``Raises:`` -----------------------------------------


ROOT = pathlib.Path(warp_ar.__file__).parents[1]
OURS = {name for name in vars(errors) if name.endswith("Error")} | {"JobsError", "RunError", "ProtocolError"}
"""Errors of which ``WarpArError`` may stand for one."""

Function = ast.FunctionDef | ast.AsyncFunctionDef


def raised(nodes: Iterable[ast.AST]) -> set[str]:
    """Names of what statements raise: not in a function or class of their own, nor what they catch or let through."""
    found = set()
    for node in nodes:
        if isinstance(node, Function | ast.ClassDef | ast.expr):
            continue
        if isinstance(node, ast.Raise) and node.exc is not None:
            kind = node.exc.func if isinstance(node.exc, ast.Call) else node.exc
            found.add(ast.unparse(kind).split(".")[-1])
        if isinstance(node, ast.Try):
            caught = {handler.type.id for handler in node.handlers if isinstance(handler.type, ast.Name)}
            found |= raised(node.body) - caught | raised([*node.handlers, *node.orelse, *node.finalbody])
        else:
            found |= raised(ast.iter_child_nodes(node))
    return found


def promised(docstring: str | None) -> set[str]:
    """Names of the errors that a docstring's section lists."""
    section = (docstring or "").partition("Raises:\n")[2].partition("\n\n")[0]
    return {name.split(".")[-1] for name in re.findall(r"^ {4}([\w.]+):", section, re.MULTILINE)}


def public(tree: ast.AST, inside: str = "", above: str | None = None) -> Iterator[tuple[str, Function, str | None]]:
    """Public functions, their names, and the docstrings that are theirs: of a constructor its class's."""
    for node in getattr(tree, "body", ()):
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from public(node, f"{inside}{node.name}.", ast.get_docstring(node))
        elif isinstance(node, Function) and (node.name == "__init__" or not node.name.startswith("_")):
            own = ast.get_docstring(node) or ""
            yield f"{inside}{node.name}", node, own if node.name != "__init__" else f"{above}\n\n{own}"


def silent(tree: ast.AST) -> dict[str, set[str]]:
    """Errors of public functions that their docstrings leave out."""
    found = {}
    for name, function, docstring in public(tree):
        told = promised(docstring)
        missing = {kind for kind in raised(function.body) - told if not (kind in OURS and "WarpArError" in told)}
        if told:  # of an error that has come in a variable, the section knows the class
            missing = {kind for kind in missing if not kind.lstrip("_")[0].islower()}
        if missing:
            found[name] = missing
    return found


@pytest.mark.parametrize("folder", ["warp_ar", "kernels"])
def test_docstrings_list_what_is_raised(folder: str) -> None:
    files = sorted((ROOT / folder).rglob("*.py"))
    assert len(files) > 50
    texts = {str(path.relative_to(ROOT)): path.read_text(encoding="utf-8") for path in files}
    trees = {name: ast.parse(text) for name, text in texts.items() if "raise " in text}
    assert {name: found for name, tree in trees.items() if (found := silent(tree))} == {}
