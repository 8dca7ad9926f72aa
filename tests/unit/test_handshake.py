"""Who gets in at a listener of a job, and what clients without the key cost: real sockets."""

from __future__ import annotations

import errno
import math
import os
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager, suppress
from typing import Any

import pytest

from gmijax.collectives.nodes import handshake
from gmijax.collectives.nodes.handshake import Key, Unreachable, accepted, call
from gmijax.collectives.nodes.rendezvous import NodeAddresses, connect, listen
from gmijax.errors import CollectiveError

HERE = "127.0.0.1"
KEY = Key(os.urandom(32), "node 0")
CALLER = (7, 1)
# What a browser sends first: a record of TLS 1.2 with a ClientHello of 512 bytes.
TLS = b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + os.urandom(506)
SENT = {
    "noise": os.urandom(3000),
    "tls": TLS,
    "http": b"GET / HTTP/1.1\r\nHost: somewhere\r\n\r\n" * 3,
    "zeros": bytes(72),
    "short": b"x",
    "nothing": b"",
}


@pytest.fixture
def listener() -> Iterator[socket.socket]:
    with listen(HERE) as found:
        yield found


def seconds(timeout_s: float) -> Callable[[], float]:
    until_s = time.monotonic() + timeout_s
    return lambda: until_s - time.monotonic()


def first(listener: socket.socket, timeout_s: float = 20.0) -> tuple[int, int] | None:
    """Who gets in first; None if nobody does in time."""
    with closing(accepted(listener, KEY, seconds(timeout_s))) as callers:
        for connection, caller in callers:
            connection.close()
            return caller
    return None


def come(listener: socket.socket, key: Key = KEY, timeout_s: float = 20.0) -> threading.Thread:
    """Somebody who calls, in a thread."""

    def run() -> None:
        with suppress(OSError):
            call(listener.getsockname(), key, CALLER, seconds(timeout_s)).close()

    thread = threading.Thread(target=run)
    thread.start()
    return thread


def unknown_client(listener: socket.socket, sent: bytes = b"") -> socket.socket:
    """The connection of a client without the key."""
    connection = socket.create_connection(listener.getsockname(), 5.0)
    connection.sendall(sent)
    return connection


def is_closed_by_peer(connection: socket.socket, timeout_s: float = 10.0) -> bool:
    connection.settimeout(timeout_s)
    try:
        while connection.recv(4096):
            pass
    except TimeoutError:
        return False
    except ConnectionError:
        pass
    return True


def test_both_ends_learn_that_the_other_knows_the_key(listener: socket.socket) -> None:
    thread = come(listener)
    assert first(listener) == CALLER
    thread.join()


