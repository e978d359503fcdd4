"""How every launcher starts its kernel, over all rows or over one band of them, and how blocks wait for each other.

A Warp CPU launch uses one thread and releases the interpreter lock, so the scheduler splits a pass into bands of rows
and launches them side by side. Every per-row kernel therefore takes ``row_start`` as its first input and adds it to
its first thread index.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Sequence
from typing import Any

import warp as wp

Rows = tuple[int, int]
"""A band of rows: first, and one past the last."""

MOST_REGISTERS = 80
"""Registers of a CUDA thread in kernels that trace rays.

They wait for memory most of their time. Left alone they take 120 to 255, with which a multiprocessor of 65,536 holds
one or two blocks of 256 threads; with three it has others to go on with, and gains more than spilling costs.
"""

MAX_PARTIALS = 8
"""Threads of a CUDA device that share a cell's samples at most, each with a partial sum."""
ENOUGH_THREADS = 1 << 20
"""Threads from which more make a CUDA device slower: each finds the cell's point and picks its samples anew."""


def count_partials(rows: int, columns: int, most: int = MAX_PARTIALS) -> int:
    """Threads of a CUDA device per cell: as many as it takes to fill it, up to ``most``, a power of 2."""
    partials = most
    while partials > 1 and partials * rows * columns > ENOUGH_THREADS:
        partials //= 2
    return partials


def launch_rows(
    kernel: wp.Kernel,
    shape: Sequence[int],
    inputs: Sequence[Any],
    outputs: Sequence[Any],
    *,
    rows: Rows | None,
    device: wp.DeviceLike,
    stream: wp.Stream | None = None,
) -> None:
    """Launch ``kernel`` over ``shape``, restricted to ``rows`` along the first axis.

    Args:
        kernel: Kernel whose first argument is ``row_start: wp.int32``, added to its first thread index.
        shape: Whole extent of the launch.
        inputs: Arguments after ``row_start`` and before the outputs.
        outputs: Arrays that the kernel writes.
        rows: Band to launch; None means all rows.
        device: Where the arrays live.
        stream: CUDA stream; None means the device's current one.
    """
    start, stop = rows if rows is not None else (0, shape[0])
    if stop > start:
        dim = (stop - start, *shape[1:])
        wp.launch(kernel, dim=dim, inputs=[start, *inputs], outputs=outputs, device=device, stream=stream)


# On CPU a module's tiles lie on the stack of the kernel that began last, for there is one pointer to them per module:
# two threads in kernels of that module, with tiles or without, take each other's (seen with 1.19 on x86-64: crashes).
_CPU_TILES = threading.Lock()


def tile_kernel(function: Callable[..., None]) -> Any:
    """Declare a kernel that uses tiles: in a module of its own, where no other kernel moves them.

    It may be launched by ``launch_tiles`` only, which sees to it that it does not meet itself.
    """
    return wp.kernel(function, enable_backward=False, module="unique")


def launch_tiles(
    kernel: wp.Kernel,
    dim: Sequence[int],
    inputs: Sequence[Any],
    outputs: Sequence[Any],
    *,
    block_dim: int,
    device: wp.DeviceLike,
) -> None:
    """Launch a kernel whose blocks work together, one block per element of ``dim``; on CPU never two at a time.

    Args:
        kernel: Declared by ``tile_kernel``, or without tiles.
        dim: Blocks along each axis.
        inputs: Arguments before the outputs.
        outputs: Arrays that the kernel writes.
        block_dim: Threads per block on CUDA; on CPU a block is one thread.
        device: Where the arrays live.
    """
    with _CPU_TILES if wp.get_device(device).is_cpu else contextlib.nullcontext():
        wp.launch_tiled(kernel, dim=dim, inputs=inputs, outputs=outputs, block_dim=block_dim, device=device)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
""")
def wait_for_block():
    """Goes on once all threads of the block are here and what they wrote can be read."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __shared__ bool last;
    __syncthreads();
    if (threadIdx.x == 0) {
        __threadfence();
        last = atomicInc(reinterpret_cast<unsigned int*>(blocks_done.data), blocks - 1) == blocks - 1;
    }
    __syncthreads();
    __threadfence();
    return last;
#else
    const bool last = ++blocks_done.data[0] == blocks;
    if (last) blocks_done.data[0] = 0;
    return last;
#endif
""")
def is_last_block(blocks_done: wp.array[wp.int32], blocks: wp.int32) -> wp.bool:
    """Whether all other blocks got here before; the last one can read what all of them wrote. Sets the count back."""
