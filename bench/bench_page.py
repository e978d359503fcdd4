"""The page's first picture, cold and warm, and its memory over many changes of quality.

Parts, which ``WARP_AR_BENCH`` picks, separated by commas:

- ``start``: seconds from the command to the page's answer, to the camera's picture, to the first lit frame and to the
  first of the wanted quality, with no kernel compiled and again with all; and the longest time between two frames from
  the first lit one on, pipelines being built and swapped in meanwhile;
- ``memory``: resident memory after each preset has run once, and its growth over ``WARP_AR_BENCH_CHANGES`` changes of
  quality (default 1000), each waited for until its frames are lit.
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

PARTS = ("start", "memory")
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
