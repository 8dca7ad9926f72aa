"""Channels over TCP: both ends in one process, what goes wrong with connections."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import pytest

from gmijax.errors import CollectiveError, ConfigError, PeerLost, PipeClosed

pytest.importorskip("zmq")

import zmq

from gmijax.collectives.channel import tcp_channel
from gmijax.collectives.channel.tcp_channel import RemoteReader, RemoteWriter
from gmijax.collectives.nodes.meeting import reserved_address

CAPACITY = 2**20
SECRET = os.urandom(32)
# What ZeroMQ says first (https://rfc.zeromq.org/spec/23), with CURVE, as one that listens.
GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"CURVE".ljust(20, b"\0") + b"\x01" + bytes(31)
PLAIN = {
    "silent": b"",
    "http": b"GET / HTTP/1.0\r\n\r\n",
    "noise": os.urandom(2**20),
    "oversized": GREETING + b"\x06" + (2**40).to_bytes(8, "big"),
}
"""What strangers send who do not use ZeroMQ."""

FORGED = tcp_channel._HEADER.pack(tcp_channel.MAGIC, tcp_channel.DATA, 0), b""


@pytest.fixture
def address() -> Iterator[str]:
    with reserved_address("127.0.0.1") as reserved:
        yield reserved


def ends(address: str) -> tuple[RemoteReader, RemoteWriter]:
    return (
        RemoteReader(address, 1, 0, CAPACITY, SECRET),
        RemoteWriter(address, 0, 1, CAPACITY, SECRET),
    )


def send(writer: RemoteWriter, *values: int) -> None:
    for value in values:
        views = writer.try_reserve([8])
        assert views is not None
        views[0][:] = value
        writer.commit()


def receive(reader: RemoteReader, count: int, longest_s: float | None = None) -> list[int]:
    """Waits for `count` values; takes fewer after `longest_s`, if that is given."""
    got: list[int] = []
    deadline_s = time.monotonic() + (longest_s or 30.0)
    while len(got) < count:
        if time.monotonic() > deadline_s:
            assert longest_s is not None, got
            break
        if (message := reader.try_get()) is not None:
            got.append(message[0].item(0))
    reader.release()
    return got


def exchange(writer: RemoteWriter, reader: RemoteReader, count: int) -> None:
    """Sends values, and gives each a second to come."""
    for value in range(count):
        send(writer, value)
        receive(reader, 1, longest_s=1.0)


def why_lost(reader: RemoteReader, looks: int) -> Any:
    """What the last of some looks says, with all read in between."""
    error = None
    for _ in range(looks):
        time.sleep(0.05)
        error = reader.why_lost("receive", 0)
        reader.try_get()
    return error


@contextmanager
def stranger(kind: str, address: str) -> Iterator[None]:
    """Somebody else at the port, who tries to deliver something."""
    host, _, port = address.rpartition(":")
    if kind == "zeromq":
        with zmq.Context() as context, context.socket(zmq.DEALER) as end:
            end.linger = 0
            end.connect(f"tcp://{address}")
            end.send_multipart(FORGED)
            yield
    elif kind == "other job":
        writer = RemoteWriter(address, 0, 1, CAPACITY, os.urandom(32))
        send(writer, 66)
        yield
        assert not writer._connection.is_up()
        writer._connection.close()
    else:
        with socket.create_connection((host, int(port)), timeout=5.0) as plain:
            with suppress(ConnectionError):
                plain.sendall(PLAIN[kind])
                # Others are hung up on after the greeting, and not only when they have given up.
                while kind in ("noise", "oversized") and plain.recv(4096):
                    pass
            yield


@pytest.mark.parametrize("kind", [*PLAIN, "zeromq", "other job"])
def test_a_stranger_delivers_nothing_and_is_not_the_end_of_the_agent(
    kind: str, address: str
) -> None:
    reader, writer = ends(address)
    send(writer, 1)
    assert receive(reader, 1) == [1]
    with stranger(kind, address):
        assert why_lost(reader, 6) is None
        assert reader._sequence == 1
    send(writer, 2)
    assert receive(reader, 1) == [2]
    writer._connection.close()  # As if it were killed.
    error = None
    while error is None:  # Until the test's own limit.
        error = why_lost(reader, 1)
    assert isinstance(error, PeerLost)
    reader.close()


def test_an_agent_stays_until_its_trainer_has_taken_all(address: str) -> None:
    reader, writer = ends(address)
    send(writer, 1, 2)
    assert receive(reader, 1) == [1]
    closing = threading.Thread(target=writer.close)
    closing.start()
    closing.join(0.3)
    assert closing.is_alive()
    assert receive(reader, 1) == [2]
    closing.join(60.0)
    assert not closing.is_alive()
    with pytest.raises(PipeClosed):
        receive(reader, 1)
    reader.close()


def test_an_agent_that_closes_before_its_trainer_listens_loses_nothing(
    address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gmijax.collectives.channel.tcp_connection._LINGER_MS", 0)
    writer = RemoteWriter(address, 0, 1, CAPACITY, SECRET)
    send(writer, 1, 2, 3)
    closing = threading.Thread(target=writer.close)
    closing.start()
    closing.join(0.3)
    reader = RemoteReader(address, 1, 0, CAPACITY, SECRET)
    assert receive(reader, 3) == [1, 2, 3]
    closing.join(60.0)
    assert not closing.is_alive()
    reader.close()


def test_an_agent_does_not_wait_for_a_trainer_that_has_left(
    address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gmijax.collectives.channel.tcp_channel._FAREWELL_S", 60.0)
    reader, writer = ends(address)
    send(writer, 1)
    assert receive(reader, 1) == [1]
    send(writer, 2)
    reader.close()
    started_s = time.monotonic()
    writer.close()
    assert time.monotonic() - started_s < 30.0  # Less than for one that is there.


def test_an_agent_does_not_wait_for_ever_for_a_trainer_that_never_comes(
    address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gmijax.collectives.channel.tcp_channel._FAREWELL_S", 0.1)
    monkeypatch.setattr("gmijax.collectives.channel.tcp_connection._LINGER_MS", 0)
    writer = RemoteWriter(address, 0, 1, CAPACITY, SECRET)
    send(writer, 1)
    writer.close()
    assert writer._connection.is_closed


def test_an_address_that_cannot_be_is_named() -> None:
    with pytest.raises(CollectiveError, match=r"no connection with GMI 0 at 127.0.0.1 "):
        RemoteReader("127.0.0.1", 1, 0, CAPACITY, SECRET)


def test_what_is_no_message_of_a_channel_is_an_error(address: str) -> None:
    reader, writer = ends(address)
    for junk in (b"", b"junk", b"x" * tcp_channel._HEADER.size):
        writer._connection.send([junk])
        with pytest.raises(CollectiveError, match="GMI 1: no message of a channel from GMI 0"):
            receive(reader, 1)
    send(writer, 7)
    assert receive(reader, 1) == [7]
    writer.close()
    reader.close()


def test_a_message_that_is_too_long_is_not_taken_and_what_follows_is_an_error(
    address: str,
) -> None:
    """Also from one who has the secret: the connection ends, and the next one misses a message."""
    reader, writer = ends(address)
    assert writer.max_message_bytes == CAPACITY // 2
    send(writer, 1)
    assert receive(reader, 1) == [1]
    writer._connection.send([FORGED[0], bytes(CAPACITY // 2 + tcp_channel.MAX_ANSWER_BYTES + 1)])
    writer._sequence += 1
    with pytest.raises(CollectiveError, match="message 1 from GMI 0 is lost, here is message"):
        exchange(writer, reader, 20)  # Those right behind it may go down with the connection.
    # An agent takes nothing but answers.
    limit = writer._connection._socket.getsockopt(zmq.MAXMSGSIZE)
    assert limit == tcp_channel.MAX_ANSWER_BYTES
    for end in (writer, reader):
        end._connection.close()


def test_a_secret_that_can_be_guessed_is_refused(address: str) -> None:
    with pytest.raises(ConfigError, match="a secret of 5 bytes: TCP needs 16 or more"):
        RemoteReader(address, 1, 0, CAPACITY, b"short")
