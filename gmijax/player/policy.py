"""`policy.npz`: a policy as a small file, read and run by numpy alone.

The learner writes one into every checkpoint (`gmijax.learning.policy_file`). It holds the weights
of the policy's network, the statistics that observations are normalised with, and the task.
"""

from __future__ import annotations

import io
import itertools
import json
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np
import numpy.typing as npt

from gmijax.errors import ConfigError
from gmijax.runs.folder import POLICY, open_regular, write_bytes
from gmijax.runs.names import nearby

Floats: TypeAlias = npt.NDArray[np.float32]

FORMAT: Final = 1
FORMAT_WITH_NORMS: Final = 2
"""Versions that do not know layer norm refuse its files, and read all others."""

LAYER_NORM_EPSILON: Final = 1e-6
"""What layer norm adds to the variance."""

_HEADS: Final = ("normal", "tanh_normal")
"""Names of `gmijax.learning.distributions`: the action is the mean, or the tanh of it."""


@dataclass(frozen=True)
class PlainPolicy:
    """A policy that acts without noise: `policy(obs) -> actions`.

    Attributes:
      kernels: weights [in, out] of every layer, float32.
      biases: [out] of every layer.
      obs_mean: [O] that is subtracted from observations.
      obs_std: [O] that they are divided by then.
      obs_clip: normalised observations are clipped to +- this; None: they are not.
      head: what the network's output is, `normal` or `tanh_normal`.
      action_size: A; the network may give more, which is noise.
      norms: scale and bias [out] of the layer norm behind every layer but the last, before SiLU;
        none: there is ELU behind them.
      about: what the policy is, as plain data: `env` (the keys of its task), `env_steps` and
        `gmijax_version`, and what else its writer noted.
    """

    kernels: Sequence[Floats]
    biases: Sequence[Floats]
    obs_mean: Floats
    obs_std: Floats
    obs_clip: float | None
    head: str
    action_size: int
    about: Mapping[str, Any]
    norms: Sequence[tuple[Floats, Floats]] = ()

    @property
    def obs_size(self) -> int:
        """O, how many numbers of an observation the policy sees."""
        return len(self.obs_mean)

    def __call__(self, obs: npt.ArrayLike) -> Any:
        """Actions [..., A] in [-1, 1] for raw observations [..., O], or longer ones.

        Of longer ones the first O numbers are seen: the others are for a value function. Arrays
        of JAX give arrays of JAX.
        """
        xp: Any = getattr(obs, "__array_namespace__", lambda: np)()
        seen = xp.asarray(obs, np.float32)[..., : self.obs_size]
        x = (seen - self.obs_mean) / self.obs_std
        if self.obs_clip is not None:
            x = xp.clip(x, -self.obs_clip, self.obs_clip)
        for number in range(len(self.kernels) - 1):
            x = self._activated(number, x @ self.kernels[number] + self.biases[number])
        mean = (x @ self.kernels[-1] + self.biases[-1])[..., : self.action_size]
        return xp.clip(xp.tanh(mean) if self.head == "tanh_normal" else mean, -1.0, 1.0)

    def _activated(self, number: int, x: Any) -> Any:
        """What comes of the sums [..., W] of a hidden layer."""
        xp: Any = getattr(x, "__array_namespace__", lambda: np)()
        if not self.norms:
            return xp.where(x > 0, x, xp.expm1(xp.minimum(x, 0)))
        scale, bias = self.norms[number]
        variance = xp.var(x, axis=-1, keepdims=True)
        x = (x - xp.mean(x, axis=-1, keepdims=True)) / xp.sqrt(variance + LAYER_NORM_EPSILON)
        x = scale * x + bias
        # SiLU; an exponential would overflow.
        return xp.asarray(x * (0.5 * xp.tanh(0.5 * x) + 0.5), xp.float32)


