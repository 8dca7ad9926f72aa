"""`python -m gmijax.export` as a user runs it, and the ONNX file that it writes."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
from made_checkpoint import ENV_STEPS, make_run
from training_jobs import child_environment, train

import gmijax
from gmijax.deploy.files import onnx_content, stablehlo_content
from gmijax.deploy.trained import trained_policy
from gmijax.runs.folder import ExportPaths

ROOT = Path(__file__).parents[2]

pytestmark = pytest.mark.timeout(600)


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> ExportPaths:
    """All files of a policy with random weights, in its run folder; they compute in float32."""
    home = tmp_path_factory.mktemp("home")
    run = make_run(home / "runs" / "made", "algo.precision=bfloat16")
    done = train("run.dir=last", cwd=home, command="export")
    assert done.returncode == 0, done.stderr
    paths = ExportPaths(run.root / "export" / f"{ENV_STEPS:012d}")
    for path in (paths.onnx, paths.stablehlo, paths.metadata):
        assert f": {path.relative_to(home)}\n" in done.stdout
    assert done.stdout.splitlines()[-1].startswith("  python -c 'import gmijax")
    assert not list(paths.root.glob(".policy*")), "nothing half written"
    return paths


def test_onnx_runtime_acts_as_jax_does(exported: ExportPaths):
    """In float32: sums in another order are all that may differ."""
    obs = np.random.default_rng(0).normal(scale=5.0, size=(10_000, 24)).astype(np.float32)
    trained = gmijax.load_policy(exported.root.parents[1])(obs)
    onnx = gmijax.load_policy(exported.onnx)(obs)
    stablehlo = gmijax.load_policy(exported.stablehlo)(obs)
    assert np.abs(onnx - trained).max() < 1e-5
    assert np.abs(stablehlo - trained).max() < 1e-6
    assert 0.05 < (np.abs(trained) == 1.0).mean() < 0.95, "some are clipped, and some are not"


def test_layer_norm_and_silu_are_exported_too(tmp_path: Path):
    run = make_run(tmp_path / "run", "algo.activation=layer_norm_silu")
    policy = trained_policy(run.checkpoint(ENV_STEPS))
    obs = np.random.default_rng(0).normal(scale=5.0, size=(1000, 24)).astype(np.float32)
    wanted = gmijax.load_policy(run.root)(obs)
    for name, content in (
        ("onnx", onnx_content(policy, {})),
        ("stablehlo", stablehlo_content(policy)),
    ):
        (tmp_path / f"policy.{name}").write_bytes(content)
    session = onnxruntime.InferenceSession(tmp_path / "policy.onnx")
    (found,) = session.run(None, {"obs": obs})
    assert np.abs(np.asarray(found) - wanted).max() < 1e-5
    assert np.abs(gmijax.load_policy(tmp_path / "policy.stablehlo")(obs) - wanted).max() < 1e-6


def test_the_onnx_file_has_one_input_and_one_output_of_any_length(exported: ExportPaths):
    session = onnxruntime.InferenceSession(exported.onnx)
    (obs,), (action,) = session.get_inputs(), session.get_outputs()
    assert (obs.name, obs.shape, obs.type) == ("obs", ["N", 24], "tensor(float)")
    assert (action.name, action.shape, action.type) == ("action", ["N", 3], "tensor(float)")
    for num in (1, 7, 4096):
        (actions,) = session.run(None, {"obs": np.ones((num, 24), np.float32)})
        assert np.shape(np.asarray(actions)) == (num, 3)


def test_metadata_are_in_the_folder_and_in_the_onnx_file(exported: ExportPaths):
    about = json.loads(exported.metadata.read_text())
    assert about["action_names"] == ["knee_1", "knee_2", "knee_3"]
    assert about["control_dt_s"] == pytest.approx(0.01)
    for file in (exported.onnx, exported.stablehlo):
        assert gmijax.load_policy(file).metadata == about
    trained = gmijax.load_policy(exported.root.parents[1]).metadata
    assert trained.items() <= about.items()


def test_an_onnx_file_is_loaded_without_jax(exported: ExportPaths):
    code = (
        "import sys, gmijax, numpy; policy = gmijax.load_policy(sys.argv[1]); "
        "print(policy(numpy.zeros(24)).shape, {'jax', 'mujoco'} & sys.modules.keys())"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(exported.onnx)],
        env=child_environment(),
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == "(3,) set()"


def test_the_example_runs_the_policy_in_mujoco(exported: ExportPaths):
    example = ROOT / "examples" / "exported_policy.py"
    done = subprocess.run(
        [sys.executable, str(example), str(exported.onnx)],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.startswith("return ")


def test_the_example_refuses_the_policy_of_another_task(tmp_path: Path):
    obs, action = (
        onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, ["N", 60])
        for name in ("obs", "action")
    )
    node = onnx.helper.make_node("Identity", ["obs"], ["action"])
    graph = onnx.helper.make_graph([node], "other", [obs], [action])
    made = onnx.helper.make_model(
        graph, ir_version=8, opset_imports=[onnx.helper.make_opsetid("", 17)]
    )
    onnx.save(made, tmp_path / "policy.onnx")
    done = subprocess.run(
        [sys.executable, str(ROOT / "examples" / "exported_policy.py"), "policy.onnx"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    message = "policy.onnx: the policy of another task: it has 60 observations and 60 actions, "
    assert (done.returncode, done.stderr) == (1, f"{message}this example 24 and 3\n")
