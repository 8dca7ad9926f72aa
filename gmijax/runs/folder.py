"""Every file name of a run folder, and how files in it are written."""

from __future__ import annotations

import errno
import json
import os
import re
import stat
import threading
import typing
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import Any, BinaryIO, Final

from gmijax.errors import ConfigError, DamagedFile
from gmijax.runs.names import nearby, steps_name

RUNS = Path("runs")
"""Where run folders go unless `run.dir` names one; relative to the working directory."""

META = "meta.json"
"""Written last into a checkpoint: a folder without it is not one."""

POLICY = "policy.npz"
"""The policy of a checkpoint, for programs without jax; those of older versions have none."""

UNFINISHED, REMOVED = ".partial", ".removed"
"""Ends of the names of checkpoints that are written or removed, which begin with a dot."""

EXIT_NO_GL = 3
"""Exit code of the renderer where the OpenGL that it was to use cannot be had."""

NO_RUN_FOLDER: Final = "is not a run folder, and is not empty"

_TEMPORARY = re.compile(r"\..+\.\d+-\d+")
"""Names that files have while they are written."""

LARGEST_JSON_BYTES: Final = 1 << 28
"""More than any file that gmijax writes, and little enough to be read by mistake."""


class _Folder:
    """A folder whose files have names here; equal to another one of the same path."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def __eq__(self, other: object) -> bool:
        return type(other) is type(self) and vars(other) == vars(self)

    def __hash__(self) -> int:
        return hash(self.root)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self.root)!r})"


class GmiPaths(_Folder):
    """Files of one GMI."""

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        self.stdout = root / "stdout.log"
        self.stderr = root / "stderr.log"
        self.error = root / "error.json"  # Why it failed: type, message, traceback.
        self.result = root / "result.json"  # What its main returned.
        self.role = root / "role.pickle"  # A role of the user's own and its arguments.
        self.output = root / "output.pickle"  # What that returned.
        self.metrics = root / "metrics.jsonl"  # Of a GMI that reports for itself alone.


class RunPaths(_Folder):
    """Files of one run."""

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        self.config = root / "config.json"
        self.plan = root / "plan.json"
        self.summary = root / "summary.json"
        self.metrics = root / "metrics.jsonl"  # One JSON object a line and iteration.
        self.tensorboard = root / "tensorboard"
        self.returns_png = root / "returns.png"
        self.checkpoints = root / "checkpoints"
        self.videos = root / "videos"
        self.profile = root / "profile"  # The trace of some iterations.
        self.filmed_model = self.videos / "model.mjb"  # While there is something left to film.
        self.mps = root / "mps"  # Logs of MPS daemons that the job starts.
        self.janitor_log = root / "janitor.log"  # Errors of the janitor; gone without any.
        self.lock = root / ".lock"  # Held by the job that writes into the folder.
        self.git = root / "git.json"  # Commit and branch of the user's code.
        self.git_diff = root / "git.diff"  # Its changes since that commit.
        self.wandb = root / "wandb.json"  # Its run at Weights & Biases, and how far that is.
        self.wandb_log = root / "wandb.log"  # Errors of sending to it; gone without any.
        self.film_log = root / "film.log"  # Errors of filming evaluations; gone without any.
        self.events = root / "events.jsonl"  # Starts, faults and restarts of the job.
        self.search_report = root / "search.json"
        self.search_png = root / "search.png"

    def earlier_metrics(self, env_steps: int) -> Path:
        """The metrics of a training that was begun anew here, after so many environment steps."""
        return self.root / f"metrics-{steps_name(env_steps)}.jsonl"

    def checkpoint(self, env_steps: int) -> Path:
        """The checkpoint after `env_steps` environment steps."""
        return self.checkpoints / steps_name(env_steps)

    def unfinished(self, env_steps: int) -> Path:
        """The same checkpoint while it is written."""
        return self.checkpoints / f".{steps_name(env_steps)}{UNFINISHED}"

    def removed(self, env_steps: int) -> Path:
        """The same checkpoint while it is removed."""
        return self.checkpoints / f".{steps_name(env_steps)}{REMOVED}"

    def video(self, env_steps: int) -> Path:
        """The film of the evaluation after `env_steps` environment steps."""
        return self.videos / f"{steps_name(env_steps)}.mp4"

    def to_film(self, env_steps: int) -> Path:
        """The trajectory of which that film is to be made; gone when it has been."""
        return self.video(env_steps).with_suffix(".npz")

    def search_profile(self, name: str) -> RunPaths:
        """The run folder of a profile of a search; it keeps no checkpoints."""
        return RunPaths(self.root / "profiles" / name)

    def gmi(self, gmi: int) -> GmiPaths:
        """Files of one GMI."""
        return GmiPaths(self.root / f"gmi_{gmi}")

    def node(self, node: int) -> RunPaths:
        """Logs of what one of several nodes starts beside its GMIs."""
        return RunPaths(self.root / f"node_{node}")


class PlayPaths(_Folder):
    """Files of one played checkpoint; its folder also has the files of a run with one GMI."""

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        self.returns = root / "returns.json"  # Of every episode, and statistics over them.
        # `qpos` [L + 1, E, nq] of the shown environments, `lengths` [E], `control_dt_s`.
        self.trajectory = root / "trajectory.npz"
        self.model = root / "model.mjb"  # In MuJoCo's binary format, until all is drawn.
        self.mp4 = root / "video.mp4"
        self.gif = root / "video.gif"
        self.html = root / "view.html"
        self.page_log = root / "page.log"
        self.render_log = root / "render.log"

    def results(self) -> tuple[Path, ...]:
        """All files that a new evaluation replaces."""
        watched = self.mp4, self.gif, self.html
        return self.returns, self.trajectory, self.model, *watched, self.render_log, self.page_log


class ExportPaths(_Folder):
    """Files of one exported policy; its folder also has the files of a run with one GMI."""

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        self.onnx = root / "policy.onnx"
        self.stablehlo = root / "policy.stablehlo"
        self.metadata = root / "policy.json"  # Written last.


def create_run(run_dir: str | None, name: str | None, prefix: str) -> RunPaths:
    """Creates the run folder `run_dir`, or `runs/<name>`, or `runs/<prefix>-<date>-<time>`.

    Raises:
      ConfigError: the folder exists already, or cannot be made.
    """
    given = given_run(run_dir, name)
    root = given or RUNS / f"{prefix}-{datetime.now():%Y%m%d-%H%M%S}"
    shown = _as_given(run_dir, name, root)
    for attempt in range(100):
        # Two jobs started in the same second: only a name that we made up may be changed.
        candidate = root.with_name(f"{root.name}-{attempt}") if attempt and not given else root
        try:
            make_folder(candidate, shown, is_new=True)
        except FileExistsError:
            require_new_run(run_dir, name)
            continue
        return RunPaths(candidate.resolve())
    raise ConfigError(f"{shown}: no free name")


def _as_given(run_dir: str | None, name: str | None, root: Path) -> str:
    """A run folder in an error: by the key that the user gave, if any."""
    if run_dir:
        return f"run.dir={root}"
    return f"run.name={name} ({root})" if name else str(root)


def replay_name(gmi: int | str) -> str:
    """The folder of a GMI's replay in a checkpoint; with "*" the pattern of all of them."""
    return f"replay_{gmi}"


