"""The command, from its arguments to its files, messages and exit codes."""

from __future__ import annotations

import fractions
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import av
import cv2
import numpy as np
import OpenEXR
import pytest

from warp_ar import live
from warp_ar.checks.check_ball import is_printed
from warp_ar.output.environment_file import read_environment
from warp_ar.output.places import folder_to_oneself
from warp_ar.scene import Marker, Pose, load_scene
from warp_ar.scene.description import CharucoBoard
from warp_ar.sources.synthetic import Synthetic

pytestmark = pytest.mark.slow

FRAMES = 4
# Lines of a terminal.
SCREEN = 40

SCENE = """
schema = 1
name = "small"
[camera]
width = {width}
height = {height}
fx = {fx}
fy = {fy}
cx = {cx}
cy = {cy}
[source]
{source}
[marker]
size = {marker}
{body}
"""
PROBE = """
[probe]
center = [-0.1, 0.03, 0.03]
radius = 0.03
"""
OBJECT = """
[[object]]
shape = "sphere"
radius = 0.03
at = [0.1, 0.0, 0.03]
[object.material]
model = "lambert"
base_color = [0.5, 0.5, 0.5]
"""


def write_scene(folder: Path, body: str = PROBE + OBJECT, source: str = 'synthetic = "card"', **changes: float) -> Path:
    with Synthetic("card") as card:
        matrix, (width, height) = card.camera_matrix, card.size
    values = {
        "width": width,
        "height": height,
        "fx": matrix[0, 0],
        "fy": matrix[1, 1],
        "cx": matrix[0, 2],
        "cy": matrix[1, 2],
    }
    path = folder / "scene.toml"
    path.write_text(SCENE.format(body=body, source=source, marker=Synthetic.MARKER_SIZE, **{**values, **changes}))
    return path


def run(*arguments: object) -> int:
    return live.main([str(argument) for argument in ("--device", "cpu", "--quality", "low", *arguments)])


def message(capsys: pytest.CaptureFixture[str]) -> str:
    """The one line that an error prints."""
    text = capsys.readouterr().err
    assert text.startswith("warp_ar: ")
    assert text.count("\n") == 1, text
    return text


def test_every_balls_environment_is_kept(tmp_path: Path) -> None:
    """The first one's where one ball's would lie, each other one's in a folder below."""
    two = PROBE.replace("[probe]", "[[probe]]") + "[[probe]]\ncenter = [0.1, 0.03, 0.03]\nradius = 0.03\n"
    scene, light = write_scene(tmp_path, body=two + OBJECT), tmp_path / "light"
    assert run(scene, "--headless", "--frames", 2, "--save-environment", light) == 0
    names = ("0000.exr", "0001.exr")
    assert sorted(path.name for path in light.iterdir()) == [*names, "ball_1"]
    assert sorted(path.name for path in (light / "ball_1").iterdir()) == [*names]
    assert (read_environment(light / "0001.exr") != read_environment(light / "ball_1" / "0001.exr")).any()


def test_folder_report_and_environment(tmp_path: Path) -> None:
    scene = write_scene(tmp_path)
    out, light, report = tmp_path / "out", tmp_path / "light", tmp_path / "reports" / "run.json"
    assert (
        run(scene, "--headless", "--frames", FRAMES, "--output", out, "--save-environment", light, "--report", report)
        == 0
    )
    assert sorted(path.name for path in out.iterdir()) == [f"{index:04d}.png" for index in range(FRAMES)]
    assert sorted(path.name for path in light.iterdir()) == [f"{index:04d}.exr" for index in range(FRAMES)]
    assert read_environment(light / "0000.exr").shape == (64, 128, 3)
    data = json.loads(report.read_text())
    assert {"decode", "track", "render", "encode"} <= set(data["steps_ms"])
    assert data["steps_ms"][data["critical_path"]] == max(data["steps_ms"].values())
    assert data["device"] == "cpu"
    assert data["quality"] == "low"
    assert data["warp"]
    assert [frame["index"] for frame in data["frames"]] == list(range(FRAMES))
    assert data["stages_run"][:2] == ["track", "unwrap"]
    assert {"key_lights", "prefilter", "summed_area", "relight", "expose"} <= {
        entry["stage"] for entry in data["stages_left_out"]
    }
    with Synthetic("card") as card:
        for frame in data["frames"]:
            rotation, translation = card.pose(frame["index"])
            np.testing.assert_allclose(frame["pose"]["R"], rotation, atol=0.02)
            np.testing.assert_allclose(frame["pose"]["t"], translation, atol=0.01)
            assert set(frame["stages"]) <= set(data["stages_run"])


