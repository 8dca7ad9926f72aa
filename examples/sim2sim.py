"""Runs the exported policy of a robot in plain MuJoCo at its real rate: the walking test.

`gmijax export run.dir=RUN format=onnx`, then
`python examples/sim2sim.py RUN/export/STEP/policy.onnx --terrain rough`, or with `--view` in
MuJoCo's viewer. The robots are go1, g1, t1 and spot. No jax here: what the loop of `walk` does
between two steps of the simulator is what a robot's computer does between two readings of its
sensors.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time

import numpy as np

import gmijax
from gmijax.deploy.policy import Policy
from gmijax.errors import ConfigError
from gmijax.player.joystick import Ground
from gmijax.player.joystick_env import JoystickEnv
from gmijax.player.walking import LENGTH_S, Recording, lines_of, measure


def walk(env: JoystickEnv, policy: Policy, steps: int) -> Recording:
    """One start, `steps` control steps."""
    obs, recorded = env.reset(), []
    for _ in range(steps):
        obs, step = env.step(policy(obs))
        recorded.append(step)
    return Recording(*(np.concatenate(parts) for parts in zip(*recorded, strict=True)))


def main() -> int:
    """Prints the walking test, or shows the robot until the window is closed."""
    given = _options()
    policy = gmijax.load_policy(given.policy)
    about = policy.metadata.get("robot")
    if about is None:
        raise ConfigError(f"{given.policy}: not a policy of env=go1, g1, t1 or spot")
    if (about["history"], about["action_repeat"]) != (1, 1):
        raise ConfigError(f"{given.policy}: env.history and env.action_repeat must be 1")
    steps = round(given.seconds / about["control_dt_s"])
    if given.envs < 1 or steps < 1:
        least = f"--seconds {about['control_dt_s']}"
        raise ConfigError(
            f"--envs {given.envs} --seconds {given.seconds:g}: at least --envs 1 and {least}"
        )
    env = JoystickEnv(about, given.terrain, np.random.default_rng(given.seed))
    if given.view:
        _view(env, policy, steps)
        return 0
    walks = [walk(env, policy, steps) for _ in range(given.envs)]
    together = Recording(*(np.concatenate(parts, 1) for parts in zip(*walks, strict=True)))
    found = measure(together, env.robot, Ground(env.model), about["control_dt_s"])
    found = found._replace(settings=about["settings"])
    print("\n".join(lines_of(found.as_json())))
    return 0


def _view(env: JoystickEnv, policy: Policy, steps: int) -> None:
    from mujoco import viewer  # Only here: it wants a screen.

    with viewer.launch_passive(env.model, env.data) as window:
        due_s, obs = time.monotonic(), env.reset()
        for number in itertools.count(1):
            if not window.is_running():
                return
            obs, _ = env.step(policy(obs))
            if number % steps == 0:
                obs = env.reset()
            window.sync()
            due_s += env.control_dt_s  # What the step took is part of its time.
            time.sleep(max(0.0, due_s - time.monotonic()))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("policy", help="policy.onnx of an export")
    parser.add_argument("--terrain", default="flat", choices=["flat", "rough"])
    parser.add_argument("--envs", type=int, default=100, help="how many starts")
    parser.add_argument("--seconds", type=float, default=LENGTH_S, help="of each")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--view", action="store_true", help="in MuJoCo's viewer")
    return parser.parse_args()


if __name__ == "__main__":
    try:
        sys.exit(main())
    except ConfigError as error:
        sys.stderr.write(f"{error}\n")
        sys.exit(2)
