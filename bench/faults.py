"""Errors of the picture by faults of a set-up, for ``python -m warp_ar.doctor``, measured on simulated faults.

The bundled desk is lit with its own numbers or frames, and with wrong ones. The error is the mean FLIP between both
pictures. ``python -m bench.faults`` writes the table of errors.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import warp_ar
from warp_ar.accuracy.metrics import flip_map
from warp_ar.scene import Scene, load_scene
from warp_ar.sources.sources import open_source

TABLE = Path(__file__).resolve().parents[1] / "warp_ar" / "checks" / "fault_errors.json"
FRAMES = 6
"""Number of lit frames; the last one is compared."""


def _ball(scene: Scene, **changes: Any) -> Scene:
    return dataclasses.replace(scene, probes=(dataclasses.replace(scene.probes[0], **changes),))


def _object(scene: Scene, **changes: Any) -> Scene:
    return dataclasses.replace(scene, objects=(dataclasses.replace(scene.objects[0], **changes),))


def _proxy(scene: Scene, off: float) -> Scene:
    moved = (dataclasses.replace(p, at=(p.at[0] + off, *p.at[1:])) if p.shape == "box" else p for p in scene.proxies)
    return dataclasses.replace(scene, proxies=tuple(moved))


def _camera(scene: Scene, **factors: float) -> Scene:
    values = {key: getattr(scene.camera, key) * factor for key, factor in factors.items()}
    return dataclasses.replace(scene, camera=dataclasses.replace(scene.camera, **values))


def _marker(scene: Scene, **changes: Any) -> Scene:
    return dataclasses.replace(scene, marker=dataclasses.replace(scene.marker, **changes))


def _scaled(gain: Any) -> Callable[[Any, int], Any]:
    return lambda image, _: np.clip(image * np.asarray(gain), 0, 255).astype(np.uint8)


def _over_ball(image: Any, paint: Callable[[Any], Any], share: float = 1.0) -> Any:
    """Return a picture in which the ball's disc, or a share of it from the left, is painted over.

    The disc has a fixed place, because the camera hardly moves in six frames.
    """
    mask = np.zeros(image.shape[:2], np.uint8)
    cv2.circle(mask, (186, 252), 32, 255, -1)
    mask[:, round(154 + 64 * share) :] = 0
    return np.where(mask[..., None] > 0, paint(image), image)


def smoothstep() -> Any:
    """Return an S-shaped tone curve as a table of 8-bit codes, (256,)."""
    x = np.arange(256) / 255.0
    return np.rint(255.0 * x * x * (3.0 - 2.0 * x)).astype(np.uint8)


SCENES: dict[str, tuple[str, Callable[[Scene], Scene]]] = {
    "units.ball": ("a radius of 35 m", lambda s: _ball(s, radius=35.0)),
    "units.card": ("a marker of 80 m", lambda s: _marker(s, size=80.0)),
    "ball.sunk": ("sunk by 15 mm", lambda s: _ball(s, center=(-0.12, 0.03, 0.0196))),
    "ball.place": ("10 mm off", lambda s: _ball(s, center=(-0.11, 0.03, 0.0346))),
    "ball.radius": ("10 % off", lambda s: _ball(s, radius=0.0385, center=(-0.12, 0.03, 0.0381))),
    "ball.unfound": ("240 mm off", lambda s: _ball(s, center=(0.12, 0.03, 0.0346))),
    "ball.on_card": ("on the card", lambda s: _ball(s, center=(0.0, 0.0, 0.0346))),
    "ball.reflectance": ("0.1 for 0.85", lambda s: _ball(s, reflectance=(0.1, 0.1, 0.1))),
    "camera.focal": ("3 % off", lambda s: _camera(s, fx=1.03, fy=1.03)),
    "camera.guessed": ("13 % off", lambda s: _camera(s, fx=0.866, fy=0.866)),
    "camera.field": ("a tenth of it", lambda s: _camera(s, fx=0.1, fy=0.1)),
    "camera.square": ("fy 5 % off", lambda s: _camera(s, fy=1.05)),
    "camera.center": ("20 % of the width off", lambda s: _camera(s, cx=1.4)),
    "camera.edges": ("fy 10 % off", lambda s: _camera(s, fy=1.1)),
    "marker.board": ("24 mm taken for 80", lambda s: _marker(s, size=0.08 * 80 / 24)),
    "card.white": ("0.3 for 0.85", lambda s: _marker(s, white=0.3)),
    "card.print": ("printed at 97 %", lambda s: _marker(s, size=0.08 / 0.97)),
    "proxy.edges": ("a box 20 mm off", lambda s: _proxy(s, 0.02)),
    "ball.outside": ("2 m off", lambda s: _ball(s, center=(2.0, 0.03, 0.0346))),
    "units.at": ("millimetres", lambda s: _object(s, at=(150.0, 55.0, 0.0))),
    "units.object": ("a scale of 26", lambda s: _object(s, scale=26.0)),
    "probe.none": ("no ball", lambda s: dataclasses.replace(s, probes=())),
}
PICTURES: dict[str, tuple[str, Callable[[Any, int], Any]]] = {
    "card.clipped": ("exposed 2.5 times as long", _scaled(1.7)),
    "ball.clipped": ("exposed 2.5 times as long", _scaled(1.7)),
    "card.dark": ("a thirtieth of the light", _scaled(0.2)),
    "card.contrast": ("haze of a third of clipping", lambda image, _: np.maximum(image // 2 + 110, image)),
    "camera.response": ("an S-shaped tone curve", lambda image, _: smoothstep()[image]),
    "camera.saturation": ("codes that end at 238", lambda image, _: np.minimum(image, 238)),
    "camera.drift": ("30 % of exposure", lambda image, k: _scaled(1 - 0.025 * k)(image, k)),
    "camera.balance": ("15 % of red", lambda image, k: _scaled([1 - 0.013 * k, 1, 1])(image, k)),
    "picture.blurred": ("by 4 pixels", lambda image, _: cv2.GaussianBlur(image, (0, 0), 4.0)),
    "ball.dull": ("a blurred mirror image", lambda i, _: _over_ball(i, lambda p: cv2.GaussianBlur(p, (0, 0), 12.0))),
    "ball.hidden": ("half of it", lambda i, _: _over_ball(i, lambda p: np.full_like(p, 90), 0.5)),
}
NOTHING = ("marker.unseen", "marker.other", "marker.mirrored", "picture.dark", "picture.clipped", "source.empty")
"""Findings with which nothing can be lit."""
ALSO_NOTHING = ("source.unreadable", "source.absent", "source.permission", "camera.aspect")


def lit(scene: Scene, images: list[Any], change: Callable[[Any, int], Any] | None = None) -> Any:
    """Return the last of some frames, lit.

    Args:
        scene: Scene to light.
        images: The frames.
        change: Function that changes each frame, given the frame and its index.
    """
    height, width = images[0].shape[:2]
    pipeline = warp_ar.Pipeline(scene, device="cpu", quality="low", size=(width, height))
    for k, image in enumerate(images):
        result = pipeline(image if change is None else change(image, k), time_seconds=k / 24)
    picture = np.array(result.image)
    pipeline.close()
    return picture


def main() -> None:
    scene = load_scene("desk")
    assert scene.source is not None
    with open_source(str(scene.source.path)) as source:
        images = [frame.image for frame in itertools.islice(source, FRAMES)]
    right = lit(scene, images)
    table = {name: {"fault": "all of it", "error": 1.0} for name in (*NOTHING, *ALSO_NOTHING)}
    for name, (fault, change) in SCENES.items():
        picture = lit(change(scene), images)
        table[name] = {"fault": fault, "error": round(float(flip_map(right, picture).mean()), 4)}
        print(name, table[name], flush=True)
    for name, (fault, spoil) in PICTURES.items():
        # Only the effect on virtual light is compared: the picture's own change by the fault is subtracted.
        before = spoil(images[-1], len(images) - 1).astype(float)
        added = lit(scene, images, spoil).astype(float) - before
        picture = np.clip(images[-1] + added, 0, 255).astype(np.uint8)
        table[name] = {"fault": fault, "error": round(float(flip_map(right, picture).mean()), 4)}
        print(name, table[name], flush=True)
    TABLE.write_text(json.dumps(dict(sorted(table.items())), indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
