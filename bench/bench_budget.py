"""The budget's controller on pretended machines: time over the budget, error, changes, by kind of load."""

from __future__ import annotations

import functools
import json

import numpy as np

from tests.test_budget import COSTS, ERRORS, Machine, best_error
from warp_ar.accuracy.budget import AIM
from warp_ar.accuracy.costs import Costs

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


def main(device: str) -> None:
    del device  # nothing of it runs
    for kind in KINDS:
        runs = [run(kind, budget, seed) for budget in BUDGETS for seed in range(SEEDS)]
        over, above, changes = np.mean(runs, axis=0)
        line = {"bench": "budget", "load": kind, "runs": len(runs), "over_budget": round(over, 3)}
        print(json.dumps({**line, "flip_above_least": round(above, 4), "changes": round(changes, 1)}), flush=True)
