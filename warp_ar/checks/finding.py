"""Faults of a set-up in words: what was found, what it spoils, what to do."""

from __future__ import annotations

import dataclasses
import functools
import importlib.resources
import json
from typing import Any


@dataclasses.dataclass(frozen=True)
class Finding:
    """A fault of the set-up, or a guess."""

    name: str
    """Name of the check that found it, such as ``probe.radius``."""
    text: str
    """Description of what was found, with the value and what would be right."""
    remedy: str
    """Remedy: a command, or a key of the scene file."""

    def remedy_for(self, scene: str | None) -> str:
        """Return what to do, with the scene's own name where a command takes it; None: it is not written into."""
        if scene is None:
            return self.remedy
        named = self.remedy.replace("calibrate camera PICTURES", f"calibrate camera PICTURES --write {scene}")
        named = named.replace("calibrate response PICTURES", f"calibrate response PICTURES --write {scene}")
        return named.replace("calibrate ball SCENE", f"calibrate ball {scene}")

    @property
    def error(self) -> float:
        """Mean FLIP of a picture lit with this fault against one lit without, 0 to 1; 1 where nothing can be lit."""
        return float(fault_errors().get(self.name, {"error": 0.0})["error"])

    @property
    def cost(self) -> str:
        """Return what it spoils, in words."""
        entry = fault_errors().get(self.name)
        if entry is None:
            return "not measured"
        if entry["error"] >= 1.0:
            return "nothing can be lit"
        return f"{entry['error']:.3f} FLIP ({entry['fault']})"


@functools.cache
def fault_errors() -> dict[str, Any]:
    """The table of simulated faults: by the check's name, the fault and the error that it caused."""
    text = importlib.resources.files("warp_ar.checks").joinpath("fault_errors.json").read_text(encoding="utf-8")
    return dict(json.loads(text))


def worst_first(findings: list[Finding]) -> list[Finding]:
    """Findings by what they spoil, the worst first."""
    return sorted(findings, key=lambda finding: -finding.error)
