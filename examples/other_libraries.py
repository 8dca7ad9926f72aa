"""Trains `ball_balance` with PPO of another library: Stable-Baselines3, rsl_rl or skrl.

    pip install 'gmijax[gymnasium]' stable-baselines3
    python examples/other_libraries.py sb3

Prints the mean return of the first and of the last episodes. On a CPU see
docs/other-libraries.md for what XLA needs in the environment.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence

import gmijax

TASK = "ball_balance"
# With 1.0, which libraries start from, the noise alone throws the ball off.
NOISE_STD = 0.4
UNROLL = 16


def sb3(num_envs: int, num_steps: int) -> Sequence[float]:
    """Returns of all episodes while Stable-Baselines3 trains."""
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecNormalize

    envs = VecNormalize(gmijax.make_vector_env(TASK, num_envs, api="sb3"))
    model = PPO(
        "MlpPolicy",
        envs,
        n_steps=UNROLL,
        batch_size=num_envs * UNROLL // 4,
        n_epochs=4,
        policy_kwargs={"log_std_init": math.log(NOISE_STD)},
        stats_window_size=10**6,
        device="cpu",
        seed=0,
    )
    model.learn(num_steps)
    return [episode["r"] for episode in model.ep_info_buffer or ()]


def rsl_rl(num_envs: int, num_steps: int) -> Sequence[float]:
    """Returns of all episodes while rsl_rl trains."""
    from rsl_rl.runners import OnPolicyRunner

    envs = gmijax.make_vector_env(TASK, num_envs, api="rsl_rl")
    network = {"class_name": "MLPModel", "hidden_dims": [64, 64], "obs_normalization": True}
    noise = {"class_name": "GaussianDistribution", "init_std": NOISE_STD}
    settings = {
        "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
        "num_steps_per_env": UNROLL,
        "save_interval": 10**6,
        "actor": {**network, "distribution_cfg": noise},
        "critic": network,
        "algorithm": {
            "class_name": "PPO",
            "num_learning_epochs": 4,
            "num_mini_batches": 4,
            "learning_rate": 3e-4,
        },
    }
    runner = OnPolicyRunner(envs, settings, log_dir="runs/rsl_rl", device=str(envs.device))
    returns: list[float] = []
    for _ in range(max(1, num_steps // (num_envs * UNROLL))):
        runner.logger.rewbuffer.clear()
        runner.learn(1)
        returns += runner.logger.rewbuffer
    return returns


def skrl(num_envs: int, num_steps: int) -> Sequence[float]:
    """Returns of all episodes while skrl trains."""
    import torch
    from gymnasium.wrappers.vector import RecordEpisodeStatistics
    from skrl.agents.torch.ppo import PPO, PPO_CFG
    from skrl.envs.wrappers.torch import wrap_env
    from skrl.memories.torch import RandomMemory
    from skrl.trainers.torch import SequentialTrainer, SequentialTrainerCfg
    from skrl.utils.model_instantiators.torch import deterministic_model, gaussian_model

    counted = RecordEpisodeStatistics(gmijax.make_vector_env(TASK, num_envs), buffer_length=10**6)
    envs = wrap_env(counted)
    spaces = {
        "observation_space": envs.observation_space,
        "action_space": envs.action_space,
        "device": envs.device,
        "network": [
            {"name": "net", "input": "OBSERVATIONS", "layers": [64, 64], "activations": "tanh"}
        ],
    }
    models = {
        "policy": gaussian_model(
            **spaces, output="ACTIONS", initial_log_std=math.log(NOISE_STD), clip_actions=False
        ),
        "value": deterministic_model(**spaces, output="ONE"),
    }
    settings = PPO_CFG(
        rollouts=UNROLL,
        learning_epochs=4,
        mini_batches=4,
        learning_rate=3e-4,
        time_limit_bootstrap=True,
    )
    agent = PPO(
        models=models,
        memory=RandomMemory(memory_size=UNROLL, num_envs=num_envs, device=envs.device),
        observation_space=envs.observation_space,
        action_space=envs.action_space,
        device=envs.device,
        cfg=settings,
    )
    torch.manual_seed(0)
    trainer = SequentialTrainer(
        env=envs,
        agents=agent,
        cfg=SequentialTrainerCfg(timesteps=num_steps // num_envs, headless=True),
    )
    trainer.train()
    return [float(value) for value in counted.return_queue]


def main() -> None:
    """Trains with the library that the command line names."""
    libraries = {"sb3": sb3, "rsl_rl": rsl_rl, "skrl": skrl}
    parser = argparse.ArgumentParser(description="PPO of another library")
    parser.add_argument("library", choices=libraries)
    parser.add_argument("--num-envs", type=int, default=128)
    parser.add_argument("--num-steps", type=int, default=300_000)
    options = parser.parse_args()
    returns = libraries[options.library](options.num_envs, options.num_steps)
    part = min(options.num_envs, max(1, len(returns) // 2))
    first, last = (sum(some) / part for some in (returns[:part], returns[-part:]))
    print(f"{options.library}: {len(returns)} episodes; return of the first {part}: {first:.1f},")
    print(f"of the last {part}: {last:.1f}")


if __name__ == "__main__":
    main()
