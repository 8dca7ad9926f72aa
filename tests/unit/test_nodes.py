"""Exchange between the leaders of nodes: leaders as threads of one process, real sockets."""

from __future__ import annotations

import os
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from gmijax.clock import running_s
from gmijax.collectives.communicator import (
    CommunicatorConfig,
    MultiRankCommunicator,
    make_communicator,
)
from gmijax.collectives.host.shared_block import MAX_GATHER_FLOATS, create_exchange
from gmijax.collectives.host_transport import HostTransport
from gmijax.collectives.nodes.leader_watch import LeaderWatch
from gmijax.collectives.nodes.mesh import Mesh
from gmijax.collectives.nodes.multi_node_group import MultiNodeGroup
from gmijax.collectives.nodes.rendezvous import NodeAddresses, connect, listen
from gmijax.collectives.strategies import COSTS, ReductionStage, nodes_s, predicted_s, stages
from gmijax.errors import CollectiveError, CollectiveTimeout, ConfigError, PeerLost
from gmijax.partition.layout import Layout
from gmijax.partition.reduction import select_strategy, why_not_strategy

TOKEN = b"secret"
HERE = "127.0.0.1"


def connect_all(tokens: Sequence[bytes], timeout_s: float = 10.0) -> list[Any]:
    """The connections of every leader, or its error."""
    with ExitStack() as held:
        listeners = [held.enter_context(listen(HERE)) for _ in tokens]
        addresses = tuple((HERE, one.getsockname()[1]) for one in listeners)

        def come(node: int) -> Any:
            try:
                nodes = NodeAddresses(node, addresses, tokens[node])
                return connect(nodes, listeners[node], 1, timeout_s)[0]
            except CollectiveError as error:
                return error

        with ThreadPoolExecutor(len(tokens)) as pool:
            return list(pool.map(come, range(len(tokens))))


@pytest.fixture
def meshes(request: pytest.FixtureRequest) -> Iterator[list[Mesh]]:
    num_nodes, timeout_s = getattr(request, "param", (3, 10.0))
    found = [
        Mesh(
            *(sockets, node, [10 * node for node in range(num_nodes)]),
            timeout_s=timeout_s,
            rendezvous_timeout_s=timeout_s,
            on_wait=lambda: None,
        )
        for node, sockets in enumerate(connect_all([TOKEN] * num_nodes))
    ]
    yield found
    for mesh in found:
        mesh.close()


@pytest.fixture
def watches(request: pytest.FixtureRequest) -> Iterator[list[LeaderWatch]]:
    num_nodes = getattr(request, "param", 2)
    ids = [10 * node for node in range(num_nodes)]
    sockets = connect_all([TOKEN] * num_nodes)
    found = [LeaderWatch(own, node, ids) for node, own in enumerate(sockets)]
    yield found
    for watch in found:
        watch.close()


def at_once(*calls: Callable[[], Any]) -> list[Any]:
    def run(call: Callable[[], Any]) -> Any:
        try:
            return call()
        except CollectiveError as error:
            return error

    with ThreadPoolExecutor(len(calls)) as pool:
        return list(pool.map(run, calls))


@pytest.mark.parametrize("num_floats", [1, 33, 400_000])
def test_a_sum_is_in_the_order_of_nodes_with_the_same_bits_on_all(
    meshes: list[Mesh], num_floats: int
) -> None:
    values = np.random.default_rng(0).normal(size=(3, num_floats)).astype(np.float32) * 1e3
    sums = at_once(*(lambda k=k: meshes[k].all_reduce(values[k], 1) for k in range(3)))
    for total in sums:
        np.testing.assert_array_equal(total, (values[0] + values[1]) + values[2])


def test_a_gather_is_in_the_order_of_nodes(meshes: list[Mesh]) -> None:
    rows = at_once(
        *(lambda k=k: meshes[k].all_gather(np.full(2, k, np.float32)) for k in range(3))
    )
    assert all(row.tolist() == [[0, 0], [1, 1], [2, 2]] for row in rows)


@pytest.mark.parametrize("meshes", [(2, 10.0)], indirect=True)
def test_a_leader_that_hangs_up_and_one_that_does_something_else_are_named(
    meshes: list[Mesh],
) -> None:
    ones = np.ones(100, np.float32)
    different = at_once(
        lambda: meshes[0].all_reduce(ones, 1), lambda: meshes[1].all_reduce(ones[:50], 1)
    )
    assert [type(error) for error in different] == [CollectiveError] * 2
    assert "GMI 0 calls sum, GMI 10 something else" in str(different[0])
    meshes[1].close()
    with pytest.raises(PeerLost, match="GMI 10 is gone during all_gather between nodes"):
        meshes[0].all_gather(ones)


@pytest.mark.parametrize("meshes", [(2, 0.3)], indirect=True)
def test_a_leader_that_does_not_come_is_named_in_time(meshes: list[Mesh]) -> None:
    with pytest.raises(CollectiveTimeout, match=r"0\.3 s in sum between nodes.*GMIs \[10\]"):
        meshes[0].all_reduce(np.ones(3, np.float32), 1)


