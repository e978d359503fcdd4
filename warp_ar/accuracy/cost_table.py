"""What a quality can turn, what each turn costs and how far off it is, and what to choose for a budget.

A **knob** is a stage with several rungs, or a number or way of ``Quality`` that several stages share. A **price** is
what one rung of one knob costs in milliseconds and errs in FLIP. Both add up over stages: costs because stages run one
after another, errors because each is the excess over the knob's best rung, mean over the same pixels. A knob that
several stages share multiplies: with four times the texels, what 128 samples per texel cost more is four times as much.

Choosing is then, for every setting of the shared knobs, a small knapsack problem with one item per other knob, solved
exactly: knobs are joined one by one, and of the joined choices those are dropped that cost no less and err no less than
another.
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

PRICE_LIST = "price_list.json"
"""The committed errors, beside this file."""


@dataclasses.dataclass(frozen=True)
class Knob:
    """Something that a quality can turn."""

    name: str
    """A stage's, or a field's of ``Quality``."""
    rungs: tuple[str, ...]
    """Cheapest first; the last is the reference."""
    stages: tuple[str, ...]
    """Stages whose work it changes."""

    @property
    def converges(self) -> bool:
        """Whether its rungs approximate one thing, which the last of them gives; others are models of their own."""
        return self.name in _CONVERGING


_CONVERGING = (
    "environment_height",
    "edge_samples",
    "light_shadow",
    "unwrap",
    "diffuse",
    "specular",
    "room_shadow",
    "mirror_ball",
)
_LIGHT = ("unwrap", "accumulate", "fill", "recover", "key_lights", "diffuse", "specular", "room_samples")
KNOBS: tuple[Knob, ...] = (
    Knob("environment_height", ("32", "64", "128", "256"), _LIGHT),
    Knob("edge_samples", ("1", "4", "16"), ("relight", "shade")),
    Knob("light_shadow", ("hard", "soft"), ("relight", "shade")),
    *(Knob(stage.name, tuple(stage.rungs), (stage.name,)) for stage in STAGES if len(stage.rungs) > 1),
)
"""All there are."""
WORDS: Mapping[str, tuple[str, Mapping[str, str]]] = {
    "environment_height": ("rows of the map that holds the room's light", {}),
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
    "diffuse": (
        "light that matt surfaces receive",
        {
            "top_mip": "a 4x8 map (the paper)",
            "sh2": "spherical harmonics of order 2",
            "sh4": "of order 4",
            "clusters": "200 clusters of the room, summed for every direction",
            "brute_force": "every texel for every direction",
        },
    ),
    "specular": (
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
            "relief": "the paper's blend, relief told from paint",
            "reflectance": "on the reflectance that frame and room light give",
            "bounce": "the same, knowing the room's own shadows, and what lit surfaces send each other",
            "brute_force": "the same at every pixel, with 1,024 rays and patches of 4 pixels",
        },
    ),
    "room_shadow": (
        "shadows of virtual things in the room's light, and the light that they reflect onto the desk",
        {
            "none": "none (the paper)",
            "coarse": "32 rays per estimate, every fifth pixel, and an estimate of reflected light",
            "bounce": "64 rays, every second pixel, and reflected light by a ray for half of them",
            "brute_force": "every texel of the room at every pixel",
        },
    ),
    "shade": (
        "what virtual objects reflect",
        {"environment": "the room (the paper)", "one_bounce": "the room, the desk and each other"},
    ),
    "mirror_ball": (
        "what the mirror ball in the picture shows of virtual things",
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
            "box": "scaled less where surroundings clip too (the paper)",
            "glow": "from the glow around them",
            "ball": "from the glow and the ball's view of the same lamp",
        },
    ),
}
"""What every knob and every rung is, for tables."""
NUMBERS = ("environment_height", "edge_samples")
"""Knobs that are numbers of ``Quality``, not rungs."""


_LIGHT_ONLY = {
    "diffuse": "sh2",
    "specular": "box_mip",
    "relight": "paper",
    "room_shadow": "none",
    "shade": "environment",
    "mirror_ball": "none",
    "edge_samples": "1",
}
"""Rungs of what only shows the light, for frames that nobody looks at."""


def setting(quality: Quality, knob: Knob) -> str:
    """Rung that ``quality`` has the knob on; one that it does not name is on the stage's own default, the last."""
    if knob.name in NUMBERS:
        return str(getattr(quality, knob.name))
    rung = quality.rung(knob.name)
    return rung if rung in knob.rungs else knob.rungs[-1]


