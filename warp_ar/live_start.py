"""Start of a page and of a run to files: a quick check of the set-up, and the device."""

from __future__ import annotations

import argparse
from typing import Final

from warp_ar.errors import WarpArError, say
from warp_ar.scene import Scene, bundled_scenes

ALWAYS: Final = ("camera.guessed", "object.outside")
"""Findings that are said beside the worst."""


def say_quick_check(options: argparse.Namespace, scene: Scene) -> tuple[bool, str]:
    """Say in one line each what is guessed, what lies outside the picture, and the worst of what else is wrong.

    Frames of a capture device are left to the run itself: a device is not opened twice.

    Returns:
        True if a mirror ball was seen where the scene has one, and the worst finding in words.
    """
    from warp_ar.checks.checkup import quick_check

    try:
        findings, ball_seen = quick_check(scene, options.source)
    except WarpArError:
        return False, ""  # the run meets it too, and says it
    # What the run itself cannot start with, it says itself.
    told = ("source.", "camera.aspect")
    found = [finding for finding in findings if not finding.name.startswith(told)]
    worst = [finding for finding in found if finding.name not in ALWAYS][:1]
    for finding in [*worst, *(finding for finding in found if finding.name in ALWAYS)]:
        more = f"; all there is to say: python -m warp_ar.doctor {options.scene}" if finding in worst else ""
        own = None if scene.path in bundled_scenes().values() else options.scene
        say(f"{finding.text}; to do: {finding.remedy_for(own)}{more}")
    return ball_seen, next((finding.text for finding in [*worst, *found]), "")


def start_device(name: str) -> None:
    """Start Warp, and make a CUDA device's context beside the imports that follow.

    Args:
        name: As for ``resolve_device``.
    """
    from warp_ar.device import open_ahead, start_warp

    start_warp()
    open_ahead(name)
