"""Where MuJoCo Menagerie's models are that tasks of MuJoCo Playground need. No jax, no mujoco.

The package `mujoco-menagerie` keeps them, in a folder that `MENAGERIE_ROOT` names or in its own
cache. Nothing is downloaded here.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Final, NamedTuple

from gmijax.errors import ConfigError

PACKAGE: Final = "mujoco_menagerie"


class _Robot(NamedTuple):
    """What Playground's tasks with a robot need, and whether it draws models for them."""

    models: tuple[str, ...] = ()
    has_randomizer: bool = False


_ROBOTS: Mapping[str, _Robot] = MappingProxyType(
    {
        "Aero": _Robot(("tetheria_aero_hand_open",), has_randomizer=True),
        "Aloha": _Robot(("aloha",)),
        "Apollo": _Robot(("apptronik_apollo",)),
        "Barkour": _Robot(("google_barkour_vb",)),
        "Berkeley": _Robot(("berkeley_humanoid",), has_randomizer=True),
        "G1": _Robot(("unitree_g1",), has_randomizer=True),
        "Go1": _Robot(("unitree_go1",), has_randomizer=True),
        "H1": _Robot(("unitree_h1",)),
        "Leap": _Robot(("leap_hand",), has_randomizer=True),
        "Op3": _Robot(("robotis_op3",)),
        "Panda": _Robot(("franka_emika_panda",)),
        "PandaRobotiq": _Robot(("franka_emika_panda", "robotiq_2f85_v4")),
        "Spot": _Robot(("boston_dynamics_spot",)),
        "T1": _Robot(("booster_t1",), has_randomizer=True),
    }
)
"""How names of Playground's tasks begin -> the robot; all others need no models."""


def _robot(task: str) -> _Robot:
    begins = [prefix for prefix in _ROBOTS if task.startswith(prefix)]
    return _ROBOTS[max(begins, key=len)] if begins else _Robot()


def has_randomizer(task: str) -> bool:
    """Whether Playground brings domain randomisation for a task, by its name there."""
    return _robot(task).has_randomizer


def models_of(task: str) -> tuple[str, ...]:
    """The models that a task of Playground needs, by its name there."""
    return _robot(task).models


def require_models(task: str, label: str) -> None:
    """Raises ConfigError, which names `label`, unless the models of a task are here."""
    missing = [name for name in models_of(task) if find_model(name) is None]
    if missing:
        raise ConfigError(f"env={label}: {how_to_get(missing)}")


def model_folder(name: str) -> Path:
    """The folder of a model; raises ConfigError if it is not here."""
    if (folder := find_model(name)) is None:
        raise ConfigError(how_to_get([name]))
    return folder


def find_model(name: str) -> Path | None:
    """The folder of a model, None if it is not here."""
    if root := os.environ.get("MENAGERIE_ROOT"):
        return _whole(Path(root) / name)
    if importlib.util.find_spec(PACKAGE) is not None:
        # By name: it is not installed where gmijax is checked.
        menagerie = importlib.import_module(PACKAGE)
        cache = menagerie.Cache()
        if name in menagerie.names() and cache.is_cached(robot := menagerie.get(name)):
            return _whole(cache.model_path(robot))
    clone = _clone()
    return None if clone is None else _whole(clone / name)


def _whole(folder: Path) -> Path | None:
    """The folder unless it is empty, as one of a clone that was broken off."""
    try:
        return folder if os.listdir(folder / "assets") else None
    except OSError:
        return None


def _clone() -> Path | None:
    """Where Playground itself clones all models to, if one has used it without gmijax."""
    package = playground_folder()
    return None if package is None else package / "external_deps" / "mujoco_menagerie"


def playground_folder() -> Path | None:
    """The folder of the package `mujoco_playground`, None if it is not installed."""
    spec = importlib.util.find_spec("mujoco_playground")
    return None if spec is None or spec.origin is None else Path(spec.origin).parent


def how_to_get(names: Sequence[str]) -> str:
    """What to do about models that are not here."""
    if root := os.environ.get("MENAGERIE_ROOT"):
        return f"MENAGERIE_ROOT={root} has no model {names[0]} (docs/tasks.md)"
    if importlib.util.find_spec(PACKAGE) is None:
        return f"needs the package {PACKAGE} (pip install 'gmijax[playground]')"
    which = f"model of {names[0]} is" if len(names) == 1 else f"models of {', '.join(names)} are"
    return (
        f"the {which} not here; get with: mujoco-menagerie prefetch {' '.join(names)} "
        "(without internet: docs/tasks.md)"
    )
