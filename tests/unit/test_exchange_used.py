"""What the summary says where the exchange is not the plan's."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from gmijax.workers.worker import exchange_used


@pytest.mark.parametrize(
    ("planned", "strategy", "intra", "said"),
    [
        ("mpr", "mpr", "host", {}),
        ("one_shot", "one_shot", "ipc", {}),
        ("one_shot", "mpr", "host", {"strategy": "mpr", "intra": "host"}),
        ("har", "har", "ipc", {"intra": "ipc"}),
        ("har", "har", "host", {"intra": "host"}),
    ],
)
def test_a_fall_back_to_host_memory_is_told(
    planned: str, strategy: str, intra: str, said: dict[str, str]
) -> None:
    plan: Any = SimpleNamespace(strategy=planned)
    reducer: Any = SimpleNamespace(strategy=strategy, intra=intra)
    assert exchange_used(plan, reducer) == said
