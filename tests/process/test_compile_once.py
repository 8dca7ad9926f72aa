"""Processes that need the same programs at the same time, with real ones on the CPU."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from supervision import CHECKOUT
from training_jobs import POINT, STEPS, train

from gmijax.runs.folder import read_json

MISS = re.compile(r"PERSISTENT COMPILATION CACHE MISS for '([\w.<>-]+)' with key")
LARGE = {"jit_whole", "jit_init"}
"""Programs that GMIs compile with the lock; others are compiled in no time."""

PROGRAM = """
import sys, time
import jax, jax.numpy as jnp
from gmijax.compile_once import compile_once
from gmijax.runs import compile_lock
from contextlib import nullcontext

def waits():
    print("waits", flush=True)
    return nullcontext()

compile_lock.ON_WAIT.append(waits)

class Slow:
    # As jax's, but it takes as long as the test wants.
    def __init__(self, lowered):
        self.as_text, self._lowered = lowered.as_text, lowered

    def compile(self):
        print("compiles", flush=True)
        sys.stdin.readline()
        return self._lowered.compile()

lowered = jax.jit(lambda x: jnp.sin(x) + 1).lower(1.0)
print(float(compile_once(Slow(lowered))(1.0)), flush=True)
"""


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A compilation cache with nothing in it; what is not there is named in the log."""
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("JAX_DEBUG_LOG_MODULES", "jax._src.compiler")
    return tmp_path / "cache"


def compiled_by(*logs: Path) -> Counter[str]:
    """How often each program was compiled."""
    return Counter(name for log in logs for name in MISS.findall(log.read_text()))


@pytest.mark.usefixtures("cache")
def test_gmis_of_a_job_compile_once(tmp_path: Path) -> None:
    done = train(
        *(*POINT, "plan.gmis_per_gpu=2", f"num_timesteps={4 * STEPS}", "run.dir=run"),
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    logs = [tmp_path / "run" / f"gmi_{gmi}" / "stderr.log" for gmi in (0, 1)]
    found = compiled_by(*logs)
    assert {name: found[name] for name in LARGE} == dict.fromkeys(LARGE, 1)
    start_s = read_json(tmp_path / "run" / "summary.json")["start_s"]
    assert {"tracing", "waiting", "compiling"} <= start_s.keys()


@pytest.mark.usefixtures("cache")
def test_jobs_of_a_sweep_compile_once(tmp_path: Path) -> None:
    done = train(
        *(*POINT, "seed=0,1", "sweep.jobs_per_gpu=2", f"num_timesteps={2 * STEPS}", "run.dir=all"),
        cwd=tmp_path,
        command="sweep",
    )
    assert done.returncode == 0, done.stderr
    logs = [tmp_path / "all" / job / "gmi_0" / "stderr.log" for job in ("000", "001")]
    found = compiled_by(*logs)
    assert {name: found[name] for name in LARGE} == dict.fromkeys(LARGE, 1)


def start_program(cache: Path) -> subprocess.Popen[str]:
    variables = {
        **os.environ,
        "PYTHONPATH": str(CHECKOUT),
        "JAX_COMPILATION_CACHE_DIR": str(cache),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PLATFORMS": "cpu",
    }
    return subprocess.Popen(
        [sys.executable, "-c", PROGRAM],
        env=variables,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )


def next_line(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline().strip()


def go_on(process: subprocess.Popen[str]) -> None:
    assert process.stdin is not None
    process.stdin.write("\n")
    process.stdin.flush()


def test_one_goes_on_where_the_compiler_is_killed_and_then_all_load_at_once(cache: Path) -> None:
    with start_program(cache) as first:
        assert next_line(first) == "compiles"
        with start_program(cache) as second:
            assert next_line(second) == "waits"
            first.kill()
            assert next_line(second) == "compiles"
            go_on(second)
            value = next_line(second)
    with start_program(cache) as third, start_program(cache) as fourth:
        # Neither waits for the other, nor holds anything while it loads.
        assert [next_line(third), next_line(fourth)] == ["compiles"] * 2
        for process in (third, fourth):
            go_on(process)
            assert next_line(process) == value
    for entry in cache.glob("*-cache"):
        entry.unlink()
    with start_program(cache) as fifth, start_program(cache) as sixth:
        assert sorted((next_line(fifth), next_line(sixth))) == ["compiles", "waits"]
        for process in (fifth, sixth):
            process.kill()
