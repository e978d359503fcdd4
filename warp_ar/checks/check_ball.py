"""Checks of a scene's mirror ball in its frames."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from warp_ar.ball.ball import explains_better
from warp_ar.ball.ball_finder import find_ball
from warp_ar.ball.ball_reflectance import REFLECTANCE, measure_reflectance
from warp_ar.ball.ball_solve import BallSolution, agreeing_outlines, rough_circle, solve_ball, standing_ground
from warp_ar.ball.ground_seen import ground_is_seen
from warp_ar.calibration.saturation import ball_codes
from warp_ar.checks.check_pictures import Look
from warp_ar.checks.finding import Finding
from warp_ar.errors import UsageError
from warp_ar.scene import Camera, Marker, Pose, Probe, Scene
from warp_ar.scene.pixel_rays import project
from warp_ar.tracking.markers import pattern_of

Image = NDArray[np.uint8]

SMALL: Final = 14.0
"""Radius in pixels below which a ball resolves too little of the environment."""
INNER: Final = 0.8
"""Share of the ball's radius within which its pixels are tested."""
CLIPPED: Final = 0.2
"""Largest share of clipped pixels in the ball: reflections of lamps and windows may clip, those of walls must not."""
DULL: Final = 0.10
"""Ratio of standard deviation to mean of the 8-bit codes inside the ball, below which it shows no reflections."""
RADIUS: Final = 0.03
"""Relative difference between the radius that the outlines give and the scene's, beyond which they contradict. The
difference must also exceed three standard deviations."""
PLACE: Final = 0.15
"""Largest error of the scene's centre, relative to the radius, if an outline is visible."""
SEEN: Final = 0.46
"""Smallest visible share of the outline of an unoccluded ball.

Unoccluded balls have 0.50 to 0.97, because parts of the rim may resemble the background. A half hidden ball has 0.44.
"""
SIDES: Final = 6
"""Largest number of frames in which it is tested whether the surface below the ball is visible where the ball should
be."""
LOST: Final = 0.35
"""Visible share of the outline below which there is no ball."""


