"""How commands begin: a signal ends them while they import, in one line at most, and slow imports are told."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading

import pytest

from warp_ar.__main__ import COMMANDS

pytestmark = [pytest.mark.slow, pytest.mark.skipif(os.name != "posix", reason="signals as on POSIX")]

FIRST = "warp_ar.begin"
"""The module that commands begin with."""


PATIENCE = 300.0
"""Seconds after which a command that goes on is killed."""


def ended_at(module: str, number: int, *words: str) -> tuple[int, list[str]]:
    """Exit code of ``python -m ...`` that gets a signal once it has imported this module, and what it said.

    Python's own report of imports tells when that is; the module after the first one comes after its handlers.
    """
    command = [sys.executable, "-X", "importtime", "-m", *words]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        late = threading.Timer(PATIENCE, process.kill)
        late.start()
        lines, seen, sent = [], False, False
        for line in process.stderr:
            if not line.startswith("import time:"):
                lines.append(line)
            elif seen and not sent:
                process.send_signal(number)
                sent = True
            elif line.split("|")[-1].strip() == module:
                seen = True
        late.cancel()
    assert sent
    return process.returncode, lines


@pytest.mark.parametrize("command", [*(f"warp_ar.{name}" for name in COMMANDS), "warp_ar"])
def test_an_interrupt_ends_every_command_as_it_begins(command):
    assert ended_at(FIRST, signal.SIGINT, command) == (130, [])


@pytest.mark.parametrize(
    ("module", "number", "code"),
    [
        ("numpy", signal.SIGINT, 130),
        ("warp_ar.kernels.launch", signal.SIGHUP, 143),
    ],
)
def test_a_signal_ends_a_command_within_any_import(module, number, code):
    assert ended_at(module, number, "warp_ar", "explain") == (code, [])


def test_who_is_started_in_the_background_goes_on():
    """A shell has what it starts with ``&`` ignore an interrupt that is meant for what is in front."""
    script = (
        "import os, signal, sys; signal.signal(signal.SIGINT, signal.SIG_IGN); os.execv(sys.executable, sys.argv[1:])"
    )
    words = [sys.executable, "-X", "importtime", "-m", "warp_ar.live", "--list"]
    with subprocess.Popen(
        [sys.executable, "-c", script, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr is not None
        assert process.stdout is not None
        for line in process.stderr:
            if line.endswith(" warp_ar.errors\n"):
                process.send_signal(signal.SIGINT)
        assert "desk" in process.stdout.read()
    assert process.returncode == 0


@pytest.mark.parametrize(("given", "expected"), [(None, "1"), ("3", "3")])
def test_commands_have_one_thread_of_blas_unless_told_otherwise(monkeypatch, given, expected):
    """Set before NumPy is imported, which reads it once."""
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    if given is not None:
        monkeypatch.setenv("OPENBLAS_NUM_THREADS", given)
    code = (
        "import os, sys, types\n"
        "sys.modules['a_command'] = types.SimpleNamespace(main=lambda: print(os.getenv('OPENBLAS_NUM_THREADS')) or 0)\n"
        "from warp_ar.begin import begin\n"
        "assert 'numpy' not in sys.modules\n"
        "begin('a_command')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == [expected]
