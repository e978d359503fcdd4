"""The live page on the bundled desk: frames per second, latency, growth of memory and latency, hostile clients.

Server and clients share this machine. Parts, selected by ``WARP_AR_BENCH``, separated by commas:

- ``serve``: clients without a browser, called light clients. Cases: one client; three clients; one with another that
  reads nothing; one with another that sends invalid messages.
- ``clip`` and ``camera``: Chromium shows the clip, then frames of its own simulated camera. A time code in the picture
  identifies the frame on the screen, from which its latency follows. This needs playwright and Chromium.

``WARP_AR_BENCH_SECONDS`` is the duration of each of the six cases (default 10; 600 to test for growth over ten
minutes). Each case takes 15 seconds in addition.
"""

from __future__ import annotations

import asyncio
import collections
import contextlib
import dataclasses
import itertools
import json
import os
import random
import re
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
import cv2
import numpy as np

from bench.common import find_chromium, report
from tests.viewer_rig import mutated
from warp_ar.output.video_sink import VideoSink
from warp_ar.scene import SourceSpec, dumps_scene, load_scene
from warp_ar.sources.sources import open_source
from warp_ar.viewer.protocol import ProtocolError, parse_text

SECONDS = float(os.environ.get("WARP_AR_BENCH_SECONDS", "10"))
WARM_SECONDS = 5.0
PARTS = ("serve", "clip", "camera")
START_SECONDS = 120.0
FUZZ_MESSAGES = 10_000
BITS, CELL = 7, 12  # the time code: the frame's number as squares along the bottom edge
FRAMES = 96  # of the clip that are played in a loop

TARGETS = {
    "serve, 1 light client": "20 fps",
    "clip": "10 fps shown, 250 ms",
    "camera": "10 fps shown, 400 ms",
}


def mark(image: np.ndarray, number: int) -> np.ndarray:
    """Return a picture with its number as a time code."""
    image = image.copy()
    for bit in range(BITS):
        image[-CELL:, bit * CELL : (bit + 1) * CELL] = 255 * (number >> bit & 1)
    return image


def write_coded_desk(folder: Path) -> tuple[Path, Path]:
    """Write the bundled desk with time codes; return its scene file, and its clip for Chromium's simulated camera."""
    scene = load_scene("desk")
    assert scene.source is not None
    assert scene.source.path is not None
    with (
        open_source(scene.source.path) as source,
        VideoSink(folder / "coded.mp4", fps=source.fps) as video,
        (folder / "camera.mjpeg").open("wb") as camera,
    ):
        for frame, number in zip(source, range(FRAMES), strict=False):
            image = mark(frame.image, number)
            video.write(image)
            camera.write(cv2.imencode(".jpg", image[..., ::-1], (cv2.IMWRITE_JPEG_QUALITY, 95))[1].tobytes())
    coded = dataclasses.replace(scene, source=SourceSpec(path=folder / "coded.mp4"), name="desk")
    (folder / "desk.toml").write_text(dumps_scene(coded))
    return folder / "desk.toml", folder / "camera.mjpeg"


# ---------------------------------------------------------------------------------------------------------- the server


def descendants(pid: int) -> Iterator[int]:
    """Yield the ids of the processes that a process has started, directly or indirectly."""
    with contextlib.suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            for child in (task / "children").read_text().split():
                yield int(child)
                yield from descendants(int(child))


@dataclasses.dataclass
class Served:
    """Server process."""

    url: str
    """Address of its page."""
    pid: int
    """Process id."""

    def resident_mb(self) -> float:
        """Return the server's resident memory in MB; NaN if the system does not state it."""
        try:
            pages = int(Path(f"/proc/{self.pid}/statm").read_text().split()[1])
        except OSError:
            return float("nan")
        return pages * os.sysconf("SC_PAGE_SIZE") / 1e6

    def cpu_seconds(self) -> float:
        """Return the processor time that the server has used."""
        return _cpu_seconds(self.pid)


