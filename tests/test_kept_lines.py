"""Lines of a long run that are kept, so that it goes on where it was ended."""

from __future__ import annotations

import json

from bench.common import KeptLines


def test_a_run_that_was_ended_goes_on(tmp_path, capsys):
    path = tmp_path / "lines.jsonl"
    first = KeptLines(path)
    first.add({"scene": "desk", "mode": "whole", "samples": 16, "z_rms": 1.0})
    with path.open("a") as file:
        file.write('{"scene": "desk", "mode": "kno')  # ended while it wrote
    later = KeptLines(path)
    assert later.has(scene="desk", mode="whole", samples=16)
    assert not later.has(scene="desk", mode="whole", samples=64)
    assert not later.has(scene="desk", mode="known")
    later.add({"scene": "desk", "mode": "known", "samples": 16})
    assert [json.loads(line)["mode"] for line in path.read_text().splitlines()] == ["whole", "known"]
    assert len(capsys.readouterr().out.splitlines()) == 2


def test_without_a_file_lines_are_printed_alone(capsys):
    lines = KeptLines(None)
    lines.add({"scene": "desk"})
    assert lines.has(scene="desk")
    assert json.loads(capsys.readouterr().out) == {"scene": "desk"}
