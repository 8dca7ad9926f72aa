"""A run by mjlab with rsl_rl: `python -m benchmarks.peers.mjlab_ppo IN OUT`.

IN is a JSON file with `task`, `num_envs`, `iterations` and `seed`; OUT gets the curve, seconds
since the start and environment steps by then. It runs in an environment with mjlab, which pins
another MuJoCo than gmijax does, so it imports nothing of gmijax.
"""

from __future__ import annotations

import importlib
import json
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any


def main() -> int:
    """Trains, and writes the curve."""
    started_s = time.monotonic()
    settings = json.loads(Path(sys.argv[1]).read_text())
    runner = make_runner(settings["task"], settings["num_envs"], settings["seed"])
    steps = settings["num_envs"] * runner.cfg["num_steps_per_env"]
    curve: list[tuple[float, int]] = []
    update = runner.alg.update

    def timed_update() -> Any:
        losses = update()  # As numbers of the host, so the GPU is done.
        curve.append((time.monotonic() - started_s, steps * (len(curve) + 1)))
        return losses

    runner.alg.update = timed_update
    runner.learn(settings["iterations"], init_at_random_ep_len=True)
    Path(sys.argv[2]).write_text(json.dumps({"curve": curve}))
    return 0


def make_runner(task: str, num_envs: int, seed: int) -> Any:
    """What mjlab's training script makes, without logs and checkpoints."""
    envs, registry, rl, torch = (
        importlib.import_module(name)
        for name in ("mjlab.envs", "mjlab.tasks.registry", "mjlab.rl", "torch")
    )
    importlib.import_module("mjlab.tasks")  # Fills the registry.
    importlib.import_module("mjlab.utils.torch").configure_torch_backends()
    device = "cuda:0" if torch.cuda.is_available() else "cpu"
    env_config, agent = registry.load_env_cfg(task), registry.load_rl_cfg(task)
    env_config.scene.num_envs = num_envs
    env_config.seed = agent.seed = seed
    env = rl.RslRlVecEnvWrapper(
        envs.ManagerBasedRlEnv(cfg=env_config, device=device), clip_actions=agent.clip_actions
    )
    runner = registry.load_runner_cls(task) or rl.MjlabOnPolicyRunner
    return runner(env, asdict(agent), None, device)


if __name__ == "__main__":
    sys.exit(main())
