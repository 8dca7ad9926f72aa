"""Jobs on several nodes without Ray: bad input, what a node says and does, nodes that are lost."""

from __future__ import annotations

import builtins
import dataclasses
import json
import os
import signal
import socket
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest
from supervision import gpus_of_nodes, machine, make_launch, plan_on, planned

from gmijax import compose
from gmijax.cluster import node as nodes
from gmijax.cluster import ray_nodes
from gmijax.cluster.checks import by_name, require_alike, require_shared
from gmijax.cluster.cluster_job import BackendOfNodes, ClusterJob
from gmijax.cluster.node import (
    COMPARED,
    Facts,
    Node,
    NodeEndpoints,
    RemoteGmiStatus,
    TrainingNode,
    address_of,
    interface_of,
)
from gmijax.cluster.ray_nodes import NodeHandle, RayCluster
from gmijax.cluster.remote_gmi import RemoteNode
from gmijax.cluster.survey import NodeInfo, differences, lines_of_nodes, nodes_as_data, survey
from gmijax.collectives.nodes.rendezvous import NodeAddresses
from gmijax.config import ClusterConfig, PlanConfig, ReduceConfig
from gmijax.errors import (
    BackendUnavailable,
    ConfigError,
    GmiFailed,
    JobInterrupted,
    NodeLost,
    ReportedError,
)
from gmijax.machine.snapshot import Machine
from gmijax.partition.planner import make_plan
from gmijax.runs.folder import GmiPaths, RunPaths
from gmijax.supervise import supervisor
from gmijax.supervise.backends import open_backend
from gmijax.supervise.failures import describe_exit, first_cause, is_consequence
from gmijax.supervise.heartbeat import Heartbeat
from gmijax.supervise.job_kinds import JobKind
from gmijax.version import versions_of


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


def joined(node: RemoteNode, versions: dict[str, str | None] | None = None) -> list[NodeHandle]:
    return [NodeHandle(node, Facts(node.address, machine(0), versions or versions_of(COMPARED)))]


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (("cluster.engine=slurm",), "cluster.engine=slurm: expected ray or null"),
        (("cluster.address=ray://head:10001",), "must be started on a node of the cluster"),
        (("cluster.engine=ray", "algo=a3c"), "nodes=auto: with algo=a3c give a number"),
        (("cluster.engine=ray", "plan.template=tdg_ex"), "template=tdg_ex: not with cluster"),
        (("cluster.engine=ray", "plan.gpus=[1]"), r"gpus=\[1\]: Ray chooses the GPUs of nodes"),
        (("cluster.engine=ray", "num_envs=auto"), "num_envs=auto: a search is for one machine"),
        (("run.dir=gs://bucket/run",), "run.dir=gs://bucket/run: expected the path of a folder"),
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
        _private: Any = None

        @staticmethod
        def init(**_: Any) -> None:
            raise ConnectionError("Could not find any running Ray instance.\nMore words.")

    monkeypatch.setattr(ray_nodes, "import_ray", Ray)
    with pytest.raises(ConfigError, match=r"address=auto: no cluster .*`ray start --head`"):
        RayCluster(ClusterConfig(), Node)
    with pytest.raises(ConfigError, match=r"address=127\.0\.0\.1:1: nothing answers there"):
        RayCluster(ClusterConfig(address="127.0.0.1:1"), Node)
    Ray._private = SimpleNamespace(
        services=SimpleNamespace(get_ray_address_from_environment=lambda *_: "127.0.0.1:1")
    )
    with pytest.raises(ConfigError, match=r"address=auto: nothing answers at 127\.0\.0\.1:1 \("):
        RayCluster(ClusterConfig(), Node)
    monkeypatch.undo()
    real = builtins.__import__

    def no_ray(name: str, *arguments: Any) -> Any:
        if name.partition(".")[0] == "ray":
            raise ImportError(name)
        return real(name, *arguments)

    monkeypatch.setattr(builtins, "__import__", no_ray)
    with pytest.raises(ConfigError, match=r"ray is not installed \(pip install 'gmijax\[ray\]'"):
        RayCluster(ClusterConfig(), Node)


NO_ADDRESSES = (
    *("somewhere", "9" * 30, "head:" + "9" * 5000, "head:65536", "head:0", ":6379"),
    *("head:\N{SUPERSCRIPT TWO}", "head:\N{ARABIC-INDIC DIGIT SIX}379", "head:6379\n"),
)
NO_HOSTS = ("a" * 100, "head\0", "..", "\udc80")


