"""Distributions of actions: what the output of a policy's network means.

A new one is a class like `Normal` and an entry in `DISTRIBUTIONS`; its name goes into
`ActorCriticConfig.distribution_type`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from gmijax.types import Array, PRNGKey

_HALF_LOG_2PI = 0.9189385332046727

_LOG_STD_LIMITS = (-5.0, 2.0)
"""Of standard deviations that a network gives, which nothing else holds back."""

_EDGE = 1.0 - 1e-6
"""Actions beyond this are taken for this: a float32 cannot tell which one tanh came from."""

_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(16)


class Distribution(Protocol):
    """A distribution of actions [A], one for every state.

    `output` [..., H] is what the network says of a state; `log_std` [A] are weights beside it
    that all states share. Log densities, entropies and divergences are in nats.
    """

    @property
    def action_size(self) -> int:
        """A."""
        ...

    @property
    def output_size(self) -> int:
        """H."""
        ...

    def mode(self, output: Array) -> Array:
        """The action [..., A] without noise."""
        ...

    def sample(self, output: Array, log_std: Array, keys: PRNGKey) -> Array:
        """Actions [N, A] for outputs [N, H]; each depends on its own one of `keys` [N] alone."""
        ...

    def log_prob(self, output: Array, log_std: Array, action: Array) -> Array:
        """Log density [...] of `action` [..., A]."""
        ...

    def entropy(self, output: Array, log_std: Array) -> Array:
        """Entropy [...], or [] where it is the same in all states."""
        ...

    def kl_divergence(
        self, old_output: Array, old_log_std: Array, output: Array, log_std: Array
    ) -> Array:
        """KL(old || new) [...]."""
        ...


class Normal(NamedTuple):
    """A diagonal Gaussian around the network's output.

    With `state_dependent_std` the network's output [..., 2 A] holds, behind the means, what is
    added to `log_std`.
    """

    action_size: int
    state_dependent_std: bool = False

    @property
    def output_size(self) -> int:
        """See `Distribution`."""
        return self.action_size * (2 if self.state_dependent_std else 1)

    def mode(self, output: Array) -> Array:
        """See `Distribution`."""
        return self._mean_and_log_std(output, jnp.zeros(()))[0]

    def sample(self, output: Array, log_std: Array, keys: PRNGKey) -> Array:
        """See `Distribution`."""
        mean, log_std = self._mean_and_log_std(output, log_std)
        noise = policy_noise(keys, self.action_size)
        return mean + jnp.exp(log_std) * noise

    def log_prob(self, output: Array, log_std: Array, action: Array) -> Array:
        """See `Distribution`."""
        mean, log_std = self._mean_and_log_std(output, log_std)
        z = (action - mean) * jnp.exp(-log_std)
        return jnp.sum(-0.5 * z**2 - log_std - _HALF_LOG_2PI, axis=-1)

    def entropy(self, output: Array, log_std: Array) -> Array:
        """See `Distribution`; of a deviation that all states share, []."""
        return jnp.sum(self._mean_and_log_std(output, log_std)[1] + 0.5 + _HALF_LOG_2PI, axis=-1)

    def kl_divergence(
        self, old_output: Array, old_log_std: Array, output: Array, log_std: Array
    ) -> Array:
        """See `Distribution`."""
        old_mean, old_log_std = self._mean_and_log_std(old_output, old_log_std)
        mean, log_std = self._mean_and_log_std(output, log_std)
        variance_ratio = jnp.exp(2.0 * (old_log_std - log_std))
        distance = ((old_mean - mean) * jnp.exp(-log_std)) ** 2
        return jnp.sum(0.5 * (variance_ratio + distance - 1.0) + log_std - old_log_std, axis=-1)

    def _mean_and_log_std(self, output: Array, log_std: Array) -> tuple[Array, Array]:
        """Both [..., A]; the deviation is [A] where all states share it."""
        if not self.state_dependent_std:
            return output, log_std
        mean, added = jnp.split(output, 2, axis=-1)
        return mean, jnp.clip(log_std + added, *_LOG_STD_LIMITS)


class TanhNormal(NamedTuple):
    """The tanh of a `Normal`: actions never leave [-1, 1]."""

    action_size: int
    state_dependent_std: bool = False

    @property
    def output_size(self) -> int:
        """See `Distribution`."""
        return self._normal.output_size

    @property
    def _normal(self) -> Normal:
        return Normal(self.action_size, self.state_dependent_std)

    def mode(self, output: Array) -> Array:
        """See `Distribution`; the tanh of the Gaussian's mean, as Brax has it."""
        return jnp.tanh(self._normal.mode(output))

    def sample(self, output: Array, log_std: Array, keys: PRNGKey) -> Array:
        """See `Distribution`."""
        return jnp.tanh(self._normal.sample(output, log_std, keys))

    def log_prob(self, output: Array, log_std: Array, action: Array) -> Array:
        """See `Distribution`."""
        before = jnp.arctanh(jnp.clip(action, -_EDGE, _EDGE))
        slopes = jnp.sum(_log_slope_of_tanh(before), axis=-1)
        return self._normal.log_prob(output, log_std, before) - slopes

    def entropy(self, output: Array, log_std: Array) -> Array:
        """See `Distribution`; by Gauss-Hermite quadrature for every action."""
        mean, log_std = self._normal._mean_and_log_std(output, log_std)
        at = mean[..., None] + jnp.exp(log_std)[..., None] * jnp.asarray(_NODES, jnp.float32)
        shares = jnp.asarray(_WEIGHTS / _WEIGHTS.sum(), jnp.float32)
        slopes = jnp.sum(_log_slope_of_tanh(at) * shares, axis=(-1, -2))
        return Normal(self.action_size).entropy(mean, log_std) + slopes

    def kl_divergence(
        self, old_output: Array, old_log_std: Array, output: Array, log_std: Array
    ) -> Array:
        """See `Distribution`; the same before and behind the tanh."""
        return self._normal.kl_divergence(old_output, old_log_std, output, log_std)


DISTRIBUTIONS: Mapping[str, Callable[[int, bool], Distribution]] = {
    "normal": Normal,
    "tanh_normal": TanhNormal,
}
"""By name: `(action_size, state_dependent_std)` to the distribution."""


def policy_noise(keys: PRNGKey, action_size: int) -> Array:
    """Standard normal noise [N, A], each row from the key of its own environment.

    Rows depend on the environment alone, so the way environments are spread over GMIs does not
    change the samples.
    """
    return jax.vmap(lambda key: jax.random.normal(key, (action_size,)))(keys)


def _log_slope_of_tanh(x: Array) -> Array:
    """log(1 - tanh(x)^2), without its cancellation."""
    return 2.0 * (math.log(2.0) - x - jax.nn.softplus(-2.0 * x))
