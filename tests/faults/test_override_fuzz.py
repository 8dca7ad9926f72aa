"""Any command line ends in success, or in exit code 2 with one line; never in a traceback.

`GMIJAX_FUZZ_EXAMPLES=5000 pytest -s tests/faults/test_override_fuzz.py` tries other lines every
time, as many of each command; GMIJAX_FUZZ_SEED gives the same ones again. A failure prints the
line. Nothing is started.
"""

from __future__ import annotations

import os
import random
import resource
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from command_lines import COMMANDS, CPU, run
from hypothesis import HealthCheck, given, seed, settings
from hypothesis import strategies as st
from plain_run import constant_policy
from strange_lines import command_lines
from supervision import machine

from gmijax.cli.compose import compose
from gmijax.config import ALGORITHMS
from gmijax.config.schema import to_dict
from gmijax.player.plain_env import PlainEnv
from gmijax.player.policy import write_policy
from gmijax.runs.checkpoints import CheckpointMeta
from gmijax.runs.folder import META, POLICY, RunPaths, write_json

_MORE = os.environ.get("GMIJAX_FUZZ_EXAMPLES")
_SEED = int(os.environ.get("GMIJAX_FUZZ_SEED", random.randrange(2**32) if _MORE else 0))
_ADDRESS_SPACE_BYTES = 4 * 2**30
"""Beside what the test process has: a line that takes more memory fails, and hurts nobody."""

_FEW = {"sweep": 8, "play": 30, "view": 30, "export": 30, "doctor": 60, "list-envs": 60}
"""Lines without GMIJAX_FUZZ_EXAMPLES where they are not 16: hydra takes long for a sweep."""

_MACHINES = (
    CPU,
    machine(2, mps_control=Path("/usr/bin/nvidia-cuda-mps-control")),
    machine(1, cpu_cores=(0,)),
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A working directory with a run, a file of a task, and limited memory."""
    root = tmp_path_factory.mktemp("fuzz")
    (root / "cache" / "gmijax" / "profiles").mkdir(parents=True)
    (root / "task.py").write_text("def make(*, impl, max_envs): ...\n")
    done = RunPaths(root / "runs" / "done")
    config = compose("env=ant", "num_envs=64")
    assert isinstance(config.algo, ALGORITHMS)
    hidden = config.algo.hidden_layer_sizes
    done.root.mkdir(parents=True, exist_ok=True)
    write_json(done.config, to_dict(config))
    meta = CheckpointMeta("ant", "ppo", 1000, 1, 64, hidden, "jax")
    done.checkpoint(1000).mkdir(parents=True, exist_ok=True)
    write_json(done.checkpoint(1000) / META, meta.to_dict())
    policy = constant_policy(PlainEnv(config.env), 0.0)
    write_policy(done.checkpoint(1000) / POLICY, policy)
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    resource.setrlimit(
        resource.RLIMIT_AS, (pages * resource.getpagesize() + _ADDRESS_SPACE_BYTES, hard)
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("NOT_TEXT", os.fsdecode(b"a\xffb"))
        patch.setenv("TWO_LINES", "a\nb")
        yield root
    resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


@pytest.mark.parametrize("command", list(COMMANDS))
@pytest.mark.timeout(3600 if _MORE else 300)
def test_any_line_is_taken_or_refused_in_one_line(command: str, folder: Path) -> None:
    before = sorted(folder.rglob("*"))
    ends: Counter[str] = Counter()

    @seed(_SEED)
    @settings(
        max_examples=int(_MORE) if _MORE else _FEW.get(command, 16),
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(command_lines(command), st.sampled_from(_MACHINES))
    def holds(argv: list[str], here: Any) -> None:
        done = run(command, *argv, cwd=folder, machine=here)
        ends[str(done.code)] += 1
        if done.code in (None, 0):
            assert done.stderr == ""
            return
        assert done.code == 2, done
        assert done.stdout == ""
        assert len(done.stderr.splitlines()) == 1, done.stderr
        assert done.stderr.startswith(f"gmijax.{command.replace('-', '_')}: ")
        assert done.stderr.endswith("\n")

    try:
        holds()
    finally:  # Shown with a failure, and with `-s`; None: it would have started something.
        sys.stdout.write(f"{command}: seed {_SEED}, exit codes {dict(ends)}\n")
    assert sorted(folder.rglob("*")) == before
