"""The command."""

from __future__ import annotations

import json

import pytest

from tests.accuracy_rig import setting
from warp_ar import tradeoff
from warp_ar.accuracy import case_report
from warp_ar.command_line import EXIT_DONE, EXIT_FAILED, EXIT_USAGE
from warp_ar.signature import is_signed

pytest.importorskip("flip_evaluator")
pytest.importorskip("matplotlib")


def test_command_writes_all_three(tmp_path, monkeypatch, capsys, device):
    monkeypatch.setattr(case_report, "RUNS", ("low",))
    arguments = ["darken", "--stage", "expose", "--frames", "2", "--shrink", "4", "--device", device]
    assert tradeoff.main([*arguments, "--out", str(tmp_path / "out")]) == EXIT_DONE
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "tradeoff.html",
        "tradeoff.jsonl",
        "cost_table.json",
    }
    lines = (tmp_path / "out" / "tradeoff.jsonl").read_text().splitlines()
    methods = list(setting("expose").methods)
    assert [json.loads(line)["method"] for line in lines[: len(methods)]] == methods
    shown = capsys.readouterr().out
    assert "expose" in shown
    told = [line for line in shown.splitlines() if "% " in line and " left" in line]
    assert told[-2].split()[-1] == "darken", "shown while the page is written too"
    assert told[-1].endswith("page: darken: expose")
    assert told[-1].split()[0] == "100%", "units that were announced are all reported"
    assert all(is_signed(path) for path in (tmp_path / "out").iterdir())


def no_measurement(*_):
    raise AssertionError("measured before its files were looked at")


def test_nothing_of_somebody_elses_is_overwritten(tmp_path, monkeypatch, capsys, device):
    monkeypatch.setattr(case_report, "RUNS", ("paper", "low"))
    arguments = ["darken", "--presets", "--frames", "1", "--shrink", "8", "--device", device, "--out", str(tmp_path)]
    (tmp_path / "presets.json").write_text("mine")
    with monkeypatch.context() as before:
        before.setattr(tradeoff, "measure", no_measurement)
        assert tradeoff.main(arguments) == EXIT_FAILED
    assert "presets.json is there, and this program did not write it" in capsys.readouterr().err
    assert (tmp_path / "presets.json").read_text() == "mine"
    assert tradeoff.main([*arguments, "--overwrite"]) == EXIT_DONE
    assert "as --overwrite says" in capsys.readouterr().err
    assert tradeoff.main(arguments) == EXIT_DONE  # its own is replaced, with a word
    assert "presets.json is replaced: this program wrote it before" in capsys.readouterr().err


def test_presets_alone(tmp_path, device):
    arguments = ["darken", "--presets", "--only", "paper,low", "--frames", "2", "--shrink", "4", "--device", device]
    assert tradeoff.main([*arguments, "--out", str(tmp_path)]) == EXIT_DONE
    assert {path.name for path in tmp_path.iterdir()} == {"presets.json", "tradeoff.jsonl"}
    listed = json.loads((tmp_path / "presets.json").read_text())
    assert listed["made"]["against"] == "truth"
    assert set(listed["errors"]) == {"darken"}
    assert set(listed["errors"]["darken"]) == {"paper", "low"}
    assert all(0.0 < error < 1.0 for error in listed["errors"]["darken"].values())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["desk", "--presets", "--stage", "irradiance"], "--presets --stage irradiance: expected one of both"),
        (["desk", "--only", "low"], "--only low: expected --presets beside it"),
        (["desk", "--presets", "--only", "low,best"], "--only best: expected presets of paper, low, medium"),
        (["desk", "--frames", "0"], "--frames 0: expected 1 or more"),
        (["desk", "--shrink", "0"], "--shrink 0: expected 1 or more"),
        (["desk", "--stage", "colour", "--frames", "1"], "--stage colour: expected one of environment_height"),
        (["--truth", "TMP"], "expected folders with scene_"),
        (["darken", "--stage", "irradiance", "--frames", "1"], "nothing to turn"),
    ],
)
def test_bad_usage_is_one_line(arguments, message, tmp_path, capsys):
    arguments = [str(tmp_path) if argument == "TMP" else argument for argument in arguments]
    assert tradeoff.main(arguments) == EXIT_USAGE
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
