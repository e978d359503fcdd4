"""Address of the page: its printed form, its listening sockets, and its certificate.

Browsers allow camera access only on the local machine or over TLS.
"""

from __future__ import annotations

import dataclasses
import datetime
import socket
import ssl
from pathlib import Path
from typing import Final

from warp_ar.errors import UsageError, import_extra
from warp_ar.files import read_bytes
from warp_ar.viewer.gate import BACKLOG


def load_context(path: Path) -> ssl.SSLContext:
    """Return a TLS context with the certificate and key of a PEM file.

    Raises:
        UsageError: The file is not a regular file, holds no certificate with its key, or the key has a password.
    """
    read_bytes(path, "text_bytes", UsageError, f"--tls {path}")  # refuses a pipe, which would block
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    try:
        context.load_cert_chain(path, password="")  # otherwise OpenSSL would prompt on the terminal
    except OSError as error:  # ssl.SSLError is one
        words = "expected a PEM file with a certificate and its key without a password"
        raise UsageError(f"--tls {path}: {error}; {words}") from error
    return context


def make_context(host: str) -> ssl.SSLContext:
    """Return a TLS context with a newly made certificate. Browsers warn before they accept such a certificate.

    Args:
        host: Host name or address at which the page is opened.

    Raises:
        UsageError: The package that makes certificates is not installed, or a certificate cannot be made for ``host``.
    """
    trustme = import_extra("tls", "--tls needs a PEM file, or trustme to make a certificate", "trustme")
    until = datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=30)
    try:
        made = trustme.CA(organization_name="warp_ar").issue_cert("localhost", "127.0.0.1", host, not_after=until)
    except ValueError as error:
        raise UsageError(f"--host {host}: no name that a certificate can have: {error}; name a PEM file") from error
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    made.configure_cert(context)
    return context


LOOPBACK: Final = ("127.0.0.1", "::1", "localhost")
EVERYWHERE: Final = ("0.0.0.0", "::", "")
"""Host names that mean all addresses of this machine."""


def own_address() -> str | None:
    """Return the address of this machine on its network; None without one."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # an address reserved for documentation; a UDP connect sends no packet
        except OSError:
            return None
        return str(probe.getsockname()[0])


@dataclasses.dataclass(frozen=True)
class Address:
    """Address of the page, with its token and certificate."""

    host: str = "127.0.0.1"
    """Address to listen on."""
    port: int = 8720
    token: str | None = None
    """Secret that must be part of the page's address; None: no secret is required."""
    tls: ssl.SSLContext | None = None
    origins: tuple[str, ...] = ()
    """Origins of other sites whose pages may request the light."""

    @property
    def loopback(self) -> bool:
        """True if the page is reachable from this machine only."""
        return self.host in LOOPBACK

    @property
    def url(self) -> str:
        """Return the page's address as it is printed."""
        return self._url("localhost" if self.host in EVERYWHERE else self.host)

    @property
    def outside_url(self) -> str | None:
        """Return the page's address for other machines.

        Return None if they cannot reach it, or this machine's address is unknown.
        """
        own = own_address() if self.host in EVERYWHERE else None if self.loopback else self.host
        return None if own is None else self._url(own)

    def _url(self, host: str) -> str:
        host = f"[{host}]" if ":" in host else host
        token = f"?token={self.token}" if self.token else ""
        return f"http{'s' * (self.tls is not None)}://{host}:{self.port}/{token}"


def listen(host: str, port: int, tries: int) -> socket.socket:
    """Listen at the first free port of an address.

    Args:
        host: Address or host name; of a name's addresses the first is used.
        port: First port to try; 0 takes any free port.
        tries: Number of ports to try.

    Raises:
        UsageError: The address does not exist, or all tried ports are taken.
    """
    for number in range(port, port + tries):
        try:
            family, _, _, _, place = socket.getaddrinfo(
                host or None, number, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
            )[0]
            return socket.create_server((str(place[0]), number), family=family, backlog=BACKLOG)
        except OSError as error:
            problem = f"cannot serve at {host} port {number}: {error.strerror or error}"
    raise UsageError(f"{problem}; choose another --port")
