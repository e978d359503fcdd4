"""Wrong usage of every command is one line that says what would be right, and leaves nothing behind."""

from __future__ import annotations

import importlib
import pathlib
import shlex
from collections.abc import Iterator

import cv2
import numpy as np
import pytest

from warp_ar import init
from warp_ar.output.environment_file import write_environment

pytestmark = pytest.mark.slow

JOBS = 'schema = 1\n[[clip]]\nscene = "torus"\npath = "good.mp4"\n'


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[pathlib.Path]:
    """A folder to work in, with a desk, photographs on their side, light and a farm's jobs."""
    made = tmp_path_factory.mktemp("usage")
    (made / "frames").mkdir()
    for name in ("photo.JPG", "frames/0.jpg"):
        (made / name).write_bytes(cv2.imencode(".jpg", np.full((64, 48, 3), 90, np.uint8))[1].tobytes())
    write_environment(made / "light.exr", np.random.default_rng(0).random((8, 16, 3), np.float32))
    write_environment(made / "dark.exr", np.zeros((4, 8, 3), np.float32))
    (made / "jobs.toml").write_text(JOBS)
    (made / "good.mp4").write_bytes(b"no video yet")
    assert init.main([str(made / "my_desk"), "--radius", "0.03"]) == 0
    before = sorted(made.rglob("*"))
    yield made
    assert sorted(made.rglob("*")) == before


