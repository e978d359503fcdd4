"""Settings of a quality, the cost and the error of their methods, and the choice for a budget.

A **setting** is a stage with several methods, or a number or method of ``Quality`` that several stages share. The
**cost** of a method is its time in milliseconds. Its **error** is in FLIP, in excess of the setting's best method. A
**choice** is one method for each setting. Costs and errors of a choice are assumed to be sums over its methods: costs
because stages run one after another, errors because all are averaged over the same pixels.

The choice of least error within a budget is a multiple-choice knapsack problem, solved exactly: settings are added one
by one, and partial choices that are dominated in cost and error are dropped.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib.resources
import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

from warp_ar.engine.graph import make_plan
from warp_ar.errors import UsageError
from warp_ar.scene import Scene
from warp_ar.scene.area_lights import emits_light
from warp_ar.stages import STAGES
from warp_ar.stages.features import AREA_SAMPLES
from warp_ar.stages.quality import PRESETS, Quality
from warp_ar.stages.request import Request

COST_TABLE = "cost_table.json"
"""File with the errors of all methods, next to this module."""


@dataclasses.dataclass(frozen=True)
class Setting:
    """Part of a quality that can be varied."""

    name: str
    """Name of a stage, or of a field of ``Quality``."""
    methods: tuple[str, ...]
    """Methods, cheapest first; the last is the most accurate."""
    stages: tuple[str, ...]
    """Names of the stages whose work the setting changes."""

    @property
    def measured(self) -> tuple[str, ...]:
        """Methods that may be chosen for a budget: all but brute force."""
        return tuple(method for method in self.methods if method != "brute_force")

    @property
    def converges(self) -> bool:
        """Return True if all methods approximate the last; False if they are different models."""
        return self.name in _SHARED or any(stage.converges for stage in STAGES if stage.name == self.name)


def _shared(name: str, *methods: str) -> Setting:
    """Return a setting that several stages share; its stages are those that declare it."""
    return Setting(name, methods, tuple(stage.name for stage in STAGES if name in stage.settings))


_SHARED: Mapping[str, tuple[str, Mapping[str, str]]] = {
    "environment_height": ("rows of the environment map", {}),
    "edge_samples": ("samples per pixel at outlines of virtual objects and shadows", {}),
    "area_light": (
        "light of objects that emit",
        {
            "point": "as a point in its middle",
            "coarse": "4 samples per point of objects; 8 per 8x8 pixels of receivers",
            "fine": "8 samples; 16 per 6x6 pixels of receivers",
            "brute_force": "256 samples per point",
        },
    ),
    "light_shadow": (
        "shadows of virtual lights",
        {"hard": "as if every light were a point", "soft": "as wide as the light"},
    ),
}
_CHOICES = tuple(stage for stage in STAGES if len(stage.methods) > 1)
SETTINGS: tuple[Setting, ...] = (
    _shared("environment_height", "32", "64", "128", "256"),
    _shared("edge_samples", "1", "4", "16"),
    _shared("light_shadow", "hard", "soft"),
    _shared("area_light", *AREA_SAMPLES),
    *(Setting(stage.name, tuple(stage.methods), (stage.name,)) for stage in _CHOICES),
)
"""All settings."""
WORDS: Mapping[str, tuple[str, Mapping[str, str]]] = {
    **_SHARED,
    **{stage.name: (stage.subject, stage.methods) for stage in _CHOICES},
}
"""Descriptions of every setting and every method, for tables."""
NUMBERS = ("environment_height", "edge_samples")
"""Settings that are numbers of ``Quality``, not methods."""


_LIGHT_ONLY = {stage.name: stage.unseen_method for stage in STAGES if stage.unseen_method} | {
    "edge_samples": "1",
    "light_shadow": "hard",
    "area_light": "point",
}
"""Cheap methods of settings that do not affect the captured light, for frames that are not shown."""


def chosen(quality: Quality, setting: Setting) -> str:
    """Return the method of a setting in a quality; if the quality names none, the default, which is the last method."""
    if setting.name in NUMBERS:
        return str(getattr(quality, setting.name))
    method = quality.method(setting.name)
    return method if method in setting.methods else setting.methods[-1]


def turn(quality: Quality, settings: Mapping[str, str]) -> Quality:
    """Return a quality with other methods for some settings.

    Args:
        quality: The quality.
        settings: Methods by the names of their settings.

    Raises:
        UsageError: A setting or a method is unknown.
    """
    known = {setting.name: setting for setting in SETTINGS}
    numbers: dict[str, int] = {}
    methods: dict[str, str] = {}
    for name, method in settings.items():
        if name not in known:
            raise UsageError(f"there is no setting {name!r}; expected {', '.join(known)}")
        if method not in known[name].methods:
            raise UsageError(f"{name} has no method {method!r}; expected {', '.join(known[name].methods)}")
        if name in NUMBERS:
            numbers[name] = int(method)
        else:
            methods[name] = method
    return dataclasses.replace(quality.with_methods(**methods), **numbers)  # type: ignore[arg-type]


def light_only(quality: Quality) -> Quality:
    """Return a quality that captures light as the given one, but has cheap methods for the rest of the picture."""
    return turn(quality, _LIGHT_ONLY)


def relevant_settings(scene: Scene, size: tuple[int, int]) -> tuple[Setting, ...]:
    """Return the settings that change the picture of a scene, or its cost."""
    plan = make_plan(Request(scene, PRESETS["reference"], size))
    running = {stage.name for stage, _ in plan.stages}
    needed = {
        "light_shadow": any(light.radius > 0.0 for light in scene.lights),
        "area_light": any(map(emits_light, scene.objects)),
    }
    return tuple(
        setting for setting in SETTINGS if not running.isdisjoint(setting.stages) and needed.get(setting.name, True)
    )


@dataclasses.dataclass(frozen=True)
class MethodCost:
    """Cost and error of one method of one setting."""

    setting: str
    method: str
    milliseconds: float
    """Milliseconds per frame in excess of the base quality's."""
    error: float
    """Error in FLIP, in excess of the setting's best method."""


