"""A sweep over nodes without Ray: slots, nodes that are lost, who is first, what Ray is asked."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
from supervision import gpu, machine

from gmijax import sweep
from gmijax.autotune.grid import Measured
from gmijax.cli.compose import compose
from gmijax.cli.grid import build_sweep
from gmijax.cluster import ray_nodes
from gmijax.cluster.node import Facts, Node
from gmijax.cluster.ray_nodes import NodeHandle, RayCluster
from gmijax.cluster.remote_gmi import RemoteNode
from gmijax.config import ClusterConfig
from gmijax.config.sweep import SweepConfig
from gmijax.errors import BackendUnavailable, ConfigError, NodeLost
from gmijax.machine.snapshot import Machine
from gmijax.runs.folder import RunPaths, read_json, write_json
from gmijax.runs.held import OpenFolder
from gmijax.supervise.stop_signals import StopSignals
from gmijax.sweeps import kind, nodes, profile_jobs, scheduler
from gmijax.sweeps.children import ChildStatus
from gmijax.sweeps.host import ChildStart, LocalHost, Order
from gmijax.sweeps.jobs import Job, jobs_of
from gmijax.sweeps.nodes import RemoteHost, SweepNode, nodes_of, num_cpus_of
from gmijax.sweeps.paths import SweepPaths
from gmijax.sweeps.report import JobsReport
from gmijax.sweeps.scheduler import Scheduler
from gmijax.sweeps.slots import Site, Slot, SlotPool, plan_slots
from gmijax.sweeps.study import Study
from gmijax.sweeps.sweep import sweep_of
from gmijax.sweeps.training import TrainingKind


class FakeHost(LocalHost):
    """A node whose jobs go on until `end` says how they end."""

    def __init__(self, name: str) -> None:
        super().__init__(machine(0))
        self.name = name
        self.running: dict[int, int] = {}  # Jobs by their children.
        self.seen: dict[int, ChildStatus] = {}
        self.started: list[int] = []
        self.folders: list[list[Path]] = []  # Of the jobs of each start.
        self._numbers = itertools.count()

    def start(self, start: ChildStart) -> int:
        if self.lost is not None:
            raise NodeLost(self.lost)
        assert start.process.input_file is not None
        order, request = start.process.input_file
        folders = [Path(config["run"]["dir"]) for config in request["configs"]]
        for folder in folders:
            folder.mkdir(exist_ok=True)
        child = next(self._numbers)
        self.running[child] = int(order.stem)
        self.started.append(self.running[child])
        self.folders.append(folders)
        return child

    @property
    def together(self) -> list[list[str]]:
        """Names of the jobs of each start."""
        return [[folder.name for folder in folders] for folders in self.folders]

    def look(self, child: int) -> ChildStatus | None:
        return self.seen.get(child)

    def order(self, child: int, order: Order) -> None:
        if order in ("ask_to_stop", "interrupt", "kill"):
            self.seen[child] = ChildStatus(130)
        if order == "close":
            del self.running[child]

    def end(self, exit_code: int = 0) -> None:
        """Ends all jobs that run there; they are complete if that is 0."""
        for child in self.running if exit_code == 0 else ():
            for run in self.folders[child]:
                write_json(RunPaths(run).summary, {"status": "completed", "env_steps": 10**12})
        self.seen |= {child: ChildStatus(exit_code, "CUDA_ERROR_X") for child in self.running}


class Sweep:
    """Jobs on two nodes, with two slots each by default."""

    def __init__(self, folder: Path, jobs: Iterable[Job], **settings: Any) -> None:
        self.jobs, self.paths = list(jobs), SweepPaths(folder)
        self.settings = SweepConfig(**{"jobs_per_gpu": 2} | settings)
        self.nodes = FakeHost("a"), FakeHost("b")
        plan = plan_slots(self.settings, machine(0), {"auto"})
        self.slots = SlotPool([Site(plan, node.machine, node.name) for node in self.nodes])

    def run(
        self,
        *steps: Any,
        kind: type[TrainingKind] = TrainingKind,
        signals: StopSignals | None = None,
    ) -> None:
        """Runs it; the steps are called one after another, the last one in every tick."""
        left = list(steps)

        def tick() -> None:
            (left.pop(0) if len(left) > 1 else left[0])()

        ranking = self.settings
        args = kind(ranking, self.paths), ranking, self.paths, self.slots, self.nodes, tick
        Scheduler(self.jobs, Study(), *args).run(signals or StopSignals())

    def states(self) -> list[str]:
        return [job.progress.state for job in self.jobs]

    def end_all(self) -> None:
        for node in self.nodes:
            node.end()


@pytest.fixture(autouse=True)
def no_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scheduler, "_TICK_S", 0.0)


def jobs(count: int, *overrides: str) -> list[Job]:
    """Jobs whose programs differ."""
    return list(jobs_of([compose(f"num_envs={16 * (n + 1)}", *overrides) for n in range(count)]))


def gpu_nodes(*num_gpus: int) -> SlotPool:
    sites = []
    for node, count in enumerate(num_gpus):
        here = machine(count, mps_control=Path("/usr/bin/nvidia-cuda-mps-control"))
        sites.append(
            Site(plan_slots(SweepConfig(jobs_per_gpu=2), here, {"auto"}), here, f"n{node}")
        )
    return SlotPool(sites)


def test_jobs_go_to_the_node_with_most_room_and_never_on_two() -> None:
    slots = gpu_nodes(2, 2)
    both = slots.acquire(2)
    assert both is not None
    assert (both.site, both.label) == (0, "n0 GPU 0 slot 0, n0 GPU 1 slot 0")
    assert both.devices == (gpu(0).uuid, gpu(1).uuid)
    singles = [slot for _ in range(4) if (slot := slots.acquire(1))]
    assert [slot.site for slot in singles] == [1, 1, 0, 0]
    assert slots.acquire(1, avoid={1}) is None
    assert slots.acquire(1) is not None
    assert slots.acquire(2) is None
    other = slots.acquire(1, avoid={0})
    assert other is not None
    assert (other.site, other.backend, other.is_whole_gpu) == (1, "mps", False)


def test_slots_of_a_node_that_is_gone_are_neither_acquired_nor_released() -> None:
    slots = gpu_nodes(1, 1)
    slot = slots.acquire(1)
    assert slot is not None
    slots.remove_site(slot.site)
    slots.release(slot)
    assert [taken.site for _ in range(3) if (taken := slots.acquire(1))] == [1, 1]
    assert not slots.num_gpus_with_free_slot()
    slots.remove_site(1)
    assert not slots.left


def test_jobs_of_a_node_that_is_lost_run_again_on_the_other(tmp_path: Path) -> None:
    sweep = Sweep(tmp_path, jobs(6))
    first, second = sweep.nodes

    def lose() -> None:
        assert (first.started, second.started) == ([0, 2], [1, 3])
        second.lost = "node 1 (b) is gone: no power"

    shown: list[tuple[str, str | None]] = []

    def look() -> None:
        shown.append((sweep.jobs[1].progress.state, sweep.jobs[1].progress.error))
        sweep.end_all()

    sweep.run(lose, look)
    assert sweep.states() == ["completed"] * 6
    assert shown[0] == ("waiting", "again, after node 1 (b) is gone: no power")
    assert first.started[:2] == [0, 2]
    assert sorted(first.started[2:4]) == [1, 3]  # Before those that have not run.
    assert {job.progress.node for job in sweep.jobs} == {"a"}
    events = (sweep.paths.job(1).events).read_text()
    assert "no power" in events
    report = JobsReport(
        sweep.jobs, sweep.settings, dict, sweep.paths, OpenFolder(sweep.paths.root, "x"), 1.0
    )
    assert report.end("completed") is None
    rows = report.data["jobs"]
    assert [row["node"] for row in rows] == ["a"] * 6
    assert read_json(sweep.paths.sweep)["jobs"] == rows


def test_a_job_that_may_not_start_again_fails_with_its_node(tmp_path: Path) -> None:
    sweep = Sweep(tmp_path, jobs(2, "run.max_restarts=0"))

    def lose() -> None:
        sweep.nodes[1].lost = "node 1 (b) is gone"

    sweep.run(lose, sweep.end_all)
    assert sweep.states() == ["completed", "failed"]
    assert sweep.jobs[1].progress.error == "node 1 (b) is gone"


def test_without_a_node_the_sweep_ends_and_says_why(tmp_path: Path) -> None:
    sweep = Sweep(tmp_path, jobs(6))

    def lose() -> None:
        for node in sweep.nodes:
            node.lost = f"node {node.name} is gone"

    with pytest.raises(NodeLost, match="no node is left: node b is gone"):
        sweep.run(lose)
    assert sweep.states() == ["waiting"] * 6


def test_a_node_that_is_lost_at_a_start_costs_the_job_nothing(tmp_path: Path) -> None:
    sweep = Sweep(tmp_path, jobs(2))
    sweep.nodes[0].lost = "node 0 (a) is gone"
    sweep.run(sweep.end_all)
    assert sweep.nodes[1].started == [0, 1]
    assert sweep.states() == ["completed"] * 2


def test_a_profile_of_a_job_with_two_gpus_has_both(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Window:
        def __init__(self, *_: Any) -> None:
            self.steps_per_s, self.iteration_s = 100.0, 0.1

        def is_over(self) -> bool:
            return True

    monkeypatch.setattr(profile_jobs, "CurveWindow", Window)
    monkeypatch.setattr(FakeHost, "open", lambda *_: None)
    host = FakeHost("a")
    host.machine = machine(2, mps_control=Path("/usr/bin/nvidia-cuda-mps-control"))
    bench = profile_jobs.Bench(host, tmp_path, StopSignals())
    for settings in (SweepConfig(), SweepConfig(gpus=(1, 0))):
        found = profile_jobs.profile_jobs(settings, jobs(1, "plan.gpus=2")[0], 1, bench)
        assert isinstance(found, Measured)
    assert host.started == [0, 0]


class AwaitedKind(TrainingKind):
    """Jobs that compile what others of their program find in a cache."""

    def start(self, jobs: tuple[Job, ...], slot: Slot) -> kind.JobStart:
        return super().start(jobs, slot)._replace(is_awaited=True)


def test_jobs_that_wait_for_a_lock_by_themselves_start_at_once(tmp_path: Path) -> None:
    sweep = Sweep(tmp_path, jobs_of([compose(f"seed={seed}") for seed in range(4)]))
    starts: list[list[int]] = []

    def look() -> None:
        starts.append([len(node.started) for node in sweep.nodes])
        sweep.end_all()

    sweep.run(look)
    assert starts[0] == [2, 2]


def test_the_first_job_of_a_program_runs_alone_on_each_node(tmp_path: Path) -> None:
    alike = jobs_of([compose(f"seed={seed}") for seed in range(6)])
    sweep = Sweep(tmp_path, alike)
    starts: list[tuple[int, int]] = []

    def look() -> None:
        starts.append((len(sweep.nodes[0].started), len(sweep.nodes[1].started)))
        if len(starts) == 3:
            sweep.nodes[0].end()
        if len(starts) > 6:
            sweep.end_all()

    sweep.run(look, kind=AwaitedKind)
    assert starts[:3] == [(1, 1)] * 3
    assert starts[3] == (3, 1)  # On the second node the first one still runs.
    assert sweep.states() == ["completed"] * 6


def test_jobs_that_differ_in_numbers_are_started_together(tmp_path: Path) -> None:
    numbers = [("seed=0",), ("seed=1",), ("algo.learning_rate=1e-3",), ("seed=2",)]
    sweep = Sweep(tmp_path, jobs_of([compose(*own) for own in [*numbers, ("num_envs=32",)]]))
    sweep.settings = SweepConfig(jobs_per_gpu=2, pack="vmap")
    sweep.run(sweep.end_all)
    first, second = sweep.nodes
    # Half of them on each machine.
    assert first.together == [["000", "001"], ["004"]]
    assert second.together == [["002", "003"]]
    assert sweep.states() == ["completed"] * 5


def test_jobs_that_cannot_share_a_program_run_beside_those_that_do(tmp_path: Path) -> None:
    own = ("seed=0",), ("eval.every=1000",), ("seed=1",), ("seed=2",)
    sweep = Sweep(tmp_path, jobs_of([compose(*one) for one in own]), pack="auto")
    sweep.run(sweep.end_all)
    together = [*sweep.nodes[0].together, *sweep.nodes[1].together]
    assert sorted(together) == [["000", "002"], ["001"], ["003"]]


def test_a_job_whose_folder_is_none_of_a_run_is_left_to_itself(tmp_path: Path) -> None:
    jobs = jobs_of([compose(f"seed={seed}") for seed in range(3)])
    sweep = Sweep(tmp_path, jobs, pack="vmap")
    write_json(sweep.paths.job(1).root / "notes.json", {})
    sweep.slots.remove_site(1)
    sweep.run(sweep.end_all)
    assert sweep.nodes[0].together == [["000", "002"], ["001"]]


class EndsOfAProgram:
    """Three jobs of one program; the second one fails, and the process is lost in its turn."""

    def __init__(self, folder: Path, *overrides: str) -> None:
        steps = "num_timesteps=1000"
        jobs = jobs_of([compose(f"seed={seed}", steps, *overrides) for seed in range(3)])
        self.sweep = Sweep(folder, jobs, pack="vmap", jobs_per_gpu=3)
        self.sweep.slots.remove_site(1)
        self.runs = [self.sweep.paths.job(number) for number in range(3)]

    def lose(self) -> None:
        """The process is lost after the second job has failed, and the first one is complete."""
        write_json(self.runs[0].summary, {"status": "completed", "env_steps": 1000})
        write_json(self.runs[1].gmi(0).error, {"type": "NonFiniteError", "message": "nan"})
        self.sweep.nodes[0].end(exit_code=1)

    def end(self) -> None:
        """All that runs is complete."""
        self.sweep.nodes[0].end()


def test_of_jobs_of_one_program_those_run_again_that_have_not_ended(tmp_path: Path) -> None:
    ends = EndsOfAProgram(tmp_path)
    ends.sweep.run(ends.lose, ends.end)
    assert ends.sweep.nodes[0].together == [["000", "001", "002"], ["002"]]
    assert ends.sweep.states() == ["completed", "failed", "completed"]
    assert ends.sweep.jobs[1].progress.error == "NonFiniteError: nan"
    events = [run.events.exists() and run.events.read_text() for run in ends.runs]
    assert [bool(text) for text in events] == [False, False, True]
    assert '"reason": "again, after CUDA_ERROR_X"' in str(events[2])


def test_of_jobs_of_one_program_all_fail_that_may_not_run_again(tmp_path: Path) -> None:
    ends = EndsOfAProgram(tmp_path, "run.max_restarts=0")
    ends.sweep.run(ends.lose)
    assert ends.sweep.states() == ["completed", "failed", "failed"]
    assert [job.progress.error for job in ends.sweep.jobs[1:]] == [
        "NonFiniteError: nan",
        "CUDA_ERROR_X",
    ]


def test_what_a_node_refuses_is_raised_here_and_does_not_lose_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(*_: Any) -> None:
        raise BackendUnavailable("no daemon")

    monkeypatch.setattr(FakeHost, "open", refuse)
    monkeypatch.setattr(nodes, "LocalHost", lambda _: FakeHost("b"))
    here = SweepNode({}, "nowhere", None, "10.0.0.2")

    class Answer:
        def __init__(self, value: Any) -> None:
            self.get = lambda: value

        def is_there(self) -> bool:
            return True

    node = RemoteNode(lambda method, *args: Answer(getattr(here, method)(*args)), 1, "10.0.0.2")
    host = RemoteHost(NodeHandle(node, Facts("10.0.0.2", Machine((), (0,)), {})), "10.0.0.2")
    plan = plan_slots(SweepConfig(jobs_per_gpu=1), machine(0), {"auto"})
    with pytest.raises(BackendUnavailable, match="no daemon"):
        host.open(plan, RunPaths(Path("nowhere")))
    assert host.lost is None
    node.lost = "node 1 (10.0.0.2) is gone"
    with pytest.raises(NodeLost, match="is gone"):
        host.open(plan, RunPaths(Path("nowhere")))
    host.shut()


def test_the_nodes_are_the_sweeps_and_each_job_is_on_one_machine() -> None:
    request = build_sweep(("seed=0,1", "algo=a3c", "cluster.engine=ray", "cluster.nodes=2"))
    assert request.cluster == ClusterConfig(engine="ray", nodes=2)
    assert {job.config.cluster for job in request.jobs} == {ClusterConfig()}
    with pytest.raises(ConfigError, match=r"cluster\.nodes=1,2: expected one value"):
        build_sweep(("seed=0,1", "cluster.nodes=1,2"))
    configs = [compose("cluster.engine=ray", f"cluster.nodes={nodes}") for nodes in (1, 2)]
    with pytest.raises(ConfigError, match="cluster: a sweep has one"):
        sweep(configs)


@pytest.mark.parametrize(
    ("settings", "overrides", "num_cpus"),
    [
        ({}, (), 1),
        ({"jobs_per_gpu": 3}, (), 3),
        ({"jobs_per_gpu": 3, "gpus": 2}, ("plan.gmis_per_gpu=2",), 12),
    ],
)
def test_ray_is_asked_for_a_cpu_for_every_gmi(
    settings: dict[str, Any], overrides: tuple[str, ...], num_cpus: int
) -> None:
    work = sweep_of(SweepConfig(), {}, lambda n, _: jobs(1)[n], jobs(2, *overrides))
    assert num_cpus_of(SweepConfig(**settings), work.processes) == num_cpus


def test_indices_of_gpus_are_refused_on_nodes(tmp_path: Path) -> None:
    with (
        pytest.raises(ConfigError, match=r"sweep\.gpus=\[0, 1\]: Ray chooses the GPUs"),
        nodes_of(ClusterConfig(engine="ray"), SweepConfig(gpus=(0, 1)), False, 1, tmp_path),
    ):
        pass


@pytest.mark.parametrize(
    ("gpus", "wanted", "most", "expected"),
    [
        ((0, 0, 0), 2, None, (2, {"CPU": 2})),
        ((0, 4, 8), 2, None, (2, {"CPU": 2, "GPU": 4})),
        ((0, 4, 8), None, None, (2, {"CPU": 2, "GPU": 4})),
        ((0, 4, 8), None, 2, (2, {"CPU": 2, "GPU": 2})),
        ((0, 4, 8), 1, None, (1, {"CPU": 2, "GPU": 8})),
        ((0, 4, 8), None, 0, (3, {"CPU": 2})),
        ((0, 4, 8), 3, None, "the cluster has 2 nodes with 2 CPUs and a GPU"),
    ],
)
def test_nodes_with_gpus_are_taken_where_there_are_any(
    gpus: tuple[int, ...],
    wanted: int | None,
    most: int | None,
    expected: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Ray:
        is_initialized = staticmethod(lambda: True)
        nodes = staticmethod(
            lambda: [{"Alive": True, "Resources": {"CPU": 4.0, "GPU": float(n)}} for n in gpus]
        )
        wait = staticmethod(lambda *_, **__: None)

    placed: list[Any] = []
    monkeypatch.setattr(ray_nodes, "import_ray", Ray)
    monkeypatch.setattr(RayCluster, "_place", lambda _, bundle, n, __: placed.append((n, bundle)))
    monkeypatch.setattr(RayCluster, "_joined", lambda _: [])
    cluster = RayCluster(ClusterConfig(wait_s=0.0), Node)
    if isinstance(expected, str):
        with pytest.raises(ConfigError, match=expected):
            cluster.join(2, wanted, most_gpus=most)
    else:
        cluster.join(2, wanted, most_gpus=most)
        assert placed == [expected]
