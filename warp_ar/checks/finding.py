"""Findings on a set-up as text: the fault, its effect, and the remedy."""

from __future__ import annotations

import dataclasses
import functools
import importlib.resources
import json
from typing import Any


@dataclasses.dataclass(frozen=True)
class Finding:
    """Fault of a set-up, or a value that is only assumed."""

    name: str
    """Name of the check, such as ``ball.radius``."""
    text: str
    """Description of the fault, with the value and allowed values."""
    remedy: str
    """Command, or key of the scene file, that removes the fault."""

    def remedy_for(self, scene: str | None) -> str:
        """Return the remedy with the scene's name inserted in commands; with None, commands keep a placeholder."""
        if scene is None:
            return self.remedy
        named = self.remedy.replace("calibrate camera PICTURES", f"calibrate camera PICTURES --write {scene}")
        named = named.replace("calibrate response PICTURES", f"calibrate response PICTURES --write {scene}")
        return named.replace("calibrate ball SCENE", f"calibrate ball {scene}")

    @property
    def error(self) -> float:
        """Mean FLIP between pictures lit with and without this fault, 0 to 1.

        It is 1 if the fault makes lighting impossible, and 0 if it was not measured.
        """
        return float(fault_errors().get(self.name, {"error": 0.0})["error"])

    @property
    def cost(self) -> str:
        """Effect of the fault on the picture, as text."""
        entry = fault_errors().get(self.name)
        if entry is None:
            return "not measured"
        if entry["error"] >= 1.0:
            return "nothing can be lit"
        return f"{entry['error']:.3f} FLIP ({entry['fault']})"


@functools.cache
def fault_errors() -> dict[str, Any]:
    """Return the table of simulated faults: by the name of a check, the ``fault`` and its ``error`` in FLIP."""
    text = importlib.resources.files("warp_ar.checks").joinpath("fault_errors.json").read_text(encoding="utf-8")
    return dict(json.loads(text))


def worst_first(findings: list[Finding]) -> list[Finding]:
    """Return findings sorted by their error, the worst first."""
    return sorted(findings, key=lambda finding: -finding.error)
