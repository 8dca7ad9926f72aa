"""What a shell offers: values of keys, run folders, checkpoints, topics of help."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from made_checkpoint import ENV_STEPS, make_run

from gmijax.cli.answers import own_answers

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(
    ("line", "answers"),
    [
        ("train plan.template=tdg", ["plan.template=tdg", "plan.template=tdg_ex"]),
        ("train env=ant run.elastic=", ["run.elastic=true", "run.elastic=false"]),
        ("train eval.video=t", ["eval.video=true"]),  # Of a union.
        ("train plan.gmis_per_gpu=", ["plan.gmis_per_gpu=auto"]),
        ("train --help pl", ["plan"]),
        ("train -h wan", ["wandb"]),
        ("sweep --help sw", ["sweep"]),
        ("train --v", ["--verbose"]),
        ("train --cfg ", ["job"]),
        ("play video=m", ["video=mp4"]),
        ("pack pack.backend=s", ["pack.backend=share"]),
        ("train env=a", None),  # Hydra knows the files of groups.
        ("train run.dir=", None),  # A new folder.
        ("train num_e", None),
        ("train ", None),
        ("play checkpoint=./", None),  # Hydra knows files.
    ],
)
def test_what_a_word_may_become(line: str, answers: list[str] | None):
    command, *words = line.split(" ")
    assert own_answers(command, words) == answers


def test_run_folders_and_checkpoints_are_offered_the_newest_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    assert own_answers("play", ["run.dir="]) == ["run.dir=last"]
    for number, name in enumerate(("old", "new", "a b")):
        run = make_run(tmp_path / "runs" / name)
        os.utime(run.config, (number, number))
    (tmp_path / "runs" / "notes").mkdir()
    runs = ["runs/new", "runs/old"]
    assert own_answers("play", ["run.dir="]) == [f"run.dir={x}" for x in ("last", *runs)]
    resumes = [f"run.resume={x}" for x in ("last", "auto", *runs)]
    assert own_answers("train", ["run.resume="]) == resumes
    steps = ["checkpoint=best", f"checkpoint={ENV_STEPS}"]
    assert own_answers("export", ["run.dir=runs/old", "checkpoint="]) == steps
    assert own_answers("play", ["checkpoint=2"]) == steps[1:]
    shipped = [steps[0], "checkpoint=shipped"]
    assert own_answers("view", ["run.dir=nowhere", "checkpoint="]) == shipped
    assert own_answers("export", ["run.dir=nowhere", "checkpoint="]) == steps[:1]


@pytest.mark.parametrize(
    "path", sorted((ROOT / "configs").glob("*.yaml")), ids=lambda path: path.stem
)
def test_every_command_with_keys_has_answers(path: Path):
    assert "--help" in (own_answers(path.stem, ["--"]) or ())
