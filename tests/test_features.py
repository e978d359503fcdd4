"""What a request calls for, and what ``explain`` says of it: reasons are true of the scene at hand."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from tests.hard_cases.rig import SIZE, make_scene
from warp_ar import explain
from warp_ar.engine.graph import Plan, make_plan
from warp_ar.scene import CapturedLight, Exposure, dumps_scene, load_scene
from warp_ar.stages.features import Features, find_features
from warp_ar.stages.irradiance import Irradiance
from warp_ar.stages.quality import PRESETS
from warp_ar.stages.request import Request


def features_of(preset: str = "high", exposures: tuple[float, ...] = (), **changes: object) -> Features:
    return find_features(Request(make_scene(**changes), PRESETS[preset], SIZE, exposures=exposures))


def plan_of(preset: str = "medium", **changes: object) -> Plan:
    return make_plan(Request(make_scene(**changes), PRESETS[preset], SIZE))


def test_without_a_ball_nothing_is_known_of_the_environment() -> None:
    found = features_of(probes=())
    assert not (found.environment)
    assert not (found.recovered)
    assert not (found.emitters)
    assert not (found.merged)
    assert not (found.near_field)
    assert not (found.shadowed)
    assert not (found.ambient_visibility)
    assert not (found.bounced)
    assert found.relight_method == "flat"
    assert (found.distant.diffuse, found.distant.specular) == ("none", False)
    assert found.layers == ("virtual", "added_light")


def test_exposures_are_merged_where_light_is_recovered() -> None:
    assert features_of("medium", (1.0, 0.1)).merged
    assert not features_of("medium").merged
    recovers_nothing = PRESETS["medium"].with_methods(recover="clipped")
    assert not find_features(Request(make_scene(), recovers_nothing, SIZE, exposures=(1.0, 0.1))).merged


def test_the_table_is_left_out_for_a_reason_that_is_true() -> None:
    """Of an exposure of 0.5 whose method looks above clipping, not that it is not lowered."""
    reasons = dict(plan_of(exposure=Exposure(0.5), lights=()).left_out)
    assert reasons["summed_area"] == "the exposure does not look at means of a pixel's surroundings"
    assert "summed_area" not in dict(plan_of("paper", exposure=Exposure(0.5), lights=()).left_out)


def test_a_captured_light_in_the_paper_s_preset_has_irradiance_by_series() -> None:
    """There is no ball to look it up: arrays and kernels are both of the method that runs instead."""
    lit = make_scene(captured=CapturedLight(Path("light.exr")))
    found = find_features(Request(lit, PRESETS["paper"], SIZE))
    assert (found.irradiance, found.distant.diffuse) == ("irradiance_sh", "sh")
    assert Irradiance.method_for(found) == "sh2"
    assert features_of("paper").irradiance == "irradiance_map"


def explained(scene: object, tmp_path: Path, capsys: pytest.CaptureFixture[str], *more: str) -> str:
    path = tmp_path / "scene.toml"
    path.write_text(dumps_scene(scene), encoding="utf-8")  # type: ignore[arg-type]
    assert explain.main([str(path), *more]) == 0
    return " ".join(capsys.readouterr().out.replace("│", " ").split())


def test_explain_shows_the_method_that_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = dataclasses.replace(load_scene("desk"), probes=())
    said = explained(scene, tmp_path, capsys, "--quality", "high")
    assert "relight flat runs" in said
    assert "relight bounce" not in said


def test_only_several_balls_call_for_interpolation() -> None:
    """One ball: the plan that there was before; two: the same stages, for both."""
    (ball,) = make_scene().probes
    two = (ball, dataclasses.replace(ball, center=(0.2, 0.0, 0.04)))
    for preset in ("low", "medium", "high", "reference"):
        single, several = plan_of(preset), plan_of(preset, probes=two)
        assert [stage.name for stage, _ in several.stages] == [stage.name for stage, _ in single.stages]
        resources = {name for _, wiring in single.stages for name in (*wiring.reads, *wiring.writes)}
        assert not [name for name in resources if name.startswith(("others", "probes_seen", "probe_places"))]
        assert (single.features.others, several.features.others) == (0, 1)
        assert not single.features.distant.several
        assert several.features.distant.several
        assert several.features.recovered == single.features.recovered
    three = plan_of("medium", probes=(*two, dataclasses.replace(ball, center=(0.0, 0.3, 0.04))))
    assert three.features.others == 2


@pytest.mark.parametrize(
    ("preset", "count", "exposures", "changes", "said"),
    [
        ("medium", 0, (), {}, ""),
        ("medium", 1, (), {}, ""),
        ("medium", 2, (), {"objects": ()}, "receivers are lit by what is interpolated between 2 mirror balls"),
        ("medium", 2, (), {"objects": (), "lights": ()}, ""),
        ("medium", 3, (), {}, "objects and receivers are lit by what is interpolated between 3 mirror balls"),
        ("medium", 2, (1.0, 0.1), {}, "of several exposures 2 mirror balls make one map"),
        ("paper", 2, (), {}, "sphere map is a texture of one mirror ball, the first"),
    ],
)
def test_which_balls_light_objects_is_said(
    preset: str, count: int, exposures: tuple[float, ...], changes: dict[str, object], said: str
) -> None:
    (ball,) = make_scene().probes
    balls = tuple(dataclasses.replace(ball, center=(0.2 * k, 0.0, 0.04)) for k in range(count))
    found = features_of(preset, exposures, **{**changes, "probes": balls})
    assert said in found.balls
    assert bool(said) == bool(found.balls)
    assert bool(found.others) == ("interpolated" in said)