def test_video_and_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    video = tmp_path / "lit.mp4"
    assert run(write_scene(tmp_path), "--frames", FRAMES, "--output", video) == 0
    with av.open(str(video)) as container:
        assert container.streams.video[0].codec_context.name == "h264"
        assert sum(1 for _ in container.decode(video=0)) == FRAMES
    lines = capsys.readouterr().out.rstrip().splitlines()[-4:]
    assert lines[0].startswith(f"small: 640x480, {FRAMES} frames, ")
    assert lines[1] == f"written to {video}"
    assert lines[2] == "nothing wrong was found"
    assert lines[3].startswith("cost most: ")
    assert run(write_scene(tmp_path), "--frames", FRAMES, "--output", video, "--verbose") == 0
    text = capsys.readouterr().out
    assert "left out" in text
    assert "unwrap" in text


def test_help_fits_a_screen_and_all_options_are_told(capsys: pytest.CaptureFixture[str]) -> None:
    told = {}
    for option in ("--help", "--help-all"):
        with pytest.raises(SystemExit) as ended:
            live.main([option])
        assert ended.value.code == 0
        told[option] = capsys.readouterr().out
    assert told["--help"].count("\n") <= SCREEN
    assert "--save-layers" not in told["--help"]
    for action in live.make_parser()._actions:
        assert not action.option_strings or action.option_strings[-1] in told["--help-all"]


def test_a_recording_s_times_are_kept(tmp_path: Path) -> None:
    stamps = [0, 33, 66, 100, 600, 633, 666, 700]
    with Synthetic("card") as card, av.open(str(tmp_path / "card.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": "10"})
        (stream.width, stream.height), stream.pix_fmt = card.size, "yuv420p"
        stream.time_base = stream.codec_context.time_base = fractions.Fraction(1, 1000)
        for stamp, frame in zip(stamps, card, strict=False):
            picture = av.VideoFrame.from_ndarray(frame.image, format="rgb24")
            picture.pts, picture.time_base = stamp, stream.time_base
            container.mux(stream.encode(picture))
        container.mux(stream.encode(None))
    scene, video = write_scene(tmp_path, body=OBJECT, source='path = "card.mp4"'), tmp_path / "lit.mp4"
    assert run(scene, "--headless", "--output", video) == 0
    with av.open(str(video)) as container:
        shown = [1e3 * float(picture.time) for picture in container.decode(video=0)]
    assert shown == pytest.approx(stamps, abs=0.1)


def test_the_frame_passes_untouched_where_nothing_is_asked_for(tmp_path: Path) -> None:
    assert run(write_scene(tmp_path, body=""), "--headless", "--frames", 2, "--output", tmp_path / "out") == 0
    with Synthetic("card") as card:
        for frame, path in zip(card, sorted((tmp_path / "out").iterdir()), strict=False):
            np.testing.assert_array_equal(cv2.imread(str(path))[..., ::-1], frame.image)


def test_no_marker_is_said_and_the_frames_are_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = write_scene(tmp_path)
    scene.write_text(scene.read_text().replace("[marker]", "[marker]\nid = 7"))
    assert run(scene, "--headless", "--frames", 3, "--output", tmp_path / "out") == 1
    assert "no marker in the first 3 frames: expected DICT_4X4_50 id 7" in message(capsys)
    assert len(list((tmp_path / "out").iterdir())) == 3
    board = scene.read_text().replace("id = 7", 'board = "charuco 5x4 0.032 0.024"').replace("size = 0.08", "")
    scene.write_text(board)
    assert run(scene, "--headless", "--frames", 1, "--output", tmp_path / "one") == 1
    said = message(capsys)
    assert "no marker in the first 1 frame: expected DICT_4X4_50 charuco 5x4 0.032 0.024; check" in said
    assert said.endswith("(1 frame was written)\n")


