"""How the benchmark beside other libraries sets up both sides, counts, and what it keeps."""

from __future__ import annotations

import argparse
import importlib.util
import inspect
import json
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.agents.ppo import networks, train

from benchmarks import records, runner
from benchmarks.evaluation.figures import NOT_MEASURED
from benchmarks.evaluation.page import TABLES
from benchmarks.evaluation.peer_tables import row
from benchmarks.peers import __main__ as peers
from benchmarks.peers import fast_td3, returns
from benchmarks.peers.brax_ppo import replicated
from benchmarks.peers.comparisons import (
    BRAX,
    COMPARISONS,
    FAST_TD3,
    MJLAB,
    OURS,
    REPORTS,
    Comparison,
    brax_training,
)
from benchmarks.peers.fast_td3_flags import fast_td3_training
from benchmarks.peers.side import Side
from benchmarks.records import read_calls
from gmijax.cli.compose import compose
from gmijax.config import RolloutConfig, SacConfig
from gmijax.errors import ConfigError

WITH_BRAX = [name for name, one in COMPARISONS.items() if one.peer == BRAX]


@pytest.mark.parametrize("name", WITH_BRAX)
def test_both_sides_learn_from_as_many_samples(name: str):
    config = compose(*COMPARISONS[name].overrides)
    assert isinstance(config.algo, RolloutConfig)
    arguments = brax_training(COMPARISONS[name]).arguments
    minibatch = arguments["batch_size"] * arguments["unroll_length"]
    assert arguments["num_envs"] == config.num_envs
    iteration = config.num_envs * config.algo.unroll_length
    assert minibatch * arguments["num_minibatches"] == iteration
    assert arguments["num_minibatches"] == config.algo.num_minibatches
    assert arguments["num_updates_per_batch"] == config.algo.num_updates_per_batch
    # What Brax asserts, and that all parts of its training have as many iterations.
    assert arguments["batch_size"] * arguments["num_minibatches"] % arguments["num_envs"] == 0
    assert arguments["num_timesteps"] % (REPORTS * iteration) == 0
    assert 0.5 < arguments["num_timesteps"] / config.num_timesteps < 1.5


@pytest.mark.parametrize("name", WITH_BRAX)
def test_brax_has_all_arguments_that_it_gets(name: str):
    training = brax_training(COMPARISONS[name])
    assert training.arguments.keys() <= inspect.signature(train.train).parameters.keys()
    taken = inspect.signature(networks.make_ppo_networks).parameters
    assert training.networks.keys() <= taken.keys()
    # Its distribution through tanh always has a standard deviation of its own in every state.
    if training.networks["distribution_type"] == "tanh_normal":
        assert training.networks["state_dependent_std"]


def test_a_short_training_has_the_same_parts():
    whole, short = (brax_training(COMPARISONS["Brax's ant"], reports=n).arguments for n in (10, 2))
    assert whole["num_timesteps"] == 5 * short["num_timesteps"]
    assert (whole["num_evals"] - 1, short["num_evals"] - 1) == (10, 2)


def test_mjlab_gets_as_many_environments_and_steps_and_no_packages_of_ours(tmp_path: Path):
    name = "anymal, and mjlab's Go1"
    side = Side(name, MJLAB, ("num_envs=1024",), where="/mjlab/bin/python")
    assert (side.settings["num_envs"], side.settings["iterations"]) == (
        1024,
        round(10e6 / 1024 / 24),
    )
    words = side.short_command(tmp_path, has_gpu=True)
    assert words[:3] == ["/mjlab/bin/python", "-m", "benchmarks.peers.mjlab_ppo"]
    assert json.loads(Path(words[3]).read_text())["iterations"] == 2
    assert Path(side.variables(tmp_path, is_short=False)["PYTHONPATH"], "benchmarks").is_dir()
    cells = row({}, name)
    assert (cells[1], cells[4]) == ("mjlab", "another task")


OFF_POLICY = "Go1, off-policy"


