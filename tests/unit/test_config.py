"""Checks of the configuration that need more than a range."""

from __future__ import annotations

import dataclasses
import importlib
from contextlib import suppress
from typing import Any

import jax.numpy as jnp
import pytest
from hydra.core.config_store import ConfigStore

from gmijax.cli.compose import build, compose
from gmijax.config import (
    ADAPTIVE_LEARNING_RATE_RANGE,
    ActorCriticConfig,
    PlayConfig,
    TrainConfig,
)
from gmijax.config.schema import from_dict, to_dict
from gmijax.errors import ConfigError
from gmijax.learning.learner import adapted_learning_rate
from gmijax.sim.registry import TASKS, task_names
from gmijax.sim.tasks.settings import SETTINGS


def test_numbers_are_finite():
    data: dict[str, Any] = to_dict(compose())
    for value in (float("inf"), float("nan")):
        with pytest.raises(ConfigError, match=r"^seed=.*: expected an integer$"):
            from_dict(TrainConfig, {**data, "seed": value})
    for value in (float("inf"), float("-inf"), float("nan"), 10**400):
        data["reduce"]["timeout_s"] = value
        with pytest.raises(ConfigError, match=r"^reduce\.timeout_s=.*: expected a finite number$"):
            from_dict(TrainConfig, data)


@pytest.mark.parametrize("key", ["cluster.address", "wandb.project"])
def test_a_text_that_is_not_null_is_not_empty(key: str):
    for given in ("", "' '"):
        with pytest.raises(ConfigError, match=rf"^{key}=\s?: must not be empty$"):
            compose(f"{key}={given}")


@pytest.mark.parametrize("rate", [9e-6, 0.011])
def test_adaptive_learning_rate_begins_where_it_is_kept(rate: float):
    algo = compose("algo.learning_rate_schedule=adaptive_kl").algo
    with pytest.raises(
        ConfigError, match=r"learning_rate=.* must be between 1e-05 and 0\.01 with"
    ):
        dataclasses.replace(algo, learning_rate=rate)
    dataclasses.replace(algo, learning_rate=rate, learning_rate_schedule="fixed")


@pytest.mark.parametrize("end", [0, 1])
def test_limits_are_those_of_the_learner(end: int):
    limit, kl = ADAPTIVE_LEARNING_RATE_RANGE[end], (1.0, 1e-9)[end]
    kept = adapted_learning_rate(jnp.float32(limit), jnp.float32(kl), 0.01)
    assert float(kept) == pytest.approx(limit)


@pytest.mark.parametrize("group", ["plan", "reduce", "run", "eval", "search", "channel", "wandb"])
def test_a_default_is_the_same_in_code_and_on_the_command_line(group: str):
    """But for groups whose defaults differ from task to task."""
    composed = getattr(compose(), group)
    for field in dataclasses.fields(composed):
        if field.default is not dataclasses.MISSING:
            assert (field.name, field.default) == (field.name, getattr(composed, field.name))


@pytest.mark.parametrize("task", task_names())
def test_weights_and_settings_are_those_of_the_task(task: str):
    composed = compose(f"env={task}").env
    terms = importlib.import_module(TASKS[task]).TERMS
    assert composed.rewards == {name: term.weight for name, term in terms.items()}
    assert composed.settings == dataclasses.asdict(SETTINGS[task]())


def test_names_of_a_custom_task_are_free():
    overrides = ("env=some.py:make", "env.rewards.near=2", "env.settings.length_m=0.5")
    config = compose(*overrides).env
    assert (config.rewards, config.settings) == ({"near": 2.0}, {"length_m": 0.5})


# Hidden layers in Table 6 of the paper; 256:128:64 for all others.
WIDTHS = {"humanoid": (200, 400, 100), "shadow_hand": (512, 512, 512, 256)}


@pytest.mark.parametrize("task", task_names())
def test_every_task_has_the_papers_networks_and_one_scale_of_rewards(task: str):
    settings = [compose(f"env={task}", f"algo={algo}").algo for algo in ("ppo", "a3c")]
    wanted = WIDTHS.get(task, (256, 128, 64))
    assert all(algo.hidden_layer_sizes == (wanted, wanted) for algo in settings)
    scales = {algo.reward_scaling for algo in settings if isinstance(algo, ActorCriticConfig)}
    assert len(scales) == 1


def test_steps_of_serving_are_split_over_the_gmis_that_simulate():
    config = compose("policy=random", "num_envs=8", "num_timesteps=100", command="serve")
    assert config.unroll_length == 64
    assert config.unrolls_per_gmi(1) == 1
    short = dataclasses.replace(config, unroll_length=2)
    assert short.unrolls_per_gmi(2) == 4  # 4 x 2 GMIs x 8 x 2 = 128 >= 100


def test_a_pipe_takes_two_steps_of_a_thousand_numbers_per_environment():
    config = compose("policy=random", "num_envs=4096", command="serve")
    assert config.pipe_bytes >= 2 * 4096 * 1000 * 4


def test_undecided_numbers_are_refused_where_numbers_are_needed():
    for config in (
        compose(command="search"),
        compose("num_envs=auto", "policy=random", command="serve"),
    ):
        with pytest.raises(ConfigError, match="num_envs=auto: not decided yet"):
            _ = config.envs_per_gmi


def test_a_film_names_the_keys_that_make_another_film_than_the_default():
    assert not build("play", PlayConfig, ()).film_overrides()
    other = ("num_envs=4", "seed=3", "deterministic=false", "camera=side", "width=320", "html=off")
    assert build("play", PlayConfig, other).film_overrides() == (
        " num_envs=4 seed=3 deterministic=false camera=side"
    )


@pytest.mark.parametrize("override", ["num_envs=3", "num_envs=3.5x", "no_key=1"])
def test_jobs_of_hydra_in_the_same_process_keep_their_settings(override: str):
    def settings() -> list[Any]:
        return list(ConfigStore.instance().load("hydra/config.yaml").node.defaults)

    before = settings()
    with suppress(ConfigError):
        compose(override)
    assert settings() == before != []
