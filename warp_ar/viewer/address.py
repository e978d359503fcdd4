"""Address of the page: as it is printed, the sockets that listen there, and its certificate.

A browser opens its camera only to this machine or over TLS.
"""

from __future__ import annotations

import asyncio
import dataclasses
import datetime
import errno
import ipaddress
import socket
import ssl
import tempfile
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
        UsageError: The package that makes certificates is not installed.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "warp_ar.pem"
        path.touch(mode=0o600)
        path.write_bytes(make_certificate(host))
        return load_context(path)


def make_certificate(host: str) -> bytes:
    """A key and its certificate, PEM; arguments as those of ``make_context``.

    Raises:
        UsageError: `cryptography` is not installed.
    """
    try:
        from cryptography import x509
        from cryptography.hazmat.primitives import hashes, serialization
        from cryptography.hazmat.primitives.asymmetric import ec
        from cryptography.x509.oid import NameOID
    except ImportError as error:
        raise UsageError(
            "--tls without a file makes a certificate: pip install 'warp-ar[tls]', or name a PEM file"
        ) from error
    names: list[x509.GeneralName] = []
    for name in dict.fromkeys(("localhost", "127.0.0.1", socket.gethostname(), host)):
        try:
            names.append(x509.IPAddress(ipaddress.ip_address(name)))
        except ValueError:
            names.append(x509.DNSName(name))
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "warp_ar")])
    now = datetime.datetime.now(datetime.UTC)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(hours=1))
        .not_valid_after(now + datetime.timedelta(days=30))
        .add_extension(x509.SubjectAlternativeName(names), critical=False)
        .sign(key, hashes.SHA256())
    )
    private = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    return bytes(private + certificate.public_bytes(serialization.Encoding.PEM))


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
    """Where the page is served, and what it takes to see it."""

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
        """Whether only this machine can reach it."""
        return self.host in LOOPBACK

    @property
    def url(self) -> str:
        """The page's address as it is printed."""
        return self._url("localhost" if self.host in EVERYWHERE else self.host)

    @property
    def outside_url(self) -> str | None:
        """The same for other machines, where the page is served at all of this one's addresses and one is known."""
        own = own_address() if self.host in EVERYWHERE else None
        return None if own is None else self._url(own)

    def _url(self, host: str) -> str:
        host = f"[{host}]" if ":" in host else host
        token = f"?token={self.token}" if self.token else ""
        return f"http{'s' * (self.tls is not None)}://{host}:{self.port}/{token}"


async def listen(host: str, port: int) -> list[socket.socket]:
    """Sockets that listen at all addresses that a name stands for.

    Raises:
        OSError: There is none, or it is taken.
    """
    found = await asyncio.get_running_loop().getaddrinfo(
        host or None, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
    )
    listeners: list[socket.socket] = []
    try:
        for family, address in dict.fromkeys((family, address) for family, _, _, _, address in found):
            # A free port that was found for the first address is taken for the others too.
            chosen = listeners[0].getsockname()[1] if listeners else port
            try:
                own = socket.create_server((address[0], chosen), family=family, backlog=BACKLOG)
            except OSError as error:
                if listeners and error.errno in (errno.EADDRNOTAVAIL, errno.EAFNOSUPPORT):
                    continue  # a machine without the other kind of address
                raise
            listeners.append(own)
    except OSError:
        for own in listeners:
            own.close()
        raise
    return listeners
