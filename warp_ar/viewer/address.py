"""Address of the page: as it is printed, the sockets that listen there, and its certificate.

A browser opens its camera only to this machine or over TLS.
"""

from __future__ import annotations

import dataclasses
import datetime
import socket
import ssl
from pathlib import Path
from typing import Final

from warp_ar.errors import UsageError
from warp_ar.files import read_bytes
from warp_ar.viewer.gate import BACKLOG


def load_context(path: Path) -> ssl.SSLContext:
    """TLS with the certificate and key of a PEM file.

    Raises:
        UsageError: The file is no regular one, or holds no certificate with its key, or the key asks for a password.
    """
    read_bytes(path, "text_bytes", UsageError, f"--tls {path}")  # a pipe in its place would be waited for
    asked = []

    def password() -> str:
        asked.append(True)
        return ""  # OpenSSL would ask the terminal

    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    try:
        context.load_cert_chain(path, password=password)
    except OSError as error:  # ssl.SSLError is one
        words = "its key asks for a password" if asked else str(error)
        raise UsageError(f"--tls {path}: {words}; expected a PEM file with a certificate and its key") from error
    return context


def make_context(host: str) -> ssl.SSLContext:
    """TLS with a certificate made on the spot; browsers ask before they trust it.

    Args:
        host: The name or address that the page is opened at.

    Raises:
        UsageError: The package that makes certificates is not installed, or ``host`` is no name for one.
    """
    try:
        import trustme
    except ImportError as error:
        raise UsageError(
            "--tls without a file makes a certificate: pip install 'warp-ar[tls]', or name a PEM file"
        ) from error
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
"""Not an address, but all that this machine has."""


def own_address() -> str | None:
    """Address of this machine on its network; None without one."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # an address for documentation: it finds the way out and sends nothing
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
    """Secret that the page's address must hold; None asks for none."""
    tls: ssl.SSLContext | None = None
    origins: tuple[str, ...] = ()
    """Other sites' pages that may ask for the light."""

    @property
    def loopback(self) -> bool:
        """Reachability from this machine alone."""
        return self.host in LOOPBACK

    @property
    def url(self) -> str:
        """The page's address as it is printed."""
        return self._url("localhost" if self.host in EVERYWHERE else self.host)

    @property
    def outside_url(self) -> str | None:
        """The same for other machines; None where they cannot reach the page, or this one's address is not known."""
        own = own_address() if self.host in EVERYWHERE else None if self.loopback else self.host
        return None if own is None else self._url(own)

    def _url(self, host: str) -> str:
        host = f"[{host}]" if ":" in host else host
        token = f"?token={self.token}" if self.token else ""
        return f"http{'s' * (self.tls is not None)}://{host}:{self.port}/{token}"


def listen(host: str, port: int, tries: int) -> socket.socket:
    """Listen at an address, at the first port that is free.

    Args:
        host: Address, or a name, of whose addresses the first is taken.
        port: First port to try; 0 takes any that is free.
        tries: Ports to try.

    Raises:
        UsageError: There is no such address, or all the ports are taken.
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
