"""What a quality can turn, what each turn costs and how far off it is, and what to choose for a budget.

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
from warp_ar.stages import STAGES
from warp_ar.stages.base import Request
from warp_ar.stages.quality import PRESETS, Quality

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
    def converges(self) -> bool:
        """Whether its methods approximate one object, which the last of them gives; others are models of their own."""
        return self.name in _CONVERGING


_CONVERGING = (
    "environment_height",
    "edge_samples",
    "light_shadow",
    "unwrap",
    "irradiance",
    "prefilter",
    "environment_shadow",
    "mirror_ball",
)
_LIGHT = ("unwrap", "accumulate", "fill", "recover", "key_lights", "irradiance", "prefilter", "environment_samples")
SETTINGS: tuple[Setting, ...] = (
    Setting("environment_height", ("32", "64", "128", "256"), _LIGHT),
    Setting("edge_samples", ("1", "4", "16"), ("relight", "shade")),
    Setting("light_shadow", ("hard", "soft"), ("relight", "shade")),
    *(Setting(stage.name, tuple(stage.methods), (stage.name,)) for stage in STAGES if len(stage.methods) > 1),
)
"""All there are."""
WORDS: Mapping[str, tuple[str, Mapping[str, str]]] = {
    "environment_height": ("rows of the map that holds the environment", {}),
    "edge_samples": ("samples per pixel along the outlines of virtual objects, and of shadows of virtual light", {}),
    "light_shadow": (
        "shadows of virtual lights",
        {"hard": "as if every lamp were a point (the paper)", "soft": "as wide as the lamp"},
    ),
    "unwrap": (
        "reading the light off the mirror ball, judged with a map of 32 rows",
        {
            "bilinear": "one sample between pixels (the paper)",
            "area": "the mean over what a texel covers",
        },
    ),
    "recover": (
        "light that clips in the ball",
        {
            "clipped": "as the camera saw it (the paper)",
            "white_card": "scaled until it lights the white card as brightly as the frame shows",
            "shading": "shared among lamps as shading and shadows in the frame tell",
        },
    ),
    "irradiance": (
        "light that matt surfaces receive",
        {
            "top_mip": "a 4x8 map (the paper)",
            "sh2": "spherical harmonics of order 2",
            "sh4": "of order 4",
            "clusters": "200 clusters of the environment, summed for every direction",
            "brute_force": "every texel for every direction",
        },
    ),
    "prefilter": (
        "light that glossy surfaces reflect",
        {
            "box_mip": "a pyramid of means (the paper)",
            "energy_mip": "a pyramid that keeps energy, mixed to fit the lobe",
            "fis32": "32 importance samples per texel",
            "fis128": "128 importance samples per texel",
            "brute_force": "every texel for every direction and width",
        },
    ),
    "relight": (
        "virtual light on the real desk",
        {
            "flat": "on a grey desk",
            "paper": "blended by the frame's brightness (the paper)",
            "directional": "the same, as far as the environment's light has a direction",
            "relief": "the paper's blend, relief told from paint",
            "reflectance": "on the reflectance that frame and environment light give",
            "bounce": "the same, knowing the environment's own shadows, and what lit surfaces send each other",
            "brute_force": "the same at every pixel, with 1,024 rays and patches of 4 pixels",
        },
    ),
    "environment_shadow": (
        "shadows of virtual objects in the environment, and the light that they reflect onto the desk",
        {
            "none": "none (the paper)",
            "coarse": "32 rays per estimate, every fifth pixel, and an estimate of reflected light",
            "bounce": "64 rays, every second pixel, and reflected light by a ray for half of them",
            "brute_force": "every texel of the environment at every pixel",
        },
    ),
    "shade": (
        "what virtual objects reflect",
        {"environment": "the environment (the paper)", "one_bounce": "the environment, the desk and each other"},
    ),
    "mirror_ball": (
        "what the mirror ball in the picture shows of virtual objects",
        {
            "none": "nothing (the paper)",
            "single": "one ray per pixel",
            "smooth": "4 rays per pixel",
            "brute_force": "64 rays per pixel",
        },
    ),
    "expose": (
        "clipped pixels at a shorter exposure",
        {
            "plain": "scaled",
            "paper": "scaled less where surroundings clip too (the paper)",
            "box": "the same, by one stop at most",
            "glow": "from the glow around them",
            "ball": "from the glow and the ball's view of the same lamp",
        },
    ),
}
"""What every setting and every method is, for tables."""
NUMBERS = ("environment_height", "edge_samples")
"""Settings that are numbers of ``Quality``, not methods."""


_LIGHT_ONLY = {
    "irradiance": "sh2",
    "prefilter": "box_mip",
    "relight": "paper",
    "environment_shadow": "none",
    "shade": "environment",
    "mirror_ball": "none",
    "edge_samples": "1",
}
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
    soft = any(light.radius > 0.0 for light in scene.lights)
    return tuple(
        setting
        for setting in SETTINGS
        if not running.isdisjoint(setting.stages) and (setting.name != "light_shadow" or soft)
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


def choose_for_error(front: Sequence[Choice], error: float) -> Choice:
    """Cheapest of a ``Pareto front`` that errs no more; the most exact if none does."""
    return next((choice for choice in front if choice.error <= error), front[-1])


def load_errors() -> dict[str, dict[str, float]]:
    """Error of every method of every setting, from the cost table that comes with the package."""
    text = importlib.resources.files("warp_ar.accuracy").joinpath(COST_TABLE).read_text(encoding="utf-8")
    return read_errors(json.loads(text))


def read_errors(cost_table: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """Errors of a cost table; a method that it does not know is taken to err as its next cheaper one.

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
        for method in setting.methods:
            last = own.get(method, last)
            if not isinstance(last, (int, float)) or not math.isfinite(last) or last < 0.0:
                raise UsageError(
                    f"{COST_TABLE}: errors.{setting.name}.{method} is {last!r}; expected a number, 0 or more"
                )
            found[method] = float(last)
        errors[setting.name] = found
    return errors
