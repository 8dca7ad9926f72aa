"""A free port of this host for the GMIs of one job, held until the job ends; stdlib only."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager

_LOCAL_HOST = "127.0.0.1"


@contextmanager
def reserved_address() -> Iterator[str]:
    """`127.0.0.1:port`, where one process of this user may listen, and nobody else.

    The port is bound here without listening, and shared (SO_REUSEPORT) with the server of a GMI.
    So it cannot go to somebody else between the choice and the server's start. Connections go
    to who listens.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as holder:
        holder.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        holder.bind((_LOCAL_HOST, 0))
        yield f"{_LOCAL_HOST}:{holder.getsockname()[1]}"
