"""What stable numbers cost: cheap and stable forms of what is summed, kept, offset and stored; their errors and times.

    python -m bench precision [--device D]

takes under two minutes, prints one JSON line per case, writes them to ``bench/results/<device>_precision.jsonl``, and
the table made of all such files into ``docs/numerics.md``; ``python -m bench.bench_precision`` only writes the table.
Times on CPU are CPU time of one thread, on CUDA those of events around graph replays; contenders run in turn.

Rows: ``sums`` of a frame, ``summed-area tables``, ``accumulations`` (a mean over 1,000 frames), ``ray offsets``,
``look-ups`` in the levels of an environment 128 texels high, and ``layers`` of a frame written and read. The first form
of a row is the cheap one; the one marked ``*`` is what the program does.
"""

from __future__ import annotations

import functools
import json
import re
import statistics
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from bench.common import commit, measure
from warp_ar.kernels.picture.summed_area import intensity, sum_area
from warp_ar.kernels.rays.shapes import FAR, ROUNDING, intersect_sphere
from warp_ar.kernels.rays.trace import offset_origin

SIZES = {"640x480": (480, 640), "1080p": (1080, 1920), "4K": (2160, 3840), "8K": (4320, 7680)}
RUNS = {"cpu": 5, "cuda": 30}
FRAMES = 1000
MOST_RAYS = 1 << 21
"""Rays that are traced on CPU; larger frames take as much longer as they have pixels."""
LEVEL_HEIGHT = 128
EPSILON = wp.constant(wp.float32(1.0e-4))
RESULTS = Path(__file__).resolve().parent / "results"
TABLE = Path(__file__).resolve().parents[1] / "docs" / "numerics.md"
BEGIN, END = "<!-- precision -->", "<!-- /precision -->"

Forms = dict[str, Callable[[], object]]
"""What to time, by form."""


@functools.cache
def make_sum_kernel(real: Any) -> wp.Kernel:
    """Plain running sums in ``real``."""

    @wp.kernel(module="unique", enable_backward=False)
    def sum_plainly_kernel(
        # In:
        values: wp.array2d[wp.float32],
        # Out:
        sums_out: wp.array[wp.float64],
    ):
        """One running sum down each column block of 64, as a thread that owns them would."""
        block = wp.tid()
        total = real(0.0)
        for i in range(values.shape[0]):
            for j in range(block * 64, wp.min(block * 64 + 64, values.shape[1])):
                total += real(values[i, j])
        sums_out[block] = wp.float64(total)

    return sum_plainly_kernel


