"""The command ``warp_ar.reference``."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
import pytest

from warp_ar.accuracy import known_frame, light_places
from warp_ar.accuracy.known_frame import KnownFrame, light_of, light_up_to
from warp_ar.accuracy.path_tracer import PathTracer, TracedPicture
from warp_ar.command_line import EXIT_DONE, EXIT_FAILED, EXIT_INTERRUPTED, EXIT_USAGE
from warp_ar.engine.pipeline import Pipeline
from warp_ar.errors import SourceError, UsageError
from warp_ar.kernels.structs import Emitter
from warp_ar.light.captured import Light, has_places
from warp_ar.reference import MAGNIFIED, main
from warp_ar.scene import CapturedLight, Pose, Scene, dumps_scene, load_scene
from warp_ar.sources.sources import open_source

pytestmark = pytest.mark.slow

QUICK = ["torus", "--quality", "low", "--size", "64x48", "--samples", "8", "--device", "cpu"]


def test_it_writes_radiance_error_and_comparison(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    radiance, compared = tmp_path / "deep" / "torus.exr", tmp_path / "torus.png"
    assert main([*QUICK, "--output", str(radiance), "--compare", str(compared)]) == EXIT_DONE
    line = capsys.readouterr().out
    assert line.startswith("torus: 64x48, 8 samples a pixel on cpu in ")
    assert "relative standard error" in line
    with OpenEXR.File(str(radiance), separate_channels=True) as file:
        channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
        assert file.header()["samples"] == 8
    assert set(channels) == {"R", "G", "B", "error.R", "error.G", "error.B"}
    assert channels["error.R"].max() > 0.0
    wide = cv2.imread(str(compared))[..., ::-1].astype(int)
    lit, traced, difference = wide[:, :64], wide[:, 64:128], wide[:, 128:]
    assert wide.shape == (48, 192, 3)
    assert abs(lit - traced).max() > 10
    shown = np.abs(lit - traced).max(axis=2) < 127 // MAGNIFIED - 1
    # The first is rounded to codes before it is compared here.
    assert abs(difference - 127.5 - MAGNIFIED * (lit - traced))[shown].max() <= 0.5 * MAGNIFIED + 1


def test_it_stops_at_an_error(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*QUICK[:-4], "--samples", "4096", "--device", "cpu", "--error", "0.9"]) == EXIT_DONE
    assert "64x48, 16 samples a pixel" in capsys.readouterr().out


def test_places_of_a_given_light_are_told_and_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(light_places, "WIDTH", 64)  # each trial distance is a picture
    given, saved = tmp_path / "given.exr", tmp_path / "deep" / "placed.exr"
    radiance = np.full((32, 64, 3), 0.2, np.float32)
    radiance[6, 40] = 200.0
    Light(radiance, np.ones((32, 64), np.float32)).save(given)
    options = [*QUICK, "--light", str(given), "--places", "--save-light", str(saved)]
    assert main(options) == EXIT_DONE
    told = capsys.readouterr().err
    assert "emitters:" in told
    light = Light.load(saved)
    assert len(light.emitters) == 1
    assert has_places(saved) == (light.emitters[0].distance is not None) == (" m toward " in told)
    assert light.radiance.max() > 50.0


def test_a_light_that_is_turned_is_not_saved(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given, scene = tmp_path / "given.exr", tmp_path / "scene.toml"
    Light(np.ones((32, 64, 3), np.float32), np.ones((32, 64), np.float32)).save(given)
    turned = dataclasses.replace(load_scene("torus"), captured=CapturedLight(given, rotate=(0.0, 0.0, 90.0)))
    scene.write_text(dumps_scene(turned))
    assert main([str(scene), *QUICK[1:], "--save-light", str(tmp_path / "placed.exr")]) == EXIT_USAGE
    assert "would be applied again" in capsys.readouterr().err


def test_a_place_that_cannot_be_written_is_told_before_paths_are_followed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("warp_ar.reference.light_up_to", None)
    (tmp_path / "file").write_text("mine")
    assert main([*QUICK, "--output", str(tmp_path / "file" / "torus.exr")]) == EXIT_FAILED
    said = capsys.readouterr().err
    assert "is a file, not a folder to write to" in said
    assert said.count("\n") == 1


def test_who_interrupts_keeps_what_was_rendered(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    original = PathTracer.render

    def interrupted(self: PathTracer, *arguments: Any, **options: Any) -> Iterator[TracedPicture]:
        yield next(original(self, *arguments, **options))
        raise KeyboardInterrupt

    monkeypatch.setattr(PathTracer, "render", interrupted)
    path = tmp_path / "torus.exr"
    assert main([*QUICK, "--samples", "16", "--output", str(path)]) == EXIT_INTERRUPTED
    assert "ended early: the written picture has 8 samples a pixel" in capsys.readouterr().err
    with OpenEXR.File(str(path)) as file:
        assert file.header()["samples"] == 8


# --- A frame with all that the pipeline knows of it -------------------------------------------------------------------


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
