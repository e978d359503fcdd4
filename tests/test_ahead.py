"""CUDA modules that are begun before all of a plan's are known: they are the plan's, and are compiled once."""

from __future__ import annotations

import threading
from types import SimpleNamespace

import pytest
import warp as wp

from warp_ar.engine import ahead, modules, nvrtc, scheduler
from warp_ar.engine.pipeline import Pipeline
from warp_ar.kernels.launch import BLOCK

SCENES = ("desk", "torus", "mirror")


class _Listed(Exception):
    """The kernels of a plan are known."""


@pytest.fixture
def listed(monkeypatch):
    """Kernels that a plan would have compiled, each with its size of block."""
    found: list[tuple[wp.Kernel, int]] = []

    def note(kernels, device, progress=None, *, blocks=(), on_host=()):
        found.extend([(kernel, BLOCK) for kernel in kernels])
        found.extend(blocks)
        raise _Listed

    monkeypatch.setattr(scheduler, "load_modules", note)
    return found


@pytest.mark.parametrize("quality", ["low", "medium", "high"])
@pytest.mark.parametrize("scene", SCENES)
def test_slowest_kernels_are_those_of_the_plan(device, listed, scene, quality) -> None:
    """One that the plan does not launch would be compiled for nothing."""
    with Pipeline(scene, device=device, quality=quality) as pipeline:
        with pytest.raises(_Listed):
            pipeline.warm_up()
        plan = pipeline.plan
        slowest = [one for kind, _ in plan.stages for one in kind.slowest_kernels(plan.features, pipeline.device)]
    assert slowest
    launched = {id(kernel) for kernel, size in listed if size == BLOCK}
    assert [kernel.key for kernel in slowest if id(kernel) not in launched] == []
    assert all(sum(module is kernel.module for kernel in slowest) == 1 for module in {one.module for one in slowest})


@pytest.fixture
def compiled(monkeypatch):
    """Modules that are compiled, by whom, and what lets those begun ahead end."""
    told = SimpleNamespace(names=[], threads=[], finish=threading.Event(), translating=threading.Lock(), most=0)

    def build(*_, **__) -> None:
        assert told.finish.wait(60.0)

    def compile_module(module, device) -> None:
        assert told.translating.acquire(blocking=False), "two modules are translated at once"
        told.names.append(module.name)
        told.threads.append(threading.current_thread().name)
        told.translating.release()
        wp._src.build.build_cuda("", 90, "")
        if module.name == "broken":
            raise RuntimeError("broken")

    monkeypatch.setattr(wp._src.build, "build_cuda", build)
    monkeypatch.setattr(wp, "compile_aot_module", compile_module)
    monkeypatch.setattr(ahead, "_UNDER_WAY", {})
    return told


class _Module(SimpleNamespace):
    """Can be a key."""

    __hash__ = object.__hash__


DEVICE = SimpleNamespace(is_cpu=False, is_cuda=True)


def test_what_is_begun_is_waited_for_and_compiled_once(compiled) -> None:
    one, two, three = (_Module(name=name, options={}) for name in ("one", "two", "three"))
    ahead.begin([one, two], DEVICE)  # returns though neither has ended
    ahead.begin([one], DEVICE)
    assert compiled.names == ["one", "two"]
    said = []

    def progress(done: int, total: int) -> None:
        if not said:
            threading.Timer(0.1, compiled.finish.set).start()
        said.append((done, total))

    modules._compile([(two, None), (three, None), (one, None)], DEVICE, progress)
    assert said == [(0, 3), (1, 3), (2, 3), (3, 3)]
    assert sorted(compiled.names) == ["one", "three", "two"]
    assert [name.startswith("warp_ar-ahead") for name in compiled.threads] == [True, True, False]
    assert ahead.take(one) is None


def test_other_blocks_of_a_module_that_is_begun_are_compiled_too(compiled, monkeypatch) -> None:
    """A binary is for one size of block."""
    monkeypatch.setattr(modules, "_compile_blocks", lambda module, device, size: compiled.names.append(size))
    (one,) = (_Module(name="one", options={}),)
    ahead.begin([one], DEVICE)
    compiled.finish.set()
    modules._compile([(one, 64), (one, None)], DEVICE, None)
    assert compiled.names == ["one", 64]


def test_what_fails_ahead_is_told_by_who_needs_it(compiled) -> None:
    compiled.finish.set()
    broken = _Module(name="broken", options={})
    ahead.begin([broken], DEVICE)
    with pytest.raises(RuntimeError, match="broken"):
        modules._compile([(broken, None)], DEVICE, None)


def test_a_library_begins_nothing_and_a_command_what_is_missing_the_longest_first(monkeypatch) -> None:
    begun: list[str] = []
    monkeypatch.setattr(ahead, "begin", lambda found, device: begun.extend(module.name for module in found))
    monkeypatch.setattr(modules, "choose", lambda kernels, device: None)
    monkeypatch.setattr(modules, "_is_cached", lambda module, size, device: module.name == "cached")
    monkeypatch.setattr(nvrtc, "_ENABLED", threading.Event())
    names = ("shade_kernel", "cached", "mirror_ball", "trace_secondary")
    kernels = [SimpleNamespace(module=SimpleNamespace(name=name)) for name in names]
    modules.begin_slowest(kernels, DEVICE)
    assert begun == []
    nvrtc.compile_beside()
    modules.begin_slowest(kernels, SimpleNamespace(is_cpu=True))
    assert begun == []
    modules.begin_slowest(kernels, DEVICE)
    assert begun == ["trace_secondary", "mirror_ball", "shade_kernel"]
