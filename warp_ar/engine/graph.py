"""From what is asked for to the stages that must run, in order, and why the others do not.

Planning is pure Python: it reads the scene and the quality and touches neither Warp nor a frame.
"""

from __future__ import annotations

import dataclasses

from warp_ar.declared import checked
from warp_ar.stages import STAGES
from warp_ar.stages.base import LeftOut, Stage, Wiring
from warp_ar.stages.features import Features, find_features
from warp_ar.stages.request import Request

# What the pipeline itself provides for every frame.
INPUTS = ("frame", "linear_frame", "pose", "lights", "objects", "exposure", "clock", "short_frames", "captured_light")


@dataclasses.dataclass(frozen=True)
class Plan:
    """The stages of a request, in the order in which they run."""

    features: Features
    """Features that the request calls for."""
    stages: tuple[tuple[type[Stage], Wiring], ...]
    left_out: tuple[tuple[str, str], ...]
    """(stage, reason) of every stage that does not run."""
    inputs: tuple[str, ...]
    """The pipeline's own inputs that some stage or output needs."""

    @property
    def request(self) -> Request:
        """Request that the plan was made for."""
        return self.features.request

    def needs(self, name: str) -> bool:
        """Return whether some stage reads the input ``name`` or the caller asked for it."""
        return name in self.inputs


@checked
def make_plan(request: Request) -> Plan:
    """Wire in the stages that the request calls for, then walk back from the outputs and drop what nothing consumes.

    Raises:
        ValueError: An output that nothing produces was asked for, or a stage reads what no earlier stage writes.
    """
    features = find_features(request)
    wired: list[tuple[type[Stage], Wiring]] = []
    reasons: dict[str, str] = {}
    for stage in STAGES:
        wiring = stage.wire(features)
        if isinstance(wiring, LeftOut):
            reasons[stage.name] = wiring.reason
        else:
            wired.append((stage, wiring))

    # ``image`` without a producer is the frame itself.
    produced = {name for _, wiring in wired for name in wiring.writes}
    wanted = {("frame" if name == "image" and name not in produced else name) for name in request.resources}
    unknown = wanted - produced - set(INPUTS)
    if unknown:
        raise ValueError(f"outputs: nothing in this scene produces {', '.join(sorted(unknown))}")

    kept: list[tuple[type[Stage], Wiring]] = []
    for stage, wiring in reversed(wired):
        if wanted.isdisjoint(wiring.writes):
            reasons[stage.name] = stage.unread or f"nothing reads its {' or '.join(wiring.writes)}"
            continue
        kept.append((stage, wiring))
        wanted |= set(wiring.reads)
    kept.reverse()

    available = set(INPUTS)
    for stage, wiring in kept:
        missing = set(wiring.reads) - available
        if missing:
            raise ValueError(f"stage {stage.name!r} reads {', '.join(sorted(missing))}, which no earlier stage writes")
        available |= set(wiring.writes)
    order = {stage.name: index for index, stage in enumerate(STAGES)}
    left_out = tuple(sorted(reasons.items(), key=lambda item: order[item[0]]))
    return Plan(features, tuple(kept), left_out, tuple(name for name in INPUTS if name in wanted))
