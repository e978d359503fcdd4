"""Streams from the network: lines that break, what is late, what is none. A camera of motion JPEG plays the phone."""

from __future__ import annotations

import contextlib
import http.server
import itertools
import socket
import threading
import time
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
import pytest

from warp_ar.errors import SourceError, UsageError
from warp_ar.sources import network_stream
from warp_ar.sources.network_stream import NetworkStream
from warp_ar.sources.sources import open_source

pytestmark = pytest.mark.slow

SIZE = (64, 48)
PATIENCE = 60.0
JPEG = 3  # levels by which a flat picture changes


class Camera:
    """Serves pictures that grow brighter by one level each, and breaks its line after every so many."""

    def __init__(self, cut_after: int | None = None, rate: float = 50.0) -> None:
        self.count, self.connections, self.refuse = 0, 0, False
        self.size = SIZE
        camera = self

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                if camera.refuse:
                    self.send_error(503)
                    return
                camera.connections += 1
                self.send_response(200)
                self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
                self.end_headers()
                sent = 0
                with contextlib.suppress(OSError):
                    while not camera.ended.is_set() and (cut_after is None or sent < cut_after):
                        width, height = camera.size
                        picture = np.full((height, width, 3), 40 + camera.count % 160, np.uint8)
                        data = cv2.imencode(".jpg", picture)[1].tobytes()
                        head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
                        self.wfile.write(head.encode() + data + b"\r\n")
                        camera.count, sent = camera.count + 1, sent + 1
                        time.sleep(1.0 / rate)

            def log_message(self, format: str, *args: Any) -> None:
                pass

        self.ended = threading.Event()
        self._server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}/video"

    def close(self) -> None:
        self.ended.set()
        self._server.shutdown()
        self._server.server_close()


@pytest.fixture
def camera() -> Iterator[Camera]:
    made = Camera()
    yield made
    made.close()


def level(image: np.ndarray) -> float:
    return float(image.mean()) - 40.0


def test_pictures_come_and_are_the_newest(camera: Camera) -> None:
    with open_source(camera.url) as source:
        assert source.live
        assert source.size == SIZE
        assert source.length is None
        frames = iter(source)
        first = next(frames)
        assert first.image.shape == (SIZE[1], SIZE[0], 3)
        assert first.index == 0
        assert first.time == 0.0
        # A reader that rests gets what is newest then, not what it missed.
        deadline = time.monotonic() + PATIENCE
        while source.dropped < 10 and time.monotonic() < deadline:
            time.sleep(0.01)
        late = next(frames)
        assert level(late.image) >= level(first.image) + 10 - JPEG
        assert late.time > 0.0


def test_ten_cuts_of_the_line() -> None:
    camera = Camera(cut_after=4)
    try:
        with NetworkStream(camera.url) as source:
            seen = []
            for frame in source:
                seen.append(level(frame.image))
                if camera.connections > 10:
                    break
        assert all(b > a - JPEG for a, b in itertools.pairwise(seen)), "never back in time"
        assert seen[-1] >= 40 - JPEG, "ten lines of four pictures"
    finally:
        camera.close()


def test_a_line_that_stays_broken_ends_with_its_reason() -> None:
    camera = Camera(cut_after=3)
    try:
        source = NetworkStream(camera.url, grace=0.5)
        camera.refuse = True
        with source, pytest.raises(SourceError, match=r"gave no picture for 0\.5 s \(.*\); check its address"):
            for _ in source:
                pass
    finally:
        camera.close()


def test_a_size_that_changes_ends_it() -> None:
    camera = Camera(cut_after=5)
    try:
        with NetworkStream(camera.url) as source:
            camera.size = (32, 24)
            with pytest.raises(SourceError, match=r"is 32x24, not 64x48 like those before it"):
                for _ in source:
                    pass
    finally:
        camera.close()


def test_what_is_no_stream_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(network_stream, "OPEN_SECONDS", 1.0)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    with pytest.raises(SourceError) as error:
        open_source(f"rtsp://user:secret@127.0.0.1:{port}/live?key=1")
    text = str(error.value)
    assert text.startswith(f"rtsp://127.0.0.1:{port}/live cannot be opened (")
    assert "secret" not in text
    assert "\n" not in text
    with pytest.raises(SourceError, match=r"gopher://a: no stream is read by 'gopher'; expected rtsp, rtsps, http"):
        open_source("gopher://a")
    with pytest.raises(SourceError, match="no stream is read by 'file'"):
        open_source("file:///etc/passwd")
    with pytest.raises(UsageError, match="exposures: a stream"):
        open_source("http://127.0.0.1:1/", exposures=(0.1, 0.01))


def test_an_address_that_gives_no_video_is_named() -> None:
    class Text(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.end_headers()
            self.wfile.write(b"<html>log in first</html>" * 100)

        def log_message(self, format: str, *args: Any) -> None:
            pass

    server = http.server.HTTPServer(("127.0.0.1", 0), Text)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        with pytest.raises(SourceError, match=r"cannot be opened \(.+\); check its address"):
            open_source(f"http://127.0.0.1:{server.server_address[1]}/")
    finally:
        server.shutdown()
        server.server_close()


def test_a_server_that_never_answers_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(network_stream, "OPEN_SECONDS", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as mute:
        port = mute.getsockname()[1]
        with pytest.raises(SourceError, match=r"cannot be opened \(no picture came for 0\.5 s\)"):
            open_source(f"rtsp://127.0.0.1:{port}/live")
