"""What viewers are told of scene and plan, as plain data; ``protocol`` has what they say."""

from __future__ import annotations

from typing import Any

from warp_ar.engine.graph import Plan
from warp_ar.errors import WarpArError
from warp_ar.output.report import left_out, stage_names
from warp_ar.stages import STAGES
from warp_ar.viewer.edits import Wanted, wanted_record


def notice(error: WarpArError) -> dict[str, Any]:
    """What could not be done, and why."""
    return {"type": "notice", "text": str(error), "bad": True}


def scene(wanted: Wanted, undo: str | None, redo: str | None) -> dict[str, Any]:
    """The scene as it is edited, and what can be undone and done again, in words."""
    return {"type": "scene", "scene": wanted_record(wanted), "undo": undo, "redo": redo}


def plan(plan: Plan | None, number: int, device: str) -> dict[str, Any]:
    """The stages that run, and why the others do not.

    Args:
        plan: What lights the frames; None while nothing does.
        number: Of the plan; frames name the one that they were lit by.
        device: What it runs on.
    """
    summaries = {kind.name: kind.summary for kind in STAGES} | {"track": "finds the marker and the camera's pose"}
    methods = {kind.name: list(kind.methods) for kind in STAGES if len(kind.methods) > 1}
    told: dict[str, Any] = {
        "type": "plan",
        "plan": number,
        "device": device,
        "quality": None,
        "run": [],
        "left_out": [],
    }
    if plan is None:
        return told
    quality = plan.request.quality
    run = [
        {
            "stage": name,
            "method": quality.method(name),
            "methods": methods.get(name, []),
            "summary": summaries[name],
        }
        for name in stage_names(plan)
    ]
    out = [{"stage": name, "reason": reason, "methods": methods.get(name, [])} for name, reason in left_out(plan)]
    return {**told, "quality": quality.name, "run": run, "left_out": out}
