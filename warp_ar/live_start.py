"""What pictures on a page and frames in files begin with: a quick check of the set-up, and compilers put to work."""

from __future__ import annotations

import argparse
from typing import Final

from warp_ar.errors import WarpArError, say
from warp_ar.scene import Scene, bundled_scenes
from warp_ar.scene.scene_files import files_of

ALWAYS: Final = ("camera.guessed", "object.outside")
"""Findings that are said beside the worst."""


def say_quick_check(options: argparse.Namespace, scene: Scene) -> bool:
    """Say in one line each what is guessed, what lies outside the picture, and the worst of what else is wrong.

    Frames of a capture device are left to the run itself: a device is not opened twice.

    Returns:
        Whether a mirror ball was seen where the scene has one.
    """
    from warp_ar.checks.quick_check import quick_check

    try:
        checked = quick_check(scene, options.source, files_of(scene))
    except WarpArError:
        return False  # the run meets it too, and says it
    # What the run itself cannot start with, it says itself.
    told = ("source.", "camera.aspect")
    found = [finding for finding in checked.findings if not finding.name.startswith(told)]
    worst = [finding for finding in found if finding.name not in ALWAYS][:1]
    for finding in [*worst, *(finding for finding in found if finding.name in ALWAYS)]:
        more = f"; all there is to say: python -m warp_ar.doctor {options.scene}" if finding in worst else ""
        own = None if scene.path in bundled_scenes().values() else options.scene
        say(f"{finding.text}; to do: {finding.remedy_for(own)}{more}")
    return checked.ball_seen


def hurry_compilers(device: str) -> None:
    """Start Warp; what can be done for its compilers beside the imports that follow, and before them, is."""
    import warp as wp

    from warp_ar.device import open_ahead, start_warp
    from warp_ar.engine.modules import parse_headers_ahead
    from warp_ar.engine.nvrtc import compile_beside
    from warp_ar.engine.tiers import begin_quickly
    from warp_ar.engine.translation import take_shortcuts

    start_warp()
    open_ahead(device)
    take_shortcuts()
    begin_quickly()
    compile_beside()
    if device == "cpu" or not wp.is_cuda_available():
        parse_headers_ahead()
