"""Row 17: the same input gives the same bits: run to run, in 1 to 16 bands, replayed from a graph or launched."""

from __future__ import annotations

import numpy as np
import pytest

from tests.hard_cases import generators
from tests.hard_cases.rig import METHODS, SIZE, STAGE_METHODS, Rig, assert_same_bits, cases

FRAMES = generators.frames(SIZE[1], SIZE[0])


REMEMBERS = ("recover",)
"""Stages that keep something on the host from frame to frame, which a rig cannot put back."""


@pytest.mark.atlas(row=17)
@pytest.mark.parametrize(("stage", "method"), cases(*REMEMBERS))
def test_from_the_first_frame_on(device, stage, method):
    """A whole sequence again, from the start and in other bands."""
    found = []
    for bands in (1, 1, 3, 16):
        with Rig(device, stage, method, bands=bands) as rig:
            for name in ("noise", "white", "ramp", "torn", "noise"):
                rig.frame(FRAMES[name])
            found.append(rig.written(stage))
    for other in found[1:]:
        assert_same_bits(found[0], other)


@pytest.mark.slow
@pytest.mark.atlas(row=17)
@pytest.mark.parametrize(("stage", "method"), [case for case in STAGE_METHODS if case[0] not in REMEMBERS])
def test_run_to_run_and_in_any_bands(rig_for, stage, method):
    """What a stage writes is a function of what it reads and of its own state before."""
    rig = rig_for(stage, method)
    state = rig.state()
    first = rig.run(stage)
    for bands in (1, 2, 5, 16):
        rig.restore(state)
        assert_same_bits(first, rig.run(stage, bands=bands))


@pytest.mark.atlas(row=17)
@pytest.mark.parametrize(("stage", "method"), cases(*METHODS))
def test_outputs_do_not_depend_on_what_stood_in_them(rig_for, stage, method):
    """Stages without a memory of their own write every element that a reader may look at."""
    if stage in ("accumulate", "expose", "recover"):
        pytest.skip("keeps a state from frame to frame")
    rig = rig_for(stage, method)
    state = rig.state()
    first = rig.run(stage)
    rig.restore(state)
    for name in first:
        values = rig.get(name)
        if values.dtype.names is None and values.dtype.kind == "f":
            rig.poke(name, np.full_like(values, 3.0))
    second = rig.run(stage)
    if stage == "near_field":  # defined where an object is seen
        seen = rig.get("hit_object") >= 0
        first, second = ({name: values[seen] for name, values in outputs.items()} for outputs in (first, second))
    assert_same_bits(first, second)
