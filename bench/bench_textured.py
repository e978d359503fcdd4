"""What textures and materials cost: a million triangles with and without four pictures of 4K, and 50 objects.

    python -m bench textured                     # both; under two minutes on an H200
    python -m bench textured --part triangles    # or: objects
    python -m bench textured --device cpu --triangles 20000 --texture 256 --size 640x480 --runs 5

Frames of ``desk`` enlarged, of one pose, quality ``medium``. On CUDA a frame is the device time of the scheduler's
captured graphs; on CPU processor time. Contenders take turns, and ``ratio`` is the median of the paired ratios.

``triangles``: a torus of a file's material, its factors alone and with pictures of base colour, metallic-roughness,
normal and occlusion. ``objects``: 50 small tori, of one material and of 20, each with a picture of its base colour.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import statistics
import struct
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import warp as wp

from bench.bench_frame import WARM_UP, Clip, clip
from bench.common import paired_ratio, report
from warp_ar.engine.pipeline import Pipeline
from warp_ar.scene import Object

Array = npt.NDArray[Any]

OBJECTS, MATERIALS = 50, 20
ROLES = ("baseColorTexture", "metallicRoughnessTexture", "normalTexture", "occlusionTexture")


def torus_grid(triangles: int) -> dict[str, Array]:
    """Attributes of a torus of at least so many triangles, 5.5 cm across, in glTF's axes, and its ``indices``."""
    rows = int(np.ceil(np.sqrt(triangles / 4.0)))
    columns = 2 * rows
    v, u = (part.ravel() for part in np.meshgrid(np.linspace(0, 1, rows + 1), np.linspace(0, 1, columns + 1)))
    around, across = 2.0 * np.pi * u, 2.0 * np.pi * v
    normal = np.stack([np.cos(around) * np.cos(across), np.sin(across), -np.sin(around) * np.cos(across)], axis=1)
    ring = np.stack([np.cos(around), np.zeros_like(u), -np.sin(around)], axis=1)
    corner = (np.arange(columns)[:, None] * (rows + 1) + np.arange(rows)).ravel()
    beside, above = corner + rows + 1, corner + 1
    faces = np.concatenate([np.stack([corner, beside, above], 1), np.stack([beside, beside + 1, above], 1)])
    return {
        "POSITION": (0.02 * ring + 0.0075 * normal).astype(np.float32),
        "NORMAL": normal.astype(np.float32),
        "TEXCOORD_0": np.stack([4.0 * u, v], axis=1).astype(np.float32),
        "indices": faces.astype(np.uint32).ravel(),
    }