@wp.kernel(enable_backward=False)
def sum_compensated_kernel(
    # In:
    values: wp.array2d[wp.float32],
    # Out:
    sums_out: wp.array[wp.float64],
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
    sums_out[block] = wp.float64(total)


@functools.cache
def make_table_kernels(real: Any) -> tuple[wp.Kernel, wp.Kernel]:
    """Summed-area tables in ``real``: along rows, then down columns."""

    @wp.kernel(module="unique", enable_backward=False)
    def sum_rows_kernel(
        # In:
        frame: wp.array2d[wp.vec3ub],
        # Out:
        table_out: wp.array2d[Any],
    ):
        """Running sums of one row."""
        i = wp.tid()
        total = real(0.0)
        for j in range(frame.shape[1]):
            total += real(intensity(frame[i, j]))
            table_out[i, j] = total

    @wp.kernel(module="unique", enable_backward=False)
    def sum_columns_kernel(
        # In:
        block: wp.int32,
        # Out:
        table_out: wp.array2d[Any],
    ):
        """Running sums of a block of columns."""
        start = wp.tid() * block
        for i in range(1, table_out.shape[0]):
            for j in range(start, wp.min(start + block, table_out.shape[1])):
                table_out[i, j] = table_out[i - 1, j] + table_out[i, j]

    return sum_rows_kernel, sum_columns_kernel


@functools.cache
def make_accumulate_kernel(kept: Any, computed: Any, stable: bool) -> wp.Kernel:
    """An exponential mean that is kept as one type and computed in another."""

    @wp.kernel(module="unique", enable_backward=False)
    def accumulate_kernel(
        # In:
        values: wp.array2d[wp.float32],
        rate: wp.float32,
        # Out:
        mean_out: wp.array2d[Any],
    ):
        i, j = wp.tid()
        mean = computed(mean_out[i, j])
        value = computed(values[i, j])
        a = computed(rate)
        if wp.static(stable):
            mean_out[i, j] = kept(mean + a * (value - mean))
        else:
            mean_out[i, j] = kept((computed(1.0) - a) * mean + a * value)

    return accumulate_kernel


@wp.kernel(enable_backward=False)
def leave_sphere_kernel(
    # In:
    radius: wp.float32,
    center: wp.vec3,
    stable: wp.int32,
    # Out:
    met_out: wp.array[wp.int32],
):
    """A ray that leaves the surface of a sphere, grazing it: does it meet the sphere?"""
    i = wp.tid()
    state = wp.rand_init(7, i)
    normal = wp.sample_unit_sphere_surface(state)
    along = wp.normalize(wp.cross(normal, wp.sample_unit_sphere_surface(state)))
    direction = wp.normalize(along + 1.0e-4 * normal)
    point = center + radius * normal
    error = ROUNDING * (8.0 * wp.max(wp.abs(point)) + 32.0 * radius * 1.7320508)
    origin = point + EPSILON * normal
    if stable != 0:
        origin = offset_origin(point, normal, direction, error)
    met_out[i] = wp.where(intersect_sphere(radius, origin - center, direction, FAR) < FAR, 1, 0)


@wp.func
def read_texel(texel: Any) -> wp.vec3:
    """Radiance of a texel of any type."""
    return wp.vec3(wp.float32(texel[0]), wp.float32(texel[1]), wp.float32(texel[2]))


@wp.kernel(enable_backward=False)
def look_up_kernel(
    # In:
    levels: wp.array2d[Any],
    # Out:
    radiance_out: wp.array2d[wp.vec3],
):
    """Bilinear look-ups as mirror directions of neighbouring pixels go: along the map, a part of a texel apart."""
    i, j = wp.tid()
    y = wp.float32(levels.shape[0] - 1) * (wp.float32(i) + 0.5) / wp.float32(radiance_out.shape[0])
    x = wp.float32(levels.shape[1] - 1) * (wp.float32(j) + 0.5) / wp.float32(radiance_out.shape[1])
    r = wp.int32(y)
    c = wp.int32(x)
    fy = y - wp.float32(r)
    fx = x - wp.float32(c)
    top = (1.0 - fx) * read_texel(levels[r, c]) + fx * read_texel(levels[r, c + 1])
    bottom = (1.0 - fx) * read_texel(levels[r + 1, c]) + fx * read_texel(levels[r + 1, c + 1])
    radiance_out[i, j] = (1.0 - fy) * top + fy * bottom


@functools.cache
def make_layer_kernels(real: Any, lanes: Any) -> tuple[wp.Kernel, wp.Kernel]:
    """Write a layer of a frame (radiance and coverage), and read it back over a frame."""

    @wp.kernel(module="unique", enable_backward=False)
    def write_layer_kernel(
        # In:
        brightness: wp.float32,
        # Out:
        layer_out: wp.array2d[Any],
    ):
        i, j = wp.tid()
        value = brightness + wp.float32((i * 31 + j * 17) & 255) / 256.0
        layer_out[i, j] = lanes(real(value), real(0.5 * value), real(0.25 * value), real(0.5))

    @wp.kernel(module="unique", enable_backward=False)
    def read_layer_kernel(
        # In:
        frame: wp.array2d[wp.vec3ub],
        layer: wp.array2d[Any],
        # Out:
        image_out: wp.array2d[wp.vec3ub],
    ):
        i, j = wp.tid()
        over = layer[i, j]
        under = frame[i, j]
        rest = 1.0 - wp.float32(over[3])
        image_out[i, j] = wp.vec3ub(
            wp.uint8(wp.min(127.0 * wp.float32(over[0]) + rest * wp.float32(under[0]), 255.0)),
            wp.uint8(wp.min(127.0 * wp.float32(over[1]) + rest * wp.float32(under[1]), 255.0)),
            wp.uint8(wp.min(127.0 * wp.float32(over[2]) + rest * wp.float32(under[2]), 255.0)),
        )

    return write_layer_kernel, read_layer_kernel


def main(device: str) -> None:
    place = wp.get_device(device)
    records: list[dict[str, Any]] = []
    with wp.ScopedDevice(place):
        for name, (height, width) in SIZES.items():
            for compare in (compare_sums, compare_tables, compare_accumulations, compare_look_ups, compare_layers):
                records += compare(name, height, width)
            for radius, away in ((1e-3, 0.0), (1e3, 0.0), (1.0, 1e3)):
                records += compare_offsets(name, height, width, radius, away)
    label = "cpu" if place.is_cpu else place.name.split()[-1].lower()
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"{label}_precision.jsonl").write_text("".join(json.dumps(record) + "\n" for record in records))
    write_table()


