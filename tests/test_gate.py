"""Connections that say nothing, say half, or say nonsense: they are cut, and cost no viewer its frames."""

from __future__ import annotations

import asyncio
import contextlib
import os
import ssl
import subprocess
import sys
from collections.abc import Iterator

import aiohttp
import pytest

from tests.viewer_rig import PATIENCE, Page, run, served
from warp_ar.errors import UsageError
from warp_ar.viewer.address import load_context, make_context
from warp_ar.viewer.gate import MOST_PER_ADDRESS
from warp_ar.viewer.server import HEADERS

pytestmark = pytest.mark.slow

SECRET = "5ec2e7"
HEADER_SECONDS = 0.7
# Further files that the process may open while it is attacked: fewer than the attack has connections.
FILES = 150
ATTACKERS = 300
ATTACKED_FRAMES = 40

# Opens connections that say nothing, and opens another wherever one is cut; ends when its input does.
ATTACK = """
import resource, select, socket, sys
hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
port, count = int(sys.argv[1]), int(sys.argv[2])
def connect():
    s = socket.socket()
    s.setblocking(False)
    s.connect_ex(("127.0.0.1", port))
    return s
sockets = [connect() for _ in range(count)]
print("up", flush=True)
while not select.select([sys.stdin], [], [], 0.1)[0]:
    for index, s in enumerate(sockets):
        try:
            gone = s.recv(1) == b""
        except BlockingIOError:
            continue
        except OSError:
            gone = True
        if gone:
            s.close()
            sockets[index] = connect()
"""


def port_of(url: str) -> int:
    return int(url.rsplit(":", 1)[1])


async def is_cut(port: int, sent: bytes, tls: bool = False) -> bool:
    """Whether the server ends a connection that sends this and no more."""
    context = None
    if tls:
        context = ssl.create_default_context()
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    reader, writer = await asyncio.open_connection("127.0.0.1", port, ssl=context)
    writer.write(sent)
    try:
        while await asyncio.wait_for(reader.read(4096), PATIENCE):
            pass
    except (ConnectionError, ssl.SSLError):
        pass
    finally:
        writer.close()
        with contextlib.suppress(ConnectionError, ssl.SSLError):
            await writer.wait_closed()
    return True


