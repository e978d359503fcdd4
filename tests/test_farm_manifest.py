"""The manifest: whole lines, outputs that appear at once, one driver at a time."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

try:
    import resource
except ImportError:  # Windows
    resource = None

from warp_ar.errors import UsageError
from warp_ar.farm.manifest import (
    Manifest,
    RunError,
    aside,
    begin_run,
    load_run,
    locked,
    publish,
    record_at,
)


def test_lines_say_what_is_done_failed_and_tried(tmp_path):
    first = Manifest(tmp_path)
    first.add("done", "a/survey", length=12)
    first.add("try", "a/segment-000000", reason="why")
    first.add("try", "a/segment-000000", reason="why")
    first.add("failed", "a/segment-000000", reason="why")
    first.add("done", "a/segment-000001", frames=3, bytes=7)
    first.add("again", "a/segment-000001", reason="gone")
    second = Manifest(tmp_path)
    assert second.done == {"a/survey": {"length": 12}}
    assert second.failed == {"a/segment-000000": "why"}
    assert second.tries == {"a/segment-000000": 2}


def test_a_line_that_was_cut_off_is_cut_away(tmp_path):
    first = Manifest(tmp_path)
    first.add("done", "a/survey", length=12)
    with open(first.path, "ab") as stream:
        stream.write(b'{"state": "done", "job": "a/segm')
    assert list(Manifest(tmp_path).done) == ["a/survey"]
    second = Manifest(tmp_path)
    second.add("done", "b/survey", length=1)
    lines = first.path.read_text().splitlines()
    assert [json.loads(line)["job"] for line in lines] == ["a/survey", "b/survey"]


def test_a_damaged_line_is_told_by_its_number(tmp_path):
    (tmp_path / "manifest.jsonl").write_text('{"state": "done", "job": "a/survey"}\nnonsense\n')
    with pytest.raises(RunError, match=r"manifest\.jsonl: line 2 is damaged"):
        Manifest(tmp_path)


@pytest.mark.parametrize(
    "line",
    [
        "[" * 200_000,
        "[1]",
        '{"state": "done", "job": ["a/b"]}',
        '{"job": "a/survey"}',
        '{"state": "done", "job": "survey"}',
        '{"state": "done", "job": "a/survey", "frames": "many"}',
        '{"state": "done", "job": "a/survey", "bytes": Infinity}',
        '{"state": "failed", "job": "a/survey"}',
    ],
)
def test_a_line_of_no_job_is_damaged(tmp_path, line):
    (tmp_path / "manifest.jsonl").write_text(line + "\n")
    with pytest.raises(RunError, match=r"manifest\.jsonl: line 1 is damaged \(.+\); remove the line and resume"):
        Manifest(tmp_path)


@pytest.mark.parametrize("text", ["[" * 200_000, "[1]", '{"version": "1", "jobs": [1]}', '{"version": "1"}', "\xff"])
def test_a_run_that_is_none_is_one_line(tmp_path, text):
    (tmp_path / "run.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(RunError, match=r"run\.json.* (is damaged|cannot be read|levels of nesting)"):
        load_run(tmp_path)


@pytest.mark.skipif(resource is None, reason="needs a limit of a file's size")
def test_a_line_that_does_not_fit_the_disk_is_taken_back(tmp_path):
    manifest = Manifest(tmp_path)
    manifest.add("done", "a/survey", length=12)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (manifest.path.stat().st_size + 5, hard))
    try:
        with pytest.raises(RunError, match=r"manifest\.jsonl cannot be written: No space left"):
            manifest.add("done", "b/survey", length=12)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert list(Manifest(tmp_path).done) == ["a/survey"]
    manifest.add("done", "c/survey", length=12)
    assert list(Manifest(tmp_path).done) == ["a/survey", "c/survey"]


def test_outputs_appear_whole_with_their_record(tmp_path):
    with aside(tmp_path, "one") as part:
        (part / "deep").mkdir()
        (part / "deep/x").write_bytes(b"12345")
        told = publish(part, tmp_path / "out/one", "clip/one", {"frames": 3})
    assert told["bytes"] == 5
    assert told["frames"] == 3
    assert record_at(tmp_path / "out/one", "clip/one") == told
    assert record_at(tmp_path / "out/one", "clip/two") is None
    assert (tmp_path / "out/one/deep/x").read_bytes() == b"12345"
    assert not list((tmp_path / ".aside").iterdir())


def test_one_driver_at_a_time(tmp_path):
    code = (
        "import pathlib, sys\nfrom warp_ar.farm.manifest import locked\n"
        "with locked(pathlib.Path(sys.argv[1])):\n print('mine', flush=True)\n sys.stdin.read()\n"
    )
    other = subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=os.getcwd()
    )
    try:
        assert other.stdout is not None
        assert other.stdout.readline() == b"mine\n"
        with pytest.raises(RunError, match="is being worked on by another driver"), locked(tmp_path):
            pass
    finally:
        other.kill()
        other.communicate()
    with locked(tmp_path):  # its death has freed it
        pass


def test_a_run_begins_in_a_folder_of_its_own(tmp_path):
    begin_run(tmp_path / "run", {"schema": 1, "clip": []}, "version")
    assert load_run(tmp_path / "run") == ({"schema": 1, "clip": []}, "version")
    with pytest.raises(UsageError, match="holds a run already; go on with: farm resume"):
        begin_run(tmp_path / "run", {}, "version")
    (tmp_path / "other").mkdir()
    (tmp_path / "other/mine.txt").write_text("")
    with pytest.raises(UsageError, match=r"is not empty \(it holds mine\.txt\)"):
        begin_run(tmp_path / "other", {}, "version")
    with pytest.raises(UsageError, match="holds no run"):
        load_run(tmp_path / "other")
