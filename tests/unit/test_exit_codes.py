"""Signals that reach a command where no job handles them."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from gmijax.__main__ import main
from gmijax.control.exit_codes import exit_code_of
from gmijax.supervise.stop_signals import STOP_SIGNALS


@pytest.fixture(autouse=True)
def default_signals() -> Iterator[None]:
    """Those of a command that a shell starts."""
    before = {number: signal.signal(number, signal.SIG_DFL) for number in STOP_SIGNALS}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", STOP_SIGNALS)
def test_a_signal_interrupts_a_command(
    number: signal.Signals, capsys: pytest.CaptureFixture[str]
) -> None:
    ended: list[str] = []

    def run() -> None:
        try:
            signal.raise_signal(number)
        finally:
            ended.append("cleaned up")

    assert exit_code_of("play", run) == 130
    assert capsys.readouterr().err == "gmijax.play: interrupted\n"
    assert ended
    assert signal.getsignal(number) is signal.SIG_DFL


@pytest.mark.parametrize("handler", [signal.SIG_IGN, lambda *_: None])
def test_signals_that_are_ignored_or_handled_already_are_left_alone(
    handler: signal.Handlers,
) -> None:
    signal.signal(signal.SIGHUP, handler)
    assert exit_code_of("play", lambda: signal.raise_signal(signal.SIGHUP)) == 0
    assert signal.getsignal(signal.SIGHUP) is handler


def test_a_working_directory_that_is_gone_is_called_that(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "gone"
    folder.mkdir()
    monkeypatch.chdir(folder)
    folder.rmdir()
    for line in (["train", "env=ant"], ["list_envs"], ["pack", "--", "true"]):
        assert main(line) == 2
        wanted = "the working directory no longer exists; change into another one"
        assert capsys.readouterr().err == f"gmijax.{line[0]}: {wanted}\n"
