"""Kills a process at random moments while it writes, and looks at what it leaves.

    python -m tests.hostile.kill 50 [SINK ...]      # so often for each sink, or for those named; prints a table

Each attempt is a process that writes frames; half of them stand on what an earlier run left. It is forked from one that
has never started a thread: what a lock of this process's encoders is at that moment, taken or free, is not its matter.
"""

from __future__ import annotations

import contextlib
import faulthandler
import json
import multiprocessing
import os
import pathlib
import random
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from typing import NoReturn

import cv2
import numpy as np
import OpenEXR

from warp_ar.command_line import Terminated, ended_by_signals
from warp_ar.errors import WarpArError
from warp_ar.files import write_whole
from warp_ar.output.environment_file import read_environment
from warp_ar.output.layer_file import LayerFrame, LayerSink
from warp_ar.output.sinks import EnvironmentSink, open_sink
from warp_ar.sources.sources import open_source

SIZE = (96, 128)
FRAMES = 180
EARLIER = 40
"""Frames that an earlier run left, so many levels brighter."""
TOLERANCE = 3
"""Levels that a video may be off."""
PATIENCE = 120.0
"""Seconds within which a process ends that was told to."""
FORKS = multiprocessing.get_context("forkserver")
FORKS.set_forkserver_preload(["warp_ar.command_line", "warp_ar.output.layer_file", "warp_ar.sources.sources"])


def frame(index: int, brighter: int = 0) -> np.ndarray:
    """A flat picture whose level is its number; noise in a corner makes files of some size."""
    image = np.full((*SIZE, 3), brighter + index, np.uint8)
    image[:32, :32] = np.random.default_rng(index).integers(0, 256, (32, 32, 3))
    return image


def write_frames(place: pathlib.Path, count: int, brighter: int = 0) -> None:
    """Write a run's frames."""
    with EnvironmentSink(place) if place.name == "light" else open_sink(place, fps=24) as sink:
        for index in range(count):
            image = frame(index, brighter)
            sink.write(image.astype(np.float32) if place.name == "light" else image)


def layer_frame(index: int, brighter: int) -> LayerFrame:
    """A frame's layers: two, one of them as a picture besides."""
    image = frame(index, brighter)
    ids = np.full(SIZE, brighter + index, np.int32)
    return LayerFrame({"plate": image.astype(np.float32), "ids": ids}, image, ("a surface",))


def write_layers(place: pathlib.Path, count: int, brighter: int = 0) -> None:
    """Write a run's layers."""
    with LayerSink(place, pictures=("plate",)) as sink:
        for index in range(count):
            sink.write(layer_frame(index, brighter))


def check_layers(place: pathlib.Path, *, finished: bool) -> int:
    """Frames of which all layers are there; an error says what is not whole."""
    if not place.exists():
        assert not finished
        return 0
    paths = sorted(place.glob("????.exr"))
    found = []
    for path in paths:
        with OpenEXR.File(str(path)) as file:
            parts = {part.name(): part for part in file.parts}
            level = int(np.median(parts["ids"].channels["ids.I"].pixels)) - 1
            assert np.median(parts["plate"].channels["plate"].pixels) == level
        found.append(level)
    pictures = {path.stem: int(np.median(cv2.imread(str(path)))) for path in (place / "plate").glob("????.png")}
    brighter = EARLIER if found and found[0] - int(paths[0].stem) else 0
    assert found == [int(path.stem) + brighter for path in paths], found
    # A picture is written after its frame's other layers.
    assert pictures.items() <= {path.stem: level for path, level in zip(paths, found, strict=True)}.items()
    return len(found)


def write_reports(place: pathlib.Path, count: int, brighter: int = 0) -> None:
    """Write a report again and again, each time a longer one."""
    for index in range(count):
        write_whole(place, json.dumps({"program": "warp_ar", "run": brighter, "frames": [0] * (200 * index)}).encode())


