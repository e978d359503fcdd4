"""Parallel compiling and loading of a plan's modules, with progress.

Warp translates Python to C++ in one thread at a time. Its compilers, Clang and NVRTC, run in parallel with each other
and with the translation.
"""

from __future__ import annotations

import contextlib
import functools
import os
import shutil
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import warp as wp

from warp_ar.device import compiling, exclusive, usable_cores
from warp_ar.errors import UsageError

Progress = Callable[[int, int], None]
"""Function to which the number of compiled modules, first 0, and the number of all modules to compile are passed. It is
not called if there are none."""

_Variant = tuple[Any, str, int | None]
"""Module, name of its device, and block size; None means the usual size."""


def load_modules(
    kernels: Iterable[wp.Kernel],
    device: Any,
    progress: Progress | None = None,
    *,
    blocks: Iterable[tuple[wp.Kernel, int]] = (),
) -> None:
    """Compile the modules of ``kernels`` where they are not in the cache, and load them.

    Args:
        kernels: Kernels of a plan, in the order of its stages.
        device: Warp device.
        progress: Function that is called on this thread after each compiled module.
        blocks: Kernels that CUDA runs with another block size than their module's, each with that size.
    """
    found: dict[_Variant, None] = dict.fromkeys((kernel.module, str(device), None) for kernel in kernels)
    found |= dict.fromkeys((kernel.module, str(device), size) for kernel, size in blocks)
    with compiling():
        missing = [variant for variant in found if not _is_cached(variant)]
        if missing:
            # The last stages take longest to compile. If they were started last, all but one core would wait for them.
            _compile(missing[::-1], progress)
        for variant in found:
            _load(variant)


def _compile(variants: list[_Variant], progress: Progress | None) -> None:
    """Compile modules into the cache, in as many threads as there are cores.

    Raises:
        UsageError: The cache cannot be written.
    """
    if progress is not None:
        progress(0, len(variants))
    pool = _compilers(os.getpid())
    jobs = [pool.submit(_compile_one, variant) for variant in variants]
    try:
        for done, job in enumerate(as_completed(jobs), 1):
            try:
                job.result()
            except OSError as error:
                folder = wp.config.kernel_cache_dir
                raise UsageError(
                    f"kernels cannot be written to {folder} ({error.strerror or error}): free space there, or set "
                    "WARP_CACHE_PATH to another folder"
                ) from error
            if progress is not None:
                progress(done, len(variants))
    finally:
        for job in jobs:
            job.cancel()  # after an interrupt, jobs that have not begun are not waited for


@functools.cache
def _compilers(process: int) -> ThreadPoolExecutor:
    """Return this process's compiling threads; they are kept because each parses Warp's headers for over a second."""
    return ThreadPoolExecutor(usable_cores(), "warp_ar-compile")


def _compile_one(variant: _Variant) -> None:
    module, device, size = variant
    if device != "cpu" and size is None:
        wp.compile_aot_module(module, device=device)  # does not need the device's lock, so other pipelines can run
    else:
        _load(variant)


def _load(variant: _Variant) -> None:
    """Load a module; if its cached file is damaged, compile it again."""
    module, device, size = variant
    with exclusive(wp.get_device(device)):
        try:
            wp.load_module(module, device=device, block_dim=size)
        except Exception:
            # Warp passes on the loader's error, of any class, if the file is truncated, empty or of random bytes.
            if not _folder_of(variant).exists():
                raise
            folder = _folder_of(variant)
            shutil.rmtree(folder, ignore_errors=True)
            with contextlib.suppress(OSError):
                folder.unlink()  # removes a file in the folder's place
            if folder.exists():
                raise
            wp.load_module(module, device=device, block_dim=size)


def _folder_of(variant: _Variant) -> Path:
    """Return the folder of Warp's cache for the compiled files of a module."""
    module, device, size = variant
    return Path(wp.config.kernel_cache_dir, module.get_module_identifier(1 if device == "cpu" else size))


def _is_cached(variant: _Variant) -> bool:
    """Return True if the cache has a module's files; the module is hashed for it, which loading needs anyway."""
    return bool(wp.config.cache_kernels) and _folder_of(variant).is_dir()
