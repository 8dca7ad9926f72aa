"""Losses and advantages of PPO, against hand arithmetic and plain loops."""

import dataclasses
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gmijax.cli.compose import compose
from gmijax.learning.distributions import DISTRIBUTIONS, Normal
from gmijax.learning.learner import ActingWeights, state_values
from gmijax.learning.normalize import Moments, from_units, moments_of, no_samples
from gmijax.learning.policy import ActorCritic, Mlp, elu
from gmijax.learning.updates import explained_variance
from gmijax.ppo.loss import UpdateContext, ppo_loss
from gmijax.ppo.rollout import Samples, gae
from gmijax.ppo.statistics import until_diverged

B, O, A = 6, 3, 2
T, N = 7, 3
NEUTRAL = UpdateContext(jnp.zeros(()), jnp.ones(()), jnp.zeros(A))


NETWORKS = ActorCritic(Mlp((8,), A, 0.01), Mlp((8,), 1, 1.0), 1.0, Normal(A))
LOSS = jax.jit(ppo_loss, static_argnames=("networks", "config"))


@pytest.fixture(scope="module")
def params():
    return jax.jit(NETWORKS.init, static_argnums=1)(jax.random.key(0), O)


def _loss(params, samples: Samples, context: UpdateContext = NEUTRAL, **costs: Any):
    """Loss and its parts with the clipped surrogate alone, and `costs`."""
    only = {"entropy_cost": 0.0, "bound_cost": 0.0, "value_cost": 0.0, "clip_value_loss": False}
    config = dataclasses.replace(compose().algo, **(only | costs))
    return LOSS(params, samples, context, networks=NETWORKS, config=config)


@jax.jit
def _samples(params, advantage: float, log_ratio: float = 0.0) -> Samples:
    """Samples whose probability ratio under `params` is exp(log_ratio)."""
    obs = jax.random.normal(jax.random.key(1), (B, O))
    mean = NETWORKS.output(params, obs)
    action = mean + 0.3
    return Samples(
        obs=obs,
        action=action,
        log_prob=NETWORKS.distribution.log_prob(mean, params.log_std, action) - log_ratio,
        output=mean,
        value=NETWORKS.state_value(params, obs),
        advantage=jnp.full(B, advantage),
    )


@pytest.mark.parametrize(
    ("advantage", "ratio", "surrogate"),
    [
        (1.0, 1.5, 1.2),  # a gain is cut off at 1 + 0.2
        (1.0, 0.5, 0.5),  # a loss of probability of a good action is not
        (-1.0, 0.5, -0.8),  # for a bad action the pessimist takes the clipped value
        (-1.0, 1.5, -1.5),
        (1.0, 1.0, 1.0),  # before the first update
    ],
)
def test_the_surrogate_is_clipped(params, advantage, ratio, surrogate) -> None:
    loss, metrics = _loss(params, _samples(params, advantage, float(np.log(ratio))))
    np.testing.assert_allclose(loss, -surrogate, rtol=1e-5)
    assert metrics.clip_fraction == float(ratio != 1.0)
    np.testing.assert_allclose(metrics.kl, 0.0, atol=1e-6)  # The policy has not moved.


@pytest.mark.parametrize("advantage", [1.0, -1.0])
def test_a_ratio_that_overflows_does_not_end_the_run(params, advantage: float) -> None:
    samples = _samples(params, advantage)
    samples = samples._replace(log_prob=samples.log_prob.at[0].add(-100.0))  # A ratio of e^100.
    grads, losses = jax.jit(
        lambda params: jax.grad(_loss, has_aux=True)(params, samples),
    )(params)
    for leaf in jax.tree.leaves((grads, losses)):
        assert jnp.isfinite(leaf).all()


