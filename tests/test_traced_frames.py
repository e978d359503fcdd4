"""``warp_ar.live --samples N``: frames by path tracing in the light that the pipeline finds."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.test_path_tracer import CAMERA, DOWN, WHITE, desk
from tests.viewer_rig import page_scene
from warp_ar.accuracy.known_frame import exposed_scene, light_of
from warp_ar.accuracy.path_tracer import PathTracer
from warp_ar.accuracy.traced_frames import TracedFrames
from warp_ar.kernels.color import decode_table
from warp_ar.live import main
from warp_ar.scene import Exposure, dumps_scene
from warp_ar.session import Session
from warp_ar.sources.synthetic import Synthetic

pytestmark = pytest.mark.slow


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    """Two small frames: paths are followed for each pixel."""
    folder = tmp_path / "clip"
    folder.mkdir()
    with Synthetic("card", size=(160, 120), length=2) as source:
        for frame in source:
            cv2.imwrite(str(folder / f"{frame.index}.png"), frame.image[..., ::-1])
    return folder


def test_frames_are_those_of_the_path_tracer(clip: Path) -> None:
    """In the light, pose and time of each frame, not of the one after it."""
    with Session(page_scene(), source=clip, device="cpu", quality="low") as session:
        session.ahead = False
        traced = TracedFrames(session.pipeline, 1)  # type: ignore[arg-type]
        first = None
        for frame, result in itertools.islice(session, 2):
            image = traced(frame, result)
            first = frame.time if first is None else first
            light = light_of(session.pipeline)  # type: ignore[arg-type]
            scene = exposed_scene(session.pipeline)  # type: ignore[arg-type]
            tracer = PathTracer(scene, light, frame.image, result.pose, device="cpu", seconds=frame.time - first)
            tracer.sample(1)
            np.testing.assert_array_equal(image, tracer.picture().image)
            assert (image != frame.image).any()
            assert (image != result.image).any()


def test_a_frame_without_a_marker_stays_as_the_pipeline_gave_it() -> None:
    with Session(page_scene(), device="cpu", quality="low") as session:
        session.ahead = False
        traced = TracedFrames(session.pipeline, 1)  # type: ignore[arg-type]
        frame, result = next(iter(session))
        lost = dataclasses.replace(result, pose=None)
        assert traced(frame, lost) is lost.image


def test_a_darker_exposure_scales_what_is_encoded() -> None:
    """The radiance stays; the picture is that of the scaled one."""
    frame = np.full((24, 32, 3), 0.5, np.float32)
    pictures = []
    for scale in (1.0, 0.5):
        scene = dataclasses.replace(desk(), exposure=Exposure(scale))
        tracer = PathTracer(scene, WHITE, frame, DOWN, device="cpu")
        tracer.sample(1)
        pictures.append(tracer.picture())
    np.testing.assert_array_equal(pictures[0].radiance, pictures[1].radiance)
    table = decode_table(CAMERA.transfer)[:, 0]
    np.testing.assert_allclose(table[pictures[1].image], 0.25, atol=0.004)  # half a code there


def test_the_command_writes_them(tmp_path: Path, clip: Path) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(dumps_scene(page_scene(probes=())))
    options = ["--source", str(clip), "--device", "cpu", "--quality", "low", "--frames", "1", "--headless"]
    assert main([str(path), *options, "--output", str(tmp_path / "lit")]) == 0
    assert main([str(path), *options, "--output", str(tmp_path / "traced"), "--samples", "1"]) == 0
    lit, traced = (cv2.imread(str(tmp_path / name / "0000.png")) for name in ("lit", "traced"))
    assert lit.shape == traced.shape
    assert (lit != traced).any()
