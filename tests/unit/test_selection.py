"""The fastest reduction, by measurements that are kept; without measuring anything."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from supervision import MPS, machine, planned

from gmijax.control import strategy_selection
from gmijax.control.strategy_selection import Probe, candidates, estimated_floats, with_measured
from gmijax.partition import reduction
from gmijax.partition.plan import Plan

MACHINE = machine(2, mps_control=MPS)
plan = partial(planned, MACHINE)


@pytest.fixture(autouse=True)
def with_bindings(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reduction, "is_installed", lambda *_: True)


@pytest.fixture
def kept_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "gmijax" / "reduction"


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> list[Sequence[Probe]]:
    """What was measured: the third probe takes 1 ms, all others 2 ms."""
    calls: list[Sequence[Probe]] = []

    def measure(_plan: Plan, _machine: object, probes: Sequence[Probe], _calls: int) -> list[Any]:
        calls.append(probes)
        return [{"chained_s": 1e-3 if k == 2 else 2e-3} for k in range(len(probes))]

    monkeypatch.setattr(strategy_selection, "measure", measure)
    return calls


@pytest.mark.parametrize(
    ("changes", "intra", "names"),
    [
        ({"gmis_per_gpu": 2}, "auto", ["mpr", "har+host", "har+ipc"]),
        ({"gmis_per_gpu": 2}, "ipc", ["mpr", "har+ipc"]),
        ({"gmis_per_gpu": 2, "backend": "cpu"}, "auto", ["mpr", "har+host"]),
        (
            {"gpus": 2, "gmis_per_gpu": 2},
            "auto",
            ["mpr", "mrr", "har+host", "har+ipc", "one_shot"],
        ),
        ({"gpus": 2, "gmis_per_gpu": 3}, "host", ["mpr", "har+host"]),
    ],
)
def test_everything_that_can_run_is_measured_once(
    changes: dict[str, Any], intra: str, names: list[str]
) -> None:
    assert [probe.name for probe in candidates(plan(**changes), 100, intra)] == names


def test_the_fastest_is_taken_and_kept(kept_in: Path, measured: list[Sequence[Probe]]) -> None:
    first = with_measured(plan(gmis_per_gpu=2), MACHINE, 100)
    assert (first.strategy, first.intra) == ("har", "ipc")
    assert first.selection["paper"] == "mpr"
    assert first.selection["measured"] == "har+ipc"
    assert "har+ipc 1 ms" in first.reasons[-1]
    assert "measured now" in first.reasons[-1]
    assert "Algorithm 1 says mpr" in first.reasons[-1]
    again = with_measured(plan(gmis_per_gpu=2), MACHINE, 100)
    assert (again.strategy, again.selection) == (first.strategy, first.selection)
    assert str(kept_in) in again.reasons[-1]
    assert len(measured) == 1
    with_measured(plan(gmis_per_gpu=3), MACHINE, 100)
    with_measured(plan(gmis_per_gpu=2), MACHINE, 200)
    assert len(measured) == 3
    assert Plan.from_dict(first.to_dict()) == first


def test_a_way_that_does_not_work_here_is_not_taken(
    kept_in: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = [{"chained_s": 2e-3}, {"chained_s": 1e-3}, {"why_not": "no such memory"}]
    monkeypatch.setattr(strategy_selection, "measure", lambda *_: rows)
    for _ in ("measured", "kept"):
        chosen = with_measured(plan(gmis_per_gpu=2), MACHINE, 100)
        assert chosen.selection["measured"] == "har+host"
        assert "har+ipc not usable: no such memory" in chosen.reasons[-1]


def test_a_broken_file_is_measured_again(kept_in: Path, measured: list[Sequence[Probe]]) -> None:
    with_measured(plan(gmis_per_gpu=2), MACHINE, 100)
    (kept,) = kept_in.iterdir()
    for number, content in enumerate(("{", "[]", "{}", '{"mpr": {}}'), start=2):
        kept.write_text(content)
        with_measured(plan(gmis_per_gpu=2), MACHINE, 100)
        assert len(measured) == number


def test_one_gmi_has_nothing_to_measure(kept_in: Path, measured: list[Sequence[Probe]]) -> None:
    assert with_measured(plan(), MACHINE, 100).strategy == "none"
    assert not measured


@pytest.mark.parametrize(
    ("hidden", "exact"),
    [
        # ant, humanoid and shadow_hand; about the figures of the paper's table 5.
        ((256, 128, 64), 110_000),
        ((512, 256, 128), 430_000),
        ((512, 512, 512, 256), 1_300_000),
    ],
)
def test_sizes_are_about_those_of_the_networks(hidden: tuple[int, ...], exact: int) -> None:
    found = estimated_floats(hidden, hidden)
    assert exact / 2 <= found <= exact * 2
    assert found & (found - 1) == 0