@pytest.mark.parametrize("watches", [3], indirect=True)
def test_leaders_meet_and_who_has_met_may_hang_up(watches: list[LeaderWatch]) -> None:
    def come_and_go(watch: LeaderWatch) -> None:
        for step in range(20):
            watch.barrier(10.0, "step", step, lambda: None)
        watch.close()

    met = at_once(*(lambda watch=watch: come_and_go(watch) for watch in watches))
    assert met == [None] * 3


def test_a_leader_that_hangs_up_before_the_barrier_is_lost(watches: list[LeaderWatch]) -> None:
    watches[0].look(running_s(), 10.0, "step", 7)
    watches[1].close()
    lost = r"GMI 0: GMI 10 is gone during step of several nodes, step 7"
    with pytest.raises(PeerLost, match=lost):
        watches[0].barrier(10.0, "step", 7, lambda: None)
    with pytest.raises(PeerLost, match=lost):
        watches[0].look(running_s(), 10.0, "step", 7)


def test_time_counts_only_while_a_leader_is_silent(watches: list[LeaderWatch]) -> None:
    mine, other = watches
    since_s = running_s()
    for _ in range(8):
        time.sleep(0.1)
        other.beat()
        mine.look(since_s, 0.5, "step", 3)  # It sends signs of life, for longer than the limit.
    waited: list[int] = []
    with pytest.raises(
        CollectiveTimeout, match=r"waited 0\.5 s in step .*for GMIs \[10\]"
    ) as late:
        mine.barrier(0.5, "step", 3, lambda: waited.append(1))
    assert late.value.missing == (10,)
    assert waited
    # It may come to the first wait of a long time late, and not be blamed for what was before.
    mine.look(running_s(), 0.5, "step", 4)


def test_who_does_not_know_the_secret_stays_out() -> None:
    answers = connect_all([TOKEN, b"guess"], timeout_s=1.0)
    assert "leaders of other nodes did not come" in str(answers[0])
    assert "has a connection with node 0 at 127.0.0.1" in str(answers[1])
    assert "cluster.interface" not in str(answers[1])


def test_a_leader_that_cannot_be_reached_is_one_of_another_network() -> None:
    with listen(HERE) as own, socket.socket() as nobody:
        nobody.bind((HERE, 0))
        nodes = NodeAddresses(1, (nobody.getsockname(), own.getsockname()), TOKEN)
        with pytest.raises(CollectiveError, match=r"cannot reach node 0 .*cluster\.interface"):
            connect(nodes, own, 1, 10.0)


def test_what_leaders_know_goes_through_a_file() -> None:
    nodes = NodeAddresses(1, ((HERE, 1234), ("10.0.0.2", 99)), os.urandom(32))
    fd = nodes.to_file()
    try:
        assert NodeAddresses.from_file(fd) == nodes
    finally:
        os.close(fd)


@contextmanager
def ranks_of_two_nodes(layout: Layout, timeout_s: float) -> Iterator[Callable[[int], Any]]:
    """Makes the communicator of a rank, which is `MultiRankCommunicator`."""
    with ExitStack() as held:
        listeners = [held.enter_context(listen(HERE)) for _ in range(2)]
        addresses = tuple((HERE, one.getsockname()[1]) for one in listeners)
        blocks = [create_exchange() for _ in listeners]
        for block in blocks:
            held.callback(os.close, block)

        def make(rank: int) -> MultiRankCommunicator:
            node = layout.node_of(rank)
            config = CommunicatorConfig(
                layout=layout,
                rank=rank,
                num_floats=10,
                exchange_fd=blocks[node],
                timeout_s=timeout_s,
                rendezvous_timeout_s=20,
                nodes=NodeAddresses(node, addresses, TOKEN),
                listener=socket.socket(fileno=os.dup(listeners[node].fileno())),
            )
            comm = make_communicator("mpr", config)
            assert isinstance(comm, MultiRankCommunicator)
            return comm

        yield make


