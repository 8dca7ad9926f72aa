"""Rewards as named, weighted terms.

A task lists its terms as data, so that logs show every addend, and `env.rewards` changes their
weights. A weight of zero costs nothing. The logged addends always sum to the reward.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from gmijax.arrays import array_module
from gmijax.config.schema import suggestion
from gmijax.errors import ConfigError
from gmijax.types import Array

View = TypeVar("View")
"""What the terms of one task may read: a NamedTuple of that task."""


class RewardTerm(NamedTuple, Generic[View]):
    """One addend of a reward.

    Attributes:
      fn: `view -> []`, without the weight: float32 in JAX; a number where it is always the same.
      weight: factor; its sign makes the term a reward or a cost.
    """

    fn: Callable[[View], Array | float]
    weight: float


class Replacement(NamedTuple):
    """A value that replaces the whole reward in some steps, such as a death penalty.

    Attributes:
      name: under which it is logged; it is a term like any other, zero while `when` is false.
      when: [] bool, whether it applies.
      value: the reward where it applies.
      keeps: share of all other terms that stay where it applies; with 1 it is one more addend.
    """

    name: str
    when: Array
    value: float
    keeps: float = 0.0


def with_weights(
    terms: Mapping[str, RewardTerm[View]], weights: Mapping[str, float] | None
) -> Mapping[str, RewardTerm[View]]:
    """The terms, with another weight where `weights` names one.

    Raises:
      ConfigError: an unknown name.
    """
    changed = dict(terms)
    for name, weight in (weights or {}).items():
        if name not in terms:
            raise ConfigError(f"unknown key env.rewards.{name}{suggestion(name, terms)}")
        changed[name] = terms[name]._replace(weight=weight)
    return changed


def total_reward(
    terms: Mapping[str, RewardTerm[View]], view: View, replacement: Replacement | None = None
) -> tuple[Array, dict[str, Array]]:
    """Returns the reward [] and its addends by name; terms of weight 0 are zero, and not traced.

    Args:
      terms: the task's terms, in the order in which they are logged.
      view: what they read.
      replacement: replaces all terms where it applies.
    """
    found = {
        name: 0.0 if term.weight == 0.0 else term.weight * term.fn(view)
        for name, term in terms.items()
    }
    when = () if replacement is None else (replacement.when,)
    xp = array_module(*found.values(), *when)
    values = {name: xp.asarray(value, np.float32) for name, value in found.items()}
    if replacement is not None:
        keeps = replacement.keeps
        values = {
            name: xp.where(replacement.when, keeps * value if keeps else 0.0, value)
            for name, value in values.items()
        }
        values[replacement.name] = xp.where(replacement.when, xp.float32(replacement.value), 0.0)
    total: Any = sum(values.values(), xp.zeros((), np.float32))
    return total, values


def term_names(
    terms: Mapping[str, RewardTerm[View]], replacement: str | None = None
) -> tuple[str, ...]:
    """The names that `total_reward` logs, in its order."""
    return tuple(terms) if replacement is None else (*terms, replacement)