def test_fast_td3_draws_as_many_transitions_for_each_that_it_makes(tmp_path: Path):
    config = compose(*COMPARISONS[OFF_POLICY].overrides)
    assert isinstance(config.algo, SacConfig)
    side = Side(OFF_POLICY, FAST_TD3, where="/FastTD3")
    flags = side.settings["flags"]
    assert flags["num-envs"] == config.num_envs
    assert flags["batch-size"] * flags["num-updates"] == 8 * flags["num-envs"]
    assert flags["num-updates"] == config.algo.updates_per_step
    assert flags["policy-frequency"] == config.algo.policy_every
    assert flags["total-timesteps"] == round(6e6 / 4096)
    assert (flags["critic-hidden-dim"], flags["actor-hidden-dim"]) == (768, 512)
    assert (flags["env-name"], flags["amp"]) == ("Go1JoystickFlatTerrain", True)
    assert config.env.settings["push"] == 0
    words = side.short_command(tmp_path, has_gpu=True)
    assert words[:3] == [sys.executable, "-m", "benchmarks.peers.fast_td3"]
    settings = json.loads(Path(words[3]).read_text())
    assert (settings["checkout"], settings["impl"]) == ("/FastTD3", "warp")
    # Learning has begun, so that its programs are compiled too.
    assert settings["flags"]["total-timesteps"] > flags["learning-starts"] + 2


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("algo=ppo", "algo=ppo: FastTD3 is compared with sac"),
        ("algo.batch_size=5000", "as many from each of num_envs=4096"),
        ("algo.critic_hidden_layer_sizes=[512,512]", "FastTD3 has three layers"),
    ],
)
def test_settings_that_fast_td3_has_no_flag_for_are_refused(override: str, message: str):
    with pytest.raises(ConfigError, match=re.escape(message)):
        fast_td3_training(COMPARISONS[OFF_POLICY], (override,))


def test_fast_td3_needs_its_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    assert not list(peers.wanted_sides([OFF_POLICY], ()))
    assert "give --fast-td3 the folder of its checkout" in capsys.readouterr().err
    sides = list(peers.wanted_sides([OFF_POLICY], (), {FAST_TD3: "/FastTD3"}))
    assert [side.trainer for side in sides] == [OURS, FAST_TD3]
    monkeypatch.setattr(sys, "argv", ["peers", "--fast-td3", str(tmp_path)])
    with pytest.raises(ConfigError, match=r"has no fast_td3/train\.py"):
        peers.main()


def test_the_curve_of_fast_td3_counts_all_environments_and_ended_episodes(
    monkeypatch: pytest.MonkeyPatch,
):
    clock_s = iter(range(10))
    monkeypatch.setattr(fast_td3.time, "monotonic", lambda: float(next(clock_s)))
    curve = fast_td3.Curve(num_envs=2, rounds=2 * fast_td3.POINTS)
    for ended, returned in [
        ([0, 1], [5, 4]),
        ([0, 0], [6, 1]),
        ([0, 0], [7, 2]),
        ([1, 1], [8, 3]),
    ]:
        curve.add(np.array(ended), np.array(returned))
    assert curve.points == [(1.0, 4), (2.0, 8)]
    assert curve.returns == [(1.0, 4.0), (2.0, 5.5)]


def test_flags_of_fast_td3_are_words():
    words = fast_td3.words({"num-envs": 4, "amp": True, "use-wandb": False})
    assert words == ["--num-envs", "4", "--amp", "--no-use-wandb"]


