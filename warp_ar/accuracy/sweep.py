"""Every method of one setting, run on a case: what each costs and how far it is from the last one and the truth.

**A method's error.** Where the methods approximate one object that the last of them gives (``converges``), it is the
distance from the last: nearer to the truth than the exact light would be is luck, for something else is wrong then.
Where methods are models of their own, the distance from the truth, less that of the best. Distances are FLIP, summed
over the picture and divided by the pixels that anything virtual changes, so that errors of different settings are on
one scale.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Mapping, Sequence

import warp as wp

from warp_ar.accuracy.cases import Case, Image, Mask
from warp_ar.accuracy.cost_table import Setting, light_only, turn
from warp_ar.accuracy.costs import NOW_AND_THEN, open_profiled, worked_ms
from warp_ar.accuracy.metrics import ArrayError, array_error, changed_region, flip_map, latlong_weights
from warp_ar.accuracy.progress import Advance, ignore
from warp_ar.accuracy.runs import BASE, TIMED, WARM_UP, Clock, LightBefore, Outcome, run
from warp_ar.stages.quality import Quality

BRUTE_FORCE_UNITS = 8.0
"""Runs at usual methods that one by brute force takes about as long as."""
COST_NOISE = 0.03
"""Share by which costs must differ to be told apart."""
FLIP_NOISE = 2e-4
"""FLIP by which pictures must differ to be told apart."""
RMSE_NOISE = 0.02
"""Share by which errors of arrays must differ to be told apart."""
_FAIR: Mapping[str, Mapping[str, str]] = {
    "unwrap": {"environment_height": "32"},
    "environment_height": {"environment_shadow": "none", "recover": "white_card"},
}
"""Other methods at which a setting is turned: footprints on the ball matter where texels are coarse; what few rays of
another map happen to meet, and how its energy is shared among emitters, would hide what the map's own size does."""


@dataclasses.dataclass(frozen=True)
class Row:
    """One method of one setting in one case."""

    case: str
    setting: str
    method: str
    milliseconds: float
    stage_error: ArrayError | None
    """Against the last method; None where sizes differ."""
    flip: float
    """Mean FLIP of the picture per changed pixel."""
    against: str
    """``truth`` or ``last method``."""
    apart: float = 0.0
    """The same against the picture at the last method."""
    error: float = 0.0
    """Error that counts: ``apart`` where the setting converges or no truth is known, else ``flip`` above the best
    method's."""
    dominated: bool = False
    """Another method costs no more and errs no more."""


def picture_error(case: Case, reference: Mapping[int, Image], images: Mapping[int, Image]) -> float:
    """Sum of FLIP over the picture divided by the pixels that anything virtual changes, mean over compared frames."""
    return statistics.fmean(
        _flip_per_pixel(case, picture, images[index], region_of(case, index, picture))
        for index, picture in reference.items()
    )


def _apart(case: Case, reference: Mapping[int, Image], last: Mapping[int, Image], images: Mapping[int, Image]) -> float:
    """FLIP between two methods' pictures, divided as ``picture_error`` divides."""
    return statistics.fmean(
        _flip_per_pixel(case, last[index], images[index], region_of(case, index, picture))
        for index, picture in reference.items()
    )


def _flip_per_pixel(case: Case, a: Image, b: Image, region: Mask) -> float:
    errors = flip_map(a, b)
    return float((errors * region if case.darker else errors).sum()) / max(int(region.sum()), 1)


def region_of(case: Case, index: int, reference: Image) -> Mask:
    """Pixels of a frame that anything virtual, or the exposure, changes."""
    return case.regions[index] if index in case.regions else changed_region(case.frames[index].image, reference)


def run_units(method: str) -> float:
    """Units of work, in runs at a usual method, of a run at this one."""
    return BRUTE_FORCE_UNITS if method == "brute_force" else 1.0


