import jax
import jax.numpy as jnp
import numpy as np

from gmijax.ppo.ppo import gae

T, N = 7, 3


def _case(seed: int = 0):
    rng = np.random.default_rng(seed)
    terminated = rng.random((T, N)) < 0.2
    truncated = (rng.random((T, N)) < 0.2) & ~terminated
    reals = [rng.normal(size=(T, N)).astype(np.float32) for _ in range(3)]
    return (*reals, terminated.astype(np.float32), truncated.astype(np.float32))


def test_equals_a_plain_loop() -> None:
    rewards, values, next_values, terminated, truncated = _case()
    expected = np.zeros((T, N))
    later = np.zeros(N)
    for t in reversed(range(T)):
        delta = rewards[t] + 0.9 * (1 - terminated[t]) * next_values[t] - values[t]
        later = delta + 0.9 * 0.8 * (1 - np.maximum(terminated[t], truncated[t])) * later
        expected[t] = later
    actual = jax.jit(gae, static_argnames=("discount", "lam"))(
        rewards, values, next_values, terminated, truncated, discount=0.9, lam=0.8
    )
    np.testing.assert_allclose(actual, expected, atol=1e-5)


def test_lambda_zero_gives_the_td_error() -> None:
    rewards, values, next_values, terminated, truncated = _case()
    actual = gae(rewards, values, next_values, terminated, truncated, discount=0.9, lam=0.0)
    expected = rewards + 0.9 * (1 - terminated) * next_values - values
    np.testing.assert_allclose(actual, expected, atol=1e-6)


def test_lambda_one_without_ends_gives_discounted_returns_minus_values() -> None:
    rewards, values, _, _, _ = _case()
    none = jnp.zeros((T, N))
    next_values = np.concatenate([values[1:], np.full((1, N), 2.0)])
    actual = gae(rewards, values, next_values, none, none, discount=0.9, lam=1.0)
    returns = np.full(N, 2.0)
    for t in reversed(range(T)):
        returns = rewards[t] + 0.9 * returns
        np.testing.assert_allclose(actual[t], returns - values[t], atol=1e-4)


def test_a_truncated_step_bootstraps_and_a_terminated_one_does_not() -> None:
    one, zero = jnp.ones((1, 1)), jnp.zeros((1, 1))
    value, next_value = 0.5 * one, 10.0 * one
    # reward 1 + 0.9 * 10 - 0.5 = 9.5, against 1 - 0.5 = 0.5
    truncated = gae(one, value, next_value, zero, one, discount=0.9, lam=0.95)
    terminated = gae(one, value, next_value, one, zero, discount=0.9, lam=0.95)
    np.testing.assert_allclose(truncated, 9.5 * one, rtol=1e-6)
    np.testing.assert_allclose(terminated, 0.5 * one, rtol=1e-6)
