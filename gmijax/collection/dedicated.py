"""The template `tdg`: simulators and agents in GMIs of their own, which talk in every step.

A simulator sends observations [N, O] and the bits of its environments' random keys; the agent of
its GPU answers with actions [N, A] and log densities [N]. An agent serves its simulators in turn,
and ends when all of them have closed their pipes. The pipes lie in host memory, as the paper has
it for GMIs whose memory is isolated (sec. 5.1).
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from gmijax.collection.programs import Counts, Step, infer, next_keys, no_counts, simulate
from gmijax.collection.share import Share
from gmijax.collection.tally import Tally
from gmijax.collectives.pipe import Message, PipeReader, PipeWriter
from gmijax.collectives.pipe_block import PipeBlock
from gmijax.errors import PipeClosed
from gmijax.types import Array


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
        """Waits for the other one's arrays; they are valid until the next call.

        Raises:
          PipeClosed: the other one has ended well.
          PeerLost, CollectiveTimeout: it is gone, or did not answer in time.
        """
        return self._reader.get(self._timeout_s)

    def close(self) -> None:
        """Says that nothing more will be sent."""
        self._writer.close()


class Stages(NamedTuple):
    """Seconds of the latest steps, by what they were spent on.

    Attributes:
      simulate: from actions on the host to observations on the host.
      exchange: from observations on the host to actions on the host: both pipes, the agent, and
        waiting while it serves others.
    """

    simulate: deque[float]
    exchange: deque[float]


def run_simulator(share: Share, agent: Peer) -> dict[str, Any]:
    """Makes the unrolls of this GMI with the actions of `agent`; see `colocated.collect`."""
    share.link.begin_compiling()
    started_s = time.monotonic()
    state = share.reset()
    loop = _Loop(share, agent, state)
    compile_s = time.monotonic() - started_s
    share.link.beat("ready", 0)
    share.meet()
    tally, stopped = loop.run()
    agent.close()
    return {
        "status": "stopped" if stopped else "completed",
        "compile_s": compile_s,
        "latency_s": [sum(both) for both in zip(*loop.stages, strict=True)],
        "stages_s": {name: list(times) for name, times in loop.stages._asdict().items()},
        **tally.outcome(),
    }


class _Loop:
    """The steps of one simulator."""

    def __init__(self, share: Share, agent: Peer, state: Any) -> None:
        config, spec = share.config, share.env.spec
        self._share = share
        self._agent = agent
        self._state, self._bits = jax.jit(next_keys)(state)
        self._actions = (
            np.zeros((config.envs_per_gmi, spec.action_size), np.float32),
            np.zeros(config.envs_per_gmi, np.float32),
        )
        program = jax.jit(partial(simulate, share.env, share.keep), donate_argnums=(1,))
        self._program = program.lower(
            share.env.model, self._state, no_counts(share.env), *self._actions
        ).compile()
        timed = config.latency_steps
        self.stages = Stages(deque(maxlen=timed), deque(maxlen=timed))

    def run(self) -> tuple[Tally, bool]:
        share = self._share
        tally = Tally(share.link, share.env.spec.name, share.steps_per_unroll)
        stopped = False
        try:
            self._exchange()  # The first observations; the clock of the stages starts after it.
            for _ in range(share.num_unrolls):
                if stopped := share.link.stop_requested:
                    break
                tally.add(self._unroll())
            if share.writer is not None:
                share.writer.wait()
        finally:
            tally.close()
        return tally, stopped

    def _unroll(self) -> Counts:
        counts, steps = no_counts(self._share.env), []
        for _ in range(self._share.config.unroll_length):
            started_s = time.perf_counter()
            self._state, self._bits, counts, step = self._program(
                self._share.env.model, self._state, counts, *self._actions
            )
            jax.block_until_ready((self._state.env.obs, self._bits))
            simulated_s = time.perf_counter()
            self._exchange()
            self.stages.simulate.append(simulated_s - started_s)
            self.stages.exchange.append(time.perf_counter() - simulated_s)
            if step is not None:
                steps.append(step)
        if self._share.writer is not None:
            self._share.writer.write(_stacked(steps))
        return counts

    def _exchange(self) -> None:
        self._agent.send(np.asarray(self._state.env.obs), np.asarray(self._bits))
        action, log_prob = self._agent.recv().parts
        # Copies: the pipe's memory is used again, and jax may keep what it is given.
        num_envs = self._share.config.envs_per_gmi
        self._actions = (
            action.view(np.float32).reshape(num_envs, -1).copy(),
            log_prob.view(np.float32).copy(),
        )


def run_agent(share: Share, simulators: Sequence[Peer]) -> dict[str, Any]:
    """Answers the simulators until all have closed; what came of it, for `result.json`."""
    share.link.begin_compiling()
    started_s = time.monotonic()
    num_envs, obs_size = share.config.envs_per_gmi, share.env.spec.obs_size
    bits = np.asarray(jax.random.key_data(jax.random.split(jax.random.key(0), num_envs)))
    program: Any = (
        jax.jit(partial(infer, share.policy))
        .lower(share.policy.weights, np.zeros((num_envs, obs_size), np.float32), bits)
        .compile()
    )
    compile_s = time.monotonic() - started_s
    infer_s: deque[float] = deque(maxlen=share.config.latency_steps)
    share.link.beat("ready", 0)
    share.meet()
    answered, left = 0, list(simulators)
    while left:
        for peer in tuple(left):
            try:
                obs, keys = peer.recv().parts
            except PipeClosed:
                left.remove(peer)
                continue
            began_s = time.perf_counter()
            action, log_prob = program(
                share.policy.weights,
                obs.view(np.float32).reshape(num_envs, obs_size),
                keys.view(np.uint32).reshape(bits.shape),
            )
            answer = np.asarray(action), np.asarray(log_prob)
            infer_s.append(time.perf_counter() - began_s)
            peer.send(*answer)
            answered += 1
        share.link.beat("running", answered)
    for peer in simulators:
        peer.close()
    return {
        "status": "stopped" if share.link.stop_requested else "completed",
        "compile_s": compile_s,
        "answered": answered,
        "stages_s": {"infer": list(infer_s)},
    }


def _stacked(steps: Sequence[Step]) -> Step:
    """Steps [T, N] from T steps [N]."""

    def stack(*leaves: Array) -> np.ndarray | Array:
        return np.stack([np.asarray(leaf) for leaf in leaves])

    return jax.tree.map(stack, *steps)