@dataclasses.dataclass(frozen=True)
class Choice:
    """Choice of a method for every setting, with their total cost and error."""

    settings: tuple[tuple[str, str], ...]
    """Pairs (setting, method)."""
    milliseconds: float
    error: float


def pareto_front(method_costs: Sequence[MethodCost]) -> list[Choice]:
    """Return the Pareto-optimal choices of all settings, cheapest first."""
    settings: dict[str, list[MethodCost]] = {}
    for method_cost in method_costs:
        settings.setdefault(method_cost.setting, []).append(method_cost)
    front = [Choice((), 0.0, 0.0)]
    for setting, own in settings.items():
        joined = [
            Choice(
                (*choice.settings, (setting, method_cost.method)),
                choice.milliseconds + method_cost.milliseconds,
                choice.error + method_cost.error,
            )
            for choice in front
            for method_cost in own
        ]
        front = []
        for choice in sorted(joined, key=lambda choice: (choice.milliseconds, choice.error)):
            if not front or choice.error < front[-1].error:
                front.append(choice)
    return front


def choose(front: Sequence[Choice], budget_ms: float) -> Choice:
    """Return the choice of least error in a Pareto front within a budget; the cheapest if none fits."""
    fitting = [choice for choice in front if choice.milliseconds <= budget_ms]
    return fitting[-1] if fitting else front[0]


@functools.cache
def _load_table() -> dict[str, Any]:
    text = importlib.resources.files("warp_ar.accuracy").joinpath(COST_TABLE).read_text(encoding="utf-8")
    table: dict[str, Any] = json.loads(text)
    return table


def load_errors() -> dict[str, dict[str, float]]:
    """Return the error of every method of every setting, from the package's cost table."""
    return read_errors(_load_table())


def load_presets(scene: str, value: str = "error") -> dict[str, float]:
    """Return a measured value of each preset's whole frames, from the package's cost table.

    Args:
        scene: Name of a bundled scene; for another name, the mean over all scenes is returned.
        value: ``error`` (FLIP) or ``ms``.
    """
    presets = [own for own in _load_table()["presets"].values() if all(value in one for one in own.values())]
    found = [own for own in presets if own is _load_table()["presets"].get(scene)] or presets
    return {name: sum(own[name][value] for own in found) / len(found) for name in found[0]}


def read_errors(cost_table: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """Return the errors in a cost table by setting and method; a method without an entry has that of the one before it.

    Raises:
        UsageError: The table has no errors, or one that is not a number.
    """
    listed = cost_table.get("errors")
    if not isinstance(listed, Mapping):
        raise UsageError(f"{COST_TABLE}: expected a table 'errors'; write it again with python -m warp_ar.tradeoff")
    errors: dict[str, dict[str, float]] = {}
    for setting in SETTINGS:
        own, last = listed.get(setting.name, {}), 0.0
        errors[setting.name] = {}
        for method in setting.methods:
            last = own.get(method, last)
            if not isinstance(last, (int, float)) or not math.isfinite(last) or last < 0.0:
                raise UsageError(
                    f"{COST_TABLE}: errors.{setting.name}.{method} is {last!r}; expected a number, 0 or more"
                )
            errors[setting.name][method] = float(last)
    return errors