def test_a_source_that_breaks_leaves_a_valid_video(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    frames = tmp_path / "frames"
    card_frames(frames, 3)
    (frames / "0003.png").write_bytes((frames / "0002.png").read_bytes()[:2000])
    video = tmp_path / "out.mp4"
    assert run(write_scene(tmp_path, source='path = "frames"'), "--headless", "--output", video) == 1
    text = message(capsys)
    assert "0003.png" in text
    assert "3 frames were written" in text
    with av.open(str(video)) as container:
        assert sum(1 for _ in container.decode(video=0)) == 3


@pytest.mark.skipif(os.name == "nt", reason="signals are sent as on POSIX")
@pytest.mark.parametrize(("kind", "code", "moment"), [("SIGINT", 130, 0.0), ("SIGTERM", 143, 0.4)])
def test_a_signal_finishes_all_files(tmp_path: Path, kind: str, code: int, moment: float) -> None:
    video, report, light = tmp_path / "out.mp4", tmp_path / "run.json", tmp_path / "light"
    command = [sys.executable, "-m", "warp_ar.live", str(write_scene(tmp_path)), "--device", "cpu", "--quality", "low"]
    command += ["--loop", "--headless", "--output", str(video), "--report", str(report)]
    command += ["--save-environment", str(light)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        deadline = time.monotonic() + 120
        while not (light / "0002.exr").exists() and time.monotonic() < deadline and process.poll() is None:
            time.sleep(0.05)
        time.sleep(moment)
        process.send_signal(signal.Signals[kind])
        _, errors = process.communicate(timeout=120)
    assert process.returncode == code, errors
    assert errors == ""
    frames = json.loads(report.read_text())["frames"]
    with av.open(str(video)) as container:
        assert container.streams.video[0].frames == len(frames)  # an ordinary MP4 says how many it has
    assert len(list(light.iterdir())) == len(frames)
    assert not list(tmp_path.rglob(".*"))


def snapshot(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


# Options, of which two lead to one place: by one name, by a link of either kind, by a folder and a file in it.
ONE_PLACE = {
    "source and output": "--source frames --output frames",
    "source and output, by ..": "--source frames --output frames/../frames",
    "source and output, by a link": "--source frames --output link",
    "source and output, videos": "--source clip.mp4 --output clip.mp4",
    "source and output, hard links": "--source clip.mp4 --output hard.mp4",
    "output and report": "--output z.mp4 --report z.mp4",
    "output and report, by ..": "--output z.mp4 --report frames/../z.mp4",
    "source and report": "--source clip.mp4 --report clip.mp4",
    "scene and report": "--report scene.toml",
    "scene's mesh and report": "--report ball.ply",
    "scene's source and report": "--report here.mp4",
    "calibration and report": "--calibration camera.yml --report camera.yml",
    "calibration and report, hard links": "--calibration camera.yml --report hard.yml",
    "output and environments": "--output out --save-environment out",
    "source and environments": "--source frames --save-environment frames",
    "an image and the folder it is in": "--source frames/0001.png --output frames",
    "a report among the frames": "--output out --report out/0001.png",
    "a report among the environments": "--save-environment out --report out/0001.exr",
}


@pytest.mark.parametrize(("case", "overwrite"), [(case, number % 2 == 0) for number, case in enumerate(ONE_PLACE)])
def test_nothing_is_written_over_what_is_read_or_twice(
    case: str, overwrite: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    mesh = '[[object]]\nshape = "mesh"\nfile = "ball.ply"\n'
    scene = write_scene(tmp_path, body=PROBE + mesh, source='path = "here.mp4"')
    card_frames(tmp_path / "frames", 3)
    for name in ("clip.mp4", "here.mp4", "camera.yml", "ball.ply"):
        (tmp_path / name).write_bytes(b"mine")
    (tmp_path / "link").symlink_to("frames")
    os.link("clip.mp4", "hard.mp4")
    os.link("camera.yml", "hard.yml")
    before = snapshot(tmp_path)
    assert run(scene, "--headless", *ONE_PLACE[case].split(), *["--overwrite"] * overwrite) == 2
    assert "name another" in message(capsys)
    assert snapshot(tmp_path) == before


def test_a_command_can_be_given_twice_and_foreign_files_stay(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = write_scene(tmp_path)
    out, light, report, video = (tmp_path / name for name in ("out", "light", "run.json", "a.mp4"))

    def twice(frames: int, *more: str) -> int:
        capsys.readouterr()
        options = ["--save-environment", light, "--report", report]
        code = run(scene, "--headless", "--frames", frames, "--output", video, *more)
        return code or run(scene, "--headless", "--frames", frames, "--output", out, *options, *more)

    assert twice(4) == 0
    assert capsys.readouterr().err == ""
    assert twice(2) == 0
    words = capsys.readouterr().err
    for path in (out, light, report, video):
        assert f"warp_ar: {path}" in words
    assert words.count("replaced") == words.count("\n") == 4
    assert len(list(out.iterdir())) == len(list(light.iterdir())) == 2

    for foreign in (report, video, out / "0007.png", light / "0007.exr"):
        kept = foreign.read_bytes() if foreign.exists() else None
        foreign.write_bytes(b"mine")
        assert twice(2) == 2, foreign
        assert "--overwrite" in capsys.readouterr().err
        assert foreign.read_bytes() == b"mine"
        assert twice(2, "--overwrite") == 0
        assert foreign.exists() == (kept is not None)
        assert not foreign.exists() or foreign.read_bytes() != b"mine"


@pytest.mark.parametrize("kind", ["folder", "pipe", "device", "long", "nothing to write to"])
def test_a_report_that_cannot_be_is_one_line_before_any_frame(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "run.json"
    if kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "long":
        path = tmp_path / ("x" * 5000)
    else:
        path = Path("/proc/no/run.json")
    assert run(write_scene(tmp_path), "--headless", "--output", tmp_path / "out", "--report", path) == 2
    assert len(message(capsys)) < 2000
    assert not (tmp_path / "out").exists()


def test_control_characters_do_not_reach_the_terminal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("a\x1b[31mb\x07", "two\nlines", "\u202edesrever", "half\ud800"):
        assert live.main(["desk", "--headless", "--source", name]) == 2
        text = message(capsys)
        assert not set(text[:-1]) & set("\x1b\x07\n\u202e\ud800")
    scene = write_scene(tmp_path)
    scene.write_text(scene.read_text().replace('"small"', '"\\u001b[2J[red]small"'))
    assert run(scene, "--frames", 2, "--output", tmp_path / "out") == 0
    shown = capsys.readouterr()
    assert "\x1b[2J" not in shown.out + shown.err


def card_frames(folder: Path, count: int = 2) -> None:
    """Frames of the generated card, which show no mirror ball."""
    folder.mkdir()
    with Synthetic("card", length=count) as card:
        for frame in card:
            cv2.imwrite(str(folder / f"{frame.index:04d}.png"), frame.image[..., ::-1])


def test_a_ball_that_is_never_seen_ends_with_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    card_frames(tmp_path / "frames")
    scene = write_scene(tmp_path, source='path = "frames"')
    assert run(scene, "--headless", "--output", tmp_path / "out") == 1
    said = capsys.readouterr().err.splitlines()
    assert "python -m warp_ar.doctor" in said[0]  # the quick check, before any frame
    assert "[probe]" in said[0]
    assert "no mirror ball was found" in said[-1]
    assert len(list((tmp_path / "out").iterdir())) == 2


def test_a_second_run_into_one_folder_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene, out = write_scene(tmp_path), tmp_path / "out"
    out.mkdir()
    with folder_to_oneself(out):
        assert run(scene, "--headless", "--frames", 2, "--output", out) == 2
        assert "is in use" in capsys.readouterr().err.splitlines()[-1]
    assert list(out.iterdir()) == []
    assert run(scene, "--headless", "--frames", 2, "--output", out) == 0
    assert sorted(path.name for path in out.iterdir()) == ["0000.png", "0001.png"]


def test_a_circle_within_the_printed_board_is_no_ball() -> None:
    marker = Marker(board=CharucoBoard(5, 7, 0.035, 0.026), size=0.026)
    camera = load_scene("desk").camera
    pose = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.6]))
    assert is_printed(marker, camera, pose, (camera.cx, camera.cy, 20.0))
    assert not is_printed(marker, camera, pose, (camera.cx - 150.0, camera.cy, 20.0))
    assert not is_printed(marker, camera, pose, (camera.cx, camera.cy, 200.0))


def test_a_picture_that_never_changes_ends_with_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    far = PROBE + OBJECT.replace("at = [0.1, 0.0, 0.03]", "at = [100.0, 0.0, 0.03]")
    assert run(write_scene(tmp_path, body=far), "--headless", "--frames", 2) == 1
    said = capsys.readouterr().err.splitlines()
    assert "100 millimetres are 0.1 m" in said[0] or "100 centimetres are 1 m" in said[0]
    assert "no frame was changed" in said[-1]


def test_exposures_that_are_not_merged_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    card_frames(tmp_path / "frames", 3)
    (tmp_path / "frames" / "exposures.json").write_text("[0.016, 0.0159, 0.001]")
    scene = write_scene(tmp_path, source='path = "frames"')
    run(scene, "--headless", "--frames", 2)
    assert "exposures 0.016, 0.0159 s, 1.01 times apart, are one" in capsys.readouterr().err


def test_a_guessed_camera_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = write_scene(tmp_path, body=PROBE + OBJECT)
    text = re.sub(r"(?m)^(width|height|fx|fy|cx|cy) = .*\n", "", scene.read_text())
    scene.write_text(text.replace("[camera]", "[camera]\nfield_of_view = 50.0"))
    assert run(tmp_path, "--headless", "--frames", 2) == 0  # the folder, which holds one scene
    assert "the camera is guessed, with a field of view of 50 degrees" in message(capsys)


def test_layers_are_written_beside_the_picture(tmp_path: Path) -> None:
    scene, out, layers = write_scene(tmp_path), tmp_path / "out", tmp_path / "layers"
    arguments = ("--headless", "--frames", 2, "--output", out, "--save-layers", layers)
    assert run(scene, *arguments, "--layers", "objects,depth", "--layer-pictures") == 0
    assert sorted(path.name for path in layers.glob("*.exr")) == ["0000.exr", "0001.exr"]
    assert sorted(path.name for path in (layers / "depth").iterdir()) == ["0000.png", "0001.png"]
    with OpenEXR.File(str(layers / "0001.exr")) as file:
        assert [part.header["name"] for part in file.parts] == ["objects", "depth"]
