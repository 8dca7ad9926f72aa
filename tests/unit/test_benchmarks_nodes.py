"""Which commands the benchmark of two nodes runs, and what its table makes of their rates."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from benchmarks import records
from benchmarks.evaluation.node_tables import ONE_NODE, TWO_NODES, rows_of, two_nodes_over_one
from benchmarks.evaluation.page import TABLES
from benchmarks.node_cases import WAYS, Case, cases_of, words_of
from benchmarks.nodes import JOB
from benchmarks.records import ResultsFile
from gmijax.cli.compose import compose
from gmijax.cluster.ray_nodes import PASSED_ON

ADDRESS = "cluster.address=127.0.0.1:6379"
JOBS = TWO_NODES["jobs"]


def words(case: Case, *gpus: int) -> list[str]:
    return words_of(case, JOB, gpus, ADDRESS, Path("/runs/one"))


@pytest.mark.parametrize("gmis", [1, 2])
@pytest.mark.parametrize("gpus", [(0, 3), ()])
def test_one_node_has_both_gpus_and_two_nodes_have_one_each(gmis: int, gpus: tuple[int, ...]):
    for case in cases_of([gmis], [], [], None):
        config = compose(*words(case, *gpus)[2:])
        assert config.plan.gmis_per_gpu == gmis
        assert config.num_envs == 8192
        if case.way == ONE_NODE:
            assert (config.plan.gpus, config.cluster.engine) == (gpus or 2, None)
        else:
            assert config.plan.gpus == 1
            assert (config.cluster.engine, config.cluster.nodes) == ("ray", 2)
        assert config.reduce.strategy == ("mpr" if case.way == TWO_NODES["tcp"] else "auto")


def test_the_variables_of_a_way_reach_gmis_of_both_nodes():
    variables = [name for way in WAYS.values() for name in way.variables]
    assert {"NCCL_P2P_DISABLE", "NCCL_SHM_DISABLE", "NCCL_IB_DISABLE"} <= {*variables}
    assert all(name.startswith(PASSED_ON) for name in variables)


def test_without_nccl_a_line_says_what_is_left_out(capsys: pytest.CaptureFixture[str]):
    found = cases_of([1], [2], [1], "no GPU")
    assert [(case.verb, case.way) for case in found] == [
        *(("train", way) for way in (ONE_NODE, TWO_NODES["tcp"])),
        *((verb, way) for verb in ("sweep", "pack") for way in (ONE_NODE, JOBS)),
    ]
    errors = capsys.readouterr().err.splitlines()
    assert [line.rpartition(": ")[2] for line in errors] == ["no GPU"] * 2


@pytest.mark.parametrize(
    ("way", "gpus", "at_once"), [(ONE_NODE, (0, 1), 2), (JOBS, (0, 1), 2), (ONE_NODE, (), 4)]
)
def test_all_jobs_of_a_sweep_run_at_once(way: str, gpus: tuple[int, ...], at_once: int):
    found = words(Case("sweep", 2, way), *gpus)
    assert {f"sweep.jobs_per_gpu={at_once}", "seed=range(4)"} <= {*found}
    assert ("sweep.gpus=[0,1]" in found) == (way == ONE_NODE and bool(gpus))
    assert (ADDRESS in found) == (way == JOBS)


def test_a_job_of_a_pack_trains_with_its_part_of_the_memory():
    found = words(Case("pack", 2, JOBS), 0, 1)
    at = found.index("--")
    assert {ADDRESS, "pack.copies=4", "pack.jobs_per_gpu=2"} <= {*found[:at]}
    overrides = [text.replace("{run_dir}", "/runs/one/000") for text in found[at + 4 :]]
    assert compose(*overrides).plan.memory_fraction == 0.4


def case_of(job: str, way: str, *rates: float | None) -> dict[str, Any]:
    runs = [
        {"failed": "no"}
        if rate is None
        else {
            "summary": {"step_per_s_train": rate, "plan": {"strategy": "flat", "inter": "nccl"}},
            "medians": {"time/reduce_s": 0.002},
            "via": ["P2P"],
        }
        for rate in rates
    ]
    return {"job": job, "way": way, "runs": runs}


def results(**rates: float | None) -> dict[str, Any]:
    """A job on one node and on two, with two more runs of each that are as fast, or failed."""
    cases = [case_of("ant", {"one": ONE_NODE, **TWO_NODES}[k], *[v] * 3) for k, v in rates.items()]
    return {"cases": {case["way"]: case for case in cases}}


def test_a_row_is_a_rate_over_that_of_one_node():
    one, two, _ = rows_of(results(one=200.0, nccl=190.0, sockets=100.0))
    assert one[:2] == ["ant", ONE_NODE]
    assert one[4] == "1"
    assert two[0] == ""
    assert two[2:6] == [
        "`flat`, `nccl`, P2P",
        "190 (190 to 190, n=3)",
        "0.95",
        "2.00 (2.00 to 2.00, n=3)",
    ]


def test_the_newest_call_with_one_node_and_two_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(records, "RESULTS", tmp_path)
    assert TABLES["nodes"]() == ["not measured"]
    for found in (
        results(one=100.0, nccl=50.0),
        results(one=100.0, nccl=98.0, tcp=None),
        results(one=100.0, nccl=None),
    ):
        with ResultsFile(tmp_path / "nodes-nvidia-x.json", "nodes", {}).changing() as written:
            written |= found
    assert {key: text.text for key, text in two_nodes_over_one().items()} == {
        "nccl": "0.98",
        **dict.fromkeys(("sockets", "tcp", "jobs"), "not measured"),
    }
    assert sum("| 0.98 |" in line for line in TABLES["nodes"]()) == 1
