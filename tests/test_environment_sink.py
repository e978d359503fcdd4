"""Environments as OpenEXR files, one or a folder of them: exact, numbered, with errors that help."""

from __future__ import annotations

import pathlib

import numpy as np
import OpenEXR
import pytest

from tests.test_sinks import flat, no_thread_left, radiance  # noqa: F401  (a fixture)
from warp_ar.errors import SinkError
from warp_ar.output.environment_file import read_environment, write_environment
from warp_ar.output.sinks import EnvironmentSink

pytestmark = pytest.mark.slow


def test_environment_round_trip_is_exact(tmp_path: pathlib.Path) -> None:
    path = tmp_path / "new" / "0000.exr"
    write_environment(path, radiance())
    assert np.array_equal(read_environment(path), radiance())
    with OpenEXR.File(str(path)) as file:
        assert file.header()["compression"] == OpenEXR.ZIP_COMPRESSION
        assert file.channels()["RGB"].pixels.dtype == np.float32
        assert np.array_equal(file.channels()["RGB"].pixels, radiance())


def test_environment_of_a_view_is_the_view(tmp_path: pathlib.Path) -> None:
    write_environment(tmp_path / "e.exr", radiance()[::-1, ::2])
    assert np.array_equal(read_environment(tmp_path / "e.exr"), radiance()[::-1, ::2])


def test_environment_from_separate_channels_and_half(tmp_path: pathlib.Path) -> None:
    small = np.clip(radiance(), 0, 100).astype(np.float16)
    channels = {name: np.ascontiguousarray(small[..., index]) for index, name in enumerate("RGB")}
    channels["Z"] = channels["R"]
    OpenEXR.File({"type": OpenEXR.scanlineimage}, channels).write(str(tmp_path / "e.exr"))
    assert np.array_equal(read_environment(tmp_path / "e.exr", axes="z-up"), small.astype(np.float32))
    OpenEXR.File({"type": OpenEXR.scanlineimage}, {"Z": channels["R"]}).write(str(tmp_path / "z.exr"))
    with pytest.raises(SinkError, match="R, G and B"):
        read_environment(tmp_path / "z.exr")


def test_environment_errors(tmp_path: pathlib.Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "folder.exr").mkdir()
    (tmp_path / "file").write_text("")
    (tmp_path / "bad.exr").write_bytes(b"no picture")
    with pytest.raises(SinkError, match="float32"):
        write_environment(tmp_path / "e.exr", radiance().astype(np.float64))
    with pytest.raises(SinkError, match="is a folder"):
        write_environment(tmp_path / "folder.exr", radiance())
    with pytest.raises(SinkError, match="cannot be written"):
        write_environment(tmp_path / "file" / "e.exr", radiance())
    with pytest.raises(SinkError, match="there is no file"):
        read_environment(tmp_path / "none.exr")
    with pytest.raises(SinkError, match="cannot be read"):
        read_environment(tmp_path / "bad.exr")
    capfd.readouterr()


def test_environment_sink_numbers_its_files(tmp_path: pathlib.Path) -> None:
    with EnvironmentSink(tmp_path / "env") as sink:
        for index in range(6):
            sink.write(radiance() + np.float32(index))
        with pytest.raises(SinkError, match="float32"):
            sink.write(flat(0))
    for index in range(6):
        assert np.array_equal(read_environment(tmp_path / "env" / f"{index:04d}.exr"), radiance() + np.float32(index))


def test_light_of_balls_of_an_earlier_run_goes(tmp_path: pathlib.Path) -> None:
    for folder in (tmp_path, tmp_path / "ball_1", tmp_path / "ball_2", tmp_path / "ball_room"):
        with EnvironmentSink(folder) as sink:
            sink.write(radiance())
            sink.write(radiance())
    theirs = tmp_path / "ball_2" / "0007.exr"
    theirs.write_bytes(b"somebody's")
    with EnvironmentSink(tmp_path) as sink:
        assert (tmp_path / "ball_1" / "0001.exr").exists(), "nothing goes before there is a frame"
        assert sink.replaced.endswith("ball_*: 4 environments of an earlier run are removed")
        sink.write(radiance())
    assert not (tmp_path / "ball_1").exists()
    assert list((tmp_path / "ball_2").iterdir()) == [theirs]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0000.exr", "ball_2", "ball_room"]
    assert len(list((tmp_path / "ball_room").iterdir())) == 2


def test_shared_environments_load(shared: pathlib.Path) -> None:
    paths = sorted((shared / "hdri").glob("*.exr"))
    assert paths
    assert read_environment(paths[0]).shape == (512, 1024, 3)
