"""Networks, optimiser and the learner's state: what all training algorithms share.

Checkpoints hold a state of the algorithm (`LearnerState`), all of which can be played.
"""

from __future__ import annotations

from functools import partial
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree

from gmijax.config import ADAPTIVE_LEARNING_RATE_RANGE, AlgoConfig
from gmijax.errors import ConfigError
from gmijax.learning.distributions import DISTRIBUTIONS
from gmijax.learning.normalize import (
    Moments,
    change_of_units,
    from_units,
    in_units,
    merge,
    no_samples,
    std_of,
    with_std_floor,
)
from gmijax.learning.policy import ActorCritic, ActorCriticParams, Mlp
from gmijax.sim.interface import EnvSpec
from gmijax.types import Array, PRNGKey, PyTree

C = TypeVar("C", bound=AlgoConfig)

_LEARNING_RATE_STEP = 1.5
_UNMOVED_KL = 1e-6
_LEAST_STD_IN_FLOORS = 10.0
"""An input moves if its standard deviation is at least so many times `obs_std_floor`. Nothing was
learnt with the weights of one that does not: when it begins to, they must not be preserved."""


class TrainState(NamedTuple):
    """All that learning must remember; equal, bit by bit, on every GMI.

    Attributes:
      params: weights of policy and value function.
      opt_state: Adam's moments, each as one vector.
      obs_moments: statistics of all observations before this iteration.
      learning_rate: [] float32.
      iteration: [] int32, finished iterations.
      key: base of the shuffling keys; never consumed, only folded with iteration and rank.
      value_moments: statistics of the targets of the value function, whose unit its network has;
        None where values are not normalised.
    """

    params: ActorCriticParams
    opt_state: PyTree
    obs_moments: Moments
    learning_rate: Array
    iteration: Array
    key: PRNGKey
    value_moments: Moments | None = None


class LearnerState(Protocol):
    """What the states of all algorithms have, named tuples; see `TrainState`."""

    @property
    def params(self) -> ActorCriticParams:
        """Weights of the policy, and of the value function if there is one."""
        ...

    @property
    def obs_moments(self) -> Moments:
        """Statistics of all observations before this iteration."""
        ...

    @property
    def learning_rate(self) -> Array:
        """[] float32."""
        ...

    @property
    def iteration(self) -> Array:
        """[] int32, finished iterations."""
        ...

    @property
    def value_moments(self) -> Moments | None:
        """Statistics of the targets of the value function, if they are kept."""
        ...

    def _replace(self, **fields: Any) -> Any: ...


S = TypeVar("S", bound=LearnerState)


class Learner(NamedTuple, Generic[C]):
    """Networks, optimiser and hyper-parameters: what the update functions need.

    Attributes:
      networks: of the policy and, where there is one, of the value function.
      optimizer: without the learning rate, which is in the state.
      config: hyper-parameters.
      extra: what else the algorithm needs, such as a teacher.
    """

    networks: ActorCritic
    optimizer: optax.GradientTransformation
    config: C
    extra: Any = None


def make_learner(spec: EnvSpec, config: C) -> Learner[C]:
    """The learner for an environment's sizes.

    Raises:
      ConfigError: a network shall see what this environment does not have.
    """
    seen, value = spec.actor_obs_size, config.value_network
    keys = {"policy_obs_key": config.policy_obs_key, "value_obs_key": value and value.obs_key}
    for key, wanted in keys.items():
        if wanted == "privileged_state" and seen is None:
            raise ConfigError(
                f"algo.{key}=privileged_state: {spec.name} has no observations for the value "
                "function alone; allowed: auto, state"
            )
    make_distribution, precision = DISTRIBUTIONS[config.distribution_type], config.precision
    distribution = make_distribution(spec.action_size, config.state_dependent_std)
    network = partial(Mlp, dtype=precision, activation=config.activation)
    # A small output layer makes the first policy's mean about zero wherever the robot is.
    policy = network(config.policy_hidden_layer_sizes, distribution.output_size, 0.01)
    return Learner(
        networks=ActorCritic(
            policy,
            network(value.hidden_layer_sizes, 1, 1.0) if value else None,
            config.init_noise_std,
            distribution,
            actor_obs_size=None if config.policy_obs_key == "privileged_state" else seen,
            value_obs_size=seen if value and value.obs_key == "state" else None,
        ),
        # The learning rate is in the state, because the adaptive schedule changes it. One vector
        # of all parameters: a kernel for each of them costs a tenth of an update on a GPU.
        optimizer=optax.flatten(
            optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.scale_by_adam())
        ),
        config=config,
    )


