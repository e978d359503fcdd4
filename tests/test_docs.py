"""Commands in the documentation are commands: their options exist."""

from __future__ import annotations

import importlib
import pathlib
import pydoc
import re
import shlex

import pytest

from docs import tables
from warp_ar.command_line import Parser
from warp_ar.errors import UsageError

ROOT = pathlib.Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
PACKAGES = {"farm": "farm.cli"}
"""Commands whose options are told by another module."""
NUMBERS = {"N": "1", "X": "1", "E": "0.1", "WxH": "4x3"}
"""What stands for a number."""


def commands(page: pathlib.Path, start: str = "python -m warp_ar.") -> list[str]:
    """What begins so, less that beginning, in blocks of shell and in code of the text."""
    text = page.read_text(encoding="utf-8")
    lines = [line for block in re.findall(r"```sh\n(.*?)```", text, re.DOTALL) for line in block.splitlines()]
    spans = re.findall(r"`([^`\n]+(?:\n[^`\n]+)?)`", re.sub(r"```.*?```", "", text, flags=re.DOTALL))
    found = (re.search(re.escape(start) + "(.*)", " ".join(line.split())) for line in (*lines, *spans))
    return [match[1] for match in found if match is not None]


def refusal(parser: Parser, words: list[str]) -> str | None:
    """What a command's parser says against words, None where it takes them."""
    try:
        parser.parse_args(words)
    except UsageError as error:
        return str(error)
    return None


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_options_of_commands_exist(page: pathlib.Path) -> None:
    for command in commands(page):
        name, *words = shlex.split(command.split(" && ")[0], comments=True)
        words = [NUMBERS.get(word, word) for word in words]
        parser = importlib.import_module(f"warp_ar.{PACKAGES.get(name, name)}").make_parser()
        options = [word.split("=")[0] for word in words if word.startswith("--")]
        refused = refusal(parser, words)
        if refused is not None:
            # A command may be told by its name and an option alone; that option must be one.
            assert "required" in refused, f"{page.name}: {command}: {refused}"
            known = {one for action in parser._actions for one in action.option_strings}
            assert set(options) <= known, f"{page.name}: {command}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_benches_and_tools_exist(page: pathlib.Path) -> None:
    for command in commands(page, "python -m bench "):
        for name in shlex.split(command, comments=True):
            if name.startswith("-"):
                break
            assert (ROOT / "bench" / f"bench_{name}.py").exists() or name == "NAME", f"{page.name}: {command}"
    for folder in ("bench", "tests"):
        for command in commands(page, f"python -m {folder}."):
            place = ROOT.joinpath(folder, *command.split()[0].split("."))
            assert place.with_suffix(".py").exists() or place.is_dir(), f"{page.name}: {command}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_names_of_the_library_exist(page: pathlib.Path) -> None:
    """All but one that the changelog says is gone, and a placeholder."""
    names = set(re.findall(r"warp_ar(?:\.\w+)+", page.read_text(encoding="utf-8")))
    for name in names - {"warp_ar.input", "warp_ar.kernels.ROOM.NAME"}:
        assert pydoc.locate(name) is not None, f"{page.name}: {name}"


def test_made_parts_are_those_of_the_code() -> None:
    """``python -m docs.tables --write`` brings them up to date."""
    assert tables.main([]) == 0