def test_values_are_learnt_in_the_unit_of_their_targets(params) -> None:
    samples = _samples(params, 0.0)
    # Targets have the mean 50 and the standard deviation 10, and the network says v of that unit.
    unit = Moments(jnp.asarray(4.0), jnp.asarray(50.0), jnp.asarray(400.0))
    network = samples.value
    samples = samples._replace(value=from_units(unit, network), advantage=jnp.full(B, 20.0))
    context = NEUTRAL._replace(value_moments=unit)
    _, metrics = _loss(params, samples, context, clip_value_loss=True)
    # 20 are two standard deviations; nothing has moved, so nothing is clipped.
    np.testing.assert_allclose(metrics.value_loss, 0.5 * 2.0**2, rtol=1e-4)
    assert float(metrics.value_clip_fraction) == 0.0
    weights = ActingWeights(params, no_samples((O,)), unit)
    values = state_values(NETWORKS, weights, samples.obs)
    np.testing.assert_allclose(values, samples.value, rtol=1e-5)


def test_advantages_are_shifted_and_scaled_by_the_context_for_the_policy_alone(params) -> None:
    context = NEUTRAL._replace(advantage_mean=jnp.asarray(1.0), advantage_std=jnp.asarray(2.0))
    loss, metrics = _loss(params, _samples(params, 5.0), context)
    np.testing.assert_allclose(loss, -2.0, rtol=1e-5)
    np.testing.assert_allclose(metrics.value_loss, 0.5 * 5.0**2, rtol=1e-5)


def test_means_out_of_bounds_cost_and_clipped_values_and_actions_are_counted(params) -> None:
    samples = _samples(params, 0.0)
    # Of six values four have moved by more than the clip range of 0.2.
    moved = samples._replace(value=samples.value + jnp.array([0.0, 0.1, 0.3, -0.3, 0.5, 0.21]))
    assert float(_loss(params, moved)[1].value_clip_fraction) == pytest.approx(4 / 6)
    # One of the two actions is clipped by the environment wherever the robot is.
    last = f"Dense_{len(NETWORKS.policy.hidden)}"
    layers = params.policy["params"]
    far = {**layers, last: {**layers[last], "bias": jnp.array([0.0, -2.0])}}
    loss, metrics = _loss(params._replace(policy={"params": far}), samples, bound_cost=1.0)
    assert float(metrics.saturated_fraction) == 0.5
    np.testing.assert_allclose(loss, 0.9**2, rtol=0.1)  # Its mean is about -2: (2 - 1.1) ** 2.


def test_the_derivative_of_elu_comes_from_its_output_and_is_the_same() -> None:
    x = jnp.linspace(-100.0, 100.0, 4001)
    mine, theirs = (jax.jit(jax.vmap(jax.value_and_grad(f)))(x) for f in (elu, nn.elu))
    np.testing.assert_array_equal(mine, theirs)


@pytest.mark.parametrize("activation", ["elu", "layer_norm_silu"])
def test_hidden_layers_compute_in_bfloat16_and_all_else_in_float32(activation: str) -> None:
    assert NETWORKS.value is not None
    whole, half = (
        NETWORKS._replace(
            policy=NETWORKS.policy.clone(dtype=dtype, activation=activation),
            value=NETWORKS.value.clone(dtype=dtype, activation=activation),
        )
        for dtype in ("float32", "bfloat16")
    )
    params = whole.init(jax.random.key(0), O)
    obs = jax.random.normal(jax.random.key(1), (20_000, O))  # Gradients are sums of many.

    def loss(params, networks):
        values = networks.state_value(params, obs)
        return jnp.mean(values + values**2), (values, networks.output(params, obs))

    derived = jax.jit(jax.grad(loss, has_aux=True), static_argnums=1)
    (mine, outputs), (theirs, exact) = derived(params, half), derived(params, whole)
    assert not jnp.array_equal(outputs[0], exact[0])
    pairs = zip(*map(jax.tree.leaves, ((outputs, mine.value), (exact, theirs.value))), strict=True)
    for a, b in pairs:
        assert a.dtype == jnp.float32
        np.testing.assert_allclose(a, b, atol=0.03 * float(jnp.max(jnp.abs(b))))


