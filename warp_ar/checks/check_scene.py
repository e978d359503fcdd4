"""Checks of a scene's numbers without pictures: units, a ball below the table, an implausible lens."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

import numpy as np

from warp_ar.ball.ball_solve import ground_below
from warp_ar.calibration.card import card_size
from warp_ar.checks.finding import Finding
from warp_ar.scene import Camera, CharucoBoard, EmissiveMaterial, Light, Object, Probe, Proxy, Scene

LARGEST_BALL: Final = 0.3
"""Largest radius in metres of a mirror ball, including gazing globes."""
SMALLEST_BALL: Final = 0.003
"""Smallest radius in metres; a smaller ball covers only a few pixels."""
LARGEST_CARD: Final = 1.5
"""Largest side of a print, metres."""
SMALLEST_CARD: Final = 0.008
"""Smallest side in metres of a print that a camera can read."""
FARTHEST: Final = 5.0
"""Largest distance in metres from the card."""
FIELDS: Final = (12.0, 140.0)
"""Range of plausible horizontal fields of view of a pinhole camera, degrees."""
SQUARE: Final = 0.02
"""Largest relative difference of a pixel's sides."""
CENTRAL: Final = 0.15
"""Largest distance of the principal point from the picture's centre, relative to the width."""
SUNK: Final = 0.0015
"""Largest depth in metres of a ball's lowest point below the table: the card's thickness and a ruler's error."""


def check_scene(scene: Scene) -> list[Finding]:
    """Return the findings that need no picture."""
    found = [*_check_card(scene), *_check_camera(scene.camera)]
    for index, probe in enumerate(scene.probes):
        label = "[probe]" if len(scene.probes) == 1 else f"[[probe]] {index}"
        found += _check_ball(scene, probe, label)
    return [*found, *_check_items(scene)]


def _check_items(scene: Scene) -> Iterator[Finding]:
    """Yield findings on objects, lights and proxies."""
    emits = any(isinstance(item.material, EmissiveMaterial) for item in scene.objects)
    if scene.objects and not (scene.probes or scene.lights or scene.captured or emits):
        text = "the scene has neither a mirror ball nor a light nor captured light: its objects are black"
        yield Finding("probe.none", text, "add [probe] with center and radius")
    placed: dict[str, tuple[Object | Light | Proxy, ...]]
    placed = {"object": scene.objects, "light": scene.lights, "proxy": scene.proxies}
    for kind, items in placed.items():
        for index, item in enumerate(items):
            if (far := float(np.linalg.norm(item.at))) > FARTHEST:
                text = f"[[{kind}]] {index}: at is {far:g} m from the card{_in_metres(far, 1.0)}"
                yield Finding("units.at", text, "write metres")
    for index, item in enumerate(scene.objects):
        size = item.scale * max(item.radius, item.major_radius, *item.size)
        if size > FARTHEST:
            text = f"[[object]] {index}: {size:g} m large{_in_metres(size, 1.0)}"
            yield Finding("units.object", text, "write metres, or set scale")


def _in_metres(value: float, largest: float) -> str:
    """Return a phrase that guesses the intended unit of a value; empty if no unit is plausible.

    Args:
        value: Length that the scene states in metres.
        largest: Largest plausible length in metres.
    """
    for name, factor in (("centimetres", 0.01), ("millimetres", 0.001)):
        if value * factor <= largest:
            return f"; {value:g} {name} are {value * factor:g} m"
    return ""


def _check_card(scene: Scene) -> Iterator[Finding]:
    size, white = max(card_size(scene.marker)), scene.marker.white
    key = "board" if scene.marker.board is not None else "size"
    large = f"{size:g} m large{_in_metres(size, 0.5)}" if size > LARGEST_CARD else f"only {1e3 * size:g} mm large"
    if not SMALLEST_CARD <= size <= LARGEST_CARD:
        right = f"write [marker] {key} in metres, as measured on the print"
        yield Finding("units.card", f"[marker] {key}: the card is {large}", right)
    elif white < 0.5:
        text = f"[marker] white = {white:g}: paper reflects 0.75 to 0.95"
        yield Finding("card.white", text, "leave white out, or measure the paper")


def _check_camera(camera: Camera) -> Iterator[Finding]:
    measure = "python -m warp_ar.calibrate camera PICTURES"
    if camera.field_of_view is not None:
        text = f"the camera is guessed, with a field of view of {camera.field_of_view:g} degrees"
        yield Finding("camera.guessed", text, measure)
    field = math.degrees(2 * math.atan(0.5 * camera.width / camera.fx))
    if not FIELDS[0] <= field <= FIELDS[1]:
        text = f"[camera] fx = {camera.fx:g}: a field of view of {field:.0f} degrees at {camera.width} pixels"
        yield Finding("camera.field", text, f"write the focal length in pixels; {measure}")
    if (off := abs(camera.fy / camera.fx - 1)) > SQUARE:
        text = f"[camera] fx = {camera.fx:g} and fy = {camera.fy:g}: pixels {off:.0%} from square"
        yield Finding("camera.square", text, measure)
    middle = np.array([(camera.width - 1) / 2, (camera.height - 1) / 2])
    aside = float(np.abs(np.array([camera.cx, camera.cy]) - middle).max()) / camera.width
    if aside > CENTRAL:
        text = f"[camera] cx = {camera.cx:g}, cy = {camera.cy:g}: {aside:.0%} of the width from the picture's middle"
        yield Finding("camera.center", text, measure)


def _check_ball(scene: Scene, probe: Probe, label: str) -> Iterator[Finding]:
    radius, far = probe.radius, float(np.linalg.norm(probe.center))
    if not SMALLEST_BALL <= radius <= LARGEST_BALL:
        size = _in_metres(radius, 0.15) if radius > LARGEST_BALL else ": smaller than a pea"
        text = f"{label} radius = {radius:g} m{size}"
        yield Finding("units.ball", text, "write the radius in metres")
        return
    if far > FARTHEST:
        text = f"{label} center is {far:g} m from the card{_in_metres(far, 1.0)}"
        yield Finding("units.ball", text, "write the center in metres")
        return
    ground = ground_below(probe, scene.proxies)
    if ground is not None and probe.center[2] - radius - ground < -max(SUNK, 0.03 * radius):
        deep = 1e3 * (ground + radius - probe.center[2])
        text = f"{label} center: the ball is {deep:.1f} mm sunk into the table"
        right = f"its height on the table is {ground + radius:g}: center = [x, y, {ground + radius:g}]"
        yield Finding("ball.sunk", text, right)
    half = np.array(card_size(scene.marker)) / 2
    inside = np.abs(np.array(probe.center[:2])) < half - 0.2 * min(radius, *half)
    on_board = inside.all() and isinstance(scene.marker.board, CharucoBoard | None)
    if on_board and probe.center[2] < 3 * radius:
        text = f"{label} center: the ball stands on the printed marker and hides it"
        yield Finding("ball.on_card", text, "stand the ball beside the marker and measure its center")
    if max(probe.reflectance) < 0.2:
        text = f"{label} reflectance = {max(probe.reflectance):g}: a mirror ball has 0.4 to 0.95"
        yield Finding("ball.reflectance", text, "leave reflectance out, or measure it")
