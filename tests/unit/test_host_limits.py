"""How many GMIs a host takes. Nothing is started here: that is the point."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
from supervision import MPS, machine, planned

import gmijax
from gmijax.errors import ConfigError
from gmijax.machine import host_limits
from gmijax.machine.host_limits import CgroupLimits, HostLimits, detect_host, usable_cores
from gmijax.machine.snapshot import Machine, detect_machine
from gmijax.supervise.job_kinds import training_plan

SMALL = HostLimits(memory_mib=24 * 1024, threads=30_000, open_files=20_000)


def two_cores(host: HostLimits = SMALL) -> Machine:
    return Machine((), (0, 1), host=host)


def test_a_thousand_gmis_on_two_cores_are_refused():
    with pytest.raises(ConfigError) as error:
        planned(two_cores(), gmis_per_gpu=1000)
    assert str(error.value) == (
        "plan.gmis_per_gpu=1000: 1000 GMIs on this machine need about 586 GiB of memory (there "
        "are 24 GiB), 63 CPU cores, one for every 16 (there are 2); allowed: at most 32"
    )


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"gpus": 8, "gmis_per_gpu": 8}, r"plan\.gmis_per_gpu=8, plan\.gpus=8: 64 GMIs"),
        ({"gpus": 64}, r"plan\.gmis_per_gpu=1, plan\.gpus=64: 64 GMIs"),
        ({"layout": (tuple(range(64)),)}, r"plan\.layout: 64 GMIs"),
    ],
)
def test_every_way_to_ask_for_too_many_is_refused(changes: dict[str, Any], what: str):
    with pytest.raises(ConfigError, match=f"^{what}.*; allowed: at most 32$"):
        planned(two_cores(), **changes)


@pytest.mark.parametrize("side", ["serving", "training"])
def test_too_many_agents_or_trainers_are_refused(side: str):
    config = gmijax.compose("env=ant", "algo=a3c", f"plan.{side}_gmis_per_gpu=1000")
    with pytest.raises(ConfigError, match=r"plan\.serving_gmis_per_gpu=.*allowed: at most 32$"):
        training_plan(config, two_cores())


@pytest.mark.parametrize(
    ("host", "needs", "most"),
    [
        (HostLimits(memory_mib=2048), "4.69 GiB of memory (there are 2 GiB)", 3),
        (HostLimits(threads=100), "192 threads (100 may still be started)", 4),
        (HostLimits(open_files=84), "96 open files (84 may still be opened, see ulimit -n)", 5),
    ],
)
def test_each_limit_is_named(host: HostLimits, needs: str, most: int):
    with pytest.raises(ConfigError) as error:
        planned(two_cores(host), gmis_per_gpu=8)
    assert str(error.value) == (
        f"plan.gmis_per_gpu=8: 8 GMIs on this machine need about {needs}; allowed: at most {most}"
    )


def test_what_there_is_room_for_is_planned_and_one_may_always_try():
    assert planned(two_cores(), gmis_per_gpu=32).layout.num_gmis == 32
    tiny = two_cores(HostLimits(memory_mib=128, threads=2, open_files=10))
    assert planned(tiny).layout.num_gmis == 1


def test_beside_gpus_memory_counts_and_cores_do_not():
    here = machine(1, cpu_cores=(0,), mps_control=MPS, host=SMALL)
    assert planned(here, gmis_per_gpu=20).layout.num_gmis == 20
    with pytest.raises(ConfigError, match=r"39\.1 GiB of memory .*; allowed: at most 24$"):
        planned(here, gmis_per_gpu=40)
    with pytest.raises(ConfigError, match=r"2 CPU cores.*; allowed: at most 16$"):
        planned(here, gmis_per_gpu=20, backend="cpu")


def test_roles_are_refused_too(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    fits = gmijax.plan(gmis_per_gpu=2, backend="cpu")
    monkeypatch.setattr("gmijax.roles.manager.detect_machine", two_cores)
    with pytest.raises(ConfigError, match=r"^plan\.gmis_per_gpu=1000: 1000 GMIs"):
        gmijax.plan(gmis_per_gpu=1000)
    monkeypatch.chdir(tmp_path)
    tiny = two_cores(HostLimits(memory_mib=700))
    monkeypatch.setattr("gmijax.roles.launch.detect_machine", lambda: tiny)
    with pytest.raises(ConfigError, match=r"^plan: 2 GMIs on this machine .* at most 1$"):
        gmijax.launch(fits, Idle())
    assert not list(tmp_path.iterdir())


class Idle(gmijax.Role):
    def run(self) -> None: ...


def test_this_machine_is_seen():
    host = detect_host()
    assert host.memory_mib is not None
    assert host.memory_mib > 100
    assert host.threads is None or host.threads > 0
    here = detect_machine()
    assert here.host.memory_mib == host.memory_mib
    assert set(here.cpu_cores) <= os.sched_getaffinity(0)


def test_threads_of_a_user_with_a_limit_are_counted(monkeypatch: pytest.MonkeyPatch):
    limit = host_limits.resource.getrlimit(host_limits.resource.RLIMIT_NPROC)
    monkeypatch.setattr(host_limits.resource, "getrlimit", lambda _: (1, limit[1]))
    monkeypatch.setattr(host_limits.os, "geteuid", lambda: 0)
    threads = detect_host().threads
    assert threads is None or threads > 1
    own = Path("/proc/self").stat().st_uid
    monkeypatch.setattr(host_limits.os, "geteuid", lambda: own or -1)
    threads = detect_host().threads
    assert threads is not None
    assert threads <= 1


def group(folder: Path, **files: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (folder / name.replace("__", ".")).write_text(text + "\n")


def test_limits_of_control_groups_of_version_2(tmp_path: Path):
    (tmp_path / "own").write_text("0::/slice/job\n")
    root = tmp_path / "root"
    group(root / "slice", memory__max=str(8 * 2**30), pids__max="100", pids__current="40")
    group(root / "slice/job", memory__max="max", cpu__max="150000 100000", pids__max="max")
    found = CgroupLimits(tmp_path / "own", root)
    assert (found.memory_mib(), found.threads(), found.cpu_quota()) == (8192.0, 60, 1.5)
    assert found.available_memory_mib() is None
    stat = f"anon 7\nactive_file {2**20}\ninactive_file {2**21}"
    group(root / "slice", memory__current=str(6 * 2**30), memory__stat=stat)
    assert found.available_memory_mib() == 2048 + 3
    group(root / "slice", cpu__max="max 100000")
    group(root / "slice/job", cpu__max="max 100000")
    assert found.cpu_quota() is None


def test_free_memory_in_a_step_of_slurm(tmp_path: Path):
    # The process is below the group that has the limit.
    step = "system.slice/slurmstepd.scope/job_7/step_0"
    (tmp_path / "own").write_text(f"0::/{step}/user/task_0\n")
    job, own = tmp_path / "root" / step, tmp_path / "root" / step / "user/task_0"
    group(job.parent, memory__max=str(9 * 2**30), memory__current=str(2**30))
    stat = f"anon 7\nactive_file {2**20}\ninactive_file {2**21}"
    group(job, memory__max=str(4 * 2**30), memory__current=str(2**30), memory__stat=stat)
    group(own, memory__max="max", memory__current=str(2**30))
    found = CgroupLimits(tmp_path / "own", tmp_path / "root")
    assert found.available_memory_mib() == 3072 + 3

    (tmp_path / "own").write_text("4:memory:/slurm/uid_1000/job_7/step_0/task_0\n0::/\n")
    step_1 = tmp_path / "root/memory/slurm/uid_1000/job_7/step_0"
    stat = f"inactive_file 5\ntotal_active_file 0\ntotal_inactive_file {2**20}"
    group(
        step_1,
        memory__limit_in_bytes=str(2**30),
        memory__usage_in_bytes=str(2**29),
        memory__stat=stat,
    )
    group(step_1 / "task_0", memory__limit_in_bytes=str(2**63 - 4096), memory__usage_in_bytes="1")
    found = CgroupLimits(tmp_path / "own", tmp_path / "root")
    assert found.available_memory_mib() == 512 + 1


def test_limits_of_control_groups_of_version_1(tmp_path: Path):
    # In a container without a cgroup namespace the path is that of the host and not seen.
    (tmp_path / "own").write_text("4:memory:/a/b\n3:cpu,cpuacct:/a\n8:pids:/docker/1\n0::/x\n")
    root = tmp_path / "root"
    group(root / "memory/a", memory__limit_in_bytes=str(2**30))
    group(root / "cpu/a", cpu__cfs_quota_us="50000", cpu__cfs_period_us="100000")
    group(root / "cpu", cpu__cfs_quota_us="-1", cpu__cfs_period_us="100000")
    group(root / "pids", pids__max="30", pids__current="10")
    found = CgroupLimits(tmp_path / "own", root)
    assert (found.memory_mib(), found.threads(), found.cpu_quota()) == (1024.0, 20, 0.5)
    stat = f"active_file 1\ninactive_file 1\ntotal_active_file {2**20}\ntotal_inactive_file 0"
    group(root / "memory/a", memory__usage_in_bytes=str(2**29), memory__stat=stat)
    assert found.available_memory_mib() == 512 + 1
    found = CgroupLimits(tmp_path / "none", root)
    assert (found.memory_mib(), found.threads(), found.cpu_quota()) == (None, None, None)


@pytest.mark.parametrize(("quota", "count"), [(None, 8), (0.2, 1), (1.5, 2), (8.0, 8), (64.0, 8)])
def test_a_quota_of_time_is_as_many_cores(quota: float | None, count: int):
    cores = tuple(range(3, 11))
    taken = usable_cores(cores, quota, "host")
    assert len(taken) == count
    assert cores[taken[0] - 3 : taken[0] - 3 + count] == taken
    assert taken == usable_cores(cores, quota, "host")


def test_containers_of_one_machine_take_different_cores():
    taken = {usable_cores(range(64), 2.0, f"container-{number}") for number in range(10)}
    assert len(taken) > 5
