"""Start of a page or a run to files: a quick check of the scene, and the device."""

from __future__ import annotations

import argparse
from typing import Final

from warp_ar.errors import WarpArError, say
from warp_ar.scene import Scene, bundled_scenes

ALWAYS: Final = ("camera.guessed", "object.outside")
"""Findings that are always printed, besides the worst one."""


def say_quick_check(options: argparse.Namespace, scene: Scene) -> tuple[bool, str]:
    """Check the scene quickly; print guessed values, objects outside the picture and the worst other finding.

    A capture device is not checked: it cannot be opened twice, and the run needs it.

    Returns:
        True if the frames show a mirror ball of the scene; and the text of the worst finding, empty without one.
    """
    from warp_ar.checks.checkup import quick_check

    try:
        findings, ball_seen = quick_check(scene, options.source)
    except WarpArError:
        return False, ""  # the run meets the same error and reports it
    # The run itself reports findings that prevent its start.
    told = ("source.", "camera.aspect")
    found = [finding for finding in findings if not finding.name.startswith(told)]
    worst = [finding for finding in found if finding.name not in ALWAYS][:1]
    for finding in [*worst, *(finding for finding in found if finding.name in ALWAYS)]:
        more = f"; all findings: python -m warp_ar.doctor {options.scene}" if finding in worst else ""
        own = None if scene.path in bundled_scenes().values() else options.scene
        say(f"{finding.text}; to do: {finding.remedy_for(own)}{more}")
    return ball_seen, next((finding.text for finding in [*worst, *found]), "")


def start_device(name: str) -> None:
    """Start Warp, and create a CUDA device's context during the imports that follow.

    Args:
        name: ``auto``, ``cpu``, ``cuda`` or ``cuda:N``.
    """
    from warp_ar.device import open_ahead, start_warp

    start_warp()
    open_ahead(name)
