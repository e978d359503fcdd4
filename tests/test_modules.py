"""Compiling side by side: headers that are parsed once, what is left, kernels found in the cache untranslated."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import pytest
import warp as wp

from warp_ar.device import resolve_device
from warp_ar.engine import modules, scheduler
from warp_ar.engine.pipeline import Pipeline
from warp_ar.kernels.launch import QUICK_TO_COMPILE

SCRIPT = """
import pathlib, tempfile
import warp as wp
from warp_ar.device import resolve_device
from warp_ar.engine import modules

device = resolve_device("cpu")

@wp.kernel(module="unique", enable_backward=False)
def one_kernel(values_out: wp.array[wp.int32]):
    values_out[wp.tid()] = 1

@wp.kernel(module="unique", enable_backward=False)
def two_kernel(values_out: wp.array[wp.int32]):
    values_out[wp.tid()] = 2

def folders():
    return len(list(pathlib.Path(tempfile.gettempdir()).glob("wp_pch_*")))

said = []
modules.load_modules([one_kernel, two_kernel], wp.get_device("cpu"), lambda done, total: said.append((done, total)))
print(said, folders())

@wp.kernel(module="unique", enable_backward=False)
def three_kernel(values_out: wp.array[wp.int32]):
    values_out[wp.tid()] = 3

values = wp.zeros(4, dtype=wp.int32, device="cpu")
wp.launch(three_kernel, 4, [], [values], device="cpu")  # compiled by this thread, in Warp's own way
print(values.numpy().tolist(), folders())
"""


def test_what_warp_keeps_for_a_thread_goes_with_it(tmp_path: Path) -> None:
    """Parsed headers, some megabytes for each thread that compiled; Python's development mode finds none left."""
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    environment = {**os.environ, "WARP_CACHE_PATH": str(tmp_path / "cache"), "TMPDIR": str(temporary)}
    script = tmp_path / "script.py"  # Warp reads a kernel's text from its file
    script.write_text(SCRIPT)
    command = [sys.executable, "-X", "dev", "-W", "error::ResourceWarning", str(script)]
    environment["PYTHONPATH"] = str(Path(__file__).parents[1])
    run = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    lines = run.stdout.splitlines()
    assert lines[-2:] == ["[(0, 2), (1, 2), (2, 2)] 0", "[3, 3, 3, 3] 1"]
    assert "ResourceWarning" not in run.stderr, run.stderr
    assert list(temporary.glob("wp_pch_*")) == []
    (headers,) = (tmp_path / "cache").glob("**/headers_*")
    assert [path.suffix for path in headers.iterdir()] == [".pch"]


@wp.kernel(module="unique", enable_backward=False)
def usual_kernel(values_out: wp.array[wp.float32]):
    values_out[wp.tid()] = 1.0


@wp.kernel(module="unique", enable_backward=False, module_options=QUICK_TO_COMPILE)
def quick_kernel(values_out: wp.array[wp.float32]):
    values_out[wp.tid()] = 2.0


def test_headers_serve_flags_that_differ_in_those_of_llvm(monkeypatch, tmp_path) -> None:
    """The second kernel finds the headers of the first under the name that Warp looks for, and no third ones appear."""
    device = resolve_device("cpu")
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    kernels = [usual_kernel, quick_kernel]

    def names() -> set[str]:
        from warp._src.context import runtime

        return {path.name for path in Path(runtime.get_clang_pch_dir()).glob("*.pch")}

    def compile_both() -> list[set[str]]:
        headers = modules._Headers({modules._flags(kernel.module) for kernel in kernels})
        seen = []
        for kernel in kernels:
            with headers.shared(modules._flags(kernel.module)):
                seen.append(names())
                modules._load(kernel.module, device)
                seen.append(names())
        headers.close()
        return seen

    # With headers of its own, none, whatever this one has compiled before.
    with ThreadPoolExecutor(1) as thread:
        before, first, second, after = thread.submit(compile_both).result()
    assert (len(before), len(first), len(second)) == (0, 1, 2)
    assert after == second
    values = wp.zeros(1, dtype=wp.float32, device="cpu")
    wp.launch(quick_kernel, 1, outputs=[values], device="cpu")
    assert values.numpy() == 2.0


