"""Settings of a quality, the cost and the error of each, and the choice for a budget.

A **setting** is a stage with several methods, or a number or way of ``Quality`` that several stages share. A **cost**
is what one method of one setting costs in milliseconds and errs in FLIP. Both are taken to add up: costs because stages
run one after another, errors because each is the excess over the setting's best method, mean over the same pixels.

Choosing is then a small knapsack problem with one item per setting, solved exactly: settings are joined one by one, and
of the joined choices those are dropped that cost no less and err no less than another.
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
"""The committed errors, beside this file."""


@dataclasses.dataclass(frozen=True)
class Setting:
    """Something that a quality can turn."""

    name: str
    """A stage's, or a field's of ``Quality``."""
    methods: tuple[str, ...]
    """Cheapest first; the last is the reference."""
    stages: tuple[str, ...]
    """Stages whose work it changes."""

    @property
    def measured(self) -> tuple[str, ...]:
        """Methods that a budget may choose: all but brute force."""
        return tuple(method for method in self.methods if method != "brute_force")

    @property
    def converges(self) -> bool:
        """Return whether its methods approximate the last of them; others are models of their own."""
        return self.name in _SHARED or any(stage.converges for stage in STAGES if stage.name == self.name)


def _shared(name: str, *methods: str) -> Setting:
    """A setting that stages share: those that say so."""
    return Setting(name, methods, tuple(stage.name for stage in STAGES if name in stage.settings))


_SHARED: Mapping[str, tuple[str, Mapping[str, str]]] = {
    "environment_height": ("rows of the environment map", {}),
    "edge_samples": ("samples per pixel at outlines of virtual objects and shadows", {}),
    "area_light": (
        "light of objects that emit",
        {
            "point": "as a point in its middle",
            "coarse": "8 samples per point of objects; 16 per 8x8 pixels of receivers",
            "fine": "32 samples; 32 per 6x6 pixels of receivers",
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
"""All there are."""
WORDS: Mapping[str, tuple[str, Mapping[str, str]]] = {
    **_SHARED,
    **{stage.name: (stage.subject, stage.methods) for stage in _CHOICES},
}
"""Descriptions of every setting and every method, for tables."""
NUMBERS = ("environment_height", "edge_samples")
"""Settings that are numbers of ``Quality``, not methods."""


_LIGHT_ONLY = {stage.name: stage.unseen_method for stage in STAGES if stage.unseen_method} | {"edge_samples": "1"}
"""Methods of what only shows the light, for frames that nobody looks at."""


def chosen(quality: Quality, setting: Setting) -> str:
    """Method that ``quality`` has the setting on; one that it does not name is on the stage's own default, the last."""
    if setting.name in NUMBERS:
        return str(getattr(quality, setting.name))
    method = quality.method(setting.name)
    return method if method in setting.methods else setting.methods[-1]


def turn(quality: Quality, settings: Mapping[str, str]) -> Quality:
    """``quality`` with some settings on other methods.

    Raises:
        UsageError: There is no such setting or method.
    """
    known = {setting.name: setting for setting in SETTINGS}
    numbers: dict[str, int] = {}
    methods: dict[str, str] = {}
    for name, method in settings.items():
        if name not in known:
            raise UsageError(f"there is nothing called {name!r} to turn; expected {', '.join(known)}")
        if method not in known[name].methods:
            raise UsageError(f"{name} has no method {method!r}; expected {', '.join(known[name].methods)}")
        if name in NUMBERS:
            numbers[name] = int(method)
        else:
            methods[name] = method
    return dataclasses.replace(quality.with_methods(**methods), **numbers)  # type: ignore[arg-type]


def light_only(quality: Quality) -> Quality:
    """The same light, cheaply shown: for frames that only bring it."""
    return turn(quality, _LIGHT_ONLY)


def relevant_settings(scene: Scene, size: tuple[int, int]) -> tuple[Setting, ...]:
    """Settings that change what the scene shows or costs."""
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
    """One method of one setting."""

    setting: str
    method: str
    milliseconds: float
    error: float
    """FLIP, as the cost table defines it."""


@dataclasses.dataclass(frozen=True)
class Choice:
    """A method for every setting, and what they cost and err together."""

    settings: tuple[tuple[str, str], ...]
    milliseconds: float
    error: float


def pareto_front(method_costs: Sequence[MethodCost]) -> list[Choice]:
    """Return every choice than which no other costs less and errs less, of all settings; cheapest first."""
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
    """Return the least error of a Pareto front within a budget; the cheapest choice if none fits."""
    fitting = [choice for choice in front if choice.milliseconds <= budget_ms]
    return fitting[-1] if fitting else front[0]


@functools.cache
def _load_table() -> dict[str, Any]:
    text = importlib.resources.files("warp_ar.accuracy").joinpath(COST_TABLE).read_text(encoding="utf-8")
    table: dict[str, Any] = json.loads(text)
    return table


def load_errors() -> dict[str, dict[str, float]]:
    """Return the error of every method of every setting, from the cost table that comes with the package."""
    return read_errors(_load_table())


def load_presets(scene: str, value: str = "error") -> dict[str, float]:
    """Return each preset's ``error`` or ``ms``, of whole frames: a bundled scene's own, else the mean of all."""
    presets = [own for own in _load_table()["presets"].values() if all(value in one for one in own.values())]
    found = [own for own in presets if own is _load_table()["presets"].get(scene)] or presets
    return {name: sum(own[name][value] for own in found) / len(found) for name in found[0]}


def read_errors(cost_table: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """Return the errors of a cost table; a method that it does not know errs as its next cheaper one.

    Raises:
        UsageError: The table has no errors, or one that is no number.
    """
    listed = cost_table.get("errors")
    if not isinstance(listed, Mapping):
        raise UsageError(f"{COST_TABLE}: expected a table 'errors'; make it anew with python -m warp_ar.tradeoff")
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
