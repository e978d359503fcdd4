"""What stable numbers cost: the cheap form and the stable one of every sum that matters, their errors and their times.

Rows: ``sums`` (a frame in float32, plain and compensated), ``summed-area tables`` (float32 against modular integers),
``accumulations`` (an exponential mean over 1,000 frames), ``ray offsets`` (a fixed epsilon against every hit's bound).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import warp as wp

from bench.common import measure, paired_ratio, report
from warp_ar.kernels.summed_area import intensity, sum_area
from warp_ar.kernels.visibility import FAR, ROUNDING, intersect_sphere, offset_origin

SIZES = {"640x480": (480, 640), "1080p": (1080, 1920), "4K": (2160, 3840), "8K": (4320, 7680)}
RUNS = 5
FRAMES = 1000
EPSILON = wp.constant(wp.float32(1.0e-4))


@wp.kernel(enable_backward=False)
def sum_plainly_kernel(
    # In:
    values: wp.array2d[wp.float32],
    # Out:
    sums_out: wp.array[wp.float32],
):
    """One running sum down each column block of 64, as a thread that owns them would."""
    block = wp.tid()
    total = wp.float32(0.0)
    for i in range(values.shape[0]):
        for j in range(block * 64, wp.min(block * 64 + 64, values.shape[1])):
            total += values[i, j]
    sums_out[block] = total


@wp.kernel(enable_backward=False)
def sum_compensated_kernel(
    # In:
    values: wp.array2d[wp.float32],
    # Out:
    sums_out: wp.array[wp.float32],
):
    """The same with Kahan's correction."""
    block = wp.tid()
    total = wp.float32(0.0)
    lost = wp.float32(0.0)
    for i in range(values.shape[0]):
        for j in range(block * 64, wp.min(block * 64 + 64, values.shape[1])):
            term = values[i, j] - lost
            after = total + term
            lost = (after - total) - term
            total = after
    sums_out[block] = total


@wp.kernel(enable_backward=False)
def sum_rows_float_kernel(
    # In:
    frame: wp.array2d[wp.vec3ub],
    # Out:
    table_out: wp.array2d[wp.float32],
):
    """Running sums of one row."""
    i = wp.tid()
    total = wp.float32(0.0)
    for j in range(frame.shape[1]):
        total += wp.float32(intensity(frame[i, j]))
        table_out[i, j] = total


@wp.kernel(enable_backward=False)
def sum_columns_float_kernel(
    # In:
    block: wp.int32,
    # Out:
    table_out: wp.array2d[wp.float32],
):
    """Running sums of a block of columns."""
    start = wp.tid() * block
    for i in range(1, table_out.shape[0]):
        for j in range(start, wp.min(start + block, table_out.shape[1])):
            table_out[i, j] = table_out[i - 1, j] + table_out[i, j]


@wp.kernel(enable_backward=False)
def blend_kernel(
    # In:
    values: wp.array2d[wp.float32],
    rate: wp.float32,
    # Out:
    mean_out: wp.array2d[wp.float32],
):
    """(1 - a) m + a x."""
    i, j = wp.tid()
    mean_out[i, j] = (1.0 - rate) * mean_out[i, j] + rate * values[i, j]


@wp.kernel(enable_backward=False)
def approach_kernel(
    # In:
    values: wp.array2d[wp.float32],
    rate: wp.float32,
    # Out:
    mean_out: wp.array2d[wp.float32],
):
    """M + a (x - m)."""
    i, j = wp.tid()
    mean_out[i, j] = mean_out[i, j] + rate * (values[i, j] - mean_out[i, j])


@wp.kernel(enable_backward=False)
def leave_sphere_kernel(
    # In:
    radius: wp.float32,
    center: wp.vec3,
    stable: wp.int32,
    # Out:
    met_out: wp.array2d[wp.int32],
):
    """A ray that leaves the surface of a sphere, grazing it: does it meet the sphere?"""
    i, j = wp.tid()
    state = wp.rand_init(7, i * met_out.shape[1] + j)
    normal = wp.sample_unit_sphere_surface(state)
    along = wp.normalize(wp.cross(normal, wp.sample_unit_sphere_surface(state)))
    direction = wp.normalize(along + 1.0e-4 * normal)
    point = center + radius * normal
    error = ROUNDING * (8.0 * wp.max(wp.abs(point)) + 32.0 * radius * 1.7320508)
    origin = point + EPSILON * normal
    if stable != 0:
        origin = offset_origin(point, normal, direction, error)
    met_out[i, j] = wp.where(intersect_sphere(radius, origin - center, direction, FAR) < FAR, 1, 0)


def main(device: str) -> None:
    for name, (height, width) in SIZES.items():
        with wp.ScopedDevice(device):
            compare_sums(name, height, width, device)
            compare_tables(name, height, width, device)
            compare_accumulations(name, height, width, device)
            compare_offsets(name, height, width, device)


