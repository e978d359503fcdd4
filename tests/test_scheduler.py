"""The scheduler, on small stages of its own: order, skipping, bands, graphs."""

from __future__ import annotations

import sys
import threading
import types
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import pytest
import warp as wp

from warp_ar.engine import graph
from warp_ar.engine.graph import Plan, make_plan
from warp_ar.engine.scheduler import Scheduler
from warp_ar.kernels.launch import copy, launch, launch_rows
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Pass, Stage, Wiring
from warp_ar.stages.features import Features
from warp_ar.stages.quality import PRESETS
from warp_ar.stages.request import Request

SIZE = 37


@wp.kernel(enable_backward=False)
def add_one_kernel(row_start: wp.int32, values: wp.array[wp.int32], values_out: wp.array[wp.int32]):
    row = wp.tid() + row_start
    values_out[row] = values[row] + 1


class AddOne(Stage):
    summary: ClassVar[str] = "adds one"
    source: ClassVar[str]
    target: ClassVar[str]

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        if cls.target in features.request.scene.unwanted:
            return LeftOut(f"the scene has no {cls.target}")
        return Wiring((cls.source,), (cls.target,))

    def arrays(self) -> Mapping[str, ArraySpec]:
        return {self.target: ArraySpec((SIZE,), wp.int32)}

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        def launch(rows: tuple[int, int] | None) -> None:
            launch_rows(add_one_kernel, (SIZE,), [arrays[self.source]], [arrays[self.target]], rows=rows, device=device)

        return [Pass(launch, rows=SIZE)]


def chain(*names: str) -> tuple[type[Stage], ...]:
    """Stages frame -> names[0] -> names[1] -> ..."""
    sources = ("frame", *names)
    return tuple(
        type(f"To{target}", (AddOne,), {"name": f"make_{target}", "source": source, "target": target})
        for source, target in zip(sources, names, strict=False)
    )


def plan_of(
    monkeypatch: pytest.MonkeyPatch, stages: tuple[type[Stage], ...], outputs: tuple[str, ...], **scene: Any
) -> Plan:
    monkeypatch.setattr(graph, "STAGES", stages)
    monkeypatch.setattr(graph, "find_features", lambda request: types.SimpleNamespace(request=request))
    values = types.SimpleNamespace(**{"unwanted": (), **scene})
    return make_plan(Request(values, PRESETS["medium"], (4, 4), outputs))  # type: ignore[arg-type]


def inputs(device: str) -> Arrays:
    arrays = Arrays()
    for name in graph.INPUTS:
        arrays.add(name, wp.zeros(SIZE, dtype=wp.int32, device=device) if name == "frame" else None)
        arrays.touch(name)
    return arrays


def run_count(timings: Mapping[str, Any]) -> int:
    return sum(not timing.skipped for timing in timings.values())


def test_walks_back_from_outputs(monkeypatch: pytest.MonkeyPatch) -> None:
    plan = plan_of(monkeypatch, (*chain("a", "b"), *chain("unused")), ("b",))
    assert [stage.name for stage, _ in plan.stages] == ["make_a", "make_b"]
    assert plan.left_out == (("make_unused", "nothing reads its unused"),)
    assert plan.inputs == ("frame",)


def test_left_out_keeps_the_reason_of_the_scene(monkeypatch: pytest.MonkeyPatch) -> None:
    plan = plan_of(monkeypatch, chain("a"), ("image",), unwanted=("a",))
    assert plan.left_out == (("make_a", "the scene has no a"),)
    assert plan.stages == ()


def test_missing_producer_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="nothing in this scene produces nowhere"):
        plan_of(monkeypatch, chain("a"), ("nowhere",))
    with pytest.raises(ValueError, match=r"'make_b' reads a, which no earlier stage writes"):
        plan_of(monkeypatch, chain("a", "b")[1:], ("b",))


def test_unchanged_input_skips(monkeypatch: pytest.MonkeyPatch, device: str) -> None:
    arrays = inputs(device)
    scheduler = Scheduler(plan_of(monkeypatch, chain("a", "b"), ("b",)), arrays, wp.get_device(device))
    assert run_count(scheduler.run()) == 2
    assert run_count(scheduler.run()) == 0
    arrays["frame"].fill_(5)
    arrays.touch("frame")
    assert run_count(scheduler.run()) == 2
    np.testing.assert_array_equal(arrays["b"].numpy(), 7)
    scheduler.forget()
    assert run_count(scheduler.run()) == 2
    scheduler.close()


def test_after_a_failing_step_the_next_frame_makes_up_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """What had not failed may have run or not: all of it runs again."""
    broken = [True]

    class Failing(AddOne):
        name, source, target = "fails", "a", "b"

        def build(self, arrays: Arrays, device: Any) -> list[Pass]:
            def check(rows: tuple[int, int] | None) -> None:
                if broken[0]:
                    raise RuntimeError("broken step")

            return [Pass(check, on_host=True), *super().build(arrays, device)]

    arrays = inputs("cpu")
    plan = plan_of(monkeypatch, (*chain("a"), Failing), ("b",))
    scheduler = Scheduler(plan, arrays, wp.get_device("cpu"), bands=2)
    for _ in range(3):
        with pytest.raises(RuntimeError, match="broken step"):
            scheduler.run()
    broken[0] = False
    assert run_count(scheduler.run()) == 2
    np.testing.assert_array_equal(arrays["b"].numpy(), 2)
    scheduler.close()


