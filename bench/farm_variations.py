"""Variations of a clip by several workers."""

from __future__ import annotations

import concurrent.futures
import dataclasses
import hashlib
import itertools
import json
import os
import shutil
import statistics
import time
from pathlib import Path

from bench.common import paired_ratio
from bench.farm_bench import START_SECONDS, Bench, size_of
from bench.farm_recordings import write_recording, write_scene
from bench.farm_runs import Done, jobs_done, prepare, rates, work
from warp_ar.farm.jobs import Job, parse_jobs, read_jobs
from warp_ar.farm.lighting import Lighter
from warp_ar.farm.survey import lit_scene, survey_clip
from warp_ar.farm.variations import draw_variation
from warp_ar.session import Session

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
    device = bench.one_device
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
