"""Certificates: a browser opens its camera only to this machine or over TLS."""

from __future__ import annotations

import datetime
import ipaddress
import socket
import ssl
import tempfile
from pathlib import Path

from warp_ar.errors import UsageError
from warp_ar.files import read_bytes


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