def test_a_pass_of_several_launches_and_copies_keeps_their_order(monkeypatch: pytest.MonkeyPatch) -> None:
    """Split into bands, whole, with a copy: on native threads as one after another."""

    class Many(AddOne):
        name, source, target = "many", "frame", "a"

        def arrays(self) -> Mapping[str, ArraySpec]:
            return {**super().arrays(), "many_scratch": ArraySpec((SIZE,), wp.int32)}

        def build(self, arrays: Arrays, device: Any) -> list[Pass]:
            scratch, target = arrays["many_scratch"], arrays["a"]

            def twice(rows: tuple[int, int] | None) -> None:
                launch_rows(add_one_kernel, (SIZE,), [arrays["frame"]], [scratch], rows=rows, device=device)
                launch_rows(add_one_kernel, (SIZE,), [scratch], [target], rows=rows, device=device)

            def whole(rows: tuple[int, int] | None) -> None:
                launch(add_one_kernel, SIZE, [0, target], [scratch], device=device)

            return [Pass(twice, rows=SIZE), Pass(whole), Pass(lambda rows: copy(target, scratch), rows=SIZE)]

    for bands in (1, 2, 5, None):
        arrays = inputs("cpu")
        arrays["frame"].assign(np.arange(SIZE, dtype=np.int32))
        scheduler = Scheduler(plan_of(monkeypatch, (Many,), ("a",)), arrays, wp.get_device("cpu"), bands=bands)
        for _ in range(50):
            arrays.touch("frame")
            arrays["a"].zero_()
            scheduler.run()
            np.testing.assert_array_equal(arrays["a"].numpy(), np.arange(SIZE) + 3)
        scheduler.close()


def test_rows_that_are_not_due_are_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [(5, 11)]

    class Part(AddOne):
        name, source, target = "part", "frame", "a"

        def build(self, arrays: Arrays, device: Any) -> list[Pass]:
            (add,) = super().build(arrays, device)
            return [Pass(add.launch, rows=SIZE, extent=lambda: rows[0])]

    for bands in (1, 3, None):
        arrays = inputs("cpu")
        scheduler = Scheduler(plan_of(monkeypatch, (Part,), ("a",)), arrays, wp.get_device("cpu"), bands=bands)
        for rows[0] in ((5, 11), (20, 20), (0, SIZE), (36, 37)):
            arrays.touch("frame")
            arrays["a"].zero_()
            scheduler.run()
            expected = np.zeros(SIZE, np.int32)
            expected[slice(*rows[0])] = 1
            np.testing.assert_array_equal(arrays["a"].numpy(), expected)
        scheduler.close()


def test_stages_without_a_common_input_run_side_by_side(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each waits for the other; one thread after another would never end."""
    meeting = threading.Barrier(2, timeout=60.0)

    def build(self: AddOne, arrays: Arrays, device: Any) -> list[Pass]:
        return [Pass(lambda rows: meeting.wait(), on_host=True)]  # type: ignore[arg-type,return-value]

    branches = tuple(
        type(f"To{target}", (AddOne,), {"name": target, "source": "frame", "target": target, "build": build})
        for target in ("a", "b")
    )
    plan = plan_of(monkeypatch, branches, ("a", "b"))
    scheduler = Scheduler(plan, inputs("cpu"), wp.get_device("cpu"), bands=2)
    scheduler._threads = 2  # on any machine
    assert run_count(scheduler.run()) == 2
    scheduler.close()


def test_passes_take_part_when_they_are_due(monkeypatch: pytest.MonkeyPatch, device: str) -> None:
    """And the host's among them cut no graph while they are not."""
    calls: list[str] = []

    class Sometimes(AddOne):
        name, source, target = "sometimes", "frame", "a"

        def build(self, arrays: Arrays, device: Any) -> list[Pass]:
            (add,) = super().build(arrays, device)
            again = Pass(add.launch, rows=SIZE, enabled=lambda: self.frame % 2 == 0)
            return [add, Pass(lambda rows: calls.append("host"), on_host=True, enabled=again.enabled), again]

        frame = -1

        def begin(self) -> None:
            self.frame += 1

    arrays = inputs(device)
    scheduler = Scheduler(plan_of(monkeypatch, (Sometimes,), ("a",)), arrays, wp.get_device(device))
    for frame in range(6):
        arrays["frame"].fill_(frame)
        arrays.touch("frame")
        scheduler.run()
        np.testing.assert_array_equal(arrays["a"].numpy(), frame + 1)
    assert calls == ["host"] * 3
    if wp.get_device(device).is_cuda:
        assert sorted(len(segments) for segments in scheduler._patterns.values()) == [1, 3]
    scheduler.close()


def test_two_owners_of_one_resource_are_an_error() -> None:
    arrays = Arrays()
    arrays.add("x", None)
    with pytest.raises(ValueError, match="'x' is already there"):
        arrays.add("x", None)


def test_a_frame_calls_launchers_under_a_debugger(monkeypatch: pytest.MonkeyPatch) -> None:
    """A breakpoint in one is hit, and the frame is the same."""
    called: list[str] = []
    plan = plan_of(monkeypatch, chain("a", "b"), ("b",))
    arrays = inputs("cpu")
    scheduler = Scheduler(plan, arrays, wp.get_device("cpu"), bands=2)
    scheduler.run()
    arrays.touch("frame")

    def trace(frame: types.FrameType, event: str, argument: object) -> None:
        if frame.f_code.co_name == "launch_rows":
            called.append(event)

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        scheduler.run()
    finally:
        sys.settrace(before)
    assert called == ["call", "call"]
    np.testing.assert_array_equal(arrays["b"].numpy(), np.full(SIZE, 2))
    scheduler.close()
