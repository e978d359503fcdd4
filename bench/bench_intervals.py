"""Share of random set-ups in which the intervals that calibrations state contain the truth.

``python -m bench intervals`` makes a hundred random set-ups of each kind: cameras (focal length, principal point, lens,
noise, poses of the hand-held card), responses (gamma or S-shaped curve, printer, light) and mirror balls (camera, lens,
environment, radius, place on the card's cross, path of the camera). An interval of two standard deviations should
contain the truth in 95 of 100.

``WARP_AR_BENCH_SETUPS`` sets the number of set-ups, ``WARP_AR_BENCH_OF`` the kinds (``camera,response,ball``). A
hundred balls take half an hour. ``WARP_AR_BENCH_KEEP`` names a file to which the figures of every set-up are appended;
set-ups in it are not run again.
"""

from __future__ import annotations

import functools
import json
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import PIL.Image

from bench.common import commit
from tests.printed_card import PrintedCard, linear_of, poses, smooth_curve
from tests.random_desk import RandomDesk
from tests.rendered_room import look_at
from warp_ar.ball.ball import posed_frames
from warp_ar.ball.ball_measure import measure_ball
from warp_ar.calibration.camera_calibration import calibrate_camera
from warp_ar.calibration.card import write_card
from warp_ar.calibration.response import measure_grey_response
from warp_ar.scene import Camera, Pose, Probe, Proxy
from warp_ar.sources.sources import open_source
from warp_ar.tracking.card_layout import CARD_MARKER, ball_center

SETUPS = 100
"""Default number of set-ups of each kind."""
VIEWS = 14
"""Number of pictures of the hand-held card."""
FRAMES = 12
"""Number of frames in which the camera moves around the ball."""
CAMERA = 0.0012
"""Relative standard deviation of the focal length with which a ball is measured: the median error of cameras here."""


def srgb(linear: np.ndarray) -> np.ndarray:
    """Return linear values encoded as sRGB, 0 to 1."""
    value = np.clip(linear, 0.0, 1.0)
    return np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055)


def random_camera(rng: np.random.Generator) -> Camera:
    """Return a random camera of 640x480 pixels, like that of a webcam or a phone."""
    focal = rng.uniform(480, 800)
    center = np.array([319.5, 239.5]) + rng.normal(0, 6, 2)
    return Camera(640, 480, focal, focal, *center, (rng.uniform(-0.15, 0.03), rng.uniform(-0.03, 0.05), 0.0, 0.0, 0.0))


def hand_poses(rng: np.random.Generator, focal: float) -> list[Pose]:
    """Return poses of a card in front of the camera, with various tilts and places in the picture."""
    found = []
    for k in range(VIEWS):
        tilt, turn = np.radians((12, 30, 45)[k % 3] + rng.uniform(-6, 6)), 2.4 * k + rng.uniform(-0.4, 0.4)
        far = focal / 640 * rng.uniform(0.28, 0.4)
        shift = rng.uniform(-0.3, 0.3, 2) * far
        eye = np.array([*shift, 0.0]) + far * np.array(
            [np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)]
        )
        found.append(Pose(*look_at(eye, np.array([*shift, 0.0]), rng.uniform(0, 360))))
    return found


Figures = dict[str, list[float]]
"""Error and stated standard deviation, by the measured quantity."""


def calibrated(seed: int) -> Figures:
    """Return the figures of a random camera's focal length, pixels."""
    rng = np.random.default_rng(seed)
    camera, card = random_camera(rng), PrintedCard(rng)
    noise = rng.uniform(0.5, 3.0)
    found = calibrate_camera(card.photograph(camera, pose, 0.7, srgb, noise) for pose in hand_poses(rng, camera.fx))
    return {"focal length": [found.camera.fx - camera.fx, found.focal_deviation]}


def responded(seed: int) -> Figures:
    """Return the figures of a random camera's response measured by greys.

    They are those of the code at the 95th percentile of the ratio of error to deviation, as logarithms.
    """
    rng = np.random.default_rng(seed)
    card, encode = PrintedCard(rng), smooth_curve(rng)
    camera = Camera(640, 480, 620.0, 620.0, 319.5, 239.5)
    lights = rng.uniform(0.25, 0.95, 5)
    found = measure_grey_response(
        card.photograph(camera, pose, light, encode) for pose, light in zip(poses(rng, 5), lights, strict=True)
    )
    codes = np.arange(40, int(found.span[1]), 4)
    error = np.log(found.curve[codes, 1] / linear_of(encode)[codes])
    ratio = np.abs(error) / found.deviation[codes, 1]
    worst = int(np.argsort(ratio)[int(0.95 * (len(codes) - 1))])
    return {"response": [float(error[worst]), float(found.deviation[codes, 1][worst])]}