@pytest.mark.parametrize(
    ("address", "message"),
    [
        *((one, "expected auto, local or host:port with a port from 1") for one in NO_ADDRESSES),
        *((f"{host}:6379", "nothing answers there") for host in NO_HOSTS),
    ],
)
def test_an_address_that_cannot_be_is_refused(
    address: str, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    ray = SimpleNamespace(is_initialized=lambda: False)
    monkeypatch.setattr(ray_nodes, "import_ray", lambda: ray)
    with pytest.raises(ConfigError, match=message):
        RayCluster(ClusterConfig(address=address), Node)


def test_a_cluster_for_one_job_has_a_token_of_its_own_and_is_for_this_machine_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen: list[dict[str, str]] = []

    class Ray:
        is_initialized = staticmethod(lambda: False)
        shutdown = staticmethod(lambda: None)
        nodes = staticmethod(list)

        def __init__(self) -> None:
            seen.append(dict(os.environ))  # Ray reads some when it is imported.

        @staticmethod
        def init(**options: Any) -> None:
            seen.append(dict(os.environ))
            if len(seen) > 4:
                raise ConnectionError("no")

    monkeypatch.setattr(ray_nodes, "import_ray", Ray)
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    monkeypatch.setenv("RAY_AUTH_TOKEN", "of the user")
    before = dict(os.environ)
    for _ in range(2):
        RayCluster(ClusterConfig(address="local"), Node).close()
        assert dict(os.environ) == before
    with pytest.raises(ConfigError):
        RayCluster(ClusterConfig(address="local"), Node)
    assert dict(os.environ) == before
    assert {one["RAY_AUTH_MODE"] for one in seen} == {"token"}
    assert {one["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] for one in seen} == {"0"}
    tokens = [one["RAY_AUTH_TOKEN"] for one in seen]
    assert tokens[::2] == tokens[1::2]
    assert len({*tokens, "of the user"}) == 4
    assert min(map(len, tokens)) == 64
    seen.clear()
    RayCluster(ClusterConfig(), Node).close()
    assert seen == [before, before]  # A cluster that others started has theirs.


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

    monkeypatch.setattr(ray_nodes, "import_ray", Ray)
    cluster = RayCluster(ClusterConfig(wait_s=0.0), Node)
    with pytest.raises(ConfigError, match="nodes=2: the cluster has 1 nodes with 2 CPUs, and no"):
        cluster.join(2, 2)
    with pytest.raises(ConfigError, match="nodes=auto: the cluster has 0 nodes with 8 CPUs"):
        cluster.join(8, None)
    with pytest.raises(ConfigError, match=r"nodes=auto: .* has 0 nodes with 2 CPUs and 2 GPUs"):
        cluster.join(2, None, least_gpus=2, most_gpus=2)
    assert cluster.has_gpus
    patient = RayCluster(ClusterConfig(wait_s=100.0), Node)
    with pytest.raises(JobInterrupted, match="stopped while waiting for nodes"):
        patient.join(2, 2, is_unwanted=lambda: True)


def test_several_nodes_of_a_machine_have_names_of_their_own() -> None:
    nodes = [*joined(a_node()), *joined(a_node())]
    assert by_name(nodes) == {"10.0.0.2": nodes[0], "10.0.0.2#1": nodes[1]}


def test_nodes_with_other_versions_are_refused() -> None:
    nodes = joined(a_node(), {**versions_of(COMPARED), "jax": "0.1"})
    with pytest.raises(ConfigError, match=r"in jax: .* on this machine; 0\.1 on 10\.0\.0\.2;"):
        require_alike(nodes)


def test_a_node_with_another_gmijax_says_so_before_all_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    node = Node({}, str(tmp_path), None, "10.0.0.2")
    assert "differ in gmijax: 9.9 on this machine; " in str(node.facts("9.9"))
    assert isinstance(node.facts(str(versions_of(COMPARED)["gmijax"])), Facts)


@pytest.mark.parametrize("package", ["cuda-bindings", "nccl4py"])
def test_packages_for_gpus_are_compared_between_nodes_that_have_some(package: str) -> None:
    versions = {**versions_of(COMPARED), "jax-cuda13-plugin": "0.9"}
    facts = [
        Facts(name, machine(1), versions | {package: number})
        for name, number in (("a", "13.0"), ("b", None))
    ]
    nodes = [NodeHandle(RemoteNode(a_node().call, 0, one.address), one) for one in facts]
    require_alike(nodes[:1])
    with pytest.raises(ConfigError, match=rf"differ in {package}: 13\.0 on a; none on b;"):
        require_alike(nodes)
    without = [NodeHandle(one.remote, one.facts._replace(machine=machine(0))) for one in nodes]
    require_alike(without)


def test_the_doctor_says_in_what_nodes_differ() -> None:
    own = versions_of(COMPARED)
    nodes = {
        "a": NodeInfo(Facts("a", machine(2), own), 0.01),
        "b": NodeInfo(Facts("b", machine(1), {**own, "jax": "0.1", "cuda-bindings": "13"}), -90.0),
        "c": NodeInfo(Facts("c", machine(0), own), 0.0),
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


def test_a_node_that_is_lost_while_the_doctor_asks_it_is_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    closed: list[bool] = []
    gone = RemoteNode(lambda *_: FakeAnswer(NodeLost("its raylet died")), 0, "10.0.0.1")
    nodes = [NodeHandle(gone, Facts("10.0.0.1", machine(0), {}))]
    cluster = SimpleNamespace(join=lambda *_: nodes, close=lambda: closed.append(True))
    monkeypatch.setattr("gmijax.cluster.survey.RayCluster", lambda *_: cluster)
    with pytest.raises(NodeLost, match=r"^node 0 \(10\.0\.0\.1\) is gone: .*its raylet died$"):
        survey("auto")
    assert closed


def test_a_run_folder_that_a_node_does_not_see_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gmijax.cluster.checks.SHOWS_S", 0.0)
    monkeypatch.chdir(tmp_path)
    # A node has another working directory, if any: what it is to see is named whole.
    message = rf"^run\.dir=runs/new: node 10\.0\.0\.2 does not see {tmp_path} or cannot write"
    with pytest.raises(ConfigError, match=message):
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
    assert interface_of("127.0.0.1") == "lo"
    assert interface_of("192.0.2.1") is None


def test_who_waited_in_vain_comes_before_who_lost_that_one() -> None:
    lost, late = (
        GmiFailed(gmi, error, error=ReportedError(error, "", ""), exit_code=1)
        for gmi, error in ((0, "PeerLost"), (2, "CollectiveTimeout"))
    )
    assert first_cause([lost, late]) is late
    assert first_cause([lost, late, killed := GmiFailed(3, "", exit_code=-9)]) is killed


def test_a_lost_node_is_the_cause_that_its_gmis_give(tmp_path: Path) -> None:
    seen = {2: RemoteGmiStatus(None, 1, Heartbeat("running", 7, 99), None, 0)}
    answers: dict[str, Any] = {"start": 99, "poll": seen}
    node = RemoteNode(lambda method, *_: FakeAnswer(answers[method]), 1, "10.0.0.2")
    gmi = node.start(2, GmiPaths(tmp_path))
    gmi.poll()  # Asks.
    assert gmi.poll() is None
    assert gmi.beat.iteration == 7
    assert gmi.is_ready
    answers["poll"] = NodeLost("its node has died")
    while gmi.poll() is None:
        pass
    failure = describe_exit(2, gmi.exit_code or 0, gmi.error, gmi.paths.stderr)
    assert failure.reason == "NodeLost: node 1 (10.0.0.2) is gone: its node has died"
    assert not is_consequence(failure)
    assert gmi.request_stacks() is None
    gmi.kill()


def test_a_process_that_does_not_end_is_named_with_its_node(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervisor, "_KILL_WAIT_S", 0.0)
    run, here = RunPaths(tmp_path), machine(0)
    plan = planned(here, gmis_per_gpu=1)
    running = RemoteGmiStatus(None, 1, Heartbeat("running", 7, 99), None, 0)
    node = a_node(start=99, poll={0: running})

    def stop(_: Any) -> None:
        raise JobInterrupted("stopped")

    supervised = supervisor.Supervisor(
        make_launch(run, ["train"], plan, grace=0.01),
        open_backend(plan, here, run),
        start=lambda gmi: node.start(gmi, run.gmi(gmi)),
    )
    with pytest.raises(JobInterrupted) as error:
        supervised.run(stop)
    assert error.value.__notes__ == [
        "processes 99 of node 10.0.0.2 do not end: a driver may hold them"
    ]


def test_an_error_of_a_node_is_no_lost_node(tmp_path: Path) -> None:
    answers: dict[str, Any] = {"start": 99, "poll": ValueError("not a heartbeat")}
    node = RemoteNode(lambda method, *_: FakeAnswer(answers[method]), 1, "10.0.0.2")
    gmi = node.start(2, GmiPaths(tmp_path))
    gmi.poll()  # Asks.
    with pytest.raises(ValueError, match="not a heartbeat"):
        gmi.poll()
    assert gmi.poll() == -signal.SIGKILL  # The job can end: nothing is asked any more.


def test_only_what_ray_says_itself_is_a_lost_node() -> None:
    errors = pytest.importorskip("ray.exceptions")
    bug = ValueError("a bug")
    for raised, error, message in (
        (errors.ActorDiedError(), NodeLost, "died"),
        (errors.GetTimeoutError("it is late"), NodeLost, "^it is late$"),
        (errors.RayTaskError("ask", "", bug).as_instanceof_cause(), ValueError, "^a bug$"),
        (ZeroDivisionError("of this process"), ZeroDivisionError, "^of this process$"),
    ):
        get = Mock(side_effect=raised)
        answer = ray_nodes._RayAnswer(SimpleNamespace(get=get, exceptions=errors), None)
        with pytest.raises(error, match=message):
            answer.get()


def test_messages_of_nodes_about_backends_have_their_address(tmp_path: Path) -> None:
    plan = plan_on(gpus_of_nodes(1, 1), gmis_per_gpu=2)
    launch = make_launch(RunPaths(tmp_path), ["train"] * 4, plan)
    opened = NodeEndpoints(("10.0.0.2", 1), {}, {})
    calls: list[tuple[Any, ...]] = []

    class Returned(FakeAnswer):
        def get(self) -> Any:
            return self.value  # An error too, if a node returns one.

    def node(**answers: Any) -> NodeHandle:
        def ask(method: str, *arguments: Any) -> FakeAnswer:
            calls.append((method, *arguments))
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
    assert calls[-2:] == [("verify", {0: 10, 1: 11}), ("verify", {2: 12, 3: 13})]
    backend.terminate(3, [13])
    assert calls[-1] == ("terminate", 3, [13])


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
    node.set_addresses(NodeAddresses(0, (opened.leader,), b"token"))
    pid = node.start(0)
    assert isinstance(pid, int)
    node.order(0, "kill")
    while (seen := node.poll()[0]).exit_code is None:
        pass
    assert seen.exit_code == -signal.SIGKILL
    node.close()
    assert not (tmp_path / "node_0").exists()


@pytest.mark.parametrize(
    ("users", "address", "inter", "expected"),
    [
        (None, "127.0.0.1", "nccl", "=lo"),
        ("eth1", "127.0.0.1", "nccl", "eth1"),
        (None, "192.0.2.1", "nccl", None),
        (None, "127.0.0.1", "tcp", None),  # Rings stay inside of nodes.
    ],
)
def test_nccl_of_a_node_takes_the_network_of_its_address_unless_the_user_says_another(
    users: str | None,
    address: str,
    inter: str,
    expected: str | None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(nodes, "detect_machine", lambda: machine(0))
    monkeypatch.setattr(nodes, "listen", lambda _: socket.create_server(("127.0.0.1", 0)))
    # A node changes both; so that they are as before after the test.
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NCCL_SOCKET_IFNAME", "")
    monkeypatch.delenv("NCCL_SOCKET_IFNAME")
    here = {name: machine(0) for name in "ab"}
    plan = make_plan(PlanConfig(), ReduceConfig(), 16, machine(0), nodes=here)
    plan = dataclasses.replace(plan, inter=inter)
    variables = {} if users is None else {"NCCL_SOCKET_IFNAME": users}
    node = TrainingNode(variables, str(tmp_path), None, address)
    launch = make_launch(RunPaths(tmp_path), ["train", "train"], plan)
    assert not isinstance(node.open(launch, 0, address, {}), BackendUnavailable)
    node.close()
    assert os.environ.get("NCCL_SOCKET_IFNAME") == expected