def check_balls(scene: Scene, look: Look, views: int = 4) -> list[Finding]:
    """Return the findings for every mirror ball.

    Args:
        scene: Scene with the balls.
        look: Frames of the scene.
        views: Largest number of frames in which outlines are searched.
    """
    if not look.views:
        return []
    few = look.views[:: -(-len(look.views) // views)]
    found = []
    for index, probe in enumerate(scene.probes):
        label = "[probe]" if len(scene.probes) == 1 else f"[[probe]] {index}"
        found += _check_ball(scene, look, few, probe, label)
    return found


def inside_contrast(views: Sequence[tuple[Image, Pose]], camera: Camera, probe: Probe) -> float:
    """Return the standard deviation of codes over their mean inside a ball's outline, as the median over frames.

    It is below ``DULL`` for paper and paint, and 0 if no frame shows the ball's place.
    """
    circles = [(image, rough_circle(camera, pose, probe)) for image, pose in views]
    parts = [disc_contrast(image, circle) for image, circle in circles if circle is not None]
    return float(np.median(parts)) if parts else 0.0


def disc_contrast(image: Image, circle: tuple[float, float, float]) -> float:
    """Return the standard deviation of codes over their mean inside a circle (x, y, radius) in pixels."""
    part = ball_codes(image, [circle], INNER).astype(float)
    return float(part.std() / max(part.mean(), 1.0)) if len(part) else 0.0


def _check_ball(
    scene: Scene, look: Look, views: tuple[tuple[Image, Pose], ...], probe: Probe, label: str
) -> list[Finding]:
    circles = [(image, rough_circle(look.camera, pose, probe)) for image, pose in views]
    seen = [(image, circle) for image, circle in circles if circle is not None and _inside(look, circle)]
    if not seen:
        text = f"{label}: the ball is outside the picture"
        return [Finding("ball.outside", text, "move camera or ball until all of it is in view; check center")]
    ground = standing_ground(probe, scene.proxies)
    contrast = float(np.median([disc_contrast(*one) for one in seen]))
    spread = look.views[:: -(-len(look.views) // SIDES)]
    if ground is not None and ground_is_seen(spread, look.camera, probe, ground):
        return [_why_lost(scene.marker, look, views, label, contrast)]
    outlines = [pair for pair in agreeing_outlines(views, look.camera, probe, ground) if pair[0].support > LOST]
    if len(outlines) < max(1, len(seen) // 2):
        return [_why_lost(scene.marker, look, views, label, contrast)]
    found = []
    solution = solve_ball(outlines, look.camera, probe, ground)
    pixels = float(np.median([outline.radius for outline, _ in outlines]))
    if pixels < SMALL:
        text = f"{label}: the ball is {2 * pixels:.0f} pixels wide; expected {2 * SMALL:.0f} or more"
        found.append(Finding("ball.small", text, "move the camera nearer, or use a larger ball"))
    insides = [ball_codes(image, [circle], INNER).min(-1) >= 250 for image, circle in seen]
    clipped = float(np.median([part.mean() for part in insides if len(part)]))
    if clipped > CLIPPED:
        text = f"{label}: {clipped:.0%} of the ball clips; walls should not"
        found.append(Finding("ball.clipped", text, "set a shorter exposure, or [source] exposures"))
    if contrast < DULL:
        text = f"{label}: the ball shows no reflections ({contrast:.0%} contrast inside it): painted, dusty or dull"
        found.append(Finding("ball.dull", text, "wipe it, or use a polished ball"))
    support = float(np.median([outline.support for outline, _ in outlines]))
    if support < SEEN:
        text = f"{label}: only {support:.0%} of the ball's outline is seen"
        found.append(Finding("ball.hidden", text, "take away what is in front of the ball"))
    off = _compare(probe, solution, label)
    others = [other for other in scene.probes if other is not probe]
    seen_ball = dataclasses.replace(probe, center=solution.center, radius=solution.radius)
    # If the scene's ball explains its mirror image better than the solution does, the outlines are other edges.
    if off and explains_better(views, look.camera, probe, seen_ball, scene.proxies, others):
        off = []
    return [*found, *(off or _check_reflectance(scene, look, views, probe, label))]


def _check_reflectance(
    scene: Scene, look: Look, views: Sequence[tuple[Image, Pose]], probe: Probe, label: str
) -> list[Finding]:
    """Return a finding if the ball's mirror image is too bright or too dark for its reflectance."""
    measured = [measure_reflectance(scene, look.camera, probe, view, look.table) for view in views]
    told = [one for one in measured if one is not None]
    if not told or 2 * len(told) < len(views):
        return []
    found = np.median([one.reflectance for one in told], axis=0)
    if abs(float(np.log(found / np.array(probe.reflectance)).mean())) < REFLECTANCE:
        return []
    red, green, blue = np.minimum(found, 1.0)
    text = (
        f"{label} reflectance = {float(np.mean(probe.reflectance)):.2g}: surfaces next to the ball are "
        f"{float(found.mean()):.2f} times as bright in its reflection as seen directly"
    )
    remedy = f"write reflectance = [{red:.2f}, {green:.2f}, {blue:.2f}], or wipe the ball"
    return [Finding("ball.reflectance", text, remedy)]


def _compare(probe: Probe, solution: BallSolution, label: str) -> list[Finding]:
    """Return the findings on differences between a ball found in pictures and the scene's.

    Args:
        probe: The scene's ball.
        solution: The ball that explains the outlines.
        label: Name of the ball in messages.
    """
    command = "python -m warp_ar.calibrate ball SCENE --write"
    if not solution.radius_assumed:
        off = solution.radius - probe.radius
        if abs(off) > max(RADIUS * probe.radius, 3 * solution.radius_deviation):
            text = (
                f"{label} radius = {probe.radius:g}: outline and card together give {solution.radius:.4f} "
                f"+/- {2 * solution.radius_deviation:.4f} m"
            )
            remedy = f"measure ball, card and the print's rulers; {command}"
            return [Finding("ball.radius", text, remedy)]
    moved = np.subtract(solution.center, probe.center)
    allowed = np.maximum(PLACE * probe.radius, 3 * np.array(solution.center_deviation))
    if (np.abs(moved) > allowed).any():
        x, y, z = solution.center
        text = f"{label} center is {1e3 * float(np.linalg.norm(moved)):.0f} mm from where the ball is seen"
        return [Finding("ball.place", text, f"center = [{x:.4f}, {y:.4f}, {z:.4f}]; {command}")]
    return []


def is_in_view(look: Look, pose: Pose, probe: Probe) -> bool:
    """Return True if a ball's centre is in the picture for a camera pose, or at most half a radius outside it."""
    circle = rough_circle(look.camera, pose, probe)
    return circle is not None and _inside(look, circle)


def _inside(look: Look, circle: tuple[float, float, float]) -> bool:
    x, y, r = circle
    return -0.5 * r < x < look.camera.width + 0.5 * r and -0.5 * r < y < look.camera.height + 0.5 * r


def is_printed(marker: Marker, camera: Camera, pose: Pose, circle: tuple[float, float, float]) -> bool:
    """Return True if a circle (x, y, radius) in pixels is inside the picture of the printed marker or board."""
    outline = project(camera, pose.apply(pattern_of(marker).outline))
    if not np.isfinite(outline).all():
        return False
    x, y, radius = circle
    return cv2.pointPolygonTest(outline.astype(np.float32), (x, y), measureDist=True) > 0.9 * radius


def _why_lost(
    marker: Marker, look: Look, views: tuple[tuple[Image, Pose], ...], label: str, contrast: float
) -> Finding:
    """Return the finding on a ball that is not seen, and its likely cause: it is elsewhere, painted or absent.

    Args:
        marker: The scene's marker.
        look: Frames of the scene.
        views: Frames in which the ball was searched.
        label: Name of the ball in messages.
        contrast: Contrast at the ball's place, as returned by ``disc_contrast``.
    """
    command = "check center and radius, and that nothing hides the ball"
    if contrast < 0.5 * DULL:
        text = f"{label}: the picture of the ball shows no reflections: it is painted, covered or not there"
        return Finding("ball.unfound", text, command)
    text = f"{label}: no ball is seen where the scene has it"
    with contextlib.suppress(UsageError):
        outline = find_ball(views[0][0], look.camera)
        if not is_printed(marker, look.camera, views[0][1], (*outline.center, outline.radius)):
            x, y = outline.center
            text += f"; there may be one at ({x:.0f}, {y:.0f}), {2 * outline.radius:.0f} pixels wide"
    return Finding("ball.unfound", text, command)
