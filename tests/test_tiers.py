"""Kernels in two ways: the same bits, better ones made beside the frames, nothing left of them that is not whole."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
import warp as wp

from warp_ar.device import resolve_device
from warp_ar.engine import better_kernels, modules, tiers
from warp_ar.errors import UsageError
from warp_ar.kernels.launch import QUICK_TO_COMPILE, is_slow_to_compile, slow_to_compile

PATIENCE = 120.0
"""Seconds in which a process that works only while a core is free gets to its end, on a machine with other work."""

SCRIPT = """
import pathlib, sys, time
import warp as wp
from warp_ar.device import resolve_device
from warp_ar.engine import modules, tiers
from warp_ar.kernels.launch import slow_to_compile

@slow_to_compile
@wp.kernel(module="unique", enable_backward=False)
def slow_kernel(values_out: wp.array[wp.float32]):
    values_out[wp.tid()] = wp.sqrt(2.0 + wp.float32(wp.tid()))

device = resolve_device("cpu")
tiers.begin_quickly()
modules.load_modules([slow_kernel], device)
values = wp.zeros(4, dtype=wp.float32, device="cpu")
wp.launch(slow_kernel, 4, [], [values], device="cpu")
cache = pathlib.Path(wp.config.kernel_cache_dir)
kept = sorted(path.name for path in cache.glob("wp_slow_kernel*"))
flags = slow_kernel.module.options["cpu_compiler_flags"]
process = tiers._BESIDE.process
print(flags == tiers.QUICK_FLAGS, values.numpy().tobytes().hex(), None if process is None else process.pid, *kept)
stop = time.monotonic() + float(sys.argv[1])
while process is not None and len(list(cache.glob("wp_slow_kernel*"))) < 2 and time.monotonic() < stop:
    time.sleep(0.05)
