"""What unit tests share."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any

import pytest

from gmijax.cli import compose


@pytest.fixture(scope="session", autouse=True)
def composed_once() -> Iterator[None]:
    """Hydra composes equal lines once: a fifth of a second each, and hundreds are equal.

    What it returns is read and not changed; what it refuses it is asked for again.
    """
    inner = compose.hydra_compose

    @functools.cache
    def composed(name: str, overrides: tuple[str, ...]) -> Any:
        return inner(name, overrides=list(overrides))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            compose, "hydra_compose", lambda name, overrides: composed(name, tuple(overrides))
        )
        yield
