"""A role of your own: an evolution strategy (arXiv:1703.03864): `python examples/custom_role.py`.

Every GMI tries other changes of one linear policy, in environments of its own. All take the mean
of what they found, so their policies stay equal. Options: task, GMIs, generations.
"""

import sys

import jax
import jax.numpy as jnp

import gmijax

PAIRS, SIGMA, RATE, STEPS = 32, 0.1, 0.1, 100


class Evolution(gmijax.Role):
    """Improves a policy without gradients; returns its mean score by generation."""

    def run(self, task, generations):
        """Each generation plays `PAIRS` changes of the policy, and their opposites."""
        env = gmijax.make_env(task)

        def play(policy, key):
            def step(carry, _):
                state, alive = carry
                state = env.step(env.model, state, jnp.tanh(state.obs @ policy))
                return (state, alive & ~state.terminated), alive * state.reward

            return jax.lax.scan(step, (env.reset(env.model, key), True), length=STEPS)[1].sum()

        @jax.jit
        def explore(policy, key):
            change = jax.random.normal(key, (PAIRS, *policy.shape))
            tried = policy + SIGMA * jnp.concatenate([change, -change])
            scores = jax.vmap(play)(tried, jnp.tile(jax.random.split(key, PAIRS), 2))
            better, worse = jnp.split((scores - scores.mean()) / (scores.std() + 1e-6), 2)
            return jnp.einsum("n,n...->...", better - worse, change) / PAIRS, scores.mean()

        policy, history = jnp.zeros((env.spec.obs_size, env.spec.action_size)), []
        for key in jax.random.split(jax.random.key(self.rank), generations):
            direction, score = self.collective(explore(policy, key))
            policy += RATE * direction
            history.append(float(score))
        return history


if __name__ == "__main__":
    task, gmis, generations = [*sys.argv[1:], *("ball_balance", 2, 30)[len(sys.argv) - 1 :]]
    plan = gmijax.plan(gmis_per_gpu=int(gmis))
    scores = gmijax.launch(plan, Evolution(), task, int(generations), timeout_s=300)
    same = all(score == scores[0] for score in scores)
    print(f"score {scores[0][0]:.2f} -> {scores[0][-1]:.2f}, the same on all GMIs: {same}")
