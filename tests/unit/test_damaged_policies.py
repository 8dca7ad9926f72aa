"""Exported policies that were damaged, or are of somebody else."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import jax
import numpy as np
import onnx
import pytest
from made_checkpoint import make_run

import gmijax
from gmijax.deploy.files import stablehlo_content
from gmijax.deploy.sealed import sealed, unsealed
from gmijax.deploy.trained import trained_policy
from gmijax.errors import ConfigError
from gmijax.runs.resume import find_checkpoint


@pytest.fixture(scope="module")
def content(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    run = make_run(tmp_path_factory.mktemp("runs") / "made")
    return stablehlo_content(trained_policy(find_checkpoint(str(run.root), "x")))


def test_a_policy_whose_bits_have_flipped_is_refused_before_it_is_taken_in(
    content: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def take_in(_: object) -> None:
        pytest.fail("took it in first")

    monkeypatch.setattr(jax.export, "deserialize", take_in)
    path, rng = tmp_path / "policy.stablehlo", random.Random(0)
    places = [*(rng.randrange(len(content)) for _ in range(100)), len(content) - 1, 0]
    for place in places:
        damaged = bytearray(content)
        damaged[place] ^= 1 << rng.randrange(8)
        path.write_bytes(damaged)
        with pytest.raises(ConfigError, match=r"not a policy of gmijax.export \((not|no digest)"):
            gmijax.load_policy(path)


@pytest.mark.parametrize("cut", [1, 64, 77, 78, 1000])
def test_a_policy_that_was_cut_off_or_has_no_digest_is_refused(
    content: bytes, tmp_path: Path, cut: int
):
    path = tmp_path / "policy.stablehlo"
    path.write_bytes(content[:-cut])
    with pytest.raises(ConfigError, match="no digest at its end"):
        gmijax.load_policy(path)


def test_jax_takes_the_file_as_it_is_and_no_observations_are_no_actions(
    content: bytes, tmp_path: Path
):
    path = tmp_path / "policy.stablehlo"
    path.write_bytes(content)
    policy = gmijax.load_policy(path)
    assert policy(np.zeros((0, policy.obs_size))).shape == (0, policy.action_size)
    obs = np.ones((2, policy.obs_size), np.float32)
    alone = jax.export.deserialize(bytearray(content)).call(obs)
    np.testing.assert_array_equal(policy(obs), np.asarray(alone))
    path.with_suffix(".json").write_text("{")
    with pytest.raises(ConfigError, match=r"policy\.json: broken"):
        gmijax.load_policy(path)


def test_a_digest_is_of_all_that_is_before_it():
    assert unsealed(sealed(b"")) == b""
    assert unsealed(sealed(sealed(b"x"))) == sealed(b"x")
    for bad in (b"", sealed(b"x") + b"y", b"y" + sealed(b"x"), sealed(b"x")[1:]):
        with pytest.raises(ValueError, match=r"digest|SHA-256"):
            unsealed(bad)


def model(path: Path, metadata: dict[str, str], kind: int = onnx.TensorProto.FLOAT, size: int = 3):
    """An ONNX model that returns what it gets."""
    ends = [onnx.helper.make_tensor_value_info(name, kind, ["N", size]) for name in "xy"]
    graph = onnx.helper.make_graph(
        [onnx.helper.make_node("Identity", ["x"], ["y"])], "g", *([end] for end in ends)
    )
    made = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)])
    made.ir_version = 8
    onnx.helper.set_model_props(made, metadata)
    path.write_bytes(made.SerializeToString())


GOOD = {"gmijax_version": '"1"', "obs_size": "3", "action_size": "3"}


@pytest.mark.parametrize(
    ("changes", "options", "message"),
    [
        ({"obs_size": None}, {}, "obs_size=None"),
        ({"action_size": '"3"'}, {}, "action_size='3'"),
        ({"obs_size": "true"}, {"size": 1}, "obs_size=True"),
        ({"obs_size": "4"}, {}, "obs_size=4"),
        ({"task": "{"}, {}, "its metadata are broken"),
        ({"task": "[" * 100_000}, {}, "its metadata are broken"),
        ({}, {"kind": onnx.TensorProto.DOUBLE}, r"tensor\(double\)"),
        ({}, {"kind": onnx.TensorProto.INT32}, r"tensor\(int32\)"),
        ({}, {"size": 5}, r"\[5\]"),
    ],
)
def test_an_onnx_model_that_is_no_policy_is_bad_input(
    tmp_path: Path, changes: dict[str, Any], options: dict[str, int], message: str
):
    path = tmp_path / "policy.onnx"
    model(path, GOOD)
    assert gmijax.load_policy(path)(np.zeros(3)).tolist() == [0.0, 0.0, 0.0]
    model(
        path, {key: text for key, text in (GOOD | changes).items() if text is not None}, **options
    )
    with pytest.raises(ConfigError, match=f"^path=.*{message}") as error:
        gmijax.load_policy(path)
    assert len(str(error.value).splitlines()) == 1
