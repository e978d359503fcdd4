"""The bench that makes cost tables: what is measured again goes in among what is not."""

from __future__ import annotations

from bench.make_cost_tables import merge_presets


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
