"""The state of the user's code when a job starts: commit and changes of its git repository."""

from __future__ import annotations

import subprocess
import threading
from contextlib import suppress
from pathlib import Path
from typing import Final

from gmijax.runs.folder import RunPaths, write_json

MAX_DIFF_BYTES: Final = 1_000_000
_MAX_STATUS_BYTES: Final = 20_000
_TIMEOUT_S: Final = 10.0


def record_git(run: RunPaths, folder: Path) -> None:
    """Writes `git.json` and `git.diff` of the repository that `folder` is in; nothing without one.

    `git.json` has the commit, the branch, the lines of `git status` and whether they or the diff
    were cut off; `git.diff` the changes of tracked files, at most MAX_DIFF_BYTES. A folder that
    cannot be written to raises no error here: others that must write into it do.
    """
    commit = _git(folder, "rev-parse", "HEAD", limit=100)
    if not commit:
        return
    branch = _git(folder, "rev-parse", "--abbrev-ref", "HEAD", limit=1000)
    status = _git(folder, "status", "--porcelain", limit=_MAX_STATUS_BYTES)
    diff = _git(folder, "diff", "--no-ext-diff", "--no-color", "HEAD", limit=MAX_DIFF_BYTES)
    with suppress(OSError):
        write_json(
            run.git,
            {
                "commit": _text(commit).strip(),
                "branch": _text(branch).strip(),
                "status": _text(status).splitlines(),
                "status_is_cut": status is None or len(status) > _MAX_STATUS_BYTES,
                "diff_is_cut": diff is None or len(diff) > MAX_DIFF_BYTES,
            },
        )
        run.git_diff.write_bytes((diff or b"")[:MAX_DIFF_BYTES])


def _git(folder: Path, *command: str, limit: int) -> bytes | None:
    """The output of git, at most `limit` bytes and one; None if it fails or takes too long."""
    try:
        process = subprocess.Popen(
            ["git", "--no-optional-locks", *command],
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
    except OSError:
        return None
    with process:
        assert process.stdout is not None
        timer = threading.Timer(_TIMEOUT_S, process.kill)
        timer.start()
        try:
            output = process.stdout.read(limit + 1)
            if len(output) > limit:
                process.kill()
                return output
            return output if process.wait() == 0 else None
        finally:
            timer.cancel()


def _text(output: bytes | None) -> str:
    return (output or b"").decode(errors="replace")
