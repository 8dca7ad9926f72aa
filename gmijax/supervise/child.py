"""The GMI's side of supervision; stdlib only, so that it runs before jax is imported.

The controller holds the write end of a pipe per GMI, the *lifeline*. One byte asks a GMI to
finish, one ends it at once; end of file means that the controller is gone, however it ended, and
so must the GMI be. While the lifeline holds a GMI ignores the signals that ask for an end: a batch
system sends them to every process of a job, and the controller decides what becomes of it.
"""

from __future__ import annotations

import atexit
import faulthandler
import gc
import io
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final

from gmijax.errors import CollectiveTimeout, ConfigError, ReportedError
from gmijax.runs.compile_lock import ON_WAIT
from gmijax.runs.folder import GmiPaths, RunPaths, write_json
from gmijax.supervise.heartbeat import GmiState, Heartbeat, HeartbeatBlock
from gmijax.supervise.stop_signals import STOP_SIGNALS

ENV_GMI: Final = "GMIJAX_GMI"
ENV_CPUS: Final = "GMIJAX_CPUS"
ENV_RUN_DIR: Final = "GMIJAX_RUN_DIR"
ENV_LIFELINE_FD: Final = "GMIJAX_LIFELINE_FD"
ENV_EXCHANGE_FD: Final = "GMIJAX_EXCHANGE_FD"
ENV_PIPES_FD: Final = "GMIJAX_PIPES_FD"
ENV_HEARTBEAT_FD: Final = "GMIJAX_HEARTBEAT_FD"

STOP_BYTE: Final = b"s"
END_BYTE: Final = b"e"

_WRITERS: Final = (io.TextIOWrapper, io.BufferedWriter, io.BufferedRandom)
"""Files that a role or a task may have left open."""

STACKS_SIGNAL: Final = signal.SIGUSR2
"""Makes a GMI write the stacks of all its threads to its log."""


class ChildLink:
    """The link of this process to the controller.

    Attributes:
      gmi: id of this GMI.
      run: files of the run.
      paths: files of this GMI.
      exchange_fd: inherited file of the gradient exchange, None where there is none.
      start_s: seconds of the parts of the start that are over, by name; see `end_part`. Those for
        which other processes compiled are `waiting` alone.

    Args:
      heartbeat_fd: inherited memory for beats and errors, None where no process reads them.
    """

    def __init__(
        self,
        gmi: int,
        run: RunPaths,
        lifeline_fd: int | None,
        exchange_fd: int | None,
        *,
        heartbeat_fd: int | None = None,
    ) -> None:
        self.gmi = gmi
        self.run = run
        self.exchange_fd = exchange_fd
        self.paths: GmiPaths = run.gmi(gmi)
        self._stop = threading.Event()
        self._block = HeartbeatBlock(heartbeat_fd)
        self._keeps_garbage = False
        self.start_s: dict[str, float] = {"waiting": 0.0}
        self._part_began_s = time.monotonic()
        if lifeline_fd is not None:
            threading.Thread(
                target=self._hold_lifeline, args=(lifeline_fd,), name="lifeline", daemon=True
            ).start()

    @classmethod
    def from_environment(cls, environment: Mapping[str, str] = os.environ) -> ChildLink:
        """Pins this process to its CPU cores and opens the link; call it before jax starts.

        Without a lifeline in the environment (a worker started by hand, to debug it) nothing
        can ask the process to stop, and everything else works.

        Raises:
          ConfigError: the process was not started as a GMI, or inherited no such descriptor.
        """
        try:
            gmi, run_dir = int(environment[ENV_GMI]), environment[ENV_RUN_DIR]
        except (KeyError, ValueError):
            raise ConfigError(
                f"{ENV_GMI} and {ENV_RUN_DIR} must be set: GMIs are started by gmijax.train"
            ) from None
        if cpus := environment.get(ENV_CPUS):
            os.sched_setaffinity(0, {int(cpu) for cpu in cpus.split(",")})
        lifeline_fd = inherited_fd(environment, ENV_LIFELINE_FD)
        if lifeline_fd is not None:
            _leave_signals_to_controller()
        link = cls(
            gmi,
            RunPaths(Path(run_dir)),
            lifeline_fd,
            inherited_fd(environment, ENV_EXCHANGE_FD),
            heartbeat_fd=inherited_fd(environment, ENV_HEARTBEAT_FD),
        )
        ON_WAIT[:] = [link.waiting]
        return link

    @property
    def stop_requested(self) -> bool:
        """Whether the controller asked for an end: finish the iteration, save, return."""
        return self._stop.is_set()

    def keep_garbage(self) -> None:
        """Lets Python collect no cycles before this GMI is ready.

        Imports and traces make millions of objects that stay. Python would look through them
        again and again, which is a fifth of the time that a start takes.
        """
        gc.disable()
        self._keeps_garbage = True

    def end_part(self, name: str) -> None:
        """Ends a part of the start, which began with the end of the one before."""
        now_s = time.monotonic()
        self.start_s[name] = now_s - self._part_began_s
        self._part_began_s = now_s

    def begin_compiling(self) -> None:
        """Reports that this GMI compiles from now on."""
        self.end_part("tracing")
        self.beat("compiling", 0)

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """While another process compiles: a time limit of the controller does not run."""
        before, began_s = self._block.read(), time.monotonic()
        self.beat("waiting", 0 if before is None else before.iteration)
        try:
            yield
        finally:
            waited_s = time.monotonic() - began_s
            self.start_s["waiting"] += waited_s
            self._part_began_s += waited_s
            if before is not None:
                self.beat(before.state, before.iteration)

    def beat(self, state: GmiState, iteration: int) -> None:
        """Reports progress; costs microseconds."""
        if self._keeps_garbage and state not in ("starting", "waiting", "compiling"):
            self._keeps_garbage = False
            gc.freeze()  # Never looked through again.
            gc.enable()
        self._block.write(Heartbeat(state, iteration, os.getpid()))

    def report_error(self, error: BaseException) -> None:
        """Reports why this GMI fails, also in `error.json`; end with a non-zero code after it."""
        report = ReportedError(
            type(error).__name__,
            str(error),
            "".join(traceback.format_exception(error)),
            error.missing if isinstance(error, CollectiveTimeout) else (),
        )
        self._block.write_error(report)
        with suppress(OSError):  # The disk may be what is wrong.
            write_json(self.paths.error, report._asdict())

    def _hold_lifeline(self, lifeline_fd: int) -> None:
        while True:
            try:
                received = os.read(lifeline_fd, 16)
            except OSError:
                received = b""
            if not received or END_BYTE in received:
                _end_now()
            if STOP_BYTE in received:
                self._stop.set()


