"""Jobs on several nodes without Ray: bad input, what a node says and does, nodes that are lost."""

from __future__ import annotations

import builtins
import dataclasses
import json
import os
import signal
from pathlib import Path
from typing import Any

import pytest
from supervision import gpu, machine, make_launch

from gmijax import compose
from gmijax.cluster import node as nodes
from gmijax.cluster import ray_nodes
from gmijax.cluster.checks import by_name, require_alike, require_shared
from gmijax.cluster.cluster_job import BackendOfNodes, ClusterJob
from gmijax.cluster.node import (
    Facts,
    Node,
    Opened,
    Seen,
    TrainingNode,
    address_of,
    own_versions,
)
from gmijax.cluster.ray_nodes import Joined, RayCluster
from gmijax.cluster.remote_gmi import RemoteNode
from gmijax.cluster.survey import Surveyed, differences, lines_of_nodes, nodes_as_data
from gmijax.collectives.nodes.meeting import Nodes
from gmijax.collectives.strategies import stages
from gmijax.config import ClusterConfig, PlanConfig, ReduceConfig, TrainConfig
from gmijax.control.restarts import with_nodes_left
from gmijax.errors import (
    BackendUnavailable,
    ConfigError,
    GmiFailed,
    JobInterrupted,
    ReportedError,
)
from gmijax.machine.snapshot import Machine
from gmijax.partition.plan import Plan
from gmijax.partition.planner import make_plan
from gmijax.runs.folder import GmiPaths, RunPaths
from gmijax.supervise.environment import gmi_environment
from gmijax.supervise.failures import describe_exit, first_cause, is_consequence
from gmijax.supervise.heartbeat import Heartbeat
from gmijax.supervise.kinds import JobKind, calls_of, training_plan


class FakeAnswer:
    """An answer that is there."""

    def __init__(self, value: Any) -> None:
        self.value = value

    def is_there(self) -> bool:
        return True

    def get(self) -> Any:
        if isinstance(self.value, Exception):
            raise self.value
        return self.value


def a_node(**answers: Any) -> RemoteNode:
    def ask(method: str, *_: Any) -> FakeAnswer:
        return FakeAnswer(answers.get(method))

    return RemoteNode(ask, 1, "10.0.0.2")


