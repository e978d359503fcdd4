"""torch and CuPy themselves: their arrays in, lit frames and light back to them, and no copy over the bus.

Each test skips where the library, or for CUDA a device, is not there. That nothing crosses the bus is read from a
profile of the CUDA driver (CUPTI, by ``torch.profiler``), which sees the copies of Warp too.
"""

from __future__ import annotations

import json
import pathlib
from typing import Any

import numpy as np
import pytest
import warp as wp

from tests.test_pipeline import SIZE, make_scene
from warp_ar.engine.pipeline import Pipeline
from warp_ar.sources.sources import Synthetic

pytestmark = pytest.mark.slow

WIDTH, HEIGHT = SIZE
FRAME_BYTES = WIDTH * HEIGHT * 3
OUTPUTS = ("image", "environment")


@pytest.fixture(scope="module")
def frame() -> np.ndarray:
    with Synthetic("card", size=SIZE) as card:
        return next(iter(card)).image.copy()


@pytest.fixture
def torch() -> Any:
    return pytest.importorskip("torch")


@pytest.fixture
def cuda_torch(torch: Any) -> Any:
    if not wp.get_cuda_devices() or not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    return torch


@pytest.fixture
def cupy() -> Any:
    library = pytest.importorskip("cupy")
    if not wp.get_cuda_devices() or not library.cuda.is_available():
        pytest.skip("needs a CUDA device")
    return library


def make_pipeline(device: str) -> Pipeline:
    return Pipeline(make_scene(), device=device, quality="low", outputs=OUTPUTS)


def lit_by_numpy(frame: np.ndarray, device: str) -> tuple[np.ndarray, np.ndarray]:
    """The picture and the light that a frame of NumPy gives."""
    with make_pipeline(device) as pipeline:
        result = pipeline(frame, time_seconds=0.0)
        assert (result.image != frame).any()
        return result.image, result.environment


def bus_copies(torch: Any, path: pathlib.Path, work: Any) -> list[int]:
    """Bytes of each copy between host and device of half a frame or more while ``work`` runs."""
    activities = [torch.profiler.ProfilerActivity.CPU, torch.profiler.ProfilerActivity.CUDA]
    with torch.profiler.profile(activities=activities) as profile:
        work()
        torch.cuda.synchronize()
    profile.export_chrome_trace(str(path))
    events = [event for event in json.loads(path.read_text())["traceEvents"] if event.get("cat") == "gpu_memcpy"]
    over_the_bus = [event for event in events if "HtoD" in event["name"] or "DtoH" in event["name"]]
    return [size for event in over_the_bus if (size := int(event["args"]["bytes"])) >= FRAME_BYTES // 2]


def test_a_tensor_is_lit_where_it_lies(device: str, torch: Any, frame: np.ndarray) -> None:
    place = torch.device("cuda" if wp.get_device(device).is_cuda else "cpu")
    if place.type == "cuda" and not torch.cuda.is_available():
        pytest.skip("this torch sees no CUDA device")
    image, environment = lit_by_numpy(frame, device)
    with make_pipeline(device) as pipeline:
        result = pipeline(torch.from_numpy(frame).to(place), time_seconds=0.0)
        lit, light = torch.from_dlpack(result), torch.from_dlpack(result.environment_array)
        assert lit.device.type == light.device.type == place.type
        assert lit.data_ptr() == result.image_array.ptr
        assert light.data_ptr() == result.environment_array.ptr
        np.testing.assert_array_equal(lit.cpu().numpy(), image)
        np.testing.assert_array_equal(light.cpu().numpy(), environment)


@pytest.mark.filterwarnings("ignore:.*Profiler clears events:UserWarning")
def test_nothing_crosses_the_bus_cuda(cuda_torch: Any, frame: np.ndarray, tmp_path: pathlib.Path) -> None:
    """A frame of NumPy goes there and back; a tensor of the device with a known pose does neither."""
    torch = cuda_torch
    tensor = torch.from_numpy(frame).cuda()
    with make_pipeline("cuda:0") as pipeline:
        pose = pipeline(frame, time_seconds=0.0).pose
        for time in (1.0, 2.0):  # what is made once, is made; the frame's graph is captured
            pipeline(tensor, time_seconds=time, pose=pose)
        copies = bus_copies(
            torch,
            tmp_path / "tensor.json",
            lambda: torch.from_dlpack(pipeline(tensor, time_seconds=3.0, pose=pose)).sum(dtype=torch.int64).item(),
        )
        assert copies == []
        copies = bus_copies(torch, tmp_path / "numpy.json", lambda: pipeline(frame, time_seconds=4.0, pose=pose).image)
        assert len(copies) >= 2


def test_torch_s_stream_is_waited_for_cuda(cuda_torch: Any, frame: np.ndarray) -> None:
    """The frame is written on a stream of torch after much other work, and read there while it is written anew."""
    torch = cuda_torch
    image, _ = lit_by_numpy(frame, "cuda:0")
    source = torch.from_numpy(frame).cuda()
    target = torch.zeros_like(source)
    ballast = torch.empty(1 << 28, dtype=torch.uint8, device="cuda")
    stream = torch.cuda.Stream()
    with make_pipeline("cuda:0") as pipeline:
        pose = pipeline(frame, time_seconds=0.0).pose
        torch.cuda.synchronize()
    with make_pipeline("cuda:0") as pipeline, torch.cuda.stream(stream):
        for value in range(8):
            ballast.fill_(value)
        target.copy_(source)
        lit = torch.from_dlpack(pipeline(target, time_seconds=0.0, pose=pose)).clone()
        np.testing.assert_array_equal(lit.cpu().numpy(), image)


def test_cupy_arrays_are_lit_where_they_lie_cuda(cupy: Any, frame: np.ndarray) -> None:
    image, environment = lit_by_numpy(frame, "cuda:0")
    with make_pipeline("cuda:0") as pipeline:
        result = pipeline(cupy.asarray(frame), time_seconds=0.0)
        for lit in (cupy.from_dlpack(result), cupy.asarray(result)):
            assert lit.data.ptr == result.image_array.ptr
            np.testing.assert_array_equal(cupy.asnumpy(lit), image)
        light = cupy.from_dlpack(result.environment_array)
        assert light.data.ptr == result.environment_array.ptr
        np.testing.assert_array_equal(cupy.asnumpy(light), environment)
