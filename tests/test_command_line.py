"""What commands share: the collector of garbage while things are loaded, and at the end."""

import gc
import json
import os
import pathlib
import signal
import subprocess
import sys
import threading
import time
import weakref

import pytest

from warp_ar.begin import EXIT_INTERRUPTED, EXIT_TERMINATED
from warp_ar.command_line import Parser, Terminated, ended_by_signals, loading, run_command
from warp_ar.errors import UsageError

FOUND = {**os.environ, "PYTHONPATH": str(pathlib.Path(__file__).parents[1])}
"""Environment in which the package is found from any folder."""


class Node:
    """Something that refers to itself: only the collector frees it."""

    def __init__(self):
        self.own = self


@pytest.mark.parametrize("was_on", [True, False])
def test_garbage_is_left_alone_until_all_is_loaded(was_on):
    before = gc.isenabled()
    try:
        gc.enable() if was_on else gc.disable()
        with loading() as loaded:
            assert not gc.isenabled()
            kept = weakref.ref(Node())
            loaded()
            assert gc.isenabled() == was_on
            gc.collect()
            assert kept() is not None, "what was loaded is looked through"
        gc.collect()
        assert kept() is None, "what was loaded is never freed"
        assert gc.isenabled() == was_on
    finally:
        gc.enable() if before else gc.disable()


def test_an_error_turns_the_collector_on_again():
    with pytest.raises(KeyError), loading():
        raise KeyError
    assert gc.isenabled()
    assert gc.get_freeze_count() == 0


def test_leaving_gives_the_code_and_runs_what_was_registered():
    script = "import atexit; from warp_ar.begin import leave; atexit.register(print, 'end'); leave(3)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (3, "end\n", "")


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["scene", "--output", ""], "--output is empty; give it a value, or leave it out"),
        (["scene", "--output="], "--output is empty; give it a value, or leave it out"),
        ([""], "an argument is empty; give it a value, or leave it out"),
        (["scene", "--frames", "9" * 400], "--frames: a number of 400 digits; expected 2,147,483,647 at most"),
        (["scene", "--frames=-3000000000"], "--frames: a number of 10 digits; expected 2,147,483,647 at most"),
    ],
)
def test_arguments_that_would_mean_something_else_are_refused(words, line):
    """A path without a name would be the folder that one stands in: the frames of a shell's unset variable."""
    parser = Parser()
    parser.add_argument("scene")
    parser.add_argument("--output", type=pathlib.Path)
    parser.add_argument("--frames", type=int)
    with pytest.raises(UsageError) as told:
        parser.parse_args(words)
    assert str(told.value) == line
    assert parser.parse_args(["scene", "--frames", "2147483647", "--output=a"]).frames == 2**31 - 1


PRINTS = "import sys; from warp_ar.live import main; sys.exit(main(['--list']))"


@pytest.mark.skipif(sys.platform != "linux", reason="pipes and /dev/full as on Linux")
def test_output_that_nobody_reads_or_that_does_not_fit_is_no_traceback():
    with open("/dev/full", "wb") as full:
        done = subprocess.run(
            [sys.executable, "-c", PRINTS], stdout=full, stderr=subprocess.PIPE, text=True, timeout=60
        )
    assert done.returncode == 1
    assert done.stderr == "warp_ar: what this command prints cannot be written: No space left on device\n"
    reader, writer = os.pipe()
    os.close(reader)
    try:
        done = subprocess.run(
            [sys.executable, "-c", PRINTS], stdout=writer, stderr=subprocess.PIPE, text=True, timeout=60
        )
    finally:
        os.close(writer)
    assert (done.returncode, done.stderr) == (141, "")


@pytest.mark.parametrize("kind", ["closed", "broken"])
@pytest.mark.parametrize("way", ["page", "clip"])
def test_nobody_has_to_listen_to_what_is_said(way, kind, tmp_path):
    """Frames are lit whether or not somebody reads the standard error; nothing of it comes into a file."""
    report = tmp_path / "report.json"
    options = ["--headless", "--report", report] if way == "clip" else ["--port", "0", "--no-browser"]
    command = [sys.executable, "-m", "warp_ar.live", "desk", "--frames", "2", "--device", "cpu", "--quality", "paper"]
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run(
        [*command, *options],
        stdout=subprocess.PIPE,
        stderr=write,
        preexec_fn=(lambda: os.close(2)) if kind == "closed" else None,
        check=False,
    )
    os.close(write)
    assert done.returncode == 0
    if way == "clip":
        assert len(json.loads(report.read_text())["frames"]) == 2
    else:
        assert b"is at http" in done.stdout


