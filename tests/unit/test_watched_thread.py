"""The thread for calls that may never come back."""

from __future__ import annotations

import subprocess
import sys
import threading

import pytest

from gmijax.collectives.device.watched_thread import WatchedThread


def test_results_and_errors_come_back_in_order() -> None:
    thread = WatchedThread("test")
    assert [thread.run(lambda n=n: n * n, threading.Event.wait) for n in range(3)] == [0, 1, 4]
    with pytest.raises(ZeroDivisionError):
        thread.run(lambda: 1 // 0, threading.Event.wait)
    assert thread.run(lambda: "still there", threading.Event.wait) == "still there"
    thread.close()
    thread.close()


def test_a_process_with_a_stuck_call_ends_all_the_same() -> None:
    # The function at exit stands for a library that waits for its call for ever.
    code = """
import atexit, threading
from gmijax.collectives.device.watched_thread import WatchedThread
atexit.register(threading.Event().wait)
def wait(done):
    assert not done.wait(0.2)
    raise TimeoutError("nobody came")
WatchedThread("test").run(threading.Event().wait, wait)
"""
    done = subprocess.run(
        [sys.executable, "-c", code], check=False, capture_output=True, text=True, timeout=20
    )
    assert done.returncode == 1
    assert "TimeoutError: nobody came" in done.stderr