def joined(node: RemoteNode, versions: dict[str, str | None] | None = None) -> list[Joined]:
    return [Joined(node, Facts(node.address, machine(0), versions or own_versions()))]


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (("cluster.engine=slurm",), "cluster.engine=slurm: expected one of ray or null"),
        (("cluster.address=ray://head:10001",), "must be started on a node of the cluster"),
        (("cluster.engine=ray", "algo=a3c"), "nodes=auto: with algo=a3c give a number"),
        (("cluster.engine=ray", "plan.template=tdg_ex"), "template=tdg_ex: not with cluster"),
        (("cluster.engine=ray", "plan.gpus=[1]"), r"gpus=\[1\]: Ray chooses the GPUs of nodes"),
        (("cluster.engine=ray", "num_envs=auto"), "num_envs=auto: a search is for one machine"),
        (("cluster.nodes=0",), "cluster.nodes=0: must be at least 1"),
    ],
)
def test_what_cannot_be_on_nodes_is_refused_by_its_key(
    overrides: tuple[str, ...], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        compose("env=ball_balance", *overrides)


def test_without_ray_or_a_cluster_the_line_says_what_to_do(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Ray:
        is_initialized = staticmethod(lambda: False)

        @staticmethod
        def init(**_: Any) -> None:
            raise ConnectionError("Could not find any running Ray instance.\nMore words.")

    monkeypatch.setattr(ray_nodes, "_import_ray", Ray)
    with pytest.raises(ConfigError, match=r"address=auto: no cluster .*`ray start --head`"):
        RayCluster(ClusterConfig(), Node)
    with pytest.raises(ConfigError, match=r"address=127\.0\.0\.1:1: nobody answers there"):
        RayCluster(ClusterConfig(address="127.0.0.1:1"), Node)
    with pytest.raises(ConfigError, match="expected auto, local or host:port"):
        RayCluster(ClusterConfig(address="somewhere"), Node)
    monkeypatch.undo()
    real = builtins.__import__

    def no_ray(name: str, *arguments: Any) -> Any:
        if name.partition(".")[0] == "ray":
            raise ImportError(name)
        return real(name, *arguments)

    monkeypatch.setattr(builtins, "__import__", no_ray)
    with pytest.raises(ConfigError, match=r"ray is not installed \(pip install 'gmijax\[ray\]'"):
        RayCluster(ClusterConfig(), Node)


def test_fewer_nodes_than_asked_for_are_refused_once_the_wait_is_over(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Ray:
        is_initialized = staticmethod(lambda: True)

        @staticmethod
        def nodes() -> list[dict[str, Any]]:
            return [
                {"Alive": True, "Resources": {"CPU": 4.0, "GPU": 1.0}},
                {"Alive": True, "Resources": {"CPU": 1.0}},
                {"Alive": False, "Resources": {"CPU": 4.0}},
            ]

        @staticmethod
        def wait(*_: Any, **__: Any) -> None:
            """Nothing is asked."""

    monkeypatch.setattr(ray_nodes, "_import_ray", Ray)
    cluster = RayCluster(ClusterConfig(wait_s=0.0), Node)
    with pytest.raises(ConfigError, match="nodes=2: the cluster has 1 nodes with 2 CPUs, and no"):
        cluster.join(2, 2)
    with pytest.raises(ConfigError, match="nodes=auto: the cluster has 0 nodes with 8 CPUs"):
        cluster.join(8, None)
    with pytest.raises(ConfigError, match=r"nodes=auto: .* has 0 nodes with 2 CPUs and 2 GPUs"):
        cluster.join(2, None, least_gpus=2, most_gpus=2)
    assert cluster.has_gpus
    patient = RayCluster(ClusterConfig(wait_s=100.0), Node)
    with pytest.raises(JobInterrupted, match="while it waited for nodes"):
        patient.join(2, 2, is_unwanted=lambda: True)


def test_several_nodes_of_a_machine_have_names_of_their_own() -> None:
    nodes = [*joined(a_node()), *joined(a_node())]
    assert by_name(nodes) == {"10.0.0.2": nodes[0], "10.0.0.2#1": nodes[1]}


def test_nodes_with_other_versions_are_refused() -> None:
    nodes = joined(a_node(), {**own_versions(), "jax": "0.1"})
    with pytest.raises(ConfigError, match=r"node 10\.0\.0\.2 has jax 0\.1, this one has"):
        require_alike(nodes)


def test_packages_for_gpus_are_compared_between_nodes_that_have_some() -> None:
    versions = {**own_versions(), "jax-cuda13-plugin": "0.9"}
    facts = [
        Facts(name, machine(1), versions | {"cuda-bindings": bindings})
        for name, bindings in (("a", "13.0"), ("b", "13.1"))
    ]
    nodes = [Joined(RemoteNode(a_node().call, 0, one.address), one) for one in facts]
    require_alike(nodes[:1])
    with pytest.raises(ConfigError, match=r"node b has cuda-bindings 13\.1, node a has 13\.0"):
        require_alike(nodes)
    without = [Joined(one.remote, one.facts._replace(machine=machine(0))) for one in nodes]
    require_alike(without)


def test_the_doctor_says_in_what_nodes_differ() -> None:
    own = own_versions()
    nodes = {
        "a": Surveyed(Facts("a", machine(2), own), 0.01),
        "b": Surveyed(Facts("b", machine(1), {**own, "jax": "0.1", "cuda-bindings": "13"}), -90.0),
        "c": Surveyed(Facts("c", machine(0), own), 0.0),
    }
    problems, notes = differences(nodes)
    assert problems == [
        f"nodes differ in jax: {own['jax']} on a, c; 0.1 on b",
        "nodes differ in cuda-bindings: none on a; 13 on b",
    ]
    assert notes == [
        "nodes differ in GPUs: 2 x H200 on a; 1 x H200 on b; none on c",
        "nodes differ in NVIDIA driver: 580.159.03 on a, b; none on c",
        "the clock of b is -90.0 s from that of this machine",
    ]
    alike = {name: node for name, node in nodes.items() if name == "a"}
    assert differences(alike) == ([], [])
    [line] = lines_of_nodes(alike)
    assert line.startswith(f"node a: gmijax {own['gmijax']}, Python")
    assert line.endswith("GPUs 2 x H200, clock +0.010 s")
    json.dumps(nodes_as_data(nodes))


def test_a_run_folder_that_a_node_does_not_see_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gmijax.cluster.checks._SHOWS_S", 0.0)
    with pytest.raises(ConfigError, match=r"node 10\.0\.0\.2 does not see .* or cannot write"):
        require_shared(joined(a_node(sees=False)), tmp_path / "runs" / "new")
    require_shared(joined(a_node(sees=True)), tmp_path / "runs" / "new")
    assert not list(tmp_path.iterdir())


def test_a_node_sees_what_is_in_a_file(tmp_path: Path) -> None:
    (tmp_path / "probe").write_text("secret")
    sees = Node.__new__(Node).sees
    assert sees(str(tmp_path / "probe"), "secret")
    assert not sees(str(tmp_path / "probe"), "other")
    assert not sees(str(tmp_path / "nothing"), "secret")


def test_an_interface_is_an_address_or_a_line_that_names_those_there_are() -> None:
    assert address_of("lo") == "127.0.0.1"
    with pytest.raises(ConfigError, match=r"cluster.interface=eth99: .*it has lo"):
        address_of("eth99")


def test_the_plan_of_nodes_has_each_nodes_shares_under_global_ids() -> None:
    here = {"10.0.0.1": machine(0), "10.0.0.2": machine(0)}
    settings = PlanConfig(gmis_per_gpu=2), ReduceConfig(), 16
    plan = make_plan(*settings, machine(0), nodes=here)
    assert plan.layout.gmis_of_gpu == ((0, 1), (2, 3))
    assert [share.gpu for share in plan.slices] == [0, 0, 1, 1]
    assert plan.slices[2].cpus == plan.slices[0].cpus
    assert plan.strategy == "mpr"
    assert plan.nodes_data()[1] == {"address": "10.0.0.2", "gmis": [2, 3]}
    assert Plan.from_dict(plan.to_dict()) == plan
    old = {key: value for key, value in plan.to_dict().items() if key != "nodes"}
    assert Plan.from_dict(old | {"layout": [[0, 1], [2, 3]]}).layout.num_nodes == 1
    with pytest.raises(ConfigError, match=r"mrr: cannot run on layout .*: in each node its rings"):
        make_plan(settings[0], ReduceConfig(strategy="mrr"), 16, machine(0), nodes=here)


def gpus_of_nodes(*num_gpus: int, **changes: Any) -> dict[str, Machine]:
    """Nodes whose GPUs are all different, with MPS."""
    nodes: dict[str, Machine] = {}
    for place, count in enumerate(num_gpus):
        gpus = tuple(
            gpu(index)._replace(uuid=f"GPU-{place}-{index}", **changes) for index in range(count)
        )
        nodes[f"10.0.0.{place}"] = machine(count, gpus=gpus, mps_control=Path("/mps"))
    return nodes


def plan_on(nodes: dict[str, Machine], **settings: Any) -> Plan:
    first = next(iter(nodes.values()))
    return make_plan(PlanConfig(**settings), ReduceConfig(), 16, first, nodes=nodes)


def test_gmis_of_nodes_share_the_gpus_of_their_node() -> None:
    plan = plan_on(gpus_of_nodes(2, 3), gpus=2, gmis_per_gpu=2)
    assert plan.backend == "mps"
    devices = [share.device for share in plan.slices]
    assert devices == [f"GPU-{node}-{gpu}" for node in (0, 1) for gpu in (0, 1) for _ in range(2)]
    assert [share.gpu for share in plan.slices] == [0, 0, 1, 1, 2, 2, 3, 3]
    assert {share.memory_fraction for share in plan.slices} == {0.4}
    variables = gmi_environment(plan, 5, {}, Path("/cache"), {})
    assert variables["CUDA_VISIBLE_DEVICES"] == "GPU-1-0"
    assert variables["XLA_CLIENT_MEM_FRACTION"] == "0.4"
    assert Plan.from_dict(plan.to_dict()) == plan


@pytest.mark.parametrize(
    ("gpus", "gmis", "strategy"),
    [(1, 2, "one_shot"), (2, 2, "one_shot"), (2, 1, "mrr"), (1, 1, "mpr")],
)
def test_nodes_with_gpus_do_inside_what_one_machine_does(
    gpus: int, gmis: int, strategy: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gmijax.partition.reduction._is_installed", lambda *_: True)
    plan = plan_on(gpus_of_nodes(gpus, gpus), gpus=gpus, gmis_per_gpu=gmis)
    assert plan.strategy == strategy
    assert [stage.link for stage in stages(strategy, plan.layout)][-1] == "nodes"


def test_a_gpu_of_two_nodes_of_one_machine_has_half_of_its_memory_for_each() -> None:
    nodes = {"a": machine(1), "a#1": machine(1)}
    plan = plan_on(nodes, backend="share", gmis_per_gpu=2)
    assert [share.memory_fraction for share in plan.slices] == [0.2] * 4
    assert "nodes of one machine have the same GPUs, and divide their memory" in plan.reasons
    with pytest.raises(ConfigError, match=r"4 GMIs on GPU 0 would reserve 1.20 of its memory"):
        plan_on(nodes, backend="share", gmis_per_gpu=2, memory_fraction=0.3)


def test_nodes_that_cannot_do_the_same_take_turns_or_are_refused_by_name() -> None:
    nodes = gpus_of_nodes(1, 1)
    bare = dataclasses.replace(nodes["10.0.0.1"], mps_control=None, driver_version="575.1")
    plan = plan_on({**nodes, "10.0.0.1": bare}, gmis_per_gpu=2)
    assert plan.backend == "share"
    assert any("take turns" in why and "(node 10.0.0.1)" in why for why in plan.reasons)
    said = "warning: node 10.0.0.1 has NVIDIA driver 575.1, node 10.0.0.0 580.159.03"
    assert said in plan.reasons
    with pytest.raises(
        BackendUnavailable, match=r"node 10\.0\.0\.1: plan\.backend=mps: nvidia-cuda"
    ):
        plan_on({**nodes, "10.0.0.1": bare}, backend="mps", gmis_per_gpu=2)
    with pytest.raises(ConfigError, match=r"node 10\.0\.0\.1: plan\.gpus=2: .* 1 usable"):
        plan_on(gpus_of_nodes(2, 1), gpus=2)
    old = gpus_of_nodes(1, 1, compute_capability=(8, 0))["10.0.0.1"]
    with pytest.raises(ConfigError, match=r"10\.0\.0\.1 has GPUs of compute capability 8\.0"):
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
    assert [share.gmi for share in plan.slices] == list(plan.layout.gmis)
    assert [plan.layout.gpu_of(share.gmi) for share in plan.slices] == [s.gpu for s in plan.slices]
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
        (("channel.transport=zmq",), "TCP without being told"),
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
        assert note.startswith(f"{3 - left} nodes of the job are gone: going on with {left}")


def test_nodes_know_the_calls_and_count_leaders_among_those_that_train() -> None:
    nodes = Nodes(2, (("a", 1), ("b", 2), ("c", 3)), b"secret", {(0, 3): "a:4"})
    fd = nodes.to_file()
    assert Nodes.from_file(fd) == nodes
    os.close(fd)
    assert nodes.among((1, 2))[:2] == (1, (("b", 2), ("c", 3)))


def test_a_job_goes_on_with_the_nodes_that_are_left() -> None:
    config = compose("env=ball_balance", "cluster.engine=ray", "num_envs=16", "seed=3")
    plan = training_plan(config, machine(0), nodes={"a": machine(0), "b": machine(0)})
    assert with_nodes_left(config, plan, {"c": machine(0), "b": machine(0)})[1] == ()
    left, [note] = with_nodes_left(config, plan, {"b": machine(0)})
    assert (left.nodes, left.layout.num_gmis, left.strategy) == (("b",), 1, "none")
    assert "1 nodes of the job are gone: going on with 1, layout [[0]]" in note
    assert left.reasons[-1] == note


def test_who_waited_in_vain_comes_before_who_lost_that_one() -> None:
    lost, late = (
        GmiFailed(gmi, error, error=ReportedError(error, "", ""), exit_code=1)
        for gmi, error in ((0, "PeerLost"), (2, "CollectiveTimeout"))
    )
    assert first_cause([lost, late]) is late
    assert first_cause([lost, late, killed := GmiFailed(3, "", exit_code=-9)]) is killed


def test_a_lost_node_is_the_cause_that_its_gmis_give(tmp_path: Path) -> None:
    seen = {2: Seen(None, 1, Heartbeat("running", 7, 99), None, 0)}
    answers: dict[str, Any] = {"start": 99, "poll": seen}
    node = a_node()
    node._ask = lambda method, *_: FakeAnswer(answers[method])
    gmi = node.start(2, False, GmiPaths(tmp_path))
    gmi.poll()  # Asks.
    assert gmi.poll() is None
    assert gmi.beat.iteration == 7
    assert gmi.is_ready
    answers["poll"] = RuntimeError("The actor died.\nits node has died")
    while gmi.poll() is None:
        pass
    failure = describe_exit(2, gmi.exit_code or 0, gmi.error, gmi.paths.stderr)
    assert "NodeLost: node 1 (10.0.0.2) is gone: its node has died" in failure.reason
    assert not is_consequence(failure)
    assert gmi.request_stacks() is None
    gmi.kill()


def test_what_nodes_say_of_backends_is_heard_with_their_address(tmp_path: Path) -> None:
    plan = plan_on(gpus_of_nodes(1, 1), gmis_per_gpu=2)
    launch = make_launch(RunPaths(tmp_path), ["train"] * 4, plan)
    opened = Opened(("10.0.0.2", 1), {}, {})
    told: list[tuple[Any, ...]] = []

    class Returned(FakeAnswer):
        def get(self) -> Any:
            return self.value  # An error too, if a node returns one.

    def node(**answers: Any) -> Joined:
        def ask(method: str, *arguments: Any) -> FakeAnswer:
            told.append((method, *arguments))
            return Returned(answers.get(method))

        return joined(RemoteNode(ask, 1, "10.0.0.2"))[0]

    nodes = [
        node(open=opened),
        node(open=BackendUnavailable("no daemon"), verify=(2, "no client")),
    ]
    job = ClusterJob(compose("env=ball_balance", "cluster.engine=ray", "num_envs=16"))
    job._joined = nodes
    with pytest.raises(BackendUnavailable, match=r"node 10\.0\.0\.2: no daemon"):
        job._open(launch)
    backend = BackendOfNodes(launch, nodes)
    with pytest.raises(GmiFailed, match="GMI 2 failed: no client"):
        backend.verify({0: 10, 1: 11, 2: 12, 3: 13})
    assert told[-2:] == [("verify", {0: 10, 1: 11}), ("verify", {2: 12, 3: 13})]
    backend.terminate(3, 13)
    assert told[-1] == ("terminate", 3, 13)


def test_a_node_starts_polls_and_ends_gmis(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(nodes, "detect_machine", lambda: machine(0))
    monkeypatch.chdir(tmp_path)
    plan = make_plan(PlanConfig(), ReduceConfig(), 16, machine(0), nodes={"a": Machine((), (0,))})
    launch = make_launch(RunPaths(tmp_path), ["train"], plan)
    assert isinstance(launch.kind, JobKind)
    node = TrainingNode({"JAX_THING": "1"}, str(tmp_path), None, "127.0.0.1")
    assert os.environ["JAX_THING"] == "1"
    opened = node.open(launch, 0, "127.0.0.1", {})
    assert not isinstance(opened, BackendUnavailable)
    assert (opened.calls, opened.daemons) == ({}, {})
    node.introduce(Nodes(0, (opened.leader,), b"token"))
    pid = node.start(0, False)
    assert isinstance(pid, int)
    node.order(0, "kill")
    while (seen := node.poll()[0]).exit_code is None:
        pass
    assert seen.exit_code == -signal.SIGKILL
    node.close()
    assert not (tmp_path / "node_0").exists()