"""


@pytest.fixture
def run_script(tmp_path: Path):
    script = tmp_path / "script.py"  # Warp reads a kernel's text from its file
    script.write_text(SCRIPT)

    def run(seconds: float, mode: str = "") -> list[str]:
        """What the script prints: whether it began quickly, its result, the process beside it, and its modules."""
        environment = {**os.environ, "WARP_CACHE_PATH": str(tmp_path / "cache"), tiers.VARIABLE: mode}
        environment["PYTHONPATH"] = str(Path(__file__).parents[1])
        command = [sys.executable, "-X", "dev", "-W", "error::ResourceWarning", str(script), str(seconds)]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        assert "ResourceWarning" not in done.stderr, done.stderr
        return done.stdout.splitlines()[-1].split()

    return run


def _binaries(cache: Path) -> dict[str, bytes]:
    return {path.parent.name: path.read_bytes() for path in cache.glob("**/wp_slow_kernel*/*.o")}


def test_the_next_run_finds_what_was_compiled_beside_this_one(tmp_path: Path, run_script) -> None:
    """And it is what Warp itself makes of the kernel, to the byte, and computes what the quick one computes."""
    quickly, first, process, quick = run_script(PATIENCE)
    assert quickly == "True"
    assert process != "None"
    (better,) = set(_binaries(tmp_path / "cache")) - {quick}
    quickly, second, process, *kept = run_script(0.0)
    assert (quickly, process) == ("False", "None")  # it has the better one, and nothing is left to do
    assert second == first
    assert sorted(kept) == sorted([quick, better])
    assert list((tmp_path / "cache").glob(f"**/{better_kernels.FOLDER}*")) == []

    made = _binaries(tmp_path / "cache")[better]
    (folder,) = (tmp_path / "cache").glob(f"**/{better}")
    names = sorted(path.name for path in folder.iterdir())
    (tmp_path / "cache").rename(tmp_path / "beside")
    assert run_script(0.0, "one")[3:] == [better]
    assert _binaries(tmp_path / "cache") == {better: made}
    (folder,) = (tmp_path / "cache").glob(f"**/{better}")
    assert sorted(path.name for path in folder.iterdir()) == names


def test_the_process_ends_with_the_one_that_asked(run_script, tmp_path: Path) -> None:
    """At its end, a second later at most: here it is over before the parent is."""
    *_, process, _ = run_script(0.0)
    assert not better_kernels._runs(int(process))
    assert list((tmp_path / "cache").glob(f"**/{better_kernels.FOLDER}*")) == []


def test_the_process_ends_when_what_it_reads_ends(tmp_path: Path) -> None:
    """So does one whose parent was killed, and it takes its folder along."""
    command = [sys.executable, better_kernels.__file__, str(tmp_path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE) as process:
        stop = time.monotonic() + PATIENCE
        while not list(tmp_path.glob(f"{better_kernels.FOLDER}*")) and time.monotonic() < stop:
            time.sleep(0.01)
        assert process.poll() is None
        assert process.stdin is not None
        process.stdin.close()
        assert process.wait(PATIENCE) == 0
    assert list(tmp_path.iterdir()) == []


def test_what_a_killed_process_left_is_removed(tmp_path: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        ended.wait()
    for number in (ended.pid, os.getpid()):
        (better_kernels.work_folder(tmp_path, number) / "half").mkdir(parents=True)
    (tmp_path / "better_work").mkdir()  # somebody else's
    better_kernels.remove_left_behind(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([f"better_{os.getpid()}", "better_work"])


def test_a_library_begins_with_the_better_ones(monkeypatch) -> None:
    monkeypatch.delenv(tiers.VARIABLE, raising=False)
    monkeypatch.setattr(tiers, "_BESIDE", tiers._Beside())  # other tests of this process run commands
    assert tiers.tiers() == "one"
    monkeypatch.setattr(tiers._BESIDE, "default", "two")
    assert tiers.tiers() == "two"
    monkeypatch.setenv(tiers.VARIABLE, "quick")
    assert tiers.tiers() == "quick"


@pytest.mark.parametrize(
    ("variable", "value", "call"),
    [
        (tiers.VARIABLE, "fast", tiers.tiers),
        (tiers.LEVEL_VARIABLE, "4", lambda: tiers.cuda_level("shade")),
        (tiers.LEVEL_VARIABLE, "two", lambda: tiers.cuda_level("shade")),
        (tiers.LEVEL_VARIABLE, ":shade", lambda: tiers.cuda_level("shade")),
    ],
)
def test_other_values_are_named(monkeypatch, variable, value, call) -> None:
    monkeypatch.setenv(variable, value)
    with pytest.raises(UsageError, match=f"{variable} = '{value}': expected"):
        call()


@pytest.mark.parametrize(
    ("asked", "levels"),
    [("", (None, None)), ("2", (2, 2)), ("2:near_field,relight", (2, None)), ("3:shade", (None, 3))],
)
def test_levels_of_cuda(monkeypatch, asked, levels) -> None:
    monkeypatch.setenv(tiers.LEVEL_VARIABLE, asked)
    assert (tiers.cuda_level("make_near_field_kernel__x"), tiers.cuda_level("make_shade_kernel__y")) == levels


@slow_to_compile
@wp.kernel(module="unique", enable_backward=False)
def marked_kernel(values_out: wp.array[wp.int32]):
    values_out[wp.tid()] = 3


@wp.kernel(module="unique", enable_backward=False)
def usual_kernel(values_out: wp.array[wp.int32]):
    values_out[wp.tid()] = 4


@wp.kernel(module="unique", enable_backward=False, module_options=QUICK_TO_COMPILE)
def chosen_kernel(values_out: wp.array[wp.int32]):
    values_out[wp.tid()] = 5


def test_all_kernels_are_compiled_quickly_and_none_twice(monkeypatch, tmp_path) -> None:
    """All by the same flags: Clang's belong to the process, and compilers with others would wait."""
    device = resolve_device("cpu")
    monkeypatch.setattr(tiers, "_BESIDE", tiers._Beside())
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    monkeypatch.setenv(tiers.VARIABLE, "quick")
    modules.load_modules([marked_kernel, usual_kernel, chosen_kernel], device)
    for kernel in (marked_kernel, usual_kernel, chosen_kernel):
        assert kernel.module.options["cpu_compiler_flags"] == tiers.QUICK_FLAGS
    names = {path.name for path in tmp_path.glob("wp_*")}
    assert len(names) == 3
    monkeypatch.setenv(tiers.VARIABLE, "two")  # what has begun stays as it is
    modules.load_modules([marked_kernel, usual_kernel, chosen_kernel], device)
    assert {path.name for path in tmp_path.glob("wp_*")} == names
    assert tiers._BESIDE.process is None


@slow_to_compile
@wp.kernel(module="unique", enable_backward=False)
def last_marked_kernel(values_out: wp.array[wp.int32]):
    values_out[wp.tid()] = 6


@wp.kernel(module="unique", enable_backward=False, module_options=QUICK_TO_COMPILE)
def last_chosen_kernel(values_out: wp.array[wp.int32]):
    values_out[wp.tid()] = 7


