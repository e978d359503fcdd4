"""Rigs that tests of hard cases share: one a combination of methods, put back into its first state every time."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from tests.hard_cases.generators import frames
from tests.hard_cases.rig import SIZE, Rig, combination_of

_RIGS: dict[tuple[str, str], tuple[Rig, dict[str, np.ndarray]]] = {}


@pytest.fixture
def rig_for(device: str) -> Callable[..., Rig]:
    """A rig of a combination, or whose plan holds a stage on a method, as it was after two frames of noise."""

    def made(stage: str, method: str | None = None) -> Rig:
        name = stage if method is None else combination_of(stage, method)
        key = device, name
        if key not in _RIGS:
            rig = Rig(device, combination=name)
            for name in ("noise", "torn"):  # two: the first has no time step
                rig.frame(frames(SIZE[1], SIZE[0])[name])
            _RIGS[key] = rig, rig.state()
        rig, state = _RIGS[key]
        rig.restore(state)
        return rig

    return made


@pytest.fixture(scope="session", autouse=True)
def _close_rigs():
    yield
    for rig, _ in _RIGS.values():
        rig.pipeline.close()
    _RIGS.clear()
