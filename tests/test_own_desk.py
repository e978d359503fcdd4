"""The words of "Your own desk" followed from an empty folder, on a desk that is made at random."""

from __future__ import annotations

import imageio.v3
import numpy as np
import pytest

from tests.random_desk import RandomDesk
from warp_ar import calibrate, doctor, init, live
from warp_ar.light.captured import latlong_directions, texel_solid_angles
from warp_ar.output.environment_file import read_environment
from warp_ar.scene import load_scene

pytestmark = pytest.mark.slow

FOCAL = 0.005
"""Share of the focal length: what a user is promised."""
BALL_MM = 0.5
"""Of the radius and of the centre: what a user is promised."""
LIGHT = 0.2
"""Of the irradiance from any side: what a user is promised."""


def irradiance(environment, normal):
    """Irradiance (3,) on a surface that faces along ``normal``."""
    height = len(environment)
    weight = np.clip(latlong_directions(height) @ normal, 0, None) * texel_solid_angles(height)
    return (environment * weight[..., None]).sum((0, 1))


SEED = 2


def test_from_an_empty_folder(tmp_path, capsys):
    folder = tmp_path / "my_desk"
    frames, photos = tmp_path / "frames", tmp_path / "photos"
    assert init.main([str(folder), "--radius", "0.031", "--source", str(frames)]) == 0
    desk = RandomDesk(folder / "card-a4.pdf", SEED)
    for place in (frames, photos):
        place.mkdir()
    for k in range(14):
        turn, tilt, far = 2.4 * k, np.radians((12, 32, 48)[k % 3]), 0.30 + 0.02 * (k % 4)
        shift = np.array([0.06 * np.cos(1.3 * k), 0.04 * np.sin(1.3 * k), 0.0])
        eye = shift + far * np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
        imageio.v3.imwrite(photos / f"{k:04d}.png", desk.photograph(eye, shift, 77.0 * k, ball=False))
    for k in range(12):
        turn = np.radians(-90 + 60 * np.sin(k / 2))
        eye = np.array([0.45 * np.cos(turn), 0.06 + 0.45 * np.sin(turn), 0.32 + 0.05 * np.cos(k)])
        imageio.v3.imwrite(frames / f"{k:04d}.png", desk.photograph(eye, (0.0, 0.06, 0.0)))

    assert calibrate.main(["camera", str(photos), "--write", str(folder)]) == 0
    assert f"next: python -m warp_ar.calibrate ball {folder} --write" in capsys.readouterr().out
    found = load_scene(folder).camera
    assert abs(found.fx / desk.camera.fx - 1) < FOCAL
    assert abs(found.fy / desk.camera.fy - 1) < FOCAL
    text = (folder / "scene.toml").read_text()
    assert "[camera]\ncalibration" in text, "what is said of the guess outlives it"

    assert calibrate.main(["ball", str(folder), "--write"]) == 0
    probe = load_scene(folder).probes[0]
    assert abs(probe.radius - desk.radius) * 1e3 < BALL_MM
    assert np.linalg.norm(np.subtract(probe.center, desk.center)) * 1e3 < BALL_MM

    assert doctor.main([str(folder)]) == 0, capsys.readouterr().out

    environment = tmp_path / "environment"
    arguments = [str(folder), "--headless", "--device", "cpu", "--quality", "low", "--save-environment"]
    assert live.main([*arguments, str(environment)]) == 0, capsys.readouterr().err
    found = read_environment(sorted(environment.iterdir())[-1])
    truth = desk.light(found.shape[0])
    for normal in (*np.eye(3), *-np.eye(3)):
        ratio = irradiance(found, normal) / irradiance(truth, normal)
        assert np.abs(ratio - 1).max() < LIGHT, (normal, ratio)
