"""The bench that makes cost tables: what is measured again goes in among what is not."""

from __future__ import annotations

from bench.make_cost_tables import merge_presets, renew_stage


def test_what_is_measured_again_replaces_its_own_alone() -> None:
    old = {"program": "p", "made": {"commit": "a"}, "errors": {"desk": {"paper": 0.3, "low": 0.2, "high": 0.1}}}
    new = {"program": "p", "made": {"commit": "b"}, "errors": {"screen": {"low": 0.4}, "desk": {"low": 0.15}}}
    once = merge_presets(old, new)
    assert once["errors"] == {"desk": {"paper": 0.3, "low": 0.15, "high": 0.1}, "screen": {"low": 0.4}}
    assert list(once["errors"]) == ["desk", "screen"]
    assert (once["made"], once["renewed"]) == ({"commit": "a"}, [{"commit": "b"}])
    twice = merge_presets(once, {"made": {"commit": "c"}, "errors": {"screen": {"high": 0.3, "paper": 0.5}}})
    assert list(twice["errors"]["screen"].items()) == [("paper", 0.5), ("low", 0.4), ("high", 0.3)]
    assert twice["renewed"] == [{"commit": "b"}, {"commit": "c"}]


def test_a_stage_that_is_measured_again_replaces_its_own_alone() -> None:
    old = {
        "made": {"commit": "a"},
        "errors": {"relight": {"flat": 0.3, "paper": 0.2}, "expose": {"plain": 0.1}},
        "stage_errors": {"relight": {"flat": 0.8}, "expose": {"plain": 0.7}},
        "dominated": {"relight": ["paper"], "expose": ["plain"]},
    }
    new = {
        "made": {"commit": "b"},
        "errors": {"relight": {"flat": 0.4}},
        "stage_errors": {"relight": {"flat": 0.9}},
        "dominated": {},
    }
    once = renew_stage(old, new)
    assert once["errors"] == {"relight": {"flat": 0.4}, "expose": {"plain": 0.1}}
    assert once["stage_errors"] == {"relight": {"flat": 0.9}, "expose": {"plain": 0.7}}
    assert once["dominated"] == {"expose": ["plain"]}
    assert (once["made"], once["renewed"]) == ({"commit": "a"}, [{"commit": "b"}])
