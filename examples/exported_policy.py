"""Runs an exported policy of ball_balance in MuJoCo itself: no gmijax, no jax.

`python -m gmijax.export run.dir=RUN`, then
`python examples/exported_policy.py RUN/export/STEP/policy.onnx`, with `--view` in MuJoCo's viewer.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import onnxruntime

MODEL = Path(__file__).parents[1] / "gmijax" / "sim" / "assets" / "ball_balance.xml"
STEPS, SUBSTEPS, SPEED = 500, 2, 20.0  # Of an episode, per action; rad/s of an action of 1.
SIZES = 24, 3  # Of an observation and an action.
KNEES, BALL = [f"knee_{leg}" for leg in (1, 2, 3)], "ball"


def reset(data: mujoco.MjData, rng: np.random.Generator) -> None:
    """The tray at rest, and the ball above it, falling inwards."""
    mujoco.mj_resetData(data.model, data)
    angle, distance = rng.uniform(0, 2 * np.pi), rng.uniform(0.001, 0.5)
    outwards = np.array([np.cos(angle), np.sin(angle)])
    speed = rng.uniform(0, 5) * (distance - 0.001) / 0.499
    data.joint(BALL).qpos[:3] = [*(distance * outwards), rng.uniform(1, 2)]
    data.joint(BALL).qvel[:3] = [*(-speed * outwards), -5]


def observe(data: mujoco.MjData) -> np.ndarray:
    """The 24 numbers of docs/tasks.md, as the policy saw them in training."""
    knees = [data.joint(knee) for knee in KNEES]
    sensors = data.sensordata.reshape(3, 2, 3)  # Of every leg a force, then a torque.
    values = [
        *[knee.qpos[0] for knee in knees],
        *[knee.qvel[0] for knee in knees],
        *[*data.joint(BALL).qpos[:3], *data.joint(BALL).qvel[:3]],
        *[*(0.05 * sensors[:, 0, 2]), *(0.05 * sensors[:, 1].ravel())],
    ]
    return np.clip(values, -5, 5).astype(np.float32)


def step(data: mujoco.MjData, action: np.ndarray) -> None:
    """Moves the position targets of the knees, and the physics by one control step."""
    change = SPEED * SUBSTEPS * data.model.opt.timestep * action
    low, high = np.array([data.model.joint(knee).range for knee in KNEES]).T
    data.ctrl = np.clip(data.ctrl + change, low, high)
    mujoco.mj_step(data.model, data, SUBSTEPS)


def reward(data: mujoco.MjData) -> float:
    """1 for a ball at rest in the middle, 0.7 m above the floor."""
    ball = data.joint(BALL)
    distance = np.linalg.norm(ball.qpos[:3] - [0, 0, 0.7])
    return float(1 / (1 + distance) / (1 + np.linalg.norm(ball.qvel[:3])))


def episode(
    policy: onnxruntime.InferenceSession,
    data: mujoco.MjData,
    rng: np.random.Generator,
    show: Callable[[], None] = lambda: None,
) -> float:
    """The return of one episode; calls `show` after every control step."""
    reset(data, rng)
    total = 0.0
    for _ in range(STEPS):
        actions = np.asarray(policy.run(["action"], {"obs": observe(data)[None]})[0])
        step(data, actions[0])
        total += reward(data)
        show()
        if data.joint(BALL).qpos[2] < 0.15:  # It has fallen.
            break
    return total


def main(path: str, *options: str) -> None:
    """Prints the mean return of 64 episodes, or shows episodes until the window is closed."""
    policy = onnxruntime.InferenceSession(path)
    sizes = policy.get_inputs()[0].shape[1], policy.get_outputs()[0].shape[1]
    if sizes != SIZES:
        sys.exit(
            f"{path}: the policy of another task: it has {sizes[0]} observations and {sizes[1]} "
            f"actions, this example {SIZES[0]} and {SIZES[1]}"
        )
    data = mujoco.MjData(mujoco.MjModel.from_xml_path(str(MODEL)))
    rng = np.random.default_rng(0)
    if "--view" not in options:
        returns = [episode(policy, data, rng) for _ in range(64)]
        print(f"return {np.mean(returns):.1f}, standard deviation {np.std(returns):.1f}")
        return
    from mujoco import viewer  # Only here: it wants a screen.

    with viewer.launch_passive(data.model, data) as window:

        def show() -> None:
            window.sync()
            time.sleep(SUBSTEPS * data.model.opt.timestep)

        while window.is_running():
            episode(policy, data, rng, show)


if __name__ == "__main__":
    main(*sys.argv[1:])
