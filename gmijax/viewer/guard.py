"""Which requests the viewer's server answers. No jax here.

A page of any website may open a websocket to this machine, and a name that its owner points here
passes for our own (DNS rebinding). So three things are checked of every request: that its `Host`
is a name of this machine, that it comes from our own page (`Origin`), and that it knows the token
that only the printed URL has.
"""

from __future__ import annotations

import functools
import hmac
import ipaddress
import secrets
import socket
from collections.abc import Sequence
from dataclasses import dataclass, field
from urllib.parse import urlsplit

from gmijax.config.view import origin_of

_TOKEN_BYTES = 24


def is_loopback(host: str) -> bool:
    """Whether an address, or a name without a port, is this machine's own for itself."""
    if host.lower() == "localhost":
        return True
    address = _address(host)
    return address is not None and address.is_loopback


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host.strip("[]"))
    except ValueError:
        return None


@dataclass(frozen=True)
class Guard:
    """Decides which requests are refused.

    Attributes:
      host: where the server listens.
      allowed_origins: of pages that may hold ours, or through which it comes.
      token: the first part of the path of every request. It stands in the path and not behind a
        `?`, because viser's page asks for its websocket at its own path, without what follows.
    """

    host: str
    allowed_origins: tuple[str, ...] = ()
    token: str = field(default_factory=lambda: secrets.token_urlsafe(_TOKEN_BYTES))

    def refusal(self, path: str, hosts: Sequence[str], origins: Sequence[str]) -> str | None:
        """Why a request is refused, None if it is not.

        Args:
          path: of the request, with its query.
          hosts: its headers `Host`.
          origins: its headers `Origin`; programs other than browsers send none.
        """
        if len(hosts) != 1 or not self._is_ours(hosts[0]):
            return f"unknown host; if it is yours: view.allow_origin=[http://{_text(hosts)}]"
        if origins and (len(origins) != 1 or not self._may_ask(origins[0], hosts[0])):
            return f"unknown origin; if it is yours: view.allow_origin=[{_text(origins)}]"
        first = path.partition("?")[0].lstrip("/").partition("/")[0]
        if not hmac.compare_digest(first.encode(errors="surrogateescape"), self.token.encode()):
            return "the address needs its token; open the one that gmijax view printed"
        return None

    def _is_ours(self, netloc: str) -> bool:
        # Any port: `ssh -L` may give the page another one than the server has.
        host = urlsplit(f"//{netloc}").hostname if origin_of(f"http://{netloc}") else None
        if host is None:
            return False
        if is_loopback(host) or host in {urlsplit(url).hostname for url in self.allowed_origins}:
            return True
        # An address is no name that another party could have pointed here.
        beyond = not is_loopback(self.host)
        return beyond and (_address(host) is not None or host in own_names(self.host))

    def _may_ask(self, origin: str, host: str) -> bool:
        return origin in self.allowed_origins or origin in (f"http://{host}", f"https://{host}")


def _text(values: Sequence[str]) -> str:
    """A header for people; it may be anything."""
    return values[0][:80] if len(values) == 1 and values[0].isprintable() else "..."


@functools.cache
def own_names(host: str) -> set[str]:
    """Names of this machine, where the server listens at `host`."""
    return {name.lower() for name in (host, socket.gethostname(), socket.getfqdn())}
