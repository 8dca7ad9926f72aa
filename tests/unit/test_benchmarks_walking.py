"""From which checkpoint on a training walks, and whose policies are tested."""

from __future__ import annotations

import importlib
import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from supervision import save_meta

import gmijax
from benchmarks import records, walking, walking_tests
from benchmarks.evaluation.figures import NOT_MEASURED
from benchmarks.evaluation.page import TABLES
from benchmarks.evaluation.walking_tables import seconds_until_it_walks
from benchmarks.records import ResultsFile, read_calls
from benchmarks.walking import SCRIPT, _theirs, apart, summary, walks_from
from benchmarks.walking_tests import Policy, policy_of, walks_twice
from gmijax.config import EnvConfig
from gmijax.config.schema import to_dict
from gmijax.errors import ConfigError
from gmijax.machine.nvidia import Gpu
from gmijax.machine.snapshot import Machine
from gmijax.player.policy import PlainPolicy, write_policy
from gmijax.runs.checkpoints import CheckpointMeta
from gmijax.runs.folder import POLICY, RunPaths, read_json, write_json


def checkpoints(*walks: bool | None) -> list[dict[str, Any]]:
    return [
        {
            "folder": "x",
            "env_steps": 10 * number,
            "command_s": 2.0 * number,
            "training_s": 1.0 * number,
            **({} if walk is None else {"walk": {"walks": walk}}),
        }
        for number, walk in enumerate(walks, 1)
    ]


def test_a_training_walks_from_the_first_of_two_checkpoints_in_a_row():
    found = walks_from(checkpoints(False, True, False, True, True, None))
    assert found == {"env_steps": 40, "command_s": 8.0, "training_s": 4.0}


def test_a_single_checkpoint_that_walks_is_not_enough():
    assert walks_from(checkpoints(False, True)) is None
    assert walks_from(checkpoints(False, True, None)) is None
    assert walks_from(checkpoints(True, False, True)) is None
    assert walks_from([]) is None


def test_too_few_environments_give_no_result():
    assert walks_from([{"walk": {"walks": None}}] * 3) is None


def test_a_folder_of_trainings_is_not_used_twice(tmp_path, monkeypatch):
    (tmp_path / "gmijax-compile").mkdir()
    overrides = ("env=go1", "num_envs=64", f"--runs={tmp_path}", f"--out={tmp_path}")
    monkeypatch.setattr("sys.argv", ["walking", *overrides])
    with pytest.raises(ConfigError, match=f"^--runs={tmp_path}: has a gmijax-compile already$"):
        walking.main()


@pytest.mark.parametrize("more", [("--script=--impl=jax",), ()])
@pytest.mark.parametrize("count", ["0", "6", "-1"])
def test_script_seeds_are_some_of_the_seeds(count, more, tmp_path, monkeypatch):
    given = ("env=go1", "num_envs=64", f"--script-seeds={count}", f"--out={tmp_path}", *more)
    monkeypatch.setattr("sys.argv", ["walking", *given])
    with pytest.raises(ConfigError, match=f"^--script-seeds={count}: needs --script, and is 1 to"):
        walking.main()


@pytest.mark.parametrize(
    ("steps", "kept"),
    [([10, 20, 30, 31], 3), ([10, 20, 30, 35], 4), ([10, 20, 30], 3), ([10, 12], 2), ([], 0)],
)
def test_a_last_checkpoint_soon_after_the_one_before_is_not_tested(steps, kept):
    checkpoints = [{"env_steps": one} for one in steps]
    assert apart(checkpoints) == checkpoints[:kept]


@pytest.mark.parametrize("more", [(), ("--cold",)])
def test_a_script_that_cannot_train_ends_the_call_before_any_seed(more, tmp_path, monkeypatch):
    ran = []
    monkeypatch.setattr(walking, "run_command", lambda command, *_: ran.append(command) or 1)
    where = (f"--runs={tmp_path}", f"--out={tmp_path}")
    given = ("env=go1", "num_envs=64", "--script=", *where, *more)
    monkeypatch.setattr("sys.argv", ["walking", *given])
    with pytest.raises(ConfigError, match=r"^--script: left no checkpoint"):
        walking.main()
    assert len(ran) == 2


