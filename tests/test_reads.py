"""What stages take from the arrays is what they declare to read: captured stages wait for nothing else."""

import dataclasses

import pytest
import warp as wp

from warp_ar.engine.pipeline import Pipeline
from warp_ar.engine.scheduler import Scheduler
from warp_ar.kernels.rays.wide_bvh import build_wide_bvh_kernel
from warp_ar.scene import bundled_scenes, load_scene
from warp_ar.stages import STAGES
from warp_ar.stages.base import Arrays
from warp_ar.stages.quality import PRESETS

INPUT_ARRAYS = {"frame": "frame", "light_array": "lights"}
"""Arrays of the pipeline that stand for a resource whose changes make stages run."""


def taken(scene, quality, monkeypatch):
    """The plan of a scene, and the names that each of its stages asks for while it is built and run; nothing runs."""
    names, current, schedulers = {}, [], []
    get = Arrays.__getitem__

    def noted(self, name):
        value = get(self, name)
        if current:
            names.setdefault(current[-1], set()).add(name)
        return value

    def noting(stage, function):
        def call(*args):
            current.append(stage)
            try:
                return function(*args)
            finally:
                current.pop()

        return call

    def noting_build(kind, build):
        return lambda self, *args: noting(kind.name, build)(self, *args)

    monkeypatch.setattr(Arrays, "__getitem__", noted)
    for kind in STAGES:
        monkeypatch.setattr(kind, "build", noting_build(kind, kind.build))
    launch = wp.launch

    def launch_builders(kernel, *args, **kwargs):
        # Trees are built, not rendered: shapes hold their addresses.
        if kernel is build_wide_bvh_kernel:
            launch(kernel, *args, **kwargs)

    monkeypatch.setattr(wp, "launch", launch_builders)
    monkeypatch.setattr(wp, "launch_tiled", lambda *args, **kwargs: None)
    begin = Scheduler.__init__
    monkeypatch.setattr(
        Scheduler, "__init__", lambda self, *args, **more: (schedulers.append(self), begin(self, *args, **more))[1]
    )
    with Pipeline(scene, device="cpu", quality=quality, bands=1) as pipeline:
        for stage, passes in schedulers[0]._stages:
            for step in passes:
                if not step.on_host:
                    noting(stage.name, step.launch)(None)
    owners = {
        name: wiring.writes
        for kind, wiring in pipeline.plan.stages
        for name in kind(pipeline.plan.features, wiring).arrays()
    }
    return pipeline.plan, names, owners


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("scene", bundled_scenes())
def test_stages_read_what_they_declare(scene, preset, monkeypatch):
    plan, names, owners = taken(load_scene(scene), PRESETS[preset], monkeypatch)
    checked, undeclared = 0, []
    for kind, wiring in plan.stages:
        known = {*wiring.reads, *wiring.writes}
        for name in names[kind.name]:
            if name in INPUT_ARRAYS:
                needed = {INPUT_ARRAYS[name]}
            elif name in owners:
                # Scratch beside a resource is written with it.
                needed = {name} if name in owners[name] else set(owners[name])
            else:
                continue
            checked += 1
            if not needed & known:
                undeclared.append(f"{kind.name} takes {name!r}, declares {', '.join(wiring.reads)}")
    assert not undeclared
    assert checked > len(plan.stages)


def test_an_undeclared_read_is_found(monkeypatch):
    relight = next(kind for kind in STAGES if kind.name == "relight")
    wire = relight.wire
    monkeypatch.setattr(relight, "wire", lambda features: dataclasses.replace(wire(features), reads=("pose",)))
    with pytest.raises(AssertionError, match=r"relight takes .*, declares pose"):
        test_stages_read_what_they_declare("desk", "medium", monkeypatch)
