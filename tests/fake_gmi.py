"""A GMI without jax, the stand-in for the real worker; `FAKE_GMI_MODES` says what each does."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from gmijax.errors import CollectiveTimeout, ConfigError, PeerLost
from gmijax.machine.mps_control import PIPE_VARIABLE
from gmijax.machine.processes import identify
from gmijax.runs.compile_lock import compile_alone
from gmijax.runs.folder import read_json, write_json
from gmijax.supervise.child import ChildLink

TICK_S = 0.02


def clean(link: ChildLink) -> None:
    """Three iterations and out; shows its cores and leaves a mark in what GMIs share."""
    sys.stdout.write(f"{sorted(os.sched_getaffinity(0))}\n")
    if link.exchange_fd is not None:
        os.pwrite(link.exchange_fd, b"x", link.gmi)
    for iteration in range(3):
        link.beat("running", iteration)
        time.sleep(TICK_S)
    link.beat("done", 3)


def train(link: ChildLink) -> None:
    """Iterates until asked to stop, then saves."""
    iteration = 0
    while not link.stop_requested:
        iteration += 1
        link.beat("running", iteration)
        time.sleep(TICK_S)
    (link.paths.root / "saved").write_text(str(iteration))
    link.beat("done", iteration)


def long_iteration(link: ChildLink) -> None:
    """Looks for a request to stop only once an iteration has ended."""
    link.beat("running", 1)
    while (link.run.root / "hold_iteration").exists():
        time.sleep(TICK_S)
    train(link)


def ignore_stop(link: ChildLink) -> None:
    """Never looks at requests to stop, beats on."""
    while True:
        link.beat("running", 1)
        time.sleep(TICK_S)


def stubborn(link: ChildLink) -> None:
    """Is stopped, so that it cannot obey an order."""
    link.beat("running", 1)
    write_json(link.paths.root / "helper.json", {"pid": os.getpid()})
    os.kill(os.getpid(), signal.SIGSTOP)


def linger(link: ChildLink) -> None:
    """Is done, but a thread of it is not."""
    threading.Thread(target=time.sleep, args=(600,)).start()
    link.beat("done", 3)


def busy(link: ChildLink) -> None:
    """Computes without a pause, and has a child process."""
    helper = os.fork()
    if helper == 0:
        time.sleep(600)
    write_json(link.paths.root / "helper.json", {"pid": helper})
    link.beat("running", 1)
    while True:
        pass


def exit_3(link: ChildLink) -> None:
    """Fails without error.json."""
    sys.stderr.write("first line\nthe last line\n\n")
    sys.exit(3)


def exit_beside_stopped(link: ChildLink) -> None:
    """Fails once GMI 0 is stopped."""
    other = link.run.gmi(0).root / "helper.json"
    while not other.exists() or not has_stopped(read_json(other)["pid"]):
        time.sleep(TICK_S)
    sys.exit(3)


def has_stopped(pid: int) -> bool:
    """Whether SIGSTOP has come to a process: until then its other threads may still act."""
    return b") T " in Path(f"/proc/{pid}/stat").read_bytes()


def raise_value_error(link: ChildLink) -> None:
    """Fails with error.json."""
    error = ValueError("the sum is off\nby one")
    link.report_error(error)
    sys.exit(1)


def raise_config_error(link: ChildLink) -> None:
    """Finds that the input is bad."""
    link.report_error(ConfigError("env.name=antt: did you mean ant?"))
    sys.exit(1)


def lose_peer(link: ChildLink) -> None:
    """Fails like a communicator does, at once when GMI 1 is gone."""
    peer = link.run.gmi(1).root / "helper.json"
    while not peer.exists() or identify(read_json(peer)["pid"]):
        link.beat("running", 1)
    link.report_error(PeerLost(gmi=link.gmi, peer=1, operation="mean", step=7))
    sys.exit(1)


def wait_in_vain(link: ChildLink) -> None:
    """Fails like a communicator does when GMI 1 does not come."""
    while not (link.run.gmi(1).root / "stalling").exists():
        link.beat("running", 1)
        time.sleep(TICK_S)
    time.sleep(0.2)
    link.report_error(CollectiveTimeout(0, (1,), "mean", 7, 5.0))
    sys.exit(1)


def die_late(link: ChildLink) -> None:
    """Names a helper as its process; that is gone before this one, and GMI 0 fails for it."""
    helper = os.fork()
    if helper == 0:
        time.sleep(0.2)
        os._exit(0)
    write_json(link.paths.root / "helper.json", {"pid": helper})
    os.waitpid(helper, 0)
    while not link.run.gmi(0).error.exists():
        time.sleep(TICK_S)
    time.sleep(0.1)
    os.kill(os.getpid(), signal.SIGSEGV)


def die_soon(link: ChildLink) -> None:
    """Fails in a moment."""
    time.sleep(0.1)
    os.kill(os.getpid(), signal.SIGSEGV)


def stall(link: ChildLink) -> None:
    """Stops to make progress."""
    link.beat("running", 5)
    (link.paths.root / "stalling").touch()
    time.sleep(600)


def silent(link: ChildLink) -> None:
    """Never says anything."""
    time.sleep(600)


def mps_client(link: ChildLink) -> None:
    """Trains as a client of the fake MPS daemon."""
    client = Path(os.environ[PIPE_VARIABLE]) / "clients" / str(os.getpid())
    client.touch()
    link.beat("ready", 0)
    train(link)


def mps_client_in_a_call(link: ChildLink) -> None:
    """A client of the fake MPS daemon that a call of C holds, with all threads of Python."""
    client = Path(os.environ[PIPE_VARIABLE]) / "clients" / str(os.getpid())
    link.beat("ready", 0)
    client.touch()
    ctypes.PyDLL(None).sleep(600)


MODES: dict[str, Callable[[ChildLink], None]] = {
    mode.__name__: mode
    for mode in (
        *(clean, train, ignore_stop, stubborn, busy, exit_3, raise_value_error),
        *(lose_peer, wait_in_vain, die_late, die_soon, stall, silent, mps_client, linger),
        *(raise_config_error, exit_beside_stopped, mps_client_in_a_call, long_iteration),
    )
}


def compile_program(link: ChildLink) -> None:
    """Leaves an entry of the cache, as jax does, and counts how often it had to."""
    while (link.run.root / "hold").exists():
        time.sleep(TICK_S)
    entry = link.run.root / "cache" / "fake-1-cache"
    if not entry.exists():
        with (link.run.root / "compiled").open("a") as count:
            count.write("1")
    entry.touch()


def main() -> None:
    link = ChildLink.from_environment()
    mode = MODES[os.environ["FAKE_GMI_MODES"].split(",")[link.gmi]]
    if mode is not silent:
        link.beat("starting", 0)
        link.begin_compiling()
        compile_alone(link.run.root / "cache", "fake", "1", partial(compile_program, link))
        link.end_part("compiling")
        write_json(link.paths.root / "start_s.json", link.start_s)
        if mode is not mps_client:
            link.beat("ready", 0)
    mode(link)


if __name__ == "__main__":
    main()
