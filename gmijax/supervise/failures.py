"""Why a GMI ended, in one line, and which of several failures came first."""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Sequence
from pathlib import Path

from gmijax import errors
from gmijax.errors import (
    CollectiveTimeout,
    GmiFailed,
    GmijaxError,
    NodeLost,
    PeerLost,
    PipeClosed,
    ReportedError,
    gist_of,
    printable,
    with_type,
)

_GPU_FAULT = re.compile(r"CUDA_ERROR_(?!OUT_OF_MEMORY)|ended by SIGABRT|MPS daemon")
"""Matches messages of jobs whose GPU faulted. XLA aborts where it cannot raise."""

_NOTHING_FITS = "All configs failed during profiling"
"""XLA's message where it has no memory to try kernels."""

_FATAL = "Fatal Python error: "
_STACKS = re.compile(
    r"(Current t|T)hread |  (File \"|<|Garbage|Binary file|\.\.\.)|Extension modules: |<truncated"
)
"""How the lines begin that `faulthandler` writes when a signal ends the process."""

_TAIL_BYTES = 2**16
_MAX_LINE = 300


def describe_exit(
    gmi: int, exit_code: int, error: ReportedError | None, stderr: Path, iteration: int = 0
) -> GmiFailed:
    """Puts together what the GMI left behind: its own error, else its last line on stderr."""
    own = with_type(error.type, shown_gist(error.message)) if error else last_line(stderr)
    how = f"exit code {exit_code}" if exit_code >= 0 else f"ended by {signal_name(-exit_code)}"
    if _NOTHING_FITS in own:
        own += " (perhaps there is too little GPU memory: fewer environments need less)"
    if exit_code == -signal.SIGKILL and not own:
        own = "not killed by gmijax; perhaps the machine ran out of memory"
    reason = f"{how}: {own}" if own else how
    if error and error.type == NodeLost.__name__:
        reason = own  # How it ended is unknown.
    return GmiFailed(gmi, reason, iteration=iteration, error=error, exit_code=exit_code)


def ended_with(failure: GmiFailed, *kinds: type[GmijaxError]) -> bool:
    """Whether the GMI ended by itself, with an exception of such a kind."""
    if failure.exit_code <= 0 or failure.error is None:
        return False
    found = getattr(errors, failure.error.type, None)
    return isinstance(found, type) and issubclass(found, kinds)


def is_consequence(failure: GmiFailed) -> bool:
    """Whether the GMI failed because it waited for another one."""
    return ended_with(failure, PeerLost, CollectiveTimeout, PipeClosed)


def first_cause(failures: Sequence[GmiFailed]) -> GmiFailed:
    """The failure that most likely caused the others.

    A GMI that lost its peer may be seen to fail before that peer is; so a signal, and any
    error that is not about a peer, goes before errors of the exchange. A peer that is lost to
    one may have given up on another that it waited for; of several that gave up, the one is shown
    whose missing peer has not failed itself. A library
    may abort a process whose peer is gone; so SIGABRT comes after all other causes.
    """
    failed = {failure.gmi for failure in failures}
    return min(
        failures,
        key=lambda failure: (
            is_consequence(failure),
            ended_with(failure, PeerLost, PipeClosed),
            failed.issuperset(failure.error.missing if failure.error else ()),
            failure.exit_code == -signal.SIGABRT,
            failure.exit_code >= 0,
        ),
    )


def may_be_neighbours(reason: str) -> bool:
    """Whether the fault can be that of another client of the same MPS daemon.

    A fatal fault of one client ends all clients on its GPU, and CUDA does not report whose it was
    (https://docs.nvidia.com/deploy/mps/, "Memory protection and error containment").
    """
    return _GPU_FAULT.search(reason) is not None


def signal_name(number: int) -> str:
    """`SIGKILL` for 9."""
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def last_line(path: Path) -> str:
    """The last non-empty line of a text file, shortened; empty where there is none."""
    return last_of(last_lines(path))


def last_of(lines: Sequence[str]) -> str:
    """The last of some lines that is not empty, shortened; empty where there is none.

    What Python's `faulthandler` writes after them, stacks and a list of modules, is no reason.
    """
    own = [line.strip() for line in lines if line.strip() and not _STACKS.match(line)]
    if len(own) > 1 and own[-1].startswith(_FATAL):
        own.pop()
    return own[-1][:_MAX_LINE] if own else ""


def last_lines(path: Path, num_bytes: int = _TAIL_BYTES, begins: int = 0) -> list[str]:
    """The last lines of a text file, as they may be shown; none without the file.

    Args:
      path: of the file.
      num_bytes: at its end that are read; the first line may be half a one.
      begins: byte before which nothing is read.
    """
    try:
        with path.open("rb") as file:
            file.seek(max(begins, os.fstat(file.fileno()).st_size - num_bytes))
            text = file.read().decode(errors="replace")
    except OSError:
        return []
    return [printable(line) for line in text.splitlines()]


def shown_gist(text: str, most: int | None = _MAX_LINE) -> str:
    """The gist of a text as it may be shown, shortened to `most` characters."""
    return printable(gist_of(text))[:most]
