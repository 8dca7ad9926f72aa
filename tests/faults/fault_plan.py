"""Faults of training jobs as data: what kinds there are, and plans of them drawn from a seed."""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from typing import Final, Literal, NamedTuple

ITERATIONS: Final = 60
"""Of a job, in all."""

CHECKPOINT_EVERY: Final = 3

_FIRST, _LAST = 9, 52
"""Iterations of faults: checkpoints are there, and there is time to handle a signal."""

Outcome = Literal["restarted", "resumed", "ended at once", "nothing happened"]
Place = Literal["gmi", "leader", "command"]


class Kind(NamedTuple):
    """A kind of fault.

    Attributes:
      does: what `faulty_worker` does, or how the command is started.
      point: where in a GMI it does that.
      outcome: what the job must come to: it starts again by itself, it goes on when the command
        is given again, it ends although it could start again, or nothing.
      exit_code: of the command that the fault ends; None if it ends none.
      place: which GMI may be hit; `command` for what is wrong from the start.
    """

    does: str
    point: str
    outcome: Outcome
    exit_code: int | None = None
    place: Place = "gmi"


KINDS: Final[dict[str, Kind]] = {
    "kill_importing": Kind("kill", "importing", "restarted"),
    "kill_controller_importing": Kind("kill_controller", "importing", "resumed", -9),
    "kill_compiling": Kind("kill", "compiling", "restarted"),
    "kill_beat": Kind("kill", "beat", "restarted"),
    "kill_mean": Kind("kill", "mean", "restarted"),
    "kill_part": Kind("kill", "part", "restarted"),
    "kill_rename": Kind("kill", "rename", "restarted", place="leader"),
    "kill_named": Kind("kill", "named", "restarted", place="leader"),
    "kill_removing": Kind("kill", "removing", "restarted", place="leader"),
    "stop": Kind("stop", "beat", "restarted"),
    "suspend_job": Kind("suspend_job", "beat", "nothing happened"),
    "suspend_job_compiling": Kind("suspend_job", "compiling", "nothing happened"),
    "suspend_controller": Kind("suspend_controller", "beat", "nothing happened"),
    "suspend_janitor": Kind("suspend_janitor", "beat", "nothing happened"),
    "suspend_gmis": Kind("suspend_gmis", "beat", "restarted"),
    "kill_measuring": Kind("kill", "measuring", "restarted"),
    "kill_controller_measuring": Kind("kill_controller", "measuring", "resumed", -9),
    "kill_result": Kind("kill", "result", "restarted"),
    "kill_controller_result": Kind("kill_controller", "result", "resumed", -9),
    "raise_mean": Kind("raise", "mean", "restarted"),
    "raise_part": Kind("raise", "part", "restarted"),
    "raise_rename": Kind("raise", "rename", "restarted", place="leader"),
    "raise_report": Kind("raise", "report", "restarted"),
    "raise_beat": Kind("raise", "beat", "restarted"),
    "file_limit": Kind("file_limit", "beat", "restarted", place="leader"),
    "slow": Kind("slow", "mean", "nothing happened"),
    "kill_janitor": Kind("kill_janitor", "beat", "nothing happened"),
    "kill_controller": Kind("kill_controller", "beat", "resumed", -9),
    "kill_controller_rename": Kind("kill_controller", "rename", "resumed", -9, "leader"),
    "kill_controller_compiling": Kind("kill_controller", "compiling", "resumed", -9),
    "kill_controller_and_stop": Kind("kill_controller_and_stop", "beat", "resumed", -9),
    "term_all": Kind("term_all", "beat", "resumed", 130),
    "usr1_controller": Kind("usr1", "beat", "resumed", 130),
    "hup_controller": Kind("hup", "beat", "resumed", 130),
    "checkpoint_truncated": Kind("kill_controller", "beat", "resumed", -9),
    "checkpoint_byte": Kind("kill_controller", "beat", "resumed", -9),
    "checkpoint_meta": Kind("kill_controller", "beat", "resumed", -9),
    "checkpoint_copies": Kind("kill_controller", "beat", "resumed", -9),
    "checkpoint_fifo": Kind("kill_controller", "beat", "resumed", -9),
    "checkpoint_device": Kind("kill_controller", "beat", "resumed", -9),
    "cache_truncated": Kind("kill_controller", "beat", "resumed", -9),
    "cache_flipped": Kind("kill_controller", "beat", "resumed", -9),
    "nan": Kind("nan", "beat", "ended at once", 1),
    "disk_full": Kind("fill_disk", "beat", "ended at once", 1),
    "shm_unwritable": Kind("shm_unwritable", "", "nothing happened", place="command"),
    "stdout_closed": Kind("stdout_closed", "", "nothing happened", place="command"),
    "stdout_gone": Kind("stdout_gone", "", "nothing happened", place="command"),
}

NEED_MOUNT: Final = frozenset({"disk_full", "shm_unwritable"})
"""Kinds that need a file system of their own."""


class Fault(NamedTuple):
    """One fault of a job.

    Attributes:
      kind: a key of `KINDS`.
      gmi: which one it hits.
      iteration: of the job, at or after which it comes.
    """

    kind: str
    gmi: int
    iteration: int


def draw_jobs(seed: int, num_faults: int, kinds: Sequence[str]) -> Iterator[list[Fault]]:
    """Jobs with `num_faults` faults in all, every kind as often as any other."""
    draw = random.Random(seed)
    deck: list[str] = []
    while num_faults > 0:
        chosen: list[str] = []
        for _ in range(min(5, num_faults)):
            deck = deck or draw.sample(list(kinds), len(kinds))
            fits = [kind for kind in deck if all(_may_meet(kind, other) for other in chosen)]
            if not fits:
                break
            chosen.append(fits[0])
            deck.remove(fits[0])
        num_faults -= len(chosen)
        yield place_faults(chosen, draw)


def place_faults(kinds: Sequence[str], draw: random.Random) -> list[Fault]:
    """Faults of these kinds, one well after the other."""
    first = [kind for kind in kinds if _is_at_start(kind)]
    later = [kind for kind in kinds if not _is_at_start(kind)]
    width = (_LAST - _FIRST) / max(1, len(later))
    starts = [round(_FIRST + number * width) for number in range(len(later))]
    iterations = [start + draw.randrange(max(1, round(width) - 5)) for start in starts]
    placed = zip((*first, *later), (*[0] * len(first), *iterations), strict=True)
    return [
        Fault(kind, 0 if KINDS[kind].place == "leader" else draw.randrange(2), iteration)
        for kind, iteration in placed
    ]


def _may_meet(kind: str, other: str) -> bool:
    """Whether one job may have both: a command is started in one way, and has one janitor."""
    if {kind, other} == {"kill_result", "kill_controller_result"}:
        return False  # With the results there the job is complete: the other never comes.
    needs_janitor = {kind, other} == {"kill_janitor", "kill_controller_and_stop"}
    return not needs_janitor and not (_is_at_start(kind) and _is_at_start(other))


def _is_at_start(kind: str) -> bool:
    return KINDS[kind].place == "command" or KINDS[kind].point in ("importing", "compiling")
