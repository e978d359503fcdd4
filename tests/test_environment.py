"""The command that writes an environment for another program."""

from __future__ import annotations

import pathlib

import numpy as np
import OpenEXR
import pytest

from warp_ar import environment
from warp_ar.output.environment_axes import to_axes
from warp_ar.output.environment_file import EnvironmentInfo, read_environment_info, write_environment


@pytest.fixture
def captured(tmp_path: pathlib.Path) -> pathlib.Path:
    path = tmp_path / "captured.exr"
    light = np.random.default_rng(0).random((8, 16, 3), np.float32)
    write_environment(path, light, info=EnvironmentInfo(exposure=0.5))
    return path


def pixels(path: pathlib.Path) -> np.ndarray:
    with OpenEXR.File(str(path)) as file:
        return np.array(file.channels()["RGB"].pixels)


def test_axes_time_and_place_are_written(captured: pathlib.Path) -> None:
    output = captured.parent / "new" / "out.exr"
    where = ["--place", "13.4", "52.5", "34", "--taken", "2026-05-01T12:00:00+02:00"]
    assert environment.main([str(captured), "--output", str(output), *where]) == 0
    np.testing.assert_array_equal(pixels(output), to_axes(pixels(captured), "y-up"))
    info = read_environment_info(output)
    assert (info.exposure, info.place[2]) == (0.5, 34.0)
    assert info.taken.isoformat() == "2026-05-01T10:00:00+00:00"


@pytest.mark.parametrize("name", ["out.hdr", "out.json", "out.exr"])
def test_every_ending_is_written(captured: pathlib.Path, name: str) -> None:
    output = captured.parent / name
    assert environment.main([str(captured), "--output", str(output), "--axes", "blender"]) == 0
    assert output.stat().st_size > 100


def test_a_cube_has_the_size_asked_for(captured: pathlib.Path) -> None:
    output = captured.parent / "out.exr"
    assert environment.main([str(captured), "--output", str(output), "--layout", "cube", "--size", "5"]) == 0
    assert pixels(output).shape == (30, 5, 3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--output", "out.png"], "ends in '.png'; use .exr, .hdr, .json"),
        (["--output", "out.exr", "--size", "5"], "add --layout cube"),
        (["--output", "out.exr", "--layout", "cube", "--axes", "blender"], "expected y-up, opengl for a cube"),
        (["--output", "out.exr", "--taken", "noon"], "'noon': expected a time"),
        (["--output", "out.exr", "--taken", "2026-05-01T12:00:00"], "expected a time with its zone"),
        (["--output", "captured.exr"], "is the same as the environment"),
    ],
)
def test_wrong_options_are_one_line(
    captured: pathlib.Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    folder = captured.parent
    options = [str(folder / option) if "." in option and "-" not in option else option for option in options]
    assert environment.main([str(captured), *options]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert [path.name for path in folder.iterdir()] == ["captured.exr"]


def test_a_missing_environment_is_one_line(tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert environment.main([str(tmp_path / "none.exr"), "--output", str(tmp_path / "o.exr")]) == 2
    assert "there is no file" in capsys.readouterr().err