def print_row(
    row: str, size: str, device: str, errors: dict[str, float], unit: str, forms: dict[str, Callable[[], object]]
) -> None:
    """Time both forms in turn and print a line each."""
    times = measure(forms, device, runs=RUNS)
    for form, milliseconds in times.items():
        more = {"over_cheap": round(paired_ratio(times, "stable", "cheap"), 3)} if form == "stable" else {}
        report(
            f"precision {row} {size} {form}",
            milliseconds,
            device,
            row=row,
            size=size,
            form=form,
            error=float(f"{errors[form]:.3g}"),
            unit=unit,
            **more,
        )


def compare_sums(name: str, height: int, width: int, device: str) -> None:
    values = np.random.default_rng(0).uniform(0.9, 1.1, (height, width)).astype(np.float32)
    source, blocks = wp.array(values, dtype=wp.float32), -(-width // 64)
    sums = wp.zeros(blocks, dtype=wp.float32)
    kernels = {"cheap": sum_plainly_kernel, "stable": sum_compensated_kernel}
    exact, errors, forms = values.sum(dtype=np.float64), {}, {}
    for form, kernel in kernels.items():
        forms[form] = lambda kernel=kernel: wp.launch(kernel, dim=blocks, inputs=[source], outputs=[sums])
        forms[form]()
        errors[form] = abs(float(sums.numpy().sum(dtype=np.float64)) - exact) / exact
    print_row("sums", name, device, errors, "relative", forms)


def compare_tables(name: str, height: int, width: int, device: str) -> None:
    values = np.random.default_rng(1).integers(200, 256, (height, width), dtype=np.uint8)
    frame = wp.array(np.repeat(values[..., None], 3, axis=2), dtype=wp.vec3ub)
    real, whole = wp.zeros((height, width), dtype=wp.float32), wp.zeros((height, width), dtype=wp.uint32)
    block = 64 if wp.get_device(device).is_cpu else 1

    def cheap() -> None:
        wp.launch(sum_rows_float_kernel, dim=height, inputs=[frame], outputs=[real])
        wp.launch(sum_columns_float_kernel, dim=-(-width // block), inputs=[block], outputs=[real])

    forms = {"cheap": cheap, "stable": lambda: sum_area(frame, whole)}
    for form in forms.values():
        form()
    side = 9
    rows = np.append(np.random.default_rng(2).integers(0, height - side, 500), height - side - 1)
    columns = np.append(np.random.default_rng(3).integers(0, width - side, 500), width - side - 1)
    exact = [values[r + 1 : r + side + 1, c + 1 : c + side + 1].mean() for r, c in zip(rows, columns, strict=True)]
    errors = {}
    for form, table in (("cheap", real.numpy()), ("stable", whole.numpy())):
        boxes = table[rows + side, columns + side] - table[rows, columns + side]
        boxes = boxes - table[rows + side, columns] + table[rows, columns]
        errors[form] = float(np.abs(boxes / side**2 - exact).max())
    print_row("summed-area tables", name, device, errors, "grey levels of a 9x9 box", forms)


def compare_accumulations(name: str, height: int, width: int, device: str) -> None:
    room = np.random.default_rng(4).uniform(0.1, 3.0, (height, width)).astype(np.float32)
    errors, forms = {}, {}
    for form, kernel in (("cheap", blend_kernel), ("stable", approach_kernel)):
        # The error does not depend on the size: a strip of it stands for all.
        strip = np.ascontiguousarray(room[:8])
        small, mean = wp.array(strip, dtype=wp.float32), wp.array(strip, dtype=wp.float32)
        for frame in range(FRAMES):
            wp.launch(kernel, dim=strip.shape, inputs=[small, 0.01 + 0.001 * (frame % 7)], outputs=[mean])
        errors[form] = float(np.abs(mean.numpy() / strip - 1.0).max())
        values, running = wp.array(room, dtype=wp.float32), wp.array(room, dtype=wp.float32)
        forms[form] = lambda kernel=kernel, values=values, running=running: wp.launch(
            kernel, dim=room.shape, inputs=[values, 0.01], outputs=[running]
        )
    print_row("accumulations", name, device, errors, f"relative drift over {FRAMES} frames", forms)


def compare_offsets(name: str, height: int, width: int, device: str) -> None:
    met = wp.zeros((height, width), dtype=wp.int32)
    for radius, away in ((1e-3, 0.0), (1e3, 0.0)):
        center, errors, forms = wp.vec3(0.6 * away, -0.64 * away, 0.48 * away), {}, {}
        for form, stable in (("cheap", 0), ("stable", 1)):
            forms[form] = lambda stable=stable, radius=radius, center=center: wp.launch(
                leave_sphere_kernel, dim=(height, width), inputs=[radius, center, stable], outputs=[met]
            )
            forms[form]()
            errors[form] = float(met.numpy().mean())
        # A fixed offset of a tenth of a millimetre also floats above the surface of small things.
        errors["cheap"] = max(errors["cheap"], 0.1 if radius < 100 * 1e-4 else 0.0)
        row = f"ray offsets, {radius:g} m at {away:g} m"
        print_row(row, name, device, errors, "share of rays that meet the surface they leave, or gap in radii", forms)
