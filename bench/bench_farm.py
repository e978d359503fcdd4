"""The farm from file to file: GPUs and workers, what bounds a worker, a long recording, a data set of variations.

    python -m bench farm --device cuda --output DIR [--parts gpus,bounds] [--minutes 6]

Parts, each of which keeps to its share of the minutes:

- ``bounds``: what a frame costs in each step of a worker, alone and on one stream: decoding, conversion, tracking,
  kernels, encoding; and a whole worker beside them;
- ``gpus``: frames a second of segments with one GPU and half of the cores, the same while a second run has the other
  GPU and half, and with two and all of them, in turn; one and several workers per GPU. On a machine of one GPU only
  the first;
- ``cpu``: the same on the processor alone, for several numbers of workers;
- ``long``: a recording through 8 segments while workers and driver are killed: each job once, memory over time, and
  every picture equal to those of one run. As many of the asked frames as fit its minutes; the figures say how many.
  With ``--phases`` all of them, one or some of its phases in a call: what they need lies in ``--work DIR``;
- ``variations``: variations of one clip by 1, 2 and 4 workers at once, each with its share of the cores: bytes equal;
  and a variation's frame over one of ``live`` with the same light, in turn;
- ``kills``: a recording lit while workers and driver are killed at random moments: bytes those of a run left alone.

Results are JSON lines, on the standard output and in ``DIR/farm_PART.jsonl``; progress is on the standard error.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import itertools
import os
import shutil
import statistics
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import warp as wp

from bench.farm_bench import START_SECONDS, Bench, numbers_of
from bench.farm_bounds import run_bounds
from bench.farm_clip import surveyed, write_clips
from bench.farm_kills import run_kills
from bench.farm_long import PHASES, run_long
from bench.farm_recordings import RATE
from bench.farm_runs import jobs_done, prepare, rates, work
from bench.farm_survey import run_survey
from bench.farm_variations import run_variations
from warp_ar.farm.fitting import probe_worker, workers_of_gpu
from warp_ar.farm.jobs import parse_jobs, read_jobs
from warp_ar.farm.pool import by_siblings

PARTS = {"bounds": 0.1, "survey": 0.1, "gpus": 0.4, "cpu": 0.1, "long": 0.22, "variations": 0.18, "kills": 0.2}
"""Parts in their order, and their shares of the minutes."""
LEAST_STEADY = 8.0
"""Seconds of steady work that a number of workers is given, so that each of them does more than one job."""


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Options of this benchmark."""
    parser = argparse.ArgumentParser(prog="python -m bench farm", description=__doc__.partition("\n")[0])
    parser.add_argument("--output", type=Path, metavar="DIR", help="where the JSON lines go (default: nowhere)")
    parser.add_argument("--parts", default=",".join(PARTS), metavar="A,B", help=f"some of {', '.join(PARTS)}")
    parser.add_argument("--minutes", type=float, default=6.0, help="of all chosen parts (default: 6)")
    parser.add_argument("--size", default="1920x1080", metavar="WxH", help="of the recordings (default: 1920x1080)")
    parser.add_argument("--quality", default="medium")
    parser.add_argument("--per-gpu", default="1,4,8", metavar="N,M", help="workers of a GPU to try (default: 1,4,8)")
    parser.add_argument("--no-trial", dest="trial", action="store_false", help="those alone, not what a trial tells")
    parser.add_argument("--cpu-workers", default="1,2,4,8", metavar="N,M", help="of part cpu (default: 1,2,4,8)")
    parser.add_argument("--segment-frames", type=int, default=60, help="of parts gpus and cpu (default: 60)")
    parser.add_argument("--long-frames", type=int, default=54_000, help="asked of part long (default: 54000)")
    parser.add_argument("--long-rate", type=int, default=RATE, help="its frames a second; the clips' own are 24 (30)")
    parser.add_argument("--phases", default="", metavar="A,B", help=f"of part long, some of {', '.join(PHASES)}")
    parser.add_argument("--kill-seconds", type=float, default=90.0, help="of part long, within which all die (90)")
    parser.add_argument("--variations", type=int, default=2000, help="of part variations (default: 2000)")
    parser.add_argument("--kill-frames", type=int, default=4800, help="of part kills' recording (default: 4800)")
    parser.add_argument("--kills", type=int, default=20, help="deaths of workers in parts long and kills (20)")
    parser.add_argument("--driver-kills", type=int, default=3, help="deaths of the driver there (default: 3)")
    parser.add_argument("--decode", choices=("cpu", "gpu"), default="cpu", help="what decodes (default: cpu)")
    parser.add_argument("--variation-size", default="640x480", metavar="WxH", help="of their pictures (640x480)")
    parser.add_argument(
        "--work", type=Path, metavar="DIR", help="for recordings and runs (default: a temporary folder)"
    )
    options = parser.parse_args(arguments)
    unknown = [part for part in options.parts.split(",") if part not in PARTS]
    if unknown:
        parser.error(f"--parts {','.join(unknown)}: there are {', '.join(PARTS)}")
    unknown = [phase for phase in filter(None, options.phases.split(",")) if phase not in PHASES]
    if unknown or (options.phases and options.work is None):
        parser.error(f"--phases: some of {', '.join(PHASES)}, and a folder that is kept: --work DIR")
    return options


