"""The examples of docs/python.md run as they stand there, and are short."""

from __future__ import annotations

import asyncio
import dataclasses
import itertools
import pathlib
import re
from typing import Any

import numpy as np
import pytest
import warp as wp

from warp_ar.engine.pipeline import Pipeline
from warp_ar.engine.scene_objects import SceneObjects
from warp_ar.output.environment_file import write_environment
from warp_ar.scene import LambertMaterial, Object, Pose, load_scene
from warp_ar.session import Session
from warp_ar.sources.video_file import VideoFile

pytestmark = pytest.mark.slow

PAGE = pathlib.Path(__file__).parents[1] / "docs" / "python.md"
BLOCKS = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(), re.MULTILINE | re.DOTALL)
WHOLE_PIXELS = 0.015
"""Metres, of 0.74: the example's corners are not refined below a pixel."""
AHEAD = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.5]))
"""A camera that looks straight down from half a metre."""


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have recordings end after two frames."""
    whole = VideoFile.__iter__
    monkeypatch.setattr(VideoFile, "__iter__", lambda self: itertools.islice(whole(self), 2))


def run(marker: str, **names: Any) -> dict[str, Any]:
    """Run the block that holds a text."""
    (block,) = (block for block in BLOCKS if marker in block)
    assert len(block.strip().splitlines()) <= 16, "an example is at most 15 lines, an empty one aside"
    exec(compile(block, str(PAGE), "exec"), names)
    return names


def test_the_first_lines(short: None) -> None:
    shown: list[np.ndarray] = []
    run("# result.environment", show=shown.append)
    assert len(shown) == 2


def test_poses_by_opencv(short: None) -> None:
    """As the program's own tracker finds them."""
    found = run("solvePnP")
    with Session("desk", device="cpu", quality="paper") as session:
        expected = [result.pose for _, result in session][-1]
    np.testing.assert_allclose(found["result"].pose.translation, expected.translation, atol=WHOLE_PIXELS)
    assert (found["result"].image != found["frame"].image).any()


def test_a_phone_s_camera_and_a_captured_light(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_environment("studio.hdr", np.full((16, 32, 3), 0.8, np.float32))
    transform = np.eye(4)  # looks along -z of a y-up world, which is the desk's +y: level, across the table
    transform[:3, 3] = 0.0, 0.05, 0.4
    intrinsics = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
    images = [np.full((240, 320, 3), 90, np.uint8)]
    found = run("intrinsics", images=images, transforms=[transform], intrinsics=intrinsics)
    np.testing.assert_allclose(found["pose"].inverse().translation, (0.0, -0.4, 0.05), atol=1e-6)
    np.testing.assert_allclose(found["pose"].inverse().rotation @ (0.0, 0.0, 1.0), (0.0, 1.0, 0.0), atol=1e-6)
    assert (found["result"].image != images[0]).any()


def test_tensors_that_stay_on_the_gpu() -> None:
    if not wp.get_cuda_devices():
        pytest.skip("needs a CUDA device")
    torch = pytest.importorskip("torch")
    if not torch.cuda.is_available():
        pytest.skip("needs a PyTorch for CUDA")
    tensor = torch.full((480, 640, 3), 90, dtype=torch.uint8, device="cuda:0")
    found = run("from_dlpack", tensors=[tensor], poses=[AHEAD])
    assert found["lit"].device.type == found["light"].device.type == "cuda"


def test_a_session_in_asyncio(short: None) -> None:
    """The loop turns while frames are waited for; a task that is cancelled in a frame leaves the session closed."""
    shown: list[np.ndarray] = []
    turns: list[int] = []
    light = run("async for")["light"]

    async def turn() -> None:
        while True:
            turns.append(len(shown))
            await asyncio.sleep(0.001)

    async def both() -> None:
        other = asyncio.create_task(turn())
        await light("desk", shown.append)
        other.cancel()
        task = asyncio.create_task(light("desk", lambda image: (shown.append(image), task.cancel())))
        with pytest.raises(asyncio.CancelledError):
            await task

    asyncio.run(both())
    assert len(shown) == 3
    assert turns.count(0) > 2


def test_objects_by_name() -> None:
    lamp = Object("sphere", radius=0.02, material=LambertMaterial((0.5, 0.5, 0.5)), name="lamp")
    with Pipeline(dataclasses.replace(load_scene("desk"), objects=(lamp,)), device="cpu", quality="paper") as pipeline:
        given = {"translation": (0.1, 0.0, 0.0), "quaternion": (0.0, 0.0, 1.0, 0.0), "scale": 2.0}
        run("objects.remove", pipeline=pipeline, matrix=np.eye(4), **given)
        assert isinstance(pipeline.objects, SceneObjects)
        np.testing.assert_allclose(pipeline.objects["lamp"].world_from_object[0], (-2.0, 0.0, 0.0, 0.1), atol=1e-6)
        assert len(pipeline.objects) == 1


def test_all_examples_are_run() -> None:
    assert len(BLOCKS) == 6
