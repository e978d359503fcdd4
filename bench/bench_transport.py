"""Ways of frames between program and page: JPEG over a WebSocket, H.264 over a WebSocket with WebCodecs, WebRTC.

First each codec by itself: processor time of server and page for one 640x480 frame each way, its bytes and how much of
the picture is lost. Then each way from end to end in Chromium on this machine: ``WARP_AR_BENCH_SECONDS`` (default 10)
of the bundled clip at 24 frames a second, latency by a time code in the picture, processor time of both ends. WebRTC
needs aiortc, the browser's part playwright and Chromium; what is not there is left out, saying so.
"""

from __future__ import annotations

import asyncio
import contextlib
import fractions
import json
import os
import statistics
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from aiohttp import web

from bench.common import find_chromium, report
from warp_ar.scene import load_scene
from warp_ar.sources.sources import open_source
from warp_ar.viewer.encoding import encode_jpeg

SECONDS = float(os.environ.get("WARP_AR_BENCH_SECONDS", "10"))
WARM_SECONDS = 3.0
RATE = 24.0
BITS, CELL = 12, 16  # the time code: the frame's number as squares along the bottom edge
BITRATE = 3_000_000  # what WebRTC may use at most as aiortc sets it up

try:
    import aiortc
    from aiortc.codecs.h264 import H264Encoder
    from aiortc.codecs.vpx import Vp8Encoder
except ImportError:
    aiortc = None

Image = np.ndarray


def clip() -> list[Image]:
    with open_source(load_scene("desk").source.path) as source:  # type: ignore[union-attr, arg-type]
        return [frame.image for frame, _ in zip(source, range(48), strict=False)]


def mark(image: Image, number: int) -> Image:
    """The picture with its number as a time code."""
    image = image.copy()
    for bit in range(BITS):
        image[-CELL:, bit * CELL : (bit + 1) * CELL] = 255 * (number >> bit & 1)
    return image


# ------------------------------------------------------------------------------------------------- codecs by themselves


class H264:
    """H.264 as a live encoder makes it: no frame held back, one thread."""

    def __init__(self, width: int, height: int, quality: int = 23) -> None:
        self._codec: Any = av.CodecContext.create("libx264", "w")
        self._codec.width, self._codec.height, self._codec.pix_fmt = width, height, "yuv420p"
        self._codec.time_base, self._codec.thread_count = fractions.Fraction(1, 30), 1
        self._codec.options = {
            "preset": "ultrafast",
            "tune": "zerolatency",
            "crf": str(quality),
            "x264-params": "annexb=1",
        }
        self._count = 0

    def __call__(self, image: Image) -> bytes:
        """One frame, an access unit of Annex B."""
        frame = av.VideoFrame.from_ndarray(image, format="rgb24").reformat(format="yuv420p")
        frame.pts = self._count
        self._count += 1
        return b"".join(bytes(packet) for packet in self._codec.encode(frame))


def _decoder(name: str) -> Callable[[bytes], Image]:
    codec: Any = av.CodecContext.create(name, "r")
    codec.thread_count, codec.options = 1, {"flags": "low_delay"}

    def decode(data: bytes) -> Image:
        frames = codec.decode(av.Packet(data))
        return frames[-1].to_ndarray(format="rgb24") if frames else np.zeros((0, 0, 3), np.uint8)

    return decode


def _webrtc(encoder: Any) -> Callable[[Image], bytes]:
    encoder.target_bitrate = BITRATE
    count = 0

    def encode(image: Image) -> bytes:
        nonlocal count
        frame = av.VideoFrame.from_ndarray(image, format="rgb24").reformat(format="yuv420p")
        frame.pts, frame.time_base = count, fractions.Fraction(1, 30)
        count += 1
        return b"".join(encoder.encode(frame)[0])

    return encode


def _psnr(a: Image, b: Image) -> float:
    return float(10 * np.log10(255.0**2 / np.mean((a.astype(float) - b) ** 2)))


