"""The page's time budget: what it offers, what it chooses, what it changes."""

from __future__ import annotations

import dataclasses
import json
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.test_budget import even_costs
from tests.viewer_rig import PATIENCE, SIZE, Running, page_scene
from warp_ar.accuracy.controller import AIM
from warp_ar.accuracy.cost_table import SETTINGS, chosen, load_presets, turn
from warp_ar.accuracy.costs import BASE, Costs
from warp_ar.engine.pipeline import TRACK, Pipeline
from warp_ar.scene import Scene, load_scene
from warp_ar.viewer import budget as budget_setting
from warp_ar.viewer.budget import BudgetSetting

pytestmark = pytest.mark.slow

# What the cost table may hold; the test's own, for that in the package may be made anew.
ERRORS = {
    setting.name: {method: 0.1 / (1 + place) for place, method in enumerate(setting.methods)} for setting in SETTINGS
}


@pytest.fixture
def known_errors(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(budget_setting, "load_errors", lambda: ERRORS)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def measured_steps(scene: Scene, image: Any, pose: Any, device: str, size: Any, settings: Any) -> Any:
    """What ``measure_steps`` gives on a device that has time for one method more than the base's, and for no other.

    Settings with long kernels stay as they are.
    """
    yield 0.25, None
    yield 0.5, Costs(20.0, {setting.name: {chosen(BASE, setting): 0.0} for setting in settings})
    return even_costs(settings, base=20.0, most=1.0, free=("environment_height", "irradiance"))


def test_what_the_budget_offers_is_what_it_chooses(known_errors: None, tmp_path: Path) -> None:
    scene = page_scene()
    told: list[dict[str, Any]] = []
    setting = BudgetSetting(told.append, tmp_path)
    with Pipeline(scene, device="cpu", quality="low") as pipeline, ThreadPoolExecutor(1) as helper:
        frame = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
        setting.look(pipeline, frame, None, helper)
        off = {"type": "budget", "measuring": None, "remaining": None, "known": False, "errors": told[-1]["errors"]}
        assert set(off["errors"]) >= {"paper", "low", "medium", "high"}
        assert told[-1] == off, "nothing is measured while it is off"
        setting.switch(50.0)
        assert setting.choose(10.0, 0.0) is None, "nothing is known yet"
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(budget_setting, "measure_steps", measured_steps)
            setting.look(pipeline, frame, None, helper)
            deadline = time.monotonic() + PATIENCE
            while not told[-1]["known"]:
                assert time.monotonic() < deadline
                time.sleep(0.01)
        assert [m["measuring"] for m in told[1:]] == [0.0, 0.25, 0.5, None]
        # What is known so far can be drawn, and is not chosen yet.
        assert "choices" not in told[2]
        assert [choice["ms"] for choice in told[3]["choices"]] == [0.0]
        assert not told[3]["known"]
        # After half of it the rest takes as long again.
        assert told[1]["remaining"] is None
        assert 0.0 <= told[3]["remaining"] < PATIENCE
        record = json.loads(json.dumps(told[-1]))
        times = [choice["ms"] for choice in record["choices"]]
        errors = [choice["error"] for choice in record["choices"]]
        assert times == sorted(times)
        assert errors == sorted(errors, reverse=True)
        assert "brute_force" in record["settings"]["irradiance"]
        for budget in (0.1, 18.0, 25.0, 500.0):
            setting.switch(budget)
            quality = setting.choose(None, 0.0)
            assert quality is not None
            assert quality.name == "auto"
            fitting = [c for c in record["choices"] if record["base"] + c["ms"] <= AIM * budget]
            best = fitting[-1] if fitting else record["choices"][0]
            offered = zip(record["settings"].items(), best["methods"], strict=True)
            assert quality == dataclasses.replace(
                turn(BASE, {name: methods[place] for (name, methods), place in offered}), name="auto"
            )
            assert setting.load == 1.0
        setting.switch(None)
        assert setting.choose(1.0, 0.0) is None
        assert setting.load is None
        # Another one finds the costs where they were kept.
        again = BudgetSetting(told.append, tmp_path)
        again.look(pipeline, frame, None, helper)
        assert told[-1]["known"]


def test_what_presets_cost_is_told_by_the_table_until_they_have_run(tmp_path: Path) -> None:
    setting = BudgetSetting(lambda message: None, tmp_path)
    table = load_presets("desk", "ms")
    with Pipeline(load_scene("desk"), device="cpu", quality="low") as pipeline, ThreadPoolExecutor(1) as helper:
        setting.look(pipeline, np.zeros((480, 640, 3), np.uint8), None, helper)
    assert setting.costs() == {name: {"ms": ms, "frames": 0} for name, ms in table.items()}, "nothing has run"
    for _ in range(5):
        setting.note("medium", 3.0 * table["medium"])
    told = setting.costs()
    assert {name: cost["frames"] for name, cost in told.items()} == {**dict.fromkeys(table, 0), "medium": 5}
    for name, ms in table.items():
        assert told[name]["ms"] == pytest.approx(3.0 * ms, abs=0.01)
    # The table leaves out tracking, which takes half of what medium took here.
    setting.note(TRACK, 1.5 * table["medium"])
    told = setting.costs()
    assert set(told) == set(table)
    assert told["medium"]["ms"] == pytest.approx(3.0 * table["medium"], abs=0.01)
    assert told["paper"]["ms"] == pytest.approx(1.5 * (table["paper"] + table["medium"]), abs=0.01)
    setting.note("high", 7.0)
    assert setting.costs()["high"] == {"ms": 7.0, "frames": 1}


def test_the_budget_changes_the_picture(known_errors: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(budget_setting, "measure_steps", measured_steps)
    with Running(page_scene()) as running:
        assert running.host.state_message()["load"] is None
        running.edit(type="budget", ms=5000.0)
        running.until(lambda: running.host.state_message()["load"])
        running.until(lambda: running.host.plan_message()["quality"] == "auto")
        assert running.host.wanted().quality.name == "auto"
        running.edit(type="budget", ms=1.0)
        cheapest = next(setting.methods[0] for setting in SETTINGS if setting.name == "irradiance")
        running.until(lambda: dict(running.host.wanted().quality.methods)["irradiance"] == cheapest)
        # Undoing edits leaves the budget; choosing a preset ends it.
        running.edit(type="reset")
        assert running.host.wanted().quality.name == "auto"
        running.edit(type="quality", name="low")
        running.until(lambda: running.host.plan_message()["quality"] == "low")
        assert running.host.state_message()["budget"] is None
        running.edit(type="quality", name="auto")
        assert running.host.state_message()["budget"] == 1.0
        running.edit(type="budget", ms=None)
        assert running.host.wanted().quality.name == "low"
