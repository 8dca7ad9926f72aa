"""Distributions of actions: what the output of a policy's network means.

A new one is a subclass of `Normal`, of which it keeps what fits, and an entry in `DISTRIBUTIONS`;
its name goes into `PolicyConfig.distribution_type`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from gmijax.types import Array, PRNGKey

_HALF_LOG_2PI = 0.9189385332046727

_LOG_STD_LIMITS = (-5.0, 2.0)
"""Of standard deviations that a network gives, which nothing else holds back."""

_SHARES = (
    *(0.003246343272134, 0.051517477033972, 0.195077912673858, 0.315569823632818),
    *(0.274149576158423, 0.131076880695470, 0.027912418727972, 0.001449567805354),
)
_INVERSE_STDS = (
    *(1.365340806296348, 1.059523971016916, 0.830791313765644, 0.650732166639391),
    *(0.508135425366489, 0.396313345166341, 0.308904252267995, 0.238212616409306),
)
"""A mixture of eight centred Gaussians whose distribution function is the logistic one within
2e-9 (Monahan and Stefanski, "Normal scale mixture approximations to F*(z)", 1992)."""


@dataclass(frozen=True)
class Normal:
    """A diagonal Gaussian of actions [A], one for every state, around the network's output.

    `output` [..., H] is the network's output for a state; `log_std` [A] are weights beside it
    that all states share. With `state_dependent_std` the output [..., 2 A] holds, behind the
    means, what is added to `log_std`. What is drawn is a raw action: the environment gets
    `action_of` it, learning keeps the raw one. Log densities, entropies and divergences are in
    nats.
    """

    action_size: int
    state_dependent_std: bool = False

    @property
    def output_size(self) -> int:
        """H."""
        return self.action_size * (2 if self.state_dependent_std else 1)

    def mode(self, output: Array) -> Array:
        """The action [..., A] without noise."""
        return self.action_of(self._mean_and_log_std(output, jnp.zeros(()))[0])

    def action_of(self, raw: Array) -> Array:
        """The action [..., A] for the environment, of a raw one."""
        return raw

    def sample(self, output: Array, log_std: Array, keys: PRNGKey) -> Array:
        """Raw actions [N, A] for outputs [N, H]; each depends on its own one of `keys` [N]."""
        mean, log_std = self._mean_and_log_std(output, log_std)
        # Each row from the key of its environment: how these are spread over GMIs changes nothing.
        noise = jax.vmap(lambda key: jax.random.normal(key, (self.action_size,)))(keys)
        return mean + jnp.exp(log_std) * noise

    def log_prob(self, output: Array, log_std: Array, raw: Array) -> Array:
        """Log density [...] of the action of `raw` [..., A]."""
        mean, log_std = self._mean_and_log_std(output, log_std)
        z = (raw - mean) * jnp.exp(-log_std)
        return jnp.sum(-0.5 * z**2 - log_std - _HALF_LOG_2PI, axis=-1)

    def entropy(self, output: Array, log_std: Array) -> Array:
        """Entropy [...], or [] of a deviation that all states share."""
        return jnp.sum(self._mean_and_log_std(output, log_std)[1] + 0.5 + _HALF_LOG_2PI, axis=-1)

    def kl_divergence(
        self, old_output: Array, old_log_std: Array, output: Array, log_std: Array
    ) -> Array:
        """KL(old || new) [...]."""
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


class TanhNormal(Normal):
    """The tanh of a `Normal`: actions never leave [-1, 1].

    Its divergence is that of the Gaussians, which is the same before and behind the tanh. The
    raw action cannot be recovered from the action: in float32, tanh is 1 of all that is above 9.
    """

    def action_of(self, raw: Array) -> Array:
        """See `Normal`. The action without noise is the tanh of the mean, as Brax has it."""
        return jnp.tanh(raw)

    def log_prob(self, output: Array, log_std: Array, raw: Array) -> Array:
        """See `Normal`."""
        return super().log_prob(output, log_std, raw) - jnp.sum(_log_slope_of_tanh(raw), axis=-1)

    def entropy(self, output: Array, log_std: Array) -> Array:
        """See `Normal`; in closed form."""
        mean, log_std = self._mean_and_log_std(output, log_std)
        slopes = jnp.sum(_mean_log_slope_of_tanh(mean, jnp.exp(log_std)), axis=-1)
        return Normal(self.action_size).entropy(mean, log_std) + slopes


DISTRIBUTIONS: Mapping[str, type[Normal]] = {
    "normal": Normal,
    "tanh_normal": TanhNormal,
}
"""By name."""


def _log_slope_of_tanh(x: Array) -> Array:
    """log(1 - tanh(x)^2), without its cancellation."""
    return 2.0 * (math.log(2.0) - x - jax.nn.softplus(-2.0 * x))


def _mean_log_slope_of_tanh(mean: Array, std: Array) -> Array:
    """Mean of `_log_slope_of_tanh` under Gaussians, within 2e-8, however wide they are.

    It is -2 log cosh x. Half the second derivative of log cosh is the density of a logistic
    variable of scale 1/2, so log cosh x + log 2 is the mean of |x + that variable|. Taken as a
    mixture of Gaussians, the variable adds to the variance, and the mean of |x| under a Gaussian
    has a closed form. A quadrature would need more nodes the wider the Gaussian is.
    """
    shares = jnp.asarray(_SHARES, jnp.float32)
    own = jnp.asarray(0.5 / np.asarray(_INVERSE_STDS), jnp.float32)
    wide, mean = jnp.hypot(std[..., None], own), mean[..., None]
    z = mean / wide
    folded = wide * math.sqrt(2.0 / math.pi) * jnp.exp(-0.5 * z**2)
    folded += mean * jax.scipy.special.erf(z / math.sqrt(2.0))
    return 2.0 * math.log(2.0) - 2.0 * jnp.sum(folded * shares, axis=-1)