def codecs(images: list[Image]) -> None:
    """Processor milliseconds to pack and to unpack a frame on the server, bytes, and what is lost."""
    height, width = images[0].shape[:2]
    decode_jpeg = lambda data: cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB)  # noqa: E731
    ways: dict[str, tuple[Callable[[Image], bytes], Callable[[bytes], Image] | None]] = {
        "jpeg (opencv)": (encode_jpeg, decode_jpeg),
        "h264 (x264 ultrafast)": (H264(width, height), _decoder("h264")),
    }
    if aiortc is not None:
        # Packed for RTP, which the decoders of av do not take: the way back is that of libvpx and H.264 above.
        ways["webrtc vp8 (aiortc)"] = (_webrtc(Vp8Encoder()), None)
        ways["webrtc h264 (aiortc)"] = (_webrtc(H264Encoder()), None)
    else:
        print(json.dumps({"case": "webrtc", "left_out": "needs aiortc"}))
    packing: dict[str, list[float]] = {name: [] for name in ways}
    unpacking: dict[str, list[float]] = {name: [] for name in ways}
    sizes: dict[str, list[int]] = {name: [] for name in ways}
    losses: dict[str, list[float]] = {name: [] for name in ways}
    for turn in range(2 * len(images)):
        image = images[turn % len(images)]
        for name, (pack, unpack) in ways.items():
            start = time.process_time()
            data = pack(image)
            packing[name].append((time.process_time() - start) * 1e3)
            sizes[name].append(len(data))
            if unpack is not None:
                start = time.process_time()
                back = unpack(data)
                unpacking[name].append((time.process_time() - start) * 1e3)
                if back.shape == image.shape:
                    losses[name].append(_psnr(back, image))
    for name in ways:
        more = {"bytes": round(statistics.mean(sizes[name]))}
        if unpacking[name]:
            more["unpack_ms"] = round(statistics.median(unpacking[name]), 3)  # type: ignore[assignment]
            more["psnr_db"] = round(statistics.median(losses[name]), 1)  # type: ignore[assignment]
        report(f"pack {width}x{height} {name}, processor time", packing[name], "cpu", **more)


# ------------------------------------------------------------------------------------------------------ from end to end

PAGE = """<!doctype html><canvas id=c></canvas><video id=v muted playsinline autoplay></video><script type=module>
const way = new URLSearchParams(location.search).get("way"), canvas = document.getElementById("c");
const video = document.getElementById("v"), context = canvas.getContext("2d", { alpha: false });
const strip = document.createElement("canvas").getContext("2d", { willReadFrequently: true });
strip.canvas.width = %(width)d; strip.canvas.height = 1;
window.seen = [];
const show = (picture, width, height) => {
  if (canvas.width !== width) [canvas.width, canvas.height] = [width, height];
  context.drawImage(picture, 0, 0);
  strip.drawImage(picture, 0, height - %(row)d, width, 1, 0, 0, width, 1);
  const data = strip.getImageData(0, 0, width, 1).data;
  let code = 0;
  for (let bit = 0; bit < %(bits)d; bit++) if (data[4 * (bit * %(cell)d + %(cell)d / 2)] > 128) code |= 1 << bit;
  requestAnimationFrame(() => seen.push([code, performance.timeOrigin + performance.now()]));
};
if (way === "webrtc") {
  const peer = new RTCPeerConnection();
  const { receiver } = peer.addTransceiver("video", { direction: "recvonly" });
  if ("jitterBufferTarget" in receiver) receiver.jitterBufferTarget = 0;
  peer.ontrack = ({ track }) => (video.srcObject = new MediaStream([track]));
  const next = () => { show(video, video.videoWidth, video.videoHeight); video.requestVideoFrameCallback(next); };
  video.requestVideoFrameCallback(next);
  await peer.setLocalDescription(await peer.createOffer());
  await new Promise((done) => (peer.iceGatheringState === "complete" ? done() :
    (peer.onicegatheringstatechange = () => peer.iceGatheringState === "complete" && done())));
  const answer = await fetch("/offer", { method: "POST", body: JSON.stringify(peer.localDescription) });
  await peer.setRemoteDescription(await answer.json());
} else {
  const socket = new WebSocket(`ws://${location.host}/frames?way=${way}`);
  socket.binaryType = "arraybuffer";
  let decoder = null, key = true;
  if (way === "webcodecs") {
    const output = (frame) => { show(frame, frame.displayWidth, frame.displayHeight); frame.close(); };
    decoder = new VideoDecoder({ output, error: (error) => (window.failed = String(error)) });
    decoder.configure({ codec: "avc1.42E01F", optimizeForLatency: true });
  }
  let count = 0;
  socket.onmessage = async ({ data }) => {
    if (decoder) {
      decoder.decode(new EncodedVideoChunk({ type: key ? "key" : "delta", timestamp: 1e6 * count++ / 24, data }));
      key = false;
    } else {
      const picture = await createImageBitmap(new Blob([data], { type: "image/jpeg" }));
      show(picture, picture.width, picture.height);
      picture.close();
    }
    socket.send("");
  };
}
</script>"""

