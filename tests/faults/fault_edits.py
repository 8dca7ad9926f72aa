"""One file that was damaged, and the command that reads it; see `fault_files`."""

from __future__ import annotations

import random
import shutil
import signal
import subprocess
import sys
from pathlib import Path

from fault_checks import events_of, is_whole, newest_whole, not_one_line
from fault_files import EDITS, READERS, EditKind, damage, drawn_file
from fault_fixtures import COLLECT, RUN_STEPS, SEARCH, SWEEP, TRAIN, fixture, write_tasks
from fault_processes import MARKER, processes_of, send
from fault_report import Report
from training_jobs import STEPS, child_environment

_LIMIT_S = 90.0
_MORE = {
    "more": (*TRAIN, f"num_timesteps={RUN_STEPS + 20 * STEPS}"),
    "same": (*TRAIN, f"num_timesteps={RUN_STEPS}"),
    "sweep": SWEEP,
    "collect": (*COLLECT, "num_timesteps=512"),
    "search": SEARCH,
}
"""What stands for several words of a command line."""

_LOAD = """
import sys
import numpy
import gmijax
from gmijax.errors import ConfigError
try:
    policy = gmijax.load_policy(sys.argv[1])
except ConfigError as error:
    sys.exit(sys.stderr.write(f"gmijax.load_policy: {error}\\n") and 2)
policy(numpy.zeros(policy.obs_size, numpy.float32))
"""


def run_edit(name: str, seed: int, scratch: Path, fixtures: Path) -> Report:
    """Damages a file of a copy of a fixture in `scratch`; raises nothing."""
    kind, draw = EDITS[name], random.Random(seed)
    scratch.mkdir(parents=True, exist_ok=True)
    try:
        wrong = _run(kind, draw, scratch, fixtures)
    except Exception as error:
        wrong = [f"{type(error).__name__}: {error}"]
    left = processes_of(scratch)
    send(left, signal.SIGKILL)
    return Report.of(name, seed, [*wrong, *(f"leaked: {process}" for process in left)])


def _run(kind: EditKind, draw: random.Random, scratch: Path, fixtures: Path) -> list[str]:
    run = scratch / "run"
    shutil.copytree(fixture(kind.fixture, fixtures), run)
    (scratch / "tmp").mkdir()
    write_tasks(scratch)
    file = drawn_file(run, kind, draw)
    way = damage(file, kind, draw)
    before = {path: path.read_bytes() for path in run.rglob("*") if _is_plain(path)}
    newest = newest_whole(run)
    code, stderr, shown = _read(kind, file, run, scratch)
    what = f"{file.relative_to(run)} damaged ({way}), {kind.reader}"
    if code is None:
        return [f"{what}: no end within {_LIMIT_S:.0f} s"]
    wrong = []
    if kind.says not in stderr + shown:
        wrong.append(f"{what}: {kind.says} is not in {stderr[-300:]} {shown[-300:]}")
    if kind.holds and kind.holds not in file.read_text():
        wrong.append(f"{what}: {kind.holds} is not kept")
    if code not in ((0, 2) if kind.code is None else (kind.code,)):
        wrong.append(f"{what}: exit code {code}: {stderr[-600:]}")
    elif code == 2:
        verb = READERS[kind.reader][0]
        wrong += [f"{what}: {text}" for text in not_one_line(stderr, verb)]
        changed = [p for p, data in before.items() if not p.is_file() or p.read_bytes() != data]
        wrong += [f"lost: {what}: refused, but {path} is not as it was" for path in changed]
    elif "Traceback" in stderr:
        wrong.append(f"{what}: a traceback: {stderr[-600:]}")
    if code == 0 and kind.reader in ("auto", "given", "resume"):
        wrong += _what_was_lost(run, scratch / "new", newest, kind)
    kept = (path.parent for path in before if path.name == "meta.json")
    others = sorted(path for path in kept if path not in (file.parent, *file.parents))
    return [*wrong, *(f"lost: {what}: {path}" for path in others if not is_whole(path))]


def _what_was_lost(run: Path, new: Path, newest: Path | None, kind: EditKind) -> list[str]:
    if kind.files == "events.jsonl":  # It says where training began, and is what was damaged.
        return []
    trained = new if kind.reader == "resume" else run
    starts = events_of(trained, "start")
    if not starts or newest is None:
        return [f"lost: there was {newest}, and {len(starts)} starts are noted"]
    begun = Path(starts[-1]["checkpoint"] or "none").name
    return [] if begun == newest.name else [f"lost: went on from {begun}, not {newest.name}"]


def _is_plain(path: Path) -> bool:
    return path.is_file() and not path.is_symlink() and path.name != ".lock"


def _read(kind: EditKind, file: Path, run: Path, scratch: Path) -> tuple[int | None, str, str]:
    """Exit code (None: no end), errors and output of the command that reads the file."""
    verb, *words = READERS[kind.reader]
    filled: list[str] = []
    for word in words:
        whole = _MORE.get(word.strip("{}"))
        filled += whole or [word.format(run=run, home=scratch, file=file)]
    program = ["-c", _LOAD] if verb == "load_policy" else ["-m", f"gmijax.{verb}"]
    try:
        done = subprocess.run(
            [sys.executable, *program, *filled],
            cwd=scratch,
            env=child_environment() | {MARKER: str(scratch), "TMPDIR": str(scratch / "tmp")},
            capture_output=True,
            text=True,
            errors="replace",
            timeout=_LIMIT_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return None, "", ""
    return done.returncode, done.stderr, done.stdout
