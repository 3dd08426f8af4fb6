"""What all servers of local pages share: where they listen, and who may talk to them.

Any page that is open in the browser can send requests to this machine. A server answers only those that name this
machine as their host (otherwise a foreign name that is made to point here would do) and that come from its own page.
A server that other machines reach has a random token in its address besides.
"""

from __future__ import annotations

import errno
import ipaddress
import logging
import secrets
import socket
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from torchdlo.errors import InputError

__all__ = ["HEADERS", "Guard", "drop_log", "listen"]

HEADERS = {
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}
"""What every answer says."""

_TOLD = 20
"""Lines in the log about clients that were dropped."""


def listen(host: str, port: int, *, tries: int = 1) -> socket.socket:
    """Return a socket that listens.

    Args:
        host: an IP address of this machine, or localhost. Other names are not looked up: that may take minutes.
        port: a free one if 0.
        tries: ports that are tried, one after the other, where some are taken.

    Raises:
        InputError: The address is none of this machine, or the ports are taken.
    """
    try:
        address = ipaddress.ip_address("127.0.0.1" if host == "localhost" else host.strip("[]"))
    except ValueError:
        raise InputError(
            f"host {host[:80]!r}: expected localhost or an IP address of this machine, such as 127.0.0.1."
        ) from None
    family = socket.AF_INET6 if address.version == 6 else socket.AF_INET
    for each in range(port, min(port + tries, 65536)):
        try:
            return socket.create_server((str(address), each), family=family)
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                continue
            if error.errno in (errno.EADDRNOTAVAIL, errno.EINVAL, errno.EAFNOSUPPORT):
                raise InputError(
                    f"host {host}: expected an address of this machine, but it has no such one; 127.0.0.1 is for this "
                    "machine alone, 0.0.0.0 for all its addresses."
                ) from None
            raise InputError(f"port {each}: expected a free one, but it cannot be used ({error.strerror}).") from None
    last = min(port + tries, 65536) - 1
    which = f"port {port}" if tries == 1 else f"ports {port} to {last}"
    raise InputError(f"{which}: expected a free one, but it is in use; choose another --port.")


@dataclass(frozen=True)
class Guard:
    """Who may talk to a server."""

    host: str
    """Address that it listens at."""
    port: int
    token: str = field(repr=False, default="")
    """What the path of every request begins with; none if only this machine reaches the server."""

    @classmethod
    def of(cls, listening: socket.socket) -> Guard:
        """Return the guard of a socket that listens."""
        host, port = listening.getsockname()[:2]
        return cls(host, port, "" if ipaddress.ip_address(host).is_loopback else secrets.token_urlsafe(16))

    @property
    def address(self) -> str:
        """What to open."""
        host = ipaddress.ip_address(self.host)
        name = socket.gethostname() if host.is_unspecified else f"[{host}]" if host.version == 6 else str(host)
        return f"http://{name}:{self.port}/" + (f"{self.token}/" if self.token else "")

    def path(self, asked: str) -> str | None:
        """Return the path of a request without the token; None if it has not the right one."""
        if not self.token:
            return asked
        first, _, rest = asked.removeprefix("/").partition("/")
        first, question, query = first.partition("?")
        right = secrets.compare_digest(first.encode("utf-8", "replace"), self.token.encode())
        return f"/{rest}{question}{query}" if right else None

    def refusal(self, hosts: Sequence[str], origins: Sequence[str], *, changes: bool = False) -> str:
        """Return why a request is refused, "" if it is not.

        Args:
            hosts: values of its header Host.
            origins: values of its header Origin, which browsers send where a page asks for more than to be shown.
            changes: whether it must come from a page, as it changes something.
        """
        if len(hosts) != 1 or len(origins) > 1:
            return "expected one header Host and at most one Origin"
        if not self.token and hosts[0].lower() not in self._names():
            return f"it names the host {_short(hosts[0])}"
        if origins and origins[0].lower() != f"http://{hosts[0].lower()}":
            return f"it comes from {_short(origins[0])}"
        return "it says nothing of where it comes from" if changes and not origins else ""

    def _names(self) -> set[str]:
        names: tuple[str, ...] = ("localhost", "127.0.0.1", "[::1]")
        own = ipaddress.ip_address(self.host)
        names += (f"[{own}]" if own.version == 6 else str(own),)
        return {f"{name}:{self.port}" for name in names} | (set(names) if self.port == 80 else set())


def drop_log(what: str) -> Callable[[str], None]:
    """Return what logs, in one line each, why clients were dropped; there is an end to that.

    Args:
        what: name of the server.
    """
    log, told = logging.getLogger("torchdlo"), 0

    def dropped(reason: str) -> None:
        nonlocal told
        told += 1
        if told <= _TOLD:
            end = "; no more is said of others" if told == _TOLD else ""
            log.warning("%s: a client was dropped: %s%s", what, " ".join(reason.split())[:200], end)

    return dropped


def _short(text: str) -> str:
    """Return a text that may come from anywhere for a line of a log."""
    return ascii(text[:60])
