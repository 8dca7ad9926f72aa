"""Files of a sweep or a pack."""

from __future__ import annotations

from pathlib import Path

from gmijax.runs.folder import RunPaths

DIGITS = 3
"""Of the number of a job in the names of its files; more jobs have more digits."""

ENV_PACK_DIR = "GMIJAX_PACK_DIR"
"""The folder of a pack, for its jobs."""


class SweepPaths(RunPaths):
    """Files of a sweep or a pack; each job has a run folder of its own in it.

    Args:
      root: its folder.
      name: of the command: its report is called so.
    """

    def __init__(self, root: Path, name: str = "sweep") -> None:
        super().__init__(root)
        self.request = root / "request.json"  # What a continued command must repeat.
        self.study = root / "study.log"  # Of Optuna.
        self.sweep = root / f"{name}.json"  # Jobs, their states and results.
        self.table = root / f"{name}.csv"  # One line a job.
        self.settings = root / "settings.csv"  # One line for all seeds of a setting.
        self.reserve = root / ".room"  # Only its size counts: disk space for the last report.
        self.curves = root / f"{name}.png"

    def job(self, number: int) -> RunPaths:
        """The run folder of a job."""
        return RunPaths(self.root / f"{number:0{DIGITS}d}")

    def run_dir(self, number: int) -> Path:
        """The folder of a job for what it writes itself."""
        return self.job(number).root

    def order(self, number: int) -> Path:
        """What the process of a job is given."""
        return self.root / "jobs" / f"{number:0{DIGITS}d}.json"

    def log(self, number: int) -> Path:
        """What the process of a job prints."""
        return self.root / "jobs" / f"{number:0{DIGITS}d}.log"
