"""Measures T and R of the paper's resource model (section 5.1): what each task takes of a GPU.

`python -m benchmarks.resource_use --tasks ant humanoid` runs simulator, agent and trainer of an
iteration one after the other in one process, each alone on the GPU and over and over. While it
does, NVML's performance monitor (GPM, from Hopper on) reads which part of the SMs is busy, and
the compiler has said what memory its program takes. R is the larger part of the two (equation 1).
Adds a call to `benchmarks/results/resource-use-<device>.json`, which `python -m
benchmarks.resource_model --resources` reads.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import pynvml

from benchmarks.paper_model import dominant_resource
from benchmarks.records import RESULTS, ResultsFile, file_name
from gmijax import compose
from gmijax.collectives.program import PeersOfOne
from gmijax.config import PpoConfig, TrainConfig
from gmijax.learning.learner import Learner, acting_weights, init_learner, make_learner
from gmijax.learning.unroll import act
from gmijax.machine.nvidia import nvml_session
from gmijax.ppo.ppo import learn
from gmijax.ppo.rollout import Samples, no_stats
from gmijax.sim.interface import EnvSpec
from gmijax.sim.randomize import make_worlds
from gmijax.sim.wrappers import BatchedEnv, env_keys, training_env

SECONDS = 2.0
"""How long each task runs: the monitor wants a tenth of a second at least."""


class Use(NamedTuple):
    """What one task takes of a GPU.

    Attributes:
      seconds: T, of one iteration.
      sm: mean part of the SMs that were busy, 0 to 1.
      memory: part of the GPU's memory that its program needs, 0 to 1.
    """

    seconds: float
    sm: float
    memory: float

    @property
    def dominant(self) -> str:
        """`sm` or `memory`, equation 1."""
        return dominant_resource(self.sm, 1.0, self.memory, 1.0)


class Stage(NamedTuple):
    """One task of an iteration.

    Attributes:
      name: simulator, agent or trainer.
      program: from (given, state) to the next state, what a GMI does in an iteration.
      given: what it reads.
      state: the first one.
    """

    name: str
    program: Callable[[Any, Any], Any]
    given: Any
    state: Any


class Monitor:
    """NVML's performance monitor of a GPU; raises NVMLError where there is none.

    Args:
      index: of the GPU, as NVML counts.
    """

    def __init__(self, index: int) -> None:
        self._device = pynvml.nvmlDeviceGetHandleByIndex(index)
        self._samples = [pynvml.nvmlGpmSampleAlloc() for _ in range(2)]
        self.uuid = str(pynvml.nvmlDeviceGetUUID(self._device))
        self.memory_bytes = int(pynvml.nvmlDeviceGetMemoryInfo(self._device).total)

    def start(self) -> None:
        """Begins an interval."""
        pynvml.nvmlGpmSampleGet(self._device, self._samples[0])

    def busy_sms(self) -> float:
        """Mean part of the SMs that were busy since `start`, 0 to 1."""
        pynvml.nvmlGpmSampleGet(self._device, self._samples[1])
        wanted: Any = pynvml.c_nvmlGpmMetricsGet_t()
        wanted.version = pynvml.NVML_GPM_METRICS_GET_VERSION
        wanted.numMetrics = 1
        wanted.sample1, wanted.sample2 = self._samples
        wanted.metrics[0].metricId = pynvml.NVML_GPM_METRIC_SM_UTIL
        pynvml.nvmlGpmMetricsGet(wanted)
        return wanted.metrics[0].value / 100.0

    def close(self) -> None:
        """Frees the samples."""
        for sample in self._samples:
            pynvml.nvmlGpmSampleFree(sample)


def main() -> int:
    """Measures and prints; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tasks", nargs="+", default=["ant", "humanoid"])
    parser.add_argument("--num-envs", type=int, default=2048)
    parser.add_argument("--impl", choices=("jax", "warp"), default="jax")
    parser.add_argument("--gpu", type=int, default=0, help="index, as NVML counts")
    parser.add_argument("--out", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    try:
        with nvml_session():
            monitor = Monitor(arguments.gpu)
            os.environ["CUDA_VISIBLE_DEVICES"] = monitor.uuid  # jax looks when it is first used.
            rows = {task: _task(task, arguments, monitor) for task in arguments.tasks}
            monitor.close()
    except pynvml.NVMLError as error:
        sys.stderr.write(f"--gpu {arguments.gpu}: NVML cannot watch it: {error}\n")
        return 2
    device = jax.local_devices()[0].device_kind
    path = arguments.out / file_name("resource-use", device)
    with ResultsFile(path, "resource-use", vars(arguments), device=device).changing() as results:
        results["tasks"] = rows
    for task, uses in rows.items():
        for name, use in uses.items():
            sys.stdout.write(
                f"{task:16}{name:10} {use['seconds'] * 1e3:9.3f} ms, SMs {use['sm']:.1%}, memory "
                f"{use['memory']:.2%}\n"
            )
    sys.stdout.write(f"written: {path}\n")
    return 0


def _task(name: str, arguments: argparse.Namespace, monitor: Monitor) -> dict[str, Any]:
    """What simulator, agent and trainer of a task take."""
    config = compose(
        f"env={name}", f"physics.impl={arguments.impl}", f"num_envs={arguments.num_envs}"
    )
    found = {}
    for stage in _stages(config, arguments.impl):
        use = _measured(stage, monitor)
        found[stage.name] = {**use._asdict(), "dominant": use.dominant}
    return found


def _measured(stage: Stage, monitor: Monitor) -> Use:
    given, state = stage.given, jax.tree.map(jnp.copy, stage.state)
    compiled = jax.jit(stage.program, donate_argnums=1).lower(given, state).compile()
    needs: Any = compiled.memory_analysis()
    memory = needs.argument_size_in_bytes + needs.temp_size_in_bytes
    state = jax.block_until_ready(compiled(given, compiled(given, state)))
    count, started = 0, time.monotonic()
    monitor.start()
    while time.monotonic() - started < SECONDS:
        for _ in range(4):
            state = compiled(given, state)
        jax.block_until_ready(state)
        count += 4
    busy, seconds = monitor.busy_sms(), time.monotonic() - started
    return Use(seconds / count, busy, memory / monitor.memory_bytes)


def _stages(config: TrainConfig, impl: str) -> Iterator[Stage]:
    """Agent, trainer and simulator, with random experience where they need some."""
    algo, num_envs = config.algo, config.envs_per_gmi
    assert isinstance(algo, PpoConfig)
    worlds = make_worlds(config.env, impl, seed=0, first_env=0, num_envs=num_envs)
    env = training_env(worlds)
    learner, key = make_learner(env.spec, algo), jax.random.key(0)
    state = init_learner(learner, env.spec.obs_size, key)
    envs = jax.jit(env.init)(env.model, env_keys(key, 0, num_envs))
    zeros = jnp.zeros((num_envs, env.spec.action_size))
    actions = jax.random.uniform(key, zeros.shape, minval=-1.0)
    samples = _samples(num_envs * algo.unroll_length, env.spec, key)
    stats = no_stats(env.spec, env.overflows)
    yield Stage("agent", partial(_act, learner), state, (envs, zeros))
    yield Stage("trainer", partial(_train, learner), (samples, stats), state)
    yield Stage("simulator", partial(_simulate, env, algo), (env.model, actions), envs)


def _simulate(env: BatchedEnv, algo: PpoConfig, given: Any, envs: Any) -> Any:
    """T steps of all environments."""
    model, actions = given

    def step(_: Any, envs: Any) -> Any:
        return env.step(model, envs, actions)[0]

    return jax.lax.fori_loop(0, algo.unroll_length, step, envs)


def _act(learner: Learner, state: Any, carry: Any) -> Any:
    """T actions for all environments."""
    weights = acting_weights(learner, state)

    def step(_: Any, carry: Any) -> Any:
        envs, total = carry
        # Other observations in every step, or the network would be evaluated only once.
        obs = envs.env.obs + 1e-9 * total[:, :1]
        envs = envs._replace(env=envs.env._replace(obs=obs))
        envs, _, action = act(learner.networks, weights, envs)
        return envs, total + action

    return jax.lax.fori_loop(0, learner.config.unroll_length, step, carry)


def _train(learner: Learner, given: Any, state: Any) -> Any:
    """All updates of an iteration."""
    samples, stats = given
    return learn(learner, PeersOfOne(), state, samples, stats)[0]


def _samples(count: int, spec: EnvSpec, key: jax.Array) -> Samples:
    """Random samples: how long an update takes does not depend on what is in them."""
    shapes = (spec.obs_size,), (spec.action_size,), ()
    obs, action, advantage = (jax.random.normal(key, (count, *shape)) for shape in shapes)
    zeros = jnp.zeros(count)
    return Samples(obs, action, zeros, jnp.zeros_like(action), zeros, advantage)


if __name__ == "__main__":
    sys.exit(main())
