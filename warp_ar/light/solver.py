"""Least squares with unknowns that are not negative, on one thread of NumPy."""

from __future__ import annotations

import functools
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

Array = NDArray[np.float64]


class OneBlasThread:
    """NumPy's BLAS on one thread: products here take microseconds, and waking threads for them more.

    The number belongs to the process. Where several solvers are at work the first sets it, the last sets it back.
    ``threadpoolctl`` lets only that thread change it which changed it first, so one thread does it for all.
    """

    def __init__(self) -> None:
        self._lock, self._inside = threading.Lock(), 0

    @functools.cached_property
    def _controller(self) -> ThreadpoolController:
        """What finds the libraries; to look for them takes as long as four fits."""
        return ThreadpoolController()

    @functools.cached_property
    def _setter(self) -> ThreadPoolExecutor:
        return ThreadPoolExecutor(1, "warp_ar-blas")

    def _set(self) -> None:
        self._limit = self._controller.limit(limits=1, user_api="blas")
        self._limit.__enter__()

    def _reset(self) -> None:
        self._limit.__exit__(None, None, None)

    def __enter__(self) -> None:
        with self._lock:
            if self._inside == 0:
                self._setter.submit(self._set).result()
            self._inside += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._inside -= 1
            if self._inside == 0:
                self._setter.submit(self._reset).result()


ONE_BLAS_THREAD = OneBlasThread()


def solve_nonnegative(hessian: Array, gradient: Array, start: Array | None = None) -> Array:
    """Minimise x' H x / 2 - g' x over x >= 0.

    Block pivoting: free unknowns that turn negative are held at zero; once none does, held ones that pull upward are
    let go.

    Args:
        hessian: H, positive definite, (n, n).
        gradient: g, (n,).
        start: Solution of a similar problem: its positive unknowns start free.
    """
    free = np.ones(len(gradient), bool) if start is None else start > 0.0
    x = np.zeros(len(gradient))
    tolerance = 1e-9 * float(np.abs(gradient).max(initial=0.0))
    for _ in range(60):
        x[:] = 0.0
        index = np.flatnonzero(free)
        if len(index) == len(x):
            x[:] = np.linalg.solve(hessian, gradient)
        elif len(index):
            x[index] = np.linalg.solve(hessian[index[:, None], index], gradient[index])
        negative = free & (x < 0.0)
        if negative.any():
            free &= ~negative
            continue
        pulled = ~free & (hessian @ x - gradient < -tolerance)
        if not pulled.any():
            break
        free |= pulled
    return np.maximum(x, 0.0)