UPLINK = """async ([url, runs]) => {
  const picture = await createImageBitmap(await (await fetch(url)).blob());
  const canvas = new OffscreenCanvas(picture.width, picture.height);
  const context = canvas.getContext("2d", { alpha: false });
  const jpeg = [], vp8 = [], sizes = [0, 0];
  for (let i = 0; i < runs; i++) {
    context.drawImage(picture, (i % 7) - 3, 0);
    const start = performance.now();
    sizes[0] += (await canvas.convertToBlob({ type: "image/jpeg", quality: 0.85 })).size;
    jpeg.push(performance.now() - start);
  }
  let done = null;
  const output = (chunk) => { sizes[1] += chunk.byteLength; done(); };
  const encoder = new VideoEncoder({ output, error: (e) => done(e) });
  const { width, height } = picture;
  encoder.configure({ codec: "vp8", width, height, bitrate: 3e6, framerate: 30, latencyMode: "realtime" });
  for (let i = 0; i < runs; i++) {
    context.drawImage(picture, (i % 7) - 3, 0);
    const start = performance.now();
    const frame = new VideoFrame(canvas, { timestamp: i * 33333 });
    const waiting = new Promise((resolve) => (done = resolve));
    encoder.encode(frame);
    frame.close();
    const error = await waiting;
    if (error) return { error: String(error) };
    vp8.push(performance.now() - start);
  }
  return { jpeg, vp8, sizes: sizes.map((s) => Math.round(s / runs)) };
}"""


class Feed:
    """The clip at its rate, with time codes, and when each frame was handed out."""

    def __init__(self, images: list[Image]) -> None:
        self._images = images
        self.sent: dict[int, float] = {}
        self._number = 0
        self._due = time.monotonic()

    async def next(self) -> Image:
        """The next frame, when it is due; late ones are not caught up with."""
        self._due = max(self._due + 1 / RATE, time.monotonic())
        await asyncio.sleep(max(self._due - time.monotonic(), 0.0))
        self._number = (self._number + 1) % (1 << BITS)
        image = mark(self._images[self._number % len(self._images)], self._number)
        self.sent[self._number] = time.time() * 1e3
        return image


