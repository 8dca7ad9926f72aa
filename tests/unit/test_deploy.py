"""Policies outside of training: loaded from a run, and what `gmijax.export` refuses."""

from __future__ import annotations

import importlib.util
import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from made_checkpoint import ENV_STEPS, make_run

import gmijax
from gmijax.cli.command import command
from gmijax.config import ExportConfig
from gmijax.deploy import exporting
from gmijax.deploy.files import stablehlo_content
from gmijax.deploy.trained import trained_policy
from gmijax.errors import ConfigError
from gmijax.machine.nvidia import Gpu
from gmijax.machine.snapshot import Machine
from gmijax.runs.folder import META, ExportPaths, RunPaths
from gmijax.sim.physics import PhysicsState
from gmijax.sim.tasks import ball_balance
from gmijax.supervise.start_gmi import environment_of
from gmijax.workers.exporter import names_of

EXAMPLE = Path(__file__).parents[2] / "examples" / "exported_policy.py"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunPaths:
    return make_run(tmp_path_factory.mktemp("runs") / "made")


@pytest.fixture(scope="module")
def policy(run: RunPaths) -> Any:
    return gmijax.load_policy(run.root)


def expected(run: RunPaths, obs: np.ndarray) -> np.ndarray:
    """The policy written out in numpy, from the arrays of the checkpoint."""
    import orbax.checkpoint as ocp

    with ocp.StandardCheckpointer() as checkpointer:
        saved: Any = checkpointer.restore(run.checkpoint(ENV_STEPS) / "learner")
    moments = saved["obs_moments"]
    seen = slice(obs.shape[-1])
    x = (obs - moments["mean"][seen]) / np.sqrt(moments["m2"][seen] / moments["count"])
    x = np.clip(x, -10.0, 10.0)
    layers = saved["params"]["policy"]["params"]
    for i in range(3):
        x = x @ layers[f"Dense_{i}"]["kernel"] + layers[f"Dense_{i}"]["bias"]
        if i < 2:
            x = np.where(x > 0.0, x, np.expm1(np.minimum(x, 0.0)))
    return np.clip(x, -1.0, 1.0)


def test_a_loaded_policy_acts_as_its_weights_say(run: RunPaths, policy: Any):
    obs = np.random.default_rng(0).normal(scale=20.0, size=(100, 24))
    actions = policy(obs)
    assert (policy.obs_size, policy.action_size) == (24, 3)
    assert actions.dtype == np.float32
    np.testing.assert_allclose(actions, expected(run, obs), atol=2e-5)
    assert 0.05 < (np.abs(actions) == 1.0).mean() < 0.95, "some are clipped, and some are not"
    np.testing.assert_allclose(policy(obs[3]), actions[3], atol=1e-6)
    assert policy(obs[3].tolist()).shape == (3,)


def test_it_says_what_it_is(policy: Any):
    about = policy.metadata
    assert (about["task"], about["env_steps"], about["run"]) == ("ball_balance", ENV_STEPS, "made")
    assert about["policy_hidden_layer_sizes"] == [16, 8]
    np.testing.assert_allclose(about["obs_mean"], np.linspace(-2.0, 2.0, 24), atol=1e-6)
    np.testing.assert_allclose(np.square(about["obs_std"]), np.linspace(0.1, 9.0, 24), rtol=1e-5)
    assert about["obs_clip"] == 10.0
    assert about["gmijax_version"] == gmijax.__version__


def test_a_policy_without_a_normaliser_sees_observations_as_they_are(tmp_path: Path):
    bare = make_run(tmp_path / "bare", "algo.normalize_observations=false")
    about = gmijax.load_policy(bare.checkpoint(ENV_STEPS)).metadata
    assert (set(about["obs_mean"]), set(about["obs_std"])) == ({0.0}, {1.0})
    assert about["obs_clip"] is None


