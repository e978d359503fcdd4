"""Modules of a plan: compiled where they are missing, counted, and compiled again where the cache is damaged."""

from __future__ import annotations

import os
import pathlib
import shutil
import subprocess
import sys
import threading

import pytest

from warp_ar.engine import modules
from warp_ar.errors import UsageError

SCRIPT = """
import sys
import numpy as np
import warp as wp

wp.config.log_level = wp.LOG_ERROR
wp.init()

@wp.kernel(module="unique", enable_backward=False)
def double_kernel(values: wp.array[wp.float32]):
    i = wp.tid()
    values[i] = 2.0 * values[i]

from warp_ar.engine.modules import load_modules

heard = []
load_modules([double_kernel], wp.get_device("cpu"), lambda done, total: heard.append((done, total)))
values = wp.array(np.ones(3, np.float32), device="cpu")
wp.launch(double_kernel, dim=3, inputs=[values], device="cpu")
assert values.numpy().tolist() == [2.0] * 3
print(heard)
"""


def run(tmp_path: pathlib.Path, cache: pathlib.Path) -> str:
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    paths = os.pathsep.join(filter(None, (str(pathlib.Path.cwd()), os.environ.get("PYTHONPATH"))))
    environment = {**os.environ, "WARP_CACHE_PATH": str(cache), "PYTHONPATH": paths}
    done = subprocess.run([sys.executable, str(script)], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip().splitlines()[-1]


@pytest.mark.parametrize("damage", ["truncated", "empty", "noise", "folder", "file"])
def test_a_damaged_cache_is_compiled_again(tmp_path: pathlib.Path, damage: str) -> None:
    cache = tmp_path / "cache"
    assert run(tmp_path, cache) == "[(0, 1), (1, 1)]"
    assert run(tmp_path, cache) == "[]", "it is cached"
    (binary,) = cache.rglob("*.o")
    data = binary.read_bytes()
    binary.unlink()
    if damage == "folder":
        binary.mkdir()
    elif damage == "file":
        shutil.rmtree(binary.parent)
        binary.parent.write_bytes(data)
    else:
        binary.write_bytes({"truncated": data[: len(data) // 2], "empty": b"", "noise": bytes(range(256)) * 8}[damage])
    run(tmp_path, cache)
    assert run(tmp_path, cache) == "[]", "what was compiled again is kept"


def test_who_interrupts_compiling_does_not_wait_for_all_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Modules whose turn has not come are left out; what is at work ends."""
    compiled, interrupted = [], threading.Event()

    def compile_module(variant: int) -> None:
        assert variant == 0 or interrupted.wait(60.0)
        compiled.append(variant)

    def progress(done: int, total: int) -> None:
        if done:
            threading.Timer(0.2, interrupted.set).start()
            raise KeyboardInterrupt

    monkeypatch.setattr(modules, "_compile_one", compile_module)
    monkeypatch.setattr(modules, "usable_cores", lambda: 1)
    modules._compilers.cache_clear()
    with pytest.raises(KeyboardInterrupt):
        modules._compile(list(range(20)), progress)
    modules._compilers(os.getpid()).shutdown()
    modules._compilers.cache_clear()
    assert len(compiled) <= 2


def test_a_full_disk_of_the_cache_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def compile_module(variant: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(modules, "_compile_one", compile_module)
    with pytest.raises(UsageError, match=r"kernels cannot be written to .*No space left on device.*WARP_CACHE_PATH"):
        modules._compile([0], None)
