"""Policy and value function: two separate multi-layer perceptrons.

The sizes are those of the paper's Table 6 (256:128:64 for most tasks); ELU activations and a
state-independent standard deviation are what Isaac Gym's PPO uses for the same tasks, layer norm
and SiLU what FastSAC does. The distribution defines what the output of the policy's network means.

In bfloat16, the hidden layers and what goes from one to the next are in it: their products are
quicker, and half as many bytes are moved. Weights, and all that comes of a network, stay float32.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike

from gmijax.learning.distributions import Normal
from gmijax.player.policy import LAYER_NORM_EPSILON
from gmijax.types import Array, PRNGKey, PyTree


@jax.custom_vjp
def elu(x: Array) -> Array:
    """The number where it is positive, else exp(x) - 1."""
    return jnp.where(x > 0, x, jnp.expm1(x))


def _elu_forward(x: Array) -> tuple[Array, Array]:
    y = elu(x)
    return y, y


def _elu_backward(y: Array, gradient: Array) -> tuple[Array]:
    # By its output, which the next layer keeps anyway: no exponential, and x need not be kept.
    return (jnp.where(y > 0, gradient, gradient * (y + 1)),)


elu.defvjp(_elu_forward, _elu_backward)


def _all_but_bias(*arrays: Any, dtype: Any = None, inexact: bool = True) -> list[Any]:
    # A bias stays float32: its gradient is then summed over all samples in float32.
    del inexact
    x, kernel, bias = arrays
    return [x.astype(dtype), kernel.astype(dtype), bias]


class Mlp(nn.Module):
    """Dense layers with an activation between them.

    Attributes:
      hidden: widths of the hidden layers.
      out: width of the linear output layer.
      out_scale: standard deviation scale of the output layer's first weights.
      dtype: what hidden layers compute in; weights and the output layer are float32.
      activation: see `PolicyConfig.activation`.
    """

    hidden: tuple[int, ...]
    out: int
    out_scale: float
    dtype: DTypeLike = jnp.float32
    activation: str = "elu"

    @nn.compact
    def __call__(self, x: Array) -> Array:
        """Maps [..., in] to [..., out] float32."""
        scaled = nn.initializers.orthogonal(jnp.sqrt(2.0))
        for width in self.hidden:
            hidden = nn.Dense(
                width, dtype=self.dtype, kernel_init=scaled, promote_dtype=_all_but_bias
            )
            if self.activation == "elu":
                x = elu(hidden(x).astype(self.dtype))
            else:
                norm = nn.LayerNorm(epsilon=LAYER_NORM_EPSILON, dtype=self.dtype)
                x = nn.silu(norm(hidden(x)))
        return nn.Dense(self.out, kernel_init=nn.initializers.orthogonal(self.out_scale))(x)


class ActorCriticParams(NamedTuple):
    """Weights of both networks.

    Attributes:
      policy: weights of the network whose output the distribution takes.
      value: weights of the value network, empty where there is none.
      log_std: [A] logarithm of the policy's standard deviation, or of the part of it that all
        states share.
    """

    policy: PyTree
    value: PyTree
    log_std: Array


class ActorCritic(NamedTuple):
    """The two networks; their weights are passed in.

    Attributes:
      policy: the network whose output the distribution takes.
      value: the value function, None for algorithms without one.
      init_noise_std: standard deviation of the first policy.
      distribution: of actions.
      actor_obs_size: `policy` sees the first so many numbers of an observation; None: all.
      value_obs_size: the same of `value`.
    """

    policy: Mlp
    value: Mlp | None
    init_noise_std: float
    distribution: Normal
    actor_obs_size: int | None = None
    value_obs_size: int | None = None

    def init(self, key: PRNGKey, obs_size: int) -> ActorCriticParams:
        """First weights; consumes `key`."""
        policy_key, value_key = jax.random.split(key)
        obs = jnp.zeros((1, obs_size))
        return ActorCriticParams(
            policy=self.policy.init(policy_key, obs[:, : self.actor_obs_size]),
            value=self.value.init(value_key, obs[:, : self.value_obs_size]) if self.value else {},
            # With an explicit dtype: with a weak type, as of a number of Python, programs that
            # are compiled for the first state would be compiled again for the second.
            log_std=jnp.full(
                (self.distribution.action_size,), jnp.log(self.init_noise_std), jnp.float32
            ),
        )

    def with_inputs(
        self, params: ActorCriticParams, scale: Array, shift: Array
    ) -> ActorCriticParams:
        """Weights that make of x what `params` make of `scale` * x + `shift`, [O] each."""

        def changed(network: PyTree) -> PyTree:
            first = network["params"]["Dense_0"]
            kernel, size = first["kernel"], first["kernel"].shape[0]
            new = {
                "kernel": scale[:size, None] * kernel,
                # No product of matrices: on a GPU those are rounded to TF32.
                "bias": first["bias"] + jnp.sum(shift[:size, None] * kernel, axis=0),
            }
            return {**network, "params": {**network["params"], "Dense_0": new}}

        value = changed(params.value) if self.value else params.value
        return params._replace(policy=changed(params.policy), value=value)

    def with_values(
        self, params: ActorCriticParams, scale: Array, shift: Array
    ) -> ActorCriticParams:
        """Weights that make `scale` * v + `shift`, [] each, of what `params` make v."""
        assert self.value is not None
        layers = params.value["params"]
        last = f"Dense_{len(self.value.hidden)}"
        new = {
            "kernel": scale * layers[last]["kernel"],
            "bias": scale * layers[last]["bias"] + shift,
        }
        return params._replace(value={**params.value, "params": {**layers, last: new}})

    def output(self, params: ActorCriticParams, obs: Array) -> Array:
        """What `distribution` takes [..., H], for normalised observations [..., O]."""
        if self.actor_obs_size is not None:
            obs = obs[..., : self.actor_obs_size]
        return jnp.asarray(self.policy.apply(params.policy, obs))

    def action_mean(self, params: ActorCriticParams, obs: Array) -> Array:
        """The action without noise [..., A] for normalised observations [..., O]."""
        return self.distribution.mode(self.output(params, obs))

    def state_value(self, params: ActorCriticParams, obs: Array) -> Array:
        """Value estimates [...] for normalised observations [..., O]."""
        assert self.value is not None
        if self.value_obs_size is not None:
            obs = obs[..., : self.value_obs_size]
        return jnp.asarray(self.value.apply(params.value, obs))[..., 0]
