"""Every task is the same on numpy as on JAX: its starts, and what it makes of the same physics.

MuJoCo in C moves an environment; the task's functions then run once in numpy and once in JAX,
compiled, on the positions, velocities, forces and sensors that it left.
"""

from __future__ import annotations

import subprocess
import sys
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gmijax.config import EnvConfig
from gmijax.player.plain_env import PlainEnv
from gmijax.sim import draws, simulators
from gmijax.sim.c_physics import CPhysics
from gmijax.sim.interface import Env
from gmijax.sim.physics_state import PhysicsState
from gmijax.sim.registry import TASKS, task_names

STEPS = 40
READ = ("qfrc_actuator", "sensordata", "xpos", "xquat")
TOLERANCE = 2e-4


class Recorded(CPhysics):
    """MuJoCo in C, of which JAX gets what it has computed: that is the `model` of a step."""

    def __init__(self, sim: CPhysics) -> None:
        super().__init__(sim.mj_model, sim.substeps)

    def start(self, qpos: Any, qvel: Any) -> PhysicsState:
        return PhysicsState(qpos, qvel, jnp.zeros_like(qvel))

    def poses(self, qpos: Any) -> Any:
        return tuple(map(floats, super().poses(np.asarray(qpos))))

    def step(self, model: Any, state: Any, ctrl: Any, read: Any = lambda data: data.sensordata):
        after = PhysicsState(model["qpos"], model["qvel"], state.qacc_warmstart)
        return after, (ctrl, read(SimpleNamespace(**{name: model[name] for name in READ})))


def assert_close(ours: Any, theirs: Any) -> None:
    np.testing.assert_allclose(ours, theirs, rtol=TOLERANCE, atol=TOLERANCE)


def floats(values: Any) -> jax.Array:
    return jnp.asarray(values, jnp.float32)


def in_jax(task: str, monkeypatch: pytest.MonkeyPatch) -> tuple[Env, list[Any]]:
    """The task in JAX, and a list that gets the control signal of each step."""
    signals: list[Any] = []
    plain = PlainEnv(EnvConfig(name=task, episode_length=None))

    class Watched(Recorded):
        def step(self, model: Any, state: Any, ctrl: Any, *read: Any) -> Any:
            after, (ctrl, found) = super().step(model, state, ctrl, *read)
            signals.append(ctrl)
            return after, found

    with monkeypatch.context() as patch:
        patch.setattr(simulators, "load", lambda *_, **__: Watched(plain.physics))
        module = __import__(TASKS[task], fromlist=["make"])
        return module.make(), signals


def same_draws(monkeypatch: pytest.MonkeyPatch, seed: int, in_jax: bool) -> None:
    """Numbers that do not depend on whether they are drawn by a key or by a generator."""
    rng = np.random.default_rng(seed)

    def uniform(key: Any, shape: Any = (), *, minval: Any = 0.0, maxval: Any = 1.0) -> Any:
        numbers = np.asarray(rng.uniform(minval, maxval, shape), np.float32)
        return jnp.asarray(numbers) if in_jax else numbers

    monkeypatch.setattr(draws, "uniform", uniform)


@pytest.mark.parametrize("task", task_names())
def test_starts_are_the_same(task: str, monkeypatch: pytest.MonkeyPatch):
    plain = PlainEnv(EnvConfig(name=task, episode_length=None))
    env, _ = in_jax(task, monkeypatch)
    for seed in range(3):
        same_draws(monkeypatch, seed, in_jax=False)
        plain.reset(seed)
        same_draws(monkeypatch, seed, in_jax=True)
        state = env.reset(env.model, jax.random.key(seed))
        assert isinstance(state.obs, jax.Array)
        assert_close(plain.obs, state.obs)
        assert_close(plain.state.physics.qvel, state.physics.qvel)
        assert_close(plain.qpos, state.physics.qpos)
        assert_trees_equal(plain.state.task, state.task)


@pytest.mark.parametrize("task", task_names())
def test_steps_are_the_same(task: str, monkeypatch: pytest.MonkeyPatch):
    plain = PlainEnv(EnvConfig(name=task, episode_length=None), seed=1)
    env, signals = in_jax(task, monkeypatch)

    @jax.jit
    def step(recorded: Any, state: Any, action: Any) -> Any:
        signals.clear()
        return env.step(recorded, state, action), signals[0]

    rng, seen = np.random.default_rng(0), set()
    key = jax.random.key(0)
    same_draws(monkeypatch, 3, in_jax=False)
    for _ in range(STEPS):
        before, action = plain.state, rng.uniform(-1.5, 1.5, env.spec.action_size)
        plain.step(action)
        data = {name: floats(getattr(plain.data, name)) for name in (*READ, "qpos", "qvel")}
        start = jax.tree.map(
            floats, before._replace(key=(), steps=(), terminated=(), truncated=())
        )
        start = start._replace(
            key=key,
            steps=jnp.int32(before.steps),
            terminated=jnp.zeros((), bool),
            truncated=jnp.zeros((), bool),
        )
        after, ctrl = step(data, start, floats(action))
        assert_close(plain.data.ctrl, ctrl)
        ours = plain.state
        assert_close(ours.obs, after.obs)
        assert_close(ours.reward, after.reward)
        assert ours.reward_terms.keys() == after.reward_terms.keys() == set(env.spec.reward_terms)
        assert ours.metrics.keys() == after.metrics.keys()
        for name, value in {**ours.reward_terms, **ours.metrics}.items():
            assert_close(value, {**after.reward_terms, **after.metrics}[name])
        assert bool(ours.terminated) == bool(after.terminated)
        assert bool(ours.truncated) == bool(after.truncated)
        assert int(ours.steps) == int(after.steps)
        if not bool(ours.metrics.get("successes", 0.0)):  # Another goal is another draw.
            assert_trees_equal(ours.task, after.task)
        seen.add(float(ours.reward))
        if ours.terminated or ours.truncated:
            plain.reset()
    assert len(seen) > STEPS / 2


def assert_trees_equal(ours: Any, theirs: Any) -> None:
    assert jax.tree.structure(ours) == jax.tree.structure(theirs)
    for mine, other in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        assert_close(mine, other)


def test_the_player_imports_neither_jax_nor_hydra():
    """In a fresh interpreter, with an environment of every task made and moved."""
    program = """
import sys
import numpy as np
from gmijax.config import EnvConfig
from gmijax.player import plain_env, policy, returns
from gmijax.sim.registry import task_names
for name in task_names():
    env = plain_env.PlainEnv(EnvConfig(name=name, episode_length=None))
    env.step(np.zeros(env.spec.action_size))
loaded = {name.partition(".")[0] for name in sys.modules}
print(sorted(loaded & {"jax", "jaxlib", "hydra", "omegaconf", "flax", "orbax"}))
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"