def test_small_things_go_over_nodes_in_order_of_rank() -> None:
    met = threading.Barrier(4)

    def gather(rank: int) -> Any:
        comm = make(rank)
        try:
            # Of all together the last is more than goes through memory at once.
            sizes = (2, 2, MAX_GATHER_FLOATS // 2)
            return [
                comm.all_gather(np.full(size, rank + k, np.float32))
                for k, size in enumerate(sizes)
            ]
        finally:
            met.wait()
            comm.close()

    with ranks_of_two_nodes(Layout(((0, 1), (2, 3)), 2), timeout_s=10) as make:
        found = at_once(*(lambda rank=rank: gather(rank) for rank in range(4)))
    for rows in found:
        assert [row[:, -1].tolist() for row in rows] == [
            [k, k + 1, k + 2, k + 3] for k in range(3)
        ]


def test_a_node_that_is_ready_late_is_waited_for_as_long_as_at_the_start() -> None:
    """By all ranks of the other node: also those that only wait for their leader."""
    met = threading.Barrier(4)

    def gather(rank: int) -> Any:
        comm = make(rank)
        try:
            if rank >= 2:
                time.sleep(2.5)
            return comm.all_gather(np.full(1, rank, np.float32)).ravel().tolist()
        finally:
            met.wait()
            comm.close()

    with ranks_of_two_nodes(Layout(((0, 1), (2, 3)), 2), timeout_s=1.0) as make:
        found = at_once(*(lambda rank=rank: gather(rank) for rank in range(4)))
    assert found == [[0, 1, 2, 3]] * 4


@pytest.mark.parametrize(
    ("gpus", "gmis", "nodes", "strategy", "seconds"),
    [
        (1, 4, 1, "mpr", COSTS["mpr"](1, 4, 400, 2, 3)),
        (1, 4, 2, "mpr", COSTS["mpr"](1, 4, 400, 2, 3) + nodes_s(2, 400, 5)),
        (2, 1, 4, "mrr", COSTS["har"](2, 1, 400, 2, 3) * 2 + nodes_s(4, 400, 5)),
        (2, 4, 3, "har", COSTS["har"](2, 4, 400, 2, 3) + nodes_s(3, 400, 5)),
    ],
)
def test_algorithm_1_and_its_cost_are_those_of_a_node_and_the_way_between(
    gpus: int, gmis: int, nodes: int, strategy: str, seconds: float
) -> None:
    layout = Layout.even(gpus, gmis).on_nodes(nodes)
    assert select_strategy(layout).strategy == strategy
    assert predicted_s(strategy, layout, 100, 2, 3, 5) == pytest.approx(seconds)


def test_a_layout_on_nodes_has_global_ids_and_ranks_in_nodes() -> None:
    layout = Layout(((0, 2), (1,))).on_nodes(2)
    assert layout.gmis_of_gpu == ((0, 2), (1,), (3, 5), (4,))
    assert layout.gmis_of_node == ((0, 1, 2), (3, 4, 5))
    assert [layout.node_of(gmi) for gmi in layout.gmis] == [0, 0, 0, 1, 1, 1]
    assert layout.is_alike
    assert layout.of_node(1) == Layout(((0, 2), (1,)))
    apart = Layout(((1, 2), (0,)), 2)
    assert [apart.node_of(gmi) for gmi in apart.gmis] == [1, 0, 0]
    assert not apart.is_alike
    with pytest.raises(ConfigError, match="3 GPUs are not as many on each of 2 nodes"):
        Layout(((0,), (1,), (2,)), 2)


def test_the_stages_of_nodes_are_those_of_har_on_as_many_gpus() -> None:
    assert stages("mpr", Layout.even(1, 2).on_nodes(2)) == [
        ReductionStage("all_reduce", "host", ((0, 1), (2, 3))),
        ReductionStage("all_reduce", "nodes", ((0, 1), (2, 3))),
    ]
    assert stages("mpr", Layout.even(1, 1).on_nodes(3)) == [
        ReductionStage("all_reduce", "nodes", ((0,), (1,), (2,)))
    ]
    assert stages("har", Layout.even(2, 1).on_nodes(2), "ipc") == [
        ReductionStage("all_gather", "ipc", ((0,), (1,), (2,), (3,))),
        ReductionStage("all_gather", "ring", ((0, 1), (2, 3))),
        ReductionStage("all_reduce", "nodes", ((0, 1), (2, 3))),
    ]
    assert why_not_strategy("har", Layout.even(1, 2).on_nodes(2)) is None
    assert "in each node its rings go" in str(
        why_not_strategy("mrr", Layout.even(1, 2).on_nodes(2))
    )


@pytest.mark.parametrize("rank", range(4))
def test_only_leaders_copy_their_numbers_from_the_gpu_for_the_sum_of_nodes(
    rank: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = ReductionStage("all_reduce", "nodes", ((0, 1), (2, 3)))
    back = ReductionStage("broadcast", "host", ((1, 0), (2,)))
    assert [node.reads(rank), back.reads(rank)] == [rank in (0, 2), rank != 0]
    assert ReductionStage("all_reduce", "host", ((0, 1, 2, 3),)).reads(rank)

    did: list[str] = []
    queue: Any = ModuleType("cuda_queue")
    queue.pinned = lambda num_floats: np.zeros(num_floats, np.float32)
    for name in ("fetch", "synchronize", "store"):
        setattr(queue, name, lambda *_, name=name: did.append(name))
    monkeypatch.setitem(sys.modules, "gmijax.collectives.device.cuda_queue", queue)
    host = MultiNodeGroup.__new__(MultiNodeGroup)
    host.rank = rank
    monkeypatch.setattr(MultiNodeGroup, "all_reduce_nodes", lambda *_: did.append("sum"))
    HostTransport(host, 8).reduce(node, 1, 0, 0, 0, 8)
    assert did == ["fetch" if rank in (0, 2) else "synchronize", "sum", "store"]
