"""A policy as the content of a file: ONNX for robots and other languages, StableHLO for JAX."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, Final

import jax
import jax.numpy as jnp

from gmijax.deploy.sealed import sealed
from gmijax.deploy.trained import TrainedPolicy

_OPSET: Final = 17
"""Holds all that a policy needs, and is old enough for the runtimes that robots have."""

_PLATFORMS: Final = ("cpu", "cuda")


def onnx_content(policy: TrainedPolicy, metadata: Mapping[str, Any]) -> bytes:
    """The policy as an ONNX model: `obs` [N, O] to `action` [N, A], both float32, N is free.

    Every entry of `metadata` becomes one of the model's own, its value as JSON.
    """
    # Hundreds of modules, which nothing else needs.
    import jax2onnx
    import onnx

    model = jax2onnx.to_onnx(
        policy.act,
        inputs=[("N", policy.obs_size)],
        model_name="policy",
        opset=_OPSET,
        input_names=["obs"],
        output_names=["action"],
    )
    model.ir_version = onnx.helper.find_min_ir_version_for(model.opset_import)
    texts = {name: json.dumps(value) for name, value in metadata.items()}
    onnx.helper.set_model_props(model, texts)
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString()


def stablehlo_content(policy: TrainedPolicy) -> bytes:
    """The policy as `jax.export` serialises it: [N, O] to [N, A], N is free, for CPUs and CUDA.

    With a digest at its end, see `gmijax.deploy.sealed`.
    """
    (num_envs,) = jax.export.symbolic_shape("N")
    obs = jax.ShapeDtypeStruct((num_envs, policy.obs_size), jnp.float32)
    exported = jax.export.export(jax.jit(policy.act), platforms=_PLATFORMS)(obs)
    return sealed(bytes(exported.serialize()))