def replays_of(checkpoint: Path) -> list[Path]:
    """The folders of the replays in a checkpoint; empty where it has none."""
    return sorted(checkpoint.glob(replay_name("*")))


def given_run(run_dir: str | None, name: str | None) -> Path | None:
    """The run folder that the user names, None if none.

    Raises:
      ConfigError: the name leads out of `RUNS`.
    """
    if run_dir:
        return Path(run_dir)
    if name and (os.path.isabs(name) or ".." in Path(name).parts or not Path(name).parts):
        raise ConfigError(
            f"run.name={name}: expected a name below {RUNS}/; run.dir takes any path"
        )
    return RUNS / name if name else None


def why_no_folder(path: str | os.PathLike[str]) -> str:
    """The message for a path that is no folder."""
    return "is not a folder" if os.path.exists(path) else "no such folder"


def make_folder(path: Path, shown: str, *, is_new: bool = False) -> None:
    """Makes a folder, and those above it; one that is there will do, unless `is_new`.

    Args:
      path: of the folder.
      shown: the same in an error, with the key that the user gave.
      is_new: see above.

    Raises:
      FileExistsError: something is there, with `is_new`.
      ConfigError: it cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=not is_new)
    except FileExistsError:
        if is_new:
            raise
        raise ConfigError(f"{shown}: {why_no_folder(path)}") from None
    except OSError as error:
        raise ConfigError(f"{shown}: cannot make the folder ({error.strerror})") from None


def require_new_run(run_dir: str | None, name: str | None, hint: str = "") -> None:
    """Raises ConfigError if the run folder that the user names exists already.

    `hint` is added where a run can continue or begin in it.
    """
    root = given_run(run_dir, name)
    if root is None or not os.path.lexists(root):
        return
    what = f"the run folder exists already{hint}"
    if not root.is_dir():
        what = "not a folder"
    elif holds_something_else(root, own=RunPaths(root).config, lock=RunPaths(root).lock):
        what = NO_RUN_FOLDER
    raise ConfigError(f"{_as_given(run_dir, name, root)}: {what}")


def holds_something_else(folder: Path, *, own: Path, lock: Path) -> bool:
    """Whether a folder has something in it, but not the file `own`, which every job's has."""
    return not own.exists() and any(path != lock for path in folder.iterdir())