def steady_run(
    bench: Bench, name: str, workers: int, device: str, seconds: float, *, gpus: Sequence[int], cores: Sequence[int]
) -> dict[str, Any]:
    """Frames a second of segments with so many workers; what it writes is removed."""
    source = surveyed(bench)
    jobs = write_clips(bench, f"{name}.toml", 60, bench.options.segment_frames)
    folder = bench.folder / name
    prepare(folder, jobs, source)
    limit = START_SECONDS + seconds
    seen = work(folder, workers, device, bench.say, gpus=gpus, cores=cores, limit=limit, steady=seconds)
    done = jobs_done(folder, "segment")
    figures = rates(done, workers, seen) | {
        "workers": workers,
        "run_seconds": round(seen.seconds, 1),
        "processor_cores_with_starts": round(seen.processor_seconds / seen.seconds, 2),
        "bytes_per_frame": round(sum(job.bytes for job in done) / max(sum(job.frames for job in done), 1)),
        **seen.gpu_figures(),
    }
    if not done:
        figures["error"] = seen.errors[-500:]
    shutil.rmtree(folder)
    return figures


def _numbers_to_try(bench: Bench, cores: int, gpus: int) -> list[int]:
    """Workers of a GPU: what a trial tells, and those that were asked for."""
    asked = numbers_of(bench.options.per_gpu)
    jobs = parse_jobs(read_jobs(write_clips(bench, "trial.toml", 1, bench.options.segment_frames)), "trial.toml")
    if not bench.options.trial or (trial := probe_worker(jobs, "cuda:0")) is None:
        return asked
    own, figures = workers_of_gpu(trial, cores, gpus), dataclasses.asdict(trial)
    # Under a name of its own: `cores` are the machine's.
    kept = round(figures.pop("cores"), 2)
    bench.tell("trial of one worker", cores_kept_busy=kept, **figures, workers_of_a_gpu=own)
    return [own, *(number for number in asked if number != own)]


@dataclasses.dataclass(frozen=True)
class GpuCase:
    """One way to spread workers over the GPUs of a host."""

    gpus: int
    """Of one run."""
    per_gpu: int
    """Workers of each."""
    cores: tuple[int, ...]
    """That one run keeps to."""
    neighbour: tuple[int, ...] = ()
    """Cores on which a second such run works on the second GPU at the same time; empty: there is none."""

    def __str__(self) -> str:
        beside = ", the other half at the same work" if self.neighbour else ""
        return f"{self.gpus} GPU, {self.per_gpu} workers each, {len(self.cores)} cores{beside}"


