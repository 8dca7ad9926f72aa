"""The sweep that a command line with lists stands for, by Hydra's grammar."""

from __future__ import annotations

import copy
import fnmatch
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from hydra.core.override_parser.types import Glob, IntervalSweep, Override, RangeSweep
from hydra.errors import HydraException

from gmijax.cli.arguments import parse, readable
from gmijax.cli.compose import build, compose_dict
from gmijax.cli.groups import choices
from gmijax.config import ClusterConfig, TrainConfig
from gmijax.config.schema import from_dict, to_dict
from gmijax.config.sweep import SweepConfig
from gmijax.errors import ConfigError
from gmijax.sweeps.jobs import Job
from gmijax.sweeps.space import MAX_JOBS, Choices, Interval, corners, grid
from gmijax.sweeps.sweep import SweepWork, sweep_of


@dataclass(frozen=True, kw_only=True)
class SweepHelp(TrainConfig):
    """All keys of a sweep, as `--help` prints them."""

    sweep: SweepConfig


@dataclass(frozen=True, kw_only=True)
class _SweepKeys:
    """Keys of the sweep itself: those of its jobs are a `TrainConfig` each."""

    sweep: SweepConfig
    cluster: ClusterConfig = field(default_factory=ClusterConfig)


def build_sweep(overrides: Sequence[str]) -> SweepWork:
    """The sweep of a command line, with all that can be checked of it.

    Args:
      overrides: `key=value`, of which some have several values: `key=1,2`, `key=choice(a,b)`,
        `key=range(0,3)`, `env=glob(*)`, `key=interval(0,1)`, `key=tag(log,interval(1e-5,1e-2))`.

    Raises:
      ConfigError: as `compose`; an empty list; what a sampler cannot do.
    """
    words = without_folder(overrides)
    overrides = readable("train", overrides)
    given = list(zip(overrides, parse(overrides), strict=True))
    whole = ("run.", "sweep.", "cluster.")
    for text, item in given:
        if item.is_sweep_override() and item.key_or_group.startswith(whole):
            raise ConfigError(f"{text}: expected one value (a list stands in brackets)")

    def of_group(group: str) -> list[str]:
        return [text for text, item in given if item.key_or_group.split(".")[0] == group]

    own, nodes = of_group("sweep"), of_group("cluster")
    fixed = [
        text for text, item in given if text not in own + nodes and not item.is_sweep_override()
    ]
    # Nodes are the sweep's; each job is a training on one machine.
    parts = {"sweep": compose_dict("sweep", own), "cluster": compose_dict("train", nodes)}
    keys = from_dict(_SweepKeys, {key: data[key] for key, data in parts.items() if key in data})
    space = {item.key_or_group: values_of(item) for _, item in given if item.is_sweep_override()}

    config_of = _Composer(fixed, [key for key in space if choices(key)])

    def make_job(number: int, chosen: Mapping[str, str]) -> Job:
        return Job(number, chosen, config_of(chosen))

    points = grid(space) if keys.sweep.sampler == "grid" else corners(space)
    jobs = [make_job(number, chosen) for number, chosen in enumerate(points)]
    return replace(sweep_of(keys.sweep, space, make_job, jobs, keys.cluster), words=words)


def without_folder(words: Sequence[str]) -> tuple[str, ...]:
    """The overrides of a command that many jobs share, but for its folder."""
    return tuple(word for word in words if not word.startswith(("run.dir=", "run.name=")))


class _Composer:
    """Configurations of jobs. Hydra takes a tenth of a second for each: it makes one of each kind.

    Args:
      fixed: overrides of all jobs.
      groups: keys of jobs that choose files of the configuration, on which other defaults depend.
    """

    def __init__(self, fixed: Sequence[str], groups: Sequence[str]) -> None:
        self._fixed, self._groups = fixed, groups
        self._made: dict[tuple[str, ...], dict[str, Any]] = {}

    def __call__(self, chosen: Mapping[str, str]) -> TrainConfig:
        given = [f"{key}={value}" for key, value in chosen.items()]
        kind = tuple(chosen[key] for key in self._groups)
        if kind in self._made:
            data = copy.deepcopy(self._made[kind])
            items = [item for item in parse(given) if item.key_or_group not in self._groups]
            if all(_set(data, item.key_or_group, item.value()) for item in items):
                return from_dict(TrainConfig, data)
        config = build("train", TrainConfig, [*self._fixed, *given])
        self._made[kind] = to_dict(config)
        return config


def _set(data: dict[str, Any], dotted: str, value: Any) -> bool:
    """Sets a value that is there already and is no group; returns whether it is."""
    *groups, key = dotted.split(".")
    for group in groups:
        data = data.get(group, {})
        if not isinstance(data, dict):
            return False
    if key not in data or isinstance(data[key], dict):
        return False
    data[key] = value
    return True


def values_of(item: Override) -> Choices | Interval:
    """The values of a key on a command line.

    Raises:
      ConfigError: there are none, too many, or one comes twice.
    """
    key, value = item.key_or_group, item.value()
    if isinstance(value, IntervalSweep):
        if value.start is None or value.end is None or not value.start < value.end:
            raise ConfigError(f"{item.input_line}: an empty interval")
        is_integer = isinstance(value.start, int) and isinstance(value.end, int)
        return Interval(value.start, value.end, "log" in value.tags, is_integer)
    if isinstance(value, RangeSweep):  # A shuffled one is made whole.
        try:
            numbers = list(itertools.islice(value.range(), MAX_JOBS + 1))
        except (ValueError, HydraException):
            raise ConfigError(f"{item.input_line}: the step must not be 0") from None
        if len(numbers) > MAX_JOBS:
            raise _too_many(item)
    if isinstance(value, Glob):
        found = [
            name
            for name in choices(key)
            if any(fnmatch.fnmatch(name, pattern) for pattern in value.include)
            and not any(fnmatch.fnmatch(name, pattern) for pattern in value.exclude)
        ]
    else:
        found = list(itertools.islice(item.sweep_string_iterator(), MAX_JOBS + 1))
    if not found:
        raise ConfigError(f"{item.input_line}: an empty list")
    if len(found) > MAX_JOBS:
        raise _too_many(item)
    if len(set(found)) < len(found):
        raise ConfigError(f"{item.input_line}: a value is repeated")
    return Choices(tuple(found))


def _too_many(item: Override) -> ConfigError:
    return ConfigError(f"{item.input_line}: at most {MAX_JOBS:,} values are allowed")