def run_gmi(routine: Callable[[ChildLink], Mapping[str, Any] | None]) -> int:
    """Main of a GMI: its routine between the first beat and the last; returns the exit code.

    What the routine returns is the content of `result.json`; None writes none.
    """
    link = ChildLink.from_environment()  # Pins the cores, so it comes before jax.
    exit_codes = [1]
    # What is registered first runs last, after what jax and others have to do at the end.
    atexit.register(_exit_without_teardown, exit_codes)
    link.beat("starting", 0)
    try:
        result = routine(link)
        if result is not None:
            write_json(link.paths.result, result)
    except BaseException as error:  # The controller must learn of every way to fail.
        link.report_error(error)
        if isinstance(error, SystemExit) and isinstance(error.code, int | None):
            exit_codes[:] = [error.code or 0]
        raise
    link.beat("done", 0)
    exit_codes[:] = [0]
    return 0


def _exit_without_teardown(exit_codes: list[int]) -> None:
    """Ends this process before Python takes itself apart.

    Until Python 3.13 a thread of a library that asks for the interpreter meanwhile is ended
    inside the library's C++, which aborts the process (https://github.com/python/cpython/issues/87135):
    a GMI that has done all would count as failed.
    """
    gc.unfreeze()  # Else its objects are not found.
    writers = [one for one in gc.get_objects() if issubclass(type(one), _WRITERS)]
    for stream in (sys.stdout, sys.stderr, *writers):
        with suppress(OSError, ValueError, AttributeError):  # Closed, or the disk is full.
            stream.flush()
    os._exit(exit_codes[0])


def _leave_signals_to_controller() -> None:
    # A handler and not SIG_IGN, which programs that a role starts would inherit.
    for number in STOP_SIGNALS:
        signal.signal(number, lambda *_: None)
        signal.siginterrupt(number, False)
    # The controller had them blocked, so that none could end this process until now.
    signal.pthread_sigmask(signal.SIG_UNBLOCK, STOP_SIGNALS)
    if sys.__stderr__ is not None:
        faulthandler.enable(sys.__stderr__)
        faulthandler.register(STACKS_SIGNAL, sys.__stderr__, all_threads=True)


def _end_now() -> None:
    # No clean-up: it could wait for a peer or a GPU forever, and no process is left that would
    # read the outcome. Helper processes must not stay behind either.
    if os.getpgrp() == os.getpid():
        os.killpg(0, signal.SIGKILL)
    os._exit(1)


def inherited_fd(environment: Mapping[str, str], name: str) -> int | None:
    """The open descriptor whose number stands in the variable `name`, None if it is not set.

    Raises:
      ConfigError: it is not a number, or not of an open file.
    """
    if name not in environment:
        return None
    try:
        fd = int(environment[name])
        # Processes that a GMI starts have no use for it.
        os.set_inheritable(fd, False)
    except (ValueError, OverflowError, OSError):
        raise ConfigError(
            f"{name}={environment[name]!r}: expected the number of an open descriptor"
        ) from None
    return fd


def required_fd(name: str) -> int:
    """The descriptor that this process has inherited as `name`.

    Raises:
      ConfigError: it has not, or as `inherited_fd`.
    """
    fd = inherited_fd(os.environ, name)
    if fd is None:
        raise ConfigError(f"{name} must be set: GMIs are started by a controller")
    return fd
