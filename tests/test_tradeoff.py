"""The cost of every method: what is measured, what is told apart, and what the page shows."""

from __future__ import annotations

import base64
import dataclasses
import html.parser
import json
import re
import time

import numpy as np
import pytest
from rich.console import Console

from tests.test_pipeline import Frames, frames, make_scene  # noqa: F401  (a fixture)
from warp_ar import tradeoff
from warp_ar.accuracy import tradeoff_page
from warp_ar.accuracy.cost_table import SETTINGS, read_errors
from warp_ar.accuracy.metrics import ArrayError
from warp_ar.command_line import EXIT_DONE, EXIT_USAGE
from warp_ar.input.sources import Frame
from warp_ar.input.tracking import Tracker
from warp_ar.stages.quality import PRESETS

pytest.importorskip("flip_evaluator")

# Bilinear resampling of a cosine lobe from 32 rows.
MAP = 3e-3


def setting(name):
    return next(setting for setting in SETTINGS if setting.name == name)


@pytest.fixture(scope="module")
def case(frames: Frames) -> tradeoff.Case:
    scene = make_scene()
    tracker = Tracker(scene.marker, scene.camera)
    poses = tuple(tracker.track(image, index / 30).pose for index, image in enumerate(frames))
    assert all(pose is not None for pose in poses)
    # Brighter to the right and from frame to frame, so that there is a light with a direction, and it changes.
    ramp = np.linspace(0.2, 1.0, frames[0].shape[1])[None, :, None]
    images = [np.uint8(image * ramp * (0.7 + 0.1 * index)) for index, image in enumerate(frames)]
    shown = tuple(Frame(index, index / 30, image) for index, image in enumerate(images))
    return tradeoff.Case("made", scene, shown, poses, {})


# ------------------------------------------------------------------------------------------------------- measuring


def test_the_last_method_is_its_own_reference(case, device):
    rows, pictures = tradeoff.sweep(case, setting("irradiance"), device, PRESETS["low"])
    assert [row.method for row in rows] == list(setting("irradiance").methods)
    assert rows[-1].stage_error == ArrayError(0.0, 0.0, 0.0)
    assert rows[-1].flip == 0.0
    assert rows[-1].error == 0.0
    assert rows[0].stage_error.relative_rmse > 5.0 * rows[1].stage_error.relative_rmse > 0.0
    assert all(row.milliseconds > 0.0 for row in rows)
    assert set(pictures) == {("top_mip"), "sh2", "sh4", "clusters", "brute_force"}


def test_sparse_runs_keep_the_light(case, device):
    """Frames before the one that counts may run at another quality without a trace."""
    other = PRESETS["low"].with_methods(irradiance="sh4")
    full = tradeoff.run(case, PRESETS["low"], device, setting("recover"))
    sparse = tradeoff.run(case, PRESETS["low"], device, setting("recover"), between=other)
    np.testing.assert_array_equal(sparse.output, full.output)
    assert np.abs(sparse.images[3].astype(int) - full.images[3]).max() <= 1


def test_a_method_that_leaves_a_stage_out_costs_nothing_of_it(case, device):
    cheap = dataclasses.replace(setting("environment_shadow"), methods=("none", "coarse"))
    rows, _ = tradeoff.sweep(case, cheap, device, PRESETS["low"].with_methods(environment_shadow="none"))
    costs = {row.method: row.milliseconds for row in rows}
    assert costs["none"] == 0.0
    assert costs["coarse"] > 0.0


def test_what_the_ball_shows_is_compared_with_many_rays(case, device):
    """Every method leaves less of it than the one before; left out, all of it."""
    rows, _ = tradeoff.sweep(case, setting("mirror_ball"), device, PRESETS["low"])
    assert [row.method for row in rows] == ["none", "single", "smooth", "brute_force"]
    left = [row.stage_error.relative_rmse for row in rows]
    assert left[0] == pytest.approx(1.0)
    assert left[0] > left[1] > left[2] > left[3] == 0.0
    errors = [row.error for row in rows]
    assert errors[0] > max(errors[1:])
    assert errors[3] == 0.0


