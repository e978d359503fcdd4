"""The page's first picture, cold and warm, and its memory over many changes of quality.

Parts, which ``WARP_AR_BENCH`` picks, separated by commas:

- ``start``: seconds from the command to the page's answer, to the camera's picture, to the first lit frame and to the
  first of the wanted quality, with no kernel compiled and again with all; and the longest time between two frames from
  the first lit one on, pipelines being built and swapped in meanwhile;
- ``memory``: resident memory after each preset has run once, and its growth over ``WARP_AR_BENCH_CHANGES`` changes of
  quality (default 1000), each waited for until its frames are lit;
- ``visits``: the same over pages that are opened and closed for ``WARP_AR_BENCH_SECONDS`` (default 3600), as a chart
  where ``WARP_AR_BENCH_PLOT`` names an SVG, ``WARP_AR_BENCH_PAUSE`` seconds (default 0) between two. A visit loads the
  page and what it names, looks at some frames and goes: with a word, or cut off; every third by two viewers at once,
  every fifth turns the quality.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import os
import re
import signal
import struct
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import aiohttp

from bench.common import commit
from warp_ar.accuracy.charts import lines, stand_alone

PARTS = ("start", "memory", "visits")
SECONDS = float(os.environ.get("WARP_AR_BENCH_SECONDS", "3600"))
PAUSE = float(os.environ.get("WARP_AR_BENCH_PAUSE", "0"))
VISIT_FRAMES = 12
SETTLED_VISITS = 20
"""Visits before memory counts: every quality has run, and every part of the page has been sent."""
SAMPLES = 200
"""Points of the chart."""
CHANGES = int(os.environ.get("WARP_AR_BENCH_CHANGES", "1000"))
QUALITIES = ("low", "medium", "paper")
START_SECONDS = 300.0
SWAPPED_FRAMES = 60
"""Frames of the wanted quality that are still looked at."""
EVERY = 50


@contextlib.contextmanager
def served(device: str, quality: str, **environment: str) -> Iterator[tuple[str, int, float]]:
    """A server of its own: its address, its process and when it was started."""
    command = [sys.executable, "-m", "warp_ar.live", "desk", "--device", device, "--quality", quality]
    begun = time.monotonic()
    with subprocess.Popen(
        [*command, "--port", "0", "--no-browser"],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, **environment},
    ) as process:
        try:
            assert process.stdout is not None
            found = re.search(r"http://\S+", process.stdout.readline())
            if found is None:
                raise RuntimeError("the server did not start")
            yield found[0], process.pid, begun
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(20)


@contextlib.asynccontextmanager
async def viewer(url: str) -> AsyncIterator[aiohttp.ClientWebSocketResponse]:
    """A viewer's connection."""
    async with (
        aiohttp.ClientSession() as session,
        session.ws_connect(f"{url}live", max_msg_size=1 << 24) as socket,
    ):
        yield socket


async def hear(socket: aiohttp.ClientWebSocketResponse) -> dict[str, Any]:
    """The next message; frames are acknowledged at once."""
    message = await asyncio.wait_for(socket.receive(), START_SECONDS)
    if message.type is aiohttp.WSMsgType.TEXT:
        return dict(json.loads(message.data))
    if message.type is not aiohttp.WSMsgType.BINARY:
        raise RuntimeError(f"the server dropped a good viewer: {message}")
    (length,) = struct.unpack_from("<I", message.data)
    header = dict(json.loads(message.data[4 : 4 + length]))
    if header["type"] == "frame":
        await socket.send_str(json.dumps({"type": "ack", "id": header["id"]}))
    return header


async def start(url: str, begun: float, quality: str) -> dict[str, Any]:
    """When what came, in seconds from the command."""
    found: dict[str, Any] = {"command_s": time.monotonic() - begun}
    with urllib.request.urlopen(url) as answer:
        answer.read()
    found["page_s"] = time.monotonic() - begun
    qualities: dict[int, str] = {}
    taken: list[float] = []
    wanted = 0
    async with viewer(url) as socket:
        while wanted < SWAPPED_FRAMES:
            message = await hear(socket)
            if message["type"] == "plan":
                qualities[message["plan"]] = message["quality"]
            if message["type"] != "frame":
                continue
            now, plan = time.monotonic() - begun, message["plan"]
            found.setdefault("camera_s", now)
            if plan:
                found.setdefault("lit_s", now)
                taken.append(message["taken"])
            if qualities.get(plan) == quality:
                found.setdefault("wanted_s", now)
                wanted += 1
    gaps = [after - before for before, after in itertools.pairwise(taken)]
    return {
        **{name: round(value, 2) for name, value in found.items()},
        "longest_gap_ms": round(max(gaps)),
        "gaps_over_100_ms": sum(gap > 100.0 for gap in gaps),
        "frames": len(taken),
    }


