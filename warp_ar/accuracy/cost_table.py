"""Settings of a quality, the cost and the error of each, and the choice for a budget.

A **setting** is a stage with several methods, or a number or way of ``Quality`` that several stages share. A **cost**
is what one method of one setting costs in milliseconds and errs in FLIP. Both add up over stages: costs because stages
run one after another, errors because each is the excess over the setting's best method, mean over the same pixels. A
setting that several stages share multiplies: with four times the texels, what 128 samples per texel cost more is four
times as much.

Choosing is then, for every setting of the shared settings, a small knapsack problem with one item per other setting,
solved
exactly: settings are joined one by one, and of the joined choices those are dropped that cost no less and err no less
than another.
"""

from __future__ import annotations

import dataclasses
import importlib.resources
import itertools
import json
import math
from collections.abc import Iterable, Mapping, Sequence
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
        """Methods whose costs are to be measured: without brute force, and without those between two others."""
        return tuple(method for method in self.methods if method not in ("brute_force", *BETWEEN.get(self.name, ())))

    @property
    def converges(self) -> bool:
        """Return whether its methods approximate the last of them; others are models of their own."""
        return self.name in _SHARED or any(stage.converges for stage in STAGES if stage.name == self.name)


def _shared(name: str, *methods: str) -> Setting:
    """A setting that stages share: those that say so."""
    return Setting(name, methods, tuple(stage.name for stage in STAGES if name in stage.settings))


_SHARED: Mapping[str, tuple[str, Mapping[str, str]]] = {
    "environment_height": ("rows of the map that holds the environment", {}),
    "edge_samples": ("samples per pixel along the outlines of virtual objects, and of shadows of virtual light", {}),
    "area_light": (
        "light of objects that emit",
        {
            "point": "as if each were all at its middle (the paper)",
            "coarse": "8 places on them per point",
            "fine": "32 places",
            "brute_force": "256 places",
        },
    ),
    "light_shadow": (
        "shadows of virtual lights",
        {"hard": "as if every light were a point (the paper)", "soft": "as wide as the light"},
    ),
}
_CHOICES = tuple(stage for stage in STAGES if len(stage.methods) > 1)
SETTINGS: tuple[Setting, ...] = (
    _shared("environment_height", "32", "48", "64", "96", "112", "128", "144", "160", "192", "224", "256"),
    _shared("edge_samples", "1", "4", "9", "16"),
    _shared("light_shadow", "hard", "soft"),
    _shared("area_light", *AREA_SAMPLES),
    *(Setting(stage.name, tuple(stage.methods), (stage.name,)) for stage in _CHOICES),
)
"""All there are."""
BETWEEN: Mapping[str, Mapping[str, tuple[str, str, float]]] = {
    "environment_height": {
        "48": ("32", "64", 5 / 12),
        "96": ("64", "128", 5 / 12),
        "112": ("64", "128", 11 / 16),
        "144": ("128", "256", 17 / 192),
        "160": ("128", "256", 9 / 48),
        "192": ("128", "256", 20 / 48),
        "224": ("128", "256", 33 / 48),
    },
    "edge_samples": {"9": ("4", "16", 5 / 12)},
    "environment_shadow": {
        "coarse6": ("none", "coarse", 25 / 36),
    },
    "shade": {"few_rays": ("environment", "one_bounce", 1 / 2)},
}
"""Methods that do the same work as another one more or less often: by setting and method two others, and the share of
the way from the first to the second at which the method's work lies; above 1 it lies beyond the second."""
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


def pareto_optimal(method_costs: Sequence[MethodCost]) -> list[MethodCost]:
    """Of one setting's costs those than which no other costs less and errs less; cheapest first."""
    kept: list[MethodCost] = []
    for method_cost in sorted(method_costs, key=lambda method_cost: (method_cost.milliseconds, method_cost.error)):
        if not kept or method_cost.error < kept[-1].error:
            kept.append(method_cost)
    return kept


Scales = Mapping[str, Mapping[str, Mapping[str, float]]]
"""By setting that stages share, its method and another setting: what multiplies the milliseconds of the other one's
methods."""


def pareto_front(method_costs: Sequence[MethodCost], scales: Scales | None = None) -> list[Choice]:
    """Every choice than which no other costs less and errs less; cheapest first.

    Args:
        method_costs: All methods of all settings; every setting must get one.
        scales: How settings that stages share scale costs; None means that costs add up.
    """
    scales = scales or {}
    settings: dict[str, list[MethodCost]] = {}
    for method_cost in method_costs:
        settings.setdefault(method_cost.setting, []).append(method_cost)
    ladders = {setting: pareto_optimal(own) for setting, own in settings.items()}
    found: list[Choice] = []
    for shared in itertools.product(*(own for setting, own in ladders.items() if setting in scales)):
        front = [Choice((), 0.0, 0.0)]
        for setting, own in ladders.items():
            at = [method_cost for method_cost in shared if method_cost.setting == setting]
            scale = math.prod(
                scales[method_cost.setting].get(method_cost.method, {}).get(setting, 1.0) for method_cost in shared
            )
            front = _thinned(
                Choice(
                    (*choice.settings, (method_cost.setting, method_cost.method)),
                    choice.milliseconds + scale * method_cost.milliseconds,
                    choice.error + method_cost.error,
                )
                for choice in front
                for method_cost in at or own
            )
        found += front
    return _thinned(found)


def _thinned(choices: Iterable[Choice]) -> list[Choice]:
    kept: list[Choice] = []
    for choice in sorted(choices, key=lambda choice: (choice.milliseconds, choice.error)):
        if not kept or choice.error < kept[-1].error:
            kept.append(choice)
    return kept


def choose(front: Sequence[Choice], budget_ms: float) -> Choice:
    """Least error of a ``Pareto front`` within a budget; the cheapest if none fits."""
    fitting = [choice for choice in front if choice.milliseconds <= budget_ms]
    return fitting[-1] if fitting else front[0]


def load_errors() -> dict[str, dict[str, float]]:
    """Error of every method of every setting, from the cost table that comes with the package."""
    text = importlib.resources.files("warp_ar.accuracy").joinpath(COST_TABLE).read_text(encoding="utf-8")
    return read_errors(json.loads(text))


def read_errors(cost_table: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """Errors of a cost table.

    A method that it does not know errs as its place between two others says (``BETWEEN``), else as its next cheaper
    one. Errors fall ever more slowly with work, as 1 - (1 - share)^2: where they were measured (shadows every eighth
    and sixth pixel) they fall faster.

    Raises:
        UsageError: The list has no errors, or one that is no number.
    """
    listed = cost_table.get("errors")
    if not isinstance(listed, Mapping):
        raise UsageError(f"{COST_TABLE}: expected a table 'errors'; make it anew with python -m warp_ar.tradeoff")
    errors: dict[str, dict[str, float]] = {}
    for setting in SETTINGS:
        own = listed.get(setting.name, {})
        found: dict[str, float] = {}
        last = 0.0
        between = BETWEEN.get(setting.name, {})
        for method in setting.methods:
            if method in between and method not in own and {between[method][0], between[method][1]} <= own.keys():
                low, high, share = between[method]
                found[method] = own[low] + (1.0 - (1.0 - min(share, 1.0)) ** 2) * (own[high] - own[low])
                continue
            last = own.get(method, last)
            if not isinstance(last, (int, float)) or not math.isfinite(last) or last < 0.0:
                raise UsageError(
                    f"{COST_TABLE}: errors.{setting.name}.{method} is {last!r}; expected a number, 0 or more"
                )
            found[method] = float(last)
        errors[setting.name] = found
    return errors
