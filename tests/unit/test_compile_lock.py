"""The lock of a program in the compilation cache, within one process."""

from __future__ import annotations

import errno
import fcntl
from contextlib import nullcontext
from pathlib import Path

import pytest

from gmijax.runs import compile_lock
from gmijax.runs.compile_lock import compile_alone


@pytest.fixture
def locked(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """What `flock` was called with."""
    calls: list[int] = []
    inner = fcntl.flock

    def flock(fd: int, operation: int) -> None:
        calls.append(operation)
        inner(fd, operation)

    monkeypatch.setattr(fcntl, "flock", flock)
    return calls


def compile_entry(cache: Path, name: str = "jit_f-1-cache") -> str:
    (cache / name).touch()
    return "program"


def test_nobody_takes_the_lock_while_the_entry_is_there(tmp_path: Path, locked: list[int]) -> None:
    cache = tmp_path / "cache"
    for _ in range(3):
        assert compile_alone(cache, "jit_f", "k", lambda: compile_entry(cache)) == "program"
    assert len(locked) == 1
    assert compile_alone(cache, "jit_f", "other", lambda: compile_entry(cache)) == "program"
    assert len(locked) == 2
    (cache / "jit_f-1-cache").unlink()
    compile_alone(cache, "jit_f", "k", lambda: compile_entry(cache))
    assert len(locked) == 3


def test_a_program_that_cannot_be_kept_is_compiled_alone_once(
    tmp_path: Path, locked: list[int]
) -> None:
    for _ in range(3):
        compile_alone(tmp_path, "jit_f", "k", lambda: None)
    assert len(locked) == 1


def test_a_compiler_that_fails_leaves_no_lock_and_no_mark(
    tmp_path: Path, locked: list[int]
) -> None:
    with pytest.raises(ZeroDivisionError):
        compile_alone(tmp_path, "jit_f", "k", lambda: 1 // 0)
    compile_alone(tmp_path, "jit_f", "k", lambda: compile_entry(tmp_path))
    assert locked == [fcntl.LOCK_EX | fcntl.LOCK_NB] * 2


def test_without_locks_nobody_waits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.ENOTSUP, "not supported")

    monkeypatch.setattr(fcntl, "flock", refuse)
    assert compile_alone(tmp_path, "jit_f", "k", lambda: compile_entry(tmp_path)) == "program"
    (tmp_path / "file").touch()
    assert compile_alone(tmp_path / "file" / "cache", "jit_f", "k", lambda: "program") == "program"


def test_a_process_that_waits_reports_it_and_finds_what_was_compiled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[str] = []

    def flock(_: int, operation: int) -> None:
        calls.append("unlocks" if operation == fcntl.LOCK_UN else "asks")
        if calls.count("asks") < 3:
            raise BlockingIOError
        (tmp_path / "jit_f-k-lock").write_text("jit_f-1-cache")
        compile_entry(tmp_path)

    monkeypatch.setattr(fcntl, "flock", flock)
    monkeypatch.setattr(compile_lock, "ON_WAIT", [lambda: nullcontext(calls.append("waits"))])
    assert compile_alone(tmp_path, "jit_f", "k", lambda: "loaded") == "loaded"
    assert calls == ["asks", "waits", "asks", "asks", "unlocks"]
    # It was loaded after the lock was given back, so it has written nothing.
    assert (tmp_path / "jit_f-k-lock").read_text() == "jit_f-1-cache"


def test_a_lock_that_nobody_releases_is_not_waited_for_without_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def flock(*_: object) -> None:
        raise BlockingIOError

    monkeypatch.setattr(fcntl, "flock", flock)
    monkeypatch.setattr(compile_lock, "LONGEST_WAIT_S", 0.0)
    assert compile_alone(tmp_path, "jit_f", "k", lambda: compile_entry(tmp_path)) == "program"
    # Later ones find what it has compiled.
    assert (tmp_path / "jit_f-k-lock").read_text() == "jit_f-1-cache"
