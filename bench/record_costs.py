"""What every method costs on ``desk``, kept for ``python -m bench budget``: ``python -m bench.record_costs``.

Processor time of one thread over ``OVERLAP``, about what a frame takes on two cores with nothing else running; so it
can be recorded on a busy machine.
"""

from __future__ import annotations

import dataclasses
import json
import sys

from bench.bench_budget import RECORDED
from bench.write_cost_tables import OVERLAP, TRACKING_MS
from warp_ar.accuracy.cases import open_scene
from warp_ar.accuracy.cost_table import relevant_settings
from warp_ar.accuracy.costs import Costs, measure_costs

FRAMES = 12


def main() -> int:
    case = open_scene("desk", FRAMES)
    size = (case.scene.camera.width, case.scene.camera.height)
    found = measure_costs(
        case.scene, case.frames[-1].image, case.poses[-1], "cpu", size, relevant_settings(case.scene, size)
    )
    pace = (found.work / OVERLAP) / (found.base - found.track)  # by the clock it depends on what else runs
    methods = {name: {method: round(pace * ms, 4) for method, ms in own.items()} for name, own in found.methods.items()}
    costs = Costs(TRACKING_MS + found.work / OVERLAP, methods, found.scales, TRACKING_MS, found.work)
    RECORDED.write_text(json.dumps(dataclasses.asdict(costs), indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
