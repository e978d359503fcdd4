"""What commands share: the collector of garbage while things are loaded, and at the end."""

import gc
import subprocess
import sys
import weakref

import pytest

from warp_ar.command_line import loading


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
    script = "import atexit; from warp_ar.command_line import leave; atexit.register(print, 'end'); leave(3)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (3, "end\n", "")
