"""What works beside training: films, export, sweeps, curves; and what mends them."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Final, NamedTuple

from gmijax.config.env import ROBOTS
from gmijax.machine.opengl import first_opengl, opengls, what_is_missing
from gmijax.sim.robot_models import find_model, how_to_get, models_of

OPENGL_TIMEOUT_S: Final = 60.0
"""Longest wait for a picture."""


class Extra(NamedTuple):
    """Something that needs optional packages."""

    packages: tuple[str, ...]
    brings: str  # What it is good for.
    install: str  # What brings the packages.


EXTRAS: Final[Mapping[str, Extra]] = MappingProxyType(
    {
        "ONNX": Extra(
            ("jax2onnx", "onnx", "onnxruntime"), "gmijax export as ONNX", "'gmijax[export]'"
        ),
        "Optuna": Extra(("optuna",), "sweep.sampler, sweep.pruner", "'gmijax[sweep]'"),
        "TensorBoard": Extra(("tensorboard",), "tensorboard --logdir RUN", "tensorboard"),
        "W&B": Extra(("wandb",), "wandb.mode", "'gmijax[wandb]'"),
        "Ray": Extra(("ray",), "several machines, cluster.engine=ray", "'gmijax[ray]'"),
        "viewer": Extra(("viser",), "gmijax view", "'gmijax[view]'"),
    }
)


class Feature(NamedTuple):
    """One of them here."""

    name: str
    usable: bool
    why: str  # What it is good for, or the line that mends it.


class OpenGl(NamedTuple):
    """What draws films here."""

    name: str | None  # None: nothing does.
    why_not: str = ""  # In one line, with what helps.


def find_opengl_here() -> OpenGl:
    """Draws a small picture with each OpenGL until one can, each in a process of its own."""
    tried = opengls("egl", "osmesa")
    gl, message = first_opengl(tried, OPENGL_TIMEOUT_S)
    if gl is not None:
        return OpenGl(gl)
    return OpenGl(None, f"{what_is_missing(tried)}; the last one: {message}")


def features(versions: Mapping[str, str | None], opengl: OpenGl | None) -> Iterator[Feature]:
    """What works here.

    Args:
      versions: of the packages of `EXTRAS`, None or nothing for what is not installed.
      opengl: None: not tried.
    """
    if opengl is not None:
        why = f"a picture was drawn with {opengl.name}" if opengl.name else opengl.why_not
        yield Feature("films", opengl.name is not None, why)
    for name, extra in EXTRAS.items():
        missing = [package for package in extra.packages if not versions.get(package)]
        why = f"{extra.brings}: pip install {extra.install}" if missing else extra.brings
        yield Feature(name, not missing, why)
    if importlib.util.find_spec("mujoco_playground") is not None:
        yield _robot_models()


def _robot_models() -> Feature:
    """Those of `env=go1` and others; tasks of Playground that need none run without them."""
    names = sorted({name for task in ROBOTS.values() for name in models_of(task)})
    missing = [name for name in names if find_model(name) is None]
    return Feature(
        "robot models", not missing, how_to_get(missing) if missing else "of env=go1, ..."
    )