def test_overrides_change_both_sides_and_bad_ones_are_refused():
    side = Side("ant, MJX-Warp", BRAX, ("num_envs=512", "algo.learning_rate_schedule=fixed"))
    assert side.settings["arguments"]["batch_size"] == 128
    assert side.settings["arguments"]["learning_rate_schedule"] == "NONE"
    assert side._replace(trainer=OURS).settings.endswith("algo.learning_rate_schedule=fixed")
    with pytest.raises(ConfigError, match=r"algo\.unroll_length=81: Brax needs 16 equal unrolls"):
        brax_training(COMPARISONS["Brax's ant"], ("algo.unroll_length=81",))
    with pytest.raises(ConfigError, match="algo=a3c: Brax trains by ppo"):
        brax_training(Comparison(("env=ant", "algo=a3c")))
    with pytest.raises(ConfigError, match="--only 'cat': in no name"):
        list(peers.wanted_sides(["ant", "cat"], ()))
    with pytest.raises(ConfigError, match="num_env"):
        list(peers.wanted_sides(["Brax's ant"], ("num_env=3",)))


def test_what_lacks_a_package_is_left_out(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    def found(name: str) -> object:
        return None if name == "mujoco_playground" else object()

    monkeypatch.setattr(importlib.util, "find_spec", found)
    sides = list(peers.wanted_sides(["Brax's", "Cartpole", "mjlab"], ()))
    assert [side.comparison for side in sides] == ["Brax's ant"] * 2 + ["Brax's humanoid"] * 2
    assert capsys.readouterr().err.splitlines() == [
        "Playground's CartpoleBalance: left out, the package mujoco_playground is not installed",
        "anymal, and mjlab's Go1: left out, give --mjlab the python of where mjlab is",
    ]


def test_the_stand_in_makes_one_row_for_each_device():
    tree = {"a": jnp.arange(3), "b": (jnp.float32(2.0),)}
    made = replicated(tree, jax.local_devices())
    assert made["a"].shape == (jax.local_device_count(), 3)
    out: Any = jax.pmap(lambda one: jax.tree.map(lambda leaf: leaf + 1, one))(made)
    assert out["a"][0].tolist() == [1, 2, 3]
    assert out["b"][0].dtype == jnp.float32


def test_returns_are_of_the_settings_that_ours_are_trained_with():
    settings = returns.settings_of("CheetahRun", ("num_timesteps=20e6",), seed=3)
    assert (settings["suite"], settings["env"], settings["impl"]) == (
        "playground",
        "CheetahRun",
        "warp",
    )
    arguments = settings["arguments"]
    assert (arguments["seed"], arguments["log_training_metrics"]) == (3, True)
    assert (arguments["num_updates_per_batch"], arguments["unroll_length"]) == (16, 30)
    assert arguments["num_timesteps"] == pytest.approx(20e6, rel=0.05)
    assert arguments.keys() <= inspect.signature(train.train).parameters.keys()


def test_returns_are_kept_up_to_where_a_run_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    # A process that reports twice, and fails behind that where its seed is 1.
    script = (
        "import json, sys; seed = json.load(open(sys.argv[-2]))['arguments']['seed'];"
        "json.dump({'curve': [], 'returns': [[100, 1.0], [200, 2.0]]}, open(sys.argv[-1], 'w'));"
        "sys.exit('no room' if seed else 0)"
    )

    start = runner.start

    def started(words: Sequence[str], variables: dict[str, str], log: Any) -> Any:
        return start([sys.executable, "-c", script, *words[-2:]], variables, log)

    monkeypatch.setattr(runner, "start", started)
    tasks = {f"a-{seed}": returns.settings_of("PointMass", (), seed) for seed in (0, 1)}
    curve = [[100, 1.0], [200, 2.0]]
    assert returns.train(tasks, tmp_path, 60.0) == {
        "a-0": {"returns": curve},
        "a-1": {"returns": curve, "failed": "no room"},
    }


class Fake:
    """Commands of 60 seconds on a clock that only they move; Brax's fail where asked to."""

    def __init__(self, broken: str = "") -> None:
        self.now_s, self.broken = 0.0, broken

    def start(self, words: Sequence[str], variables: dict[str, str], log: Any) -> Any:
        assert "JAX_COMPILATION_CACHE_DIR" in variables
        return words, log

    def wait_until(self, deadline_s: float, *processes: Any) -> list[int]:
        del deadline_s
        self.now_s += 60.0
        return [self._end(words, log) for words, log in processes]

    def _end(self, words: Sequence[str], log: Any) -> int:
        if self.broken and any(self.broken in word for word in words):
            log.write(b"no such task\n")
            return 1
        points = [(10.0 + n, 100 * n) for n in range(1, 11)]
        if "gmijax.train" in words:
            folder = Path(words[-1].removeprefix("run.dir="))
            folder.mkdir()
            lines = [
                json.dumps({"wall_s": 0.5 * s, "env_steps": steps, "return": 2.0})
                for s, steps in points
            ]
            (folder / "metrics.jsonl").write_text("\n".join(lines) + "\n")
        else:
            Path(words[-1]).write_text(json.dumps({"curve": points}))
        return 0


def benchmark(
    monkeypatch: pytest.MonkeyPatch, folder: Path, fake: Fake, *only: str, **options: Any
) -> peers.Benchmark:
    for name in ("start", "wait_until"):
        monkeypatch.setattr(runner, name, getattr(fake, name))
    monkeypatch.setattr(peers.os, "cpu_count", lambda: 8)
    arguments = {"repeats": 3, "timeout_s": 600.0, "deadline_s": None, **options}
    sides = [side for side in peers.wanted_sides(only, ()) if "Warp" not in side.comparison]
    with monkeypatch.context() as patched:
        patched.setattr(peers.time, "monotonic", lambda: fake.now_s)
        made = peers.Benchmark(argparse.Namespace(out=folder, **arguments), folder, sides)
        made.run()
    return made


def test_both_sides_run_in_turn_and_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    # A minute to compile, then the two sides in turn; the sixth training would end at 420 s.
    made = benchmark(monkeypatch, tmp_path, Fake(), "Brax's ant", deadline_s=400.0)
    runs = [made.file.results["cases"][f"Brax's ant, {one}"]["runs"] for one in (OURS, BRAX)]
    assert [[run["repeat"] for run in own] for own in runs] == [[0, 1, 2], [0, 1]]
    rates = [own[0]["summary"]["steps_per_s"] for own in runs]
    assert rates == pytest.approx([200.0, 100.0])
    assert runs[0][0]["summary"]["command_s"] == 60.0
    assert runs[0][0]["returns"][0] == (5.5, 2.0)
    assert runs[1][0]["returns"] == []  # Of rates alone.
    assert not made.has_failed
    kept = read_calls(made.file.path)[-1].results
    assert kept == json.loads(json.dumps(made.file.results))


def test_a_side_that_does_not_compile_is_reported_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    made = benchmark(monkeypatch, tmp_path, Fake("brax_ppo"), "Brax's ant", repeats=2)
    cases = made.file.results["cases"]
    assert cases["Brax's ant, Brax"]["runs"] == [{"repeat": 0, "failed": "no such task"}]
    assert len(cases["Brax's ant, gmijax"]["runs"]) == 2
    assert made.has_failed


def test_the_table_takes_the_newest_call_that_measured_both_sides(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(records, "RESULTS", tmp_path)
    assert TABLES["peers"]() == [NOT_MEASURED]
    made = benchmark(monkeypatch, tmp_path, Fake(), "Brax's ant", repeats=1)
    benchmark(monkeypatch, tmp_path / "2", Fake("gmijax.train"), "Brax's ant", repeats=1)
    calls = [json.loads(made.file.path.read_text())["calls"][0]]
    calls += json.loads((tmp_path / "2" / made.file.path.name).read_text())["calls"]
    path = tmp_path / "peers-nvidia-h200.json"
    path.write_text(json.dumps({"format": 2, "suite": "peers", "calls": calls}))
    table = TABLES["peers"]()
    assert "| Brax's ant | Brax | 200 | 100 | 2.00 | 60.0 | 60.0 |" in table
    assert sum(NOT_MEASURED in line for line in table) == len(COMPARISONS) - 1
