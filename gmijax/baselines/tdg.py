"""Serving with simulators and agents in GMIs of their own: the template `tdg`.

They talk in every step: a simulator sends observations [N, O] and the bits of its environments'
random keys; the agent of its GPU answers with actions [N, A] and log densities [N]. An agent
serves its simulators in turn, and ends when all of them have closed their pipes. The pipes lie in
host memory, as the paper has it for GMIs whose memory is isolated (sec. 5.1).
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import closing
from functools import partial
from typing import Any

import jax
import numpy as np

from gmijax.baselines.tdg_steps import infer, next_keys, simulate
from gmijax.channels.pipe import Message, PipeReader, PipeWriter
from gmijax.channels.pipe_block import PipeBlock
from gmijax.collection.collectors import CollectorContext
from gmijax.collection.programs import CollectedStep
from gmijax.compile_once import compile_once
from gmijax.errors import PipeClosed
from gmijax.learning.unroll import Counts, no_counts
from gmijax.partition.plan import Plan
from gmijax.partition.templates import AGENT, SIMULATOR, has_role
from gmijax.supervise.child import ENV_PIPES_FD, required_fd


def collect(context: CollectorContext, plan: Plan) -> dict[str, Any]:
    """Does what the plan gives to this GMI; the outcome for `result.json`.

    Raises:
      NonFiniteError, CollectiveError: as `gmijax.collection.collectors.collect`.
    """
    gmi = context.link.gmi
    simulates = has_role(plan.roles[gmi], SIMULATOR)
    wanted = AGENT if simulates else SIMULATOR
    with closing(PipeBlock(required_fd(ENV_PIPES_FD), gmi)) as block:
        peers = [
            _Peer(block, other, context.config.run.exchange_timeout_s)
            for other in sorted(plan.layout.neighbours_of(gmi))
            if has_role(plan.roles[other], wanted)
        ]
        return _run_simulator(context, peers[0]) if simulates else _run_agent(context, peers)


class _Peer:
    """Both pipes between this GMI and another one."""

    def __init__(self, block: PipeBlock, gmi: int, timeout_s: float) -> None:
        self._writer = PipeWriter(block, gmi)
        self._reader = PipeReader(block, gmi)
        self._timeout_s = timeout_s

    def send(self, *arrays: np.ndarray) -> None:
        """Sends arrays; waits only if the other one has not taken those of before."""
        self._writer.put(arrays, self._timeout_s)

    def recv(self) -> Message:
        """Waits for the other one's arrays, valid until the next call; PipeClosed at its end."""
        return self._reader.get(self._timeout_s)

    def close(self) -> None:
        """Marks the end of what is sent."""
        self._writer.close()


def _run_simulator(context: CollectorContext, agent: _Peer) -> dict[str, Any]:
    """Makes the unrolls of this GMI with the actions of `agent`; see `collect`."""
    context.link.begin_compiling()
    started_s = time.monotonic()
    state = context.reset()
    simulator = _Simulator(context, agent, state)
    compile_s = time.monotonic() - started_s - context.link.start_s["waiting"]
    context.link.beat("ready", 0)
    context.barrier()
    outcome = context.record(simulator.unrolls())
    agent.close()
    stages = {"simulate": simulator.simulate_s, "exchange": simulator.exchange_s}
    return {
        "compile_s": compile_s,
        "latency_s": [sum(both) for both in zip(*stages.values(), strict=True)],
        "stages_s": {name: list(times) for name, times in stages.items()},
        **outcome,
    }