@contextlib.asynccontextmanager
async def site(images: list[Image], feed: Feed) -> AsyncIterator[str]:
    height, width = images[0].shape[:2]
    peers: list[Any] = []

    async def page(request: web.Request) -> web.Response:
        text = PAGE % {"width": width, "row": CELL // 2, "bits": BITS, "cell": CELL}
        return web.Response(text=text, content_type="text/html")

    async def picture(request: web.Request) -> web.Response:
        return web.Response(body=encode_jpeg(images[0]), content_type="image/jpeg")

    async def frames(request: web.Request) -> web.WebSocketResponse:
        socket = web.WebSocketResponse()
        await socket.prepare(request)
        pack = encode_jpeg if request.query["way"] == "jpeg" else H264(width, height)
        loop, unshown = asyncio.get_running_loop(), 0

        async def listen() -> None:
            nonlocal unshown
            async for _ in socket:
                unshown -= 1

        listening = asyncio.create_task(listen())
        with contextlib.suppress(ConnectionError):
            while not socket.closed:
                image = await feed.next()
                if unshown < 2:
                    unshown += 1
                    await socket.send_bytes(await loop.run_in_executor(None, pack, image))
        listening.cancel()
        return socket

    async def offer(request: web.Request) -> web.Response:
        class Track(aiortc.VideoStreamTrack):  # type: ignore[misc, name-defined]
            async def recv(self) -> Any:
                frame = av.VideoFrame.from_ndarray(await feed.next(), format="rgb24")
                frame.pts, frame.time_base = int(time.monotonic() * 90000), fractions.Fraction(1, 90000)
                return frame

        peer = aiortc.RTCPeerConnection()
        peers.append(peer)
        peer.addTrack(Track())
        described = await request.json()
        await peer.setRemoteDescription(aiortc.RTCSessionDescription(described["sdp"], described["type"]))
        await peer.setLocalDescription(await peer.createAnswer())
        local = peer.localDescription
        return web.json_response({"sdp": local.sdp, "type": local.type})

    app = web.Application()
    app.add_routes(
        [web.get("/", page), web.get("/picture", picture), web.get("/frames", frames), web.post("/offer", offer)]
    )
    runner = web.AppRunner(app, access_log=None)
    await runner.setup()
    await web.TCPSite(runner, "127.0.0.1", 0).start()
    try:
        yield f"http://127.0.0.1:{runner.addresses[0][1]}/"
    finally:
        for peer in peers:
            await peer.close()
        await runner.cleanup()


def descendants(pid: int) -> Iterator[int]:
    """Processes that a process has started, and those that they have."""
    with contextlib.suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            for child in (task / "children").read_text().split():
                yield int(child)
                yield from descendants(int(child))


def children_seconds() -> float:
    """Processor seconds of all processes that this one has started and that still run: the browser's."""
    ticks = 0
    for pid in descendants(os.getpid()):
        with contextlib.suppress(OSError):
            fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
            ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf("SC_CLK_TCK")


async def ends(images: list[Image]) -> None:
    chromium = find_chromium()
    if chromium is None:
        return
    from playwright.async_api import async_playwright

    async with async_playwright() as driver:
        # Without this a browser hides its address behind a name that needs multicast.
        arguments = ["--no-sandbox", "--disable-features=WebRtcHideLocalIpsWithMdns"]
        browser = await driver.chromium.launch(executable_path=chromium, args=arguments)
        for way in ("jpeg", "webcodecs", *(["webrtc"] if aiortc is not None else [])):
            feed = Feed(images)
            async with site(images, feed) as url:
                page = await browser.new_page()
                await page.goto(f"{url}?way={way}")
                await _one_way(way, page, feed)
                if way == "jpeg":
                    await _uplink(page)
                await page.close()
        await browser.close()


async def _one_way(way: str, page: Any, feed: Feed) -> None:
    await asyncio.sleep(WARM_SECONDS)
    await page.evaluate("seen.length = 0")
    here, there, start = time.process_time(), children_seconds(), time.monotonic()
    await asyncio.sleep(SECONDS)
    seen = await page.evaluate("seen")
    here, there = time.process_time() - here, children_seconds() - there
    seconds = time.monotonic() - start
    delays = [at - feed.sent[code] for code, at in seen if code in feed.sent]
    if not delays:
        print(json.dumps({"case": f"{way}, from end to end", "failed": await page.evaluate("window.failed ?? ''")}))
        return
    report(
        f"{way}, latency from end to end",
        delays,
        "cpu",
        fps=round(len(seen) / seconds, 1),
        unread=len(seen) - len(delays),
        server_ms_per_frame=round(1e3 * here / len(seen), 2),
        browser_ms_per_frame=round(1e3 * there / len(seen), 2),
    )


async def _uplink(page: Any) -> None:
    """What packing a camera's frame takes in the page."""
    packed = await page.evaluate(UPLINK, ["/picture", 60])
    if "error" in packed:
        print(json.dumps({"case": "pack in the page", "failed": packed["error"]}))
        return
    for name, size in zip(("jpeg", "vp8"), packed["sizes"], strict=True):
        report(f"pack in the page, {name}", packed[name], "cpu", bytes=size)


def main(device: str) -> None:
    images = clip()
    codecs(images)
    run: Awaitable[None] = ends(images)
    asyncio.run(run)  # type: ignore[arg-type]
