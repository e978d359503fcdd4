"""The budget's controller on pretended machines: time over the budget, error, changes, by kind of load.

Then where it settles: with the costs that ``RECORDED`` holds of ``desk`` (``python -m bench.record_costs``), each
method up to ``OFF`` more or less expensive than the controller believes, and all errors of the cost table.
Per budget ``settles`` is the share of it that frames take, the median of the last ``LAST`` seconds: least, median,
most over seeds; ``within`` the share of runs that end within a tenth below the budget, or on the best methods there
are (``at_the_top``); ``changes`` those after ``SETTLED`` seconds of a steady load. ``stepping``: the same in
``PERIOD`` seconds after each step of a load of ``LOADS``.
"""

from __future__ import annotations

import functools
import json
import statistics
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from tests.test_budget import COSTS, ERRORS, Machine, best_error
from warp_ar.accuracy.controller import AIM
from warp_ar.accuracy.cost_table import SETTINGS, chosen, load_errors
from warp_ar.accuracy.costs import BASE as BASE_QUALITY
from warp_ar.accuracy.costs import Costs, fill_between

RECORDED = Path(__file__).parent / "results" / "desk_budget_costs.json"
SETTLING = (20.0, 40.0, 100.0, 400.0)
"""Budgets whose use is asked for, milliseconds."""
OFF = 0.15
SETTLED, LAST, STEADY_SECONDS = 30.0, 10.0, 120.0
LOADS, PERIOD = (0.6, 0.8, 1.0, 1.3, 1.7), 25.0
BUDGETS = (20.0, 33.0, 60.0)
SEEDS = 6
SECONDS = 40
KINDS = ("steady", "steps", "drift", "spiky")


def costs_a_fifth_off(seed: int) -> Costs:
    """What the controller believes; what multiplies stays as it is."""
    random = np.random.default_rng(100 + seed)
    methods = dict(COSTS.methods)
    for setting in ("irradiance", "environment_shadow"):
        methods[setting] = {method: ms * float(random.uniform(0.8, 1.2)) for method, ms in methods[setting].items()}
    return Costs(COSTS.base, methods, COSTS.scales)


@functools.cache
def least_error(budget: float) -> float | None:
    """Of settings that truly fit; None where none does."""
    try:
        return best_error(budget)
    except ValueError:
        return None


def run(kind: str, budget: float, seed: int) -> tuple[float, float, int]:
    """Share of seconds over 1.05 budgets, mean FLIP above the least, and changes, of one machine."""
    machine = Machine(budget, seed, known=costs_a_fifth_off(seed))
    random = np.random.default_rng(seed)
    machine.run(3.0)
    settled = machine.changes()
    over, above = [], []
    for second in range(SECONDS):
        if kind == "steps" and second % 4 == 0:
            machine.load = float(random.choice([0.5, 0.8, 1.0, 1.5, 2.0]))
        if kind == "drift":
            machine.load = 1.0 + 0.5 * float(np.sin(second / SECONDS * 4.0 * np.pi))
        machine.run(1.0, noise=0.1 if kind == "steady" else 0.2, slow=0.02 if kind == "spiky" else 0.0)
        over.append(machine.load * machine.cost(machine.shown) > 1.05 * budget)
        least = least_error(round(AIM * budget / machine.load, 1))
        if least is not None:
            above.append(sum(ERRORS[setting][method] for setting, method in machine.shown.items()) - least)
    return float(np.mean(over)), float(np.mean(above)), machine.changes() - settled


def recorded() -> Costs:
    """Costs of ``desk`` as they were measured."""
    kept = json.loads(RECORDED.read_text(encoding="utf-8"))
    return fill_between(Costs(**{name: kept[name] for name in ("base", "methods", "scales", "track", "work")}))


def machine_like(costs: Costs, seed: int) -> Costs:
    """A machine on which methods take up to ``OFF`` more or less than the costs say."""
    random = np.random.default_rng(1000 + seed)
    methods = {
        setting: {method: ms * float(random.uniform(1.0 - OFF, 1.0 + OFF)) for method, ms in own.items()}
        for setting, own in costs.methods.items()
    }
    return Costs(costs.base, methods, costs.scales)


def open_machine(budget: float, seed: int) -> Machine:
    """A machine like the one that was recorded."""
    costs = recorded()
    base = {setting.name: chosen(BASE_QUALITY, setting) for setting in SETTINGS if setting.name in costs.methods}
    errors = load_errors()
    return Machine(budget, seed, known=costs, truth=machine_like(costs, seed), running=base, errors=errors)


def is_top(machine: Machine, settings: Mapping[str, str]) -> bool:
    """Whether nothing errs less."""
    return abs(machine.controller.expected_error - machine.controller.choices[-1].error) < 1e-9


def settle(budget: float, seed: int) -> tuple[float, bool, int]:
    """Share of the budget that a steady machine takes in the end, whether that is the best, and late changes."""
    machine = open_machine(budget, seed)
    machine.run(STEADY_SECONDS, noise=0.1)
    late = [milliseconds for now, milliseconds, _ in machine.history if now > STEADY_SECONDS - LAST]
    return statistics.median(late) / budget, is_top(machine, machine.shown), machine.changes(SETTLED)


def settle_in_steps(budget: float, seed: int) -> list[tuple[float, bool, int]]:
    """The same at the end of every period of a load that steps; changes are those within the period."""
    machine = open_machine(budget, seed)
    random = np.random.default_rng(seed)
    machine.run(PERIOD, noise=0.1)
    found = []
    for _ in range(8):
        machine.load = float(random.choice([load for load in LOADS if load != machine.load]))
        start = machine.now
        machine.run(PERIOD, noise=0.1)
        late = [milliseconds for now, milliseconds, _ in machine.history if now > machine.now - LAST]
        found.append((statistics.median(late) / budget, is_top(machine, machine.shown), machine.changes(start)))
    return found


def tell(load: str, budget: float, runs: list[tuple[float, bool, int]]) -> None:
    shares = [share for share, _, _ in runs]
    within = [0.9 <= share <= 1.0 or (top and share <= 1.0) for share, top, _ in runs]
    line = {"bench": "budget", "load": load, "budget_ms": budget, "runs": len(runs)}
    settles = [round(float(value), 3) for value in (min(shares), statistics.median(shares), max(shares))]
    line |= {"settles": settles, "within": round(float(np.mean(within)), 3)}
    line |= {"at_the_top": round(float(np.mean([top for _, top, _ in runs])), 3)}
    print(json.dumps({**line, "changes": round(float(np.mean([n for _, _, n in runs])), 2)}), flush=True)


def main(device: str) -> None:
    del device  # nothing of it runs
    for kind in KINDS:
        runs = [run(kind, budget, seed) for budget in BUDGETS for seed in range(SEEDS)]
        over, above, changes = np.mean(runs, axis=0)
        line = {"bench": "budget", "load": kind, "runs": len(runs), "over_budget": round(over, 3)}
        print(json.dumps({**line, "flip_above_least": round(above, 4), "changes": round(changes, 1)}), flush=True)
    for budget in SETTLING:
        tell("steady", budget, [settle(budget, seed) for seed in range(SEEDS)])
        tell("stepping", budget, [run for seed in range(SEEDS) for run in settle_in_steps(budget, seed)])