def check_frames(place: pathlib.Path, *, finished: bool) -> int:
    """Frames that are there; an error says what is not whole."""
    if not place.exists():
        assert not finished
        return 0
    numbers = [int(path.stem) for path in sorted(place.glob("????.*"))] if place.is_dir() else None
    if place.name == "light":
        found = [float(np.median(read_environment(path))) for path in sorted(place.glob("????.exr"))]
    elif numbers == []:
        found = []
    else:
        with open_source(place) as source:
            found = [float(np.median(picture.image)) for picture in source]
    numbers = list(range(len(found))) if numbers is None else numbers
    # All of this run, or all of the earlier one.
    brighter = EARLIER if found and found[0] - numbers[0] > TOLERANCE else 0
    expected = [number + brighter for number in numbers]
    assert np.allclose(found, expected, rtol=0.0, atol=TOLERANCE), (found, expected)
    return len(found)


def check_report(place: pathlib.Path, *, finished: bool) -> int:
    """Whether there is a report, whole."""
    if not place.exists():
        assert not finished
        return 0
    assert json.loads(place.read_text())["program"] == "warp_ar"
    return 1


Writer = Callable[[pathlib.Path, int, int], None]
SINKS: dict[str, tuple[Writer, Callable[..., int]]] = {
    **dict.fromkeys(("clip.mp4", "clip.mov", "clip.mkv", "frames", "light"), (write_frames, check_frames)),
    "layers": (write_layers, check_layers),
    "run.json": (write_reports, check_report),
}


def write_until_told(name: str, place: pathlib.Path, begun: Connection) -> NoReturn:
    """Write a whole run in a process of its own, say that it has begun, and end as a command does."""
    # In a thread of C, so that a process that hangs says where, whoever holds Python's lock.
    faulthandler.dump_traceback_later(PATIENCE - 10.0)
    code = 1
    try:
        with ended_by_signals():
            begun.send(True)
            SINKS[name][0](place, FRAMES, 0)
            code = 0
    except Terminated:
        code = 143
    finally:
        os._exit(code)


def attempt(name: str, number: int, kind: signal.Signals, folder: pathlib.Path) -> int:
    """Kill one run; returns how many frames it left.

    Raises:
        AssertionError: It did not end, or what it left is not whole.
    """
    chance = random.Random(f"{name} {number}")
    write, check = SINKS[name]
    place = folder / name
    if number % 2:
        write(place, EARLIER, EARLIER)
    begins, begun = FORKS.Pipe(duplex=False)
    child = FORKS.Process(target=write_until_told, args=(name, place, begun))
    child.start()
    begun.close()
    begins.recv()
    time.sleep(chance.uniform(0.0, 0.5))
    with contextlib.suppress(ProcessLookupError):  # it has written all there is
        os.kill(child.pid, kind)
    child.join(PATIENCE)
    if child.exitcode is None:
        child.kill()
        raise AssertionError(f"it did not end within {PATIENCE:g} s")
    assert child.exitcode in (0, -kind if kind == signal.SIGKILL else 143), child.exitcode
    count = check(place, finished=bool(number % 2))
    if kind == signal.SIGTERM:
        assert not list(folder.rglob(".*")), "a file that was being written was left"
    return count


def main(times: int, names: Sequence[str] = tuple(SINKS)) -> int:
    """Kill each sink so often by either signal; prints what held, and returns 1 if anything did not."""
    failed = 0
    print("| sink | signal | kills | whole | frames left, least to most |\n| --- | --- | --: | --: | --: |")
    for name in names:
        for kind in (signal.SIGKILL, signal.SIGTERM):
            counts = []
            for number in range(times):
                with tempfile.TemporaryDirectory() as folder:
                    try:
                        counts.append(attempt(name, number, kind, pathlib.Path(folder)))
                    except (AssertionError, WarpArError, ValueError) as error:
                        print(f"{name} {kind.name} {number}: {error}", file=sys.stderr)
            failed += times - len(counts)
            span = f"{min(counts, default=0)} to {max(counts, default=0)}"
            print(f"| {name} | {kind.name} | {times} | {len(counts)} | {span} |", flush=True)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), sys.argv[2:] or tuple(SINKS)))
