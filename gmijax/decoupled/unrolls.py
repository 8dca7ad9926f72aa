"""The programs of an agent: an unroll, in pieces that are joined on the device."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from gmijax.compile_once import compile_once
from gmijax.devices import host_sharding
from gmijax.learning.learner import ActingWeights
from gmijax.learning.unroll import Counts, no_counts
from gmijax.sim.wrappers import BatchedEnv, BatchState
from gmijax.types import Array


def concatenated(pieces: Sequence[Any]) -> Any:
    """The unroll that pieces are in a row: each channel [S, N, ...] along its steps."""
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), *pieces)


class UnrollPrograms:
    """The compiled programs of an agent's unrolls, of `num_pieces` pieces.

    Args:
      env: the environments.
      collect: makes a piece: `(model, weights, env_state) -> (env_state, experience, counts)`.
      join: pieces to an unroll.
      num_pieces: of an unroll.
      weights: an example of those that act.
      env_state: an example.
      stays: whether unrolls stay on the device; others go where the host can read them.
    """

    def __init__(
        self,
        env: BatchedEnv,
        collect: Callable[..., tuple[BatchState, Any, Counts]],
        join: Callable[[Sequence[Any]], Any],
        num_pieces: int,
        weights: ActingWeights,
        env_state: BatchState,
        *,
        stays: bool = False,
    ) -> None:
        self._model = env.model
        piece = jax.jit(collect, donate_argnums=(2,))
        lowered: Any = piece.lower(env.model, weights, env_state)
        where = host_sharding()
        unrolls: Any = None if stays else where
        joining = jax.jit(partial(_join, join), out_shardings=(unrolls, where) if where else None)
        self._join: Any = compile_once(joining.lower([lowered.out_info[1:]] * num_pieces))
        self._piece: Any = compile_once(lowered)

    def piece(
        self, weights: ActingWeights, env_state: BatchState
    ) -> tuple[BatchState, tuple[Any, Counts]]:
        """Starts the next steps; `env_state` is donated."""
        env_state, kept, counts = self._piece(self._model, weights, env_state)
        return env_state, (kept, counts)

    def join(self, pieces: Sequence[tuple[Any, Counts]]) -> tuple[Any, Array]:
        """The unroll that pieces are in a row, and its packed counts [M]."""
        return self._join(list(pieces))


def _join(
    join: Callable[[Sequence[Any]], Any], pieces: Sequence[tuple[Any, Counts]]
) -> tuple[Any, Array]:
    kept, counts = zip(*pieces, strict=True)
    totals = jax.tree.map(lambda *parts: sum(parts), *counts)
    return join(kept), ravel_pytree(totals)[0]


def num_counts(env: BatchedEnv) -> int:
    """M, how many numbers `Counts` are."""
    return len(jax.tree.leaves(no_counts(env.spec, env.overflows)))
