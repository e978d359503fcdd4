"""Small recordings of the bundled desk, and job files, for tests of the farm."""

from __future__ import annotations

import fractions
import functools
import itertools
import pathlib
from collections.abc import Sequence
from typing import Any

import av
import cv2
import numpy as np

from warp_ar.farm.jobs import JobFile, parse_jobs
from warp_ar.sources.sources import open_source

CLIPS = pathlib.Path(__file__).resolve().parents[1] / "scenes" / "clips"
SIZE = (320, 240)
"""Of recordings; the marker is some 25 pixels wide, just enough to be found."""
TICK = fractions.Fraction(1, 600)


@functools.cache
def desk_frames(count: int) -> tuple[np.ndarray, ...]:
    """The first frames of the bundled clip at ``SIZE``."""
    with open_source(CLIPS / "desk.mp4") as source:
        return tuple(
            cv2.resize(frame.image, SIZE, interpolation=cv2.INTER_AREA) for frame in itertools.islice(source, count)
        )


def write_recording(
    path: pathlib.Path, count: int, *, ticks: Sequence[int] | None = None, sound: bool = False, bframes: int = 2
) -> list[int]:
    """Write a recording with some of the desk's frames; returns its time stamps in ``TICK``.

    Args:
        path: An MP4.
        count: Frames.
        ticks: Time stamps; 24 a second if left out.
        sound: Whether it has a sound track, a tone of 440 Hz.
        bframes: As the encoder may order frames.
    """
    ticks = [25 * n for n in range(count)] if ticks is None else list(ticks)
    with av.open(str(path), "w") as container:
        container.metadata["title"] = "A desk"
        stream: Any = container.add_stream("libx264", rate=24, options={"crf": "12", "g": "6", "bf": str(bframes)})
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
        stream.time_base = stream.codec_context.time_base = TICK
        tone: Any = container.add_stream("aac", rate=48000) if sound else None
        if tone is not None:
            tone.metadata["language"] = "deu"
        for image, tick in zip(desk_frames(count), ticks, strict=True):
            picture = av.VideoFrame.from_ndarray(image, format="rgb24")
            picture.pts, picture.time_base = tick, TICK
            container.mux(stream.encode(picture))
        container.mux(stream.encode(None))
        if tone is not None:
            samples = int(48000 * float(ticks[-1] * TICK))
            wave = 0.2 * np.sin(np.arange(samples) * (2 * np.pi * 440 / 48000)).astype(np.float32)
            frame = av.AudioFrame.from_ndarray(wave[None], format="fltp", layout="mono")
            frame.sample_rate, frame.pts = 48000, 0
            container.mux(tone.encode(frame))
            container.mux(tone.encode(None))
    return ticks


def make_jobs(folder: pathlib.Path, clips: Sequence[dict[str, Any]], **sections: Any) -> JobFile:
    """A job file of these clips, at quality ``low`` unless ``run`` says otherwise."""
    data = {"schema": 1, "run": {"quality": "low"}, "clip": list(clips), "folder": str(folder), **sections}
    return parse_jobs(data, "jobs.toml")
