"""How every launcher starts its kernel: over all rows, or over one band of them.

A Warp CPU launch uses one thread and releases the interpreter lock, so the scheduler splits a pass into bands of rows
and launches them side by side. Every per-row kernel therefore takes ``row_start`` as its first input and adds it to
its first thread index.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import warp as wp

Rows = tuple[int, int]
"""A band of rows: first, and one past the last."""


def launch_rows(
    kernel: wp.Kernel,
    shape: Sequence[int],
    inputs: Sequence[Any],
    outputs: Sequence[Any],
    *,
    rows: Rows | None,
    device: wp.DeviceLike,
) -> None:
    """Launch ``kernel`` over ``shape``, restricted to ``rows`` along the first axis.

    Args:
        kernel: Kernel whose first argument is ``row_start: wp.int32``, added to its first thread index.
        shape: Whole extent of the launch.
        inputs: Arguments after ``row_start`` and before the outputs.
        outputs: Arrays that the kernel writes.
        rows: Band to launch; None means all rows.
        device: Where the arrays live.
    """
    start, stop = rows if rows is not None else (0, shape[0])
    if stop > start:
        wp.launch(kernel, dim=(stop - start, *shape[1:]), inputs=[start, *inputs], outputs=outputs, device=device)
