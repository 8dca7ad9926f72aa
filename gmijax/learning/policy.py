"""Gaussian policy and value function: two separate multi-layer perceptrons.

The sizes are those of the paper's Table 5 (256:128:64 for most tasks); ELU activations and a
state-independent standard deviation are what Isaac Gym's PPO uses for the same tasks.
"""

from __future__ import annotations

from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from gmijax.types import Array, PRNGKey, PyTree

_HALF_LOG_2PI = 0.9189385332046727


class Mlp(nn.Module):
    """Dense layers with ELU between them.

    Attributes:
      hidden: widths of the hidden layers.
      out: width of the linear output layer.
      out_scale: standard deviation scale of the output layer's first weights.
    """

    hidden: tuple[int, ...]
    out: int
    out_scale: float

    @nn.compact
    def __call__(self, x: Array) -> Array:
        """Maps [..., in] to [..., out]."""
        for width in self.hidden:
            x = nn.elu(nn.Dense(width, kernel_init=nn.initializers.orthogonal(jnp.sqrt(2.0)))(x))
        return nn.Dense(self.out, kernel_init=nn.initializers.orthogonal(self.out_scale))(x)


class ActorCriticParams(NamedTuple):
    """Weights of both networks.

    Attributes:
      policy: weights of the network that gives the mean action.
      value: weights of the value network.
      log_std: [A] logarithm of the policy's standard deviation.
    """

    policy: PyTree
    value: PyTree
    log_std: Array


class ActorCritic(NamedTuple):
    """The two networks; their weights are passed in."""

    policy: Mlp
    value: Mlp
    init_noise_std: float

    def init(self, key: PRNGKey, obs_size: int) -> ActorCriticParams:
        """First weights; consumes `key`."""
        policy_key, value_key = jax.random.split(key)
        obs = jnp.zeros((1, obs_size))
        return ActorCriticParams(
            policy=self.policy.init(policy_key, obs),
            value=self.value.init(value_key, obs),
            log_std=jnp.full((self.policy.out,), jnp.log(self.init_noise_std)),
        )

    def action_mean(self, params: ActorCriticParams, obs: Array) -> Array:
        """Mean action [..., A] for normalised observations [..., O]."""
        return jnp.asarray(self.policy.apply(params.policy, obs))

    def state_value(self, params: ActorCriticParams, obs: Array) -> Array:
        """Value estimates [...] for normalised observations [..., O]."""
        return jnp.asarray(self.value.apply(params.value, obs))[..., 0]


def make_actor_critic(
    action_size: int,
    policy_hidden: tuple[int, ...],
    value_hidden: tuple[int, ...],
    init_noise_std: float,
) -> ActorCritic:
    """Networks for `action_size` actions with the given hidden widths."""
    # A small output layer makes the first policy's mean about zero wherever the robot is.
    return ActorCritic(
        policy=Mlp(tuple(policy_hidden), action_size, 0.01),
        value=Mlp(tuple(value_hidden), 1, 1.0),
        init_noise_std=init_noise_std,
    )


def log_prob(mean: Array, log_std: Array, action: Array) -> Array:
    """Log density [...] of `action` [..., A] under the Gaussian."""
    z = (action - mean) * jnp.exp(-log_std)
    return jnp.sum(-0.5 * z**2 - log_std - _HALF_LOG_2PI, axis=-1)


def entropy(log_std: Array) -> Array:
    """Entropy [] of the Gaussian with `log_std` [A], in nats."""
    return jnp.sum(log_std + 0.5 + _HALF_LOG_2PI)


def kl_divergence(old_mean: Array, old_log_std: Array, mean: Array, log_std: Array) -> Array:
    """KL(old || new) [...] between two diagonal Gaussians [..., A], in nats."""
    variance_ratio = jnp.exp(2.0 * (old_log_std - log_std))
    distance = ((old_mean - mean) * jnp.exp(-log_std)) ** 2
    return jnp.sum(0.5 * (variance_ratio + distance - 1.0) + log_std - old_log_std, axis=-1)
