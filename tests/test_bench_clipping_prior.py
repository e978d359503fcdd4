"""What one number makes up for where light clips, on maps whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest

from bench.bench_clipping_prior import errors_of, metered_level, summarise
from warp_ar.light.config import CONFIG

ROUNDING = 1e-4
"""float32 sums over the map."""


def lamp(radiance: float) -> np.ndarray:
    """A grey room with a lamp."""
    found = np.full((64, 128, 3), 0.2, np.float32)
    found[4:12, 20:40] = radiance
    return found


def test_a_lamp_of_one_radiance_is_made_up_for_by_its_number() -> None:
    """It lacks twice the level: 2 puts it right, 4 is as far off as nothing, and four stops later it does not clip."""
    found = errors_of(lamp(3.0), 1.0)
    assert found["missing"] == pytest.approx(2.0, rel=ROUNDING)
    assert found["2.0"] == pytest.approx(0.0, abs=ROUNDING)
    assert found["best"] == pytest.approx(0.0, abs=ROUNDING)
    assert found["4.0"] == pytest.approx(found["clipped"], rel=ROUNDING)
    assert found["1.0"] == pytest.approx(0.5 * found["clipped"], rel=ROUNDING)
    assert found["stops_4"] == 0.0
    assert found["clipped"] > 0.05


def test_worse_is_counted_by_number() -> None:
    """Of a lamp that lacks twice and one that lacks half of the level, 1.5 makes the second worse."""
    found = summarise([errors_of(lamp(3.0), 1.0), errors_of(lamp(1.5), 1.0)])
    assert found["exposures"] == 2
    assert found["worse"]["0.5"] == 0.0
    assert found["worse"]["1.5"] == 0.5
    assert found["error"]["0.5"] < found["error"]["clipped"]
    assert found["worse"]["least"] == 0.0
    # A lamp that hardly clips would become worse by the program's own rule.
    assert summarise([errors_of(lamp(1.1), 1.0)])["worse"]["least"] == 1.0
    assert summarise([errors_of(lamp(1.1), 1.0)])["allowed"][0] < CONFIG.least.least


def test_metering_puts_the_frame_at_grey() -> None:
    """A frame of 0.09 clips at half; a stop less at 1."""
    grey = np.full((64, 128, 3), 0.09, np.float32)
    assert metered_level(grey, 5, 0.0) == pytest.approx(0.5)
    assert metered_level(grey, 5, 1.0) == pytest.approx(1.0)