def test_the_policy_does_not_see_what_is_behind_its_part_of_an_observation() -> None:
    networks = NETWORKS._replace(actor_obs_size=2)
    params = networks.init(jax.random.key(0), O)
    obs = jnp.array([[1.0, 2.0, 3.0], [1.0, 2.0, -4.0]])
    first, second = networks.action_mean(params, obs)
    np.testing.assert_array_equal(first, second)
    assert not jnp.equal(*networks.state_value(params, obs))
    # Whoever has no more than what the policy sees gets the same actions.
    np.testing.assert_array_equal(networks.action_mean(params, obs[:, :2]), [first, second])


def test_explained_variance_by_hand() -> None:
    targets, values = jnp.array([1.0, 2.0, 3.0, 4.0]), jnp.array([1.5, 2.0, 3.0, 3.5])
    error = moments_of(targets - values, 1)
    # Errors of -0.5, 0, 0, 0.5: their squares sum to 0.5, those of the targets to 5.
    np.testing.assert_allclose(explained_variance(moments_of(targets, 1), error), 0.9, rtol=1e-6)
    assert float(explained_variance(moments_of(jnp.ones(4), 1), error)) == 0.0


def test_all_of_an_episode_that_ends_by_divergence_is_left_out() -> None:
    #                        starts over after step 1, and diverges in step 4
    ended = jnp.array([[0, 1, 0, 0, 1, 0], [0, 0, 0, 0, 0, 0]], bool).T
    bad = jnp.array([[0, 0, 0, 0, 1, 0], [0, 0, 0, 0, 0, 0]], bool).T
    wanted = np.array([[0, 0, 1, 1, 1, 0], [0, 0, 0, 0, 0, 0]], bool).T
    np.testing.assert_array_equal(until_diverged(bad, ended), wanted)


def test_gaussian_formulas() -> None:
    normal = Normal(2)
    mean, log_std, action = np.zeros(2), np.log([1.0, 2.0]), np.array([1.0, 2.0])
    # both actions are one standard deviation off: -1/2 - log std - log(2 pi) / 2 each
    expected = -1.0 - np.log(2.0) - np.log(2 * np.pi)
    np.testing.assert_allclose(normal.log_prob(mean, log_std, action), expected, rtol=1e-6)
    expected = np.log(2.0) + 1.0 + np.log(2 * np.pi)
    np.testing.assert_allclose(normal.entropy(mean, jnp.asarray(log_std)), expected, rtol=1e-6)
    # KL(N(0, 1) || N(1, 2)) = log 2 + (1 + 1) / 8 - 1/2 per dimension
    kl = Normal(1).kl_divergence(np.zeros(1), np.zeros(1), np.ones(1), np.log([2.0]))
    np.testing.assert_allclose(kl, np.log(2.0) + 0.25 - 0.5, rtol=1e-6)


@pytest.mark.parametrize("name", DISTRIBUTIONS)
@pytest.mark.parametrize("state_dependent_std", [False, True])
def test_a_distribution_is_what_it_says_of_its_samples(name: str, state_dependent_std) -> None:
    """One action, so that densities can be summed up and samples be counted."""
    distribution = DISTRIBUTIONS[name](1, state_dependent_std)
    assert distribution.output_size == 1 + state_dependent_std
    added = [-0.2] * state_dependent_std
    old, new = jnp.array([0.3, *added]), jnp.array([0.5, *added])
    log_std = jnp.log(jnp.array([0.6]))
    raw = jnp.linspace(-5.0, 5.0, 20_001)
    grid = distribution.action_of(raw)
    width = jnp.gradient(grid)
    logs, later = (distribution.log_prob(x, log_std, raw[:, None]) for x in (old, new))
    density = jnp.exp(logs)
    np.testing.assert_allclose(jnp.sum(density * width), 1.0, atol=2e-3)
    entropy = jnp.mean(distribution.entropy(old, log_std))
    np.testing.assert_allclose(entropy, -jnp.sum(density * logs * width), atol=5e-3)
    divergence = distribution.kl_divergence(old, log_std, new, log_std)
    np.testing.assert_allclose(divergence, jnp.sum(density * (logs - later) * width), atol=5e-3)
    outputs = jnp.broadcast_to(old, (4000, len(old)))
    keys = jax.random.split(jax.random.key(0), 4000)
    drawn = distribution.action_of(distribution.sample(outputs, log_std, keys))
    assert drawn.shape == distribution.mode(outputs).shape == (4000, 1)
    mean = jnp.sum(density * grid * width)
    np.testing.assert_allclose(jnp.mean(drawn), mean, atol=0.04)
    # Half of them lie below the median, which the mode is of all of these.
    np.testing.assert_allclose(jnp.mean(drawn < distribution.mode(old)), 0.5, atol=0.03)


