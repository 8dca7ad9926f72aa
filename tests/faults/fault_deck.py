"""Faults from outside of the processes of a command, as data; `fault_plan` has those from within.

A case is one fault of one command: it is started, hit at a moment, must come to what the kind
says, is repaired and given again, and must then go on from all that it had finished.
"""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from typing import Final, Literal, NamedTuple

from fault_files import EDITS
from fault_plan import KINDS, Fault, draw_jobs
from fault_processes import STALL

Outcome = Literal["goes on", "restarted", "killed", "interrupted", "fails", "refused"]
"""What a command comes to: it ends well or trains on, with or without a restart; it is killed (and
goes on when it is given again, as after all that follow); exit code 130; 1; 2."""

EXIT_CODES: Final[dict[str, int]] = {"killed": -9, "interrupted": 130, "fails": 1, "refused": 2}


class OuterKind(NamedTuple):
    """A kind of fault.

    Attributes:
      command: a key of `COMMANDS`.
      moment: when it comes, a key of `MOMENTS`.
      does: a key of `ACTS`.
      whom: which processes, see `chosen`.
      outcome: what the command must come to.
      says: a regular expression that its error must have.
      overrides: more of the command line.
      disk: what is a small file system of its own, see `DISKS`; `folder`: nothing.
    """

    command: str
    moment: str
    does: str
    whom: str
    outcome: Outcome
    says: str = ""
    overrides: tuple[str, ...] = ()
    disk: str = "folder"

    @property
    def needs_mount(self) -> bool:
        """Whether only who may mount can make this fault."""
        return self.disk != "folder" or self.does == "read_only"


class Case(NamedTuple):
    """A kind of fault, and the seed of everything about it that is drawn."""

    kind: str
    seed: int


Trial = Case | list[Fault]
"""What is run at once: a case, or a training job with faults from within."""

_SHORT_STOP = (*STALL, "run.stop_timeout_s=8")
_SERVE_STALL = ("run.stall_timeout_s=10",)


def _kills(command: str, whom: str = "gmi", outcome: Outcome = "fails") -> dict[str, OuterKind]:
    """What every command is tried with: its controller and its child killed, asked to end."""
    says = "SIGKILL" if outcome == "fails" else ""
    return {
        f"{command}_kill_controller": OuterKind(command, "any", "kill", "controller", "killed"),
        f"{command}_kill_child": OuterKind(command, "any", "kill", whom, outcome, says),
        f"{command}_term": OuterKind(command, "any", "term", "controller", "interrupted"),
    }


_PROCESSES: Final[dict[str, OuterKind]] = {
    **_kills("serve"),
    **_kills("play"),
    **_kills("stablehlo"),
    **_kills("onnx"),
    **_kills("search", outcome="goes on"),
    **_kills("sweep", outcome="goes on"),
    **_kills("tdg", outcome="restarted"),
    "a3c_kill_agent": OuterKind("a3c", "saved", "kill", "gmi_1", "restarted"),
    "a3c_kill_trainer": OuterKind("a3c", "saved", "kill", "gmi_0", "restarted"),
    "a3c_kill_leader": OuterKind("a3c_two", "saved", "kill", "gmi_0", "restarted"),
    "a3c_kill_starting": OuterKind("a3c", "begun", "kill", "gmi", "restarted"),
    "a3c_kill_controller": OuterKind("a3c", "saved", "kill", "controller", "killed"),
    "a3c_term": OuterKind("a3c", "saved", "term", "controller", "interrupted"),
    "a3c_stop_agent": OuterKind("a3c", "saved", "stop", "gmi_1", "restarted", overrides=STALL),
    "a3c_stop_trainer": OuterKind("a3c", "saved", "stop", "gmi_0", "restarted", overrides=STALL),
    "a3c_suspend": OuterKind("a3c", "saved", "suspend", "all", "goes on", overrides=STALL),
    "serve_stop": OuterKind("serve", "saved", "stop", "gmi", "fails", overrides=_SERVE_STALL),
    "serve_suspend": OuterKind("serve", "saved", "suspend", "all", "goes on",
                               overrides=_SERVE_STALL),
    "sweep_kill_job": OuterKind("sweep", "saved", "kill", "job", "goes on"),
    "sweep_kill_job_starting": OuterKind("sweep", "begun", "kill", "job", "goes on"),
    "sweep_suspend": OuterKind("sweep", "saved", "suspend", "all", "goes on", overrides=STALL),
    "sweep_term_twice": OuterKind("sweep", "saved", "term_twice", "controller", "interrupted"),
    "train_term_starting": OuterKind("train", "begun", "term", "controller", "interrupted"),
    "train_suspend_stopping": OuterKind("train", "saved", "term_and_suspend", "all",
                                        "interrupted", overrides=_SHORT_STOP),
    "train_stop_janitor_and_gmi": OuterKind("train", "saved", "stop_and_kill", "controller",
                                            "killed"),
    "measured_kill_gmi": OuterKind("measured", "trained", "kill", "gmi", "goes on"),
    "measured_kill_controller": OuterKind("measured", "trained", "kill", "controller", "killed"),
    "summary_kill_controller": OuterKind("measured", "ended", "kill", "controller", "killed"),
    "films_kill_writer": OuterKind("films", "filming", "kill", "film", "goes on"),
    "films_kill_controller": OuterKind("films", "filming", "kill", "controller", "killed"),
}  # fmt: skip