def test_truth_is_what_pictures_are_compared_with(case, device):
    truth = dataclasses.replace(case, truth={3: np.full_like(case.frames[3].image, 250)})
    rows, _ = tradeoff.sweep(truth, setting("expose"), device, PRESETS["low"])
    assert {row.against for row in rows} == {"truth"}
    assert all(row.flip > 0.1 for row in rows)
    assert min(row.error for row in rows) == 0.0


def test_dominated_means_in_every_respect():
    def row(method, ms, flip, rmse):
        return tradeoff.Row("c", "k", method, ms, ms, ArrayError(rmse, 0.0, 0.0), flip, "truth", flip, flip)

    rows = [row("a", 1.0, 0.3, 0.3), row("b", 2.0, 0.4, 0.4), row("c", 3.0, 0.3, 0.1), row("d", 4.0, 0.1, 0.1)]
    assert [tradeoff._is_dominated(one, rows) for one in rows] == [False, True, False, False]
    # What cannot be told apart counts as equal, and of equals the first stays.
    equal = [row("a", 1.0, 0.3, 0.3), row("b", 1.01, 0.3001, 0.301), row("c", 1.0, 0.3, 0.3)]
    assert [tradeoff._is_dominated(one, equal) for one in equal] == [False, True, True]


# ---------------------------------------------------------------------------------------------------- irradiance


@pytest.mark.parametrize("shape", [(4, 8), (32, 64), (7, 14)])
def test_resampling_keeps_a_constant_map(shape):
    np.testing.assert_allclose(tradeoff.resample(np.full((*shape, 3), 2.0, np.float32), tradeoff.NORMALS), 2.0)


def test_irradiance_of_both_forms_agrees():
    """Order 1, which a small map holds to its bilinear error: E = pi (1 + d / 2) for radiance 1 + 3/4 d, d one axis."""
    coefficients = np.zeros((9, 3))
    coefficients[0] = np.pi / 0.28209479
    for channel, index in enumerate((3, 1, 2)):  # x, y, z
        coefficients[index, channel] = 0.5 * np.pi / 0.48860251
    from_sh = tradeoff.irradiance_from_sh(coefficients)
    exact = np.pi * (1.0 + 0.5 * tradeoff._directions(32, 64))
    np.testing.assert_allclose(from_sh, np.pi * (1.0 + 0.5 * tradeoff._directions(*tradeoff.NORMALS)), rtol=1e-6)
    np.testing.assert_allclose(tradeoff.resample(exact, tradeoff.NORMALS), from_sh, rtol=MAP)


# ------------------------------------------------------------------------------------------------------ reporting


@pytest.fixture
def report(case) -> tradeoff.CaseReport:
    """A report of two methods, made up; names that HTML must escape."""
    rng = np.random.default_rng(0)
    index = case.shown[-1]
    camera = case.frames[index].image
    images = [
        np.clip(camera.astype(int) + rng.integers(0, add, camera.shape), 0, 255).astype(np.uint8) for add in (60, 5)
    ]
    rows = tuple(
        tradeoff.Row(case.name, "irradiance", method, ms, ms + 3.0, error, flip, "last method", flip, flip, False)
        for method, ms, error, flip in (("top_mip", 0.5, ArrayError(0.3, 2.0, -0.01), 0.1), ("sh2", 1.0, None, 0.0))
    )
    wholes = tuple(
        tradeoff.Whole(label, ms, flip, {"irradiance": "sh2"}, {index: image})
        for label, ms, flip, image in (
            ("paper", 10.0, 0.3, images[0]),
            ("ours in the paper's time", 9.0, 0.2, images[1]),
        )
    )
    region = np.zeros(camera.shape[:2], bool)
    region[100:140, 60:90] = True
    pictures = {("irradiance", "top_mip"): images[0], ("irradiance", "sh2"): images[1]}
    named = dataclasses.replace(case, name="<made> & so on")
    return tradeoff.CaseReport(named, {index: images[1]}, rows, pictures, wholes, region)


