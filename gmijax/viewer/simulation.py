"""A few environments with one policy, step by step. No jax and no viser here."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import mujoco
import numpy as np
import numpy.typing as npt

from gmijax.player.plain_env import PlainEnv
from gmijax.sim.camera import free_robot
from gmijax.sim.stage import body_poses, put
from gmijax.viewer.pull import Pull
from gmijax.viewer.requests import Drag

Floats: TypeAlias = npt.NDArray[np.floating]
Policy: TypeAlias = Callable[[Any], Floats]
"""Actions [E, A] for observations [E, O]."""


class Episode(NamedTuple):
    """How an episode goes.

    Attributes:
      steps: control steps that it has taken.
      sums: every term of the reward by name, summed over them.
      now: the same of the last of them.
      number: of the episode in its environment, from 1.
      last_return: of the episode before it; None: there was none.
    """

    steps: int
    sums: dict[str, float]
    now: dict[str, float]
    number: int
    last_return: float | None


class Simulation:
    """Environments of one task that a policy acts in.

    Args:
      envs: E of them, of the same task.
      policy: acts in all of them.
      seed: of the directions of pushes.
    """

    def __init__(self, envs: Sequence[PlainEnv], policy: Policy, seed: int) -> None:
        self.envs, self.policy = envs, policy
        self.episodes = [self._first(1, None) for _ in envs]
        self._command: Floats | None = None
        self._pulls: dict[int, Pull] = {}
        self._torn_off: set[int] = set()
        self._pushes: dict[int, Floats] = {}
        self._pushed_lately: dict[int, tuple[int, Floats]] = {}
        self._rng, self.steps = np.random.default_rng(seed), 0
        self._shown = mujoco.MjData(self.model)
        self.pushed = pushed_body(self.model)
        self.reset()

    @property
    def model(self) -> Any:
        """The `mujoco.MjModel` of all environments."""
        return self.envs[0].model

    @property
    def control_dt_s(self) -> float:
        """Simulated seconds of a step."""
        return self.envs[0].spec.control_dt_s

    def reset(self) -> None:
        """Begins the next episode everywhere; lets go of what is pulled."""
        for number in range(len(self.envs)):
            self._begin(number)

    def step(self) -> None:
        """One control step of all environments; episodes that end are followed by others."""
        actions = self.policy(np.stack([env.obs for env in self.envs]))
        self.steps += 1
        for number, (env, action) in enumerate(zip(self.envs, actions, strict=True)):
            forces = env.data.xfrc_applied
            forces[:] = 0.0
            if (pull := self._pulls.get(number)) is not None:
                pull.apply()
            if (push := self._pushes.pop(number, None)) is not None:
                # The whole change within one control step.
                mass = self.model.body_subtreemass[self.pushed]
                forces[self.pushed, :3] += mass * push / self.control_dt_s
                self._pushed_lately[number] = (self.steps, push)
            done = env.step(action)
            forces[:] = 0.0
            self._count(number, done.terms)
            if done.terminated or done.truncated:
                self._begin(number)

    def push(self, env: int, speed_m_per_s: float) -> None:
        """Changes the velocity of a robot by so much in the next step, to a side by chance."""
        angle = self._rng.uniform(0.0, 2.0 * np.pi)
        self._pushes[env] = speed_m_per_s * np.array([np.cos(angle), np.sin(angle), 0.0])

    def drag(self, drag: Drag) -> None:
        """Pulls at a body, or lets go."""
        if drag.pointer is None:
            self._pulls.pop(drag.env, None)
            self._torn_off.discard(drag.env)
            return
        if drag.env in self._torn_off:
            return
        pull = self._pulls.get(drag.env)
        if pull is None or pull.body != drag.body:
            env = self.envs[drag.env]
            put(self._shown, env.qpos)
            mujoco.mj_fwdPosition(self.model, self._shown)
            pull = Pull(self.model, env.data, self._shown, drag.body, drag.grabbed)
            self._pulls[drag.env] = pull
        pull.pointer = drag.pointer

    def set_command(self, command: Sequence[float] | None) -> None:
        """Commands all robots; None: what the task draws, from the next episode on."""
        self._command = None if command is None else np.array(command, np.float32)
        for env in self.envs:
            self._apply_command(env)

    def pushed_lately(self) -> dict[int, Floats]:
        """Changes of velocity [3] by pushes of the last half of a second, m/s, by environment."""
        steps = int(0.5 / self.control_dt_s)
        lately = self._pushed_lately.items()
        return {env: push for env, (at, push) in lately if self.steps - at < steps}

    def poses(self) -> tuple[Floats, Floats]:
        """Positions [E, B, 3], m, and orientations [E, B, 4] of all bodies."""
        # Those of `env.data` are of before the last physics step.
        found = [body_poses(self.model, self._shown, env.qpos) for env in self.envs]
        return np.stack([xpos for xpos, _ in found]), np.stack([xquat for _, xquat in found])

    def _begin(self, number: int) -> None:
        before = self.episodes[number]
        if self._pulls.pop(number, None) is not None:
            self._torn_off.add(number)  # Until the mouse lets go: the body is elsewhere now.
        self._pushes.pop(number, None)
        self._pushed_lately.pop(number, None)
        self.envs[number].reset()
        ended = sum(before.sums.values()) if before.steps else before.last_return
        self.episodes[number] = self._first(before.number + bool(before.steps), ended)
        self._apply_command(self.envs[number])

    def _first(self, number: int, last_return: float | None) -> Episode:
        names = self.envs[0].spec.reward_terms
        return Episode(
            0, dict.fromkeys(names, 0.0), dict.fromkeys(names, 0.0), number, last_return
        )

    def _count(self, number: int, terms: dict[str, float]) -> None:
        before = self.episodes[number]
        sums = {name: before.sums[name] + value for name, value in terms.items()}
        self.episodes[number] = before._replace(steps=before.steps + 1, sums=sums, now=terms)

    def _apply_command(self, env: PlainEnv) -> None:
        if self._command is not None:
            env.command = self._command


def pushed_body(model: Any) -> int:
    """What a push is given to: a thing that lies free, else the robot, else the last body."""
    robot = free_robot(model)
    free = model.jnt_bodyid[model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)].tolist()
    things = [body for body in free if body != robot]
    return next(iter(things), model.nbody - 1 if robot is None else robot)