@pytest.mark.parametrize("log_std", [-5.0, -1.0, 0.0, 1.0, 2.0])
@pytest.mark.parametrize("mean", [0.0, -0.4, 3.0, 9.0])
def test_the_entropy_behind_a_tanh_is_exact_for_every_deviation(mean: float, log_std: float):
    z = np.linspace(-10.0, 10.0, 100_001)
    x = mean + np.exp(log_std) * z
    shares = np.exp(-0.5 * z**2) / np.exp(-0.5 * z**2).sum()
    slopes = 2.0 * (np.log(2.0) - x - np.logaddexp(0.0, -2.0 * x))
    expected = log_std + 0.5 * np.log(2.0 * np.pi * np.e) + np.sum(shares * slopes)
    tanh_normal = DISTRIBUTIONS["tanh_normal"](1)
    found = tanh_normal.entropy(jnp.asarray([mean]), jnp.asarray([log_std]))
    np.testing.assert_allclose(found, expected, atol=2e-5)


def test_a_saturated_action_is_as_likely_as_the_noise_that_made_it() -> None:
    """Its tanh is 1 in float32, whatever it was: with that alone, ratios would explode."""
    squashed, log_std = DISTRIBUTIONS["tanh_normal"](1, False), jnp.zeros(1)
    raw, old = jnp.array([20.5]), jnp.array([20.0])
    assert squashed.action_of(raw) == 1.0

    def log_ratio(mean):
        logs = (squashed.log_prob(x, log_std, raw) for x in (mean, old))
        return next(logs) - next(logs)

    value, slope = jax.value_and_grad(log_ratio)(jnp.array([21.0]))
    # As of the Gaussians: (0.5^2 - 0.5^2) / 2, and back towards what was drawn.
    np.testing.assert_allclose(value, 0.0, atol=1e-4)
    np.testing.assert_allclose(slope, [-0.5], atol=1e-4)


@pytest.mark.parametrize("lam", [0.0, 0.8, 1.0])
def test_advantages_are_those_of_a_plain_loop(lam: float) -> None:
    rng = np.random.default_rng(0)
    rewards, values, next_values = rng.normal(size=(3, T, N)).astype(np.float32)
    terminated = rng.random((T, N)) < 0.2
    truncated = (rng.random((T, N)) < 0.2) & ~terminated
    expected, later = np.zeros((T, N)), np.zeros(N)
    for t in reversed(range(T)):
        delta = rewards[t] + 0.9 * ~terminated[t] * next_values[t] - values[t]
        expected[t] = later = delta + 0.9 * lam * ~(terminated[t] | truncated[t]) * later
    steps = map(jnp.asarray, (rewards, values, next_values, terminated, truncated))
    np.testing.assert_allclose(gae(*steps, discount=0.9, lam=lam), expected, atol=1e-5)


def test_a_truncated_step_bootstraps_and_a_terminated_one_does_not() -> None:
    # reward 1 + 0.9 * 10 - 0.5 = 9.5, against 1 - 0.5 = 0.5
    ends = jnp.array([[False, True]])
    steps = jnp.ones((1, 2)), jnp.full((1, 2), 0.5), jnp.full((1, 2), 10.0)
    advantages = gae(*steps, ends, ~ends, discount=0.9, lam=0.95)
    np.testing.assert_allclose(advantages, [[9.5, 0.5]], rtol=1e-6)
