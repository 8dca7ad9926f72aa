"""Names that a configuration may have are those of the registries."""

from __future__ import annotations

from typing import Any, get_args, get_type_hints

from gmijax.collectives.strategies import COSTS
from gmijax.config import (
    ALGORITHMS,
    BackendName,
    EnvConfig,
    StrategyName,
    TemplateName,
    TrainConfig,
)
from gmijax.partition import reduction
from gmijax.partition.templates import DESCRIPTIONS
from gmijax.sim.registry import SUITES
from gmijax.supervise.backends import BACKENDS


def names(kind: Any) -> set[str]:
    return set(get_args(kind))


def test_names_of_the_configuration_are_those_of_the_registries() -> None:
    assert set(BACKENDS) == names(BackendName)
    assert set(DESCRIPTIONS) == names(TemplateName)
    assert set(COSTS) == names(StrategyName)
    assert set(reduction.STRATEGIES) == names(StrategyName) | {"none"}
    assert {"gmijax", *SUITES} == names(get_type_hints(EnvConfig)["suite"])
    assert set(ALGORITHMS) == names(get_type_hints(TrainConfig)["algo"])
