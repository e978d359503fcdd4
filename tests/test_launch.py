"""Launching: bands of rows, and blocks that work together from several threads."""

from __future__ import annotations

import importlib
import inspect
import itertools
import pkgutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import warp as wp

import warp_ar.kernels
from warp_ar.kernels.environment import irradiance
from warp_ar.kernels.launch import launch_rows, takes_few_blocks

ROWS = 13


@wp.kernel(enable_backward=False)
def count_rows_kernel(row_start: wp.int32, amount: wp.int32, counts_out: wp.array2d[wp.int32]):
    band_row, column = wp.tid()
    counts_out[row_start + band_row, column] += amount


@pytest.mark.parametrize("edges", [(0, ROWS), (0, 5, ROWS), (0, 0, 1, 12, ROWS)])
def test_bands_touch_each_row_once(device: str, edges: tuple[int, ...]) -> None:
    counts = wp.zeros((ROWS, 3), dtype=wp.int32, device=device)
    for band in itertools.pairwise(edges):
        launch_rows(count_rows_kernel, counts.shape, [2], [counts], rows=band, device=device)
    np.testing.assert_array_equal(counts.numpy(), 2)
    launch_rows(count_rows_kernel, counts.shape, [1], [counts], rows=None, device=device)
    np.testing.assert_array_equal(counts.numpy(), 3)


def test_layers_are_cleared_before_only_where_few_blocks_write_them(device: str) -> None:
    """At 640x480 a CUDA device has a thread for each pixel, at 1080p it has not."""
    assert not takes_few_blocks((480, 640), device)
    assert takes_few_blocks((1080, 1920), device) == (device != "cpu")


def test_tiles_from_several_threads() -> None:
    """Warp's CPU tiles share one unguarded arena: without the lock this crashes within a few dozen rounds."""
    environment = wp.array(np.random.default_rng(1).random((16, 32, 3), np.float32), dtype=wp.vec3, device="cpu")
    clusters = wp.zeros(8 * 16, dtype=irradiance.Cluster, device="cpu")
    irradiance.gather_clusters(environment, (8, 16), clusters)
    expected, actual = (wp.zeros((64, 64), dtype=wp.vec3, device="cpu") for _ in range(2))
    irradiance.sum_clusters(clusters, expected)
    with ThreadPoolExecutor(4) as pool:
        for _ in range(100):
            actual.zero_()
            list(
                pool.map(
                    lambda band: irradiance.sum_clusters(clusters, actual, rows=(band, band + 16)), range(0, 64, 16)
                )
            )
            np.testing.assert_array_equal(actual.numpy(), expected.numpy())


BESIDE = """
import faulthandler
import itertools
import threading
import numpy as np
import warp as wp
from warp_ar.device import start_warp
from warp_ar.kernels.environment import irradiance

faulthandler.enable()
start_warp()
environment = wp.array(np.random.default_rng(1).random((16, 32, 3), np.float32), dtype=wp.vec3, device="cpu")
clusters, others = (wp.zeros(8 * 16, dtype=irradiance.Cluster, device="cpu") for _ in range(2))
irradiance.gather_clusters(environment, (8, 16), clusters)
expected, actual = (wp.zeros((64, 64), dtype=wp.vec3, device="cpu") for _ in range(2))
irradiance.sum_clusters(clusters, expected)
done = threading.Event()

def gather():
    while not done.is_set():
        irradiance.gather_clusters(environment, (8, 16), others)

beside = threading.Thread(target=gather)
beside.start()
try:
    for _ in range(2000):
        actual.zero_()
        irradiance.sum_clusters(clusters, actual)
        np.testing.assert_array_equal(actual.numpy(), expected.numpy())
finally:
    done.set()
    beside.join()
"""


def test_tiles_beside_other_kernels() -> None:
    """Were both in one module, the other's launches would move the tiles: that crashes within a few hundred rounds."""
    done = subprocess.run([sys.executable, "-c", BESIDE], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_kernels_with_tiles_have_modules_of_their_own() -> None:
    found = []
    for module in pkgutil.walk_packages(warp_ar.kernels.__path__, "warp_ar.kernels."):
        for item in vars(importlib.import_module(module.name)).values():
            if isinstance(item, wp.Kernel) and "wp.tile" in inspect.getsource(item.func):
                found.append(item.key)
                assert list(item.module.kernels) == [item.key], f"{item.key}: declare it with tile_kernel"
    assert "sum_clusters_kernel" in found
