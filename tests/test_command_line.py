"""Common part of all commands: arguments, errors, signals."""

import json
import os
import pathlib
import signal
import subprocess
import sys
import threading

import cv2
import pytest

from warp_ar.begin import EXIT_INTERRUPTED, EXIT_TERMINATED
from warp_ar.command_line import Parser, Terminated, count, ended_by_signals, run_command
from warp_ar.errors import UsageError

pytestmark = pytest.mark.slow

FOUND = {**os.environ, "PYTHONPATH": str(pathlib.Path(__file__).parents[1])}
"""Environment in which the package is found from any folder."""


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
        (["scene", "--frames", "9" * 400], f"--frames {'9' * 400}: expected 1 or more, 2,147,483,647 at most"),
        (["scene", "--frames=-3000000000"], "--frames -3000000000: expected 1 or more, 2,147,483,647 at most"),
    ],
)
def test_arguments_that_would_mean_something_else_are_refused(words, line):
    """A path without a name would be the folder that one stands in: the frames of a shell's unset variable."""
    parser = Parser()
    parser.add_argument("scene")
    parser.add_argument("--output", type=pathlib.Path)
    parser.add_argument("--frames", type=count)
    with pytest.raises(UsageError) as told:
        parser.parse_args(words)
    assert str(told.value).startswith(line)
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


@pytest.mark.parametrize(("way", "kind"), [("page", "broken"), ("clip", "closed")])
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


@pytest.mark.parametrize(
    "error",
    [
        MemoryError("Unable to allocate 9 TiB"),
        RuntimeError("Failed to allocate 20889600 bytes on device 'cpu'"),
        cv2.error("OpenCV: error: (-4:Insufficient memory) Failed to allocate 921600 bytes"),
        OSError(12, "Cannot allocate memory"),
        RuntimeError("can't start new thread"),
    ],
)
def test_too_little_memory_is_told_in_one_line(capsys, error):
    def command():
        raise error

    assert run_command(command) == 1
    assert capsys.readouterr().err.startswith("warp_ar: there is not enough memory: ")


def test_another_error_of_a_library_is_no_lack_of_memory():
    def command():
        raise RuntimeError("a kernel has failed")

    with pytest.raises(RuntimeError, match="a kernel has failed"):
        run_command(command)


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


def test_a_command_that_does_not_unwind_ends_all_the_same():
    """A signal that comes as Python takes a lock may leave it taken: whoever waits for it would wait for ever."""
    text = """
import os, signal, sys, threading
from warp_ar import command_line

command_line._GRACE = 0.5
lock = threading.Lock()

def command():
    try:
        os.kill(os.getpid(), signal.SIGTERM)
        threading.Event().wait(20.0)
    finally:
        lock.acquire()
        lock.acquire()

sys.exit(command_line.run_command(command))
"""
    ended = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, timeout=60, env=FOUND)
    assert (ended.returncode, ended.stderr) == (EXIT_TERMINATED, "")


@pytest.mark.parametrize(("name", "error"), [("SIGTERM", Terminated), ("SIGINT", KeyboardInterrupt)])
def test_who_waits_for_another_thread_is_interrupted(name, error):
    never = threading.Event()
    sender = threading.Timer(0.1, lambda: signal.pthread_kill(threading.main_thread().ident, signal.Signals[name]))

    def wait() -> None:
        sender.start()  # not before the signal is handled
        never.wait(60.0)

    with pytest.raises(error), ended_by_signals():
        wait()
    sender.join()
