"""Keeping threads off a device while another one needs it for itself."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest

from warp_ar import device
from warp_ar.device import exclusive


def held_by_another(device: SimpleNamespace, patience: float) -> bool:
    """Whether another thread cannot enter within so many seconds while this one is inside."""
    entered = threading.Event()

    def enter() -> None:
        with exclusive(device):
            entered.set()

    with exclusive(device), exclusive(device):  # twice: a pipeline that builds a scheduler enters again
        thread = threading.Thread(target=enter)
        thread.start()
        held = not entered.wait(patience)
    thread.join()
    assert entered.is_set()
    return held


def test_one_thread_at_a_time_on_cuda_and_all_on_cpu() -> None:
    assert held_by_another(SimpleNamespace(is_cuda=True), 0.2)
    assert not held_by_another(SimpleNamespace(is_cuda=False), 60.0)


class _Event:
    """An event of a CUDA device that comes to pass at some look, or never."""

    def __init__(self, looks: int | None) -> None:
        self.looks, self.asked, self.captured = looks, 0, 0

    @property
    def is_complete(self) -> bool:
        self.captured += device._CAPTURES.holders < 0
        self.asked += 1
        return self.looks is not None and self.asked > self.looks


def test_nobody_looks_at_an_event_while_a_graph_is_captured() -> None:
    event, capturing, may_end = _Event(0), threading.Event(), threading.Event()

    def capture() -> None:
        with device.capturing():
            capturing.set()
            assert may_end.wait(60.0)

    thread = threading.Thread(target=capture)
    thread.start()
    assert capturing.wait(60.0)
    waiting = threading.Thread(target=device.wait_for, args=(event,))
    waiting.start()
    waiting.join(0.1)
    assert waiting.is_alive()
    assert event.asked == 0
    may_end.set()
    for one in (thread, waiting):
        one.join(60.0)
        assert not one.is_alive()
    assert (event.asked, event.captured) == (1, 0)


START = """
import warp as wp
from warp_ar.device import resolve_device

@wp.kernel(enable_backward=False)
def one_kernel(values_out: wp.array[wp.int32]):
    values_out[wp.tid()] = 1

values = wp.zeros(2, dtype=wp.int32, device=resolve_device("cpu"))
wp.launch(one_kernel, 2, [], [values], device="cpu")
print(values.numpy().tolist(), wp.config.kernel_cache_dir)
"""


@pytest.mark.slow
@pytest.mark.parametrize("variable", ["WARP_CACHE_PATH", "empty"])
def test_a_cache_that_cannot_be_written_is_a_temporary_folder_and_one_line(tmp_path: Path, variable: str) -> None:
    script, file = tmp_path / "script.py", tmp_path / "file"
    script.write_text(START)
    file.write_text("no folder")
    environment = {name: value for name, value in os.environ.items() if "CACHE" not in name}
    environment["PYTHONPATH"] = str(Path(__file__).parents[1])
    environment["HOME"] = str(tmp_path / "home")
    environment["WARP_CACHE_PATH" if variable == "empty" else variable] = "" if variable == "empty" else str(file)
    command = [sys.executable, str(script)]
    run = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    values, folder = run.stdout.strip().rsplit(" ", 1)
    assert values == "[1, 1]"
    if variable == "empty":
        assert run.stderr == ""
        assert folder.startswith(environment["HOME"])
        assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "home", "script.py"]
    else:
        (line,) = run.stderr.splitlines()
        assert line.startswith("warp_ar: the cache of kernels cannot be written")
        assert not Path(folder).exists(), "it goes with the run"
