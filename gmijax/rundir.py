"""Every file name of a run folder, and how files in it are written. No jax here.

`<run>/config.json plan.json summary.json metrics.jsonl returns.png tensorboard/`
`<run>/checkpoints/<12-digit env steps>/meta.json`
`<run>/gmi_<id>/{stdout.log,stderr.log,heartbeat.json,error.json,result.json,metrics.jsonl}`
"""

from __future__ import annotations

import json
import os
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from gmijax.errors import ConfigError

RUNS = Path("runs")
"""Where run folders go unless `run.dir` names one; relative to the working directory."""

STEP_DIGITS = 12

META = "meta.json"
"""Written last into a checkpoint: a folder without it is not one."""


@dataclass(frozen=True)
class GmiPaths:
    """Files of one GMI."""

    root: Path

    @property
    def stdout(self) -> Path:
        """What the process prints."""
        return self.root / "stdout.log"

    @property
    def stderr(self) -> Path:
        """What the process and its libraries complain about."""
        return self.root / "stderr.log"

    @property
    def heartbeat(self) -> Path:
        """State and iteration, rewritten as the GMI makes progress."""
        return self.root / "heartbeat.json"

    @property
    def error(self) -> Path:
        """Why the GMI failed: type, message, traceback."""
        return self.root / "error.json"

    @property
    def result(self) -> Path:
        """What the GMI's role returned."""
        return self.root / "result.json"

    @property
    def role(self) -> Path:
        """A role of the user's own and its arguments, pickled."""
        return self.root / "role.pickle"

    @property
    def output(self) -> Path:
        """What a role of the user's own returned, pickled."""
        return self.root / "output.pickle"

    @property
    def metrics(self) -> Path:
        """Lines of a GMI that reports for itself alone."""
        return self.root / "metrics.jsonl"


@dataclass(frozen=True)
class RunPaths:
    """Files of one run."""

    root: Path

    @property
    def config(self) -> Path:
        """The composed configuration."""
        return self.root / "config.json"

    @property
    def plan(self) -> Path:
        """The partition."""
        return self.root / "plan.json"

    @property
    def summary(self) -> Path:
        """The outcome."""
        return self.root / "summary.json"

    @property
    def metrics(self) -> Path:
        """One JSON object a line and iteration."""
        return self.root / "metrics.jsonl"

    @property
    def tensorboard(self) -> Path:
        """Folder of TensorBoard event files."""
        return self.root / "tensorboard"

    @property
    def returns_png(self) -> Path:
        """Picture of the return curve."""
        return self.root / "returns.png"

    @property
    def checkpoints(self) -> Path:
        """Folder of checkpoints."""
        return self.root / "checkpoints"

    @property
    def mps(self) -> Path:
        """Folder of the logs of MPS daemons that the job starts."""
        return self.root / "mps"

    def checkpoint(self, env_steps: int) -> Path:
        """The checkpoint after `env_steps` environment steps."""
        return self.checkpoints / f"{env_steps:0{STEP_DIGITS}d}"

    def gmi(self, gmi: int) -> GmiPaths:
        """Files of one GMI."""
        return GmiPaths(self.root / f"gmi_{gmi}")


def create_run(
    run_dir: str | None, name: str | None, prefix: str, now: datetime | None = None
) -> RunPaths:
    """Creates the run folder `run_dir`, or `runs/<name>`, or `runs/<prefix>-<date>-<time>`.

    Raises:
      ConfigError: the folder exists already, or cannot be made.
    """
    stamp = (now or datetime.now()).strftime("%Y%m%d-%H%M%S")
    root = Path(run_dir) if run_dir else RUNS / (name or f"{prefix}-{stamp}")
    key = "run.dir" if run_dir else "run.name"
    for attempt in range(100):
        # Two jobs started in the same second: only a name that we made up may be changed.
        made_up = not (run_dir or name)
        candidate = root.with_name(f"{root.name}-{attempt}") if attempt and made_up else root
        try:
            candidate.mkdir(parents=True)
        except FileExistsError:
            if made_up:
                continue
            raise ConfigError(f"{key}={root}: the run folder exists already") from None
        except OSError as error:
            raise ConfigError(f"{key}={root}: cannot make the folder ({error.strerror})") from None
        return RunPaths(candidate.resolve())
    raise ConfigError(f"{key}={root}: no free name")


def require_new_run(run_dir: str | None, name: str | None) -> None:
    """Refuses what `create_run` would, before something is started that takes long.

    Raises:
      ConfigError: the folder that is named exists already.
    """
    if (run_dir or name) and _named(run_dir, name).exists():
        key = "run.dir" if run_dir else "run.name"
        raise ConfigError(f"{key}={_named(run_dir, name)}: the run folder exists already")


def _named(run_dir: str | None, name: str | None) -> Path:
    return Path(run_dir) if run_dir else RUNS / str(name)


def write_json(path: Path, data: Mapping[str, Any]) -> None:
    """Writes `data` so that a reader sees the old file or the new one, never half a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        # As any new file, for whom the user's umask lets read it: mkstemp would not ask.
        with temporary.open("x") as file:
            json.dump(data, file, indent=2)
            file.write("\n")
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def read_json(path: Path) -> dict[str, Any]:
    """Reads what `write_json` wrote."""
    return json.loads(path.read_text())


def last_run(key: str, runs: Path = RUNS) -> Path:
    """The run folder below `runs` with the newest checkpoint.

    Args:
      key: the configuration key that asks for it, for the message.
      runs: where to look.

    Raises:
      ConfigError: there is none.
    """
    # Not the time of a folder: that changes with whatever is put into it later, e.g. films.
    found = list(runs.glob(f"*/checkpoints/[0-9]*/{META}"))
    if not found:
        raise ConfigError(f"{key}=last: no run with a checkpoint in {runs}/")
    return max(found, key=lambda meta: meta.stat().st_mtime).parents[2]