class Checker(html.parser.HTMLParser):
    """Every tag that opens closes, in order."""

    VOID = ("meta", "img")

    def __init__(self):
        super().__init__()
        self.open: list[str] = []
        self.images: list[str] = []

    def handle_starttag(self, tag, attrs):
        if tag == "img":
            self.images.append(dict(attrs)["src"])
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        pass

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_page_is_whole_and_needs_nothing_else(report):
    camera = report.case.frames[-1].image
    shown = tradeoff.Figure("Figure 7", "text", (("camera", camera), ("ours", camera)), camera, None)
    page = tradeoff_page.render([report], [shown], {"device": "this <one>", "warp": "1"})
    checker = Checker()
    checker.feed(page)
    assert checker.open == []
    assert "&lt;made&gt; &amp; so on" in page
    assert "this &lt;one&gt;" in page
    assert not re.search(r"""(src|href)=["'](?!data:|#)""", page)
    assert "<script" not in page
    assert len(checker.images) > 10
    for source in checker.images:
        code = re.fullmatch(r"data:image/webp;base64,(.+)", source).group(1)
        assert base64.b64decode(code)[:4] == b"RIFF"


@pytest.mark.parametrize("points", [[("one", 1.0, 0.0, False)], [("a", 0.0, 0.1, False), ("b", 900.0, 1e-7, True)]])
def test_charts_stay_inside(points):
    chart = tradeoff_page.scatter(points, "ms", "error")
    for name, size in (("cx", tradeoff_page.PLOT[0]), ("cy", tradeoff_page.PLOT[1])):
        values = [float(value) for value in re.findall(rf'{name}="([^"]+)"', chart)]
        assert len(values) == len(points)
        assert all(0.0 <= value <= size for value in values)


def test_crops_lie_around_what_is_to_be_seen():
    region = np.zeros((480, 640), bool)
    region[400:470, 600:630] = True
    region[0, 0] = True  # one stray pixel
    rows, columns = tradeoff_page.bounding_box(region, region.shape)
    assert rows.start <= 400 <= 470 <= rows.stop <= 480
    assert columns.start <= 600 <= 630 <= columns.stop <= 640
    assert rows.stop - rows.start < 200
    assert tradeoff_page.bounding_box(np.zeros((48, 64), bool), (48, 64)) == (slice(0, 48), slice(0, 64))


def test_records_and_tables_hold_every_method(report):
    device = tradeoff.wp.get_device("cpu")
    lines = [json.loads(json.dumps(record)) for record in tradeoff.records(report, device)]
    assert [line["kind"] for line in lines] == ["method", "method", "whole", "whole"]
    assert lines[0]["relative_rmse"] == 0.3
    console = Console(width=120, record=True, quiet=False, file=open("/dev/null", "w"))  # noqa: SIM115
    with console.file:
        tradeoff.print_report(report, console)
    text = console.export_text()
    assert all(word in text for word in ("top_mip", "sh2", "30.00%", "ours in the paper's time"))


def test_price_list_is_what_ladder_reads(report):
    made = tradeoff.make_cost_table([report, report], tradeoff.wp.get_device("cpu"))
    errors = read_errors(json.loads(json.dumps(made)))
    assert errors["irradiance"]["top_mip"] == pytest.approx(0.1)
    assert errors["irradiance"]["sh2"] == 0.0
    assert made["stage_errors"]["irradiance"] == {"top_mip": 0.3}


def test_choices_are_made_from_the_committed_list(report, monkeypatch):
    """Not from the errors of the case that they are scored on, unless there is no list yet."""
    listed = {"irradiance": {"top_mip": 0.7, "sh2": 0.2}}
    monkeypatch.setattr(tradeoff, "load_errors", lambda: listed)
    assert tradeoff.listed_errors(report.rows) is listed
    monkeypatch.setattr(tradeoff, "load_errors", lambda: {"irradiance": {"top_mip": 0.0, "sh2": 0.0}})
    assert tradeoff.listed_errors(report.rows) == {"irradiance": {"top_mip": 0.1, "sh2": 0.0}}


# ------------------------------------------------------------------------------------------------------------ truth


def test_bundled_scenes_end_with_their_truth():
    case = tradeoff.open_scene("desk", 2, 4)
    assert len(case.frames) == 2
    assert list(case.truth) == [1]
    region = case.regions[1]
    camera, truth = case.frames[1].image, case.truth[1]
    assert 0.05 < region.mean() < 0.5
    # Nothing virtual, nothing changed.
    np.testing.assert_array_equal(truth[~region], camera[~region])
    assert np.abs(truth[region].astype(int) - camera[region]).mean() > 5.0


