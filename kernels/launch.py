"""Launches of kernels, over all rows or over one band of them.

A Warp CPU launch uses one thread, so the scheduler splits a pass into bands of rows that threads take side by side.
Every per-row kernel therefore takes ``row_start`` as its first input and adds it to its first thread index.

Launchers use this module, so that launches can be recorded instead of executed (``noting``). From these notes the
scheduler finds the modules to compile and, on CPU, the calls that native threads make.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import warp as wp

Rows = tuple[int, int]
"""A band of rows: first, and one past the last."""

MOST_REGISTERS = 80
"""Registers of a CUDA thread in kernels that trace rays.

These kernels mostly wait for memory. Without a limit they take 120 to 255 registers, with which a multiprocessor of
65,536 holds one or two blocks of 256 threads. A third block hides more latency than spilled registers cost.
"""


@dataclasses.dataclass(frozen=True)
class Note:
    """Record of a launch or a copy, made while ``noting``."""

    kernel: wp.Kernel | None
    """Kernel of the launch; None for a copy."""
    rows: Rows | None
    """Band of rows that the launcher was given."""
    do: Callable[[], None]
    """Function that executes the launch or copy."""
    record: Callable[[], wp.Launch] | None = None
    """Function that loads the kernel and packs its arguments, for a launch over all rows with ``row_start`` 0."""
    arrays: tuple[wp.array, wp.array] | None = None
    """Target and source of a copy."""
    block_dim: int = 256
    """Threads of a block, on CUDA."""
    tiles: bool = False
    """True if it must not run at the same time as another launch that uses tiles."""


_NOTES = threading.local()


@contextlib.contextmanager
def noting() -> Iterator[list[Note]]:
    """Append the launches and copies of this thread to the list that is yielded, without executing them."""
    before = getattr(_NOTES, "list", None)
    _NOTES.list = notes = []
    try:
        yield notes
    finally:
        _NOTES.list = before


def do_or_note(note: Note) -> None:
    """Execute a launch or copy or, inside ``noting``, append it to the list instead."""
    notes = getattr(_NOTES, "list", None)
    if notes is None:
        note.do()
    else:
        notes.append(note)


def device_of(device: wp.DeviceLike, arguments: Sequence[Any]) -> Any:
    """Return the device; if None, that of the first array among the arguments, which may be a field of a struct."""
    if device is None:
        held = [part for one in arguments for part in (one, *getattr(one, "__dict__", {}).values())]
        device = next(part.device for part in held if isinstance(part, wp.array))
    return wp.get_device(device)


def launch(
    kernel: wp.Kernel,
    dim: int | Sequence[int],
    inputs: Sequence[Any] = (),
    outputs: Sequence[Any] = (),
    *,
    device: wp.DeviceLike = None,
    stream: wp.Stream | None = None,
    block_dim: int = 256,
) -> None:
    """Launch a kernel that is not split into bands; arguments as for ``wp.launch``."""
    device = device_of(device, [*outputs, *inputs])
    given = {"dim": dim, "inputs": inputs, "outputs": outputs, "device": device, "stream": stream}
    given["block_dim"] = None if device.is_cpu else block_dim
    do_or_note(
        Note(
            kernel,
            None,
            lambda: wp.launch(kernel, **given),
            lambda: wp.launch(kernel, **given, record_cmd=True),
            block_dim=block_dim,
        )
    )


def copy(target: wp.array, source: wp.array) -> None:
    """Copy an array into another of its size and type, on the same device."""
    do_or_note(Note(None, None, lambda: wp.copy(target, source), arrays=(target, source)))


def launch_rows(
    kernel: wp.Kernel,
    shape: Sequence[int],
    inputs: Sequence[Any],
    outputs: Sequence[Any],
    *,
    rows: Rows | None,
    device: wp.DeviceLike = None,
    stream: wp.Stream | None = None,
) -> None:
    """Launch ``kernel`` over ``shape``, restricted to ``rows`` along the first axis.

    Args:
        kernel: Kernel whose first argument is ``row_start: wp.int32``, added to its first thread index.
        shape: Whole extent of the launch.
        inputs: Arguments after ``row_start`` and before the outputs.
        outputs: Arrays that the kernel writes.
        rows: Band to launch; None means all rows.
        device: Device of the arrays; None: found by ``device_of``.
        stream: CUDA stream; None means the device's current one.
    """
    device = device_of(device, [*outputs, *inputs])

    def do() -> None:
        start, stop = rows if rows is not None else (0, shape[0])
        if stop > start:
            dim = (stop - start, *shape[1:])
            wp.launch(kernel, dim=dim, inputs=[start, *inputs], outputs=outputs, device=device, stream=stream)

    def record() -> wp.Launch:
        given = {"inputs": [0, *inputs], "outputs": outputs, "device": device, "stream": stream}
        return wp.launch(kernel, dim=tuple(shape), **given, record_cmd=True)

    do_or_note(Note(kernel, rows, do, record))


def pixel_run(device: wp.DeviceLike) -> int:
    """Return the number of pixels of a row that one thread computes, for kernels in which most pixels are cheap.

    On a CPU starting a thread costs as much as such a pixel. On CUDA neighbouring threads read neighbouring pixels.
    """
    return 32 if wp.get_device(device).is_cpu else 1


def row_launcher(
    kernel: wp.Kernel | Callable[..., wp.Kernel],
    *,
    configs: int = 1,
    outputs: int = 1,
    like: Callable[..., Any] | None = None,
    runs: bool = False,
    **options: bool,
) -> Callable[..., None]:
    """Return ``launcher(*configs, *inputs, *outputs, rows=None, **options)`` of a kernel that takes ``row_start``.

    Args:
        kernel: Kernel, or a factory that makes it from configurations, the launcher's first arguments.
        configs: Number of configurations.
        outputs: Number of the kernel's outputs, the launcher's last arguments.
        like: Function of the kernel's arguments that returns the launch's shape, or an array of that shape; None: the
            first output.
        runs: Whether each thread computes a run of pixels of one row, whose length is the kernel's last input.
        **options: Options of ``launch_rows`` for all launches.
    """

    def launcher(*given: Any, rows: Rows | None = None, **more: bool) -> None:
        made, arguments = kernel, given
        if not isinstance(kernel, wp.Kernel):
            made, arguments = kernel(*given[:configs]), given[configs:]
        extent = arguments[-outputs] if like is None else like(*arguments)
        inputs, written, shape = arguments[:-outputs], arguments[-outputs:], getattr(extent, "shape", extent)
        if runs:
            run = pixel_run(written[0].device)
            inputs, shape = (*inputs, run), (shape[0], -(-shape[1] // run))
        launch_rows(made, shape, inputs, written, rows=rows, **options, **more)

    return launcher


# On CPU a module has one pointer to its tiles, which lie on the stack of the kernel that began last. Two threads in
# kernels of one module, with or without tiles, use each other's tiles (with Warp 1.19 on x86-64 this crashes).
_CPU_TILES = threading.Lock()


def alone_with_tiles() -> contextlib.AbstractContextManager[Any]:
    """Return a lock that callers hold while they run kernels with tiles on the CPU without ``launch_tiles``."""
    return _CPU_TILES


def tile_kernel(function: Callable[..., None]) -> Any:
    """Declare a kernel that uses tiles, in a module of its own, so that no other kernel moves its tiles.

    It may be launched by ``launch_tiles`` only, which prevents concurrent launches.
    """
    return wp.kernel(function, enable_backward=False, module="unique")


def launch_tiles(
    kernel: wp.Kernel,
    dim: Sequence[int],
    inputs: Sequence[Any],
    outputs: Sequence[Any],
    *,
    block_dim: int,
    device: wp.DeviceLike = None,
    rows: Rows | None = None,
) -> None:
    """Launch a kernel whose blocks work together, one block per element of ``dim``; on CPU never two at a time.

    Args:
        kernel: Declared by ``tile_kernel``, or without tiles. If ``rows`` are given, its first argument is as that of
            ``launch_rows``.
        dim: Blocks along each axis.
        inputs: Arguments before the outputs.
        outputs: Arrays that the kernel writes.
        block_dim: Threads per block on CUDA; on CPU a block is one thread.
        device: Device of the arrays; None: found by ``device_of``.
        rows: Band of blocks along the first axis; None means all blocks of a kernel without ``row_start``.
    """
    device = device_of(device, [*outputs, *inputs])

    def do(record_cmd: bool = False) -> wp.Launch | None:
        start, stop = rows if rows is not None and not record_cmd else (0, dim[0])
        if stop <= start:
            return None
        given = [start, *inputs] if rows is not None else list(inputs)
        more = {"block_dim": block_dim, "device": device, "record_cmd": record_cmd}
        with _CPU_TILES if device.is_cpu else contextlib.nullcontext():
            return wp.launch_tiled(kernel, dim=(stop - start, *dim[1:]), inputs=given, outputs=outputs, **more)

    do_or_note(Note(kernel, rows, do, functools.partial(do, True), block_dim=block_dim, tiles=True))