def write_json(path: Path, data: Mapping[str, Any]) -> None:
    """Writes `data` as `write_text` does."""
    write_text(path, json.dumps(data, indent=2) + "\n")


def write_text(path: Path, text: str) -> None:
    """Writes a text as `write_bytes` does."""
    write_bytes(path, text.encode())


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Has errors within name the file: those of writing to an open file name none.

    Those of replacing it name the other one first.
    """
    try:
        yield
    except OSError as error:
        error.filename, error.filename2 = str(path), None
        raise


def write_bytes(path: Path, content: bytes) -> None:
    """Writes a file so that a reader sees the old one or the new one, never half a file.

    Also after a loss of power: its content is on the disk before its name is.
    """
    # Not the folders above: one that was moved away must not come back with half of its files.
    path.parent.mkdir(exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}-{threading.get_ident()}")
    try:
        with naming(path):
            with temporary.open("wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def remove_temporary(folder: Path) -> None:
    """Removes what processes left in a folder that were killed within `write_bytes`."""
    for path in folder.glob(".*"):
        if _TEMPORARY.fullmatch(path.name):
            path.unlink(missing_ok=True)


def read_json(path: Path) -> dict[str, Any]:
    """Reads what `write_json` wrote.

    Raises:
      DamagedFile: it cannot be read, or is no JSON object; the message has the path.
    """
    try:
        with open_regular(path) as file:
            content = file.read(LARGEST_JSON_BYTES + 1)
        if len(content) > LARGEST_JSON_BYTES:
            raise OSError(errno.EFBIG, f"larger than {LARGEST_JSON_BYTES >> 20} MiB")
        data: object = json.loads(content)
    except OSError as error:
        why = error.strerror or str(error)
        raise DamagedFile(f"{nearby(path)}: cannot be read", why) from None
    except RecursionError:
        raise DamagedFile(f"{nearby(path)}: broken", "nested too deeply") from None
    except ValueError as error:  # Not JSON, or not even text.
        raise DamagedFile(f"{nearby(path)}: broken", f"not JSON: {error}") from None
    if not isinstance(data, dict):
        raise DamagedFile(f"{nearby(path)}: broken", "not a JSON object")
    return typing.cast("dict[str, Any]", data)


def open_regular(path: Path) -> BinaryIO:
    """Opens a file for reading that is nothing else, e.g. a pipe, which would wait for a writer.

    Raises:
      OSError: it is something else, or cannot be opened.
    """
    # Before it is opened: to open a device may do something.
    _require_regular(path, os.stat(path))
    fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        _require_regular(path, os.fstat(fd))
        return open(fd, "rb")
    except BaseException:
        os.close(fd)
        raise


def _require_regular(path: Path, found: os.stat_result) -> None:
    if not stat.S_ISREG(found.st_mode):
        raise OSError(errno.EINVAL, "not a regular file", str(path))


def add_event(path: Path, event: str, **details: Any) -> None:
    """Appends to the events of a run; a full disk must not end what it only records."""
    when = datetime.now().astimezone().isoformat(timespec="milliseconds")
    line = (json.dumps({"time": when, "event": event, **details}) + "\n").encode()
    with suppress(OSError), path.open("ab", buffering=0) as file:
        end = file.tell()
        if file.write(line) < len(line):
            file.truncate(end)  # The next event would stand behind half of this one.