def write_policy(path: Path, policy: PlainPolicy, *, half: bool = False) -> None:
    """Writes `policy.npz`, as a whole or not at all; with `half` its weights are float16."""
    layers = zip(policy.kernels, policy.biases, strict=True)
    arrays: dict[str, npt.NDArray[Any]] = {"obs_mean": policy.obs_mean, "obs_std": policy.obs_std}
    for number, (kernel, bias) in enumerate(layers):
        arrays[f"kernel_{number}"] = kernel.astype(np.float16) if half else kernel
        arrays[f"bias_{number}"] = bias
    for number, (scale, bias) in enumerate(policy.norms):
        arrays[f"norm_scale_{number}"], arrays[f"norm_bias_{number}"] = scale, bias
    head = {
        "format": FORMAT_WITH_NORMS if policy.norms else FORMAT,
        "num_layers": len(policy.kernels),
        "obs_clip": policy.obs_clip,
        "head": policy.head,
        "action_size": policy.action_size,
        "about": dict(policy.about),
    }
    content = io.BytesIO()
    np.savez(content, allow_pickle=False, header=np.array(json.dumps(head)), **arrays)
    write_bytes(path, content.getvalue())


def read_policy(path: Path) -> PlainPolicy:
    """Reads what `write_policy` wrote.

    Raises:
      ConfigError: there is no such file, or it holds no policy.
    """
    try:
        with open_regular(path) as file, np.load(file, allow_pickle=False) as data:
            return _policy_of(data)
    except OSError as error:
        raise ConfigError(f"{nearby(path)}: cannot be read ({error.strerror or error})") from None
    except (EOFError, KeyError, TypeError, ValueError, zipfile.BadZipFile) as error:
        why = " ".join(str(error).split())
        raise ConfigError(f"{nearby(path)}: not a policy ({why})") from None


def checkpoint_policy(checkpoint: Path) -> PlainPolicy:
    """The policy of a checkpoint folder.

    Raises:
      ConfigError: it has no `policy.npz`, as those of older versions, or a broken one.
    """
    path = checkpoint / POLICY
    if not path.exists():
        raise ConfigError(
            f"checkpoint {nearby(checkpoint)}: has no {POLICY}, which this version writes into "
            "every checkpoint; `gmijax play` plays it without"
        )
    return read_policy(path)


def _policy_of(data: Mapping[str, Any]) -> PlainPolicy:
    head = json.loads(str(data["header"]))
    if head["format"] not in (FORMAT, FORMAT_WITH_NORMS) or head["head"] not in _HEADS:
        raise ValueError("written by another version of gmijax")
    kernels, biases = (
        [_floats(data[f"{kind}_{number}"]) for number in range(head["num_layers"])]
        for kind in ("kernel", "bias")
    )
    has_norms = head["format"] == FORMAT_WITH_NORMS
    policy = PlainPolicy(
        kernels,
        biases,
        _floats(data["obs_mean"]),
        _floats(data["obs_std"]),
        head["obs_clip"],
        head["head"],
        head["action_size"],
        head["about"],
        [
            (_floats(data[f"norm_scale_{number}"]), _floats(data[f"norm_bias_{number}"]))
            for number in range(head["num_layers"] - 1 if has_norms else 0)
        ],
    )
    _require_sizes(policy)
    return policy


def _floats(array: npt.NDArray[Any]) -> Floats:
    return np.asarray(array, np.float32)


def _require_sizes(policy: PlainPolicy) -> None:
    """Raises ValueError where the layers do not fit each other, or are none."""
    widths = [policy.obs_size, *(len(bias) for bias in policy.biases)]
    shapes = [kernel.shape for kernel in policy.kernels]
    fits = shapes == list(itertools.pairwise(widths))
    norms = [array.shape for pair in policy.norms for array in pair]
    fits &= norms in ([], [(width,) for width in widths[1:-1] for _ in range(2)])
    if not (shapes and fits and policy.obs_std.shape == policy.obs_mean.shape):
        raise ValueError("sizes of its layers do not fit")
    if not 0 < policy.action_size <= widths[-1]:
        raise ValueError("it has fewer outputs than actions")
