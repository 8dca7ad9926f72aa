"""Some faults, and every kind of them once where slow tests run.

`GMIJAX_FAULT_SEEDS=7,8 pytest -m '' tests/faults/test_faults.py` draws more decks, from these
seeds; a failure prints the report of its trial and keeps its folder. `python -m
tests.faults.campaign` does the same and writes a table. A start of a job costs five seconds.
"""

from __future__ import annotations

import os
import random
import re
import shutil
from pathlib import Path

import pytest
from fault_commands import COMMANDS
from fault_deck import ALL_KINDS, Case, Trial, draw_trials, faults_of
from fault_plan import place_faults
from fault_trials import kinds_here, run_trial

SEEDS = (0, *map(int, filter(None, os.environ.get("GMIJAX_FAULT_SEEDS", "").split(","))))
QUICK: tuple[Trial, ...] = (
    place_faults(
        ("stdout_gone", "slow", "kill_named", "checkpoint_copies", "term_all"),
        random.Random(0),
    ),
    place_faults(("stdout_closed", "stop", "nan", "disk_full"), random.Random(0)),
    Case("train_move", 0),
    *(Case(kind, 0) for kind in ("edit_config_resume", "edit_meta_resume", "edit_summary_again")),
)
DECKS = tuple(trial for seed in SEEDS for trial in draw_trials(seed, len(ALL_KINDS), ALL_KINDS))


@pytest.fixture(scope="module")
def fixtures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where trials find what undisturbed commands leave; made when one asks for it."""
    return tmp_path_factory.mktemp("fixtures")


def test_a_deck_has_every_kind_once():
    drawn = [kind for trial in DECKS for kind in faults_of(trial)]
    assert sorted(drawn) == sorted([*ALL_KINDS] * len(SEEDS))


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_that_gets_faults_is_of_keys_and_values(name: str):
    words = COMMANDS[name].overrides
    assert [word for word in words if not re.match(r"[a-z_.]{3,}=", word)] == []


@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    "trial",
    [
        pytest.param(
            trial,
            id=f"{number}-" + "-".join(faults_of(trial)),
            marks=() if number < len(QUICK) else pytest.mark.slow,
        )
        for number, trial in enumerate((*QUICK, *DECKS))
    ],
)
def test_a_command_gets_over_its_faults(trial: Trial, tmp_path: Path, fixtures: Path) -> None:
    here = kinds_here()
    if missing := [kind for kind in faults_of(trial) if kind not in here]:
        if isinstance(trial, Case):
            pytest.skip(f"{missing} cannot be made here: no right to mount, no OpenGL or no Ray")
        trial = [fault for fault in trial if fault.kind in here]
    report = run_trial(trial, tmp_path, fixtures)
    assert report.is_good, report
    shutil.rmtree(tmp_path)
    if missing:
        pytest.skip(f"the others passed; may not mount, which {missing} need")
