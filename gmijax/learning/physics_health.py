"""Bad numbers and full buffers, reported alike by training and serving. No jax."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping

from gmijax.errors import NonFiniteError

TOLERATED_FRACTION = 1e-3
"""Fraction of some steps that may diverge: rare, and nothing that is learnt."""

TOLERATED_STEPS = 10
"""The same in steps, for so few of them that one is a large fraction."""


def check_diverged(where: str, diverged: Mapping[str, float], steps: float) -> None:
    """Ends a job in which environments diverge more often than now and then.

    Args:
      where: task and time, for the message.
      diverged: environments that were ended because of a bad number: `any`, and by its source (see
        `gmijax.sim.divergence`).
      steps: environment steps in which that happened.

    Raises:
      NonFiniteError: more than `TOLERATED_FRACTION` of them and more than `TOLERATED_STEPS`.
    """
    if diverged["any"] > max(TOLERATED_STEPS, TOLERATED_FRACTION * steps):
        arrays = [name for name, count in diverged.items() if count and name != "any"]
        raise NonFiniteError(
            f"{where}: {diverged['any']:.0f} of {steps:.0f} steps gave numbers that are not "
            f"finite or beyond all bounds, in {', '.join(arrays)}"
        )


def check_losses(where: str, losses: Mapping[str, float]) -> None:
    """Ends a job whose losses are not finite.

    Raises:
      NonFiniteError: names those of `losses` that are NaN or infinite, and `where`.
    """
    if names := [name for name, value in losses.items() if not math.isfinite(value)]:
        raise NonFiniteError(f"{where}: {', '.join(names)} of the update is not finite")


class OverflowCount:
    """Counts steps for which a buffer of MJX-Warp was too small; reports the first ones.

    Attributes:
      steps: environment steps so far, by buffer; empty if nothing can overflow.
    """

    def __init__(self, env_name: str) -> None:
        self._env_name = env_name
        self.steps: dict[str, float] = {}

    def add(self, overflowed: Mapping[str, float]) -> None:
        """Adds steps by buffer, of one iteration or unroll."""
        for name, count in overflowed.items():
            before = self.steps.get(name, 0.0)
            if count and not before:
                sys.stderr.write(
                    f"{self._env_name}: MJX-Warp's {name} buffer was too small in {count:.0f} "
                    "environment steps; what did not fit was left out (counted in "
                    f"physics/{name}_overflow_steps)\n"
                )
            self.steps[name] = before + count


def overflow_warnings(steps: Mapping[str, float]) -> str:
    """Lines for people, each with a line break before it; empty if nothing overflowed."""
    return "".join(
        f"\nwarning: MJX-Warp's {name} buffer was too small in {count:,.0f} environment steps"
        for name, count in steps.items()
        if count
    )


def overflow_line(overflowed: Mapping[str, float]) -> dict[str, float]:
    """The part of a line of metrics."""
    return {f"physics/{name}_overflow_steps": count for name, count in overflowed.items()}
