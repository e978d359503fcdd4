"""What several tests of ``warp_ar.accuracy`` share: a case of four frames, and a report that is made up."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tests.test_pipeline import Frames, frames, make_scene  # noqa: F401  (a fixture)
from warp_ar.accuracy import cases, measure
from warp_ar.accuracy.cost_table import SETTINGS
from warp_ar.sources.source import Frame
from warp_ar.tracking.tracking import Tracker


def setting(name):
    return next(setting for setting in SETTINGS if setting.name == name)


@pytest.fixture(scope="module")
def case(frames: Frames) -> cases.Case:
    scene = make_scene()
    tracker = Tracker(scene.marker, scene.camera)
    poses = tuple(tracker.track(image, index / 30).pose for index, image in enumerate(frames))
    assert all(pose is not None for pose in poses)
    # Brighter to the right and from frame to frame, so that there is a light with a direction, and it changes.
    ramp = np.linspace(0.2, 1.0, frames[0].shape[1])[None, :, None]
    images = [np.uint8(image * ramp * (0.7 + 0.1 * index)) for index, image in enumerate(frames)]
    shown = tuple(Frame(index, index / 30, image) for index, image in enumerate(images))
    return cases.Case("made", scene, shown, poses, {})


@pytest.fixture
def report(case) -> measure.CaseReport:
    """A report of two methods, made up; names that HTML must escape."""
    rng = np.random.default_rng(0)
    index = case.shown[-1]
    camera = case.frames[index].image
    images = [
        np.clip(camera.astype(int) + rng.integers(0, add, camera.shape), 0, 255).astype(np.uint8) for add in (60, 5)
    ]
    rows = tuple(
        measure.Row(case.name, "irradiance", method, ms, flip, "last method", flip, False)
        for method, ms, flip in (("sphere_mip", 0.5, 0.1), ("sh2", 1.0, 0.0))
    )
    wholes = tuple(
        measure.Whole(label, ms, flip, {"irradiance": "sh2"}, {index: image})
        for label, ms, flip, image in (
            ("paper", 10.0, 0.3, images[0]),
            (measure.SAME_TIME, 9.0, 0.2, images[1]),
        )
    )
    region = np.zeros(camera.shape[:2], bool)
    region[100:140, 60:90] = True
    pictures = {("irradiance", "sphere_mip"): images[0], ("irradiance", "sh2"): images[1]}
    named = dataclasses.replace(case, name="<made> & so on")
    return measure.CaseReport(named, {index: images[1]}, rows, pictures, wholes, region)
