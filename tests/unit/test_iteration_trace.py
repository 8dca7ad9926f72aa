"""`run.profile`: which iterations are traced, and what is written of them."""

from __future__ import annotations

import gzip
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import pytest

from gmijax.config import RunConfig
from gmijax.errors import ConfigError
from gmijax.learning.iteration_trace import IterationTrace


@jax.jit
def toy_iteration(x: jax.Array) -> jax.Array:
    return jnp.sin(x) @ x


def _trained(trace: IterationTrace, num_iterations: int) -> dict[str, Any]:
    """Iterations that the device computes while the host goes on; what the run notes of them."""
    x = jnp.ones((64, 64))

    def wait() -> None:
        x.block_until_ready()

    for iteration in range(1, num_iterations + 1):
        trace.begin(iteration, wait)
        x = toy_iteration(x)
        trace.end(iteration, wait)
    wait()
    trace.close()
    return trace.outcome() or {}


def _events(folder: Path) -> list[dict[str, Any]]:
    [path] = folder.glob("plugins/profile/*/perfetto_trace.json.gz")
    return json.loads(gzip.decompress(path.read_bytes()))["traceEvents"]


def _steps(folder: Path) -> list[int]:
    steps = [event for event in _events(folder) if event.get("name") == "iteration"]
    return sorted(int(event["args"]["step_num"]) for event in steps)


def test_the_asked_iterations_are_traced_and_no_others(tmp_path: Path):
    outcome = _trained(IterationTrace((2, 4), tmp_path), 6)
    found = {"iterations": (2, 4), "dir": str(tmp_path), "error": None}
    assert outcome == found
    assert _steps(tmp_path) == [2, 3, 4]
    calls = [e for e in _events(tmp_path) if e.get("name") == "PjitFunction(toy_iteration)"]
    assert len({call["ts"] for call in calls}) >= 3
    [xplane] = tmp_path.glob("plugins/profile/*/*.xplane.pb")  # What TensorBoard's plugin reads.
    assert xplane.stat().st_size > 0


def test_a_run_that_ends_on_the_way_keeps_what_was_traced(tmp_path: Path):
    outcome = _trained(IterationTrace((2, 9), tmp_path), 3)
    assert outcome["iterations"] == (2, 3)
    assert _steps(tmp_path) == [2, 3]


def test_a_run_that_never_comes_there_says_so(tmp_path: Path):
    outcome = _trained(IterationTrace((5, 9), tmp_path / "profile"), 3)
    assert outcome["iterations"] is None
    assert not (tmp_path / "profile").exists()


def test_all_ranks_wait_in_the_same_iterations(tmp_path: Path):
    """What they wait for can be a step of all, which the others would take for another one."""

    def waits(name: str, *, is_written: bool) -> list[int]:
        trace, found = IterationTrace((2, 4), tmp_path / name, is_written=is_written), []
        for iteration in range(1, 6):
            trace.begin(iteration, lambda: found.append(iteration))  # noqa: B023
            trace.end(iteration, lambda: found.append(-iteration))  # noqa: B023
        trace.close()
        assert (trace.outcome() is not None) == (tmp_path / name).exists() == is_written
        return found

    assert waits("one", is_written=True) == waits("other", is_written=False) == [2, -4]


def test_without_the_key_nothing_is_noted(tmp_path: Path):
    assert _trained(IterationTrace(None, tmp_path), 2) == {}


def test_a_trace_that_cannot_be_written_ends_no_training(tmp_path: Path):
    (tmp_path / "file").touch()
    outcome = _trained(IterationTrace((1, 1), tmp_path / "file"), 3)
    assert outcome["error"]
    assert _trained(IterationTrace((1, 1), tmp_path), 1)["error"] is None


def test_a_trace_of_an_earlier_command_stays_as_it_is(tmp_path: Path):
    earlier = tmp_path / "plugins" / "profile" / "2020_01_01_00_00_00"
    earlier.mkdir(parents=True)
    for name in ("host.trace.json.gz", "perfetto_trace.json.gz"):
        (earlier / name).write_bytes(b"as it was")
    assert _trained(IterationTrace((1, 1), tmp_path), 2)["error"] is None
    found = sorted(tmp_path.glob("plugins/profile/*/perfetto_trace.json.gz"))
    assert [path.read_bytes() == b"as it was" for path in found] == [True, False]


def test_a_tracer_that_writes_no_events_is_an_error(tmp_path: Path, monkeypatch):
    stop = jax.profiler.stop_trace

    def stop_and_lose() -> None:
        stop()
        for path in tmp_path.glob("plugins/profile/*/*.trace.json.gz"):
            path.unlink()

    monkeypatch.setattr(jax.profiler, "stop_trace", stop_and_lose)
    outcome = _trained(IterationTrace((1, 1), tmp_path), 2)
    assert outcome["error"] == f"JAX has written no events below {tmp_path}"


@pytest.mark.parametrize(
    "wanted", ["5", "0:3", "5:4", "a:b", "3:", ":3", "1:2:3", "1:99999999999"]
)
def test_other_ranges_are_refused(wanted: str):
    with pytest.raises(ConfigError, match=f"run.profile={wanted}: expected FIRST:LAST"):
        run_config(wanted)


def test_a_trace_that_memory_may_not_hold_is_refused():
    assert run_config("11:30").profiled == (11, 30)
    with pytest.raises(ConfigError, match=r"11:31: 21 iterations; at most 20"):
        run_config("11:31")


def test_one_iteration_is_a_range():
    assert run_config("7:7").profiled == (7, 7)


def run_config(profile: str) -> RunConfig:
    from gmijax.cli.compose import compose

    return compose(f"run.profile='{profile}'").run
