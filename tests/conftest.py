"""Fixtures shared by every test: devices and data that may be absent."""

from __future__ import annotations

import os
import pathlib
from collections.abc import Iterator

import pytest
import warp as wp

wp.config.log_level = wp.LOG_WARNING


def pytest_addoption(parser: pytest.Parser) -> None:
    """Options of this suite."""
    parser.addoption("--update-golden", action="store_true", help="write the golden frames anew instead of comparing")


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