def make_pictures(side: int, seed: int) -> dict[str, bytes]:
    """Noise of two scales for each role of a texture, as PNG."""
    rng = np.random.default_rng(seed)
    pictures = {}
    for role in ROLES:
        fine = rng.integers(0, 64, (side, side, 3), np.uint8)
        coarse = rng.integers(64, 192, (max(side // 64, 2), max(side // 64, 2), 3), np.uint8)
        picture = cv2.resize(coarse, (side, side), interpolation=cv2.INTER_CUBIC) + fine
        if role == "normalTexture":  # codes of x, y near 128; BGR, z is blue
            picture = picture // 4 + 96
            picture[..., 0] = 255
        pictures[role] = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
    return pictures


def write_torus(path: Path, grid: Mapping[str, Array], color: tuple[float, ...], pictures: Mapping[str, bytes]) -> Path:
    """A GLB of the torus with one material; its textures are those of ``pictures``."""
    parts: list[bytes] = []
    views: list[dict[str, int]] = []
    accessors: list[dict[str, Any]] = []

    def add(data: bytes) -> int:
        views.append({"buffer": 0, "byteOffset": sum(map(len, parts)), "byteLength": len(data)})
        parts.append(data + b"\0" * (-len(data) % 4))
        return len(views) - 1

    for name, values in grid.items():
        view = add(np.ascontiguousarray(values).tobytes())
        kinds = {"component": 5125 if name == "indices" else 5126, "type": f"VEC{values.shape[-1]}"}
        accessor = {"bufferView": view, "componentType": kinds["component"], "count": len(values)}
        accessor["type"] = "SCALAR" if name == "indices" else kinds["type"]
        if name == "POSITION":
            accessor |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        accessors.append(accessor)
    roles = {role: {"index": index} for index, role in enumerate(pictures)}
    inner = {role: roles.pop(role) for role in ROLES[:2] if role in roles}
    factors = {"baseColorFactor": [*color, 1.0], "metallicFactor": 0.5, "roughnessFactor": 0.5}
    attributes = {name: index for index, name in enumerate(grid) if name != "indices"}
    primitive = {"attributes": attributes, "indices": list(grid).index("indices"), "material": 0}
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [{"pbrMetallicRoughness": {**factors, **inner}, **roles}],
        "accessors": accessors,
        "images": [{"bufferView": add(data), "mimeType": "image/png"} for data in pictures.values()],
        "textures": [{"source": index} for index in range(len(pictures))],
        "bufferViews": views,
    }
    if not pictures:
        del tree["images"], tree["textures"]
    data = b"".join(parts)
    tree["buffers"] = [{"byteLength": len(data)}]
    header = json.dumps(tree).encode()
    header += b" " * (-len(header) % 4)
    chunks = struct.pack("<II", len(header), 0x4E4F534A) + header + struct.pack("<II", len(data), 0x004E4942) + data
    path.write_bytes(b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks)
    return path


def with_objects(frames: Clip, objects: tuple[Object, ...]) -> Clip:
    """The clip with these in place of its own."""
    return dataclasses.replace(frames, scene=dataclasses.replace(frames.scene, objects=objects))


def triangle_cases(frames: Clip, folder: Path, triangles: int, side: int) -> dict[str, Clip]:
    """One large torus, its material without pictures and with four."""
    grid = torus_grid(triangles)
    color = (0.8, 0.6, 0.5)
    files = {
        "plain": write_torus(folder / "plain.glb", grid, color, {}),
        "textured": write_torus(folder / "textured.glb", grid, color, make_pictures(side, 0)),
    }
    return {
        name: with_objects(frames, (Object("mesh", file=path, at=(0.1, 0.05, 0.04), scale=5.0),))
        for name, path in files.items()
    }


def object_cases(frames: Clip, folder: Path) -> dict[str, Clip]:
    """50 small tori over the desk, of one file and of 20."""
    rng = np.random.default_rng(1)
    grid = torus_grid(2000)
    files = []
    for index in range(MATERIALS):
        red, green, blue = map(float, rng.uniform(0.2, 0.9, 3))
        picture = {ROLES[0]: make_pictures(256, index)[ROLES[0]]}
        files.append(write_torus(folder / f"small_{index}.glb", grid, (red, green, blue), picture))
    places = [(0.05 + 0.03 * (index % 10), -0.03 + 0.035 * (index // 10), 0.012) for index in range(OBJECTS)]
    return {
        f"{count} materials": with_objects(
            frames,
            tuple(Object("mesh", file=files[index % count], at=at, scale=0.5) for index, at in enumerate(places)),
        )
        for count in (1, MATERIALS)
    }


def frame_timer(pipeline: Pipeline, frames: Clip) -> Callable[[], float]:
    """Warm a pipeline up; what it gives renders one frame and says its milliseconds."""
    image, pose = frames.images[0], frames.poses[0]
    for index in range(WARM_UP):
        pipeline(image, time_seconds=index / 24.0, pose=pose)
    scheduler, arrays = pipeline._scheduler, pipeline.arrays

    def touch() -> None:
        for name in ("frame", "pose", "clock"):
            arrays.touch(name)

    def on_host() -> float:
        touch()
        begin = time.process_time()
        scheduler.run()
        return (time.process_time() - begin) * 1e3

    if pipeline.device.is_cpu:
        return on_host
    stream = wp.get_stream(pipeline.device)
    begin, end = (wp.Event(pipeline.device, enable_timing=True) for _ in range(2))

    def on_device() -> float:
        touch()
        stream.record_event(begin)
        scheduler.run()
        stream.record_event(end)
        return float(wp.get_event_elapsed_time(begin, end))

    return on_device


def compare(part: str, cases: Mapping[str, Clip], device: str, runs: int, quality: str) -> None:
    """One line per case, in turn; the last says the ratio to the first."""
    timers, more = {}, {}
    with contextlib.ExitStack() as stack:
        for name, frames in cases.items():
            start = time.perf_counter()
            print(f"{part}, {name}: loading and compiling ...", file=sys.stderr, flush=True)
            pipeline = stack.enter_context(Pipeline(frames.scene, device=device, quality=quality))
            timers[name] = frame_timer(pipeline, frames)
            shown = int((pipeline.arrays["hit_object"].numpy() >= 0).sum())
            more[name] = {"start_s": round(time.perf_counter() - start, 1), "object_pixels": shown}
            if not shown:
                raise RuntimeError(f"{part}, {name}: no pixel shows an object; nothing would be measured.")
        times: dict[str, list[float]] = {name: [] for name in timers}
        for _ in range(runs):
            for name, timer in timers.items():
                times[name].append(timer())
    first = next(iter(times))
    for name, values in times.items():
        ratio = {} if name == first else {"over": first, "ratio": round(paired_ratio(times, name, first), 3)}
        report(f"{part} {name}", values, device, mean_ms=round(statistics.mean(values), 4), **more[name], **ratio)


def main(device: str, arguments: list[str] | None = None) -> None:
    """Print a line a case."""
    parser = argparse.ArgumentParser(prog="python -m bench textured")
    parser.add_argument("--part", choices=("all", "triangles", "objects"), default="all")
    parser.add_argument("--triangles", type=int, default=1_000_000)
    parser.add_argument("--texture", type=int, default=4096, help="rows and columns of each picture")
    parser.add_argument("--size", default="1920x1080")
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--quality", default="medium")
    options = parser.parse_args(arguments or [])
    width, height = map(int, options.size.split("x"))
    frames = clip("desk", (width, height), 2)
    with tempfile.TemporaryDirectory() as folder:
        if options.part in ("all", "triangles"):
            cases = triangle_cases(frames, Path(folder), options.triangles, options.texture)
            compare(f"{options.triangles} triangles", cases, device, options.runs, options.quality)
        if options.part in ("all", "objects"):
            compare(f"{OBJECTS} objects", object_cases(frames, Path(folder)), device, options.runs, options.quality)