def test_where_nothing_clips_the_truth_of_a_shorter_exposure_is_known():
    case = tradeoff.open_scene("darken", 1, 1)
    camera, truth, region = case.frames[0].image, case.truth[0], case.regions[0]
    decode = tradeoff.decode_table("srgb")[:, 0]
    scaled = 0.5 * decode[camera[~region]]
    # Rounding to a code: half of the step between codes there.
    assert np.abs(decode[truth[~region]] - scaled).max() <= 0.51 * np.diff(decode).max()
    assert region[(camera >= 255).any(-1)].mean() > 0.95


@pytest.mark.parametrize("scale", [0.0, 0.3, 1.0])
def test_scaling_codes_is_scaling_radiance(scale):
    image = np.arange(256, dtype=np.uint8)[None, :, None].repeat(3, -1)
    scaled = tradeoff.scale_codes(image, scale, "linear")
    np.testing.assert_array_equal(scaled[0, :, 0], np.floor(np.arange(256) * scale + 0.5))


def test_in_turn_is_alone(case, device):
    """Qualities that run in turn do not touch each other."""
    qualities = {"a": PRESETS["low"], "b": PRESETS["low"].with_methods(irradiance="sh4")}
    times, images = tradeoff.run_in_turn(case, qualities, device, time.perf_counter)
    for label, quality in qualities.items():
        alone = tradeoff.run(case, quality, device)
        np.testing.assert_array_equal(images[label][3], alone.images[3])
        assert len(times[label]) == len(case.frames) - tradeoff.WARM_UP


# --------------------------------------------------------------------------------------------------- the command


def test_command_writes_all_three(tmp_path, monkeypatch, capsys, device):
    monkeypatch.setattr(tradeoff, "RUNS", ("low",))
    monkeypatch.setattr(tradeoff, "BASE", PRESETS["low"])
    arguments = ["darken", "--stage", "expose", "--frames", "2", "--shrink", "4", "--device", device]
    assert tradeoff.main([*arguments, "--out", str(tmp_path / "out")]) == EXIT_DONE
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "tradeoff.html",
        "tradeoff.jsonl",
        "cost_table.json",
    }
    lines = (tmp_path / "out" / "tradeoff.jsonl").read_text().splitlines()
    assert [json.loads(line)["method"] for line in lines[:4]] == list(setting("expose").methods)
    assert "expose" in capsys.readouterr().out


def test_presets_alone(tmp_path, monkeypatch, device):
    monkeypatch.setattr(tradeoff, "RUNS", ("paper", "low"))
    arguments = ["darken", "--presets", "--frames", "2", "--shrink", "4", "--device", device]
    assert tradeoff.main([*arguments, "--out", str(tmp_path)]) == EXIT_DONE
    assert {path.name for path in tmp_path.iterdir()} == {"presets.json", "tradeoff.jsonl"}
    listed = json.loads((tmp_path / "presets.json").read_text())
    assert listed["made"]["against"] == "truth"
    assert set(listed["errors"]) == {"darken"}
    assert set(listed["errors"]["darken"]) == {"paper", "low"}
    assert all(0.0 < error < 1.0 for error in listed["errors"]["darken"].values())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["desk", "--presets", "--stage", "irradiance"], "--presets --stage irradiance: expected one of both"),
        (["desk", "--frames", "0"], "--frames 0: expected 1 or more"),
        (["desk", "--shrink", "0"], "--shrink 0: expected 1 or more"),
        (["desk", "--stage", "colour", "--frames", "1"], "--stage colour: expected one of environment_height"),
        (["--truth", "TMP"], "expected folders with scene_"),
        (["darken", "--stage", "irradiance", "--frames", "1"], "nothing to turn"),
    ],
)
def test_bad_usage_is_one_line(arguments, message, tmp_path, capsys):
    arguments = [str(tmp_path) if argument == "TMP" else argument for argument in arguments]
    assert tradeoff.main(arguments) == EXIT_USAGE
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