QUICK = "--device cpu --quality low"
CASES = {
    "live --headless": [
        ("no_such_scene", "no_such_scene"),
        ("desk --quality hihg", "did you mean high? expected"),
        ("photo.JPG", "photo.JPG is no scene; expected a scene file; frames go to --source"),
        ("desk --source frames", "frames are 48x64: another aspect ratio"),
        ("desk --light photo.JPG", "photo.JPG cannot be read as OpenEXR: it is another kind of file"),
        ("desk --device cuda:99", "device 'cuda:99' does not exist"),
        ("desk --frames 0", "--frames 0: expected 1 or more"),
        ("desk --source /no/such/clip.mp4", "/no/such/clip.mp4"),
        ("desk --calibration /no/such/file.yml", "/no/such/file.yml"),
        ("desk --output /proc/no.mp4", "/proc cannot be written to"),
        ("desk --output picture.xyz", "picture.xyz"),
        ("desk --layers depth", "--layers depth needs --save-layers DIR"),
        ("desk --layer-pictures", "--layer-pictures needs --save-layers DIR"),
        ("desk --save-layers layers --layers beauty", "--layers: 'beauty' is no layer"),
        (f"desk {QUICK} --samples 0", "--samples 0: expected 1 or more"),
        (f"desk {QUICK} --samples 4 --error 0", "--error 0: expected a number above 0"),
        (f"desk {QUICK} --error 0.1", "--error 0.1 needs --samples"),
        ("desk --device cpu --quality auto --samples 4", "--samples needs a preset as --quality"),
        ("my_desk --qualty low", "did you mean --quality?"),
        ("my_desk --radius 3", "unrecognized arguments: --radius 3; see"),
    ],
    "live desk": [
        ("--port 70000", "--port 70000"),
        ("--token 'a b'", "--token"),
        ("--tls /no/such.pem", "/no/such.pem"),
        ("--report run.json", "--report needs"),
        ("--quality auto --budget-ms -5", "--budget-ms -5"),
        ("--budget-ms 20", "needs --quality auto"),
        (f"--host no.such.host.invalid {QUICK}", "cannot serve"),
        ("--allow-origin localhost:5173 --no-browser", "--allow-origin"),
    ],
    "export desk --device cpu": [
        ("--output shot.fbx", "--output shot.fbx: expected a name that ends in .usda, .usdc, .usd, .glb, .jsonl"),
    ],
    "reference torus --quality low --size 64x48 --device cpu": [
        ("--samples 0", "--samples 0: expected 1 or more"),
        ("--error -1", "--error -1: expected a number above 0"),
        ("--save-light x.png", "--save-light x.png: expected a name that ends in .exr"),
        ("--compare x.exr", "--compare x.exr: expected a name that ends in .png"),
        ("--size 64x64", "another aspect ratio"),
        ("--quality best", "quality 'best' is no preset"),
        ("--seed -3", "--seed -3: expected 0 or more"),
    ],
    "tradeoff": [
        ("desk --presets --stage irradiance", "--presets --stage irradiance: expected one of both"),
        ("desk --only low", "--only low: needs --presets"),
        ("desk --presets --only low,best", "--only best: expected presets of paper, low, medium"),
        ("desk --stage colour --frames 1", "--stage colour: expected one of environment_height"),
        ("--truth frames", "expected folders with scene_"),
        ("darken --stage irradiance --frames 1", "no scene has a setting to vary"),
    ],
    "paper": [
        ("2", "figure 2: expected 1, 3, 4"),
    ],
    "calibrate": [
        ("", "required"),
        ("paint", "invalid choice"),
        ("card --dictionary DICT_9X9", "DICT_9X9"),
        ("card --board 'charuco 5x7'", "charuco 5x7"),
        ("card --id 50", "50"),
        ("card --size 0.25 --output card.png", "does not fit"),
        ("card --paper a9", "letter"),
        ("card --output nowhere/card.png", "nowhere"),
        ("camera nowhere", "nowhere"),
        ("camera my_desk", "my_desk: is the folder of a scene; expected photographs"),
        ("response nowhere.png --exposures fast", "1/50"),
    ],
    "capture photo.JPG --output new.exr": [
        ("--rectangle-size 1 2", "belong together"),
        ("--shown nothing.jpg", "expected one of the photographs"),
        ("--reflectance 1.5", "0.01 to 1"),
        ("--exposures 0.1 0.2", "expected one for each"),
        ("--exposures pixels 0.2", "cannot be combined with exposure times"),
        ("--focal-35mm 0", "--focal-35mm 0: expected millimetres"),
        ("--ball-radius -3", "--ball-radius -3: expected metres above 0, 1 at most"),
        ("--ball-radius 4", "1 at most; 4 cm are 0.04"),
        ("--contact 1 2 --stand 0.1", "--stand 0.1: expected --contact and --ball-radius beside it"),
        ("--contact nan 100", "--contact nan: expected pixels"),
        ("--height 8", "--height 8: expected 16 to 4096 rows"),
        ("--ball 1 2 9 --circle 1 2 9", "--ball is a rough circle and --circle an exact one"),
        ("--ball 5000 5 30", "ball 5000, 5, 30: the circle lies outside the picture, 48x64 pixels"),
    ],
    "capture my_desk --output new.exr": [("", "is a folder; name the photographs in it")],
    "pose photo.JPG --light light.exr": [
        ("", "photo.JPG does not show the printed card: expected it in the picture, or one of --rectangle; --point"),
        ("--rectangle 1 2 3 4 5 6 7 8 --colmap .", "--rectangle and --colmap each give the pose"),
        ("--colmap .", "--colmap .: expected the folder of a sparse model"),
        ("--colmap-scale 2", "--colmap-scale 2: expected --colmap FOLDER beside it"),
        ("--colmap . --focal-35mm 26", "--focal-35mm and --colmap both give the focal length"),
        ("--vanishing-x 1 2 3", "--vanishing-x: 3 numbers; expected 8 or 12, 4 of each segment"),
        ("--vanishing-x 1 2 3 4 5 6 7 8 --length 1 1 2 2 1", "expected parallel segments of two axes or three"),
        ("--vanishing-x 1 2 3 4 5 6 7 8 --vanishing-z 1 2 3 4 5 6 7 8", "and --length"),
        ("--length 1 1 1 1 2", "--vanishing-x, -y or -z: expected"),
        ("--point 0 0 0 1 1", "1 points; expected four or more"),
        ("--rectangle 1 2 3 4 5 6 7 8", "--rectangle and --rectangle-size belong together"),
    ],
    "environment light.exr": [
        ("--output out.png", "--output out.png: expected a name that ends in .exr, .hdr, .json"),
        ("--output out.exr --size 5", "add --layout cube"),
        ("--output out.exr --layout cube --axes blender", "expected y-up, opengl for a cube"),
        ("--output out.exr --taken noon", "'noon': expected a time"),
        ("--output out.exr --taken 2026-05-01T12:00:00", "expected a time with its zone"),
        ("--output light.exr", "is the same as the environment"),
        ("--output out.hdr --color-space acescg", "can be stored in OpenEXR only; name an .exr"),
    ],
    "environment": [
        ("dark.exr --output out.exr --grey-card", "the light from above is 0"),
        ("none.exr --output out.exr", "there is no file"),
    ],
    "farm.cli": [
        ("run jobs.toml --output new --workers 0", "--workers 0: expected a number from 1 to"),
        ("run none.toml --output new", "none.toml is not there"),
        ("resume nowhere", "nowhere holds no run (run.json is missing); begin one with: farm run"),
        ("status nowhere", "nowhere holds no run"),
        ("run jobs.toml --output .", ". is not empty"),
        ("run jobs.toml --output good.mp4", "--output good.mp4 is no folder; name a new one"),
        ("run jobs.toml", "the following arguments are required: --output"),
    ],
    "init": [
        ("my_desk", "is there already"),
        ("nowhere/desk", "nowhere"),
        ("other --radius 3", "3 cm are 0.03"),
    ],
    "doctor": [("mydesk", "mydesk: no such scene"), ("nowhere", "nowhere")],
    "__main__": [("doctr my_desk", 'no command doctr; did you mean "doctor"?')],
}
"""Of each command, with what is given in every case: further arguments, and words of what is said."""


@pytest.mark.parametrize(
    ("arguments", "words"), [(f"{command} {more}", words) for command, rows in CASES.items() for more, words in rows]
)
def test_wrong_usage_is_one_line(
    arguments: str,
    words: str,
    folder: pathlib.Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(folder)
    command, *rest = shlex.split(arguments)
    assert importlib.import_module(f"warp_ar.{command}").main(rest) == 2
    said = capsys.readouterr().err.splitlines()
    assert words in said[-1]
    assert all(line.startswith("warp_ar: ") for line in said)
