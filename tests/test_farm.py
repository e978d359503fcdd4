"""The command with real workers: what it makes, what a corrupt clip and sudden deaths do to it, and the same in Ray."""

from __future__ import annotations

import collections
import contextlib
import hashlib
import json
import os
import pathlib
import random
import signal
import subprocess
import sys
import time

import av
import pytest

from tests.farm_rig import TICK, write_recording
from warp_ar.farm.cli import main
from warp_ar.farm.manifest import read_status

pytestmark = pytest.mark.slow

TICKS = [0, 25, 40, 75, 100, 101, 150, 175, 230, 250, 275, 300]
"""Of a recording of variable rate."""
ROOT = pathlib.Path(__file__).resolve().parents[1]
PATIENCE = 580.0
"""Seconds after which a run that should have ended has hung."""

RECORDINGS = """
schema = 1
[run]
quality = "low"
segment_frames = 6
[[clip]]
scene = "torus"
path = "good.mp4"
[[clip]]
scene = "torus"
path = "cut.mp4"
"""
DATASET = """
schema = 1
[run]
quality = "low"
[[clip]]
scene = "torus"
path = "good.mp4"
frames = [0, 4]
[dataset]
variations = 4
seed = 1
objects = [1, 2]
every = 2
[[dataset.object]]
name = "ball"
shape = "sphere"
radius = 0.02
material = { model = "metallic_roughness", roughness = [0.1, 0.9] }
[[dataset.object]]
name = "die"
shape = "box"
size = [0.03, 0.03, 0.03]
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Recordings, one of them cut off, and job files."""
    tmp_path = tmp_path_factory.mktemp("farm")
    write_recording(tmp_path / "good.mp4", 12, sound=True, ticks=TICKS)
    data = (tmp_path / "good.mp4").read_bytes()
    (tmp_path / "cut.mp4").write_bytes(data[: len(data) // 2])
    (tmp_path / "jobs.toml").write_text(RECORDINGS)
    (tmp_path / "data.toml").write_text(DATASET)
    return tmp_path


@pytest.fixture(scope="module")
def finished(folder):
    """A run of both recordings with two workers: its folder, and exit code, output and errors of the command."""
    return folder / "run", *finish(farm("run", folder / "jobs.toml", "--output", folder / "run", "--workers", 2))


def farm(*arguments, **options):
    """Start the command in a process of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "warp_ar.farm", *map(str, arguments)],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        **options,
    )


def finish(process):
    out, err = process.communicate(timeout=PATIENCE)
    return process.returncode, out, err


def done_lines(run):
    """How often each job has a line that says it is done."""
    lines = [json.loads(line) for line in (run / "manifest.jsonl").read_text().splitlines()]
    return collections.Counter(line["job"] for line in lines if line["state"] == "done")


def digest(run):
    """Of every file of a data set."""
    files = sorted(path for path in (run / "dataset").rglob("*") if path.is_file())
    return {path.relative_to(run).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def test_a_corrupt_clip_fails_alone_and_the_exit_code_says_so(folder, finished, capsys):
    run, code, out, err = finished
    assert code == 1, err
    assert "1 job failed" in out
    assert "cut/survey: " in out
    assert str(folder / "cut.mp4") in out
    with av.open(str(run / "good.mp4")) as container:
        assert [packet.pts * packet.time_base / TICK for packet in container.demux(video=0) if packet.size] == TICKS
        assert container.metadata["title"] == "A desk"
        assert container.streams.audio[0].metadata["language"] == "deu"
        assert len(container.streams.audio) == 1
    assert not (run / "cut.mp4").exists()
    assert list((run / "parts").iterdir()) == [], "what was joined is not kept twice"
    status = read_status(run)
    assert status["done"] == {"survey": 1, "segment": 2, "join": 1}
    assert not status["running"]
    capsys.readouterr()
    assert main(["status", str(run)]) == 0
    told = capsys.readouterr().out
    assert "12 frames lit" in told
    assert "failed: cut/survey: " in told
    assert "no driver is at work; nothing that is known is open" in told
    # Nothing is left to do, and what failed is still said.
    before = (run / "manifest.jsonl").read_text()
    assert main(["resume", str(run), "--workers", "1"]) == 1
    assert (run / "manifest.jsonl").read_text() == before


def test_a_data_set_is_the_same_bytes_for_any_number_of_workers_and_any_deaths(folder, pytestconfig):
    """One worker's data set, and that of two whose workers and driver are killed again and again."""
    kills, driver_kills = (20, 3) if pytestconfig.getoption("--long") else (1, 1)
    if pytestconfig.getoption("--long"):
        (folder / "data.toml").write_text(DATASET.replace("variations = 4", "variations = 40"))
    alone, killed = folder / "alone", folder / "killed"
    code, _, err = finish(farm("run", folder / "data.toml", "--output", alone, "--workers", 1))
    assert code == 0, err
    worker_deaths, driver_deaths = run_with_kills(folder / "data.toml", killed, kills, driver_kills)
    assert (worker_deaths, driver_deaths) == (kills, driver_kills)
    assert digest(killed) == digest(alone)
    counts = done_lines(killed)
    assert set(counts) == set(done_lines(alone))
    assert set(counts.values()) == {1}
    assert not (killed / ".aside").exists() or not list((killed / ".aside").iterdir())


def run_with_kills(jobs, run, kills, driver_kills):
    """Run to the end, killing workers and the driver as the manifest grows; returns how many of each died."""
    dice = random.Random(5)
    order = ["worker"] * kills + ["driver"] * driver_kills
    dice.shuffle(order)
    dead: collections.Counter[str] = collections.Counter()
    process = farm("run", jobs, "--output", run, "--workers", 2)
    manifest, seen, end = run / "manifest.jsonl", 0, time.monotonic() + PATIENCE
    while process.poll() is None and time.monotonic() < end:
        time.sleep(0.02)
        lines = manifest.read_text().count("\n") if manifest.exists() else 0
        if not order or lines <= seen:
            continue
        if order[-1] == "driver":
            process.kill()
            process.communicate()
            dead["driver"] += 1
            seen = lines
            order.pop()
            process = farm("resume", run, "--workers", 2)
            continue
        workers = children(process.pid)
        if workers:
            with contextlib.suppress(ProcessLookupError):
                os.kill(dice.choice(workers), signal.SIGKILL)
                dead["worker"] += 1
                seen = lines
                order.pop()
    code, _, err = finish(process)
    assert code == 0, err
    return dead["worker"], dead["driver"]


def children(parent):
    """Workers of a driver: processes that multiprocessing has spawned."""
    found = []
    for path in pathlib.Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if (
                int((path / "stat").read_text().rsplit(")", 1)[1].split()[1]) == parent
                and b"spawn_main" in (path / "cmdline").read_bytes()
            ):
                found.append(int(path.name))
    return sorted(found)


def test_a_plan_runs_nothing_but_a_few_frames(folder, capsys):
    before = sorted(folder.iterdir())
    assert main(["plan", str(folder / "data.toml"), "--device", "cpu", "--workers", "4"]) == 0
    out = capsys.readouterr().out
    assert "1 clips, 4 variations, 8 frames to light, 4 to survey" in out
    assert "4 workers: " in out
    assert sorted(folder.iterdir()) == before


def test_a_run_of_another_program_is_not_gone_on_with(tmp_path, capsys):
    run = tmp_path / "run"
    run.mkdir()
    (run / "run.json").write_text(json.dumps({"version": "warp_ar 0.0", "jobs": {"clip": []}}))
    assert main(["resume", str(run)]) == 2
    assert "was started by warp_ar 0.0; this is warp_ar" in capsys.readouterr().err


def test_the_same_on_a_local_ray_of_two_nodes(folder, finished):
    """Needs the extra ``farm``."""
    pytest.importorskip("ray", reason="Ray is not installed: pip install 'warp-ar[farm]'")
    code = (
        "import sys\nfrom ray.cluster_utils import Cluster\n"
        "cluster = Cluster(initialize_head=True, head_node_args={'num_cpus': 1, 'include_dashboard': False})\n"
        "cluster.add_node(num_cpus=1)\nprint(cluster.address, flush=True)\nsys.stdin.read()\ncluster.shutdown()\n"
    )
    cluster = subprocess.Popen(
        [sys.executable, "-c", code],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    try:
        assert cluster.stdout is not None
        address = cluster.stdout.readline().strip()
        assert address
        result, out, err = finish(farm("run", folder / "jobs.toml", "--output", folder / "ray", "--ray", address))
        assert result == 1, err
        assert "cut/survey" in out
        assert set(done_lines(folder / "ray").values()) == {1}
        assert (folder / "ray/good.mp4").read_bytes() == (finished[0] / "good.mp4").read_bytes()
    finally:
        cluster.communicate("")
