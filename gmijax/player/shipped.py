"""The trained policies that are shipped, one for a task; `benchmarks/shipped.py` makes them."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from gmijax.errors import ConfigError
from gmijax.player.policy import PlainPolicy, read_policy

POLICIES: Final = Path(__file__).parent / "policies"


def shipped_tasks() -> tuple[str, ...]:
    """Tasks of which a policy is shipped."""
    return tuple(sorted(path.stem for path in POLICIES.glob("*.npz")))


def require_alone(key: str, value: object, allowed: object = None) -> None:
    """Raises ConfigError for a key that a shipped policy cannot be played with."""
    if value != allowed:
        shown = str(value).lower() if isinstance(value, bool) else value
        raise ConfigError(
            f"checkpoint=shipped cannot be combined with {key}; remove {key}={shown}"
        )


def require_shipped(task: str | None) -> str:
    """The task; raises ConfigError if no policy of it is shipped."""
    tasks = ", ".join(shipped_tasks()) or "none (python -m benchmarks.shipped makes them)"
    if task is None:
        raise ConfigError(f"checkpoint=shipped: of which task? Add env=TASK; there are {tasks}")
    if task not in shipped_tasks():
        raise ConfigError(f"env={task}: no policy of it is shipped; allowed: {tasks}")
    return task


def shipped_policy(task: str) -> PlainPolicy:
    """The shipped policy of a task.

    Raises:
      ConfigError: there is none.
    """
    return read_policy(POLICIES / f"{require_shipped(task)}.npz")
