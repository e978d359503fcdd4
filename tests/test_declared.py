"""Every argument of the public constructors and functions is checked where it is given, and named with its value."""

from __future__ import annotations

import dataclasses
import fractions
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import warp_ar
import warp_ar.scene as sc
from tests.test_pipeline import make_scene
from warp_ar.engine.switcher import Target
from warp_ar.errors import UsageError, WarpArError

HALF = (0.5, 0.5, 0.5)
FACING = {"camera": sc.Camera(320, 240, 300.0, 300.0, 160.0, 120.0)}
MAP, SHARE = np.ones((8, 16, 3), np.float32), np.ones((8, 16), np.float32)
RUN: dict[str, Any] = {"outputs": ("image",), "quality": "paper", "device": "cpu"}

GOOD: list[tuple[Callable[..., Any], dict[str, Any]]] = [
    (warp_ar.Pose, {"rotation": np.eye(3), "translation": HALF}),
    (warp_ar.Quality, dataclasses.asdict(warp_ar.PRESETS["low"])),
    (warp_ar.Light, {"radiance": MAP, "confidence": SHARE, "emitters": (), "white_level": 1.0, "lower_bound": 0.0}),
    (warp_ar.Light(MAP, SHARE).save, {"path": "a.exr", "axes": "z-up"}),
    (warp_ar.Light.load, {"path": "a.exr", "axes": None}),
    (warp_ar.open_source, {"spec": "synthetic:card", "fps": None, "loop": False, "exposures": ()}),
    (warp_ar.open_sink, {"path": "a", "fps": 9.0, "size": None, "tick": fractions.Fraction(1, 9), "coding": "8bit"}),
    (warp_ar.read_environment, {"path": "a.exr", "axes": None}),
    (warp_ar.write_environment, {"path": "b.exr", "axes": "z-up", "overwrite": False}),
    (warp_ar.make_plan, {"request": None}),
    (warp_ar.Tracker, {"marker": sc.Marker(), **FACING, "hold": 0.2, "steady": True}),
    (warp_ar.Pipeline, {"scene": make_scene(), "size": None, "bands": None, "estimates": "delayed", **RUN}),
    (warp_ar.Pipeline, {"scene": make_scene(), "exposures": (), "shown": None, "linear": False, **RUN}),
    (warp_ar.Session, {"scene": "desk", "source": None, "calibration": None, "light": None, "budget_ms": None, **RUN}),
    (warp_ar.PipelineSwitcher, {"builder": None, "keep": 0}),
    (Target, {"scene": make_scene(), "quality": warp_ar.PRESETS["low"], "size": None, "exposures": ()}),
    (warp_ar.load_scene, {"path_or_name": "desk", "files": None}),
    (sc.loads_scene, {"text": warp_ar.dumps_scene(make_scene()), "path": None, "files": None}),
    (warp_ar.dumps_scene, {"scene": make_scene(), "folder": None}),
    (sc.load_calibration, {"path": "a.yml", "transfer": "srgb"}),
    (warp_ar.Scene, {field.name: getattr(make_scene(), field.name) for field in dataclasses.fields(sc.Scene)}),
    (sc.PoseSpec, {"poses": (((1.0,) * 9, HALF),), "file": None, "names": ()}),
    (warp_ar.capture_light, {"paths": ["a.jpg"], "ball": None, "shown": None, "focal_35mm": None, "reflectance": None}),
]
WRONG = (object(), 1j, math.nan, b"abc", {}, (math.nan,) * 3, np.full((2, 5), np.nan))
"""What no parameter takes."""


@pytest.mark.parametrize(
    ("call", "good", "name"),
    [pytest.param(call, good, name, id=f"{call.__qualname__}-{name}") for call, good in GOOD for name in good],
)
def test_what_cannot_be_is_named(call: Callable[..., Any], good: dict[str, Any], name: str) -> None:
    for wrong in WRONG:
        with pytest.raises(UsageError, match=rf"\b{name}\b"):
            call(**{**good, name: wrong})


def test_maps_and_poses_have_their_shapes() -> None:
    for radiance, confidence in (
        (MAP[:, :9], SHARE),
        (MAP, SHARE[:3]),
        (MAP * math.nan, SHARE),
        (MAP.astype(int), SHARE),
    ):
        with pytest.raises(UsageError, match=r"Light: (radiance|confidence)"):
            warp_ar.Light(radiance, confidence)
    for height, samples in ((0, 4), (8192, 4), (64, 3)):
        with pytest.raises(UsageError, match=r"Quality: (environment_height|edge_samples) = "):
            dataclasses.replace(warp_ar.PRESETS["low"], environment_height=height, edge_samples=samples)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: warp_ar.Frame(0, math.nan, np.zeros((4, 4, 3), np.uint8)), r"Frame: time = nan: expected a finite"),
        (lambda: warp_ar.Frame(0, 0.0, None), r"Frame: image = None: expected ndarray"),
        (lambda: warp_ar.Scene(FACING["camera"], name=""), r"Scene: name = '': expected some text"),
        (sc.SourceSpec, r"SourceSpec: path = None: expected exactly one of path, camera and synthetic"),
        (lambda: sc.SourceSpec(camera=0, synthetic="card"), r"synthetic = 'card': camera is given too"),
        (lambda: warp_ar.write_environment("b.exr", MAP * np.inf), r"384 values that are NaN or infinite"),
    ],
)
def test_parts_and_light_are_checked_where_they_are_given(make: Callable[[], Any], said: str) -> None:
    with pytest.raises(WarpArError, match=said):
        make()