def time_forms(forms: Forms, share: float = 1.0) -> dict[str, list[float]]:
    """Milliseconds of every run, contenders in turn; ``share`` of the work is done, and stands for all."""
    device = wp.get_device()
    runs = RUNS["cpu" if device.is_cpu else "cuda"]
    if not device.is_cpu:
        times = measure(forms, device, runs=runs)
        return {form: [t / share for t in taken] for form, taken in times.items()}
    times = {form: [] for form in forms}
    for run in range(runs + 1):
        for form, function in forms.items():
            start = time.process_time()
            function()
            if run:  # the first one warms up
                times[form].append(1e3 * (time.process_time() - start) / share)
    return times


def make_records(
    row: str, size: str, unit: str, errors: dict[str, float], forms: Forms, share: float = 1.0
) -> list[dict[str, Any]]:
    """Time the forms in turn and print a line each; the first is the cheap one."""
    times, device = time_forms(forms, share), wp.get_device()
    cheap = next(iter(forms))
    records = []
    for form, taken in times.items():
        ratio = statistics.median(a / b for a, b in zip(taken, times[cheap], strict=True))
        records.append(
            {
                "case": "precision",
                "row": row,
                "size": size,
                "form": form,
                "error": float(f"{errors[form]:.2g}"),
                "unit": unit,
                "median_ms": float(f"{statistics.median(taken):.3g}"),
                "over_cheap": round(ratio, 2),
                "runs": len(taken),
                "clock": "CPU time" if device.is_cpu else "events",
                "device": device.name,
                "warp": wp.__version__,
                "commit": commit(),
            }
        )
        print(json.dumps(records[-1]), flush=True)
    return records


