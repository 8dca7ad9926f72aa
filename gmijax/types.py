"""Array aliases and the legend of size letters that docstrings use.

T: steps of one rollout.  N: environments of one GMI.  O: size of an observation.
A: size of an action.  K: number of GMIs that train.  P: numbers that are reduced at once, those
of the gradient with the parts of the loss.  B: samples of one minibatch; in channels environments
of one batch.  [] is a scalar.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

if TYPE_CHECKING:
    import jax

# As texts, so that modules that name types need not load jax.
Array: TypeAlias = "jax.Array"
"""One array on a device."""

PRNGKey: TypeAlias = "jax.Array"
"""A typed JAX random key (`jax.random.key`), one use only."""

PyTree: TypeAlias = Any
"""Any nesting of tuples, dicts and NamedTuples with arrays as leaves."""
