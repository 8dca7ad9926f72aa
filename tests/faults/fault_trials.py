"""Runs whatever a deck holds: a case from outside, damaged files, unknown clients, a job."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
from fault_case import run_case
from fault_clients import can_cluster, run_with_clients
from fault_deck import ALL_KINDS, CLIENT_KINDS, OUTER_KINDS, Case, Trial
from fault_disks import can_mount
from fault_edits import run_edit
from fault_files import EDITS
from fault_fixtures import undisturbed
from fault_jobs import run_job
from fault_plan import NEED_MOUNT
from fault_report import Report

from gmijax.machine.opengl import first_opengl, opengls


def run_trial(trial: Trial, scratch: Path, fixtures: Path) -> Report:
    """Runs a trial in `scratch`, which is made; raises nothing."""
    if not isinstance(trial, Case):
        return run_job(trial, scratch, _expected(fixtures))
    if trial.kind in EDITS:
        return run_edit(trial.kind, trial.seed, scratch, fixtures)
    if trial.kind in CLIENT_KINDS:
        return run_with_clients(trial.kind, trial.seed, scratch)
    return run_case(trial, scratch, fixtures)


@cache
def kinds_here() -> list[str]:
    """The kinds of faults that can be made on this machine."""
    return [kind for kind in ALL_KINDS if _can_be_made(kind)]


@cache
def _expected(fixtures: Path) -> list[np.ndarray]:
    return undisturbed(fixtures)


@cache
def _can_draw() -> bool:
    return first_opengl(opengls("osmesa", "egl"))[0] is not None


def _can_be_made(kind: str) -> bool:
    if kind in CLIENT_KINDS:
        return can_cluster()
    outer = OUTER_KINDS.get(kind)
    if outer is None:
        return kind not in NEED_MOUNT or can_mount()
    is_drawn = outer.command == "films"
    return (not outer.needs_mount or can_mount()) and (not is_drawn or _can_draw())
