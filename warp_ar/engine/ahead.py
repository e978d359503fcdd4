"""CUDA modules that are compiled beside what a pipeline does before it knows all of them.

The longest of a plan's kernels take NVRTC seconds, and are known from what is asked for alone. Arrays, trees of meshes,
streams and whatever else comes before the plan's other kernels are known takes one thread some seconds as well.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import warp as wp

from warp_ar.engine.nvrtc import telling_when_translated

_UNDER_WAY: dict[Any, Future[None]] = {}
_LOCK = threading.Lock()


def begin(modules: Iterable[Any], device: Any) -> None:
    """Have modules compiled by threads of their own; returns when all are translated, which one thread does at a time.

    Args:
        modules: Of Warp, not in the cache.
        device: CUDA device.
    """

    def work(module: Any, translated: threading.Event) -> None:
        with telling_when_translated(translated):
            wp.compile_aot_module(module, device=device)

    with _LOCK:
        for module in [module for module in modules if module not in _UNDER_WAY]:
            translated = threading.Event()
            pool = ThreadPoolExecutor(1, "warp_ar-ahead")
            _UNDER_WAY[module] = pool.submit(work, module, translated)
            pool.shutdown(wait=False)
            # Whoever declares kernels holds the lock on translation for as long as this one translates.
            translated.wait()


def take(module: Any) -> Future[None] | None:
    """What compiles a module, if anything does; asked once, for after that it is in the cache."""
    with _LOCK:
        return _UNDER_WAY.pop(module, None)
