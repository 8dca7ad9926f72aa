"""The thread for calls that may never come back."""

from __future__ import annotations

import subprocess
import sys


def test_a_process_with_a_stuck_call_ends_all_the_same() -> None:
    # The function at exit stands for a library that waits for its call for ever.
    code = """
import atexit, threading
from gmijax.collectives.device.watched_thread import WatchedThread
atexit.register(threading.Event().wait)
def wait(done):
    assert not done.wait(0.2)
    raise TimeoutError("nobody came")
WatchedThread().run(threading.Event().wait, wait)
"""
    done = subprocess.run(
        [sys.executable, "-c", code], check=False, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 1
    assert "TimeoutError: nobody came" in done.stderr