def test_flags_of_clang_part_headers(warp_flags) -> None:
    usual, quick = warp_flags, QUICK_TO_COMPILE["cpu_compiler_flags"]
    assert modules._clang_flags(usual) == modules._clang_flags(quick) == ["-march=native"]
    assert modules._clang_flags(modules._header_flags()) == ["-march=native"]
    assert modules._clang_flags("-mavx2 -mllvm=-x=1") == ["-mavx2"]


class _Listed(Exception):
    """The kernels of a plan are known."""


class _Module(SimpleNamespace):
    """Stands for one of Warp's; a key of dictionaries, as those are."""

    __hash__ = object.__hash__


def test_who_interrupts_compiling_does_not_wait_for_all_of_it(monkeypatch) -> None:
    """Kernels whose turn has not come are left out; what is at work ends."""
    compiled, interrupted = [], threading.Event()

    def compile_module(module, device):
        assert module.number == 0 or interrupted.wait(60.0)
        compiled.append(module.number)

    def progress(done, total):
        if done:
            threading.Timer(0.2, interrupted.set).start()
            raise KeyboardInterrupt

    monkeypatch.setattr(modules.wp, "compile_aot_module", compile_module)
    monkeypatch.setattr(modules, "usable_cores", lambda: 1)
    variants = [(_Module(number=number, name="", options={}), None) for number in range(20)]
    with pytest.raises(KeyboardInterrupt):
        modules._compile(variants, SimpleNamespace(is_cpu=False), progress)
    assert len(compiled) <= 2


@pytest.mark.parametrize("quality", ["low", "medium", "high"])
def test_no_kernel_is_translated_to_tell_whether_it_is_cached(monkeypatch, quality) -> None:
    """Warp would, at every start, for values of ``wp.static`` that hang on a loop's variable."""
    found: list[wp.Kernel] = []

    def listed(kernels, device, progress=None, **_):
        found.extend(kernels)
        raise _Listed

    monkeypatch.setattr(scheduler, "load_modules", listed)
    with Pipeline("desk", device="cpu", quality=quality) as pipeline, pytest.raises(_Listed):
        pipeline.warm_up()
    assert found
    assert [kernel.key for kernel in found if kernel.adj.has_unresolved_static_expressions] == []


AHEAD = """
import pathlib
import warp as wp
from warp_ar.device import resolve_device, usable_cores
from warp_ar.engine import modules

device = resolve_device("cpu")

@wp.kernel(module="unique", enable_backward=False)
def one_kernel(values_out: wp.array[wp.int32]):
    values_out[wp.tid()] = 1

def headers():
    found = list(pathlib.Path(wp.config.kernel_cache_dir).glob("headers_*/*.pch"))
    return [(path.name, path.stat().st_mtime_ns, path.stat().st_ino) for path in found]

print(len(headers()))
modules.parse_headers_ahead()
modules.parse_headers_ahead()  # one is under way
(thread,) = modules._AHEAD
thread.join()
kept = headers()
print(len(kept))
modules.load_modules([one_kernel], device)
print(headers() == kept, len(modules._AHEAD))
modules.parse_headers_ahead()  # they are there
print(len(modules._AHEAD))
"""


def test_headers_are_parsed_once_ahead_of_the_kernels(tmp_path: Path) -> None:
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    environment = {**os.environ, "WARP_CACHE_PATH": str(tmp_path / "cache"), "TMPDIR": str(temporary)}
    environment["PYTHONPATH"] = str(Path(__file__).parents[1])
    script = tmp_path / "script.py"
    script.write_text(AHEAD)
    command = [sys.executable, "-X", "dev", "-W", "error::ResourceWarning", str(script)]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert run.stdout.splitlines()[-4:] == ["0", "1", "True 0", "0"]
    assert "ResourceWarning" not in run.stderr, run.stderr
    assert list(temporary.iterdir()) == []


def test_modules_that_take_nvrtc_longest_begin_first() -> None:
    """By their names, which are those of their kernels' factories; the others keep their order."""
    folder = Path(modules.__file__).parents[1] / "kernels"
    factories = "".join(path.read_text(encoding="utf-8") for path in folder.glob("*.py"))
    for word in modules._LONGEST:
        assert f"def make_{word}" in factories, word
    names = ["composite", "shade_kernel", "fill", "mirror_ball", "bands", "near_field", "trace_secondary"]
    variants = [(SimpleNamespace(name=f"make_{name}__x"), None) for name in names]
    ordered = [module.name[5:-3] for module, _ in modules._longest_first(variants)]
    assert ordered == [*modules._LONGEST, "composite", "fill", "bands"]