def test_a_script_without_time_for_a_checkpoint_does_not_end_the_call(tmp_path, monkeypatch):
    ran = []
    monkeypatch.setattr(walking, "run_command", lambda command, *_: ran.append(command) or 1)
    monkeypatch.setattr(walking, "deadline", lambda seconds: -math.inf)
    where = (f"--runs={tmp_path}", f"--out={tmp_path}")
    monkeypatch.setattr("sys.argv", ["walking", "env=go1", "num_envs=64", "--script=", *where])
    assert walking.main() == 1
    assert "benchmarks.walking_tests" in ran[-1]


@pytest.mark.parametrize("is_cold", [True, False])
def test_a_cold_training_has_neither_programs_nor_kernels(is_cold, tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(walking, "run_command", lambda *given: seen.append(given[2]) or 1)
    more = ("--cold",) if is_cold else ()
    given = ("env=go1", "num_envs=64", "--seeds=2", f"--runs={tmp_path}", f"--out={tmp_path}")
    monkeypatch.setattr("sys.argv", ["walking", *given, *more])
    walking.main()
    *trainings, tests = seen
    for name in ("JAX_COMPILATION_CACHE_DIR", "WARP_CACHE_PATH"):
        assert len({variables[name] for variables in trainings}) == (2 if is_cold else 1)
        assert Path(tests[name]).parent == tmp_path


def test_every_seed_is_trained_and_tested_on_a_gpu_of_its_own(tmp_path, monkeypatch):
    gpus = tuple(Gpu(n, f"GPU-{n}", "some GPU", 80000, (9, 0), False) for n in (0, 1))
    for user in (walking, records):
        monkeypatch.setattr(user, "detect_machine", lambda: Machine(gpus, tuple(range(8))))
    ran = []

    def run_command(command, deadline_s, variables):
        ran.append((command[2], variables.get("CUDA_VISIBLE_DEVICES"), command))
        if "benchmarks.walking_tests" in command:
            asked = read_json(Path(command[-2]))
            walks = [[{"walks": True}] * len(run) for run in asked["runs"]]
            write_json(Path(command[-1]), {"walks": walks})
            return 0
        own = dict(word.split("=", 1) for word in command if "=" in word)
        for steps in (10, 20):
            meta = CheckpointMeta("go1", "ppo", steps, 1, 64, ((8,), (8,)), "warp")
            save_meta(RunPaths(Path(own["run.dir"])), meta)
        return 0

    monkeypatch.setattr(walking, "run_command", run_command)
    given = ("env=go1", "num_envs=64", "--gpus=2", f"--runs={tmp_path}", f"--out={tmp_path}")
    monkeypatch.setattr("sys.argv", ["walking", *given])
    assert walking.main() == 0
    found = {}
    for cores, gpu, command in ran[1:]:  # The first one compiles, and sees all.
        assert cores == {"0": "0,1,2,3", "1": "4,5,6,7"}[gpu]
        found.setdefault(gpu, []).extend(word for word in command if word.startswith("seed="))
    assert ran[0][1] is None
    assert found == {"0": ["seed=0", "seed=2", "seed=4"], "1": ["seed=1", "seed=3"]}
    (path,) = tmp_path.glob("walking-go1-*.json")
    (call,) = read_calls(path)
    assert call.device == "1 x some GPU"
    assert [run["seed"] for run in call.results["runs"]] == [0, 1, 2, 3, 4]
    assert summary(call.results["runs"])["gmijax"]["walk"] == 5


def test_tests_end_with_the_second_in_a_row_that_walks():
    walks = [one["walk"] for one in checkpoints(True, False, True, True)]
    assert [walks_twice(walks[:n]) for n in range(1, 5)] == [False, False, False, True]


def _run_of(trainer, tested):
    return {"trainer": trainer, "walks_from": walks_from(tested), "checkpoints": tested}


def test_a_training_whose_tests_were_cut_short_counts_neither_way():
    cut = [_run_of("gmijax", checkpoints(*walks)) for walks in ((False, None), (None,))]
    tested = _run_of("gmijax", checkpoints(False, False))
    row = summary([*cut, tested])["gmijax"]
    assert (row["seeds"], row["walk"], row["untested"]) == (1, 0, 2)
    assert summary(cut)["gmijax"]["seeds"] == 0


def test_summary_has_least_median_and_most_of_those_that_walk():
    runs = [
        _run_of("gmijax", checkpoints(*walks))
        for walks in ((True, True), (False, True, True), (False, True), (True, True, None))
    ]
    row = summary([*runs, _run_of("train-jax-ppo", [])])
    assert row["gmijax"] == {
        "seeds": 4,
        "walk": 3,
        "untested": 0,
        "env_steps": [10, 10, 20],
        "command_s": [2.0, 2.0, 4.0],
        "training_s": [1.0, 1.0, 2.0],
    }
    assert row["train-jax-ppo"]["walk"] == 0
    assert row["train-jax-ppo"]["command_s"] is None


def by_script(folder, *all_steps):
    for steps in all_steps:
        at = folder / "Go1-now" / "checkpoints" / f"{steps:012d}"
        at.mkdir(parents=True)
        (at / "ppo_network_config.json").write_text("{}")


def test_checkpoints_of_playgrounds_script_are_found_by_their_steps(tmp_path):
    by_script(tmp_path, 2000, 1000)
    assert [one["env_steps"] for one in _theirs(tmp_path, 0.0)] == [1000, 2000]


class Sized:
    """An `Env` in so far as policies ask for it: 5 numbers for the policy, 3 more besides."""

    class spec:  # noqa: N801
        actor_obs_size = 5


def written_policy(
    rng, folder, *, has_norms=False, obs_clip=10.0, head="tanh_normal"
) -> PlainPolicy:
    kernels = [rng.normal(size=shape).astype(np.float32) for shape in ((5, 8), (8, 4))]
    biases = [rng.normal(size=n).astype(np.float32) for n in (8, 4)]
    norms = [tuple(rng.normal(size=(2, 8)).astype(np.float32))] if has_norms else []
    mean, std = rng.uniform(1, 2, (2, 5)).astype(np.float32)
    policy = PlainPolicy(kernels, biases, mean, std, obs_clip, head, 2, {}, norms)
    write_policy(folder / POLICY, policy)
    return policy


@pytest.mark.parametrize("has_norms", [False, True])
def test_our_policy_acts_in_jax_as_in_numpy(has_norms, tmp_path):
    """And in the program of another one of its kind."""
    rng = np.random.default_rng(0)
    (tmp_path / "first").mkdir()
    (tmp_path / "second").mkdir()
    policies = [
        written_policy(rng, tmp_path / name, has_norms=has_norms) for name in ("first", "second")
    ]
    first, second = (policy_of(tmp_path / name, Sized) for name in ("first", "second"))
    obs = rng.normal(size=(3, 8)).astype(np.float32)
    import jax

    assert first.kind == second.kind
    assert first.kind[0] == "gmijax"
    act = jax.jit(first.act)
    assert np.asarray(act(first.weights, obs)) == pytest.approx(policies[0](obs), abs=1e-5)
    assert np.asarray(act(second.weights, obs)) == pytest.approx(policies[1](obs), abs=1e-5)


@pytest.mark.parametrize("change", [{"has_norms": True}, {"obs_clip": 5.0}, {"head": "normal"}])
def test_a_policy_of_another_kind_has_a_program_of_its_own(change, tmp_path):
    rng = np.random.default_rng(0)
    kinds = []
    for name, given in (("first", {}), ("second", change)):
        (tmp_path / name).mkdir()
        written_policy(rng, tmp_path / name, **given)
        kinds.append(policy_of(tmp_path / name, Sized).kind)
    assert kinds[0] != kinds[1]


def test_a_policy_of_brax_gets_its_observations_by_name(tmp_path):
    pytest.importorskip("brax")
    import jax

    # By name: it is not installed where gmijax is checked.
    statistics_of = importlib.import_module("brax.training.acme.running_statistics")
    specs = importlib.import_module("brax.training.acme.specs")
    checkpoint = importlib.import_module("brax.training.agents.ppo.checkpoint")
    networks = importlib.import_module("brax.training.agents.ppo.networks")
    config_dict = importlib.import_module("ml_collections.config_dict")

    sizes = {"state": (5,), "privileged_state": (8,)}
    kwargs = {"policy_hidden_layer_sizes": (4,), "policy_obs_key": "state"}
    silu = importlib.import_module("flax.linen").silu
    network = networks.make_ppo_networks(
        sizes, 2, preprocess_observations_fn=statistics_of.normalize, activation=silu, **kwargs
    )
    shapes = {name: specs.Array(shape, np.dtype("float32")) for name, shape in sizes.items()}
    statistics = statistics_of.init_state(shapes).replace(
        mean={name: np.linspace(-1, 1, *shape) for name, shape in sizes.items()},
        std={name: np.linspace(1, 3, *shape) for name, shape in sizes.items()},
    )
    key = jax.random.key(0)
    params = (statistics, network.policy_network.init(key), network.value_network.init(key))
    # As the script writes it, which Brax itself cannot read.
    more = {
        "activation": silu,
        "mean_kernel_init_fn": None,
        "value_network_kernel_init_kwargs": None,
    }
    config = config_dict.ConfigDict(
        {
            "network_factory_kwargs": {**kwargs, **more},
            "normalize_observations": True,
            "observation_size": {name: {"shape": list(size)} for name, size in sizes.items()},
            "action_size": 2,
        }
    )
    checkpoint.save(tmp_path, 7, params, config)
    folder = tmp_path / f"{7:012d}"
    assert json.loads((folder / "ppo_network_config.json").read_text())["action_size"] == 2
    found = policy_of(folder, Sized)
    obs = np.random.default_rng(0).normal(size=(3, 13)).astype(np.float32)
    named = {"state": obs[:, :5], "privileged_state": obs[:, 5:]}
    act = networks.make_inference_fn(network)(params, deterministic=True)
    assert found.kind == ("brax",)
    acted = jax.jit(found.act)(found.weights, obs)
    assert np.asarray(acted) == pytest.approx(np.asarray(act(named, key)[0]), abs=1e-6)


def _add_call(
    folder, seconds, given, *, task="go1", is_cold=False, seeds=5, script=False, num_cut=0
):
    """A call of a walking benchmark, as if it had been measured; with no time for some tests."""
    settings = {"cold": is_cold, "overrides": given}
    file = ResultsFile(folder / "walking-go1-nvidia-h100.json", "walking", settings, device="H100")
    errors = {"linear_m_per_s": seconds / 1000, "yaw_rad_per_s": None}
    walk = {"upright": 0.995, "settled": errors, "impl": "warp"}
    tests = [{"env_steps": 7e7, "walk": walk}, {"env_steps": 8e7}]
    middle = [(5e7, seconds)] * (seeds - 2)
    runs = [
        {
            "trainer": "gmijax",
            "checkpoints": tests,
            "walks_from": {"env_steps": steps, "training_s": at_s, "command_s": None},
        }
        for steps, at_s in [(4e7, 50.0), *middle, (6e7, 120.0)]
    ]
    cut = [{"trainer": "gmijax", "checkpoints": tests[1:]}] * num_cut
    by_script = [{"trainer": SCRIPT, "checkpoints": tests[:1]}] if script else []
    with file.changing() as results:
        results.update(task=task, runs=[*runs, *cut, *by_script])


def _rows_of_the_table():
    """Without the commit, which is that of the tests."""
    lines = TABLES["walking"]()
    cells = [line.split(" | ") for line in lines if line.startswith("| `")]
    return [" | ".join([*row[:3], *row[4:]]) for row in cells]


PPO, SAC, CACHED = "`go1` | warp | gmijax PPO", "`go1` | warp | gmijax SAC", "from the cache"
WALK, SHARE, MOST = "5 of 5 | 50 (40 to 60)", "70 | 99.5%", "(50 to 120)"


def test_the_table_has_the_newest_call_of_each_kind_of_start(tmp_path, monkeypatch):
    monkeypatch.setattr(records, "RESULTS", tmp_path)
    assert TABLES["walking"]() == [NOT_MEASURED]
    # Playground's name is the same robot's.
    _add_call(tmp_path, 99.0, [], task="playground/Go1JoystickFlatTerrain")
    _add_call(tmp_path, 60.0, ["env=go1"])
    _add_call(tmp_path, 100.0, [], is_cold=True)
    by_sac = ["env=go1", "algo=sac"]
    _add_call(tmp_path, 70.0, by_sac, task="playground/Go1JoystickFlatTerrain")
    assert _rows_of_the_table() == [
        f"| {PPO} | {CACHED} | {WALK} | 60 {MOST} |  | {SHARE} | 0.06 |  |",
        f"| {PPO} | compiled anew | {WALK} | 100 {MOST} |  | {SHARE} | 0.10 |  |",
        f"| {SAC} | {CACHED} | {WALK} | 70 {MOST} |  | {SHARE} | 0.07 |  |",
    ]


def test_a_call_with_fewer_seeds_does_not_take_the_place_of_one_with_more(tmp_path, monkeypatch):
    monkeypatch.setattr(records, "RESULTS", tmp_path)
    by_sac = ["env=go1", "algo=sac"]
    _add_call(tmp_path, 70.0, by_sac)
    _add_call(tmp_path, 50.0, by_sac, seeds=3)
    rows = [f"| {SAC} | {CACHED} | {WALK} | 70 {MOST} |  | {SHARE} | 0.07 |  |"]
    assert _rows_of_the_table() == rows
    median, seeds = seconds_until_it_walks("go1", "warp")
    assert median is not None
    assert (median.median, seeds) == (70.0, "5 of 5")
    # Playground's script is compared with ours of the same call.
    _add_call(tmp_path, 60.0, by_sac, seeds=3, script=True)
    few = WALK.replace("5 of 5", "3 of 3")
    beside = [
        f"| {SAC} | {CACHED} | {few} | 60 {MOST} |  | {SHARE} | 0.06 |  |",
        f"| `go1` | warp | {SCRIPT} | {CACHED} | 0 of 1 |  |  |  | {SHARE} | 0.06 |  |",
    ]
    assert _rows_of_the_table() == [*rows, *beside]
    assert seconds_until_it_walks("go1", "warp")[1] == "5 of 5"
    # One with as many seeds says it all.
    _add_call(tmp_path, 60.0, by_sac, script=True)
    whole = [line.replace("3 of 3", "5 of 5") for line in beside]
    assert _rows_of_the_table() == whole


def test_trainings_without_tests_are_named_and_do_not_count(tmp_path, monkeypatch):
    monkeypatch.setattr(records, "RESULTS", tmp_path)
    by_sac = ["env=go1", "algo=sac"]
    _add_call(tmp_path, 60.0, by_sac, seeds=3, num_cut=2)
    (row,) = _rows_of_the_table()
    assert row.split(" | ")[3:5] == ["from the cache", "3 of 3, 2 not tested"]
    assert seconds_until_it_walks("go1", "warp")[1] == "3 of 3, 2 not tested"
    _add_call(tmp_path, 70.0, by_sac, seeds=4)
    assert seconds_until_it_walks("go1", "warp")[1] == "4 of 4"


def test_one_program_tests_all_checkpoints_of_a_kind(tmp_path, monkeypatch):
    made = []

    class Test:
        """Policies walk whose weights are over 1."""

        def __init__(self, env, robot, act, **options):
            made.append((robot.name, options))

        def compile(self, weights):
            pass

        def run(self, weights):
            walk = SimpleNamespace(as_json=lambda: {"walks": weights > 1})
            walk._replace = lambda settings: walk
            return walk

    monkeypatch.setattr(walking_tests, "WalkingTest", Test)
    monkeypatch.setattr(walking_tests, "walking_env", lambda *_: None)
    monkeypatch.setattr(
        walking_tests,
        "policy_of",
        lambda path, _: Policy((path.suffix,), lambda *_: None, int(path.stem)),
    )
    monkeypatch.setattr(walking_tests, "_trained_with", lambda path: "jax")
    env = to_dict(EnvConfig(suite="playground", name="g1_rough", episode_length=None))
    runs = [["1.a", "2.a", "3.a", "4.a"], ["5.b", "1.a"]]
    asked = {"env": env, "impls": ["auto", "jax"], "num_envs": 4, "seed": 7, "runs": runs}
    write_json(tmp_path / "in.json", asked)
    monkeypatch.setattr("sys.argv", ["x", str(tmp_path / "in.json"), str(tmp_path / "out.json")])
    assert walking_tests.main() == 0
    written = read_json(tmp_path / "out.json")["walks"]
    found = [[one["walks"] for one in run] for run in written]
    assert {one["impl"] for run in written for one in run} == {"jax"}
    assert found == [[False, True, True], [True, False]]
    assert made == [("g1", {"num_envs": 4, "seed": 7})] * 2


@pytest.mark.parametrize(
    ("works", "script_seeds", "seeds"),
    [(True, (), [0, 1]), (False, (), [0, 1]), (True, ("--script-seeds=1",), [0])],
)
def test_a_call_trains_tests_and_writes_what_it_found(
    works, script_seeds, seeds, tmp_path, monkeypatch
):
    commands = []

    def run(command, deadline_s, variables):
        commands.append((command, variables))
        if "gmijax.train" in command:
            folder = RunPaths(Path(command[-2].removeprefix("run.dir=")))
            for steps in (100, 200, 300):
                meta = CheckpointMeta("go1", "ppo", steps, 1, 4, ((8,), (8,)), "jax", time_s=1e9)
                save_meta(folder, meta)
                (folder.checkpoint(steps) / "gmi_0").mkdir()
            lines = [{"env_steps": steps, "wall_s": steps / 10} for steps in (100, 200, 300)]
            folder.metrics.write_text("".join(f"{json.dumps(line)}\n" for line in lines))
        elif "benchmarks.walking_tests" in command:
            asked = read_json(Path(command[-2]))
            walks = [[{"walks": "100" not in folder} for folder in run] for run in asked["runs"]]
            if not works:  # It was stopped before the second that walks.
                walks = [run[:2] for run in walks]
            write_json(Path(command[-1]), {"walks": walks})
            return 0 if works else 1
        else:
            (folder,) = (one for one in command if one.startswith("--logdir="))
            by_script(Path(folder.removeprefix("--logdir=")), 100)
        return 0

    monkeypatch.setattr(walking, "run_command", run)
    monkeypatch.setattr(
        "sys.argv",
        [
            *("walking", "env=go1", "num_envs=64", "num_timesteps=20480", "--seeds", "2"),
            *("--script=--impl=jax", f"--out={tmp_path}", f"--runs={tmp_path}", "--tests=4"),
            *("--envs=100", *script_seeds),
        ],
    )
    assert walking.main() == (0 if works else 1)
    ours = [command for command, _ in commands if "gmijax.train" in command]
    assert [command[-1] for command in ours] == ["num_timesteps=1", "seed=0", "seed=1"]
    every = [one for one in ours[1] if one.startswith("run.checkpoint_every=")]
    assert gmijax.compose(*ours[1][3:]).run.checkpoint_every == int(every[0].split("=")[1]) > 1
    theirs = [command for command, _ in commands if "--impl=jax" in command]
    assert [command[-1] for command in theirs[1:]] == [f"--seed={seed}" for seed in seeds]
    assert {"--env_name=Go1JoystickFlatTerrain", "--num_evals=5"} <= set(theirs[1])
    # How long a part is is compiled in.
    assert theirs[0][-2:] == ["--num_timesteps=50000000", "--num_evals=2"]
    (path,) = tmp_path.glob("walking-go1-*.json")
    (call,) = read_calls(path)
    rows = summary(call.results["runs"])
    assert "folder" not in call.results["runs"][0]["checkpoints"][0]
    assert (rows["gmijax"]["walk"], rows["gmijax"]["seeds"]) == ((2, 2) if works else (0, 0))
    assert rows["gmijax"]["training_s"] == ([20.0, 20.0, 20.0] if works else None)
    assert rows["train-jax-ppo"]["walk"] == 0
    assert not list(tmp_path.rglob("gmi_0"))