def test_it_computes_in_float32_and_asks_for_nothing_that_only_the_value_function_saw(
    tmp_path: Path,
):
    run = make_run(tmp_path / "run", "algo.precision=bfloat16", actor_obs_size=20)
    policy = gmijax.load_policy(run.root)
    obs = np.random.default_rng(0).normal(scale=20.0, size=(100, 20))
    assert (policy.obs_size, len(policy.metadata["obs_mean"])) == (20, 20)
    np.testing.assert_allclose(policy(obs), expected(run, obs), atol=2e-5)


@pytest.mark.parametrize("shape", [(), (23,), (2, 25), (2, 2, 24)])
def test_observations_of_another_shape_are_refused(policy: Any, shape: tuple[int, ...]):
    with pytest.raises(ConfigError, match=r"^obs: shape \[.*\], expected \[24\] or \[N, 24\]$"):
        policy(np.zeros(shape))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("nowhere", "no such folder"),
        ("bad.npz", r"bad.npz: is not a folder of a run or .*, and no file .onnx or .stablehlo$"),
        ("exported", r"exported: an exported policy is a file; .* .*exported/policy.stablehlo\?$"),
        ("", "no checkpoint in this folder"),
        ("nowhere.onnx", "no such file"),
        ("nowhere.stablehlo", "no such file"),
        ("bad.onnx", "not an ONNX model"),
        ("bad.stablehlo", "not a policy of gmijax.export"),
    ],
)
def test_a_path_without_a_policy_is_bad_input(tmp_path: Path, name: str, message: str):
    (tmp_path / "exported").mkdir()
    ExportPaths(tmp_path / "exported").stablehlo.touch()
    if name.startswith("bad"):
        (tmp_path / name).write_bytes(b"\x08\x07 no policy at all" * 9)
    with pytest.raises(ConfigError, match=f"^path=.*{message}") as error:
        gmijax.load_policy(tmp_path / name)
    assert len(str(error.value).splitlines()) == 1


def test_a_damaged_checkpoint_that_is_passed_over_is_warned_of(run: RunPaths, tmp_path: Path):
    shutil.copytree(run.root, tmp_path / "run")
    paths = RunPaths(tmp_path / "run")
    paths.checkpoint(ENV_STEPS + 1).mkdir()
    (paths.checkpoint(ENV_STEPS + 1) / META).write_text("{")
    with pytest.warns(RuntimeWarning, match=r": passed over, broken meta\.json") as warned:
        policy = gmijax.load_policy(paths.root)
    assert policy.metadata["env_steps"] == ENV_STEPS
    assert [Path(one.filename).name for one in warned] == [Path(__file__).name]


def test_a_checkpoint_that_holds_no_policy_is_bad_input(run: RunPaths, tmp_path: Path):
    shutil.copytree(run.root, tmp_path / "broken")
    broken = RunPaths(tmp_path / "broken").checkpoint(ENV_STEPS)
    shutil.rmtree(broken / "learner")
    (broken / "learner").mkdir()
    with pytest.raises(ConfigError, match="holds no policy"):
        trained_policy(broken)


def export(*overrides: str) -> int:
    return command("export", ExportConfig, exporting.export, overrides)


