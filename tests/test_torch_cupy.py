"""torch and CuPy themselves: their arrays in, lit frames and light back to them, and no copy over the bus.

Each test skips where the library, or for CUDA a device, is not there. That nothing crosses the bus is read from a
profile of the CUDA driver (CUPTI, by ``torch.profiler``), which sees the copies of Warp too.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp

from tests.test_pipeline import SIZE, make_scene
from warp_ar.engine.pipeline import Pipeline
from warp_ar.sources.synthetic import Synthetic

pytestmark = pytest.mark.slow

WIDTH, HEIGHT = SIZE
OUTPUTS = ("image", "environment")


@pytest.fixture(scope="module")
def frame() -> np.ndarray:
    with Synthetic("card", size=SIZE) as card:
        return next(iter(card)).image.copy()


@pytest.fixture
def torch() -> Any:
    return pytest.importorskip("torch")


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