def init_learner(learner: Learner, obs_size: int, key: PRNGKey) -> TrainState:
    """The first state; consumes `key`."""
    params_key, shuffle_key = jax.random.split(key)
    value = learner.config.value_network
    params = learner.networks.init(params_key, obs_size)
    return TrainState(
        params=params,
        opt_state=learner.optimizer.init(params),
        obs_moments=no_samples((obs_size,)),
        learning_rate=jnp.asarray(learner.config.learning_rate, jnp.float32),
        iteration=jnp.zeros((), jnp.int32),
        key=shuffle_key,
        value_moments=no_samples(()) if value and value.is_normalized else None,
    )


def acting_moments(config: AlgoConfig, state: LearnerState) -> Moments:
    """The statistics that observations are normalised with (none if switched off)."""
    if config.normalize_observations:
        return with_std_floor(state.obs_moments, config.obs_std_floor)
    return no_samples(state.obs_moments.mean.shape)


def with_targets(learner: Learner, state: TrainState, target: Moments) -> TrainState:
    """`state` with the statistics of more targets of the value function, if it keeps any.

    Its unit moves with them, and its last layer so that all values stay what they are (Pop-Art,
    arXiv:1602.07714). Where there were no statistics before nothing was learnt in a unit.
    """
    before = state.value_moments
    if before is None:
        return state
    after = merge(before, target)
    scale, shift = std_of(before) / std_of(after), in_units(after, before.mean)
    known = before.count > 0
    params = learner.networks.with_values(
        state.params, jnp.where(known, scale, 1.0), jnp.where(known, shift, 0.0)
    )
    return state._replace(value_moments=after, params=params)


def finish_iteration(learner: Learner, state: S, seen: Moments) -> S:
    """`state` after an iteration, with the statistics of what was `seen` in it.

    Normalised observations change with the statistics, and with them what policy and value
    function make of the same observation. With `preserve_outputs` their first layers make up for
    it, as Pop-Art's last one does for targets (arXiv:1602.07714); but not for the clip of
    normalised observations, nor where there were no statistics before, nor for inputs that hardly
    move (`_LEAST_STD_IN_FLOORS`) or whose standard deviation doubles or halves at once.
    """
    after = state._replace(
        obs_moments=merge(state.obs_moments, seen), iteration=state.iteration + 1
    )
    if not learner.config.preserve_outputs:
        return after
    units = change_of_units(
        acting_moments(learner.config, state),
        acting_moments(learner.config, after),
        _LEAST_STD_IN_FLOORS * learner.config.obs_std_floor,
    )
    return after._replace(params=learner.networks.with_inputs(state.params, *units))


class ActingWeights(NamedTuple):
    """Weights of a policy that acts.

    Attributes:
      params: weights of policy and value function.
      moments: statistics that observations are normalised with.
      value_moments: see `TrainState`.
    """

    params: ActorCriticParams
    moments: Moments
    value_moments: Moments | None = None


def acting_weights(learner: Learner, state: LearnerState) -> ActingWeights:
    """The weights to act with when the learner has `state`."""
    return ActingWeights(state.params, acting_moments(learner.config, state), state.value_moments)


def state_values(networks: ActorCritic, weights: ActingWeights, obs: Array) -> Array:
    """Values [...] of normalised observations [..., O], in the unit of scaled rewards."""
    return in_rewards(weights, networks.state_value(weights.params, obs))