def test_without_its_package_only_stablehlo_can_be_written(
    run: RunPaths, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    find = importlib.util.find_spec
    without = SimpleNamespace(find_spec=lambda name: None if name == "jax2onnx" else find(name))
    monkeypatch.setattr(exporting.importlib, "util", without)
    for wanted in ("onnx", "all"):
        assert export(f"run.dir={run.root}", f"format={wanted}") == 2
        message = capsys.readouterr().err
        assert f"format={wanted}: needs the package jax2onnx (pip install" in message
        assert len(message.splitlines()) == 1
    assert not (run.root / "export").exists()
    exporting.require_packages(exporting_config("format=stablehlo"))


def exporting_config(*overrides: str) -> ExportConfig:
    found: list[ExportConfig] = []
    assert command("export", ExportConfig, lambda c, **_: found.append(c), overrides) == 0
    return found[0]


def test_an_export_leaves_a_gpu_to_the_job_that_trains_on_it(
    run: RunPaths, monkeypatch: pytest.MonkeyPatch
):
    machine = Machine(gpus=(Gpu(0, "GPU-1", "some GPU", 80000, (9, 0), False),), cpu_cores=(0, 1))
    monkeypatch.setattr(exporting, "detect_machine", lambda: machine)
    config, _, _ = exporting.open_run(exporting_config(f"run.dir={run.root}"))
    paths = ExportPaths(exporting.output_folder(config, "export"))
    assert paths == ExportPaths(run.root / "export" / f"{ENV_STEPS:012d}")
    environment = environment_of(exporting.launch_of(paths), 0, {})
    assert (environment["JAX_PLATFORMS"], environment["CUDA_VISIBLE_DEVICES"]) == ("cpu", "")


def test_stablehlo_is_the_same_policy_for_any_number_of_observations(
    run: RunPaths, policy: Any, tmp_path: Path
):
    file = tmp_path / "policy.stablehlo"
    file.write_bytes(stablehlo_content(trained_policy(run.checkpoint(ENV_STEPS))))
    loaded = gmijax.load_policy(file)
    assert (loaded.obs_size, loaded.action_size, loaded.metadata) == (24, 3, {})
    obs = np.random.default_rng(1).normal(scale=5.0, size=(10_000, 24))
    np.testing.assert_allclose(loaded(obs), policy(obs), atol=1e-6)
    assert loaded(obs[:7]).shape == (7, 3)
    file.with_suffix(".json").write_text(json.dumps({"task": "x"}))
    assert gmijax.load_policy(file).metadata == {"task": "x"}


def test_the_example_sees_and_does_what_the_task_does():
    """In MuJoCo itself, without gmijax."""
    place = importlib.util.spec_from_file_location("example", EXAMPLE)
    assert place is not None
    assert place.loader is not None
    example = importlib.util.module_from_spec(place)
    place.loader.exec_module(example)
    env = ball_balance.make(impl="jax")
    ids, rng = ball_balance.look_up(env.mj_model), np.random.default_rng(0)
    data = mujoco.MjData(mujoco.MjModel.from_xml_path(str(example.MODEL)))
    example.reset(data, rng)
    assert not data.sensordata.any(), "the first observation has no sensors"
    example.step(data, np.array([0.25, -1.0, 1.0]))
    np.testing.assert_allclose(data.ctrl, [0.05, -0.2, 0.2])
    for _ in range(20):
        example.step(data, np.array([0.0, -1.0, 1.0]))
    limits = [0.05, ids.knees.lower[1], ids.knees.upper[2]]
    np.testing.assert_allclose(data.ctrl, limits, rtol=1e-6)
    data.qpos, data.qvel = rng.normal(size=data.qpos.shape), rng.normal(size=data.qvel.shape)
    data.sensordata = rng.normal(scale=50.0, size=data.sensordata.shape)
    state = PhysicsState(data.qpos, data.qvel, data.qacc_warmstart)
    wanted = ball_balance.observe(ids, state, data.sensordata[ids.sensors])
    np.testing.assert_allclose(example.observe(data), wanted, rtol=1e-5)
    assert example.STEPS == ball_balance.DEFAULT_EPISODE_LENGTH
    assert example.SUBSTEPS == ball_balance.SUBSTEPS


def test_names_are_those_of_the_model():
    env = ball_balance.make(impl="jax")
    names = names_of(env)
    assert names["control_dt_s"] == pytest.approx(0.01)
    assert names["obs_terms"][0] == ["knee_position", 3]
    assert names["action_names"] == ["knee_1", "knee_2", "knee_3"]
    assert names["joint_names"][:3] == ["tray", "hip_1", "knee_1"]
    other = names_of(env._replace(spec=env.spec._replace(action_size=2, obs_size=48)))
    assert (other["action_names"], other["obs_terms"]) == (None, None)
    assert names_of(env._replace(mj_model=None))["joint_names"] is None