def turn(quality: Quality, settings: Mapping[str, str]) -> Quality:
    """``quality`` with some knobs on other rungs.

    Raises:
        UsageError: There is no such knob or rung.
    """
    known = {knob.name: knob for knob in KNOBS}
    numbers: dict[str, int] = {}
    rungs: dict[str, str] = {}
    for name, rung in settings.items():
        if name not in known:
            raise UsageError(f"there is nothing called {name!r} to turn; expected {', '.join(known)}")
        if rung not in known[name].rungs:
            raise UsageError(f"{name} has no rung {rung!r}; expected {', '.join(known[name].rungs)}")
        if name in NUMBERS:
            numbers[name] = int(rung)
        else:
            rungs[name] = rung
    return dataclasses.replace(quality.with_rungs(**rungs), **numbers)  # type: ignore[arg-type]


def light_only(quality: Quality) -> Quality:
    """The same light, cheaply shown: for frames that only bring it."""
    return turn(quality, _LIGHT_ONLY)


def relevant_knobs(scene: Scene, size: tuple[int, int]) -> tuple[Knob, ...]:
    """Knobs that change what the scene shows or costs."""
    plan = make_plan(Request(scene, PRESETS["reference"], size))
    running = {stage.name for stage, _ in plan.stages}
    soft = any(light.radius > 0.0 for light in scene.lights)
    return tuple(
        knob for knob in KNOBS if not running.isdisjoint(knob.stages) and (knob.name != "light_shadow" or soft)
    )


@dataclasses.dataclass(frozen=True)
class Price:
    """One rung of one knob."""

    knob: str
    rung: str
    milliseconds: float
    error: float
    """FLIP, as the price list defines it."""


@dataclasses.dataclass(frozen=True)
class Choice:
    """A rung for every knob, and what they cost and err together."""

    settings: tuple[tuple[str, str], ...]
    milliseconds: float
    error: float


def undominated(prices: Sequence[Price]) -> list[Price]:
    """Of one knob's prices those than which no other costs less and errs less; cheapest first."""
    kept: list[Price] = []
    for price in sorted(prices, key=lambda price: (price.milliseconds, price.error)):
        if not kept or price.error < kept[-1].error:
            kept.append(price)
    return kept


Scales = Mapping[str, Mapping[str, Mapping[str, float]]]
"""By knob that stages share, its rung and another knob: what multiplies the milliseconds of the other one's rungs."""


def frontier(prices: Sequence[Price], scales: Scales | None = None) -> list[Choice]:
    """Every choice than which no other costs less and errs less; cheapest first.

    Args:
        prices: All rungs of all knobs; every knob must get one.
        scales: How knobs that stages share scale prices; None means that prices add up.
    """
    scales = scales or {}
    knobs: dict[str, list[Price]] = {}
    for price in prices:
        knobs.setdefault(price.knob, []).append(price)
    ladders = {knob: undominated(own) for knob, own in knobs.items()}
    found: list[Choice] = []
    for shared in itertools.product(*(own for knob, own in ladders.items() if knob in scales)):
        front = [Choice((), 0.0, 0.0)]
        for knob, own in ladders.items():
            at = [price for price in shared if price.knob == knob]
            scale = math.prod(scales[price.knob].get(price.rung, {}).get(knob, 1.0) for price in shared)
            front = _thinned(
                Choice(
                    (*choice.settings, (price.knob, price.rung)),
                    choice.milliseconds + scale * price.milliseconds,
                    choice.error + price.error,
                )
                for choice in front
                for price in at or own
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
    """Least error of a ``frontier`` within a budget; the cheapest if none fits."""
    fitting = [choice for choice in front if choice.milliseconds <= budget_ms]
    return fitting[-1] if fitting else front[0]


def choose_for_error(front: Sequence[Choice], error: float) -> Choice:
    """Cheapest of a ``frontier`` that errs no more; the most exact if none does."""
    return next((choice for choice in front if choice.error <= error), front[-1])


def load_errors() -> dict[str, dict[str, float]]:
    """Error of every rung of every knob, from the price list that comes with the package."""
    text = importlib.resources.files("warp_ar.accuracy").joinpath(PRICE_LIST).read_text(encoding="utf-8")
    return read_errors(json.loads(text))


def read_errors(price_list: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """Errors of a price list; a rung that it does not know is taken to err as its next cheaper one.

    Raises:
        UsageError: The list has no errors, or one that is no number.
    """
    listed = price_list.get("errors")
    if not isinstance(listed, Mapping):
        raise UsageError(f"{PRICE_LIST}: expected a table 'errors'; make it anew with python -m warp_ar.tradeoff")
    errors: dict[str, dict[str, float]] = {}
    for knob in KNOBS:
        own = listed.get(knob.name, {})
        found: dict[str, float] = {}
        last = 0.0
        for rung in knob.rungs:
            last = own.get(rung, last)
            if not isinstance(last, (int, float)) or not math.isfinite(last) or last < 0.0:
                raise UsageError(f"{PRICE_LIST}: errors.{knob.name}.{rung} is {last!r}; expected a number, 0 or more")
            found[rung] = float(last)
        errors[knob.name] = found
    return errors
