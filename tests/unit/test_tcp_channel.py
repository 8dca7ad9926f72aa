"""Channels over TCP: both ends in one process, what goes wrong with connections."""

from __future__ import annotations

import os
import socket
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

import pytest

from gmijax.channels import tcp_channel
from gmijax.channels.tcp_channel import RemoteReader, RemoteWriter
from gmijax.collectives.nodes.handshake import Key, call
from gmijax.collectives.nodes.rendezvous import reserved_address
from gmijax.errors import CollectiveError, ConfigError, PeerLost, PipeClosed

CAPACITY = 2**20
SECRET = os.urandom(32)
SILENT_S = 0.3


@pytest.fixture
def address() -> Iterator[str]:
    with reserved_address("127.0.0.1") as reserved:
        yield reserved


def ends(address: str, **options: float) -> tuple[RemoteReader, RemoteWriter]:
    return (
        RemoteReader(address, 1, 0, CAPACITY, SECRET),
        RemoteWriter(address, 0, 1, CAPACITY, SECRET, **options),
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


def why_lost(reader: RemoteReader, longest_s: float = 30.0) -> Any:
    """Why nothing comes any more; None if something still may after so long."""
    until_s = time.monotonic() + longest_s
    while time.monotonic() < until_s:
        assert reader.try_get() is None
        if (error := reader.why_lost("receive", 0)) is not None:
            return error
        time.sleep(0.002)
    return None


def at(address: str) -> tuple[str, int]:
    host, _, port = address.rpartition(":")
    return host, int(port)


@contextmanager
def agent(address: str, caller: tuple[int, int] = (0, 1)) -> Iterator[socket.socket]:
    """A connection that has proved all, for one that then does not behave."""
    key = Key(SECRET, "GMI 1")
    until_s = time.monotonic() + 20.0
    connection = call(at(address), key, caller, lambda: until_s - time.monotonic())
    with connection:
        connection.settimeout(20.0)
        yield connection


def message(*parts: bytes) -> bytes:
    lengths = b"".join(struct.pack("<Q", len(part)) for part in parts)
    return struct.pack("<I", len(parts)) + lengths + b"".join(parts)


def data(sequence: int) -> bytes:
    return message(tcp_channel.HEADER.pack(tcp_channel.DATA, sequence), bytes([66]))


def test_nobody_listens_once_the_agent_is_there_and_its_death_is_seen_at_once(
    address: str,
) -> None:
    reader = RemoteReader(address, 1, 0, CAPACITY, SECRET)
    with agent(address) as connection:
        connection.sendall(data(0))
        assert receive(reader, 1) == [66]
        for _ in range(100):
            with pytest.raises(ConnectionRefusedError):
                socket.create_connection(at(address), 5.0)
        connection.sendall(data(1))
        assert receive(reader, 1) == [66]
    # It is gone without a goodbye, as if it were killed.
    assert isinstance(why_lost(reader, 2.0), PeerLost)
    reader.close()


@pytest.mark.parametrize("kind", ["quick", "silent", "other job"])
def test_clients_without_the_secret_neither_deliver_nor_keep_the_agent_out(
    kind: str, address: str
) -> None:
    reader = RemoteReader(address, 1, 0, CAPACITY, SECRET)
    with ExitStack() as held:
        for _ in range(1000 if kind == "quick" else 0):
            with suppress(OSError), socket.create_connection(at(address), 5.0) as client:
                client.sendall(b"noise" * 600)
        for _ in range(50 if kind == "silent" else 0):
            held.enter_context(socket.create_connection(at(address), 5.0))
        if kind == "other job":
            other = RemoteWriter(address, 0, 1, CAPACITY, os.urandom(32), farewell_s=0.0)
            held.callback(other.close)
            send(other, 66)
        assert why_lost(reader, SILENT_S) is None
        writer = RemoteWriter(address, 0, 1, CAPACITY, SECRET)
        send(writer, 1)
        assert receive(reader, 1) == [1]
    writer.close()
    reader.close()


def test_another_gmi_of_the_job_is_not_the_agent(address: str) -> None:
    reader = RemoteReader(address, 1, 0, CAPACITY, SECRET)
    with agent(address, caller=(2, 1)) as other:
        other.sendall(data(0))
        assert why_lost(reader, SILENT_S) is None
    reader.close()


def test_an_agent_that_stalls_within_a_message_is_there_until_it_leaves(address: str) -> None:
    reader = RemoteReader(address, 1, 0, CAPACITY, SECRET)
    with agent(address) as connection:
        connection.sendall(data(0) + data(1)[:-1])
        assert receive(reader, 1) == [66]
        assert why_lost(reader, SILENT_S) is None
    assert isinstance(why_lost(reader), PeerLost)
    reader.close()


def test_what_an_agent_sent_before_its_end_arrives_though_nothing_can_be_answered(
    address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def send(*_: Any) -> bool:
        raise BrokenPipeError

    monkeypatch.setattr("gmijax.channels.tcp_connection.Outgoing.send", send)
    reader = RemoteReader(address, 1, 0, CAPACITY, SECRET)
    with agent(address) as connection:
        connection.sendall(data(0) + data(1))
    assert receive(reader, 2) == [66, 66]
    assert isinstance(why_lost(reader), PeerLost)
    reader.close()


@pytest.mark.parametrize(
    "lengths",
    [[2**32 - 1], [1, CAPACITY], [1, 2**64 - 1], [3, 2**63, 2**63, 0], [CAPACITY // 8 + 1]],
)
def test_a_length_that_cannot_be_is_refused_before_memory_is_taken(
    lengths: list[int], address: str
) -> None:
    """Also from one who has the secret. The first number is how many parts follow."""
    reader = RemoteReader(address, 1, 0, CAPACITY, SECRET)
    with agent(address) as connection:
        connection.sendall(data(0))
        connection.sendall(
            struct.pack("<I", lengths[0]) + struct.pack("<3Q", *(*lengths[1:], 0, 0, 0)[:3])
        )
        assert receive(reader, 1) == [66]
        with pytest.raises(
            CollectiveError, match=r"GMI 1: GMI 0 sends a message of \d+ (parts|bytes)"
        ):
            why_lost(reader)
        with pytest.raises(CollectiveError, match="GMI 0 sends a message of"):
            reader.try_get()
        with suppress(ConnectionError):
            while connection.recv(4096):  # Until the other end closes it.
                pass
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
    address: str,
) -> None:
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


def test_an_agent_does_not_wait_for_a_trainer_that_has_left(address: str) -> None:
    reader, writer = ends(address, farewell_s=60.0)
    send(writer, 1)
    assert receive(reader, 1) == [1]
    send(writer, 2)
    reader.close()
    started_s = time.monotonic()
    writer.close()
    assert time.monotonic() - started_s < 30.0  # Less than for one that is there.


def test_an_agent_does_not_wait_for_ever_for_a_trainer_that_never_comes(address: str) -> None:
    writer = RemoteWriter(address, 0, 1, CAPACITY, SECRET, farewell_s=0.1)
    send(writer, 1)
    closing = threading.Thread(target=writer.close)
    closing.start()
    closing.join(60.0)
    assert not closing.is_alive()


def test_an_address_that_cannot_be_is_named() -> None:
    with pytest.raises(CollectiveError, match=r"no connection with GMI 0 at 127.0.0.1 "):
        RemoteReader("127.0.0.1", 1, 0, CAPACITY, SECRET)


def test_what_is_no_message_of_a_channel_is_an_error(address: str) -> None:
    reader = RemoteReader(address, 1, 0, CAPACITY, SECRET)
    with agent(address) as connection:
        for junk in ([], [b""], [b"junk"], [b"x" * tcp_channel.HEADER.size]):
            connection.sendall(message(*junk))
            with pytest.raises(CollectiveError, match="GMI 1: no message of a channel from GMI 0"):
                receive(reader, 1)
        connection.sendall(data(0))
        assert receive(reader, 1) == [66]
    reader.close()


def test_a_message_is_missed_when_it_is_lost(address: str) -> None:
    reader = RemoteReader(address, 1, 0, CAPACITY, SECRET)
    with agent(address) as connection:
        connection.sendall(data(0) + data(2))
        assert receive(reader, 1) == [66]
        with pytest.raises(CollectiveError, match="message 1 from GMI 0 is lost, here is message"):
            receive(reader, 1)
    reader.close()


def test_a_secret_that_can_be_guessed_is_refused(address: str) -> None:
    with pytest.raises(ConfigError, match="a secret of 5 bytes: TCP needs 16 or more"):
        RemoteReader(address, 1, 0, CAPACITY, b"short")
