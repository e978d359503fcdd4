"""Fixtures shared by every test: devices and data that may be absent."""

from __future__ import annotations

import gc
import os
import pathlib
import signal
from collections.abc import Iterator
from typing import Any

import hypothesis
import pytest
import warp as wp

from warp_ar.device import CPU_COMPILER_FLAGS, usable_cores

wp.config.log_level = wp.LOG_WARNING
# Kernels that a test launches by itself are then the same as those of pipelines and commands: compiled once.
wp.config.cpu_compiler_flags = CPU_COMPILER_FLAGS

MOST_PROCESSES = 4
"""Processes that a run of a folder is spread over at most: each takes 1 to 3 GB."""

# Every run tries the same few examples; ``--hypothesis-profile deep`` searches for new ones.
_PROFILE = {"deadline": None, "database": None, "suppress_health_check": list(hypothesis.HealthCheck)}
hypothesis.settings.register_profile("ci", derandomize=True, max_examples=15, **_PROFILE)
hypothesis.settings.register_profile("deep", max_examples=2000, **_PROFILE)
hypothesis.settings.load_profile("ci")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Options of this suite."""
    parser.addoption("--update-golden", action="store_true", help="write the golden frames anew instead of comparing")
    parser.addoption("--all", action="store_true", help="tests marked slow as well, which a folder's run leaves out")
    parser.addoption("--slow", action="store_true", help="the tests marked slow alone: what a plain run left out")
    parser.addoption("--long", action="store_true", help="hard cases at full length: millions of rays, 10,000 frames")
    parser.addoption("--atlas", type=pathlib.Path, metavar="FILE", help="write what covers which hard case, as JSON")


def pytest_configure(config: pytest.Config) -> None:
    """Name the marker by which tests say what they cover; heed interrupts wherever the suite was started from.

    A shell has what it starts in the background ignore them, and commands that tests start would inherit that.
    """
    for number in (signal.SIGINT, getattr(signal, "SIGHUP", signal.SIGINT)):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    config.addinivalue_line("markers", "slow: left out of runs of whole folders without --all")
    config.addinivalue_line("markers", "atlas(row, stage, method): hard case that a test covers; see hard_cases")


def pytest_unconfigure(config: pytest.Config) -> None:
    """Let Python's end free all objects, where a command that a test has run froze what was loaded."""
    gc.unfreeze()


@pytest.hookimpl(tryfirst=True)
def pytest_cmdline_main(config: pytest.Config) -> None:
    """Run a folder of tests in one process per core.

    Single files and tests stay in this process, where starting others would take longer than they save, and a debugger
    works; so does everything where there is a GPU, which the processes would share. ``-n`` says otherwise.
    """
    option = config.option
    if not config.pluginmanager.hasplugin("xdist") or option.numprocesses is not None or option.dist != "no":
        return
    if hasattr(config, "workerinput") or option.usepdb or option.capture == "no" or option.collectonly:
        return
    if len(_devices()) > 1 or not all(pathlib.Path(argument).is_dir() for argument in config.args):
        return
    processes = min(MOST_PROCESSES, usable_cores())
    if processes > 1:
        # Tests differ in length by a factor of a thousand: whoever is done takes from the others.
        option.numprocesses, option.dist = processes, "worksteal"
        # The processes inherit it: on cores that are all busy, its threads take a fifth more and bring nothing.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Note in every report which hard cases a test covers; leave slow tests out of runs of whole folders."""
    from tests.hard_cases import atlas

    items.sort(key=_turn)
    for item in items:
        item.user_properties += [("atlas", "/".join(map(str, cell))) for cell in atlas.cells_of(item)]
    atlas.collected[:] = items
    # Every process of a run that is spread has collected the same.
    if config.getoption("--atlas") and getattr(config, "workerinput", {}).get("workerid", "gw0") == "gw0":
        atlas.write_collection(items, config.getoption("--atlas"))
    if config.getoption("--slow"):
        _deselect(config, items, [item for item in items if item.get_closest_marker("slow") is None])
    elif _is_plain(config):
        _deselect(config, items, [item for item in items if item.get_closest_marker("slow") is not None])


def _turn(item: Any) -> int:
    """Return the place of a test's kind in the order of tests.

    Golden frames compile what the hard cases need, too: of two processes the second one begins with other tests. Those
    in Chromium are the longest: they come when kernels are compiled, and none is left for the end.
    """
    kinds = item.path.stem == "test_golden", item.path.parent.name == "hard_cases", "browser" in item.fixturenames
    return (*kinds, True).index(True)


def _deselect(config: pytest.Config, items: list[pytest.Item], left_out: list[pytest.Item]) -> None:
    config.hook.pytest_deselected(items=left_out)
    gone = set(left_out)
    items[:] = [item for item in items if item not in gone]


def _is_plain(config: pytest.Config) -> bool:
    """Return True for a run of whole folders that asks for no slow tests."""
    asked = config.getoption("--all") or config.getoption("--slow")
    return not asked and all(pathlib.Path(argument).is_dir() for argument in config.args)


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Say what a plain run left out."""
    if _is_plain(config):
        terminalreporter.write_line("Tests marked slow were left out: --all runs everything, --slow these alone.")


def _devices() -> list[str]:
    wp.init()
    return ["cpu", *(str(device) for device in wp.get_cuda_devices()[:1])]


@pytest.fixture(params=_devices())
def device(request: pytest.FixtureRequest) -> Iterator[str]:
    """Run the test on the CPU and, where there is one, on the first CUDA device."""
    with wp.ScopedDevice(request.param):
        yield request.param


@pytest.fixture(scope="session")
def shared() -> pathlib.Path:
    """Folder of photographs, path-traced truth and environments; tests that need it skip where it is absent."""
    root = pathlib.Path(__file__).resolve().parents[1]
    folder = pathlib.Path(os.environ.get("WARP_AR_SHARED", root.parent / "shared"))
    if not (folder / "truth").is_dir():
        pytest.skip(f"needs the shared measurement data, expected at {folder} (set WARP_AR_SHARED to its folder)")
    return folder
