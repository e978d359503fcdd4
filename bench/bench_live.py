"""The live page on the bundled desk: what pictures cost to pack, frames per second served and shown, latency, memory.

Server and viewers share this machine. ``WARP_AR_BENCH_SECONDS`` sets how long each case runs (default 10; 600 for ten
minutes without growth); the browser's cases need playwright and Chromium and are left out, saying so, without them.
"""

from __future__ import annotations

import asyncio
import contextlib
import fractions
import json
import os
import random
import re
import shutil
import signal
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import aiohttp
import av
import cv2
import numpy as np

from bench.common import measure, report
from warp_ar.scene import load_scene
from warp_ar.sources import open_source
from warp_ar.viewer.server import encode_jpeg

SECONDS = float(os.environ.get("WARP_AR_BENCH_SECONDS", "10"))
WARM_SECONDS = 4.0
FUZZ_MESSAGES = 10_000  # at most


class X264:
    """H.264 as a live encoder would make it: no frame held back."""

    def __init__(self, width: int, height: int) -> None:
        self._codec: Any = av.CodecContext.create("libx264", "w")
        self._codec.width, self._codec.height, self._codec.pix_fmt = width, height, "yuv420p"
        self._codec.time_base, self._codec.thread_count = fractions.Fraction(1, 30), 1
        self._codec.options = {"preset": "ultrafast", "tune": "zerolatency", "crf": "23"}
        self._count = 0

    def __call__(self, image: np.ndarray) -> int:
        """Bytes of one frame."""
        frame = av.VideoFrame.from_ndarray(image, format="rgb24").reformat(format="yuv420p")
        frame.pts = self._count
        self._count += 1
        return sum(packet.size for packet in self._codec.encode(frame))


def transport() -> None:
    """JPEG against H.264: milliseconds to pack a frame, and its bytes."""
    with open_source(load_scene("desk").source.path) as source:  # type: ignore[union-attr, arg-type]
        images = [frame.image for frame, _ in zip(source, range(48), strict=False)]
    height, width = images[0].shape[:2]
    turns = {"jpeg": 0, "h264": 0}
    sizes: dict[str, list[int]] = {"jpeg": [], "h264": []}
    x264 = X264(width, height)
    packers = {"jpeg": lambda image: len(encode_jpeg(image)), "h264": x264}

    def pack(name: str) -> None:
        sizes[name].append(packers[name](images[turns[name] % len(images)]))
        turns[name] += 1

    times = measure({name: (lambda name=name: pack(name)) for name in packers}, "cpu", runs=96)  # type: ignore[misc]
    for name in packers:
        report(f"pack {width}x{height} {name}", times[name], "cpu", bytes=statistics.median(sizes[name]))