def _cpu_seconds(pid: int) -> float:
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@contextlib.contextmanager
def served(device: str, scene: str = "desk") -> Iterator[Served]:
    """Context with a running server, which is ended on exit."""
    command = [sys.executable, "-m", "warp_ar.live", scene, "--device", device, "--port", "0", "--no-browser"]
    with (
        tempfile.TemporaryFile("w+") as errors,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True) as process,
    ):
        try:
            assert process.stdout is not None
            found = re.search(r"http://\S+", process.stdout.readline())
            if found is None:
                errors.seek(0)
                raise RuntimeError(f"the server did not start: {errors.read()}")
            yield Served(found[0], process.pid)
        finally:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(20)
            except subprocess.TimeoutExpired:
                process.kill()


@dataclasses.dataclass
class Growth:
    """Growth of memory and latency over a case: the median of the last third minus that of the first."""

    server: Served
    """The measured server."""
    memory: list[float] = dataclasses.field(default_factory=list)
    """Samples of resident memory, MB."""
    latency: list[tuple[float, float]] = dataclasses.field(default_factory=list)
    """Time of measurement, and latency in milliseconds."""
    cpu: float = 0.0
    """Processor time of the server at the start, seconds."""
    start: float = 0.0
    """Time of the start, seconds."""

    def begin(self) -> None:
        """Start the measurement."""
        self.memory.clear()
        self.latency.clear()
        self.cpu, self.start = self.server.cpu_seconds(), time.monotonic()

    def sample(self) -> None:
        """Store the present memory; call this at regular intervals."""
        self.memory.append(self.server.resident_mb())

    def figures(self, frames: int) -> dict[str, Any]:
        """Return the figures for the report: frames per second, processor time, memory and growth."""
        cpu = self.server.cpu_seconds() - self.cpu
        figures: dict[str, Any] = {
            "fps": round(frames / (time.monotonic() - self.start), 2),
            "server_cpu_ms_per_frame": round(1e3 * cpu / max(frames, 1), 1),
        }
        third = len(self.memory) // 3
        if third:
            grown = statistics.median(self.memory[-third:]) - statistics.median(self.memory[:third])
            figures |= {"memory_mb": round(self.memory[-1]), "grown_mb": round(grown, 1)}
        third = len(self.latency) // 3
        if third:
            delays = [delay for _, delay in self.latency]
            drift = statistics.median(delays[-third:]) - statistics.median(delays[:third])
            figures["latency_grown_ms"] = round(drift, 1)
        return figures


# -------------------------------------------------------------------------------------------------------- light clients


async def view(growth: Growth, seconds: float, *, reads: bool = True, counts: bool = False) -> dict[str, Any]:
    """Run a client without a browser and return its figures.

    Args:
        growth: Measurement of the server.
        seconds: Duration after the warm-up.
        reads: False for a client that only keeps its connection open.
        counts: True if this client's frames are measured by ``growth``.
    """
    delays: list[float] = []
    frames, begun, plan = 0, False, 0
    start = time.monotonic()
    async with (
        aiohttp.ClientSession() as session,
        session.ws_connect(f"{growth.server.url}live", max_msg_size=1 << 24) as socket,
    ):
        while time.monotonic() - start < WARM_SECONDS + seconds:
            if not reads:
                await asyncio.sleep(0.1)
                continue
            with contextlib.suppress(TimeoutError):
                message = await asyncio.wait_for(socket.receive(), 1.0)
                if message.type in (aiohttp.WSMsgType.CLOSED, aiohttp.WSMsgType.CLOSE, aiohttp.WSMsgType.ERROR):
                    raise RuntimeError(f"the server dropped a good client: {message}")
                if message.type is not aiohttp.WSMsgType.BINARY:
                    continue
                (length,) = struct.unpack_from("<I", message.data)
                header = json.loads(message.data[4 : 4 + length])
                if header["type"] != "frame":
                    continue
                await socket.send_str(json.dumps({"type": "ack", "id": header["id"]}))
                now = time.monotonic()
                if header["plan"] != plan:
                    # A new pipeline lights the frames; those before it are not counted.
                    plan, start, begun, frames = header["plan"], now, False, 0
                    delays.clear()
                if now - start < WARM_SECONDS:
                    continue
                if not begun:
                    begun = True
                    if counts:
                        growth.begin()
                frames += 1
                # The monotonic clock is common to both processes.
                delays.append(1e3 * now - header["taken"])
                if counts:
                    growth.latency.append((now, delays[-1]))
                    if frames % 20 == 0:
                        growth.sample()
    return {"delays": delays, **(growth.figures(frames) if counts else {"fps": round(frames / seconds, 2)})}


