import jax.numpy as jnp
import numpy as np
import pytest

from gmijax.a3c.returns import n_step_returns, vtrace

T, N = 9, 7


@pytest.fixture
def steps():
    draw = np.random.default_rng(0)
    ended = draw.random((2, T, N)) < 0.15
    return {
        "rewards": draw.normal(size=(T, N)).astype(np.float32),
        "values": draw.normal(size=(T, N)).astype(np.float32),
        "next_values": draw.normal(size=(T, N)).astype(np.float32),
        "terminated": ended[0].astype(np.float32),
        "truncated": (ended[1] & ~ended[0]).astype(np.float32),
    }


def _slow_vtrace(s, ratios, discount, lam, rho_clip, trace_clip):
    """Equation 1 of arXiv:1802.01561 as a sum over later steps, episode by episode."""
    value, advantage = np.zeros((T, N)), np.zeros((T, N))
    rho, c = np.minimum(rho_clip, ratios), lam * np.minimum(trace_clip, ratios)
    goes_on = discount * (1 - s["terminated"])
    for env in range(N):
        for start in range(T):
            total, factor = s["values"][start, env], 1.0
            for t in range(start, T):
                delta = s["rewards"][t, env] + goes_on[t, env] * s["next_values"][t, env]
                total += factor * rho[t, env] * (delta - s["values"][t, env])
                if s["terminated"][t, env] or s["truncated"][t, env]:
                    break
                factor *= discount * c[t, env]
            value[start, env] = total
    for env in range(N):
        for t in range(T):
            ends = t == T - 1 or s["terminated"][t, env] or s["truncated"][t, env]
            # What follows is worth v of the same episode, corrected as the next row is.
            later = 0.0 if ends else value[t + 1, env] - s["values"][t + 1, env]
            target = s["rewards"][t, env] + goes_on[t, env] * (s["next_values"][t, env] + later)
            advantage[t, env] = target - s["values"][t, env]
    return value, advantage


@pytest.mark.parametrize(("lam", "rho_clip", "trace_clip"), [(1, 1, 1), (0.9, 2, 0.7), (0, 1, 1)])
def test_vtrace_is_the_sum_of_the_paper(steps, lam, rho_clip, trace_clip) -> None:
    ratios = np.random.default_rng(1).lognormal(size=(T, N)).astype(np.float32)
    got = vtrace(
        *map(jnp.asarray, steps.values()), ratios=jnp.asarray(ratios),
        discount=0.97, lam=lam, rho_clip=rho_clip, trace_clip=trace_clip,
    )  # fmt: skip
    value, advantage = _slow_vtrace(steps, ratios, 0.97, lam, rho_clip, trace_clip)
    np.testing.assert_allclose(got.value, value, rtol=2e-5, atol=1e-5)
    np.testing.assert_allclose(got.advantage, advantage, rtol=2e-5, atol=1e-5)
    np.testing.assert_allclose(got.rho, np.minimum(rho_clip, ratios))


def test_n_step_returns_by_hand() -> None:
    # Two steps, discount 0.5: bootstrap 8 -> 2 + 4 = 6 -> 1 + 3 = 4; terminated: 2 -> 1 + 1;
    # truncated at the first step with a value of 10 behind it: 1 + 5.
    one = np.ones(3, np.float32)
    returns = n_step_returns(
        rewards=jnp.asarray([one, 2 * one]),
        values=jnp.asarray([one, one]),
        next_values=jnp.asarray([[7.0, 7.0, 10.0], [8.0, 8.0, 8.0]]),
        terminated=jnp.asarray([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
        truncated=jnp.asarray([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]),
        discount=0.5,
    )
    np.testing.assert_allclose(returns.value, [[4, 2, 6], [6, 2, 6]])
    np.testing.assert_allclose(returns.advantage, [[3, 1, 5], [5, 1, 5]])