HALVES = [b"", b"GET / HT", b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Slow: a"]


@run
async def test_silence_and_half_a_header_are_cut() -> None:
    async with served(header_seconds=HEADER_SECONDS) as site:
        port = port_of(site.url)
        assert all(await asyncio.gather(*(is_cut(port, sent) for sent in HALVES)))
        # A second request is no way around it.
        whole = f"GET /static/icon.svg HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode()
        assert await is_cut(port, whole + b"GET / HT")
        assert await is_cut(port, whole)


def test_a_body_that_is_not_what_it_says_is_no_line_of_the_log(caplog: pytest.LogCaptureFixture) -> None:
    async def send() -> bytes:
        async with served() as site:
            reader, writer = await asyncio.open_connection("127.0.0.1", port_of(site.url))
            host = f"Host: 127.0.0.1:{port_of(site.url)}\r\nConnection: close\r\n".encode()
            head = b"POST / HTTP/1.1\r\n" + host + b"Content-Encoding: gzip\r\nContent-Length: 90\r\n\r\n"
            writer.write(head + b"no such thing" + bytes(77))
            answer = await asyncio.wait_for(reader.read(), PATIENCE)
            writer.close()
            return answer

    assert asyncio.run(send()).startswith(b"HTTP/1.")
    assert not [record for record in caplog.records if record.levelname == "ERROR"]


@run
async def test_a_header_that_drips_is_cut() -> None:
    async with served(header_seconds=HEADER_SECONDS) as site:
        reader, writer = await asyncio.open_connection("127.0.0.1", port_of(site.url))
        with contextlib.suppress(ConnectionError):
            for byte in b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n" + b"X: a\r\n" * 4000:
                if reader.at_eof():
                    break
                writer.write(bytes([byte]))
                await writer.drain()
                await asyncio.sleep(0.02)
            else:
                pytest.fail("it was heard to the end")
        writer.close()
        with contextlib.suppress(ConnectionError):
            await writer.wait_closed()


@run
async def test_behind_tls_too() -> None:
    async with served(header_seconds=HEADER_SECONDS, tls=make_context("127.0.0.1"), token=SECRET) as site:
        port = port_of(site.url)
        cut = [is_cut(port, sent, tls=True) for sent in HALVES]
        without_handshake = [is_cut(port, sent) for sent in (b"", b"\x16\x03\x01", b"GET / HTTP/1.1\r\n\r\n")]
        assert all(await asyncio.gather(*cut, *without_handshake))
        async with asyncio.timeout(PATIENCE):
            while len(site.server.gate.connections):  # a client may hear first that it was cut
                await asyncio.sleep(0.01)


@pytest.fixture
def few_files() -> Iterator[None]:
    """The process may open hardly more files than it has."""
    resource = pytest.importorskip("resource", reason="sockets are no files here")
    if not os.path.isdir("/proc/self/fd"):
        pytest.skip("open files cannot be counted here")
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (len(os.listdir("/proc/self/fd")) + FILES, hard))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@contextlib.contextmanager
def attacked(port: int) -> Iterator[None]:
    """While silent connections from another process come and come again."""
    command = [sys.executable, "-c", ATTACK, str(port), str(ATTACKERS)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        try:
            assert process.stdout.readline() == b"up\n"
            yield
        finally:
            assert process.stdin is not None
            process.stdin.close()


def test_a_polite_viewer_keeps_its_frames_beside_silent_connections(
    few_files: None, capfd: pytest.CaptureFixture[str]
) -> None:
    query = f"?token={SECRET}"

    @run
    async def test() -> None:
        async with served(token=SECRET) as site:
            live = f"{site.url}/live{query}"
            async with site.session.ws_connect(live, max_msg_size=1 << 24) as polite:
                page = Page(polite)
                while not (await page.until("frame"))[0]["plan"]:
                    pass
                with attacked(port_of(site.url)):
                    shown = page.frames
                    while page.frames < shown + ATTACKED_FRAMES:
                        await page.hear()
                    assert len(site.server.gate.connections) < FILES
                    # Whoever comes now, with a request, comes in.
                    async with site.session.get(f"{site.url}/{query}") as response:
                        assert response.status == 200
                    async with site.session.ws_connect(live, max_msg_size=1 << 24) as late:
                        await Page(late).until("frame")

    test()
    told = capfd.readouterr().err
    # Said again after a while, however many are cut.
    assert all("too many connections" in line for line in told.splitlines())
    assert told.count("\n") < ATTACKERS / 10, "an attack fills the log"


@run
async def test_connections_that_rest_make_room_for_those_that_ask() -> None:
    """Whoever had one request answered and says no more is no reason to refuse another."""
    async with served(token=SECRET) as site:
        port = port_of(site.url)
        request = f"GET /?token={SECRET} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode()
        idle = []
        for _ in range(2 * MOST_PER_ADDRESS):
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            writer.write(request)
            assert (await asyncio.wait_for(reader.readline(), PATIENCE)).endswith(b"200 OK\r\n")
            idle.append(writer)
        assert len(site.server.gate.connections) <= MOST_PER_ADDRESS + 1
        for writer in idle:
            writer.close()


REFUSED = [
    (b"NONSENSE\r\n\r\n", 400),
    (b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nbad header\r\n\r\n", 400),
    (b"GET /" + b"a" * 20_000 + b" HTTP/1.1\r\n\r\n", 400),
    (b"GET / HTTP/1.1\r\nHost: evil.example\r\n\r\n", 403),
    (b"GET /nothing HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n", 404),
    (b"GET /static/nothing HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n", 404),
    (b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 0\r\n\r\n", 405),
    (b"GET /download/camera.yml HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n", 409),
    (b"GET /live HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n", 400),
    (b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nExpect: tea\r\n\r\n", 417),
]


def test_refusals_have_the_headers_of_the_page_and_no_traceback(capfd: pytest.CaptureFixture[str]) -> None:
    @run
    async def test() -> None:
        async with served() as site:
            for request, status in REFUSED:
                reader, writer = await asyncio.open_connection("127.0.0.1", port_of(site.url))
                writer.write(request)
                head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), PATIENCE)
                assert head.startswith((f"HTTP/1.1 {status}".encode(), f"HTTP/1.0 {status}".encode()))
                for name, value in HEADERS.items():
                    assert f"{name}: {value}".encode() in head, (request[:40], name)
                writer.close()
            with pytest.raises(aiohttp.WSServerHandshakeError):
                await site.session.ws_connect(f"{site.url}/live", headers={"Origin": "https://evil.example"})

    test()
    assert capfd.readouterr().err == ""


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes as on POSIX")
def test_a_certificate_that_is_none_is_one_line(tmp_path):
    """Nothing waits: not for a pipe, not for a password at the terminal."""
    serialization = pytest.importorskip("cryptography.hazmat.primitives.serialization", reason="needs the extra tls")
    trustme = pytest.importorskip("trustme", reason="needs the extra tls")
    from cryptography.hazmat.primitives.asymmetric import ec

    os.mkfifo(tmp_path / "pipe.pem")
    (tmp_path / "text.pem").write_text("no certificate")
    key = ec.generate_private_key(ec.SECP256R1()).private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.BestAvailableEncryption(b"secret"),
    )
    certificate = trustme.CA().issue_cert("127.0.0.1").cert_chain_pems[0]
    (tmp_path / "locked.pem").write_bytes(key + certificate.bytes())
    for name, words in (
        ("pipe.pem", "is a named pipe; a regular file is needed"),
        ("none.pem", "is not there"),
        ("text.pem", "expected a PEM file with a certificate and its key"),
        ("locked.pem", "expected a PEM file with a certificate and its key without a password"),
    ):
        with pytest.raises(UsageError, match=rf"--tls .*{name}:? .*{words}"):
            load_context(tmp_path / name)