async def fuzz(url: str, stop: asyncio.Event) -> int:
    """Send invalid messages until ``stop`` is set, each by a new connection; return their number."""
    rng, count = random.Random(0), 0
    async with aiohttp.ClientSession() as session:
        while not stop.is_set() and count < FUZZ_MESSAGES:
            message = mutated(rng)
            with contextlib.suppress(ProtocolError):
                if isinstance(message, str):
                    parse_text(message)
                    continue  # a valid message would change the scene that is measured
            count += 1
            with contextlib.suppress(aiohttp.ClientError, ConnectionError):
                async with session.ws_connect(f"{url}live", max_msg_size=1 << 24) as socket:
                    await (socket.send_str(message) if isinstance(message, str) else socket.send_bytes(message))
                    async for _ in socket:
                        pass
    return count


async def serving(device: str, case: str, server: Served) -> None:
    """Run and report a case of the part ``serve``."""
    growth = Growth(server)
    first = view(growth, SECONDS, counts=True)
    extra: dict[str, Any] = {}
    if case == "3 light clients":
        results = await asyncio.gather(first, *(view(growth, SECONDS) for _ in range(2)))
        extra["each_fps"] = [result["fps"] for result in results]
    elif case == "1 beside one that reads nothing":
        results = await asyncio.gather(first, view(growth, SECONDS, reads=False))
    elif case == "1 beside a hostile one":
        stop = asyncio.Event()
        hostile = asyncio.create_task(fuzz(server.url, stop))
        results = [await first]
        stop.set()
        extra["bad_messages"] = await hostile
    else:
        results = [await first]
    figures = results[0]
    delays = figures.pop("delays")
    _report(f"serve, {case}", delays, device, **figures, **extra)


def _report(case: str, delays: list[float], device: str, **figures: Any) -> None:
    if not delays:
        print(json.dumps({"case": case, "failed": "no frame came"}), flush=True)
        return
    wanted = {"asked": TARGETS[case]} if case in TARGETS else {}
    report(case, delays, device, **wanted, of="milliseconds from source to client", **figures)


# ---------------------------------------------------------------------------------------------------------- the browser

# Records the number of the frame on the canvas, and of that in the camera's picture, with their times.
WATCH = f"""() => {{
  if (window.bench) return;  // from an earlier case
  const strip = document.createElement("canvas").getContext("2d", {{ willReadFrequently: true }});
  strip.canvas.width = {BITS * CELL}; strip.canvas.height = 1;
  const read = (picture, height) => {{
    strip.drawImage(picture, 0, height - {CELL // 2}, {BITS * CELL}, 1, 0, 0, {BITS * CELL}, 1);
    const data = strip.getImageData(0, 0, {BITS * CELL}, 1).data;
    let code = 0;
    for (let bit = 0; bit < {BITS}; bit++) if (data[4 * (bit * {CELL} + {CELL // 2})] > 128) code |= 1 << bit;
    return code;
  }};
  window.bench = {{ shown: [], taken: [] }};
  const canvas = document.getElementById("canvas"), video = document.getElementById("video");
  warpAr.view.addEventListener("shown", ({{ detail }}) => {{
    const code = read(canvas, canvas.height);
    requestAnimationFrame(() => bench.shown.push([code, detail.id, detail.taken, performance.timeOrigin + performance.now(), detail.state]));
  }});
  const next = (now, about) => {{
    bench.taken.push([read(video, video.videoHeight), performance.timeOrigin + (about.captureTime ?? now)]);
    video.requestVideoFrameCallback(next);
  }};
  video.requestVideoFrameCallback(next);
}}"""  # noqa: E501


def clip_delays(shown: list[list[Any]], wall: float) -> list[float]:
    """Return the milliseconds from source to screen of the clip's frames.

    Args:
        shown: For each shown frame: code on the screen, the header's id and time of the source (the server's monotonic
            clock), time on the screen (wall clock), state of the marker.
        wall: Wall clock minus monotonic clock, milliseconds.
    """
    # Frames are used only if the code on the screen is that of the header, which a faulty page might confuse.
    return [at - (taken + wall) for code, id, taken, at, _ in shown if code == (id - 1) % FRAMES]


