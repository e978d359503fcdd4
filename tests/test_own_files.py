"""Files that a command writes into a folder of its user's."""

from __future__ import annotations

import json
import os
import pathlib
import stat
import time

import numpy as np
import pytest

from warp_ar import calibrate
from warp_ar.calibration.camera_calibration import CameraReport, write_camera
from warp_ar.calibration.response import write_response
from warp_ar.command_line import Terminated
from warp_ar.errors import SinkError
from warp_ar.files import create_new, name_aside, write_whole
from warp_ar.output.environment_file import write_environment
from warp_ar.output.places import claim_places
from warp_ar.output.sinks import open_sink
from warp_ar.output.video_sink import VideoSink, WholeFragments
from warp_ar.scene import Camera
from warp_ar.signature import COMMENT, PROGRAM, is_signed
from warp_ar.tracking.card_layout import CARD_MARKER


def claimed(folder: pathlib.Path, *, overwrite: bool = False) -> None:
    claim_places({}, {name: folder / name for name in ("a.md", "b.md")}, overwrite=overwrite)


def test_all_names_are_looked_at_before_the_folder_is_made(tmp_path: pathlib.Path, capsys) -> None:
    folder = tmp_path / "deep" / "out"
    claimed(folder)
    (folder / "a.md").write_text(f"{COMMENT}\n")
    assert capsys.readouterr().err == ""
    claimed(folder)
    assert "a.md is replaced: this program wrote it before" in capsys.readouterr().err
    (folder / "b.md").write_text("mine")
    with pytest.raises(SinkError, match=r"b\.md is there, and this program did not write it"):
        claimed(folder)
    claimed(folder, overwrite=True)
    assert (folder / "b.md").read_text() == "mine"


def test_a_folder_that_cannot_be_made_is_named(tmp_path: pathlib.Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(SinkError, match="file"):
        claimed(tmp_path / "file" / "out")
    (tmp_path / "a.md").mkdir()
    with pytest.raises(SinkError, match="is a folder"):
        claimed(tmp_path, overwrite=True)


# --- Files set aside: random names, created new, no link followed ----------------------------------------------------


FRAME = np.zeros((32, 32, 3), np.uint8)
PATIENCE = 120.0
"""Seconds within which a file appears on a busy machine."""


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
        WholeFragments(tmp_path / "clip.mp4")
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


def wait_for(path: pathlib.Path) -> None:
    """Wait until a thread has made a file."""
    deadline = time.monotonic() + PATIENCE
    while not path.exists():
        assert time.monotonic() < deadline, f"{path} never appears"
        time.sleep(0.01)


def test_a_second_run_on_one_video_is_found_out_by_the_first(tmp_path: pathlib.Path) -> None:
    path = tmp_path / "clip.mp4"
    first = VideoSink(path, fps=2.0)
    for _ in range(8):
        first.write(FRAME)
    wait_for(path)
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
    wait_for(folder / "clip.mp4")
    (folder / "clip.mp4").unlink()
    folder.rmdir()
    with pytest.raises(SinkError, match="removed while it was written"):
        sink.close()


# --- Files that this program writes are known as its own; others are not, whatever they hold --------------------------


REPORT = CameraReport(Camera(64, 48, 60.0, 61.0, 31.5, 23.5), 0.1, (0.1,), 0.1, 1.0, (), CARD_MARKER, (5.0, 40.0))
CURVE = np.repeat(np.linspace(0.0, 1.0, 256)[:, None] ** 2, 3, axis=1)


def write(path: pathlib.Path) -> None:
    """Write a file of the kind that its name tells, as the program does."""
    if path.suffix in (".mp4", ".mov", ".mkv"):
        with open_sink(path, fps=24) as sink:
            for _ in range(20):
                sink.write(np.zeros((16, 16, 3), np.uint8))
    elif path.suffix == ".exr":
        write_environment(path, np.zeros((4, 8, 3), np.float32))
    elif path.suffix == ".png":
        assert calibrate.main(["card", "--output", str(path), "--dpi", "100"]) == 0
    elif path.suffix == ".txt":
        write_response(CURVE, path)
    elif path.name == "run.json":
        path.write_text(json.dumps({"program": PROGRAM, "frames": []}, indent=1))
    else:
        write_camera(REPORT, path)


@pytest.mark.parametrize(
    "name", ["a.mp4", "a.mov", "a.mkv", "a.exr", "a.png", "a.txt", "run.json", "a.yml", "a.json", "a.xml"]
)
def test_what_is_written_here_is_known(tmp_path: pathlib.Path, name: str) -> None:
    path = tmp_path / name
    write(path)
    assert is_signed(path)
    path.write_bytes(path.read_bytes().replace(PROGRAM.encode(), b"another"))
    assert not is_signed(path)


def test_others_are_not(tmp_path: pathlib.Path) -> None:
    for number, data in enumerate((b"", b"warp_ar", b"{}", b'{"frames": [], "program": "warp_ar"}', b"\x89PNG")):
        (tmp_path / str(number)).write_bytes(data)
        assert not is_signed(tmp_path / str(number))
    assert not is_signed(tmp_path)
    assert not is_signed(tmp_path / "nothing")
