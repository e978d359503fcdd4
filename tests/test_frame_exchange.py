"""Frames and pictures of other libraries: where they lie, without a copy, and in one line what does not fit."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
import pytest
import warp as wp

from tests.test_pipeline import SIZE, make_scene
from warp_ar.engine.frame_exchange import Borrowed, adopt_frame
from warp_ar.engine.pipeline import Pipeline
from warp_ar.errors import UsageError
from warp_ar.sources.synthetic import Synthetic

WIDTH, HEIGHT = SIZE


def picture() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)


class OnlyDLPack:
    """An array of another library, as far as DLPack tells."""

    def __init__(self, array: Any, device: tuple[int, int] | None = None) -> None:
        self._array = array
        self._device = device
        self.streams: list[Any] = []

    def __dlpack__(self, *, stream: Any = None, **options: Any) -> Any:
        self.streams.append(stream)
        return self._array.__dlpack__(stream=stream, **options)

    def __dlpack_device__(self) -> tuple[int, int]:
        return self._device or self._array.__dlpack_device__()


class OnlyCuda:
    """An array that has nothing but a CUDA array interface."""

    def __init__(self, interface: dict[str, Any]) -> None:
        self.__cuda_array_interface__ = interface

    def __len__(self) -> int:
        return int(self.__cuda_array_interface__["shape"][0])


@pytest.fixture
def pipeline(device: str) -> Iterator[Pipeline]:
    with contextlib.closing(Pipeline(make_scene(objects=(), lights=()), device=device, quality="low")) as made:
        yield made


def test_a_frame_of_the_host_is_read_where_it_lies(device: str) -> None:
    frame = picture()
    for image in (OnlyDLPack(frame), wp.array(frame, dtype=wp.uint8, device="cpu", copy=False)):
        adopted = adopt_frame(image, SIZE, wp.get_device(device))
        assert isinstance(adopted, np.ndarray)
        assert adopted.ctypes.data == frame.ctypes.data
        np.testing.assert_array_equal(adopted, frame)


def test_a_slice_of_the_host_is_made_whole(device: str) -> None:
    wide = np.random.default_rng(0).integers(0, 256, (2 * HEIGHT, WIDTH, 3), np.uint8)
    adopted = adopt_frame(OnlyDLPack(wide[::2]), SIZE, wp.get_device(device))
    assert adopted.flags.c_contiguous
    np.testing.assert_array_equal(adopted, wide[::2])


def test_pictures_are_the_same_by_every_way_in(device: str) -> None:
    with Synthetic("card", size=SIZE) as card:
        frame = next(iter(card)).image.copy()
    shown = []
    ways: list[Any] = [frame, OnlyDLPack(frame), wp.array(frame, dtype=wp.vec3ub, device=device)]
    ways.append(wp.array(frame, dtype=wp.uint8, device=device))
    for way in ways:
        with Pipeline(make_scene(), device=device, quality="low") as pipeline:
            shown.append(pipeline(way, time_seconds=0.0).image)
    assert (shown[0] != frame).any()
    for image in shown[1:]:
        np.testing.assert_array_equal(image, shown[0])


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (
            OnlyDLPack(np.zeros((HEIGHT, WIDTH, 4), np.uint8)),
            r"frame is OnlyDLPack uint8 \(240, 320, 4\); expected uint8",
        ),
        (OnlyDLPack(np.zeros((3, HEIGHT, WIDTH), np.uint8)), r"OnlyDLPack uint8 \(3, 240, 320\)"),
        (OnlyDLPack(np.zeros((HEIGHT, WIDTH, 3), np.float32)), "OnlyDLPack float32"),
        (OnlyDLPack(picture(), (10, 0)), "OnlyDLPack on a device of DLPack's kind 10; expected one on the host"),
        (OnlyDLPack(picture(), (2, 77)), "OnlyDLPack on cuda:77; expected one on the host"),
        ("frame.png", r"frame is str; expected uint8 RGB \(240, 320, 3\)"),
    ],
)
def test_what_does_not_fit_is_one_line(device: str, image: Any, message: str) -> None:
    with pytest.raises(UsageError, match=message) as caught:
        adopt_frame(image, SIZE, wp.get_device(device))
    assert "\n" not in str(caught.value)


def test_an_array_that_refuses_is_told(device: str) -> None:
    class Refuses(OnlyDLPack):
        def __dlpack__(self, **_: Any) -> Any:
            raise BufferError("requires a gradient")

    with pytest.raises(UsageError, match="Refuses, which gives no array by __dlpack__: requires a gradient"):
        adopt_frame(Refuses(picture()), SIZE, wp.get_device(device))


def test_a_cuda_array_on_a_pipeline_of_the_host_is_told() -> None:
    image = OnlyCuda({"shape": (HEIGHT, WIDTH, 3), "typestr": "|u1", "data": (4096, False), "version": 3})
    with pytest.raises(UsageError, match="OnlyCuda on a CUDA device; expected one on the host"):
        adopt_frame(image, SIZE, wp.get_device("cpu"))


# ---------------------------------------------------------------------------------------------------------------- CUDA


@pytest.fixture
def cuda() -> Any:
    if not wp.get_cuda_devices():
        pytest.skip("needs a CUDA device")
    return wp.get_cuda_devices()[0]


def test_a_frame_on_the_device_is_read_where_it_lies(cuda: Any) -> None:
    frame = picture()
    array = wp.array(frame, dtype=wp.uint8, device=cuda)
    packed = OnlyDLPack(array)
    adopted = adopt_frame(packed, SIZE, cuda)
    assert (adopted.ptr, adopted.dtype, adopted.shape) == (array.ptr, wp.vec3ub, (HEIGHT, WIDTH))
    assert set(packed.streams) == {wp.get_stream(cuda).cuda_stream or 1}
    plain = adopt_frame(OnlyCuda(array.__cuda_array_interface__ | {"stream": 1}), SIZE, cuda)
    assert plain.ptr == array.ptr
    np.testing.assert_array_equal(plain.numpy(), frame)


def test_the_stream_that_writes_is_waited_for(cuda: Any) -> None:
    """Without the wait the copy overtakes what is queued on the other stream: 2 GB of writes."""
    stream = wp.Stream(cuda)
    array = wp.zeros((HEIGHT, WIDTH, 3), dtype=wp.uint8, device=cuda)
    ballast = wp.zeros(1 << 28, dtype=wp.uint8, device=cuda)
    target = wp.zeros((HEIGHT, WIDTH), dtype=wp.vec3ub, device=cuda)
    interface = array.__cuda_array_interface__ | {"stream": stream.cuda_stream}
    wp.synchronize_device(cuda)
    with wp.ScopedStream(stream, sync_enter=False):
        for value in range(8):
            ballast.fill_(value)
        array.fill_(200)
    wp.copy(target, adopt_frame(OnlyCuda(interface), SIZE, cuda))
    assert (target.numpy() == 200).all()


def test_strides_that_a_kernel_cannot_read_are_told(cuda: Any) -> None:
    array = wp.zeros((3, HEIGHT, WIDTH), dtype=wp.uint8, device=cuda)
    strides = (WIDTH, 1, HEIGHT * WIDTH)
    image = OnlyCuda(array.__cuda_array_interface__ | {"shape": (HEIGHT, WIDTH, 3), "strides": strides})
    with pytest.raises(UsageError, match="pixels of 3 bytes side by side"):
        adopt_frame(image, SIZE, cuda)


def test_a_borrowed_frame_is_let_go_when_it_was_read(cuda: Any) -> None:
    borrowed = Borrowed(cuda)
    borrowed.keep("first")
    wp.synchronize_device(cuda)
    borrowed.keep("second")
    assert [frame for frame, _ in borrowed._kept] == ["second"]


# ------------------------------------------------------------------------------------------------------------- results


def test_a_lit_result_is_the_device_s_own_array(device: str) -> None:
    with Synthetic("card", size=SIZE) as card:
        frame = next(iter(card)).image.copy()
    with Pipeline(make_scene(), device=device, quality="low", outputs=("image", "environment")) as pipeline:
        result = pipeline(frame, time_seconds=0.0)
        array = wp.from_dlpack(result)
        assert array.ptr == result.image_array.ptr
        assert (array.shape, array.dtype) == ((HEIGHT, WIDTH, 3), wp.uint8)
        np.testing.assert_array_equal(array.numpy(), result.image)
        light = wp.from_dlpack(result.environment_array)
        assert light.ptr == result.environment_array.ptr
        np.testing.assert_array_equal(light.numpy(), result.environment)
        if wp.get_device(device).is_cuda:
            assert result.__cuda_array_interface__["data"][0] == array.ptr
            assert result.__cuda_array_interface__["stream"]
        else:
            assert not hasattr(result, "__cuda_array_interface__")
            assert np.from_dlpack(result).ctypes.data == array.ptr
        with pytest.raises(BufferError, match="copy it afterwards"):
            result.__dlpack__(copy=True)
        with pytest.raises(BufferError, match="copy it afterwards"):
            result.__dlpack__(dl_device=(10, 3))


def test_a_submitted_result_lasts(pipeline: Pipeline) -> None:
    """Of a frame ahead of others the device's own array is written anew; what was sent to the host is not."""
    first, second = picture(), 255 - picture()
    results = [pipeline.submit(frame, time_seconds=time) for time, frame in enumerate((first, second))]
    arrays = [np.from_dlpack(result) for result in results]
    expected = [pipeline(frame, time_seconds=2.0 + time).image for time, frame in enumerate((first, second))]
    np.testing.assert_array_equal(arrays, expected)
    assert (expected[0] != expected[1]).any()


def test_a_notebook_shows_the_picture(pipeline: Pipeline) -> None:
    result = pipeline(picture(), time_seconds=0.0)
    shown = cv2.imdecode(np.frombuffer(result._repr_png_(), np.uint8), cv2.IMREAD_COLOR)
    np.testing.assert_array_equal(shown[..., ::-1], result.image)


# -------------------------------------------------------------------------------------------------------------- scenes
