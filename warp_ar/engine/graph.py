"""Planning: from a request to the stages that must run, in order, with a reason for each stage that does not.

Planning reads the scene and the quality. It uses neither Warp nor a frame.
"""

from __future__ import annotations

import dataclasses

from warp_ar.declared import checked
from warp_ar.stages import STAGES
from warp_ar.stages.base import LeftOut, Stage, Wiring
from warp_ar.stages.features import Features, find_features
from warp_ar.stages.request import Request

# Resources that the pipeline itself provides for every frame.
INPUTS = ("frame", "linear_frame", "pose", "lights", "objects", "exposure", "clock", "short_frames", "captured_light")


@dataclasses.dataclass(frozen=True)
class Plan:
    """Stages of a request, in the order in which they run."""

    features: Features
    """Features of the request."""
    stages: tuple[tuple[type[Stage], Wiring], ...]
    """Stages, each with the resources that it reads and writes."""
    left_out: tuple[tuple[str, str], ...]
    """Pairs (stage, reason) of the stages that do not run."""
    inputs: tuple[str, ...]
    """Inputs from the pipeline that a stage or an output needs."""

    @property
    def request(self) -> Request:
        """Request from which the plan was made."""
        return self.features.request

    def needs(self, name: str) -> bool:
        """Return True if the input ``name`` is an output or is read by a stage."""
        return name in self.inputs


@checked
def make_plan(request: Request) -> Plan:
    """Return the plan of a request.

    Each stage states the resources that it reads and writes. Stages whose outputs nothing reads are then dropped, from
    the request's outputs backwards.

    Raises:
        ValueError: No stage produces an output, or a stage reads a resource that no earlier stage writes.
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

    # Without a stage that writes ``image``, the output is the input frame.
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
