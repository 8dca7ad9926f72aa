"""Folders of sweeps and packs as an earlier command, or somebody's hand, has left them."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
from command_lines import CPU

from gmijax.cli.command import sweep_command
from gmijax.cli.pack import pack_command
from gmijax.control.exit_codes import EXIT_BAD_INPUT
from gmijax.sweeps import runner
from gmijax.sweeps.work import name_of_request

JOBS = {"jobs": [{"seed": "0"}]}


def pack() -> int:
    return pack_command(["seed=0,1", "run.dir=all", "--", "true", "{seed}"])


def sweep() -> int:
    return sweep_command(["env=ant", "seed=0,1", "run.dir=all"])


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a command, with what says whose it is; no job can be started."""

    def no_jobs(*_: Any) -> None:
        raise AssertionError("a job would be started")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(runner, "detect_machine", lambda: CPU)
    monkeypatch.setattr(runner, "_run_jobs", no_jobs)
    (tmp_path / "all").mkdir()
    return tmp_path / "all"


@pytest.mark.parametrize("command", [pack, sweep])
@pytest.mark.parametrize(
    ("content", "why"),
    [
        ("{}", "not what a sweep or a pack was asked"),
        ('{"command": 5}', "not what a sweep or a pack was asked"),
        ('{"commands": 5, "jobs": []}', "not what a sweep or a pack was asked"),
        ('{"jobs": {}}', "not what a sweep or a pack was asked"),
        ('{"commands": [["true"]]}', "not what a sweep or a pack was asked"),
        ("[]", "not a JSON object"),
        ("{", "not JSON: .*"),
    ],
)
def test_a_damaged_request_is_called_so(
    command: Callable[[], int],
    content: str,
    why: str,
    folder: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (folder / "request.json").write_text(content)
    assert command() == EXIT_BAD_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    message, _, advice = line.partition(": ")[2].rpartition("; ")
    assert message.startswith("all/request.json: broken (")
    assert why.removesuffix(".*") in message
    assert advice == "give another folder"
    assert (folder / "request.json").read_text() == content


@pytest.mark.parametrize(
    ("held", "name"),
    [
        (JOBS, "sweep"),
        ({"sampler": "tpe", "seed": 0, "space": {}}, "sweep"),
        ({"commands": [["true"]], **JOBS}, "pack"),
        ({"commands": [], "sampler": "random"}, "pack"),
        ({"seed": 0}, None),
    ],
)
def test_a_request_says_of_which_command_it_is(held: Mapping[str, Any], name: str | None) -> None:
    assert name_of_request(held) == name


@pytest.mark.parametrize(
    ("command", "name", "held"),
    [(pack, "pack", {"commands": [["true"]], **JOBS}), (sweep, "sweep", JOBS)],
)
def test_another_command_in_the_folder_is_named(
    command: Callable[[], int],
    name: str,
    held: Mapping[str, Any],
    folder: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (folder / "request.json").write_text(json.dumps(held))
    assert command() == EXIT_BAD_INPUT
    assert f": run.dir=all: holds another {name}; give the same" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("command", "place"),
    [(pack, "000"), (pack, "001"), (pack, "001/pack"), (sweep, "001"), (sweep, "jobs")],
)
def test_what_is_in_the_place_of_a_jobs_folder_is_refused_before_anything_starts(
    command: Callable[[], int], place: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(AssertionError, match="would be started"):
        command()
    path = folder / place
    path.parent.mkdir(exist_ok=True)
    path.touch()
    capsys.readouterr()
    assert command() == EXIT_BAD_INPUT
    assert capsys.readouterr().err == f"gmijax.{command.__name__}: all/{place}: is not a folder\n"


@pytest.mark.parametrize(
    ("command", "name"), [(pack, "pack.json"), (pack, "request.json"), (sweep, "sweep.csv")]
)
def test_a_folder_in_the_place_of_a_report_is_bad_input_and_is_named(
    command: Callable[[], int], name: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(AssertionError, match="would be started"):
        command()
    (folder / name).unlink()
    (folder / name).mkdir()
    capsys.readouterr()
    assert command() == EXIT_BAD_INPUT
    errors = capsys.readouterr().err
    assert errors.startswith(f"gmijax.{command.__name__}: all/{name}: ")
    assert len(errors.splitlines()) == 1
