"""Checkpoints that cannot be used are told in one line."""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import orbax.checkpoint as ocp
import pytest

from gmijax.checkpoint import restore_learner
from gmijax.errors import ConfigError


def restore_with(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(ocp.StandardCheckpointer, "restore", fail)
    restore_learner(Path("x"), {"a": jnp.zeros(2)})


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (ValueError("trees differ:\nhere\nthere"), "trees differ:"),
        (ValueError(), "ValueError"),
        (KeyError("a"), "'a'"),
        (FileNotFoundError("gone"), "gone"),
        # What orbax raises for an array whose file was cut off.
        (Exception("Encountered error while reading"), "Encountered error while reading"),
    ],
)
def test_checkpoint_that_does_not_fit_is_bad_input(
    error: Exception, said: str, monkeypatch: pytest.MonkeyPatch
):
    with pytest.raises(
        ConfigError, match=rf"^checkpoint x/learner does not fit this job: {said}$"
    ):
        restore_with(error, monkeypatch)


def test_failure_of_the_device_is_not_the_checkpoints(monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(RuntimeError, match="RESOURCE_EXHAUSTED"):
        restore_with(RuntimeError("RESOURCE_EXHAUSTED"), monkeypatch)