def test_a_folder_that_was_deleted_is_told_in_one_line(tmp_path):
    gone = tmp_path / "gone"
    gone.mkdir()
    script = "import os, sys; os.rmdir(os.getcwd()); from warp_ar.init import main; sys.exit(main(['desk']))"
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=gone, env=FOUND, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (2, "warp_ar: the current folder is gone; run this in another one\n")


def test_too_little_memory_is_told_in_one_line(capsys):
    def command():
        raise MemoryError("Unable to allocate 9 TiB")

    assert run_command(command) == 1
    assert capsys.readouterr().err == "warp_ar: there is not enough memory: Unable to allocate 9 TiB\n"


def test_letters_that_a_terminal_does_not_know_are_numbers():
    script = "from warp_ar.command_line import run_command\nrun_command(lambda: print('\\u2026\\u4e2d') or 0)\n"
    plain = {**os.environ, "PYTHONIOENCODING": "ascii:strict", "PYTHONUTF8": "0", "LC_ALL": "C"}
    done = subprocess.run([sys.executable, "-c", script], env=plain, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (0, "\\u2026\\u4e2d\n", "")


@pytest.mark.skipif(os.name != "posix", reason="Windows ends a process that is sent SIGTERM")
@pytest.mark.parametrize(("name", "code"), [("SIGTERM", EXIT_TERMINATED), ("SIGINT", EXIT_INTERRUPTED)])
def test_a_signal_that_arrives_as_native_code_calls_back_ends_the_command(name, code):
    """Python drops what is raised there."""
    text = f"""
import ctypes, signal, sys, time
from warp_ar.command_line import run_command

def command():
    ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(signal.{name}))()
    time.sleep(20.0)
    return 0

sys.exit(run_command(command))
"""
    ended = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, timeout=60)
    assert (ended.returncode, ended.stderr) == (code, "")


class SlowLock:
    """A lock during one of whose steps a signal comes."""

    def __init__(self, step, number):
        self._lock, self._steps, self._number = threading.Lock(), [step], number

    def _pass(self, step):
        if self._steps == [step]:
            self._steps.clear()
            signal.raise_signal(self._number)

    def acquire(self, *how):
        self._pass("to take")
        got = self._lock.acquire(*how)
        self._pass("taken")
        return got

    def release(self):
        self._pass("to give back")
        self._lock.release()
        self._pass("given back")

    def __enter__(self):
        return self.acquire()

    def __exit__(self, *_):
        self.release()

    def locked(self):
        return self._lock.locked()


@pytest.mark.parametrize("where", ["at the first step", "while waiting"])
@pytest.mark.parametrize("step", ["to take", "taken", "to give back", "given back"])
@pytest.mark.parametrize(("name", "error"), [("SIGTERM", Terminated), ("SIGINT", KeyboardInterrupt)])
def test_a_signal_leaves_no_lock_taken(name, error, step, where):
    """Futures, events and queues take locks in Python: an exception in there would have others wait for ever."""
    lock = SlowLock(step if where == "at the first step" else "", signal.Signals[name])
    condition = threading.Condition(lock)

    def wait():
        with condition:
            if where == "while waiting":
                lock._steps = [step]
            condition.wait(0.001)
        time.sleep(10.0)

    with pytest.raises(error), ended_by_signals():
        wait()
    assert not lock.locked()


@pytest.mark.parametrize(("name", "error"), [("SIGTERM", Terminated), ("SIGINT", KeyboardInterrupt)])
def test_who_waits_for_another_thread_is_interrupted(name, error):
    never, begun = threading.Event(), time.monotonic()
    sender = threading.Timer(0.1, lambda: signal.pthread_kill(threading.main_thread().ident, signal.Signals[name]))
    sender.start()
    with pytest.raises(error), ended_by_signals():
        never.wait(20.0)
    sender.join()
    assert time.monotonic() - begun < 20.0
