"""CUDA modules that processes beside this one compile: the same binaries, and this process where they fail."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import warp as wp

from warp_ar.device import start_warp
from warp_ar.engine import nvrtc, nvrtc_process
from warp_ar.errors import UsageError

ARCH = 90

start_warp()
needs_nvrtc = pytest.mark.skipif(wp._src.context.runtime.toolkit_version is None, reason="Warp without CUDA")


@wp.kernel(module="unique", enable_backward=False)
def first_kernel(values_out: wp.array[wp.float32]):
    values_out[wp.tid()] = wp.sin(wp.float32(wp.tid())) * 3.0 + 1.0


@wp.kernel(module="unique", enable_backward=False)
def second_kernel(values_out: wp.array[wp.float32]):
    values_out[wp.tid()] = wp.exp(wp.float32(wp.tid()))


@pytest.fixture
def source(tmp_path) -> Path:
    """What Warp translates a kernel to."""
    folder = tmp_path / "translated"
    wp.compile_aot_module(first_kernel.module, arch=ARCH, module_dir=str(folder), use_ptx=False)
    (found,) = folder.rglob("*.cu")
    return found


def in_thread(work) -> None:
    """What a thread of its own does, and what it raises."""
    with ThreadPoolExecutor(1) as pool:
        pool.submit(work).result()


def built(folder: Path, compilers: nvrtc.Compilers, source: Path, name: str) -> bytes:
    def work() -> None:
        with compilers.used():
            wp._src.build.build_cuda(str(source), ARCH, str(folder / name), pch_dir=None)

    in_thread(work)
    return (folder / name).read_bytes()


def use_up_threads_of_this_process(compilers: nvrtc.Compilers) -> None:
    """The next thread has a process."""
    for _ in range(nvrtc.HERE):
        in_thread(lambda: compilers.used().__enter__())


@pytest.fixture(autouse=True)
def warp_builds_again(monkeypatch):
    """Each test has Warp's own function, and leaves it."""
    monkeypatch.setattr(wp._src.build, "build_cuda", wp._src.build.build_cuda)


@needs_nvrtc
def test_binaries_are_the_same_to_the_byte(tmp_path, source, monkeypatch) -> None:
    """The first threads compile here, the next has a process."""
    here = []
    build = wp._src.build.build_cuda

    def note(*given, **options) -> None:
        here.append(threading.get_ident())
        build(*given, **options)

    monkeypatch.setattr(wp._src.build, "build_cuda", note)
    compilers = nvrtc.Compilers(1)
    try:
        own = [built(tmp_path, compilers, source, f"own_{number}.cubin") for number in range(nvrtc.HERE)]
        assert len(here) == nvrtc.HERE
        assert not compilers._processes
        other = built(tmp_path, compilers, source, "other.cubin")
        assert len(here) == nvrtc.HERE
        (process,) = compilers._processes
        last = built(tmp_path, compilers, source, "last.cubin")  # there is no process for it
        assert len(here) == nvrtc.HERE + 1
    finally:
        compilers.close()
    assert {*own, other, last} == {other}
    assert process.returncode is not None


@needs_nvrtc
def test_where_a_process_ends_or_fails_this_one_compiles(tmp_path, source, monkeypatch) -> None:
    whole = nvrtc.Compilers(1)
    expected = built(tmp_path, whole, source, "expected.cubin")
    whole.close()
    compilers = nvrtc.Compilers(1)
    use_up_threads_of_this_process(compilers)

    def work() -> None:
        with compilers.used():
            nvrtc._THREAD.process.kill()
            nvrtc._THREAD.process.wait()
            wp._src.build.build_cuda(str(source), ARCH, str(tmp_path / "own.cubin"), pch_dir=None)

    try:
        in_thread(work)
    finally:
        compilers.close()
    assert (tmp_path / "own.cubin").read_bytes() == expected


@needs_nvrtc
def test_what_is_closed_compiles_no_further(tmp_path, source) -> None:
    """A thread that is left when a command is interrupted does not go on by itself."""
    compilers = nvrtc.Compilers(1)
    use_up_threads_of_this_process(compilers)

    def work() -> None:
        with compilers.used():
            compilers.close()
            wp._src.build.build_cuda(str(source), ARCH, str(tmp_path / "none.cubin"), pch_dir=None)

    with pytest.raises(RuntimeError, match="interrupted"):
        in_thread(work)
    assert not (tmp_path / "none.cubin").exists()


@needs_nvrtc
def test_a_process_answers_each_job_and_ends_with_its_input(tmp_path, source) -> None:
    wrong = tmp_path / "wrong.cu"
    wrong.write_text("this is no program", encoding="utf-8")
    jobs = [
        {"source": str(path), "arch": ARCH, "target": str(tmp_path / f"{number}.cubin"), "options": {}}
        for number, path in enumerate((wrong, source))
    ]
    command = [sys.executable, str(nvrtc_process.__file__)]
    with subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env={**os.environ, "CUDA_VISIBLE_DEVICES": ""},
    ) as process:
        answers = []
        for job in jobs:
            process.stdin.write(json.dumps(job) + "\n")
            process.stdin.flush()
            answers.append(process.stdout.readline())
        process.stdin.close()
        assert process.wait(60.0) == 0
    assert answers == ["0\n", "1\n"]
    assert not (tmp_path / "0.cubin").exists()
    assert (tmp_path / "1.cubin").is_file()


def test_a_library_starts_no_processes(monkeypatch) -> None:
    monkeypatch.delenv(nvrtc.VARIABLE, raising=False)
    monkeypatch.setattr(nvrtc, "_ENABLED", threading.Event())
    assert nvrtc.count_processes(40, 16) == 0
    nvrtc.compile_beside()
    # Two threads compile here; no more at once than there are cores or modules.
    assert nvrtc.count_processes(40, 16) == 14
    assert nvrtc.count_processes(40, 64) == nvrtc.MOST
    assert nvrtc.count_processes(40, 1) == 0
    # What one more scene needs is compiled sooner by threads.
    assert nvrtc.count_processes(nvrtc.LEAST, 64) > 0
    assert nvrtc.count_processes(nvrtc.LEAST - 1, 64) == 0
    monkeypatch.setenv(nvrtc.VARIABLE, "14")
    assert nvrtc.count_processes(3, 16) == 1
    assert nvrtc.count_processes(2, 16) == 0
    assert nvrtc.count_processes(1, 16) == 0
    monkeypatch.setenv(nvrtc.VARIABLE, "0")
    assert nvrtc.count_processes(40, 16) == 0
    monkeypatch.setenv(nvrtc.VARIABLE, "-1")
    with pytest.raises(UsageError, match="expected a number"):
        nvrtc.count_processes(40, 16)
