"""All checks of a set-up, and a quick subset."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Final

from warp_ar.ball.ball_solve import find_outline, standing_ground
from warp_ar.ball.ground_seen import ground_is_seen
from warp_ar.checks.check_ball import LOST, check_balls, is_in_view
from warp_ar.checks.check_objects import check_objects, written_poses
from warp_ar.checks.check_pictures import Look, check_pictures, check_saturation, take_look
from warp_ar.checks.check_print import check_print
from warp_ar.checks.check_proxies import check_proxies
from warp_ar.checks.check_scene import check_scene
from warp_ar.checks.finding import Finding, worst_first
from warp_ar.errors import SceneError, SourceError
from warp_ar.scene import Camera, Pose, Scene
from warp_ar.sources.sources import open_source, source_of

FRAMES: Final = 120
"""Number of frames that the full check reads."""
FEW_VIEWS: Final = 5
"""Largest number of frames in which paper and modelled shapes are searched."""
QUICK_FRAMES: Final = 12
"""Number of frames that the quick check uses."""
SPREAD: Final = 96
"""Number of frames over which the quick check's frames are spread, to include drift and several views. Of pictures with
more than ``PIXELS`` pixels, fewer frames are read, so that the total number of pixels stays equal."""
_NOT_LOOKED: Final = ("source.", "units.", "marker.", "picture.", "camera.aspect", "ball.unfound", "ball.outside")
"""Prefixes of the names of findings with which a ball was not searched, or one of several balls was not visible."""
PIXELS: Final = 640 * 480
"""Number of pixels of a picture up to which ``SPREAD`` applies."""


def quick_check(scene: Scene, given: str | int | Path | None) -> tuple[list[Finding], bool]:
    """Check the first frames of a recorded source in about a second.

    Args:
        scene: The scene.
        given: Source of frames instead of the scene's own, or None.

    Returns:
        The findings, the worst first; and True if the scene has mirror balls and the frames show all of them.
    """
    source = source_of(scene, given)
    recorded = isinstance(source, Path) or (isinstance(source, str) and Path(source).exists())
    found, _ = check_and_look(scene, source if recorded else None, quick=True)
    seen = recorded and bool(scene.probes) and not any(finding.name.startswith(_NOT_LOOKED) for finding in found)
    return found, seen


def check_and_look(
    scene: Scene,
    source: str | int | Path | None,
    *,
    frames: int = FRAMES,
    quick: bool = False,
    tell: Callable[[str], object] | None = None,
) -> tuple[list[Finding], Look | None]:
    """Return the findings on a set-up, the worst first, and the frames that were read.

    Args:
        scene: The scene.
        source: Source of the frames; None: check the scene's numbers only.
        frames: Number of frames to read.
        quick: True to read only a few frames, which takes about a second.
        tell: Function to which a progress text for users is passed; the full check takes seconds.

    Returns:
        The findings, and the frames or None if none were read.
    """
    unread = []
    if source is not None:
        try:
            look = _read(scene, source, None if quick else frames, tell)
        except SourceError as error:
            unread = [Finding("source.unreadable", str(error), "check [source], or give --source")]
        except SceneError as error:
            unread = [Finding("camera.aspect", str(error), "python -m warp_ar.calibrate camera PICTURES")]
        else:
            if tell is not None:
                tell("looking at card, ball and light")
            return check_look(scene, look, 1 if quick else 4), look
    return worst_first([*check_scene(scene), *unread]), None


def _read(scene: Scene, source: str | int | Path, frames: int | None, tell: Callable[[str], object] | None) -> Look:
    """Return frames of a source, with the marker tracked in them.

    Args:
        scene: The scene.
        source: Source of the frames.
        frames: Number of frames to read; None: those of the quick check, which are read in a second.
        tell: Function to which a progress text for users is passed, or None.
    """
    own = scene.source
    exposures = own.exposures or () if own is not None else ()
    with open_source(source, exposures=exposures) as opened:
        every = 1
        if frames is None:
            width, height = opened.size
            spread = round(SPREAD * min(PIXELS / (width * height), 1.0))
            every = max(min(spread, opened.length or spread) // QUICK_FRAMES, 1)
            frames = every * QUICK_FRAMES
        return take_look(scene, opened, frames, every, tell)


def check_look(scene: Scene, look: Look, views: int = 4) -> list[Finding]:
    """Return the findings on a set-up whose frames were read before, the worst first.

    Args:
        scene: The scene.
        look: Frames of the scene.
        views: Largest number of frames in which each ball is searched; each takes about half a second.
    """
    before = check_scene(scene)
    return worst_first([*before, *_check_frames(scene, look, views, {finding.name for finding in before})])


def _check_frames(scene: Scene, look: Look, views: int, told: set[str]) -> list[Finding]:
    """Return the findings that frames show, except where the scene's numbers explain them already.

    Args:
        scene: The scene.
        look: Frames of the scene.
        views: Largest number of frames in which each ball is searched.
        told: Names of the findings on the scene's numbers.
    """
    if not scene.has_marker and look.images:
        # The scene gives the poses. Without a print, camera, light and ball cannot be checked.
        return check_objects(scene, look.camera, written_poses(scene))
    found = check_pictures(scene, look)
    if any(finding.name in ("marker.board", "marker.twice") for finding in found):
        return found  # poses by a wrong marker allow no conclusion on print, proxies and balls
    few = look.views[:: max(1, -(-len(look.views) // FEW_VIEWS))]
    found += [*check_print(scene.marker, look.camera, few), *check_proxies(scene, look.camera, few)]
    # If the scene's numbers are impossible, pictures add no information.
    if any(name.startswith("units.") for name in told):
        return found
    found += check_objects(scene, look.camera, [pose for _, pose in look.views])
    balls = check_balls(scene, look, views)
    if not any(finding.name in ("ball.outside", "ball.unfound") for finding in balls):
        found += check_saturation(scene, look)
    # The mirror image is darker than the direct view, so a wrong tone curve changes their ratio.
    known = {"ball.reflectance"} if {"camera.response", "card.contrast"} & {one.name for one in found} else set()
    known |= {"ball.place"} if "ball.sunk" in told else set()
    return [*found, *(finding for finding in balls if finding.name not in known)]


def ball_is_seen(scene: Scene, camera: Camera, views: Iterable[tuple[Any, Pose]]) -> bool:
    """Return True if any of some posed RGB frames shows any of the scene's mirror balls."""
    views = list(views)
    for probe in scene.probes:
        ground = standing_ground(probe, scene.proxies)
        if ground is not None and ground_is_seen(views, camera, probe, ground):
            continue  # the surface is visible in the ball's place; its edges may resemble a rim
        # Frames are tested only up to the first that shows the ball; each takes a third of a second.
        outlines = (find_outline(view, camera, probe) for view in views)
        if any(outline is not None and outline.support > LOST for outline in outlines):
            return True
    return False


def are_balls_missing(scene: Scene, given: str | int | Path | None) -> bool:
    """Return True if the first frames of a recording show the places of the mirror balls, but no ball.

    Args:
        scene: The scene.
        given: Source of frames instead of the scene's own, or None.

    Raises:
        SceneError: The camera was calibrated for another aspect ratio.
        SourceError: The frames cannot be read.
    """
    source = source_of(scene, given)
    if not scene.probes or not scene.has_marker or not isinstance(source, str | Path) or not Path(source).exists():
        return False
    look = _read(scene, source, None, None)
    views = [view for view in look.views if any(is_in_view(look, view[1], probe) for probe in scene.probes)]
    views = views[:: -(-len(views) // FEW_VIEWS) or 1]
    return bool(views) and not ball_is_seen(scene, look.camera, views)
