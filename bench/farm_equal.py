"""A long recording in segments against one run of it, and variations of a clip by several workers."""

from __future__ import annotations

import concurrent.futures
import dataclasses
import hashlib
import itertools
import json
import multiprocessing
import os
import shutil
import statistics
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.common import paired_ratio
from bench.farm_bounds import measure_worker
from bench.farm_recordings import RATE, write_recording, write_scene
from bench.farm_runs import Done, jobs_done, prepare, rates, work, write_jobs
from warp_ar.device import usable_cores
from warp_ar.farm.draws import draw_variation
from warp_ar.farm.jobs import Job, parse_jobs, read_jobs
from warp_ar.farm.lighting import Lighter
from warp_ar.farm.survey import lit_scene
from warp_ar.input.sources import open_source
from warp_ar.session import Session

if TYPE_CHECKING:
    from bench.bench_farm import Bench

SEGMENTS = 8
EDGE = 24
"""Frames from a segment's begin on that are taken for its beginning."""


# ------------------------------------------------------------------------------------------------------ long recordings


def run_long(bench: Bench) -> None:
    """As many frames as fit through 8 segments, and every picture against that of one run."""
    bench.surveyed()
    measure_worker(bench)
    frames = frames_that_fit(bench)
    folder, video = bench.folder / "long", bench.folder / "long.mp4"
    start = time.monotonic()
    write_recording(video, bench.size, frames)
    bench.say(
        f"a recording of {frames} frames in {time.monotonic() - start:.0f} s, {video.stat().st_size / 1e6:.0f} MB"
    )
    jobs = write_jobs(bench, "long", -(-frames // SEGMENTS))
    prepare(folder, jobs, None)
    seen = work(folder, SEGMENTS, bench.device, bench.say, limit=max(bench.left, 120.0))
    survey, segments = jobs_done(folder, "survey"), jobs_done(folder, "segment")
    whole = seen.code == 0 and (folder / "long.mp4").is_file()
    minutes = bench.options.long_frames / RATE / 60
    by_frames = sum(job.end - job.start for job in survey)
    if segments:
        by_frames += max(job.end for job in segments) - min(job.start for job in segments)
    bench.tell(
        f"recording of {frames} frames in {SEGMENTS} segments",
        whole=whole,
        asked_frames=bench.options.long_frames,
        seconds=round(seen.seconds, 1),
        survey_seconds=round(sum(job.end - job.start for job in survey), 1),
        **{f"segments_{name}": value for name, value in rates(segments, SEGMENTS).items()},
        seconds_for_all_asked=round(seen.seconds + by_frames * (bench.options.long_frames / frames - 1.0)),
        asked_minutes=round(minutes, 1),
        **seen.memory(),
        **seen.gpu_figures(),
        error="" if whole else seen.errors[-500:],
    )
    if whole:
        _compare(bench, jobs, folder, frames)
    shutil.rmtree(folder, ignore_errors=True)
    video.unlink()


def frames_that_fit(bench: Bench) -> int:
    """Frames that the part's time is enough for, by what a survey and a worker were measured to take."""
    cores = usable_cores()
    lit = max(bench.costs["worker"] / SEGMENTS, bench.costs["worker_processor"] / cores)
    # Surveyed once; lit by the run, then once by one run beside eight segments.
    # (without being encoded, which is half of a worker's time).
    each = bench.costs["survey"] + lit + max(0.5 * bench.costs["worker"], 2.0 * lit) + 2.0
    fixed = 25.0  # workers' starts, and the recording
    frames = int(0.85 * (bench.left - fixed) * 1e3 / each)
    frames = max(min(frames, bench.options.long_frames), SEGMENTS * EDGE * 2)
    bench.say(f"{frames} of {bench.options.long_frames} frames fit {bench.left:.0f} s at {each:.1f} ms each")
    return frames


def _compare(bench: Bench, jobs: Path, folder: Path, frames: int) -> None:
    """Digests of all pictures of one run and of its segments, before they are encoded, and what encoding changes."""
    segment = -(-frames // SEGMENTS)
    parts = [(n, n * segment, min((n + 1) * segment, frames)) for n in range(SEGMENTS)]
    device = "cpu" if bench.device == "cpu" else "cuda"
    spawn = multiprocessing.get_context("spawn")
    start = time.monotonic()
    with concurrent.futures.ProcessPoolExecutor(SEGMENTS + 1, mp_context=spawn) as pool:
        one = pool.submit(digest_pictures, jobs, folder, device, (0, 0, frames), folder / "long.mp4")
        several = [
            pool.submit(digest_pictures, jobs, folder, device, part, None) for part in parts if part[1] < part[2]
        ]
        digests, differences = one.result()
        joined = list(itertools.chain.from_iterable(each.result()[0] for each in several))
    unlike = [n for n, (a, b) in enumerate(itertools.zip_longest(digests, joined)) if a != b]
    begins = {first for _, first, _ in parts}
    edges = [value for number, value in differences if any(0 <= number - begin < EDGE for begin in begins)]
    inner = [value for number, value in differences if not any(0 <= number - begin < EDGE for begin in begins)]
    bench.tell(
        "pictures of segments against one run",
        pictures=len(digests),
        unlike=len(unlike),
        first_unlike=unlike[:10],
        seconds=round(time.monotonic() - start, 1),
        encoded_minus_lit_mean_codes={
            "all": round(float(np.mean([value for _, value in differences])), 3),
            "within_24_frames_of_a_segment": round(float(np.mean(edges)), 3) if edges else None,
            "elsewhere": round(float(np.mean(inner)), 3) if inner else None,
            "largest_of_a_frame": round(float(np.max([value for _, value in differences])), 3),
        },
    )


def digest_pictures(
    jobs: Path, folder: Path, device: str, part: tuple[int, int, int], joined: Path | None
) -> tuple[list[bytes], list[tuple[int, float]]]:
    """Light frames and digest their pictures; a process of its own.

    Args:
        jobs: The job file.
        folder: Of a run that has surveyed its clip.
        device: ``cpu`` or ``cuda``: then one GPU after another, by the number of the part.
        part: Number of a segment, its first frame, and the one behind its last.
        joined: The encoded recording, against which every eighth picture is held; None: none is.

    Returns:
        Digests of all pictures, and numbers of frames with the mean of what encoding changed, in 8-bit codes.
    """
    import warp as wp

    number, first, end = part
    if device != "cpu":
        gpus = wp.get_cuda_devices()
        device = str(gpus[number % len(gpus)])
    file = parse_jobs(read_jobs(jobs), str(jobs))
    digests: list[bytes] = []
    differences: list[tuple[int, float]] = []
    with Lighter(file, folder, device) as lighter, concurrent.futures.ThreadPoolExecutor(2) as threads:
        encoded: Iterator[Any] | None = iter(open_source(joined)) if joined is not None else None
        waiting = []
        for lit in lighter.light(Job("segment", 0, number, first, end)):
            image = lit.image.copy()
            waiting.append(threads.submit(lambda data: hashlib.blake2b(data, digest_size=16).digest(), image))
            if encoded is not None:
                other = next(encoded).image
                if lit.frame.index % 8 == 0 or lit.frame.index % 97 < EDGE:
                    difference = float(np.abs(image.astype(np.int16) - other).mean())
                    differences.append((lit.frame.index, difference))
            while len(waiting) > 4:
                digests.append(waiting.pop(0).result())
        digests += [task.result() for task in waiting]
    return digests, differences


# ----------------------------------------------------------------------------------------------------------- variations

DATASET = """schema = 1
[run]
quality = "{quality}"
[[clip]]
scene = "small.toml"
path = "small.mp4"
name = "small"
light = "light.exr"
frames = [0, 8]
[dataset]
variations = {count}
seed = 7
objects = [1, 3]
lights = [1, 1]
every = 8
exposure = [0.7, 1.0]
[[dataset.object]]
name = "teapot"
file = "{teapot}"
scale = 0.02
material = {{ model = "metallic_roughness", metallic = [0.0, 1.0], roughness = [0.1, 0.9] }}
[[dataset.object]]
name = "ball"
shape = "sphere"
radius = 0.02
[[dataset.object]]
name = "die"
shape = "box"
size = [0.02, 0.02, 0.02]
rest = "any"
[[dataset.light]]
kind = "spot"
at = [[-0.3, -0.3, 0.3], [0.3, 0.3, 0.5]]
intensity = [0.5, 2.5]
"""
TEAPOT = Path(__file__).resolve().parents[1] / "scenes" / "meshes" / "teapot.ply"
CLIP = 96
"""Frames of the short clip."""


def run_variations(bench: Bench) -> None:
    """Variations by 1, 2 and 4 workers, and a frame of one against one of ``live``."""
    from bench.bench_farm import START_SECONDS, size_of

    size = size_of(bench.options.variation_size)
    write_scene(bench.folder / "small.toml", size)
    write_recording(bench.folder / "small.mp4", size, CLIP)
    _capture_light(bench)
    jobs = bench.folder / "data.toml"
    text = DATASET.format(quality=bench.options.quality, count=bench.options.variations, teapot=TEAPOT)
    jobs.write_text(text)
    _against_live(bench, jobs)
    cores = sorted(os.sched_getaffinity(0))
    shares = {
        count: cores[len(cores) * (count - 1) // 7 : max(1, len(cores) * (2 * count - 1) // 7)] or cores[:1]
        for count in (1, 2, 4)
    }
    if len(cores) < 7:
        shares = dict.fromkeys(shares, cores)
    limit = max(bench.left - 10.0, 20.0)
    with concurrent.futures.ThreadPoolExecutor(3) as threads:
        runs = {}
        for count, share in shares.items():
            prepare(bench.folder / f"data-{count}", jobs, None)
            options = {"cores": share, "limit": START_SECONDS + limit, "steady": limit}
            say = bench.say if count == 4 else (lambda _: None)
            runs[count] = threads.submit(work, bench.folder / f"data-{count}", count, bench.device, say, **options)
        seen = {count: run.result() for count, run in runs.items()}
    digests = {}
    for count, watched in seen.items():
        folder = bench.folder / f"data-{count}"
        digests[count] = _digests(folder)
        done = jobs_done(folder, "variation")
        bench.tell(
            f"variations by {count} workers",
            done=len(done),
            asked=bench.options.variations,
            ended=watched.code is not None,
            error="" if done else watched.errors[-500:],
            seconds=round(watched.seconds, 1),
            used_cores=len(shares[count]),
            **rates(done, count),
            ms_per_variation=_per_variation(done),
            **watched.memory(),
        )
    common = set.intersection(*(set(found) for found in digests.values()))
    unlike = sorted(key for key in common if len({found[key] for found in digests.values()}) > 1)
    indexes = [bench.folder / f"data-{count}/dataset/annotations.json" for count in digests]
    whole = all(path.is_file() for path in indexes)
    bench.tell(
        "bytes of variations by 1, 2 and 4 workers",
        compared=len(common),
        asked=bench.options.variations,
        unlike=len(unlike),
        first_unlike=unlike[:10],
        whole_data_sets=whole,
        annotations_equal=len({_file_digest(path) for path in indexes}) == 1 if whole else None,
    )
    for count in digests:
        shutil.rmtree(bench.folder / f"data-{count}", ignore_errors=True)


def _capture_light(bench: Bench) -> None:
    """The light of the short clip's end, as a survey keeps it."""
    jobs, folder = bench.folder / "capture.toml", bench.folder / "capture"
    jobs.write_text(
        f'schema = 1\n[run]\nquality = "{bench.options.quality}"\nlight = "fixed"\nsegment_frames = 8\n'
        '[[clip]]\nscene = "small.toml"\npath = "small.mp4"\nname = "small"\nframes = [0, 48]\n'
    )
    prepare(folder, jobs, None)
    seen = work(folder, 1, bench.device, bench.say, steady=0.0, limit=120.0)
    light = folder / "clips/small/light.exr"
    if not light.is_file():
        raise RuntimeError(f"the light was not captured: {seen.errors[-300:]}")
    shutil.copy(light, bench.folder / "light.exr")
    shutil.rmtree(folder)


def _per_variation(done: list[Done]) -> float | None:
    """Median milliseconds of a variation with its labels."""
    return round(1e3 * statistics.median(job.end - job.start for job in done), 1) if done else None


def _digests(folder: Path) -> dict[str, str]:
    """Of every variation that a run has done, over names and contents of its files."""
    found = {}
    for line in (folder / "manifest.jsonl").read_text().splitlines():
        told = json.loads(line)
        if told["state"] == "done" and "variation" in told["job"]:
            found[told["job"]] = str(told["sha256"])
    return found


def _file_digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _against_live(bench: Bench, jobs: Path) -> None:
    """A frame of a variation's pictures against one of ``live`` with the same light, in turn."""
    count, frames = (4, 12) if bench.device == "cpu" else (12, 96)
    file = parse_jobs(read_jobs(jobs), str(jobs))
    assert file.dataset is not None
    file = dataclasses.replace(file, clips=(dataclasses.replace(file.clips[0], end=frames),))
    folder = bench.folder / "live"
    device = "cpu" if bench.device == "cpu" else "cuda:0"
    from warp_ar.farm.survey import survey_clip

    place = folder / "clips" / "small"
    place.mkdir(parents=True)
    survey_clip(file, 0, place, device, lambda _: None)
    times: dict[str, list[float]] = {"live": [], "variation": []}
    with Lighter(file, folder, device) as lighter:
        survey = lighter.survey(0)
        base = lit_scene(file, 0, survey)
        base = dataclasses.replace(base, camera=base.camera.scaled_to(*survey.size), source=None)
        poses = [pose for pose in map(survey.pose, range(frames)) if pose is not None]
        scene = draw_variation(base, file.dataset, 0, 0, poses).scene
        source = bench.folder / "small.mp4"
        with Session(scene, source=source, device=device, quality=bench.options.quality, loop=True) as session:
            live = iter(session)
            for turn in range(count):
                start = time.perf_counter()
                for _, result in itertools.islice(live, frames):
                    _ = result.image
                middle = time.perf_counter()
                for lit in lighter.light(Job("variation", 0, turn, 0, frames), scene):
                    _ = lit.image
                end = time.perf_counter()
                if turn:
                    times["live"].append(1e3 * (middle - start) / frames)
                    times["variation"].append(1e3 * (end - middle) / frames)
    shutil.rmtree(folder)
    bench.tell(
        "a variation's frame over one of live with given light",
        ratio=round(paired_ratio(times, "variation", "live"), 3),
        asked=1.15,
        variation_ms=[round(value, 2) for value in times["variation"]],
        live_ms=[round(value, 2) for value in times["live"]],
        frames=frames,
    )
