"""Where the page is served: its address, as it is printed, and the sockets that listen there."""

from __future__ import annotations

import asyncio
import dataclasses
import errno
import socket
import ssl
from typing import Final

from warp_ar.viewer.gate import BACKLOG

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
