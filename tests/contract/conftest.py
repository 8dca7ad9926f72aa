"""The tasks x implementations that contract tests run over."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator

import jax
import pytest
from compiled_tasks import CompiledTask

from gmijax.machine.xla_on_cpu import flags_on_cpu
from gmijax.sim.registry import TASKS

CHEAPEST = "ball_balance"
"""The task that runs with MJX-Warp too, and through a thousand steps, where time is short."""


def _variants() -> list[object]:
    # On a CPU Warp compiles its kernels for 30 s, and takes milliseconds a step.
    missing = pytest.mark.skipif(
        importlib.util.find_spec("warp") is None, reason="warp-lang is not installed"
    )
    with_jax = [pytest.param((name, "jax"), id=name) for name in sorted(TASKS)]
    with_warp = [
        pytest.param(
            (name, "warp"),
            id=f"{name}-warp",
            marks=[missing] if name == CHEAPEST else [missing, pytest.mark.slow],
        )
        for name in sorted(TASKS)
    ]
    return [*with_jax, *with_warp]


@pytest.fixture(scope="module", autouse=True)
def all_optimizations() -> Iterator[None]:
    """Where a flag of XLA cannot help: a reset of franka_cabinet takes minutes without either."""
    name = "jax_disable_most_optimizations"
    before = jax.config.read(name)
    jax.config.update(name, before and bool(flags_on_cpu("")))
    yield
    jax.config.update(name, before)


@pytest.fixture(scope="session", params=_variants())
def task(request: pytest.FixtureRequest) -> CompiledTask:
    return CompiledTask(*request.param)


@pytest.hookimpl(tryfirst=True)  # Before tests are left out by their marks.
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks a thousand steps of the dearer tasks as slow: up to a minute each on two cores."""
    for item in items:
        if item.path.name == "test_physics_sanity.py" and f"[{CHEAPEST}]" not in item.name:
            item.add_marker(pytest.mark.slow)