@functools.cache
def printed() -> Path:
    """Return the path of the card as a PDF, in a temporary folder."""
    path = Path(tempfile.mkdtemp()) / "card.pdf"
    write_card(CARD_MARKER, path, "a4", 600)
    return path


def film(desk: RandomDesk, rng: np.random.Generator, folder: Path) -> None:
    """Write frames in which the camera moves around the card with the ball."""
    middle, half = np.radians(rng.uniform(-110, -70)), np.radians(rng.uniform(30, 70))
    far, high = rng.uniform(0.4, 0.55), rng.uniform(0.28, 0.4)
    for k in range(FRAMES):
        turn = middle + half * np.sin(k / 2)
        eye = np.array([far * np.cos(turn), 0.06 + far * np.sin(turn), high + 0.04 * np.cos(k)])
        PIL.Image.fromarray(desk.photograph(eye, (0.0, 0.06, 0.0))).save(folder / f"{k:02d}.png")


def measured(seed: int) -> Figures:
    """Return the figures of a random mirror ball, millimetres; the centre's error is that of its worst axis."""
    rng = np.random.default_rng(1000 + seed)
    desk = RandomDesk(printed(), 1000 + seed)
    truth = desk.camera
    off = 1.0 + rng.normal(0.0, CAMERA)
    camera = Camera(truth.width, truth.height, truth.fx * off, truth.fy * off, truth.cx, truth.cy, truth.distortion)
    with tempfile.TemporaryDirectory() as folder:
        film(desk, rng, Path(folder))
        with open_source(folder) as source:
            views = posed_frames(source, CARD_MARKER, camera, FRAMES)
    told = desk.radius * rng.uniform(0.92, 1.08)
    table = Proxy("plane", at=(0.0, 0.0, 0.0), size=(1.6, 1.2))
    found = measure_ball(views, camera, Probe(ball_center(told), told), (table,))
    if found.radius_deviation is None:
        return {"radius assumed": [0.0, 1.0]}
    error = np.subtract(found.center, desk.center)
    worst = float(error[np.abs(error).argmax()])
    return {
        "ball's centre": [1e3 * worst, 1e3 * found.deviation],
        "ball's radius": [1e3 * (found.radius - desk.radius), 1e3 * found.radius_deviation],
    }


PARTS: dict[str, Callable[[int], Figures]] = {"camera": calibrated, "response": responded, "ball": measured}


def _kept(path: Path | None) -> dict[tuple[str, int], Figures]:
    if path is None or not path.exists():
        return {}
    rows = map(json.loads, path.read_text().splitlines())
    return {(row["part"], row["seed"]): row["figures"] for row in rows}


def main(device: str) -> None:
    """Print the number of intervals that contain the truth; nothing runs on the device."""
    count = int(os.environ.get("WARP_AR_BENCH_SETUPS", SETUPS))
    keep = Path(name) if (name := os.environ.get("WARP_AR_BENCH_KEEP")) else None
    known = _kept(keep)
    for part in os.environ.get("WARP_AR_BENCH_OF", ",".join(PARTS)).split(","):
        rows = []
        for seed in range(count):
            figures = known.get((part, seed))
            if figures is None:
                figures = PARTS[part](seed)
                if keep is not None:
                    with keep.open("a") as file:
                        file.write(json.dumps({"part": part, "seed": seed, "figures": figures}) + "\n")
            rows.append(figures)
        for name in sorted({name for figures in rows for name in figures}):
            _tell(name, np.array([figures[name] for figures in rows if name in figures]))


def _tell(of: str, rows: np.ndarray) -> None:
    ratio = np.abs(rows[:, 0]) / rows[:, 1]
    figures = {
        "held": int((ratio < 2).sum()),
        "median_error": round(float(np.median(np.abs(rows[:, 0]))), 4),
        "largest_error": round(float(np.abs(rows[:, 0]).max()), 4),
        "median_interval": round(2 * float(np.median(rows[:, 1])), 4),
        "ratio_95": round(float(np.percentile(ratio, 95)), 2),
    }
    print(json.dumps({"case": f"interval of the {of}", "setups": len(rows), **figures, "commit": commit()}), flush=True)
