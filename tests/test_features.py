"""What a request calls for, and what ``explain`` says of it: reasons are true of the scene at hand."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from tests.hard_cases.rig import SIZE, make_scene
from warp_ar import explain
from warp_ar.engine.graph import Plan, make_plan
from warp_ar.scene import Exposure, SourceSpec, dumps_scene, load_scene
from warp_ar.stages.features import Features, find_features
from warp_ar.stages.quality import PRESETS
from warp_ar.stages.relight import Relight
from warp_ar.stages.request import Request
from warp_ar.stages.unwrap import Unwrap


def features_of(preset: str = "high", exposures: tuple[float, ...] = (), **changes: object) -> Features:
    return find_features(Request(make_scene(**changes), PRESETS[preset], SIZE, exposures=exposures))


def plan_of(preset: str = "medium", **changes: object) -> Plan:
    return make_plan(Request(make_scene(**changes), PRESETS[preset], SIZE))


def test_a_scene_of_everything_calls_for_everything() -> None:
    found = features_of()
    assert found.layers == ("virtual", "added_light", "shadow_ratio", "mirror_ball")
    assert found.environment
    assert found.recovered
    assert found.emitters
    assert found.near_field
    assert found.exposed
    assert found.declipped
    assert found.declipped_by_ball
    assert not found.boxed
    assert found.relight_method == "bounce"
    assert found.ambient_visibility
    assert found.bounced


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


EXPOSURES = [
    (1.0, True, False, False),
    (0.5, True, True, True),
    (2.0, True, True, False),
    ("auto", True, True, True),
    ("auto", False, False, False),
]


@pytest.mark.parametrize(("scale", "lights", "exposed", "darkened"), EXPOSURES)
def test_an_exposure_calls_for_what_it_shows(scale: float | str, lights: bool, exposed: bool, darkened: bool) -> None:
    more = {} if lights else {"lights": ()}
    high, low = (features_of(preset, exposure=Exposure(scale), **more) for preset in ("high", "low"))
    assert high.exposed == low.exposed == exposed
    assert high.declipped == low.boxed == darkened


def test_exposures_are_merged_where_light_is_recovered() -> None:
    assert features_of("medium", (1.0, 0.1)).merged
    assert not features_of("medium").merged
    recovers_nothing = PRESETS["medium"].with_methods(recover="clipped")
    assert not find_features(Request(make_scene(), recovers_nothing, SIZE, exposures=(1.0, 0.1))).merged


def test_the_method_is_the_one_that_runs() -> None:
    """Not the one that the quality names where the scene leaves no choice, nor none where there is a choice."""
    assert Relight.method_for(features_of("high")) == "bounce"
    assert Relight.method_for(features_of("high", probes=())) == "flat"
    assert Unwrap.method_for(features_of("medium")) == "area"


def test_the_table_is_left_out_for_a_reason_that_is_true() -> None:
    """Of an exposure of 0.5 whose method looks above clipping, not that it is not lowered."""
    reasons = dict(plan_of(exposure=Exposure(0.5), lights=()).left_out)
    assert reasons["summed_area"] == "the exposure does not look at means of a pixel's surroundings"
    assert "summed_area" not in dict(plan_of("low", exposure=Exposure(0.5), lights=()).left_out)


def explained(scene: object, tmp_path: Path, capsys: pytest.CaptureFixture[str], *more: str) -> str:
    path = tmp_path / "scene.toml"
    path.write_text(dumps_scene(scene), encoding="utf-8")  # type: ignore[arg-type]
    assert explain.main([str(path), *more]) == 0
    return " ".join(capsys.readouterr().out.replace("│", " ").split())


def test_explain_knows_the_exposures_of_the_source(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = dataclasses.replace(load_scene("desk"), source=SourceSpec(camera=0, exposures=(0.02, 0.002)))
    assert "bracket default runs" in explained(scene, tmp_path, capsys)
    bare = dataclasses.replace(scene, source=SourceSpec(camera=0))
    assert "bracket default runs" not in explained(bare, tmp_path, capsys)


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


def test_explain_says_which_balls_light_objects(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = make_scene()
    file = tmp_path / "two.toml"
    two = (scene.probes[0], dataclasses.replace(scene.probes[0], center=(0.2, 0.0, 0.04)))
    for balls, said in ((two, True), (two[:1], False)):
        file.write_text(dumps_scene(dataclasses.replace(scene, probes=balls)))
        assert explain.main([str(file)]) == 0
        assert ("interpolated between 2 mirror balls" in " ".join(capsys.readouterr().out.split())) == said
