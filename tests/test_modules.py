"""Compiling side by side, and what it leaves."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

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
