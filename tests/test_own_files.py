"""Files that a command writes into a folder of its user's."""

from __future__ import annotations

import pathlib

import pytest

from warp_ar.errors import SinkError, UsageError
from warp_ar.output.own_files import OwnFiles
from warp_ar.signature import COMMENT


def test_all_names_are_looked_at_before_the_folder_is_made(tmp_path: pathlib.Path, capsys) -> None:
    folder = tmp_path / "deep" / "out"
    files = OwnFiles(folder, ["a.md", "b.md"], overwrite=False)
    assert files.write("a.md", f"{COMMENT}\nä\n").read_text(encoding="utf-8") == f"{COMMENT}\nä\n"
    with pytest.raises(ValueError, match=r"c\.md is not among"):
        files.write("c.md", "")
    assert capsys.readouterr().err == ""
    OwnFiles(folder, ["a.md", "b.md"], overwrite=False)
    assert "a.md is replaced: this program wrote it before" in capsys.readouterr().err
    (folder / "b.md").write_text("mine")
    with pytest.raises(SinkError, match=r"b\.md is there, and this program did not write it"):
        OwnFiles(folder, ["a.md", "b.md"], overwrite=False)
    OwnFiles(folder, ["a.md", "b.md"], overwrite=True).write("b.md", b"yours")
    assert (folder / "b.md").read_bytes() == b"yours"
    assert sorted(path.name for path in folder.iterdir()) == ["a.md", "b.md"]


def test_what_is_read_is_not_written(tmp_path: pathlib.Path) -> None:
    (tmp_path / "lines").write_text("{}")
    (tmp_path / "a.md").hardlink_to(tmp_path / "lines")
    with pytest.raises(UsageError, match="is the same as --extra"):
        OwnFiles(tmp_path, ["a.md"], overwrite=True, reads={"--extra": [tmp_path / "lines"]})


def test_a_folder_that_cannot_be_made_is_named(tmp_path: pathlib.Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(SinkError, match="file"):
        OwnFiles(tmp_path / "file" / "out", ["a.md"], overwrite=False)
    (tmp_path / "a.md").mkdir()
    with pytest.raises(SinkError, match="is a folder"):
        OwnFiles(tmp_path, ["a.md"], overwrite=True)
