"""Plans over several nodes: shares, strategies, roles, and what is left when a node is lost."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Any

import pytest
from supervision import gpus_of_nodes, machine, plan_on

from gmijax import compose
from gmijax.collectives.nodes.rendezvous import NodeAddresses
from gmijax.collectives.strategies import stages
from gmijax.config import PlanConfig, ReduceConfig, TrainConfig
from gmijax.control.reduced_plan import with_nodes_left
from gmijax.errors import (
    BackendUnavailable,
    ConfigError,
)
from gmijax.partition.plan import Plan
from gmijax.partition.planner import make_plan
from gmijax.supervise.environment import gmi_environment
from gmijax.supervise.job_kinds import calls_of, training_plan


def test_the_plan_of_nodes_has_each_nodes_shares_under_global_ids() -> None:
    here = {"10.0.0.1": machine(0), "10.0.0.2": machine(0)}
    settings = PlanConfig(gmis_per_gpu=2), ReduceConfig(), 16
    plan = make_plan(*settings, machine(0), nodes=here)
    assert plan.layout.gmis_of_gpu == ((0, 1), (2, 3))
    assert [allocation.gpu for allocation in plan.allocations] == [0, 0, 1, 1]
    assert plan.allocations[2].cpus == plan.allocations[0].cpus
    assert (plan.strategy, plan.inter) == ("mpr", "tcp")
    assert plan.nodes_data()[1] == {"address": "10.0.0.2", "gmis": [2, 3]}
    assert Plan.from_dict(plan.to_dict()) == plan
    old = {key: value for key, value in plan.to_dict().items() if key != "nodes"}
    assert Plan.from_dict(old | {"layout": [[0, 1], [2, 3]]}).layout.num_nodes == 1
    with pytest.raises(ConfigError, match=r"mrr: cannot run on layout .*: in each node its rings"):
        make_plan(settings[0], ReduceConfig(strategy="mrr"), 16, machine(0), nodes=here)


def test_gmis_of_nodes_share_the_gpus_of_their_node() -> None:
    plan = plan_on(gpus_of_nodes(2, 3), gpus=2, gmis_per_gpu=2)
    assert plan.backend == "mps"
    devices = [allocation.device for allocation in plan.allocations]
    assert devices == [f"GPU-{node}-{gpu}" for node in (0, 1) for gpu in (0, 1) for _ in range(2)]
    assert [allocation.gpu for allocation in plan.allocations] == [0, 0, 1, 1, 2, 2, 3, 3]
    assert {allocation.memory_fraction for allocation in plan.allocations} == {0.4}
    variables = gmi_environment(plan, 5, {}, Path("/cache"), {})
    assert variables["CUDA_VISIBLE_DEVICES"] == "GPU-1-0"
    assert variables["XLA_CLIENT_MEM_FRACTION"] == "0.4"
    assert Plan.from_dict(plan.to_dict()) == plan


@pytest.mark.parametrize(
    ("gpus", "gmis", "named", "strategy", "inter"),
    [
        (1, 1, "auto", "flat", "nccl"),
        (2, 1, "auto", "flat", "nccl"),
        (1, 2, "auto", "one_shot", "nccl"),
        (2, 2, "auto", "one_shot", "nccl"),
        (2, 2, "paper", "mrr", "nccl"),
        (1, 2, "har", "har", "nccl"),
        (1, 1, "flat", "flat", "nccl"),
        (1, 1, "paper", "mpr", "tcp"),
        (2, 2, "mpr", "mpr", "tcp"),
    ],
)
def test_nodes_with_gpus_exchange_by_nccl_but_for_mpr(
    gpus: int, gmis: int, named: str, strategy: str, inter: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gmijax.partition.reduction.is_installed", lambda *_: True)
    nodes = gpus_of_nodes(gpus, gpus)
    settings = PlanConfig(gpus=gpus, gmis_per_gpu=gmis), ReduceConfig(strategy=named), 16
    plan = make_plan(*settings, nodes["10.0.0.0"], nodes=nodes)
    assert (plan.strategy, plan.inter) == (strategy, inter)
    assert [why for why in plan.reasons if why.startswith(f"inter {inter}: ")]
    transports = [s.transport for s in stages(strategy, plan.layout, plan.intra, plan.inter)]
    assert ("nodes" in transports, "ring" in transports) == (inter == "tcp", inter == "nccl")
    assert Plan.from_dict(plan.to_dict()) == plan
    old = {key: value for key, value in plan.to_dict().items() if key != "inter"}
    assert Plan.from_dict(old).inter is None


@pytest.mark.parametrize(
    ("missing", "gmis", "strategy", "why"),
    [
        ("nccl", 1, "mpr", "need the package nccl4py"),
        ("nccl", 2, "one_shot", "need the package nccl4py"),
        ("cuda", 1, "mpr", "need the package cuda-bindings"),
    ],
)
def test_nodes_without_nccl_exchange_by_tcp(
    missing: str, gmis: int, strategy: str, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "gmijax.partition.reduction.is_installed", lambda *modules: missing not in modules
    )
    plan = plan_on(gpus_of_nodes(1, 1), gmis_per_gpu=gmis)
    assert (plan.strategy, plan.inter) == (strategy, "tcp")
    [reason] = [reason for reason in plan.reasons if reason.startswith("inter tcp: ")]
    assert why in reason
    if missing == "nccl" and gmis == 1:
        nodes, named = gpus_of_nodes(1, 1), ReduceConfig(strategy="flat")
        with pytest.raises(ConfigError, match=r"reduce\.strategy=flat: .* nccl4py"):
            make_plan(PlanConfig(), named, 16, nodes["10.0.0.0"], nodes=nodes)


def test_nodes_of_one_machine_that_have_one_gpu_exchange_by_tcp(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("gmijax.partition.reduction.is_installed", lambda *_: True)
    plan = plan_on({"a": machine(1), "a#1": machine(1)}, backend="share")
    assert (plan.strategy, plan.inter) == ("mpr", "tcp")
    assert any("inter tcp: " in why and "the same GPU" in why for why in plan.reasons)


def test_nccl_between_nodes_listens_where_the_node_says(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gmijax.partition.reduction.is_installed", lambda *_: True)
    plan = plan_on(gpus_of_nodes(1, 1))
    assert "NCCL_SOCKET_IFNAME" not in gmi_environment(plan, 1, {}, Path("/cache"), {})
    own = {"NCCL_SOCKET_IFNAME": "=eth1"}
    assert own.items() <= gmi_environment(plan, 1, own, Path("/cache"), {}).items()


def test_rings_inside_of_nodes_stay_on_the_loopback(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gmijax.partition.reduction.is_installed", lambda *_: True)
    here, groups = gpus_of_nodes(2, 2), ("plan.serving_gpus=[0,1]", "plan.training_gpus=[2,3]")
    config = asynchronous_config("plan.gpus=2", "reduce.strategy=mrr", *groups, nodes=2)
    trains = training_plan(config, here["10.0.0.0"], nodes=here)
    assert (trains.strategy, trains.inter) == ("mrr", None)
    for plan in (trains, dataclasses.replace(trains, inter="tcp")):
        found = gmi_environment(plan, 1, {}, Path("/cache"), {})
        assert found["NCCL_SOCKET_IFNAME"] == "lo"


def test_a_gpu_of_two_nodes_of_one_machine_has_half_of_its_memory_for_each() -> None:
    nodes = {"a": machine(1), "a#1": machine(1)}
    plan = plan_on(nodes, backend="share", gmis_per_gpu=2)
    assert [allocation.memory_fraction for allocation in plan.allocations] == [0.2] * 4
    assert "nodes of one machine have the same GPUs, and divide their memory" in plan.reasons
    with pytest.raises(ConfigError, match=r"4 GMIs on GPU 0 would reserve 1.20 of its memory"):
        plan_on(nodes, backend="share", gmis_per_gpu=2, memory_fraction=0.3)


def test_nodes_that_cannot_do_the_same_take_turns_or_are_refused_by_name() -> None:
    nodes = gpus_of_nodes(1, 1)
    bare = dataclasses.replace(nodes["10.0.0.1"], mps_control=None, driver_version="575.1")
    plan = plan_on({**nodes, "10.0.0.1": bare}, gmis_per_gpu=2)
    assert plan.backend == "share"
    assert any("take turns" in why and "(node 10.0.0.1)" in why for why in plan.reasons)
    warning = "warning: nodes differ in NVIDIA driver: 580.159.03 on 10.0.0.0; 575.1 on 10.0.0.1"
    assert warning in plan.reasons
    with pytest.raises(
        BackendUnavailable, match=r"node 10\.0\.0\.1: plan\.backend=mps: nvidia-cuda"
    ):
        plan_on({**nodes, "10.0.0.1": bare}, backend="mps", gmis_per_gpu=2)
    with pytest.raises(ConfigError, match=r"node 10\.0\.0\.1: plan\.gpus=2: .* 1 usable"):
        plan_on(gpus_of_nodes(2, 1), gpus=2)
    old = gpus_of_nodes(1, 1, compute_capability=(8, 0))["10.0.0.1"]
    with pytest.raises(ConfigError, match=r"capability of GPUs: 9.* on .*; 8\.0 on 10\.0\.0\.1;"):
        plan_on({**nodes, "10.0.0.1": old})


def asynchronous_config(*overrides: str, nodes: int) -> TrainConfig:
    settings = ("env=ball_balance", "algo=a3c", "cluster.engine=ray", "num_envs=16")
    return compose(*settings, f"cluster.nodes={nodes}", *overrides)


def asynchronous_plan(*overrides: str, nodes: int = 2) -> Plan:
    config = asynchronous_config(*overrides, nodes=nodes)
    machines = {f"10.0.0.{node}": machine(0) for node in range(nodes)}
    return training_plan(config, machine(0), nodes=machines)


@pytest.mark.parametrize(
    ("overrides", "nodes", "layout", "of_nodes", "strategy"),
    [
        ((), 2, [[1], [0]], [[1], [0]], "none"),
        (("plan.serving_gmis_per_gpu=2",), 2, [[1, 2], [0]], [[1, 2], [0]], "none"),
        (("plan.gpus=2",), 2, [[1], [2], [3], [0]], [[1, 2], [0, 3]], "none"),
        (("plan.training_gmis_per_gpu=2",), 2, [[2], [0, 1]], [[2], [0, 1]], "mpr"),
        (
            ("plan.serving_gpus=[0,1]", "plan.training_gpus=[0,1]"),
            *(2, [[0, 2], [1, 3]], [[0, 2], [1, 3]], "mpr"),
        ),
        (("plan.serving_gpus=2", "plan.training_gpus=2"), 4, None, [[2], [3], [0], [1]], "mpr"),
    ],
)
def test_agents_and_trainers_are_placed_over_the_gpus_of_all_nodes(
    overrides: tuple[str, ...], nodes: int, layout: Any, of_nodes: Any, strategy: str
) -> None:
    plan = asynchronous_plan(*overrides, nodes=nodes)
    assert plan.to_dict()["layout"] == (layout or of_nodes)
    assert [node["gmis"] for node in plan.nodes_data()] == of_nodes
    assert plan.strategy == strategy
    assert [allocation.gmi for allocation in plan.allocations] == list(plan.layout.gmis)
    assert [plan.layout.gpu_of(allocation.gmi) for allocation in plan.allocations] == [
        s.gpu for s in plan.allocations
    ]
    assert Plan.from_dict(plan.to_dict()) == plan


def test_who_calls_whom_over_nodes() -> None:
    plan = asynchronous_plan("plan.gpus=2", "plan.training_gmis_per_gpu=2")
    assert plan.nodes_data()[1]["gmis"] == [0, 1, 4]  # Trainers 0 and 1, agents 2 to 4.
    experience, weights = ((0, 2), (0, 3), (1, 2), (1, 3)), ((2, 0), (3, 0))
    assert calls_of(plan) == (*experience, *weights)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (("plan.serving_gpus=2", "plan.training_gpus=1"), "take 3 GPUs, .*as many"),
        (("plan.serving_gpus=[0]", "plan.training_gpus=[3]"), "the last is number 3; on 2"),
        (
            ("plan.gpus=2", "plan.serving_gpus=[0]", "plan.training_gpus=[1,2,3]"),
            "as many of them",
        ),
        (("channel.transport=device",), "device: the job is on several nodes; use memory"),
        (("plan.layout=[[0]]",), "with the decoupled template give"),
    ],
)
def test_placements_that_nodes_cannot_have_are_refused(
    overrides: tuple[str, ...], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        asynchronous_plan(*overrides)


@pytest.mark.parametrize(
    ("overrides", "left", "of_nodes"),
    [
        ((), 1, [[0, 1]]),
        (("plan.serving_gpus=[0,1,2]", "plan.training_gpus=[0,1,2]"), 1, [[0, 1]]),
        (
            ("plan.gpus=2", "plan.serving_gpus=[0,2,4]", "plan.training_gpus=[1,3,5]"),
            *(2, [[0, 2], [1, 3]]),
        ),
        (("plan.serving_gpus=[0,1]", "plan.training_gpus=[2]"), 2, None),
        (("plan.serving_gpus=2", "plan.training_gpus=1"), 2, None),
    ],
)
def test_agents_and_trainers_go_on_with_the_nodes_that_are_left(
    overrides: tuple[str, ...], left: int, of_nodes: list[list[int]] | None
) -> None:
    config = asynchronous_config(*overrides, nodes=3)
    plan = training_plan(config, machine(0), nodes=dict.fromkeys("abc", machine(0)))
    nodes = dict.fromkeys("abc"[:left], machine(0))
    if of_nodes is None:
        with pytest.raises(ConfigError, match=r"plan\.serving_gpus.*, plan\.training_gpus"):
            with_nodes_left(config, plan, nodes)
    else:
        again, [note] = with_nodes_left(config, plan, nodes)
        assert [node["gmis"] for node in again.nodes_data()] == of_nodes
        assert note.startswith(f"{3 - left} nodes of the job are gone: continuing with {left}")


def test_nodes_know_the_calls_and_count_leaders_among_those_that_train() -> None:
    nodes = NodeAddresses(2, (("a", 1), ("b", 2), ("c", 3)), b"secret", {(0, 3): "a:4"})
    fd = nodes.to_file()
    assert NodeAddresses.from_file(fd) == nodes
    os.close(fd)
    assert nodes.among((1, 2))[:2] == (1, (("b", 2), ("c", 3)))


def test_a_job_goes_on_with_the_nodes_that_are_left() -> None:
    config = compose("env=ball_balance", "cluster.engine=ray", "num_envs=16", "seed=3")
    plan = training_plan(config, machine(0), nodes={"a": machine(0), "b": machine(0)})
    assert with_nodes_left(config, plan, {"c": machine(0), "b": machine(0)})[1] == ()
    left, [note] = with_nodes_left(config, plan, {"b": machine(0)})
    assert (left.nodes, left.layout.num_gmis, left.strategy) == (("b",), 1, "none")
    assert "1 nodes of the job are gone: continuing with 1, layout [[0]]" in note
    assert left.reasons[-1] == note
