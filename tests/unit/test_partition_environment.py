"""The environment of a GMI, against golden files and rule by rule."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from supervision import MPS, gpu, machine
from supervision import planned as plan_of

from gmijax.machine import xla_on_cpu
from gmijax.machine.nvidia import Gpu, MigInstance
from gmijax.partition.plan import Plan
from gmijax.supervise.backends import BACKENDS
from gmijax.supervise.environment import gmi_environment

NO_EMITTERS = "--xla_cpu_use_fusion_emitters=false"
GOLDEN = Path(__file__).parents[1] / "golden"
INHERITED = {
    "PATH": "/usr/bin",
    "XLA_FLAGS": "--xla_dump_to=/tmp/dump",
    # What defines a share, and is that of another job here.
    "CUDA_MPS_ACTIVE_THREAD_PERCENTAGE": "10",
    "CUDA_VISIBLE_DEVICES": "0,1",
    "XLA_CLIENT_MEM_FRACTION": "0.9",
    "XLA_PYTHON_CLIENT_MEM_FRACTION": "0.5",
    # What other programs of the user compute with.
    "JAX_ENABLE_X64": "1",
    "JAX_NUMPY_DTYPE_PROMOTION": "strict",
}
FROM_BACKEND = {
    "cpu": {},
    "share": {"CUDA_MPS_PIPE_DIRECTORY": "/runs/a/mps/none"},
    "mig": {"CUDA_MPS_PIPE_DIRECTORY": "/runs/a/mps/none"},
    "mps": {"CUDA_MPS_PIPE_DIRECTORY": "/tmp/gmijax-1"},
}


def divided_gpus() -> tuple[Gpu, ...]:
    """Two GPUs with a large and a small MIG instance each."""
    return tuple(
        gpu(index, mig_enabled=True)._replace(
            instances=(
                MigInstance(f"MIG-{index}-small", "1g.18gb", 9, 16, 17856),
                MigInstance(f"MIG-{index}-large", "3g.71gb", 1, 60, 71424),
            )
        )
        for index in range(2)
    )


def planned(backend: str, **changes: Any) -> Plan:
    changes_of_machine = {"gpus": divided_gpus()} if backend == "mig" else {}
    here = machine(
        0 if backend == "cpu" else 2,
        mps_control=MPS,
        cpu_cores=tuple(range(8)),
        **changes_of_machine,
    )
    return plan_of(here, gpus=2, gmis_per_gpu=2, backend=backend, **changes)


def environment(plan: Plan, gmi: int = 0, **inherited: str) -> dict[str, str]:
    return gmi_environment(plan, gmi, inherited, Path("/cache"), {})


@pytest.mark.parametrize("backend", sorted(BACKENDS))
def test_environment_is_the_golden_one_whatever_is_inherited(backend: str):
    plan = planned(backend, sm_percent=25.0 if backend == "mps" else None)
    found = gmi_environment(plan, 2, INHERITED, Path("/cache"), FROM_BACKEND[backend])
    assert found == json.loads((GOLDEN / f"environment_{backend}.json").read_text())


@pytest.mark.parametrize(
    ("num_cores", "pool"), [(1, "1"), (2, "4"), (3, "4"), (4, "4"), (16, "16")]
)
def test_thread_pool_never_has_two_threads(num_cores: int, pool: str):
    plan = plan_of(machine(0, cpu_cores=tuple(range(num_cores))))
    assert environment(plan, PJRT_NPROC="2")["PJRT_NPROC"] == pool


@pytest.mark.parametrize(
    ("jaxlib", "users", "flags"),
    [
        ("0.10.2", "", NO_EMITTERS),
        ("0.11.0.dev3", "--a=1 --c", f"--a=1 --c {NO_EMITTERS}"),
        ("0.10.2", "--xla_cpu_use_fusion_emitters=true", "--xla_cpu_use_fusion_emitters=true"),
        # XLA would abort.
        ("0.11.1", "--a=1", "--a=1"),
        ("0.12.0", "", None),
        (None, "", None),
    ],
)
def test_xla_flag_is_added_where_jaxlib_knows_it_and_the_user_has_not(
    jaxlib: str | None, users: str, flags: str | None, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(xla_on_cpu, "versions_of", lambda _: {"jaxlib": jaxlib})
    inherited = {"XLA_FLAGS": users} if users else {}
    assert environment(planned("cpu"), **inherited).get("XLA_FLAGS") == flags


@pytest.mark.parametrize("backend", ["cpu", "share"])
def test_users_choices_are_kept(backend: str):
    users = {
        "NCCL_SOCKET_IFNAME": "eth0",
        "JAX_COMPILATION_CACHE_DIR": "/mine",
        "OMP_NUM_THREADS": "7",
    }
    assert users.items() <= environment(planned(backend), **users).items()


@pytest.mark.parametrize(
    ("cores", "environment", "missing"),
    [
        (8, {}, {"XLA_FLAGS": NO_EMITTERS}),
        (2, {"XLA_FLAGS": "--a=1"}, {"XLA_FLAGS": f"--a=1 {NO_EMITTERS}", "PJRT_NPROC": "4"}),
        (3, {"XLA_FLAGS": NO_EMITTERS}, {"PJRT_NPROC": "4"}),
        (2, {"XLA_FLAGS": NO_EMITTERS, "PJRT_NPROC": "2"}, {}),
        (1, {"XLA_FLAGS": NO_EMITTERS}, {}),
    ],
)
def test_what_a_users_own_process_lacks_for_physics_on_a_cpu(
    cores: int,
    environment: dict[str, str],
    missing: dict[str, str],
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setattr(xla_on_cpu, "versions_of", lambda _: {"jaxlib": "0.10.2"})
    assert xla_on_cpu.missing_on_cpu(environment, cores) == missing
