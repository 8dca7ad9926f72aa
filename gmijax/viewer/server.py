"""The viewer's web server: viser's, which answers only what `Guard` lets through. No jax here."""

from __future__ import annotations

import errno
import http
import io
import logging
import socket
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from typing import Any, Final
from urllib.parse import urlsplit

import viser
import websockets.asyncio.server
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from gmijax.errors import ConfigError, GmijaxError
from gmijax.viewer.guard import Guard, own_names

_PORTS_TRIED: Final = 20
"""From the wanted one upwards: several viewers may run on one machine."""


class Server(viser.ViserServer):
    """viser's server without its public tunnel, which any client could ask for."""

    guard: Guard

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Refuses: nothing is published."""
        return None

    def disconnect_share_url(self) -> None:
        """Does nothing: there is no tunnel."""

    @property
    def url(self) -> str:
        """Address of the page, with the token that it needs."""
        host = self.guard.host
        # Of all addresses that this is, the one at which this machine has it.
        shown = socket.gethostname() if host in ("0.0.0.0", "::") else host
        netloc = f"[{shown}]" if ":" in shown else shown
        return f"http://{netloc}:{self.get_port()}/{self.guard.token}/"


def open_server(guard: Guard, port: int) -> Server:
    """Starts a server behind `guard`.

    Args:
      guard: decides what is answered, and where the server listens.
      port: wanted; 0: any. If it is taken the next free one above.

    Raises:
      ConfigError: it cannot listen there.
    """
    listening = _listen(guard.host, port)
    own_names(guard.host)  # Which may ask a name server: not while others are served.
    try:
        with _guarded(guard, listening) as used, redirect_stdout(io.StringIO()):
            server = Server(host=guard.host, port=listening.getsockname()[1], verbose=False)
        if not used:  # viser starts its server in another way: nothing would be checked.
            server.stop()
            raise GmijaxError(f"viser {viser.__version__} cannot be guarded; install viser==1.1.1")
    except BaseException:
        listening.close()
        raise
    server.guard = guard
    # It would do nothing.
    server.gui.configure_theme(show_share_button=False, show_logo=False)
    return server


def close_server(server: viser.ViserServer) -> None:
    """Stops a server; viser would print that it has."""
    with redirect_stdout(io.StringIO()):
        server.stop()


def _listen(host: str, port: int) -> socket.socket:
    """A listening socket. Of our own, because viser takes the port for one of a thousand."""
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        # For `localhost` that of IPv4, which `ssh -L` is given.
        family, *_, address = min(found, key=lambda one: one[0] != socket.AF_INET)
        for candidate in range(port, min(port + _PORTS_TRIED, 65536)) if port else (0,):
            try:
                return socket.create_server((address[0], candidate), family=family)
            except OSError as failed:
                if failed.errno != errno.EADDRINUSE:
                    raise
        reason = "no port is free"
    except (OSError, ValueError) as failed:
        reason = getattr(failed, "strerror", None) or str(failed)
    raise ConfigError(f"view.host={host} view.port={port}: cannot listen there ({reason})")


@contextmanager
def _guarded(guard: Guard, listening: socket.socket) -> Iterator[list[bool]]:
    """Has the next server that viser starts ask `guard` first, and listen at `listening`.

    viser has no argument for that. Yields a list that is not empty once it has happened.
    """
    real, used = websockets.asyncio.server.serve, []

    def serve(handler: Any, _host: Any, _port: Any, *, process_request: Any, **others: Any) -> Any:
        used.append(True)

        def checked(connection: Any, request: Request) -> Any:
            refused = _check(guard, request)
            return refused if refused is not None else process_request(connection, request)

        others |= {"sock": listening, "process_request": checked, "logger": _logger()}
        return real(handler, **others)

    websockets.asyncio.server.serve = serve
    try:
        yield used
    finally:
        websockets.asyncio.server.serve = real


def _logger() -> logging.Logger:
    """What websockets complains to: not of what is no request, which anybody may send."""
    logger = logging.Logger("gmijax.viewer", logging.WARNING)
    logger.addFilter(lambda record: record.getMessage() != "opening handshake failed")
    return logger


def _check(guard: Guard, request: Request) -> Response | None:
    """The answer to a request that is refused; takes the token out of the path of others."""
    headers = request.headers
    why = guard.refusal(request.path, headers.get_all("Host"), headers.get_all("Origin"))
    if why is not None:
        body = f"{why}\n".encode()
        sent = Headers({"Content-Type": "text/plain", "Content-Length": str(len(body))})
        return Response(http.HTTPStatus.FORBIDDEN, "Forbidden", sent, body)
    path = urlsplit(request.path).path
    request.path = path.replace(f"/{guard.token}", "", 1) or "/"
    return None
