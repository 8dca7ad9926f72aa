"""Two critics that give distributions of returns (arXiv:1707.06887), and their targets."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gmijax.config import SacConfig
from gmijax.learning.policy import Mlp
from gmijax.types import Array, PRNGKey, PyTree

NUM_CRITICS = 2


class Critics(NamedTuple):
    """Both critics; weights are passed in, with a leading axis [2].

    Attributes:
      network: of one of them, from [..., O + A] to logits [..., Z].
      atoms: [Z], the returns that their probabilities are of.
    """

    network: Mlp
    atoms: Array

    def init(self, key: PRNGKey, obs_size: int, action_size: int) -> PyTree:
        """First weights, of each its own; consumes `key`."""
        inputs = jnp.zeros((1, obs_size + action_size))
        # One after the other: JAX 0.11 computes orthogonal matrices of a batch on the threads of
        # its pool and waits for them on threads of the same pool; with two threads it hangs.
        keys = jax.random.split(key, NUM_CRITICS)
        return jax.lax.map(lambda k: self.network.init(k, inputs), keys)

    def log_probs(self, params: PyTree, obs: Array, action: Array) -> Array:
        """Logarithms of probabilities [2, B, Z] of the atoms."""
        inputs = jnp.concatenate([obs, action], axis=-1)
        logits: Any = jax.vmap(self.network.apply, in_axes=(0, None))(params, inputs)
        return jax.nn.log_softmax(logits)

    def values(self, params: PyTree, obs: Array, action: Array) -> Array:
        """Mean returns [2, B]."""
        return jnp.exp(self.log_probs(params, obs, action)) @ self.atoms


def critics_of(config: SacConfig) -> Critics:
    """The critics of a configuration."""
    atoms = jnp.linspace(-config.value_range, config.value_range, config.num_atoms)
    sizes = config.critic_hidden_layer_sizes
    network = Mlp(sizes, config.num_atoms, 1.0, config.precision, "layer_norm_silu")
    return Critics(network, atoms)


def projected(atoms: Array, values: Array, probs: Array) -> Array:
    """Probabilities [..., Z] of `atoms` [Z] that stand for those [..., Z] of `values` [..., Z].

    A value between two atoms is shared between them by its distance, one beyond the ends counts
    as the end. The mean stays, but for that.
    """
    step = atoms[1] - atoms[0]
    values = jnp.clip(values, atoms[0], atoms[-1])
    near = jnp.maximum(0.0, 1.0 - jnp.abs(values[..., None] - atoms) / step)
    return jnp.sum(probs[..., None] * near, axis=-2)
