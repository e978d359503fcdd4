"""All checks of a set-up, and their quick half."""

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
"""Frames that are looked at."""
FEW_VIEWS: Final = 5
"""Views in which paper and modelled shapes are looked for."""
QUICK_FRAMES: Final = 12
"""Frames that the quick half looks at."""
SPREAD: Final = 96
"""Frames of ``PIXELS`` over which these are spread: drifts, and views from several sides, take seconds."""
_NOT_LOOKED: Final = ("source.", "units.", "marker.", "picture.", "camera.aspect", "ball.unfound", "ball.outside")
"""Beginnings of findings after which a ball was not looked for, or one of several not seen."""
PIXELS: Final = 640 * 480
"""Pixels of a picture above which fewer frames are read, for the same total."""


def check_up(scene: Scene, source: str | int | Path | None, *, quick: bool = False) -> list[Finding]:
    """Return what is wrong with a set-up, the worst first; arguments as those of `check_and_look`."""
    return check_and_look(scene, source, quick=quick)[0]


def quick_check(scene: Scene, given: str | int | Path | None) -> tuple[list[Finding], bool]:
    """Look at a set-up's first frames, if they were recorded, for about a second.

    Args:
        scene: The scene.
        given: Its frames, unless they are the scene's own.

    Returns:
        The findings, the worst first, and True if a frame shows every mirror ball of the scene, which has one.
    """
    source = source_of(scene, given)
    recorded = isinstance(source, Path) or (isinstance(source, str) and Path(source).exists())
    found = check_up(scene, source if recorded else None, quick=True)
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
    """Return what is wrong with a set-up, the worst first, and what its frames show: they need not be read twice.

    Args:
        scene: The scene.
        source: The frames; None: look at the scene's numbers alone.
        frames: How many to look at.
        quick: Look at a few only, which takes about a second.
        tell: Told, for people, what is looked at: all of it takes seconds.

    Returns:
        The findings, and None in the look's place where no frames were read.
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
    """Frames of a source; for None as many as are looked at in a second, from all over its beginning."""
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
    """Return what is wrong with a set-up whose frames were looked at already, the worst first.

    Args:
        scene: The scene.
        look: What its frames show.
        views: In how many frames the ball is looked for, each about half a second.
    """
    before = check_scene(scene)
    return worst_first([*before, *_check_frames(scene, look, views, {finding.name for finding in before})])


def _check_frames(scene: Scene, look: Look, views: int, told: set[str]) -> list[Finding]:
    """Return what frames tell beside what the scene's own numbers have told."""
    if not scene.has_marker and look.images:
        # Its poses are written down: no print is there to tell camera, light and ball by.
        return check_objects(scene, look.camera, written_poses(scene))
    found = check_pictures(scene, look)
    if any(finding.name in ("marker.board", "marker.twice") for finding in found):
        return found  # poses by another marker say nothing about prints, proxies and balls
    few = look.views[:: max(1, -(-len(look.views) // FEW_VIEWS))]
    found += [*check_print(scene.marker, look.camera, few), *check_proxies(scene, look.camera, few)]
    # Where the scene's own numbers cannot be, a picture says nothing more about them.
    if any(name.startswith("units.") for name in told):
        return found
    found += check_objects(scene, look.camera, [pose for _, pose in look.views])
    balls = check_balls(scene, look, views)
    if not any(finding.name in ("ball.outside", "ball.unfound") for finding in balls):
        found += check_saturation(scene, look)
    # What is mirrored is darker than what is seen directly: another curve changes their ratio.
    known = {"ball.reflectance"} if {"camera.response", "card.contrast"} & {one.name for one in found} else set()
    known |= {"ball.place"} if "ball.sunk" in told else set()
    return [*found, *(finding for finding in balls if finding.name not in known)]


def ball_is_seen(scene: Scene, camera: Camera, views: Iterable[tuple[Any, Pose]]) -> bool:
    """Return whether any of some posed RGB frames shows any of the scene's mirror balls."""
    views = list(views)
    for probe in scene.probes:
        ground = standing_ground(probe, scene.proxies)
        if ground is not None and ground_is_seen(views, camera, probe, ground):
            continue  # edges of what lies there may look like a rim
        # Frame by frame, up to the first that does: looking takes a third of a second.
        outlines = (find_outline(view, camera, probe) for view in views)
        if any(outline is not None and outline.support > LOST for outline in outlines):
            return True
    return False


def are_balls_missing(scene: Scene, given: str | int | Path | None) -> bool:
    """Return whether the first frames of a recording show where the mirror balls should be, and none is there.

    Args:
        scene: The scene.
        given: Its frames, unless they are the scene's own.

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
