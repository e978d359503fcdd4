"""In how many processes tests run: folders in one per core, all else in this one."""

from __future__ import annotations

import types

import pytest

from tests import conftest

HERE = "tests"
SPREAD, ALONE = (3, "worksteal"), (None, "no")
FREE = {"numprocesses": None, "dist": "no", "usepdb": False, "capture": "fd", "collectonly": False}


@pytest.mark.parametrize(
    ("arguments", "options", "expected"),
    [
        ([HERE], {}, SPREAD),
        ([HERE, f"{HERE}/hard_cases"], {}, SPREAD),
        ([f"{HERE}/test_processes.py"], {}, ALONE),
        ([HERE, f"{HERE}/test_processes.py::test_folders_alone_are_spread"], {}, ALONE),
        ([HERE], {"numprocesses": 0}, (0, "no")),
        ([HERE], {"numprocesses": 2}, (2, "no")),
        ([HERE], {"usepdb": True}, ALONE),
        ([HERE], {"capture": "no"}, ALONE),
        ([HERE], {"collectonly": True}, ALONE),
    ],
)
def test_folders_alone_are_spread(monkeypatch, pytestconfig, arguments, options, expected):
    monkeypatch.chdir(pytestconfig.rootpath)
    monkeypatch.setattr(conftest, "usable_cores", lambda: 3)
    monkeypatch.setattr(conftest, "_devices", lambda: ["cpu"])
    assert asked(monkeypatch, arguments, options) == expected


@pytest.mark.parametrize(
    ("cores", "devices", "expected"),
    [
        (1, ["cpu"], ALONE),
        (2, ["cpu"], (2, "worksteal")),
        (64, ["cpu"], (conftest.MOST_PROCESSES, "worksteal")),
        (64, ["cpu", "cuda:0"], ALONE),
    ],
)
def test_neither_one_core_nor_a_gpu_is_shared(monkeypatch, pytestconfig, cores, devices, expected):
    monkeypatch.chdir(pytestconfig.rootpath)
    monkeypatch.setattr(conftest, "usable_cores", lambda: cores)
    monkeypatch.setattr(conftest, "_devices", lambda: devices)
    assert asked(monkeypatch, [HERE], {}) == expected


def asked(monkeypatch, arguments, options):
    """Number of processes that a run with these arguments is spread over, None where it is not, and how."""
    option = types.SimpleNamespace(**{**FREE, **options})
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "1")
    plugins = types.SimpleNamespace(hasplugin=lambda name: name == "xdist")
    conftest.pytest_cmdline_main(types.SimpleNamespace(option=option, args=arguments, pluginmanager=plugins))
    return option.numprocesses, option.dist