class _Simulator:
    """The steps of one simulator, and how long the latest took.

    `simulate_s` is from actions to observations on the host. `exchange_s` is from observations to
    actions on the host: both pipes, the agent, and waiting while it serves others.
    """

    def __init__(self, context: CollectorContext, agent: _Peer, state: Any) -> None:
        config, spec = context.config, context.env.spec
        self._context = context
        self._agent = agent
        self._state, self._bits = jax.jit(next_keys)(state)
        self._actions = (
            np.zeros((config.envs_per_gmi, spec.action_size), np.float32),
            np.zeros(config.envs_per_gmi, np.float32),
        )
        self._no_counts = no_counts(spec, context.env.overflows)
        program = jax.jit(partial(simulate, context.env, context.keep), donate_argnums=(1,))
        self._program = compile_once(
            program.lower(context.env.model, self._state, self._no_counts, *self._actions)
        )
        self.simulate_s: deque[float] = deque(maxlen=config.latency_steps)
        self.exchange_s: deque[float] = deque(maxlen=config.latency_steps)

    def unrolls(self) -> Iterator[tuple[CollectedStep | None, Counts]]:
        """Gives out unrolls one after the other."""
        self._exchange()  # The first observations; the clock of the stages starts after it.
        for _ in range(self._context.num_unrolls):
            if self._context.link.stop_requested:
                break
            yield self._unroll()

    def _unroll(self) -> tuple[CollectedStep | None, Counts]:
        counts, steps = self._no_counts, []
        for _ in range(self._context.config.unroll_length):
            started_s = time.perf_counter()
            self._state, self._bits, counts, step = self._program(
                self._context.env.model, self._state, counts, *self._actions
            )
            jax.block_until_ready((self._state.env.obs, self._bits))
            simulated_s = time.perf_counter()
            self._exchange()
            self.simulate_s.append(simulated_s - started_s)
            self.exchange_s.append(time.perf_counter() - simulated_s)
            if step is not None:
                steps.append(step)
        return _stacked(steps) if steps else None, counts

    def _exchange(self) -> None:
        self._agent.send(np.asarray(self._state.env.obs), np.asarray(self._bits))
        action, log_prob = self._agent.recv()
        # Copies: the pipe's memory is used again, and jax may keep what it is given.
        num_envs = self._context.config.envs_per_gmi
        self._actions = (
            action.view(np.float32).reshape(num_envs, -1).copy(),
            log_prob.view(np.float32).copy(),
        )


def _run_agent(context: CollectorContext, simulators: Sequence[_Peer]) -> dict[str, Any]:
    """Answers the simulators until all have closed; the outcome for `result.json`."""
    context.link.begin_compiling()
    started_s = time.monotonic()
    agent = _Agent(context)
    compile_s = time.monotonic() - started_s - context.link.start_s["waiting"]
    context.link.beat("ready", 0)
    context.barrier()
    answered, left = 0, list(simulators)
    while left:
        for peer in tuple(left):
            try:
                obs, bits = peer.recv()
            except PipeClosed:
                left.remove(peer)
                continue
            peer.send(*agent.act(obs, bits))
            answered += 1
        context.link.beat("running", answered)
    for peer in simulators:
        peer.close()
    return {
        "status": "stopped" if context.link.stop_requested else "completed",
        "compile_s": compile_s,
        "answered": answered,
        "stages_s": {"infer": list(agent.infer_s)},
    }


class _Agent:
    """The compiled agent of several simulators; `infer_s`: seconds of its latest answers."""

    def __init__(self, context: CollectorContext) -> None:
        num_envs, obs_size = context.config.envs_per_gmi, context.env.spec.obs_size
        keys = jax.random.split(jax.random.key(0), num_envs)
        obs, bits = np.zeros((num_envs, obs_size), np.float32), jax.random.key_data(keys)
        program = jax.jit(partial(infer, context.policy))
        self.infer_s: deque[float] = deque(maxlen=context.config.latency_steps)
        self._weights = context.policy.weights
        self._shapes = obs.shape, bits.shape
        self._program: Any = compile_once(program.lower(self._weights, obs, np.asarray(bits)))

    def act(self, obs: np.ndarray, bits: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Actions [N, A] and log densities [N], from the bytes of observations and keys."""
        began_s = time.perf_counter()
        action, log_prob = self._program(
            self._weights,
            obs.view(np.float32).reshape(self._shapes[0]),
            bits.view(np.uint32).reshape(self._shapes[1]),
        )
        answer = np.asarray(action), np.asarray(log_prob)
        self.infer_s.append(time.perf_counter() - began_s)
        return answer


def _stacked(steps: Sequence[CollectedStep]) -> CollectedStep:
    """Steps [T, N] from T steps [N]."""
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *steps)