def sweep(
    case: Case,
    setting: Setting,
    device: str,
    base: Quality = BASE,
    *,
    methods: Sequence[str] | None = None,
    timed: int = TIMED,
    clock: Clock = time.perf_counter,
    advance: Advance = ignore,
    before: LightBefore | None = None,
) -> tuple[list[Row], dict[str, Image]]:
    """Every method of one setting, or those named: its row, and its last picture.

    Args:
        case: Frames, and their truth if it is known.
        setting: What to turn.
        device: Where.
        base: What all other settings stay on.
        methods: Some of the setting's, in its order; None means all.
        timed: Last frames that run at a method, the first of them not timed; by brute force only the last does.
        clock: Seconds, on CPU.
        advance: Told of every method that has run.
        before: As that of ``run``.
    """
    outcomes: dict[str, Outcome] = {}
    for method in methods or setting.methods:
        turned = turn(base, {**_FAIR.get(setting.name, {}), setting.name: method})
        count = 1 if method == "brute_force" else timed
        between = light_only(turned)
        outcomes[method] = run(case, turned, device, setting, between=between, timed=count, clock=clock, before=before)
        advance(f"{case.name}: {setting.name} {method}", run_units(method))
    if setting.name == NOW_AND_THEN and wp.get_device(device).is_cpu:
        count_work(case, outcomes, device, clock)
    last = list(outcomes.values())[-1]
    common = set.intersection(*(set(outcome.stages) for outcome in outcomes.values())) - set(setting.stages)
    reference = case.truth or last.images
    rows = []
    for method, outcome in outcomes.items():
        own = {name: ms for name, ms in outcome.stages.items() if name not in common}
        rows.append(
            Row(
                case.name,
                setting.name,
                method,
                sum(own.values()),
                _stage_error(outcome, last),
                picture_error(case, reference, outcome.images),
                "truth" if case.truth else "last method",
                _apart(case, reference, last.images, outcome.images),
            )
        )
    best = min(row.flip for row in rows)
    own_scale = setting.converges or not case.truth
    rows = [dataclasses.replace(row, error=row.apart if own_scale else row.flip - best) for row in rows]
    rows = [dataclasses.replace(row, dominated=_is_dominated(row, rows)) for row in rows]
    return rows, {method: outcome.images[case.shown[-1]] for method, outcome in outcomes.items()}


def count_work(case: Case, outcomes: dict[str, Outcome], device: str, clock: Clock) -> None:
    """Charge methods that work on a thread of their own with what the process works more than for the cheapest.

    Frames only bring the light meanwhile, and follow each other as fast as they can: times between are the clip's.
    """
    work: dict[str, float] = {}
    for method, outcome in outcomes.items():
        with open_profiled(case.scene, device, light_only(outcome.quality), None, clock) as pipeline:
            for index, (frame, pose) in enumerate(zip(case.frames, case.poses, strict=True)):
                if index == min(WARM_UP, len(case.frames) - 1):
                    begun = time.process_time()
                pipeline(frame.image, time_seconds=frame.time, pose=pose)
        # Outside: what was begun beside the frames has ended then.
        work[method] = worked_ms((time.process_time() - begun) / max(len(case.frames) - WARM_UP, 1), clock)
    for method, outcome in outcomes.items():
        stages = {**outcome.stages, NOW_AND_THEN: work[method] - min(work.values())}
        outcomes[method] = dataclasses.replace(outcome, stages=stages)


def _is_dominated(row: Row, rows: Sequence[Row]) -> bool:
    """Return whether another method costs no more and errs no more, in the picture and in what the stage writes.

    What measurements cannot tell apart counts as equal; of equals the first in the methods stays.
    """

    def better(a: Row, b: Row) -> bool:
        cheaper = a.milliseconds < (1.0 - COST_NOISE) * b.milliseconds
        nearer = a.error < b.error - FLIP_NOISE
        mine, yours = (x.stage_error.relative_rmse if x.stage_error else 0.0 for x in (a, b))
        return cheaper or nearer or mine < (1.0 - RMSE_NOISE) * yours

    place = list(rows).index(row)
    return any(
        not better(row, other) and (better(other, row) or index < place)
        for index, other in enumerate(rows)
        if index != place
    )


def _stage_error(outcome: Outcome, last: Outcome) -> ArrayError | None:
    values, reference = outcome.output, last.output
    if values is None or reference is None or values.shape != reference.shape:
        return None
    is_map = reference.ndim == 3 and reference.shape[1] == 2 * reference.shape[0]
    return array_error(values, reference, latlong_weights(*reference.shape[:2]) if is_map else None)
