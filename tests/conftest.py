"""What every test needs: the environment of jax, set before its import, and given back after."""

from __future__ import annotations

import copy
import functools
import gc
import io
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pynvml
import pytest
from omegaconf import OmegaConf

from gmijax.machine.xla_on_cpu import flags_on_cpu

# Of XLA:CPU, read when jax starts, so it is set before any test module is imported.
# A thread pool of exactly two threads, as on a machine with two cores, can hang.
os.environ.setdefault("PJRT_NPROC", "4")

# Compiling is most of what these tests cost. The folder lies outside of the checkout, so that
# it survives `make clean` and serves several checkouts; gmijax hands it on to the GMIs.
_CACHE_HOME = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(_CACHE_HOME / "gmijax-tests"))
# Programs of the tests' own process too, of which most compile in less than jax's least second.
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")


# A shell ignores SIGINT in what it starts in the background, nohup SIGHUP; gmijax leaves ignored
# signals ignored, and the processes that tests start inherit that.
for _number in (signal.SIGINT, signal.SIGHUP, signal.SIGTERM, signal.SIGUSR1):
    if signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, signal.SIG_DFL)
if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def _has_gpu() -> bool:
    try:
        pynvml.nvmlInit()
    except pynvml.NVMLError:
        return False
    try:
        return pynvml.nvmlDeviceGetCount() > 0
    finally:
        pynvml.nvmlShutdown()


# LLVM's -O0 compiles in a fifth of the time; most programs of tests run for less than that.
if not _has_gpu():
    os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
    # As in GMIs. Programs compile in half the time with it.
    os.environ["XLA_FLAGS"] = flags_on_cpu(os.environ.get("XLA_FLAGS", ""))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skips tests marked `gpu` where there is no NVIDIA GPU."""
    marked = [item for item in items if item.get_closest_marker("gpu")]
    if marked and not _has_gpu():
        for item in marked:
            item.add_marker(pytest.mark.skip(reason="no NVIDIA GPU"))


def pytest_collection_finish() -> None:
    """Leaves what was imported out of garbage collections, and lets these be rarer.

    Tracing a program makes a million objects that live: a sixth of its time was collections.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)


@pytest.fixture(scope="session", autouse=True)
def files_parsed_once() -> Iterator[None]:
    """Hydra reads all files of a configuration again for every line, 40 % of its time."""
    load = OmegaConf.load

    @functools.cache
    def parsed(text: str) -> Any:
        return load(io.StringIO(text))

    with pytest.MonkeyPatch.context() as patch:
        # Hydra changes what it is given.
        patch.setattr(OmegaConf, "load", lambda file: copy.deepcopy(parsed(file.read())))
        yield


@pytest.fixture(autouse=True)
def environment_restored() -> Iterator[None]:
    """Undoes what a test does to `os.environ`, and no more.

    Only differences are written back: threads of jax may read the environment meanwhile, and
    `setenv` under a concurrent `getenv` is undefined in C.
    """
    before = dict(os.environ)
    yield
    after = dict(os.environ)
    for key in (before.keys() | after.keys()) - {"PYTEST_CURRENT_TEST"}:
        if key not in before:
            del os.environ[key]
        elif before[key] != after.get(key):
            os.environ[key] = before[key]
