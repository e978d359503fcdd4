"""Inputs of somebody who means harm, or has bad luck: each is one clear line, quickly, and nothing is lost."""

from __future__ import annotations

import os
import pathlib
import signal
import subprocess
import sys

import hypothesis
import hypothesis.strategies as st
import pytest

from tests.hostile import table
from tests.hostile.cases import SOUND
from tests.hostile.table import HELD
from warp_ar import files
from warp_ar.errors import SceneError, SourceError, UsageError, printable
from warp_ar.files import limits, read_bytes, write_whole
from warp_ar.pictures import picture_size

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="pipes, devices and limits as on Linux"),
]

LEAST_INPUTS = 600
KILLS = 2
"""For each sink and signal; ``python -m tests.hostile.kill 50`` kills more often."""


def test_every_input_is_read_or_refused_in_one_line() -> None:
    outcomes = table.attack()
    broke = [outcome for outcome in outcomes if outcome[2] not in HELD]
    assert not broke, broke[:5]
    assert len(outcomes) == table.tried() >= LEAST_INPUTS
    # The readers do read: what is refused is not refused for nothing.
    sound = {row: outcome for row, what, outcome, _ in outcomes if what == SOUND}
    assert set(sound.values()) == {"read"}, sound
    assert sum(outcome == "read" for _, _, outcome, _ in outcomes) > len(outcomes) / 10
    # Who is refused is told why: no message is a mere name of an exception.
    assert all(len(message) > 20 for _, _, outcome, message in outcomes if outcome == "refused")


def test_the_table_in_the_docs_is_of_these_inputs() -> None:
    assert table.tried_in_docs() == table.tried(), "run python -m tests.hostile.table"


def test_whoever_is_killed_leaves_whole_files() -> None:
    command = [sys.executable, "-m", "tests.hostile.kill", str(KILLS)]
    done = subprocess.run(command, cwd=table.ROOT, check=False, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    rows = [line for line in done.stdout.splitlines() if signal.Signals.SIGKILL.name in line or "SIGTERM" in line]
    assert len(rows) == 14
    assert all(f"| {KILLS} | {KILLS} |" in row for row in rows), done.stdout


@hypothesis.settings(max_examples=200)
@hypothesis.given(st.text(st.characters(codec=None), max_size=200))
def test_what_is_printed_is_one_line_that_a_terminal_shows(text: str) -> None:
    shown = printable(text)
    assert len(shown.splitlines()) <= 1
    shown.encode()
    assert all(ord(character) >= 32 and not 127 <= ord(character) < 160 for character in shown)
    assert not set(shown) & set("\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069")


def test_what_is_plain_is_printed_as_it_is() -> None:
    text = "/home/zoë/Schreibtisch/机 1.toml: camera.width = 0: expected 1 or more"
    assert printable(text) == text
    assert printable("a\x1b[2Jb\nc\x9b\ud800") == "a\\x1b[2Jb\\nc\\x9b\\ud800"


def test_limits_are_set_by_the_environment(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.toml"
    path.write_bytes(bytes(1000))
    assert len(read_bytes(path, "text_bytes", SceneError)) == 1000
    monkeypatch.setenv("WARP_AR_MAX_TEXT_BYTES", "999")
    expected = "1,000 bytes; at most 999 are read .set WARP_AR_MAX_TEXT_BYTES for more"
    with pytest.raises(SceneError, match=expected):
        read_bytes(path, "text_bytes", SceneError)
    for wrong in ("0", "-1", "many", "9" * 19, "1e9", ""):
        monkeypatch.setenv("WARP_AR_MAX_TEXT_BYTES", wrong)
        with pytest.raises(UsageError, match="WARP_AR_MAX_TEXT_BYTES"):
            limits()


def test_every_limit_is_in_the_docs() -> None:
    text = table.FILE.read_text()
    for name, value in vars(files.Limits()).items():
        assert f"- `{files.variable_of(name)}` ({value:,}): " in text


def test_sizes_are_those_of_the_decoders(tmp_path: pathlib.Path) -> None:
    import cv2
    import numpy as np

    for kind in ("png", "jpg", "bmp", "tiff", "webp", "gif", "ppm", "pgm"):
        image = np.zeros((37, 53, 3), np.uint8)
        ok, data = cv2.imencode(f".{kind}", image[..., 0] if kind == "pgm" else image)
        assert ok
        assert picture_size(data.tobytes()) == (53, 37), kind
    ok, data = cv2.imencode(".webp", np.zeros((37, 53, 4), np.uint8), [cv2.IMWRITE_WEBP_QUALITY, 101])
    assert ok
    assert picture_size(data.tobytes()) == (53, 37)


def test_a_file_written_whole_replaces_or_leaves(tmp_path: pathlib.Path) -> None:
    path = tmp_path / "a"
    write_whole(path, b"one")
    (tmp_path / "link").symlink_to(path)
    write_whole(tmp_path / "link", b"two")  # the link stays one
    assert path.read_bytes() == b"two"
    assert (tmp_path / "link").is_symlink()

    def fail(part: pathlib.Path) -> None:
        part.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space"):
        write_whole(path, fail)
    assert path.read_bytes() == b"two"
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["a", "link"]


def test_a_source_that_becomes_a_pipe_does_not_wait(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:

    path = tmp_path / "a.png"
    os.mkfifo(path)
    monkeypatch.setattr(files, "kind_of", lambda _: "file")  # as if it had been one when it was looked at
    assert read_bytes(path, "picture_bytes", SourceError) == b""
