"""The jobs that a command line with lists stands for, by Hydra's grammar of sweeps."""

from __future__ import annotations

import fnmatch
import itertools
from collections.abc import Sequence
from dataclasses import dataclass

from hydra.core.override_parser.types import Glob, Override

from gmijax.cli.compose import build, choices, compose_dict, parse, with_custom_task
from gmijax.config import TrainConfig
from gmijax.config.schema import from_dict
from gmijax.config.sweep import SweepConfig
from gmijax.errors import ConfigError
from gmijax.sweeps.jobs import Job

MAX_JOBS = 10_000
"""More would be a slip of the keyboard."""


@dataclass(frozen=True, kw_only=True)
class SweepHelp(TrainConfig):
    """All keys of a sweep, as `--help` prints them."""

    sweep: SweepConfig


def build_sweep(overrides: Sequence[str]) -> tuple[SweepConfig, tuple[Job, ...]]:
    """The settings and the jobs of a sweep, all of them checked.

    Raises:
      ConfigError: as `compose` and `expand`.
    """
    overrides = [part for text in overrides for part in with_custom_task("train", text)]
    given = list(zip(overrides, parse(overrides), strict=True))
    own = [text for text, item in given if item.key_or_group.split(".")[0] == "sweep"]
    fixed = [text for text, item in given if text not in own and not is_list(item)]
    lists = [text for text, item in given if is_list(item)]
    for text, item in given:
        if is_list(item) and item.key_or_group.startswith(("run.", "sweep.")):
            raise ConfigError(f"{text}: expected one value (a list stands in brackets)")
    sweep = from_dict(SweepConfig, compose_dict("sweep", own)["sweep"])
    jobs = []
    for number, chosen in enumerate(expand(lists)):
        told = [f"{key}={value}" for key, value in chosen.items()]
        jobs.append(Job(number, chosen, build("train", TrainConfig, [*fixed, *told])))
    return sweep, tuple(jobs)


def expand(overrides: Sequence[str]) -> list[dict[str, str]]:
    """Every combination of the values that `overrides` list, the last key changing fastest.

    Args:
      overrides: `key=value`, of which some have several: `key=1,2`, `key=choice(a,b)`,
        `key=range(0,3)`, `env=glob(*)`.

    Returns:
      Of each job the overrides with a list: key -> value.

    Raises:
      ConfigError: no such grammar, an empty list, or one without a finite number of values.
    """
    axes = {item.key_or_group: _values(item) for item in parse(overrides) if is_list(item)}
    count = 1
    for key, values in axes.items():
        if not values:
            raise ConfigError(f"{key}: an empty list")
        if len(set(values)) < len(values):
            raise ConfigError(f"{key}={','.join(values)}: a value that comes twice")
        count *= len(values)
    if count > MAX_JOBS:
        raise ConfigError(f"{' '.join(axes)}: {count:,} jobs; at most {MAX_JOBS:,} are allowed")
    return [dict(zip(axes, values, strict=True)) for values in itertools.product(*axes.values())]


def is_list(item: Override) -> bool:
    """Whether an override has several values."""
    return item.is_sweep_override()


def _values(item: Override) -> list[str]:
    value = item.value()
    if isinstance(value, Glob):
        names = choices(item.key_or_group)
        return [
            name
            for name in names
            if any(fnmatch.fnmatch(name, pattern) for pattern in value.include)
            and not any(fnmatch.fnmatch(name, pattern) for pattern in value.exclude)
        ]
    if not item.is_discrete_sweep():
        raise ConfigError(f"{item.input_line}: expected values, not an interval")
    return list(item.sweep_string_iterator())