def test_kernels_that_gain_most_are_compiled_better_first_and_each_by_its_own_flags(
    monkeypatch, tmp_path, warp_flags
) -> None:
    monkeypatch.setattr(tiers, "_BESIDE", tiers._Beside())
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    monkeypatch.setenv(tiers.VARIABLE, "two")
    assert is_slow_to_compile(last_marked_kernel)
    assert not is_slow_to_compile(last_chosen_kernel)
    tiers.choose([last_chosen_kernel, last_marked_kernel], resolve_device("cpu"))
    wanted = [(module, arguments["extra_flags"]) for module, _, _, arguments in tiers._BESIDE.wanted]
    assert wanted == [
        (last_marked_kernel.module, warp_flags),
        (last_chosen_kernel.module, QUICK_TO_COMPILE["cpu_compiler_flags"]),
    ]


@wp.kernel(module="unique", enable_backward=False)
def early_kernel(values_out: wp.array[wp.int32]):
    values_out[wp.tid()] = 8


def test_a_kernel_that_runs_while_a_pipeline_is_built_parses_no_headers(monkeypatch, tmp_path) -> None:
    """They were parsed ahead, by another thread; the kernel keeps its own flags."""
    build, found = wp._src.build.build_cpu, {}

    def note(target: str, source: str, *, pch_dir: str, **given: object) -> None:
        found[Path(source).name.partition("_kernel")[0]] = list(Path(pch_dir).glob("*.pch")) != []
        build(target, source, pch_dir=pch_dir, **given)

    monkeypatch.setattr(wp._src.build, "build_cpu", note)
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    modules.parse_headers_ahead()
    modules.load_at_once(early_kernel, resolve_device("cpu"))
    # Another test of this process may have had them parsed before.
    assert not found.pop("headers.cpp", False)
    assert found == {"wp_early": True}
    assert early_kernel.module.options["cpu_compiler_flags"] is None
    values = wp.zeros(1, dtype=wp.int32, device="cpu")
    wp.launch(early_kernel, 1, [], [values], device="cpu")
    assert values.numpy()[0] == 8
    assert len(list(tmp_path.glob("wp_early_kernel*"))) == 1


FRAMES = """
import hashlib, itertools, json, sys
import cv2
import numpy as np
from warp_ar.engine.pipeline import Pipeline
from warp_ar.engine.tiers import QUICK_FLAGS
from warp_ar.sources.sources import open_source
from warp_ar.kernels.launch import _SLOW
from warp_ar.scene import load_scene

name, quality = sys.argv[1:]
scene = load_scene(name)
size, seen = (160, 120), hashlib.sha256()
with open_source(scene.source.path) as source:
    with Pipeline(scene, device="cpu", quality=quality, size=size, outputs=("image", "radiance")) as pipeline:
        for frame in itertools.islice(source, 3):
            small = cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA).astype(np.uint8)
            result = pipeline(small, time_seconds=frame.time)
            seen.update(result.image.tobytes())
            seen.update(np.ascontiguousarray(result.radiance).tobytes())
        quick = sum(kernel.module.options["cpu_compiler_flags"] == QUICK_FLAGS for kernel in _SLOW)
print(json.dumps({"frames": seen.hexdigest(), "quick": quick}))
"""


@pytest.mark.parametrize(
    ("scene", "quality"),
    [
        ("desk", "medium"),
        ("desk", "high"),
        # All other bundled scenes but ``darken``, which runs no kernel that is marked.
        *((name, "medium") for name in ("mirror", "product", "screen", "torus", "wire_coincident", "wire_opposing")),
    ],
)
def test_both_ways_compute_the_same_bits(
    tmp_path: Path, scene: str, quality: str, request: pytest.FixtureRequest
) -> None:
    """So that frames are equal from run to run, whichever kernels a run finds: codes, and radiance in 32 bits."""
    if (scene, quality) not in (("desk", "high"), ("screen", "medium")) and not request.config.getoption("--long"):
        pytest.skip("between them the other two hold the kernels of all: --long")
    script = tmp_path / "frames.py"
    script.write_text(FRAMES)

    def run(mode: str) -> dict[str, object]:
        environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1]), tiers.VARIABLE: mode}
        command = [sys.executable, str(script), scene, quality]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        return dict(json.loads(done.stdout.splitlines()[-1]))

    one, quick = run("one"), run("quick")
    assert one["quick"] == 0
    assert quick["quick"] != 0
    assert one["frames"] == quick["frames"]
