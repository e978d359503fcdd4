"""Speed of the farm, from file to file, for numbers of workers, or in comparison with another checkout.

``python -m bench farm --device cpu --workers 1,2`` lights the bundled desk in segments and checks that the joined
recordings have equal bytes. With ``--other DIR``, the program of another checkout runs the job file in turn with this
one; the median of the paired ratios of frames per second is printed.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from bench.common import commit

ROOT = Path(__file__).resolve().parents[1]
JOBS = """schema = 1
[run]
quality = "{quality}"
segment_frames = {segment}
[[clip]]
scene = "desk"
"""


def light(root: Path, jobs: Path, folder: Path, device: str, workers: str) -> tuple[float, str]:
    """Run the farm of a checkout; return the frames per second of the whole run, and the recording's digest.

    Args:
        root: Folder of the checkout.
        jobs: The job file.
        folder: Folder of the run.
        device: Option ``--device`` of the farm.
        workers: Number of workers as text, or ``default``.
    """
    command = [sys.executable, "-m", "warp_ar.farm", "run", str(jobs), "--output", str(folder), "--device", device]
    if workers != "default":
        command += ["--workers", workers]
    start = time.perf_counter()
    subprocess.run(command, cwd=root, env=os.environ, check=True, capture_output=True)
    seconds = time.perf_counter() - start
    lines = [json.loads(line) for line in (folder / "manifest.jsonl").read_text(encoding="utf-8").splitlines()]
    frames = sum(line["frames"] for line in lines if "/segment" in line["job"] and line["state"] == "done")
    return frames / seconds, hashlib.sha256((folder / "desk.mp4").read_bytes()).hexdigest()[:16]


def main(device: str, arguments: Sequence[str] = ()) -> None:
    parser = argparse.ArgumentParser(prog="python -m bench farm")
    parser.add_argument("--workers", default="default", help="numbers with commas (default: the program's own)")
    parser.add_argument("--quality", default="medium")
    parser.add_argument("--segment", type=int, default=24, help="frames of a segment")
    parser.add_argument("--other", type=Path, metavar="DIR", help="another checkout, run in turn")
    parser.add_argument("--turns", type=int, default=3)
    options = parser.parse_args(arguments)
    roots = [ROOT] + ([options.other] if options.other else [])
    with tempfile.TemporaryDirectory(prefix="warp_ar-bench-") as name:
        jobs = Path(name) / "jobs.toml"
        jobs.write_text(JOBS.format(quality=options.quality, segment=options.segment), encoding="utf-8")
        digests = set()
        for workers in options.workers.split(","):
            rates: list[list[float]] = [[] for _ in roots]
            for turn in range(-1, options.turns):  # the first turn compiles kernels and is not counted
                for number, root in enumerate(roots):
                    rate, digest = light(root, jobs, Path(name) / f"{workers}-{number}-{turn}", device, workers)
                    digests.add(digest)
                    if turn >= 0:
                        rates[number].append(rate)
            told = {
                "case": f"farm, {workers} workers",
                "device": device,
                "commit": commit(),
                "frames_per_second": [round(statistics.median(own), 2) for own in rates],
                "equal_bytes": len(digests) == 1,
            }
            if options.other:
                told["ratio"] = round(statistics.median(a / b for a, b in zip(*rates, strict=True)), 3)
            print(json.dumps(told), flush=True)
