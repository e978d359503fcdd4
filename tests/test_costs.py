"""Costs: measured with everything at work, kept in a folder."""

from __future__ import annotations

import pytest

from tests.test_pipeline import Frames, frames, make_scene  # noqa: F401  (a fixture)
from warp_ar.accuracy.cost_table import SETTINGS, chosen, relevant_settings
from warp_ar.accuracy.costs import BASE, Costs, measure_costs, read_costs, show_again, write_costs
from warp_ar.engine.pipeline import Pipeline
from warp_ar.stages.quality import PRESETS

pytestmark = pytest.mark.slow

SETTING = next(setting for setting in SETTINGS if setting.name == "irradiance")
KEPT = Costs(12.5, {"irradiance": {"sh2": 0.0, "clusters": 1.25}}, 2.5)


def test_costs_are_kept(tmp_path):
    write_costs(tmp_path / "new", "a", KEPT)
    write_costs(tmp_path / "new", "b", Costs(1.0, {"irradiance": {"sh2": 0.0}}))
    assert read_costs(tmp_path / "new", "a", [SETTING]) == KEPT
    assert read_costs(tmp_path / "new", "c", [SETTING]) is None


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        '{"a": 3}',
        '{"a": {"base": 1}}',
        '{"a": {"base": "x", "methods": {"irradiance": {"sh2": 0}}}}',
        '{"a": {"base": 1, "methods": {"irradiance": {"sh9": 0}}}}',
        '{"a": {"base": 1, "methods": {"irradiance": {}}}}',
        '{"a": {"base": 1, "methods": {"prefilter": {"energy_mip": 0}}}}',
        '{"a": {"base": 1, "methods": {"irradiance": {"sh2": 0}}}}',
    ],
)
def test_costs_that_are_not_ours_are_measured_anew(tmp_path, text):
    (tmp_path / "costs.json").write_text(text)
    assert read_costs(tmp_path, "a", [SETTING]) is None
    write_costs(tmp_path, "a", KEPT)
    assert read_costs(tmp_path, "a", [SETTING]) == KEPT


def test_a_cache_that_cannot_be_written_is_no_failure(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    write_costs(tmp_path / "file", "a", KEPT)
    assert "cannot store measured costs" in capsys.readouterr().err


def test_measured_costs_cover_every_method_but_brute_force(frames: Frames, device: str) -> None:
    scene = make_scene()
    with Pipeline(scene, device=device, quality="low") as pipeline:
        pose = pipeline(frames[0]).pose
    names = ("irradiance", "expose", "unwrap", "environment_height")
    settings = [setting for setting in relevant_settings(scene, (320, 240)) if setting.name in names]
    costs = measure_costs(scene, frames[0], pose, device, (320, 240), settings)
    assert costs.base > costs.track > 0.0
    for setting in settings:
        assert set(costs.methods[setting.name]) == set(setting.methods) - {"brute_force"}
        assert costs.methods[setting.name][chosen(PRESETS["medium"], setting)] == 0.0


def test_a_frame_that_is_shown_again_keeps_every_stage_at_work(frames: Frames, device: str) -> None:
    """What rests costs nothing: a resting picture would hide what a moving one takes."""
    scene = make_scene()
    with Pipeline(scene, device=device, quality=BASE) as pipeline:
        pose = pipeline(frames[0]).pose
    with Pipeline(scene, device=device, quality=BASE) as pipeline:
        for index in range(4):
            stages = show_again(pipeline, frames[0], pose, index).stages
            assert "visibility" in stages
            assert not [name for name, timing in stages.items() if timing.skipped], f"in frame {index}"
