"""Runs the exported policy of a robot in plain MuJoCo at its real rate: the walking test.

`gmijax export run.dir=RUN format=onnx`, then
`python examples/sim2sim.py RUN/export/STEP/policy.onnx --terrain rough`, or with `--view` in
MuJoCo's viewer. The robots are go1, g1, t1 and spot. No jax here: what the loop of `walk` does
between two steps of the simulator is what a robot's computer does between two readings of its
sensors.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable

import numpy as np

import gmijax
from gmijax.deploy.policy import Policy
from gmijax.errors import ConfigError
from gmijax.player.joystick import Ground
from gmijax.player.joystick_env import JoystickEnv
from gmijax.player.walking import LENGTH_S, Recording, lines_of, measure


def walk(
    env: JoystickEnv, policy: Policy, steps: int, show: Callable[[], None] = lambda: None
) -> Recording:
    """One start, `steps` control steps; calls `show` after each."""
    obs, recorded = env.reset(), []
    for _ in range(steps):
        obs, step = env.step(policy(obs))
        recorded.append(step)
        show()
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
    env = JoystickEnv(about, given.terrain, np.random.default_rng(given.seed))
    if given.view:
        _view(env, policy)
        return 0
    steps = round(given.seconds / about["control_dt_s"])
    walks = [walk(env, policy, steps) for _ in range(given.envs)]
    together = Recording(*(np.concatenate(parts, 1) for parts in zip(*walks, strict=True)))
    found = measure(together, env.robot, Ground(env.model), about["control_dt_s"])
    print("\n".join(lines_of(found.as_json())))
    return 0


def _view(env: JoystickEnv, policy: Policy) -> None:
    from mujoco import viewer  # Only here: it wants a screen.

    with viewer.launch_passive(env.model, env.data) as window:

        def show() -> None:
            window.sync()
            time.sleep(env.control_dt_s)

        while window.is_running():
            walk(env, policy, round(LENGTH_S / env.control_dt_s), show)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("policy", help="policy.onnx of an export")
    parser.add_argument("--terrain", default="flat", choices=["flat", "rough"])
    parser.add_argument("--envs", type=int, default=20, help="how many starts")
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
