"""What commands say where a disk is full or cannot be written: one line."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
from supervision import machine, planned

from gmijax.control.exit_codes import exit_code_of
from gmijax.errors import GmiFailed, GmijaxError, JobInterrupted
from gmijax.learning.training_log import JsonlSink
from gmijax.runs.folder import RunPaths, write_json
from gmijax.supervise.run_gmis import recorded


def failing(number: int) -> Callable[..., None]:
    def write(*_: object) -> None:
        raise OSError(number, os.strerror(number), "runs/x/search.json")

    return write


@pytest.mark.parametrize(
    ("number", "exit_code"),
    [
        *((number, 1) for number in (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO)),
        # A folder in place of a file is bad input.
        *((number, 2) for number in (errno.EISDIR, errno.ENOTDIR, errno.EEXIST)),
    ],
)
@pytest.mark.parametrize("verb", ["train", "search", "serve", "play", "export", "sweep"])
def test_an_error_of_the_disk_is_one_line(
    verb: str, number: int, exit_code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_code_of(verb, failing(number)) == exit_code
    message = f"gmijax.{verb}: runs/x/search.json: {os.strerror(number)}\n"
    assert capsys.readouterr().err == message


def test_the_file_that_was_to_be_written_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "metrics.jsonl"
    folder.mkdir()
    assert exit_code_of("train", lambda: write_json(folder, {})) == 2
    assert capsys.readouterr().err == f"gmijax.train: {folder}: Is a directory\n"
    assert list(tmp_path.iterdir()) == [folder]


def test_the_file_that_cannot_be_replaced_is_named_as_it_is_typed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "pack.json"
    folder.mkdir()
    with pytest.raises(IsADirectoryError) as error:
        write_json(folder, {})
    # Whoever looks at the first name alone must not find that of the temporary file.
    assert (error.value.filename, error.value.filename2) == (str(folder), None)
    assert exit_code_of("pack", lambda: write_json(folder, {})) == 2
    assert capsys.readouterr().err == "gmijax.pack: pack.json: Is a directory\n"


def test_a_file_that_was_open_when_the_disk_was_full_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def no_space(_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", no_space)
    plan, metrics = tmp_path / "plan.json", tmp_path / "metrics.jsonl"
    sink = JsonlSink(metrics)
    sink.close()
    monkeypatch.setattr(sink, "_file", SimpleNamespace(write=no_space))
    for path, write in ((plan, lambda: write_json(plan, {})), (metrics, lambda: sink.write({}))):
        assert exit_code_of("train", write) == 1
        full = os.strerror(errno.ENOSPC)
        assert capsys.readouterr().err == f"gmijax.train: {path}: {full}\n"
    assert list(tmp_path.iterdir()) == [metrics]


def test_other_errors_of_files_are_not_hidden() -> None:
    for number in (errno.EMFILE, errno.EBADF):
        with pytest.raises(OSError, match=r"search\.json"):
            exit_code_of("train", failing(number))


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.ENOENT])
def test_what_a_complete_job_cannot_write_is_not_read(number: int, tmp_path: Path) -> None:
    run = RunPaths(tmp_path)
    write_json(run.plan, planned(machine(0)).to_dict())
    with (
        pytest.raises(GmijaxError, match=f"outcome cannot be written to .*{os.strerror(number)}"),
        recorded(run, str, failing(number)),
    ):
        pass


def test_a_full_disk_does_not_hide_why_a_job_ended(tmp_path: Path) -> None:
    run = RunPaths(tmp_path)
    write_json(run.plan, planned(machine(0)).to_dict())
    for error in (GmiFailed(0, "exit code 1"), JobInterrupted("interrupted")):
        with pytest.raises(type(error)), recorded(run, str, failing(errno.ENOSPC)):
            raise error
