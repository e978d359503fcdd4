"""The simulated camera does what its fields say."""

import dataclasses

import cv2
import numpy as np
import pytest

from tests.simulated_camera import ALL, ALONE, Faults, decode_srgb, expose, faults_named

MIRRORED = 0.05
"""Relative: codes of a frame of a quarter of the exposure lie 1 to 2 % apart, and it has a path tracer's noise."""


def one(light, **faults):
    return expose([light], Faults(**faults), phase=[0.0])[0]


def test_a_perfect_camera_is_srgb():
    ramp = np.repeat(np.linspace(0, 1.3, 128)[None, :, None], 96, 0).repeat(3, 2)
    codes = one(ramp)
    assert np.abs(decode_srgb(codes) - np.clip(ramp, 0, 1)).max() < 0.005  # half a code where sRGB is steepest
    assert (codes[:, -1] == 255).all()


def test_distortion_is_opencvs():
    board = np.zeros((240, 320, 3))
    board[60:180, 80:240] = 0.8
    seen = one(board, distortion=-0.2)[..., 1].astype(float)
    matrix = np.array([[320.0, 0, 159.5], [0, 320.0, 119.5], [0, 0, 1]])
    corner = np.array([[(79.5 - 159.5) / 320, (59.5 - 119.5) / 320, 1.0]])
    want = cv2.projectPoints(corner, np.zeros(3), np.zeros(3), matrix, np.array([-0.2, 0, 0, 0, 0]))[0].ravel()
    edge_x = np.interp(-seen.max() / 2, -seen[120, 160:60:-1], np.arange(160, 60, -1))
    inside = seen[int(round(want[1])) + 2, int(round(want[0])) + 2]
    outside = seen[int(round(want[1])) - 2, int(round(want[0])) - 2]
    assert inside > 180
    assert outside < 20
    assert edge_x > 80.0  # k1 below 0 draws the picture in


def test_noise_grows_with_light_and_the_curve_has_contrast():
    noise = [decode_srgb(one(np.full((96, 96, 3), level), noise=0.02)).std() for level in (0.05, 0.5)]
    assert noise[1] / noise[0] == pytest.approx(np.sqrt((0.5 + 0.01) / (0.05 + 0.01)), rel=0.1)
    dark, bright = (int(one(np.full((8, 8, 3), level), s_curve=1.0)[0, 0, 0]) for level in (0.03, 0.5))
    assert dark < int(one(np.full((8, 8, 3), 0.03))[0, 0, 0]) - 7
    assert bright > int(one(np.full((8, 8, 3), 0.5))[0, 0, 0]) + 8


def test_every_fault_changes_the_picture():
    light = np.random.default_rng(1).random((64, 96, 3)) * np.linspace(0.1, 1.4, 96)[None, :, None]
    plain = expose([light] * 7, ALONE["none"])
    for name, faults in [*ALONE.items(), ("all", ALL)]:
        assert any((a != b).any() for a, b in zip(expose([light] * 7, faults), plain, strict=True)) == (name != "none")
    used = {f.name for f in dataclasses.fields(Faults) if getattr(ALL, f.name) != f.default}
    assert used == {f.name for f in dataclasses.fields(Faults)} - {"seed"}


def test_what_clips_in_the_ball_is_what_a_shorter_exposure_shows(shared):
    """Frames of a quarter of the exposure tell as far as four times what clips."""
    bench = pytest.importorskip("bench.bench_camera_faults", reason="needs flip-evaluator and the benches")
    case = shared / "truth" / "plastic_bunny_sunset"
    light = bench.light_of(case / "camera" / "0006.png", bench.mirrored_light(case, 6))
    dark = bench.read(case / "dark_25" / "0006.png")
    told = (light > 1.0) & (dark < 254) & (light < bench.BEYOND)
    ratio = light[told] / (4.0 * decode_srgb(dark[told]))
    assert told.sum() > 500
    assert np.abs(np.quantile(ratio, [0.05, 0.5, 0.95]) - 1.0).max() < MIRRORED


@pytest.mark.parametrize("name", [name for name in ALONE if name not in ("none", "mjpeg")])
def test_all_but_one_leaves_out_that_one_alone(name):
    """``mjpeg`` is none of all."""
    without, alone, nothing = faults_named(f"all_but_{name}"), faults_named(name), faults_named("none")
    fields = [field.name for field in dataclasses.fields(Faults)]
    changed = [field for field in fields if getattr(without, field) != getattr(ALL, field)]
    assert changed == [field for field in fields if getattr(alone, field) != getattr(nothing, field)] != []
    assert all(getattr(without, field) == getattr(nothing, field) for field in changed)