@pytest.mark.parametrize("kind", SENT)
@pytest.mark.parametrize("leaves", [False, True])
def test_a_client_without_proof_is_disconnected_and_keeps_nobody_out(
    kind: str, leaves: bool, listener: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(handshake, "PROOF_TIMEOUT_S", 0.2)
    with unknown_client(listener, SENT[kind]) as other:
        if leaves:
            other.shutdown(socket.SHUT_WR)
        thread = come(listener)
        assert first(listener) == CALLER
        thread.join()
        assert first(listener, 0.3) is None
        assert is_closed_by_peer(other)


def test_a_client_that_sends_slowly_has_no_more_time_than_others(
    listener: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(handshake, "PROOF_TIMEOUT_S", 0.3)
    with unknown_client(listener) as other:
        started_s = time.monotonic()
        accepting = threading.Thread(target=first, args=(listener, 2.0))
        accepting.start()
        with suppress(ConnectionError):
            while time.monotonic() - started_s < 2.0:
                other.sendall(b"x")
                time.sleep(0.02)  # 72 of them would take 1.5 s.
        assert time.monotonic() - started_s < 1.3
        accepting.join()


def _proof_of_another_call(listener: socket.socket) -> bytes:
    """What a caller sends to a listener of the same job, as somebody on the way sees it."""
    with listen(HERE) as other:
        thread = come(other, timeout_s=0.2)
        connection, _ = other.accept()
        with connection:
            connection.settimeout(5.0)
            received = connection.recv(32, socket.MSG_WAITALL)
            connection.sendall(bytes(32))
            received += connection.recv(40, socket.MSG_WAITALL)
        thread.join()
    return received


def test_what_was_sent_once_proves_nothing_later(listener: socket.socket) -> None:
    received = _proof_of_another_call(listener)
    assert len(received) == 72
    with unknown_client(listener, received) as other:
        assert first(listener, 0.5) is None
        assert is_closed_by_peer(other)


def test_what_the_listener_sends_proves_nothing_to_itself(listener: socket.socket) -> None:
    with ThreadPoolExecutor(1) as pool, unknown_client(listener, bytes(32)) as other:
        answer = pool.submit(first, listener, 0.5)
        nonce = other.recv(32, socket.MSG_WAITALL)
        caller = struct.pack("<II", *CALLER)
        # The proof that the listener itself would send.
        other.sendall(caller + KEY.proof(b"hears", caller, bytes(32) + nonce))
        assert answer.result() is None
        assert is_closed_by_peer(other)


@pytest.mark.parametrize("key", [Key(os.urandom(32), "node 0"), Key(KEY.token, "node 1")])
def test_another_token_or_what_was_meant_for_another_listener_stays_out(
    key: Key, listener: socket.socket
) -> None:
    thread = come(listener, key, timeout_s=0.6)
    assert first(listener, 0.6) is None
    thread.join()


def test_a_caller_does_not_trust_a_listener_without_the_token() -> None:
    with listen(HERE) as false:

        def answer() -> None:
            connection, _ = false.accept()
            with connection:
                connection.sendall(os.urandom(32))
                connection.recv(72, socket.MSG_WAITALL)
                connection.sendall(os.urandom(32))

        thread = threading.Thread(target=answer)
        thread.start()
        with pytest.raises(OSError, match=r"not of this job|does not answer"):
            call(false.getsockname(), KEY, CALLER, seconds(0.5))
        thread.join()


def test_many_silent_clients_keep_nobody_out_and_few_are_held(listener: socket.socket) -> None:
    """More than the listener would hold, and all there before the one that counts."""
    with ExitStack() as held:
        others = [held.enter_context(unknown_client(listener)) for _ in range(100)]
        started_s = time.monotonic()
        thread = come(listener)
        with closing(accepted(listener, KEY, seconds(20.0))) as callers:
            connection, caller = next(callers)
            held.callback(connection.close)
            assert caller == CALLER
            assert time.monotonic() - started_s < handshake.PROOF_TIMEOUT_S
            waiting = [one for one in others if not is_closed_by_peer(one, 0.001)]
            assert len(waiting) <= handshake.MAX_UNAUTHENTICATED
        thread.join()
        assert all(is_closed_by_peer(one) for one in others)


def test_a_caller_that_was_disconnected_to_make_room_calls_again(listener: socket.socket) -> None:
    thread = come(listener)
    dropped, _ = listener.accept()
    dropped.close()
    assert first(listener) == CALLER
    thread.join()


class _Exhausted(socket.socket):
    """A listener in a process without descriptors, at first."""

    failures = 3

    def accept(self) -> Any:
        self.failures -= 1
        if self.failures >= 0:
            raise OSError(errno.EMFILE, "Too many open files")
        return super().accept()


def test_a_lack_of_descriptors_passes(listener: socket.socket) -> None:
    with _Exhausted(fileno=listener.detach()) as exhausted:
        thread = come(exhausted)
        assert first(exhausted) == CALLER
        thread.join()


def test_no_listener_and_a_silent_listener_are_different_errors() -> None:
    with listen(HERE) as gone:
        address = gone.getsockname()
    with pytest.raises(Unreachable, match="Connection refused"):
        call(address, KEY, CALLER, seconds(5.0))
    with listen(HERE) as silent, pytest.raises(OSError, match="does not answer") as caught:
        call(silent.getsockname(), KEY, CALLER, seconds(0.3))
    assert not isinstance(caught.value, Unreachable)


@contextmanager
def disturbed(listener: socket.socket, kind: str) -> Iterator[None]:
    """Five clients without the key, which connect again when their connection is closed."""
    over = threading.Event()

    def disturb() -> None:
        while not over.is_set():
            with suppress(OSError), unknown_client(listener, SENT.get(kind, b"")) as other:
                while not over.wait(0.005 if kind == "noise" else 0.05):
                    other.sendall(b"x" if kind == "drip" else b"")
                    if kind == "noise":
                        break

    threads = [threading.Thread(target=disturb) for _ in range(5)]
    for thread in threads:
        thread.start()
    yield
    over.set()
    for thread in threads:
        thread.join()


@pytest.mark.parametrize("kind", ["drip", "silent", "noise"])
def test_leaders_connect_or_give_up_in_time_whoever_else_connects(kind: str) -> None:
    """Node 1 comes to node 0, whatever other clients do; node 2 never comes."""
    with ExitStack() as held:
        listeners = [held.enter_context(listen(HERE)) for _ in range(3)]
        addresses = tuple((HERE, one.getsockname()[1]) for one in listeners)
        held.enter_context(disturbed(listeners[0], kind))
        time.sleep(0.1)

        def error_of(node: int) -> str:
            with pytest.raises(CollectiveError) as caught:
                connect(NodeAddresses(node, addresses, KEY.token), listeners[node], 2, 1.0)
            return str(caught.value)

        started_s = time.monotonic()
        with ThreadPoolExecutor(2) as pool:
            answers = list(pool.map(error_of, (0, 1)))
        assert time.monotonic() - started_s < 2.0
    assert answers == [
        f"node {node}: the leaders of other nodes did not come: 2" for node in (0, 1)
    ]


def test_a_listener_can_wait_without_an_end(listener: socket.socket) -> None:
    left = iter([math.inf, math.inf, 0.0])
    assert list(accepted(listener, KEY, lambda: next(left))) == []
