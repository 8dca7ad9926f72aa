"""Tasks of the user's own and of Brax, trained as users do it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from command_lines import run as run_here
from training_jobs import train

pytestmark = pytest.mark.timeout(600)

TASK = """
import jax
import jax.numpy as jnp
from gmijax.sim import episode
from gmijax.sim.interface import Env, EnvSpec

SPEC = EnvSpec("point", 1, 1, 0.1, 5, ("near", "effort"))

def make(*, impl, max_envs, settings={"pace": 0.1}):
    def reset(model, key):
        key, draw = jax.random.split(key)
        start = jax.random.uniform(draw, (1,))
        return episode.begin(SPEC, start, (), start, key)

    def step(model, state, action):
        moved = state.physics + settings["pace"] * action
        terms = {"near": -jnp.abs(moved[0]), "effort": -0.1 * action[0] ** 2}
        reward = terms["near"] + terms["effort"], terms
        return episode.advance(state, moved, (), moved, reward, moved[0] > 3.0)

    return Env(SPEC, (), reset, step, None, lambda state: state.physics)
"""
SMALL = (
    *("num_envs=16", "algo.unroll_length=4", "run.grace_s=3"),
    "run.max_restarts=0",
    *("algo.policy_hidden_layer_sizes=[8]", "algo.value_hidden_layer_sizes=[8]"),
)


def test_a_task_of_ones_own_trains_in_two_gmis_and_resumes(tmp_path: Path):
    file = tmp_path / "point.py"
    file.write_text(TASK)
    changes = ("env.settings.pace=0.1", "env.history=3", "env.action_repeat=2")
    by_pass = "algo.recompute_advantages=true"  # With exchanges between real processes.
    task = ("env=point.py:make", *changes, *SMALL, by_pass, "num_timesteps=256", "plan.gpus=2")
    done = train(*task, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (run,) = (tmp_path / "runs").iterdir()
    assert run.name.startswith("point-ppo-")
    config = json.loads((run / "config.json").read_text())
    assert config["env"]["name"] == f"{file}:make"
    assert len(config["env"]["source_sha256"]) == 64
    line = json.loads((run / "metrics.jsonl").read_text().splitlines()[-1])
    assert line["episode_length"] == 3.0  # Actions, of which the last is taken for one step.
    assert line["return"] == pytest.approx(line["reward/near"] + line["reward/effort"], rel=1e-4)

    file.write_text(TASK.replace('{"near": -', '{"near": jnp.log(-1.0 - 0 * moved[0]) - '))
    again = ("run.resume=last", "num_timesteps=512", "run.name=second")
    refused = run_here("train", *again, cwd=tmp_path)
    assert refused.code == 2
    assert "To use the file as it is now, add env=point.py:make" in refused.stderr
    done = train(*again, "env=point.py:make", cwd=tmp_path)
    assert "custom task: point.py:make has changed since the run was started" in done.stdout
    # The change makes one term not a number: the error names task, step and term.
    assert done.returncode == 1, done.stderr
    assert "NonFiniteError: point.py:make, up to env step 384: 128 of 128 steps" in done.stderr
    assert "in reward/near" in done.stderr


def test_after_a_mistake_in_the_file_the_same_command_trains(tmp_path: Path):
    file = tmp_path / "point.py"
    file.write_text(TASK.replace("jnp.abs", "jnp.abz"))
    command = ("env=point.py:make", *SMALL, "num_timesteps=64", "run.dir=mine")
    refused = train(*command, cwd=tmp_path)
    assert refused.returncode == 2
    assert "has no attribute 'abz'" in refused.stderr
    file.write_text(TASK)
    done = train(*command, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "nothing was trained in mine before" in done.stdout
    assert not list((tmp_path / "mine").rglob("error.json"))
    # What was trained is not replaced.
    assert "exists already" in train(*command, cwd=tmp_path).stderr


@pytest.mark.parametrize("command", ["train", "serve"])
def test_nothing_is_left_of_a_command_whose_task_fails(command: str, tmp_path: Path):
    (tmp_path / "point.py").write_text(f"raise ImportError('{'x' * 400}')")
    own = ("policy=random", "output.dir=data", "run.name=mine") if command == "serve" else ()
    done = train("env=point.py:make", *own, cwd=tmp_path, command=command)
    assert done.returncode == 2
    assert done.stderr.endswith("point.py:1)\n")  # However long the error is.
    assert not list((tmp_path / "runs").iterdir())
    assert not (tmp_path / "data").exists()


def test_files_may_have_the_names_of_packages(tmp_path: Path):
    """Beside the task and in the working directory; the neighbour is the one of the task."""
    for name in ("random", "queue", "statistics", "optax", "flax/__init__", "gmijax/__init__"):
        for folder in (tmp_path, tmp_path / "tasks"):
            file = folder / f"{name}.py"
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text("raise ImportError('not the package')")
    (tmp_path / "utils.py").write_text("raise ImportError('of the working directory')")
    (tmp_path / "tasks" / "utils.py").write_text("PACE = 0.1")
    (tmp_path / "tasks" / "optax.py").write_text(f"from utils import PACE\n{TASK}")
    # As the program `gmijax`, which has no working directory on its path.
    done = train("env=tasks/optax.py:make", *SMALL, "num_timesteps=64", cwd=tmp_path, safe=True)
    assert done.returncode == 0, done.stderr


def test_an_environment_of_brax_trains(tmp_path: Path):
    done = train("env=brax", "env.name=fast", *SMALL, "num_timesteps=64", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (run,) = (tmp_path / "runs").iterdir()
    assert run.name.startswith("brax-fast-ppo-")
    assert json.loads((run / "summary.json").read_text())["env"] == "brax/fast"


def test_what_only_a_gmi_can_know_is_still_bad_input(tmp_path: Path):
    done = train("env=brax", "env.name=antt", cwd=tmp_path)
    assert done.returncode == 2
    assert "env.name=antt: Brax has no such env" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