def compare_sums(name: str, height: int, width: int) -> list[dict[str, Any]]:
    values = np.random.default_rng(0).random((height, width), np.float32) * np.float32(0.2) + np.float32(0.9)
    source, blocks = wp.array(values, dtype=wp.float32), -(-width // 64)
    sums = wp.zeros(blocks, dtype=wp.float64)
    kernels = {
        "float32": make_sum_kernel(wp.float32),
        "float32, compensated *": sum_compensated_kernel,
        "float64": make_sum_kernel(wp.float64),
    }
    exact, errors, forms = values.sum(dtype=np.float64), {}, {}
    for form, kernel in kernels.items():
        forms[form] = functools.partial(wp.launch, kernel, dim=blocks, inputs=[source], outputs=[sums])
        forms[form]()
        errors[form] = abs(float(sums.numpy().sum()) - exact) / exact
    return make_records("sums", name, "relative", errors, forms)


def compare_tables(name: str, height: int, width: int) -> list[dict[str, Any]]:
    values = np.random.default_rng(1).integers(200, 256, (height, width), dtype=np.uint8)
    frame = wp.array(np.repeat(values[..., None], 3, axis=2), dtype=wp.vec3ub)
    block = 64 if wp.get_device().is_cpu else 1

    def in_reals(real: Any, table: wp.array) -> None:
        rows, columns = make_table_kernels(real)
        wp.launch(rows, dim=height, inputs=[frame], outputs=[table])
        wp.launch(columns, dim=-(-width // block), inputs=[block], outputs=[table])

    tables = {
        "float32": wp.zeros((height, width), dtype=wp.float32),
        "uint32, modulo 2^32 *": wp.zeros((height, width), dtype=wp.uint32),
        "float64": wp.zeros((height, width), dtype=wp.float64),
    }
    names = list(tables)
    forms: Forms = {
        names[0]: functools.partial(in_reals, wp.float32, tables[names[0]]),
        names[1]: functools.partial(sum_area, frame, tables[names[1]]),
        names[2]: functools.partial(in_reals, wp.float64, tables[names[2]]),
    }
    side, errors = 9, {}
    rows = np.append(np.random.default_rng(2).integers(0, height - side, 500), height - side - 1)
    columns = np.append(np.random.default_rng(3).integers(0, width - side, 500), width - side - 1)
    exact = [values[r + 1 : r + side + 1, c + 1 : c + side + 1].mean() for r, c in zip(rows, columns, strict=True)]
    for form, function in forms.items():
        function()
        table = tables[form].numpy()
        boxes = table[rows + side, columns + side] - table[rows, columns + side]
        boxes = boxes - table[rows + side, columns] + table[rows, columns]
        errors[form] = float(np.abs(boxes / side**2 - exact).max())
    return make_records("summed-area tables", name, "grey levels of a 9x9 box", errors, forms)


def compare_accumulations(name: str, height: int, width: int) -> list[dict[str, Any]]:
    surroundings = np.random.default_rng(4).random((height, width), np.float32) * np.float32(2.9) + np.float32(0.1)
    # The error does not depend on the size: a strip stands for all.
    strip = np.ascontiguousarray(surroundings[:4, :512])
    errors, forms = {}, {}
    kinds = {
        "float32, (1 - a) m + a x": (wp.float32, wp.float32, False),
        "float32, m + a (x - m) *": (wp.float32, wp.float32, True),
        "float64, (1 - a) m + a x": (wp.float64, wp.float64, False),
        "float16 kept, m + a (x - m)": (wp.float16, wp.float32, True),
    }
    small, values = wp.array(strip, dtype=wp.float32), wp.array(surroundings, dtype=wp.float32)
    for form, (kept, computed, stable) in kinds.items():
        kernel = make_accumulate_kernel(kept, computed, stable)
        # From nine tenths of the truth: what is kept too coarsely never gets there.
        mean = wp.array(0.9 * strip, dtype=kept)
        for frame in range(FRAMES):
            wp.launch(kernel, dim=strip.shape, inputs=[small, 0.01 + 0.001 * (frame % 7)], outputs=[mean])
        errors[form] = float(np.abs(mean.numpy() / strip.astype(np.float64) - 1.0).max())
        running = wp.array(surroundings, dtype=kept)
        forms[form] = functools.partial(
            wp.launch, kernel, dim=surroundings.shape, inputs=[values, 0.01], outputs=[running]
        )
    return make_records("accumulations", name, f"relative, after {FRAMES} frames", errors, forms)


def compare_look_ups(name: str, height: int, width: int) -> list[dict[str, Any]]:
    rng = np.random.default_rng(5)
    surroundings = np.float32(10.0 ** rng.uniform(-4, 1, (LEVEL_HEIGHT, 2 * LEVEL_HEIGHT, 3)))
    surroundings[LEVEL_HEIGHT // 3, LEVEL_HEIGHT // 2] = 1e6  # a sun
    share = min(1.0, MOST_RAYS / (height * width)) if wp.get_device().is_cpu else 1.0
    out = wp.zeros((round(height * share), width), dtype=wp.vec3)
    errors, forms, dark = {}, {}, surroundings.max(-1) < 65504
    kinds = {"float16, 4 lanes": (wp.vec4h, np.float16), "float32 *": (wp.vec3, np.float32)}
    for form, (lanes, real) in kinds.items():
        with np.errstate(over="ignore"):
            kept = np.minimum(surroundings, np.finfo(real).max).astype(real)
        errors[form] = float(np.abs(kept[dark].astype(np.float64) / surroundings[dark] - 1.0).max())
        if real is np.float16:
            kept = np.concatenate([kept, np.zeros_like(kept[..., :1])], -1)
        levels = wp.array(kept, dtype=lanes)
        forms[form] = functools.partial(wp.launch, look_up_kernel, dim=out.shape, inputs=[levels], outputs=[out])
    unit = "relative, below 65504; a sun of 1e6 loses 93 % in float16"
    return make_records("look-ups", name, unit, errors, forms, out.shape[0] / height)


def compare_layers(name: str, height: int, width: int) -> list[dict[str, Any]]:
    share = min(1.0, MOST_RAYS / (height * width)) if wp.get_device().is_cpu else 1.0
    shape = round(height * share), width
    frame, image = wp.zeros(shape, dtype=wp.vec3ub), wp.zeros(shape, dtype=wp.vec3ub)
    errors, forms = {}, {}
    exact = 0.1 + ((31 * np.arange(shape[0])[:, None] + 17 * np.arange(width)) & 255) / 256.0
    for form, real, lanes in (("float16", wp.float16, wp.vec4h), ("float32 *", wp.float32, wp.vec4)):
        layer = wp.zeros(shape, dtype=lanes)
        write, read = make_layer_kernels(real, lanes)

        def both(write: Any = write, read: Any = read, layer: Any = layer) -> None:
            wp.launch(write, dim=shape, inputs=[0.1], outputs=[layer])
            wp.launch(read, dim=shape, inputs=[frame, layer], outputs=[image])

        both()
        errors[form] = float(np.abs(layer.numpy()[..., 0] / exact - 1.0).max())
        forms[form] = both
    return make_records("layers", name, "relative", errors, forms, shape[0] / height)


def compare_offsets(name: str, height: int, width: int, radius: float, away: float) -> list[dict[str, Any]]:
    rays = min(height * width, MOST_RAYS) if wp.get_device().is_cpu else height * width
    met = wp.zeros(rays, dtype=wp.int32)
    center, errors, forms = wp.vec3(0.6 * away, -0.64 * away, 0.48 * away), {}, {}
    for form, stable in (("0.1 mm", 0), ("each hit's bound *", 1)):
        forms[form] = functools.partial(
            wp.launch, leave_sphere_kernel, dim=rays, inputs=[radius, center, stable], outputs=[met]
        )
        forms[form]()
        errors[form] = float(met.numpy().mean())
    if radius <= 1e-3:  # a tenth of a millimetre floats above what is small: shadows come loose
        errors["0.1 mm"] = 1e-4 / radius
    unit = "gap in radii" if radius <= 1e-3 else "share of rays that meet what they leave"
    row = f"ray offsets, a ball of {radius:g} m {f'{away:g} m away' if away else 'at the origin'}"
    return make_records(row, name, unit, errors, forms, rays / (height * width))


# --- Table ------------------------------------------------------------------------------------------------------------


def format_table(records: Iterable[dict[str, Any]]) -> str:
    """Markdown: a line per row and form, four sizes in a cell, a column of times per device."""
    found: dict[tuple[str, str], dict[tuple[str, str], dict[str, Any]]] = {}
    devices: dict[str, None] = {}
    for record in records:
        device = "CPU" if record["clock"] == "CPU time" else record["device"].removeprefix("NVIDIA ")
        devices[device] = None
        found.setdefault((record["row"], record["form"]), {})[device, record["size"]] = record
    lines = ["| what | form | error | " + " | ".join(f"{device}, ms" for device in devices) + " |"]
    lines.append("| --- | --- | --- |" + " --- |" * len(devices))
    for (row, form), cells in found.items():
        errors = [max(cells[d, s]["error"] for d in devices if (d, s) in cells) for s in SIZES]
        unit = next(iter(cells.values()))["unit"]
        columns = [
            " / ".join(f"{cells[device, size]['median_ms']:g}" for size in SIZES if (device, size) in cells)
            for device in devices
        ]
        spread = f"{errors[0]:g}" if len(set(errors)) == 1 else " / ".join(f"{error:g}" for error in errors)
        lines.append(f"| {row} | {form} | {spread} ({unit}) | {' | '.join(columns)} |")
    return "\n".join(lines)


def write_table() -> None:
    """Write the table of all results into the documentation."""
    files = sorted(RESULTS.glob("*_precision.jsonl"))
    table = format_table(json.loads(line) for file in files for line in file.read_text().splitlines())
    text = TABLE.read_text()
    pattern = f"{re.escape(BEGIN)}.*?{re.escape(END)}"
    if not re.search(pattern, text, re.DOTALL):
        raise ValueError(f"{TABLE} has no {BEGIN} ... {END} to write the table into")
    TABLE.write_text(re.sub(pattern, lambda _: f"{BEGIN}\n{table}\n{END}", text, count=1, flags=re.DOTALL))


if __name__ == "__main__":
    sys.exit(write_table())