def camera_delays(shown: list[list[Any]], taken: list[list[float]]) -> list[float]:
    """Return the milliseconds from camera to screen: from the time when the camera last gave the code on the screen.

    Args:
        shown: For each shown frame, five values of which the code and the time on the screen are used.
        taken: Code and time of each frame of the camera.
    """
    times: dict[int, list[float]] = collections.defaultdict(list)
    for code, at in taken:
        times[int(code)].append(at)
    delays = []
    for code, _, _, at, _ in shown:
        before = [time for time in times[int(code)] if time <= at]
        if before:
            delays.append(at - before[-1])
    return delays


@contextlib.contextmanager
def browsing(camera: Path, server: Served) -> Iterator[Any]:
    """Context with the page in Chromium, whose simulated camera plays a file; None without playwright and Chromium."""
    chromium = find_chromium()
    if chromium is None:
        yield None
        return
    from playwright.sync_api import sync_playwright

    fake = ["--use-fake-ui-for-media-stream", "--use-fake-device-for-media-stream"]
    with sync_playwright() as driver:
        browser = driver.chromium.launch(
            executable_path=chromium, args=["--no-sandbox", *fake, f"--use-file-for-fake-video-capture={camera}"]
        )
        page = browser.new_context(permissions=["camera"]).new_page()
        page.goto(server.url)
        deadline = time.monotonic() + START_SECONDS
        while not page.evaluate("!!window.warpAr && warpAr.view.stats.shown > 5"):
            if time.monotonic() > deadline:
                raise RuntimeError("the page shows nothing")
            page.wait_for_timeout(100)
        yield page
        browser.close()


def showing(device: str, case: str, page: Any, server: Served) -> None:
    """Run and report the case ``clip`` or ``camera`` in Chromium."""
    if case == "camera":
        page.click("#use-camera")
    page.wait_for_timeout(1e3 * WARM_SECONDS)
    page.evaluate(WATCH)
    page.wait_for_timeout(1e3)
    growth = Growth(server)
    children = lambda: sum(map(_cpu_seconds, descendants(os.getpid()))) - server.cpu_seconds()  # noqa: E731
    page.evaluate("bench.shown.length = 0")
    growth.begin()
    browser_cpu = children()
    while time.monotonic() - growth.start < SECONDS:
        page.wait_for_timeout(500)
        growth.sample()
    shown, taken = page.evaluate("[bench.shown, bench.taken]")
    browser_cpu = children() - browser_cpu
    wall = 1e3 * (time.time() - time.monotonic())
    delays = clip_delays(shown, wall) if case == "clip" else camera_delays(shown, taken)
    growth.latency = [(0.0, delay) for delay in delays]
    # A picture that is shown twice counts once.
    new = sum(before[0] != after[0] for before, after in itertools.pairwise(shown))
    _report(
        case,
        delays,
        device,
        **growth.figures(new),
        shown_twice=len(shown) - 1 - new,
        browser_cpu_ms_per_frame=round(1e3 * browser_cpu / max(new, 1), 1),
        tracked=round(sum(frame[4] == "tracked" for frame in shown) / max(len(shown), 1), 3),
        unread_codes=len(shown) - len(delays),
        page_says_ms=round(page.evaluate("warpAr.view.stats.latency") or 0.0, 1),
    )


def main(device: str) -> None:
    parts = set(filter(None, os.environ.get("WARP_AR_BENCH", "").split(","))) or set(PARTS)
    cases = ["1 light client", "3 light clients", "1 beside one that reads nothing", "1 beside a hostile one"]
    runs = len(cases) * ("serve" in parts) + ("clip" in parts) + ("camera" in parts)
    took = runs * (SECONDS + 15)
    print(json.dumps({"parts": sorted(parts), "takes_minutes": round(took / 60, 1)}), flush=True)
    if "serve" in parts:
        for case in cases:
            with served(device) as server:
                asyncio.run(serving(device, case, server))
    shown = [case for case in ("clip", "camera") if case in parts]
    if not shown:
        return
    with tempfile.TemporaryDirectory() as folder:
        scene, camera = write_coded_desk(Path(folder))
        with served(device, str(scene)) as server, browsing(camera, server) as page:
            for case in shown if page is not None else []:
                showing(device, case, page, server)