_FOLDERS: Final[dict[str, OuterKind]] = {
    f"{command}_{does}": OuterKind(command, "saved", does, "run", "fails")
    for command in ("train", "a3c", "sweep", "serve")
    for does in ("move", "remove", "replace")
} | {
    "train_move_parent": OuterKind("train", "saved", "move_parent", "run", "fails"),
    "train_read_only": OuterKind("train", "saved", "read_only", "run", "fails"),
}

_DISKS: Final[dict[str, OuterKind]] = {
    f"{command}_{disk}": OuterKind(command, moment, "fill", "run", "fails", disk=disk)
    for command, moment in {
        "train": "saved", "a3c": "saved", "sweep": "saved", "serve": "saved", "search": "begun",
        "play": "begun", "stablehlo": "begun", "onnx": "begun",
    }.items()
    for disk in ("small", "few_inodes")
} | {
    "films_small": OuterKind("films", "saved", "fill", "run", "fails", disk="small"),
    "cache_full": OuterKind("train", "saved", "fill_cache", "gmi", "restarted", disk="cache"),
    "cache_few_inodes": OuterKind("train", "saved", "fill_cache", "gmi", "restarted",
                                  disk="cache_few_inodes"),
}  # fmt: skip

_NAMES: Final[dict[str, OuterKind]] = {
    "train_odd_path": OuterKind("train", "saved", "kill", "controller", "killed"),
    "a3c_odd_path": OuterKind("a3c", "saved", "kill", "controller", "killed"),
    "sweep_odd_path": OuterKind("sweep", "saved", "kill", "controller", "killed"),
    "stablehlo_odd_path": OuterKind("stablehlo", "any", "kill", "controller", "killed"),
} | {
    f"{command}_shadowed": OuterKind(command, "saved", "nothing", "run", "goes on")
    for command in ("train", "sweep", "serve", "play", "search", "stablehlo")
}

OUTER_KINDS: Final[dict[str, OuterKind]] = _PROCESSES | _FOLDERS | _DISKS | _NAMES
EDIT_KINDS: Final = tuple(EDITS)
CLIENT_KINDS: Final = ("strangers_meeting", "strangers_registers")
ALL_KINDS: Final = (*KINDS, *OUTER_KINDS, *EDIT_KINDS, *CLIENT_KINDS)


def draw_trials(seed: int, num_faults: int, kinds: Sequence[str]) -> Iterator[Trial]:
    """Trials with `num_faults` faults in all, every kind as often as any other, in any order."""
    draw = random.Random(seed)
    while num_faults > 0:
        round_of = draw.sample(list(kinds), min(len(kinds), num_faults))
        num_faults -= len(round_of)
        inner = [kind for kind in round_of if kind in KINDS]
        trials: list[Trial] = [
            Case(kind, draw.randrange(2**32)) for kind in round_of if kind not in KINDS
        ]
        trials += draw_jobs(draw.randrange(2**32), len(inner), inner) if inner else ()
        yield from draw.sample(trials, len(trials))


def faults_of(trial: Trial) -> list[str]:
    """The kinds of a trial."""
    return [trial.kind] if isinstance(trial, Case) else [fault.kind for fault in trial]


_GROUPS: Final = {
    **dict.fromkeys(("stablehlo", "onnx"), "export"),
    **dict.fromkeys(("measured", "summary", "films", "cache", "tdg"), "train"),
    "edit": "files that were edited",
}


def group_of(kind: str) -> str:
    """What tables have a row for: faults from within, a command, or what else was harmed."""
    first = kind.partition("_")[0]
    return "training, from within" if kind in KINDS else _GROUPS.get(first, first)
