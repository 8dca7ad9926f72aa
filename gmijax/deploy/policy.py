"""`gmijax.load_policy`: a trained or exported policy as a function of observations.

An exported file needs no checkpoint; an ONNX file needs not even jax.
"""

from __future__ import annotations

import importlib.util
import json
import os
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gmijax.deploy.sealed import unsealed
from gmijax.errors import ConfigError, lines_of
from gmijax.runs.folder import ExportPaths, read_json
from gmijax.runs.resume import choose_checkpoint

_Actions = npt.NDArray[np.float32]


class Policy:
    """A policy that acts deterministically: `policy(obs) -> actions`.

    Attributes:
      obs_size: O, length of an observation.
      action_size: A, length of an action.
      metadata: what the policy is, as in `policy.json` of an export.
    """

    def __init__(
        self,
        act: Callable[[_Actions], npt.ArrayLike],
        obs_size: int,
        action_size: int,
        metadata: Mapping[str, Any],
    ) -> None:
        self._act = act
        self.obs_size = obs_size
        self.action_size = action_size
        self.metadata = metadata

    def __call__(self, obs: npt.ArrayLike) -> _Actions:
        """Actions [N, A] in [-1, 1] for raw observations [N, O]; [A] for one observation [O].

        Raises:
          ConfigError: observations of another shape.
        """
        given = np.asarray(obs, np.float32)
        if given.ndim not in (1, 2) or given.shape[-1] != self.obs_size:
            raise ConfigError(
                f"obs: shape {list(given.shape)}, expected [{self.obs_size}] or "
                f"[N, {self.obs_size}]"
            )
        if given.shape[0] == 0:  # Not every program takes none.
            return np.zeros((0, self.action_size), np.float32)
        actions = np.asarray(self._act(np.atleast_2d(given)))
        return actions[0] if given.ndim == 1 else actions


def load_policy(path: str | os.PathLike[str]) -> Policy:
    """Loads a trained policy.

    Loading a file runs code in it: load files only from sources that you trust. A RuntimeWarning
    names every damaged checkpoint that was skipped for an older one.

    Args:
      path: a run folder (its newest checkpoint), a checkpoint folder, `last`, or a file that
        `python -m gmijax.export` wrote, `.onnx` or `.stablehlo`.

    Examples:
      >>> policy = load_policy("runs/ant-ppo-20260101-120000")
      >>> actions = policy(np.zeros(policy.obs_size))

    Raises:
      ConfigError: there is no such folder or file, or it holds no policy.
    """
    text = os.fspath(path)
    kinds = {".onnx": _from_onnx, ".stablehlo": _from_stablehlo}
    kind = kinds.get(os.path.splitext(text)[1])
    if kind is None:
        _require_run_folder(text)
        checkpoint, passed_over = choose_checkpoint(text, "path")
        for line in passed_over:
            warnings.warn(line, RuntimeWarning, stacklevel=2)
        return _from_checkpoint(checkpoint)
    if not os.path.isfile(text):  # Unlike `Path.is_file` it takes any text.
        raise ConfigError(f"path={text}: no such file")
    return kind(Path(text))


def _require_run_folder(path: str) -> None:
    """Names the file that the folder of an export stands for, or what may be given."""
    exported = ExportPaths(Path(path))
    for file in (exported.onnx, exported.stablehlo):
        if os.path.isfile(file):
            raise ConfigError(f"path={path}: an exported policy is a file; did you mean {file}?")
    if os.path.isfile(path):
        raise ConfigError(
            f"path={path}: is not a folder of a run or a checkpoint, and no file .onnx or "
            ".stablehlo"
        )


def _from_checkpoint(checkpoint: Path) -> Policy:
    import jax

    from gmijax.deploy.trained import trained_policy

    trained = trained_policy(checkpoint)
    return Policy(jax.jit(trained.act), trained.obs_size, trained.action_size, trained.metadata)


def _from_onnx(path: Path) -> Policy:
    if importlib.util.find_spec("onnxruntime") is None:
        raise ConfigError(
            f"path={path}: needs the package onnxruntime (pip install 'gmijax[export]')"
        )
    import onnxruntime

    try:
        session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    except Exception as error:  # Its exceptions have no base of their own.
        raise ConfigError(f"path={path}: not an ONNX model ({lines_of(error)[0]})") from error
    texts = session.get_modelmeta().custom_metadata_map
    if "gmijax_version" not in texts:
        raise ConfigError(f"path={path}: not written by gmijax.export")
    try:
        metadata = {name: json.loads(text) for name, text in texts.items()}
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"path={path}: its metadata are broken ({error})") from None
    sizes = _sizes(path, metadata, session)
    names = session.get_inputs()[0].name, session.get_outputs()[0].name

    def act(obs: _Actions) -> npt.ArrayLike:
        return np.asarray(session.run([names[1]], {names[0]: obs})[0])

    return Policy(act, *sizes, metadata)


def _sizes(path: Path, metadata: Mapping[str, Any], session: Any) -> tuple[int, int]:
    """O and A of an ONNX model; raises ConfigError if it takes or gives anything else."""
    sizes: list[int] = []
    ends = {"obs_size": session.get_inputs(), "action_size": session.get_outputs()}
    for key, found in ends.items():
        size, kinds = metadata.get(key), [(node.type, node.shape[1:]) for node in found]
        if type(size) is not int or kinds != [("tensor(float)", [size])]:
            raise ConfigError(
                f"path={path}: not a policy: {kinds} where float32 [N, {key}={size!r}] is expected"
            )
        sizes.append(size)
    return sizes[0], sizes[1]


def _from_stablehlo(path: Path) -> Policy:
    import jax

    try:
        # Before anything of it is looked at: a program that is damaged ends this process.
        exported = jax.export.deserialize(bytearray(unsealed(path.read_bytes())))
        (obs,), (actions,) = exported.in_avals, exported.out_avals
        (_, obs_size), (_, action_size) = obs.shape, actions.shape
    except Exception as error:  # Bytes of anything else fail in any way.
        raise ConfigError(
            f"path={path}: not a policy of gmijax.export ({lines_of(error)[0]})"
        ) from error
    beside = path.with_suffix(".json")
    metadata = read_json(beside) if os.path.lexists(beside) else {}
    return Policy(jax.jit(exported.call), int(obs_size), int(action_size), metadata)