def _gpu_cases(each: Sequence[int], cores: Sequence[int], count: int) -> list[GpuCase]:
    """For each number of workers of a GPU: one GPU, the same while the host's other half is as busy, and two."""
    whole = tuple(cores)
    half = whole[: max(1, len(whole) // 2)] if count > 1 else whole
    cases = []
    for per_gpu in each:
        cases.append(GpuCase(1, per_gpu, half))
        if count > 1:
            cases += [GpuCase(2, per_gpu, whole), GpuCase(1, per_gpu, half, whole[len(half) :])]
    if count > 1:
        cases.append(GpuCase(1, 2 * each[-1], whole))
    return cases


def _measure_gpu_case(bench: Bench, name: str, case: GpuCase, seconds: float) -> dict[str, Any]:
    """Figures of one run; where it has a neighbour, with the frames a second of both (``fps_each``) and their mean."""
    workers = case.gpus * case.per_gpu
    if not case.neighbour:
        return steady_run(bench, name, workers, "cuda", seconds, gpus=range(case.gpus), cores=case.cores)
    with ThreadPoolExecutor(2) as pool:
        runs = [
            pool.submit(steady_run, bench, f"{name}-{gpu}", workers, "cuda", seconds, gpus=[gpu], cores=cores)
            for gpu, cores in enumerate((case.cores, case.neighbour))
        ]
        both = [run.result() for run in runs]
    figures = both[0]
    if all("fps" in one for one in both):
        figures["fps_each"] = [one["fps"] for one in both]
        figures["fps"] = statistics.mean(figures["fps_each"])
    return figures


def run_gpus(bench: Bench) -> None:
    """One GPU and two, in turn; one GPU also while the host's other half does the same."""
    count = len(wp.get_cuda_devices())
    if not count or bench.device == "cpu":
        bench.tell("gpus", left_out="there is no CUDA device")
        return
    surveyed(bench)
    cores = by_siblings(os.sched_getaffinity(0))
    each = _numbers_to_try(bench, len(cores), count)
    cases = _gpu_cases(each, cores, count)
    seconds = max(LEAST_STEADY, bench.left / (2 * len(cases)) - 8.0)
    found: dict[GpuCase, list[float]] = {}
    took = 0.0
    for turn, case in itertools.product(range(2), cases):
        if bench.left < took:
            bench.say("no time is left for more")
            break
        bench.say(f"{case}, turn {turn + 1}")
        start = time.monotonic()
        figures = _measure_gpu_case(bench, f"gpus-{cases.index(case)}-{turn}", case, seconds)
        bench.tell(
            "gpus",
            gpus=case.gpus,
            per_gpu=case.per_gpu,
            used_cores=len(case.cores),
            neighbour=bool(case.neighbour),
            turn=turn + 1,
            figures=figures,
        )
        if "fps" in figures:
            found.setdefault(case, []).append(figures["fps"])
        took = max(took, time.monotonic() - start)
    for two, one in itertools.product(cases, cases):
        if two.gpus == 2 and one.gpus == 1 and one.per_gpu == two.per_gpu and len(one.cores) < len(two.cores):
            _tell_ratio(bench, one, found.get(one, []), found.get(two, []))


def _tell_ratio(bench: Bench, case: GpuCase, one: list[float], two: list[float]) -> None:
    """What two GPUs make over one."""
    ratios = [b / a for a, b in zip(one, two, strict=False)]
    if not ratios:
        return
    beside = ", which has a neighbour at the same work" if case.neighbour else ""
    bench.tell(
        f"two GPUs over one{beside}, {case.per_gpu} workers each",
        ratio=round(statistics.median(ratios), 3),
        ratios=[round(ratio, 3) for ratio in ratios],
        asked=1.9,
        one_fps=one,
        two_fps=two,
    )


def run_cpu(bench: Bench) -> None:
    """Numbers of workers on the processor alone."""
    surveyed(bench)
    cores = sorted(os.sched_getaffinity(0))
    counts = [count for count in numbers_of(bench.options.cpu_workers) if count <= len(cores)]
    frames, bench.options.segment_frames = bench.options.segment_frames, min(4, bench.options.segment_frames)
    try:
        seconds = max(4.0, bench.left / len(counts) - 8.0)
        for count in counts:
            bench.say(f"{count} workers on {len(cores)} cores")
            figures = steady_run(bench, f"cpu-{count}", count, "cpu", seconds, gpus=(), cores=cores)
            bench.tell("cpu", used_cores=len(cores), figures=figures)
    finally:
        bench.options.segment_frames = frames


def run_parts(bench: Bench) -> None:
    """All parts that are asked for, each within its share of the minutes."""
    runs = {
        "bounds": run_bounds,
        "survey": run_survey,
        "gpus": run_gpus,
        "cpu": run_cpu,
        "long": run_long,
        "variations": run_variations,
        "kills": run_kills,
    }
    asked = [part for part in PARTS if part in bench.options.parts.split(",")]
    end = time.monotonic() + 60.0 * bench.options.minutes
    for index, part in enumerate(asked):
        left = sum(PARTS[name] for name in asked[index:])
        bench.part = part
        bench.until = time.monotonic() + max(end - time.monotonic(), 20.0) * PARTS[part] / left
        bench.say(f"has {bench.left:.0f} s")
        start = time.monotonic()
        try:
            runs[part](bench)
        except Exception as error:
            # The other parts are run all the same; the caller sees this one's end.
            bench.tell(part, error=f"{type(error).__name__}: {error}"[:500])
            if len(asked) == 1:
                raise
        bench.say(f"took {time.monotonic() - start:.0f} s")


def main(device: str, arguments: Sequence[str] = ()) -> None:
    """Run the parts that the arguments ask for."""
    options = parse(arguments)
    with _folder(options.work) as folder:
        run_parts(Bench(options, "cpu" if device == "cpu" else "cuda", folder))


@contextlib.contextmanager
def _folder(path: Path | None) -> Iterator[Path]:
    """A folder that is there, temporary unless it is named."""
    if path is not None:
        path.mkdir(parents=True, exist_ok=True)
        yield path.absolute()
        return
    with tempfile.TemporaryDirectory(prefix="warp_ar-farm-") as name:
        yield Path(name)
