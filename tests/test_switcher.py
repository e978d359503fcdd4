"""Going from one pipeline to another while frames run."""

from __future__ import annotations

import dataclasses
import gc
import threading
import weakref
from typing import Any

import numpy as np
import pytest

from tests.test_pipeline import Frames, frames, make_scene  # noqa: F401  (a fixture)
from warp_ar.engine import switcher as module
from warp_ar.engine.pipeline import Pipeline
from warp_ar.engine.switcher import PipelineSwitcher, Target, let_go
from warp_ar.errors import UsageError
from warp_ar.stages.quality import PRESETS

pytestmark = pytest.mark.slow

SIZE = (320, 240)
LOW, PAPER = PRESETS["low"], PRESETS["paper"]


def target(quality: Any = LOW, **changes: Any) -> Target:
    return Target(make_scene(**changes), quality, SIZE)


def settle(switcher: PipelineSwitcher) -> None:
    """Wait for what is being built."""
    if switcher._building is not None:
        switcher._building.exception()


def go_over(switcher: PipelineSwitcher, wanted: Target) -> Pipeline | None:
    switcher.want(wanted)
    settle(switcher)
    switcher.take()
    settle(switcher)  # what was built before could not take over
    return switcher.take()


def test_what_is_wanted_while_something_is_built_comes_next(monkeypatch: pytest.MonkeyPatch) -> None:
    go_on = threading.Event()
    switcher = PipelineSwitcher(device="cpu")
    switcher.open(target())
    switcher.want(target(PAPER), lambda _: go_on.wait(60.0))
    last = target(dataclasses.replace(LOW, environment_height=32))
    switcher.want(last)
    assert switcher.take().quality == LOW  # type: ignore[union-attr]
    go_on.set()
    while not switcher.shows(last):
        settle(switcher)
        switcher.take()
        assert switcher.pipeline is not None
        assert switcher.pipeline.quality != PAPER, "nobody wants it any more"
    switcher.close()


def test_a_pipeline_that_is_not_admitted_never_lights_a_frame() -> None:
    switcher = PipelineSwitcher(device="cpu")
    first = switcher.open(target())
    asked: list[Any] = []
    wanted = target(PAPER)
    assert not switcher.want(wanted, lambda _: 12.5)
    settle(switcher)

    def refuse(pipeline: Pipeline, prepared: Any) -> bool:
        asked.append((pipeline.quality, prepared))
        return False

    assert switcher.take(refuse) is first
    assert asked == [(PAPER, 12.5)]
    switcher.want(wanted)
    assert not switcher.busy, "it is built again and again"
    switcher.close()


def test_what_cannot_be_built_is_told_once_and_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(pipeline: Pipeline) -> None:
        raise RuntimeError("Failed to allocate 12 bytes on device 'cuda:0'\nmore of it")

    switcher = PipelineSwitcher(device="cpu")
    first = switcher.open(target())
    wanted = target(PAPER)
    switcher.want(wanted, fail)
    settle(switcher)
    with pytest.raises(
        UsageError, match=r"quality 'paper' cannot run here: Failed to allocate 12 bytes .* cheaper one$"
    ):
        switcher.take()
    for _ in range(3):
        assert switcher.follow(wanted) is first
        assert not switcher.busy
    switcher.close()


def test_a_pipeline_that_cannot_go_on_is_not_said_to_be_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    """Going over waits for the frames that were submitted, and raises what one of them did."""

    def fail(pipeline: Pipeline, other: Pipeline) -> None:
        raise UsageError("a frame could not be rendered")

    switcher = PipelineSwitcher(device="cpu")
    now, wanted = target(), target(PAPER)
    first = switcher.open(now)
    with monkeypatch.context() as patch:
        patch.setattr(Pipeline, "continue_from", fail)
        with pytest.raises(UsageError, match="could not be rendered"):
            go_over(switcher, wanted)
    assert switcher.pipeline is first
    assert switcher.shows(now)
    assert go_over(switcher, wanted) is not first
    switcher.close()


def test_pipelines_that_are_kept_come_back_at_once() -> None:
    switcher = PipelineSwitcher(device="cpu", keep=1)
    first = switcher.open(target())
    second = go_over(switcher, target(PAPER))
    assert switcher.want(target(LOW)), "it is there"
    assert switcher.take() is first
    assert switcher.want(target(PAPER))
    assert switcher.take() is second
    switcher.close()


def test_a_pipeline_that_goes_frees_its_arrays_at_once(frames: Frames, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the garbage collector; what a result refers to stays."""
    trimmed: list[None] = []
    monkeypatch.setattr(module, "release_memory", lambda: trimmed.append(None))
    gc.collect()
    gc.disable()
    try:
        pipeline = Pipeline(make_scene(), device="cpu", quality="low", size=SIZE)
        result = pipeline(frames[0])
        held = weakref.ref(pipeline.arrays["frame"])
        image = result.image_array
        let_go(pipeline)
        del pipeline
        assert held() is None, "it waits for the garbage collector"
        assert trimmed
        assert image.numpy().any()
        np.testing.assert_array_equal(result.image, image.numpy())
    finally:
        gc.enable()