def resident_mb(pid: int) -> float:
    """Resident memory of a process; not a number where the system does not tell."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    except OSError:
        return float("nan")
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


async def change(socket: aiohttp.ClientWebSocketResponse, quality: str, frames: int = 3) -> None:
    """Go over to a quality, and wait until frames are lit by it."""
    await socket.send_str(json.dumps({"type": "quality", "name": quality}))
    plans: set[int] = set()
    while frames:
        message = await hear(socket)
        if message["type"] == "plan" and message["quality"] == quality:
            plans.add(message["plan"])
        frames -= message["type"] == "frame" and message["plan"] in plans


async def memory(url: str, pid: int) -> dict[str, Any]:
    """Memory over changes of quality."""
    async with viewer(url) as socket:
        while (await hear(socket)).get("quality") != QUALITIES[0]:
            pass
        for quality in (*QUALITIES[1:], *QUALITIES):
            await change(socket, quality)
        first = resident_mb(pid)
        seen = []
        for count in range(CHANGES):
            await change(socket, QUALITIES[count % len(QUALITIES)])
            if count % EVERY == EVERY - 1:
                seen.append(round(resident_mb(pid)))
    last = resident_mb(pid)
    return {
        "changes": CHANGES,
        "start_mb": round(first),
        "end_mb": round(last),
        "ratio": round(last / first, 3),
        f"mb_every_{EVERY}": seen,
        "asked": "at most 1.3 times the start",
    }


async def load_page(session: aiohttp.ClientSession, url: str) -> None:
    """Fetch the page and every script, style and picture that it names."""
    async with session.get(url) as answer:
        text = await answer.text()
    for name in set(re.findall(r'(?:src|href)="([^":#]+)"', text)):
        async with session.get(url + name.lstrip("/")) as answer:
            await answer.read()


async def look(session: aiohttp.ClientSession, url: str, quality: str, *, polite: bool) -> None:
    """One viewer: some frames, then gone."""
    socket = await session.ws_connect(f"{url}live", max_msg_size=1 << 24)
    if quality:
        await change(socket, quality)
    frames = 0
    while frames < VISIT_FRAMES:
        frames += (await hear(socket))["type"] == "frame"
    if polite:
        await socket.close()
    else:
        connection = socket.get_extra_info("transport") or socket._response.connection.transport
        connection.abort()


async def visit(url: str, number: int) -> None:
    """Open the page, look, and close it."""
    async with aiohttp.ClientSession() as session:
        await load_page(session, url)
        quality = QUALITIES[number // 5 % len(QUALITIES)] if number % 5 == 0 else ""
        viewers = [look(session, url, quality, polite=number % 2 == 0)]
        if number % 3 == 0:
            viewers.append(look(session, url, "", polite=number % 4 == 0))
        await asyncio.gather(*viewers)


async def visits(url: str, pid: int) -> dict[str, Any]:
    """Memory while pages come and go."""
    begun, taken = time.monotonic(), []
    number = 0
    while time.monotonic() - begun < SECONDS:
        await visit(url, number)
        number += 1
        taken.append((time.monotonic() - begun, number, resident_mb(pid), open_files(pid), threads_of(pid)))
        await asyncio.sleep(PAUSE)
    settled = taken[min(SETTLED_VISITS, len(taken) - 1) :]
    shown = settled[:: -(-len(settled) // SAMPLES)]
    if plot := os.environ.get("WARP_AR_BENCH_PLOT"):
        minutes, memory_mb = [row[0] / 60.0 for row in shown], [row[2] for row in shown]
        chart = lines([("resident memory", minutes, memory_mb)], "minutes of pages opened and closed", "MB")
        Path(plot).write_text(stand_alone(chart), encoding="utf-8")
    memory_mb = [row[2] for row in settled]
    return {
        "seconds": round(taken[-1][0]),
        "visits": number,
        "start_mb": round(memory_mb[0]),
        "end_mb": round(memory_mb[-1]),
        "most_mb": round(max(memory_mb)),
        "ratio": round(memory_mb[-1] / memory_mb[0], 3),
        "most_ratio": round(max(memory_mb) / memory_mb[0], 3),
        "files": [settled[0][3], settled[-1][3]],
        "threads": [settled[0][4], settled[-1][4]],
        "asked": "at most 1.3 times the start",
    }


def open_files(pid: int) -> int:
    """Files and sockets that a process has open; -1 where the system does not tell."""
    try:
        return len(os.listdir(f"/proc/{pid}/fd"))
    except OSError:
        return -1


def threads_of(pid: int) -> int:
    """Threads of a process; -1 where the system does not tell."""
    try:
        return len(os.listdir(f"/proc/{pid}/task"))
    except OSError:
        return -1


def _print(case: str, device: str, figures: dict[str, Any]) -> None:
    print(json.dumps({"case": case, "device": device, "commit": commit(), **figures}), flush=True)


def main(device: str) -> None:
    """Run the parts."""
    parts = os.environ.get("WARP_AR_BENCH", ",".join(PARTS)).split(",")
    if "start" in parts:
        with tempfile.TemporaryDirectory() as cache:
            for case in ("cold", "warm"):
                with served(device, "medium", WARP_CACHE_PATH=cache) as (url, _, begun):
                    _print(f"start, {case}", device, asyncio.run(start(url, begun, "medium")))
    if "memory" in parts:
        with served(device, QUALITIES[0]) as (url, pid, _):
            _print("memory", device, asyncio.run(memory(url, pid)))
    if "visits" in parts:
        with served(device, QUALITIES[0]) as (url, pid, _):
            _print("visits", device, asyncio.run(visits(url, pid)))
