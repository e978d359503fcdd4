"""The recording that several parts of the farm's benchmark light again and again: written and surveyed once."""

from __future__ import annotations

import shutil
import time
from pathlib import Path

from bench.farm_bench import Bench
from bench.farm_recordings import write_recording, write_scene
from bench.farm_runs import jobs_done, prepare, work

FRAMES = 480
"""Of the recording."""
JOBS = """schema = 1
[run]
quality = "{quality}"
decode = "{decode}"
segment_frames = {segment}
digests = {digests}
"""
CLIP = """[[clip]]
scene = "desk.toml"
path = "{path}.mp4"
name = "{name}"
"""


def surveyed(bench: Bench) -> Path:
    """A run that has surveyed the recording; made once."""
    folder = bench.folder / "surveyed"
    if folder.exists():
        return folder
    start = time.monotonic()
    write_scene(bench.folder / "desk.toml", bench.size)
    write_recording(bench.folder / "desk.mp4", bench.size, FRAMES)
    bench.say(f"a recording of {FRAMES} frames in {time.monotonic() - start:.1f} s")
    keep_kernels(bench)
    making = bench.folder / "surveying"
    shutil.rmtree(making, ignore_errors=True)  # of a call that was ended
    prepare(making, write_clips(bench, "survey.toml", 1, 8), None)
    seen = work(making, 1, bench.device, bench.say, steady=0.0)
    surveys = jobs_done(making, "survey")
    if not surveys:
        raise SystemExit(f"the survey failed: {seen.errors}")
    bench.costs["survey"] = 1e3 * (surveys[0].end - surveys[0].start) / FRAMES
    bench.tell("survey", ms_per_frame=round(bench.costs["survey"], 2), frames=FRAMES, bytes=surveys[0].bytes)
    return making.rename(folder)


def keep_kernels(bench: Bench, recording: str = "desk") -> None:
    """Have all kernels compiled and kept, by surveying and lighting a few frames of a recording; once."""
    folder = bench.folder / "first"
    if folder.exists():
        return
    start = time.monotonic()
    prepare(folder, write_clips(bench, "first.toml", 1, 8, end=16, recording=recording), None)
    work(folder, 1, bench.device, bench.say, steady=0.0)
    bench.say(f"kernels are compiled and kept after {time.monotonic() - start:.1f} s")


def write_clips(
    bench: Bench, name: str, clips: int, segment_frames: int, end: int = FRAMES, *, recording: str = "desk"
) -> Path:
    """A job file of so many clips that are the first frames of a recording."""
    text = _settings(bench, segment_frames, digests=False)
    for number in range(clips):
        text += CLIP.format(path=recording, name=f"c{number:04d}") + f"frames = [0, {end}]\n"
    path = bench.folder / name
    path.write_text(text, encoding="utf-8")
    return path


def write_jobs(bench: Bench, name: str, segment_frames: int, *, digests: bool = False) -> Path:
    """The job file of one recording, ``NAME.mp4``, lit by the scene ``desk.toml`` in segments of so many frames."""
    path = bench.folder / f"{name}.toml"
    text = _settings(bench, segment_frames, digests=digests) + CLIP.format(path=name, name=name)
    path.write_text(text, encoding="utf-8")
    return path


def _settings(bench: Bench, segment_frames: int, *, digests: bool) -> str:
    options = bench.options
    told = str(digests).lower()
    return JOBS.format(quality=options.quality, decode=options.decode, segment=segment_frames, digests=told)
