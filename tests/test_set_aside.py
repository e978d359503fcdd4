"""Files set aside: random names, created new, no link followed, and one place that does it."""

from __future__ import annotations

import ast
import os
import pathlib
import stat

import numpy as np
import pytest

from warp_ar.command_line import Terminated
from warp_ar.errors import SinkError
from warp_ar.files import create_new, name_aside, write_whole
from warp_ar.output.video_sink import VideoSink
from warp_ar.output.whole_fragments import WholeFragments

ROOT = pathlib.Path(__file__).parents[1] / "warp_ar"
RENAMERS = {"os.replace", "os.rename", "os.renames", "shutil.move", "os.link", "os.symlink"}
OPENERS = {"files.py", "farm/manifest.py", "farm/pools.py"}
"""Files that may create files by descriptor; the farm's are a lock and a log inside its own folder."""
PRIVATE = ("farm/plan.py",)
"""Files that rename inside a folder of the program's own, where nobody else writes."""
FRAME = np.zeros((32, 32, 3), np.uint8)


def test_a_link_under_the_earlier_name_of_files_set_aside_is_not_followed(tmp_path: pathlib.Path) -> None:
    victim, mine = tmp_path / "victim.txt", tmp_path / ".keep.json.part"
    victim.write_text("mine")
    mine.write_text("mine too")
    for name in ("rep.json", "clip.mp4"):
        (tmp_path / f".{name}.part").symlink_to(victim)
    write_whole(tmp_path / "rep.json", b"{}")
    write_whole(tmp_path / "keep.json", b"{}")
    with VideoSink(tmp_path / "clip.mp4", fps=30.0) as sink:
        sink.write(FRAME)
    assert victim.read_text() == "mine"
    assert mine.read_text() == "mine too"


def test_names_are_random_and_files_are_new(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert len({name_aside(tmp_path / "a.json") for _ in range(20)}) == 20
    monkeypatch.setattr("warp_ar.files.secrets.token_hex", lambda count: "0" * 2 * count)
    (tmp_path / f".b.json.{'0' * 16}.part").symlink_to(tmp_path / "victim")
    with pytest.raises(FileExistsError):
        create_new(name_aside(tmp_path / "b.json"))
    with pytest.raises(FileExistsError):
        write_whole(tmp_path / "b.json", b"{}")
    assert not (tmp_path / "victim").exists()


def test_a_signal_right_after_a_file_is_created_leaves_nothing(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    create = os.open

    def end(*given: object, **more: object) -> int:
        os.close(create(*given, **more))  # type: ignore[arg-type]
        raise Terminated

    monkeypatch.setattr("warp_ar.files.os.open", end)
    with pytest.raises(Terminated):
        write_whole(tmp_path / "run.json", b"{}")
    with pytest.raises(Terminated):
        WholeFragments(tmp_path / "clip.mp4", boxes=True)
    monkeypatch.undo()
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_left_beside_and_the_mode_stays(tmp_path: pathlib.Path) -> None:
    path = tmp_path / "scene.toml"
    path.write_text("old")
    path.chmod(0o600)
    (tmp_path / "linked.toml").hardlink_to(path)
    write_whole(path, b"new", keep_links=True)
    assert (tmp_path / "linked.toml").read_text() == "new"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    (tmp_path / "linked.toml").unlink()
    write_whole(path, b"newer")
    assert (path.read_text(), stat.S_IMODE(path.stat().st_mode)) == ("newer", 0o600)
    assert [entry.name for entry in tmp_path.iterdir()] == ["scene.toml"]


def test_a_second_run_on_one_video_is_found_out_by_the_first(tmp_path: pathlib.Path) -> None:
    path = tmp_path / "clip.mp4"
    first = VideoSink(path, fps=2.0)
    for _ in range(8):
        first.write(FRAME)
    while not path.exists():
        pass
    second = VideoSink(path, fps=2.0, overwrite=True)
    for _ in range(8):
        second.write(FRAME)
    errors = []
    for sink in (first, second):
        try:
            sink.close()
        except SinkError as error:
            errors.append(str(error))
    assert len(errors) == 1
    assert "another file took its name" in errors[0]
    import av

    with av.open(str(path)) as container:
        assert sum(1 for _ in container.decode(video=0)) == 8


def test_a_folder_that_is_removed_while_a_video_is_written_is_said(tmp_path: pathlib.Path) -> None:
    folder = tmp_path / "out"
    sink = VideoSink(folder / "clip.mp4", fps=2.0)
    for _ in range(8):
        sink.write(FRAME)
    while not (folder / "clip.mp4").exists():
        pass
    (folder / "clip.mp4").unlink()
    folder.rmdir()
    with pytest.raises(SinkError, match="removed while it was written"):
        sink.close()


def test_one_place_sets_files_aside_and_renames() -> None:
    found = []
    for path in sorted(ROOT.rglob("*.py")):
        place = path.relative_to(ROOT).as_posix()
        if place in ("files.py", *PRIVATE) or place.startswith("kernels/"):
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Attribute) and node.attr == "O_CREAT" and place not in OPENERS:
                found.append(f"{place}:{node.lineno}: O_CREAT")
            if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)):
                continue
            text = ast.unparse(node.func)
            one = len(node.args) == 1 and not node.keywords  # Path.replace takes one, str.replace two arguments
            if (
                text in RENAMERS
                or node.func.attr in ("rename", "mkstemp", "mktemp")
                or (node.func.attr == "replace" and one and not text.startswith("dataclasses."))
            ):
                found.append(f"{place}:{node.lineno}: {text}")
    assert found == []
