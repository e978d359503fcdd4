"""Modules of a plan: compiled where they are missing, counted, and compiled again where the cache is damaged."""

from __future__ import annotations

import importlib
import inspect
import itertools
import os
import pathlib
import pkgutil
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import warp as wp

import warp_ar.kernels
from warp_ar.engine import modules
from warp_ar.engine.pipeline import Pipeline
from warp_ar.errors import UsageError
from warp_ar.kernels.environment import irradiance
from warp_ar.scene import load_scene
from warp_ar.sources.sources import open_source
from warp_ar.stages.shared import lighting

pytestmark = pytest.mark.slow

SCRIPT = """
import sys
import numpy as np
import warp as wp

wp.config.log_level = wp.LOG_ERROR
wp.init()

@wp.kernel(module="unique", enable_backward=False)
def double_kernel(values: wp.array[wp.float32]):
    i = wp.tid()
    values[i] = 2.0 * values[i]

from warp_ar.engine.modules import load_modules

heard = []
load_modules([double_kernel], wp.get_device("cpu"), lambda done, total: heard.append((done, total)))
values = wp.array(np.ones(3, np.float32), device="cpu")
wp.launch(double_kernel, dim=3, inputs=[values], device="cpu")
assert values.numpy().tolist() == [2.0] * 3
print(heard)
"""


def run(tmp_path: pathlib.Path, cache: pathlib.Path) -> str:
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    paths = os.pathsep.join(filter(None, (str(pathlib.Path.cwd()), os.environ.get("PYTHONPATH"))))
    environment = {**os.environ, "WARP_CACHE_PATH": str(cache), "PYTHONPATH": paths}
    done = subprocess.run([sys.executable, str(script)], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip().splitlines()[-1]


def test_a_damaged_cache_is_compiled_again(tmp_path: pathlib.Path) -> None:
    """A file that was cut off, and a folder in its place; what was compiled again is kept."""
    cache = tmp_path / "cache"
    assert run(tmp_path, cache) == "[(0, 1), (1, 1)]"
    (binary,) = cache.rglob("*.o")
    data = binary.read_bytes()
    binary.write_bytes(data[: len(data) // 2])
    run(tmp_path, cache)
    assert binary.stat().st_size == len(data)
    binary.unlink()
    binary.mkdir()
    run(tmp_path, cache)
    assert binary.stat().st_size == len(data)
    assert run(tmp_path, cache) == "[]", "it is cached"


def test_who_interrupts_compiling_does_not_wait_for_all_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Modules whose turn has not come are left out; what is at work ends."""
    compiled, interrupted = [], threading.Event()

    def compile_module(variant: int) -> None:
        assert variant == 0 or interrupted.wait(60.0)
        compiled.append(variant)

    def progress(done: int, total: int) -> None:
        if done:
            threading.Timer(0.2, interrupted.set).start()
            raise KeyboardInterrupt

    monkeypatch.setattr(modules, "_compile_one", compile_module)
    monkeypatch.setattr(modules, "usable_cores", lambda: 1)
    modules._compilers.cache_clear()
    with pytest.raises(KeyboardInterrupt):
        modules._compile(list(range(20)), progress)
    modules._compilers(os.getpid()).shutdown()
    modules._compilers.cache_clear()
    assert len(compiled) <= 2


def test_a_full_disk_of_the_cache_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def compile_module(variant: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(modules, "_compile_one", compile_module)
    with pytest.raises(UsageError, match=r"kernels cannot be written to .*No space left on device.*WARP_CACHE_PATH"):
        modules._compile([0], None)


# --- Launching: bands of rows, and blocks that work together from several threads -------------------------------------


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


def test_kernels_with_tiles_have_modules_of_their_own() -> None:
    found = []
    for module in pkgutil.walk_packages(warp_ar.kernels.__path__, "warp_ar.kernels."):
        for item in vars(importlib.import_module(module.name)).values():
            if isinstance(item, wp.Kernel) and "wp.tile" in inspect.getsource(item.func):
                found.append(item.key)
                assert list(item.module.kernels) == [item.key], f"{item.key}: declare it with tile_kernel"
    assert "sum_clusters_kernel" in found


# --- Kernels that any scene shares give the pictures of those that are made for one -----------------------------------


@pytest.mark.parametrize(("name", "quality"), [("wire_coincident", "low")])
def test_a_shared_kernel_gives_the_same_picture(monkeypatch: pytest.MonkeyPatch, name: str, quality: str) -> None:
    """In all bits: what a scene lacks adds zeros and multiplies by one."""
    scene = load_scene(name)
    with open_source(scene.source.path) as source:
        images = [frame.image.copy() for frame in itertools.islice(source, 3)]
    lit = []
    for shared in (True, False):
        monkeypatch.setattr(lighting, "shares_kernels", lambda device, shared=shared: shared)
        with Pipeline(scene, device="cpu", quality=quality, estimates="synchronous") as pipeline:
            lit.append([pipeline(image, time_seconds=k / 24.0).image for k, image in enumerate(images)])
    np.testing.assert_array_equal(lit[0], lit[1])
    assert any((shown != image).any() for shown, image in zip(lit[0], images, strict=True)), "nothing was lit"
