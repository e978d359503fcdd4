"""A frame with all that the pipeline knows of it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from warp_ar.accuracy import known_frame
from warp_ar.accuracy.known_frame import KnownFrame, light_of, light_up_to
from warp_ar.engine.pipeline import Pipeline
from warp_ar.errors import SourceError, UsageError
from warp_ar.kernels.structs import Emitter
from warp_ar.light.captured import Light
from warp_ar.scene import Pose, Scene, load_scene
from warp_ar.sources.sources import open_source


@pytest.fixture(scope="module")
def known() -> KnownFrame:
    return light_up_to(load_scene("torus"), 1, quality="low", device="cpu")


def test_it_is_the_frame_that_the_pipeline_lit(known: KnownFrame) -> None:
    scene = load_scene("torus")
    assert scene.source is not None
    assert scene.source.path is not None
    with (
        open_source(scene.source.path) as source,
        Pipeline(scene, device="cpu", quality="low", estimates="synchronous") as p,
    ):
        frames = iter(source)
        p(next(frames).image, time_seconds=0.0)
        second = next(frames)
        result = p(second.image, time_seconds=second.time)
        np.testing.assert_array_equal(known.lit, result.image)
        np.testing.assert_array_equal(known.image, second.image)
        np.testing.assert_array_equal(known.light.radiance, p.arrays["environment"].numpy())
    assert known.seconds == pytest.approx(second.time)
    assert known.milliseconds > 0.0


def test_the_reference_of_it_differs_only_where_virtual_things_are(known: KnownFrame) -> None:
    tracer = known.tracer(device="cpu", size=(80, 60))
    tracer.sample(16)
    picture = tracer.picture()
    changed = np.abs(picture.image.astype(int) - known.image[4::8, 4::8]).max(axis=2) > 30
    small = known.lit[4::8, 4::8].astype(int)
    shown = np.abs(small - known.image[4::8, 4::8]).max(axis=2) > 30
    assert 0.005 < shown.mean() < 0.2
    # The ring is where the pipeline shows it: most pixels of the one are pixels of the other.
    assert (changed & shown).sum() > 0.5 * shown.sum()
    assert changed.mean() < 0.3


def test_emitters_keep_their_places(device: str) -> None:
    with Pipeline("desk", device=device, quality="medium") as pipeline:
        records = np.zeros(len(pipeline.arrays["emitters"]), np.dtype(Emitter.numpy_dtype()))
        records["direction"][:2] = (0.0, 0.0, 1.0)
        records["distance"][:2] = (0.5, np.inf)
        records["power"][0], records["origin"][0] = (1.0, 2.0, 3.0), (0.1, 0.2, 0.3)
        pipeline.arrays["emitters"].assign(records)
        near, distant = light_of(pipeline).emitters
    assert near.distance == 0.5
    assert near.power == (1.0, 2.0, 3.0)
    assert near.origin == pytest.approx((0.1, 0.2, 0.3))
    assert distant.distance is None


def test_frames_that_cannot_be_judged_are_named(tmp_path: Path) -> None:
    scene = load_scene("torus")
    cv2.imwrite(str(tmp_path / "0.png"), np.zeros((480, 640, 3), np.uint8))
    with pytest.raises(UsageError, match="--frame -1: expected 0 or more"):
        light_up_to(scene, -1, quality="low", device="cpu")
    with pytest.raises(SourceError, match=r"frame 0 of .* shows no marker"):
        light_up_to(scene, 0, quality="low", device="cpu", source=tmp_path)
    with pytest.raises(SourceError, match="has no frame 1; it ends before"):
        light_up_to(scene, 1, quality="low", device="cpu", source=tmp_path)
    nowhere = Scene(scene.camera)
    with pytest.raises(UsageError, match="names no source"):
        light_up_to(nowhere, 0, quality="low", device="cpu")


def test_what_a_reference_lacks_of_several_balls_is_said_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(known_frame, "PathTracer", lambda *given, **more: None)
    black = np.zeros((2, 4, 3), np.float32)
    light, pose = Light(black, black[..., 0]), Pose(np.eye(3), np.zeros(3))
    for balls, said in ((1, 0), (2, 1), (2, 1)):
        scene = dataclasses.replace(load_scene("torus"), name="two balls of this test")
        image = np.zeros((2, 4, 3), np.uint8)
        KnownFrame(scene, image, image, pose, light, 0.0, 0.0, balls).tracer()
        assert len(caplog.records) == said
    assert "the path tracer's light is that of the first of 2 mirror balls" in caplog.records[0].getMessage()
