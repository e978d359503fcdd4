"""The paper's figures: what they compare, and what their numbers mean."""

from __future__ import annotations

import numpy as np
import pytest

from bench import paper_figures
from bench.paper_figures import FIGURES, READINGS, Context
from warp_ar.kernels.picture.expose import BOXES
from warp_ar.kernels.receiver.receiver import METHODS
from warp_ar.kernels.receiver.receiver import READINGS as BLENDS
from warp_ar.stages import STAGES
from warp_ar.stages.quality import PRESETS

pytest.importorskip("flip_evaluator")
pytest.importorskip("matplotlib")


def test_readings_can_be_run():
    for reading in READINGS:
        for stage, method in reading.methods.items():
            own = {"relight": (*METHODS, *BLENDS), "expose": BOXES}
            assert method in own.get(stage, next(one.methods for one in STAGES if one.name == stage))
    for question in {reading.question for reading in READINGS}:
        taken = [reading for reading in READINGS if reading.question == question and "(taken)" in reading.answer]
        assert len(taken) == 1
        assert not taken[0].methods
        assert not taken[0].video


@pytest.mark.slow
@pytest.mark.parametrize("number", [6, 8])
def test_figures_of_the_wire(number, device, monkeypatch):
    monkeypatch.setattr(paper_figures, "OURS", ("low",))
    monkeypatch.setattr(paper_figures, "PRESETS", {**PRESETS, "high": PRESETS["low"]})
    figure = FIGURES[number](Context(device, 6, 2))
    assert figure.number == number
    assert figure.picture.dtype == np.uint8
    assert all(len(row) == len(figure.head) for row in figure.rows)
    assert all(plot.startswith("<svg") for plot in figure.plots)
    rows = {row[0]: row[1:] for row in figure.rows}
    if number == 6:
        # The figure's point: structure as it is for a coincident light, inverted for an opposing one.
        assert float(rows["coincident, paper"][0]) > 0.3
        assert float(rows["opposing, paper"][0]) < -0.5
    if number == 8:
        assert list(rows) == ["plain", "paper", "low"]
        assert float(rows["low"][1]) < float(rows["paper"][1])
