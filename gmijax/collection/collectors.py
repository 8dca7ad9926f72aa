"""What a serving GMI does: one GMI's part of the job, by template.

With `tcg` simulator and agent share a GMI, and an unroll is one program. With `tdg` they have GMIs
of their own, which talk in every step: a simulator sends observations [N, O] and the bits of its
environments' random keys; the agent of its GPU answers with actions [N, A] and log densities [N].
An agent serves its simulators in turn, and ends when all of them have closed their pipes. The
pipes lie in host memory, as the paper has it for GMIs whose memory is isolated (sec. 5.1).
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from gmijax.channels.pipe import Message, PipeReader, PipeWriter
from gmijax.channels.pipe_block import PipeBlock
from gmijax.collection.programs import (
    ActingPolicy,
    Keep,
    Step,
    infer,
    next_keys,
    simulate,
    unroll,
)
from gmijax.collection.recording import CollectionStats, ShardWriter
from gmijax.compile_once import compile_once
from gmijax.config import ServeConfig
from gmijax.errors import PipeClosed
from gmijax.learning.start import begin_episodes
from gmijax.learning.unroll import Counts, no_counts
from gmijax.sim.wrappers import BatchedEnv, BatchState
from gmijax.supervise.child import ChildLink

WARM_UP_STEPS = 10
"""Steps before the timed ones: caches, pools and clocks settle."""


class Share(NamedTuple):
    """One GMI's part of a serving job.

    Attributes:
      rank: place among the GMIs that simulate (an agent: among the agents).
      first_unroll: unrolls that earlier jobs have written of this GMI's part.
      num_unrolls: unrolls that are left to be made.
      writer: takes the experience, None where it is not kept.
    """

    config: ServeConfig
    link: ChildLink
    env: BatchedEnv
    policy: ActingPolicy
    rank: int
    first_unroll: int
    num_unrolls: int
    writer: ShardWriter | None
    barrier: Callable[[], Any]

    @property
    def keep(self) -> Keep:
        """What of every step leaves the compiled program."""
        return Keep(self.writer is not None, self.config.output.next_obs)

    def reset(self) -> BatchState:
        """Environments at their starts.

        Starts depend on the seed, on the number of the environment in the whole job, and on how
        many unrolls were there before: a job that goes on makes other episodes, not the same.
        """
        key = jax.random.fold_in(jax.random.key(self.config.seed), self.first_unroll)
        num_envs = self.config.envs_per_gmi
        kept_steps = self.config.unroll_length if self.keep.steps else 0
        first_env = self.rank * num_envs
        return begin_episodes(self.env, key, first_env, num_envs, kept_steps=kept_steps)

    def record(self, unrolls: Iterable[tuple[Step | None, Counts]]) -> dict[str, Any]:
        """Takes unrolls until there are no more; returns the outcome for `result.json`."""
        steps_per_unroll = self.config.envs_per_gmi * self.config.unroll_length
        stats = CollectionStats(self.link, self.env.spec.name, steps_per_unroll)
        try:
            for steps, counts in unrolls:
                stats.add(counts)  # First, so that no unroll with bad numbers is kept.
                if self.writer is not None and steps is not None:
                    self.writer.write(steps)
            if self.writer is not None:
                self.writer.wait()
        finally:
            stats.close()
        is_complete = stats.num_unrolls == self.num_unrolls
        return {"status": "completed" if is_complete else "stopped", **stats.outcome()}


def collect(share: Share) -> dict[str, Any]:
    """Simulator and agent in one GMI: makes its unrolls; the outcome for `result.json`.

    Raises:
      NonFiniteError: too many worlds gave numbers that are not finite or beyond all bounds.
      CollectiveError: another GMI is gone or stuck before all have begun.
    """
    started_s = time.monotonic()
    state = share.reset()
    arguments = share.env.model, share.policy.weights
    program = _lowered(share, share.config.unroll_length, share.keep, (*arguments, state))
    latency_s: list[float] = []
    single = None
    if share.config.latency_steps:
        single = _lowered(share, 1, Keep(steps=False, next_obs=False), (*arguments, state))
    share.link.begin_compiling()
    program = compile_once(program)
    single = single and compile_once(single)
    compile_s = time.monotonic() - started_s - share.link.start_s["waiting"]
    share.link.beat("ready", 0)
    if single is not None:
        share.barrier()
        latency_s = _time_steps(share, partial(single, *arguments), state)
        # The unrolls are to begin at the starts, whatever was timed before.
        state = share.reset()
    share.barrier()  # All have compiled: the clock may start.
    outcome = share.record(_unrolls(share, partial(program, *arguments), state))
    return {"compile_s": compile_s, "latency_s": latency_s, "stages_s": {}, **outcome}


def _lowered(share: Share, length: int, keep: Keep, arguments: tuple[Any, ...]) -> Any:
    program = partial(unroll, share.env, share.policy, length, keep)
    return jax.jit(program, donate_argnums=(2,)).lower(*arguments)


def _time_steps(share: Share, step: Any, state: Any) -> list[float]:
    """Seconds of single steps of all N environments, each waited for."""
    seconds = []
    for number in range(WARM_UP_STEPS + share.config.latency_steps):
        started_s = time.perf_counter()
        state, _, _ = step(state)
        jax.block_until_ready(state)
        if number >= WARM_UP_STEPS:
            seconds.append(time.perf_counter() - started_s)
        share.link.beat("running", 0)
    return seconds


def _unrolls(share: Share, program: Any, state: Any) -> Iterator[tuple[Step | None, Counts]]:
    """Gives out each unroll while the next one is computed."""
    before = None
    for _ in range(share.num_unrolls):
        if share.link.stop_requested:
            break
        state, *made = program(state)
        if before is not None:
            yield before
        before = made[0], made[1]
    if before is not None:
        yield before


class Peer:
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
        """Says that nothing more will be sent."""
        self._writer.close()


def run_simulator(share: Share, agent: Peer) -> dict[str, Any]:
    """Makes the unrolls of this GMI with the actions of `agent`; see `collect`."""
    share.link.begin_compiling()
    started_s = time.monotonic()
    state = share.reset()
    simulator = _Simulator(share, agent, state)
    compile_s = time.monotonic() - started_s - share.link.start_s["waiting"]
    share.link.beat("ready", 0)
    share.barrier()
    outcome = share.record(simulator.unrolls())
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

    def __init__(self, share: Share, agent: Peer, state: Any) -> None:
        config, spec = share.config, share.env.spec
        self._share = share
        self._agent = agent
        self._state, self._bits = jax.jit(next_keys)(state)
        self._actions = (
            np.zeros((config.envs_per_gmi, spec.action_size), np.float32),
            np.zeros(config.envs_per_gmi, np.float32),
        )
        self._no_counts = no_counts(spec, share.env.overflows)
        program = jax.jit(partial(simulate, share.env, share.keep), donate_argnums=(1,))
        self._program = compile_once(
            program.lower(share.env.model, self._state, self._no_counts, *self._actions)
        )
        self.simulate_s: deque[float] = deque(maxlen=config.latency_steps)
        self.exchange_s: deque[float] = deque(maxlen=config.latency_steps)

    def unrolls(self) -> Iterator[tuple[Step | None, Counts]]:
        """Gives out unrolls one after the other."""
        self._exchange()  # The first observations; the clock of the stages starts after it.
        for _ in range(self._share.num_unrolls):
            if self._share.link.stop_requested:
                break
            yield self._unroll()

    def _unroll(self) -> tuple[Step | None, Counts]:
        counts, steps = self._no_counts, []
        for _ in range(self._share.config.unroll_length):
            started_s = time.perf_counter()
            self._state, self._bits, counts, step = self._program(
                self._share.env.model, self._state, counts, *self._actions
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
        num_envs = self._share.config.envs_per_gmi
        self._actions = (
            action.view(np.float32).reshape(num_envs, -1).copy(),
            log_prob.view(np.float32).copy(),
        )


def run_agent(share: Share, simulators: Sequence[Peer]) -> dict[str, Any]:
    """Answers the simulators until all have closed; the outcome for `result.json`."""
    share.link.begin_compiling()
    started_s = time.monotonic()
    agent = _Agent(share)
    compile_s = time.monotonic() - started_s - share.link.start_s["waiting"]
    share.link.beat("ready", 0)
    share.barrier()
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
        share.link.beat("running", answered)
    for peer in simulators:
        peer.close()
    return {
        "status": "stopped" if share.link.stop_requested else "completed",
        "compile_s": compile_s,
        "answered": answered,
        "stages_s": {"infer": list(agent.infer_s)},
    }


class _Agent:
    """The compiled agent of several simulators; `infer_s`: seconds of its latest answers."""

    def __init__(self, share: Share) -> None:
        num_envs, obs_size = share.config.envs_per_gmi, share.env.spec.obs_size
        keys = jax.random.split(jax.random.key(0), num_envs)
        obs, bits = np.zeros((num_envs, obs_size), np.float32), jax.random.key_data(keys)
        program = jax.jit(partial(infer, share.policy))
        self.infer_s: deque[float] = deque(maxlen=share.config.latency_steps)
        self._weights = share.policy.weights
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


def _stacked(steps: Sequence[Step]) -> Step:
    """Steps [T, N] from T steps [N]."""
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *steps)