@contextlib.contextmanager
def served(device: str, *options: str) -> Iterator[tuple[str, int]]:
    """Address and process id of a server of its own."""
    command = [
        sys.executable,
        "-m",
        "warp_ar.live",
        "desk",
        "--device",
        device,
        "--port",
        "0",
        "--no-browser",
        *options,
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        found = re.search(r"http://\S+", process.stdout.readline())
        assert found, "the server did not start"
        try:
            yield found[0], process.pid
        finally:
            process.send_signal(signal.SIGINT)


def resident_mb(pid: int) -> float | None:
    """Resident memory of a process in MB; None where the system does not tell."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    except OSError:
        return None
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


async def view(url: str, seconds: float, *, show: bool = True) -> list[float]:
    """Milliseconds between frames at a light viewer, warm-up left out; one that shows nothing never acknowledges."""
    gaps: list[float] = []
    start = last = time.monotonic()
    async with aiohttp.ClientSession() as session, session.ws_connect(f"{url}live", max_msg_size=1 << 24) as socket:
        while time.monotonic() - start < seconds:
            try:
                message = await asyncio.wait_for(socket.receive(), 1.0)
            except TimeoutError:
                continue
            if message.type is not aiohttp.WSMsgType.BINARY:
                continue
            (length,) = struct.unpack_from("<I", message.data)
            header = json.loads(message.data[4 : 4 + length])
            if header["type"] != "frame" or not show:
                continue
            await socket.send_str(json.dumps({"type": "ack", "id": header["id"]}))
            now = time.monotonic()
            if now - start > WARM_SECONDS:
                gaps.append((now - last) * 1e3)
            last = now
    return gaps


async def fuzz(url: str, stop: asyncio.Event) -> int:
    """Send bad messages until told to stop, coming back after each, for each costs the connection; returns how many."""
    from tests.test_viewer import is_refused, mutated

    rng, count = random.Random(0), 0
    async with aiohttp.ClientSession() as session:
        while not stop.is_set() and count < FUZZ_MESSAGES:
            message = mutated(rng)
            if not is_refused(message):
                continue  # it would be done, and the scene would no longer be the one that is measured
            count += 1
            with contextlib.suppress(aiohttp.ClientError, ConnectionError):
                async with session.ws_connect(f"{url}live", max_msg_size=1 << 24) as socket:
                    await (socket.send_str(message) if isinstance(message, str) else socket.send_bytes(message))
                    async for _ in socket:
                        pass
    return count


async def serving(device: str, case: str, url: str, pid: int) -> None:
    before = resident_mb(pid)
    if case == "1 viewer":
        results = [await view(url, WARM_SECONDS + SECONDS)]
    elif case == "3 viewers":
        results = list(await asyncio.gather(*(view(url, WARM_SECONDS + SECONDS) for _ in range(3))))
    elif case == "and one that reads nothing":
        duration = WARM_SECONDS + SECONDS
        results = (await asyncio.gather(view(url, duration), view(url, duration, show=False)))[:1]
    else:
        stop = asyncio.Event()
        hostile = asyncio.create_task(fuzz(url, stop))
        results = [await view(url, WARM_SECONDS + SECONDS)]
        stop.set()
        case = f"and one that sends {await hostile} bad messages"
    for gaps in results:
        after = resident_mb(pid)
        grown = None if before is None or after is None else round(after - before, 1)
        fps = round(1e3 * len(gaps) / max(sum(gaps), 1e-9), 2)
        report(f"serve desk, {case}", gaps, device, fps=fps, grown_mb=grown)


def write_camera(path: Path) -> None:
    """The desk's clip as Chromium's fake camera plays it."""
    with open_source(load_scene("desk").source.path) as source, path.open("wb") as file:  # type: ignore[union-attr, arg-type]
        for frame in source:
            file.write(cv2.imencode(".jpg", frame.image[..., ::-1], (cv2.IMWRITE_JPEG_QUALITY, 95))[1].tobytes())


def browsing(device: str) -> None:
    """Frames shown and latency from source to screen, in Chromium on the same machine."""
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        chromium = None
    if chromium is None:
        print(json.dumps({"case": "browser", "left_out": "needs playwright and Chromium"}))
        return
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as driver, served(device) as (url, pid):
        path = Path(folder) / "camera.mjpeg"
        write_camera(path)
        fake = ["--use-fake-ui-for-media-stream", "--use-fake-device-for-media-stream"]
        browser = driver.chromium.launch(
            executable_path=chromium, args=["--no-sandbox", *fake, f"--use-file-for-fake-video-capture={path}"]
        )
        context = browser.new_context(permissions=["camera"])
        page = context.new_page()
        page.goto(url)
        for case in ("clip", "camera"):
            if case == "camera":
                page.click("#use-camera")
            page.wait_for_timeout(1e3 * WARM_SECONDS)
            before, count, start = resident_mb(pid), page.evaluate("warpAr.view.stats.shown"), time.monotonic()
            latencies = []
            while time.monotonic() - start < SECONDS:
                page.wait_for_timeout(250)
                latencies.append(page.evaluate("warpAr.view.stats.latency") or 0.0)
            fps = (page.evaluate("warpAr.view.stats.shown") - count) / (time.monotonic() - start)
            after = resident_mb(pid)
            third = len(latencies) // 3
            report(
                f"browser {case}, latency",
                latencies,
                device,
                fps=round(fps, 2),
                latency_drift=round(statistics.median(latencies[-third:]) - statistics.median(latencies[:third]), 1),
                grown_mb=None if before is None or after is None else round(after - before, 1),
            )
        browser.close()


def main(device: str) -> None:
    transport()
    for case in ("1 viewer", "3 viewers", "and one that reads nothing", "hostile"):
        with served(device) as (url, pid):
            asyncio.run(serving(device, case, url, pid))
    browsing(device)
