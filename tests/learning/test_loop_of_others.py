"""A training loop as others write it around a vector environment of Gymnasium learns our task.

It is of the shape that single-file implementations of PPO have, in numpy and optax so that the
tests need no torch: storage that is written in place, returns from `final_info`, a bootstrap from
`final_obs`, Gymnasium's own wrappers of rewards.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from gymnasium.wrappers import vector as wrappers
from toy_env import point_mass_env

from gmijax.sim.adapters.to_gymnasium import GmijaxVectorEnv

NUM_ENVS, UNROLL, ITERATIONS, LENGTH = 32, 32, 20, 20
GAMMA, LAMBDA, CLIP = 0.95, 0.9, 0.2
OPTIMISER = optax.adam(3e-3)


def layer(rng: np.random.Generator, inputs: int, outputs: int, scale: float) -> dict[str, Any]:
    weights = rng.normal(0.0, scale / np.sqrt(inputs), (inputs, outputs)).astype(np.float32)
    return {"w": jnp.asarray(weights), "b": jnp.zeros(outputs)}


def network(layers: list[dict[str, Any]], x: Any) -> Any:
    hidden = jnp.tanh(x @ layers[0]["w"] + layers[0]["b"])
    return hidden @ layers[1]["w"] + layers[1]["b"]


@jax.jit
def act(params: Any, obs: Any, noise: Any) -> tuple[Any, Any, Any]:
    mean, std = network(params["actor"], obs), jnp.exp(params["log_std"])
    action = mean + std * noise
    return action, log_prob(params, mean, action), network(params["critic"], obs)[:, 0]


def log_prob(params: Any, mean: Any, action: Any) -> Any:
    deviation = (action - mean) / jnp.exp(params["log_std"])
    return jnp.sum(-0.5 * deviation**2 - params["log_std"], axis=1)


@jax.jit
def learn(params: Any, optimiser: Any, batch: dict[str, Any]) -> tuple[Any, Any]:
    def loss(params: Any) -> Any:
        mean = network(params["actor"], batch["obs"])
        ratio = jnp.exp(log_prob(params, mean, batch["action"]) - batch["log_prob"])
        clipped = jnp.clip(ratio, 1 - CLIP, 1 + CLIP)
        gain = jnp.minimum(ratio * batch["advantage"], clipped * batch["advantage"])
        error = network(params["critic"], batch["obs"])[:, 0] - batch["target"]
        return jnp.mean(0.5 * error**2 - gain)

    updates, optimiser = OPTIMISER.update(jax.grad(loss)(params), optimiser)
    return optax.apply_updates(params, updates), optimiser


def advantages(reward: np.ndarray, value: np.ndarray, over: np.ndarray) -> np.ndarray:
    """Of [T, N] steps; `value` has one more, of what follows the last."""
    found, last = np.zeros_like(reward), np.zeros(NUM_ENVS, np.float32)
    for t in reversed(range(UNROLL)):
        error = reward[t] + GAMMA * value[t + 1] * ~over[t] - value[t]
        found[t] = last = error + GAMMA * LAMBDA * ~over[t] * last
    return found


def train(envs: Any) -> list[float]:
    """Returns of all episodes, in the order of their ends."""
    rng = np.random.default_rng(0)
    params: Any = {
        "actor": [layer(rng, 2, 32, 1.0), layer(rng, 32, 1, 0.01)],
        "critic": [layer(rng, 2, 32, 1.0), layer(rng, 32, 1, 1.0)],
        "log_std": jnp.full(1, -0.5),
    }
    optimiser = OPTIMISER.init(params)
    store = {
        "obs": np.zeros((UNROLL, NUM_ENVS, 2), np.float32),
        "action": np.zeros((UNROLL, NUM_ENVS, 1), np.float32),
        "log_prob": np.zeros((UNROLL, NUM_ENVS), np.float32),
    }
    reward, over = np.zeros((UNROLL, NUM_ENVS), np.float32), np.zeros((UNROLL, NUM_ENVS), bool)
    value = np.zeros((UNROLL + 1, NUM_ENVS), np.float32)
    returns: list[float] = []

    def noise() -> np.ndarray:
        return rng.normal(size=(NUM_ENVS, 1)).astype(np.float32)

    obs, _ = envs.reset(seed=0)
    for _ in range(ITERATIONS):
        for t in range(UNROLL):
            action, store["log_prob"][t], value[t] = act(params, obs, noise())
            store["obs"][t], store["action"][t] = obs, action
            obs, earned, terminated, truncated, info = envs.step(np.asarray(action))
            over[t] = np.logical_or(terminated, truncated)
            if "final_info" in info:
                ended = np.nonzero(info["final_info"]["_episode"])[0]
                returns += info["final_info"]["episode"]["r"][ended].tolist()
                *_, last = act(params, info["final_obs"], noise())
                earned[truncated] += GAMMA * np.asarray(last)[truncated]
            reward[t] = earned
        *_, value[UNROLL] = act(params, obs, noise())
        advantage = advantages(reward, value, over)
        batch = {**store, "advantage": advantage, "target": advantage + value[:-1]}
        flat = {key: x.reshape(-1, *x.shape[2:]) for key, x in batch.items()}
        flat["advantage"] = (flat["advantage"] - flat["advantage"].mean()) / advantage.std()
        for _ in range(4):
            for rows in rng.permutation(UNROLL * NUM_ENVS).reshape(4, -1):
                minibatch = {key: x[rows] for key, x in flat.items()}
                params, optimiser = learn(params, optimiser, minibatch)
    return returns


def test_a_loop_of_others_learns():
    envs: Any = GmijaxVectorEnv(point_mass_env(LENGTH), NUM_ENVS)
    envs = wrappers.ClipReward(wrappers.NormalizeReward(envs, gamma=GAMMA), -10.0, 10.0)
    returns = train(envs)
    first, last = np.mean(returns[:NUM_ENVS]), np.mean(returns[-NUM_ENVS:])
    assert len(returns) >= ITERATIONS * UNROLL * NUM_ENVS // LENGTH - NUM_ENVS
    assert first < 0.0
    assert last > 10.0, f"returns of {first:.1f} at first and {last:.1f} at the end"