def in_rewards(weights: ActingWeights, outputs: Array) -> Array:
    """Values [...] in the unit of scaled rewards, from what the value network put out."""
    if weights.value_moments is None:
        return outputs
    return from_units(weights.value_moments, outputs)


def next_values(values: Array, truncated: Array, cut_values: Array) -> Array:
    """V(s_{t+1}) [T, N] of `values` [T + 1, N], the last ones of what follows step T.

    Where time ran out the next row is of another episode; `cut_values` [T, N] count there. Where
    the task ended nothing counts.
    """
    return jnp.where(truncated > 0, cut_values, values[1:])


def pack_weights(weights: ActingWeights) -> Array:
    """All numbers as one array [W] float32, to be sent."""
    return ravel_pytree(weights)[0]


def unpack_weights(example: ActingWeights, packed: Array) -> ActingWeights:
    """Inverts `pack_weights`; `example` gives the structure."""
    return ravel_pytree(example)[1](packed)


def learner_shapes(spec: EnvSpec, config: AlgoConfig) -> TrainState:
    """Shapes of a state; nothing is computed."""
    learner = make_learner(spec, config)
    return jax.eval_shape(lambda: init_learner(learner, spec.obs_size, jax.random.key(0)))


def num_weights(spec: EnvSpec, config: AlgoConfig) -> int:
    """W, length of the packed weights."""
    state = learner_shapes(spec, config)
    weights = ActingWeights(state.params, state.obs_moments, state.value_moments)
    return sum(leaf.size for leaf in jax.tree.leaves(weights))


def apply_gradients(
    learner: Learner, state: TrainState, grads: ActorCriticParams, kl: Array
) -> TrainState:
    """One Adam step with the mean gradient of all GMIs.

    `kl` [] is the divergence that the adaptive schedule looks at; see `adapted_learning_rate`.
    """
    config, rate = learner.config, state.learning_rate
    if config.adaptive_kl is not None:
        rate = adapted_learning_rate(rate, kl, config.adaptive_kl)
    updates, opt_state = learner.optimizer.update(grads, state.opt_state, state.params)
    params: ActorCriticParams = jax.tree.map(lambda p, u: p - rate * u, state.params, updates)
    return state._replace(params=params, opt_state=opt_state, learning_rate=rate)


def rate_figures(config: AlgoConfig, rates: Array) -> dict[str, Array]:
    """Mean, least and largest of the learning rates of updates; none if they cannot differ."""
    if config.adaptive_kl is None or rates.size == 1:
        return {}
    return {"mean": jnp.mean(rates), "min": jnp.min(rates), "max": jnp.max(rates)}


def policy_figures(state: LearnerState) -> dict[str, Array]:
    """Figures of the policy as it is, [] each, by the names that they are logged under.

    The learning rate, and of the standard deviations of its actions the mean and, of several,
    the smallest.
    """
    std = jnp.exp(state.params.log_std)
    figures = {"policy/learning_rate": state.learning_rate, "policy/noise_std": jnp.mean(std)}
    return figures if std.size == 1 else figures | {"policy/noise_std_min": jnp.min(std)}


def adapted_learning_rate(rate: Array, kl: Array, desired_kl: float) -> Array:
    """Steers the rate to keep the KL divergence near `desired_kl`.

    Divided by 1.5 above twice the target, multiplied by 1.5 below half of it (the rule of
    Isaac Gym's trainers), within `ADAPTIVE_LEARNING_RATE_RANGE`. No change below 1e-6: that is
    the first update on a rollout, where the policy has not moved yet and the rest is rounding.
    """
    low, high = ADAPTIVE_LEARNING_RATE_RANGE
    slower = jnp.maximum(rate / _LEARNING_RATE_STEP, low)
    faster = jnp.minimum(rate * _LEARNING_RATE_STEP, high)
    too_slow = (kl < 0.5 * desired_kl) & (kl > _UNMOVED_KL)
    return jnp.where(kl > 2.0 * desired_kl, slower, jnp.where(too_slow, faster, rate))
