"""A run by FastTD3 (github.com/younggyoseo/FastTD3): `python -m benchmarks.peers.fast_td3 IN OUT`.

IN is a JSON file with `checkout`, the folder of FastTD3, `impl` of MJX and `flags` of its
`train.py`; OUT gets the curve, seconds since the start and environment steps by then, and the mean
return of the training's episodes between two points. The script runs as it is, but:

- FastTD3 wants a version of MuJoCo Playground of its own, which keeps the last observations of an
  episode. Here Playground's wrapper keeps them, without the terms of the reward, which that
  version fetches one by one after every step;
- environments have the MJX implementation that ours have, and do not print;
- Weights & Biases is not needed: it stays switched off, and is an empty module.
"""

from __future__ import annotations

import importlib
import json
import os
import runpy
import sys
import time
from pathlib import Path
from types import ModuleType
from typing import Any

from gmijax.sim.adapters.playground_package import import_playground

POINTS = 60


class Curve:
    """Points of a training's curve, each from when the GPU is done with what it counts.

    Args:
      num_envs: environments N.
      rounds: steps of all environments that the training makes.
    """

    def __init__(self, num_envs: int, rounds: int) -> None:
        self._started_s, self._num_envs = time.monotonic(), num_envs
        self._every, self._rounds = max(1, rounds // POINTS), 0
        self._returned: Any = 0.0
        self._ended: Any = 0.0
        self.points: list[tuple[float, int]] = []
        self.returns: list[tuple[float, float]] = []

    def add(self, ended: Any, episode_return: Any) -> None:
        """A step of all environments: 1 where an episode ended [N], returns until then [N]."""
        self._returned += (episode_return * ended).sum()
        self._ended += ended.sum()
        self._rounds += 1
        if self._rounds % self._every:
            return
        episodes, returned = float(self._ended), float(self._returned)  # Waits for the GPU.
        now_s = time.monotonic() - self._started_s
        self.points.append((now_s, self._rounds * self._num_envs))
        if episodes:
            self.returns.append((now_s, returned / episodes))
        self._returned = self._ended = 0.0


def main() -> int:
    """Trains, and writes the curve."""
    settings = json.loads(Path(sys.argv[1]).read_text())
    out, folder = Path(sys.argv[2]).absolute(), Path(settings["checkout"]).absolute() / "fast_td3"
    has_gpu = importlib.import_module("torch").cuda.is_available()
    flags = {**settings["flags"], "cuda": has_gpu}
    curve = Curve(flags["num-envs"], flags["total-timesteps"])
    sys.modules["wandb"] = ModuleType("wandb")
    sys.path.insert(0, str(folder))
    os.chdir(out.parent)  # It writes the policy into `models`.
    patch_environments(settings["impl"], curve, has_gpu=has_gpu)
    sys.argv = ["train.py", *words(flags)]
    runpy.run_path(str(folder / "train.py"), run_name="__main__")
    out.write_text(json.dumps({"curve": curve.points, "returns": curve.returns}))
    return 0


def words(flags: dict[str, Any]) -> list[str]:
    """The words of a command line, from the values of flags by their names."""
    made = []
    for name, value in flags.items():
        if isinstance(value, bool):
            made.append(f"--{name}" if value else f"--no-{name}")
        else:
            made += [f"--{name}", str(value)]
    return made


def patch_environments(impl: str, curve: Curve, *, has_gpu: bool) -> None:
    """Makes Playground what FastTD3's `make_env` asks for; `curve` gets every step."""
    # By name: not all of it is installed where gmijax is checked.
    jax, torch, adapter = (
        importlib.import_module(name)
        for name in ("jax", "torch", "gmijax.sim.adapters.playground")
    )
    theirs: Any = importlib.import_module("environments.mujoco_playground_env")
    torch_wrapper: Any = theirs.wrapper_torch
    registry = import_playground().registry
    to_torch, load, make_env = torch_wrapper._jax_to_torch, registry.load, theirs.make_env

    def load_as_ours(name: str, config: Any) -> Any:
        config.impl = impl
        env = load(name, config=config)
        return adapter.without_warnings(env) if impl == "warp" else env

    class Wrapper(torch_wrapper.RSLRLBraxWrapper):
        def __init__(self, *given: Any, **named: Any) -> None:
            super().__init__(*given, **named)
            self.env.env = _keeping_last_obs(self.env.env)

        def step(self, action: Any) -> tuple[Any, ...]:
            action = torch_wrapper._torch_to_jax(torch.clip(action, -1.0, 1.0))
            state = self.env_state = self.step_fn(self.env_state, action)
            read = jax.tree.map(to_torch, (state.obs, state.info["last_obs"], state.reward))
            obs, last, reward = read
            done, truncation = to_torch(state.done), to_torch(state.info["truncation"])
            curve.add(done, to_torch(state.info["episode_metrics"]["sum_reward"]))
            raw = {"obs": last["state"], "critic_obs": last["privileged_state"]}
            kept = {"critic": obs["privileged_state"], "raw": raw}
            return obs["state"], reward, done, {"time_outs": truncation, "observations": kept}

        def reset_with_critic_obs(self) -> tuple[Any, Any]:
            obs = super().reset()
            return obs["state"], obs["privileged_state"]

    def make_env_here(*given: Any, **named: Any) -> Any:
        *most, rank = given
        return make_env(*most, rank if has_gpu else None, **named)

    registry.load, theirs.make_env = load_as_ours, make_env_here
    torch_wrapper.RSLRLBraxWrapper = Wrapper


def _keeping_last_obs(env: Any) -> Any:
    """`env`, with the observations before a reset in `info`: within what resets."""
    wrapper: Any = importlib.import_module("mujoco_playground._src.wrapper")

    class KeepsLastObs(wrapper.Wrapper):
        def reset(self, rng: Any) -> Any:
            return self._kept(self.env.reset(rng))

        def step(self, state: Any, action: Any) -> Any:
            return self._kept(self.env.step(state, action))

        def _kept(self, state: Any) -> Any:
            return state.replace(info={**state.info, "last_obs": state.obs})

    return KeepsLastObs(env)


if __name__ == "__main__":
    sys.exit(main())
