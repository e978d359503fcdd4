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


def test_all_figures_of_results_are_there():
    """Figure 2 is a photograph of the ball."""
    assert list(FIGURES) == [1, 3, 4, 5, 6, 7, 8, 9]


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


def test_kept_error_is_a_share_of_what_is_asked():
    camera, truth = np.full((4, 6, 3), 100, np.uint8), np.full((4, 6, 3), 180, np.uint8)
    region = np.ones((4, 6), bool)
    assert paper_figures.kept_error(camera, truth, camera, region) == 1.0
    assert paper_figures.kept_error(camera, truth, truth, region) == 0.0
    assert paper_figures.kept_error(camera, truth, np.full_like(camera, 160), region) == 0.25


def test_the_plane_is_where_the_marker_says():
    """The card's centre is the world's origin: some pixel of the printed marker sees (0, 0)."""
    case = Context("cpu", 1, 4).case("wire_coincident")
    points, inside = paper_figures._plane_points(case, 0)
    distance = np.hypot(points[..., 0], points[..., 1])
    row, column = np.unravel_index(distance.argmin(), distance.shape)
    assert inside[row, column]
    assert distance.min() < 0.005
    marker = case.frames[0].image[row - 3 : row + 4, column - 3 : column + 4]
    assert int(marker.max()) - int(marker.min()) > 60  # black and white cells


def test_detail_and_structure_leave_falloff_out():
    x = np.linspace(-1.0, 1.0, 200)
    falloff = 1.0 + 0.3 * x + 0.2 * x * x
    np.testing.assert_allclose(paper_figures._detail(falloff), 0.0, atol=1e-12)
    assert paper_figures._structure(falloff) < 1e-12
    assert paper_figures._structure(falloff * (1.0 + 0.1 * np.sin(40.0 * x))) == pytest.approx(
        0.1 / np.sqrt(2), rel=0.05
    )


@pytest.mark.parametrize("number", [5, 6, 8])
def test_figures_of_the_wire(number, device, monkeypatch):
    monkeypatch.setattr(paper_figures, "OURS", ("low",))
    monkeypatch.setattr(paper_figures, "PRESETS", {**PRESETS, "high": PRESETS["low"]})
    figure = FIGURES[number](Context(device, 6, 2))
    assert figure.number == number
    assert figure.picture.dtype == np.uint8
    assert all(len(row) == len(figure.head) for row in figure.rows)
    assert all(plot.startswith("<svg") for plot in figure.plots)
    rows = {row[0]: row[1:] for row in figure.rows}
    if number == 5:
        camera, model = (float(row[0].rstrip("%")) for row in rows.values())
        assert camera > 2.0 * model  # what the model leaves out is in the frame
    if number == 6:
        # The figure's point: structure as it is for a coincident light, inverted for an opposing one.
        assert float(rows["coincident, paper"][0]) > 0.3
        assert float(rows["opposing, paper"][0]) < -0.5
    if number == 8:
        assert list(rows) == ["plain", "paper", "low"]
        assert float(rows["low"][1]) < float(rows["paper"][1])


def test_the_environment_and_its_filtered_map(device, monkeypatch):
    monkeypatch.setattr(paper_figures, "PRESETS", {**PRESETS, "high": PRESETS["low"]})
    figure = FIGURES[3](Context(device, 2, 2))
    rows = {row[0]: row[1:] for row in figure.rows}
    assert float(rows["paper"][1]) < 1.3  # as the camera clips, over the ball's reflectance
    assert float(rows["high"][1]) > float(rows["paper"][1])
    assert 0.0 < float(rows["paper"][3].rstrip("%")) < 100.0
