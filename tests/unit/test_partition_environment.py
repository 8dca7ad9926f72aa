"""The environment of a GMI, against golden files and rule by rule."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from supervision import gpu, machine, plan_config, reduce_config

from gmijax.machine.nvidia import Gpu, MigInstance
from gmijax.partition.plan import Plan
from gmijax.partition.planner import make_plan
from gmijax.supervise.backends import BACKENDS
from gmijax.supervise.backends.cpu import NO_FUSION_EMITTERS, cpu_environment
from gmijax.supervise.environment import extend_xla_flags, gmi_environment

GOLDEN = Path(__file__).parents[1] / "golden"
INHERITED = {
    "PATH": "/usr/bin",
    "XLA_FLAGS": "--xla_dump_to=/tmp/dump",
    "XLA_PYTHON_CLIENT_MEM_FRACTION": "0.5",
    "CUDA_VISIBLE_DEVICES": "0,1",
}
FROM_BACKEND = {
    "cpu": cpu_environment((0, 10, 2)),
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
        mps_control=Path("/usr/bin/nvidia-cuda-mps-control"),
        cpu_cores=tuple(range(8)),
        **changes_of_machine,
    )
    config = plan_config(gpus=2, gmis_per_gpu=2, backend=backend, **changes)
    return make_plan(config, reduce_config(), 64, here)


def environment(plan: Plan, gmi: int = 0, **inherited: str) -> dict[str, str]:
    return gmi_environment(plan, gmi, inherited, Path("/cache"), {})


@pytest.mark.parametrize("backend", sorted(BACKENDS))
def test_environment_is_the_golden_one(backend: str):
    plan = planned(backend, sm_percent=25.0 if backend == "mps" else None)
    found = gmi_environment(plan, 2, INHERITED, Path("/cache"), FROM_BACKEND[backend])
    assert found == json.loads((GOLDEN / f"environment_{backend}.json").read_text())


def test_users_choices_are_kept():
    users = {"JAX_COMPILATION_CACHE_DIR": "/mine", "OMP_NUM_THREADS": "7"}
    found = environment(planned("cpu"), 0, **users)
    assert {name: found[name] for name in users} == users


def test_inherited_share_is_overwritten():
    found = environment(
        planned("share"),
        CUDA_VISIBLE_DEVICES="0,1",
        CUDA_MPS_ACTIVE_THREAD_PERCENTAGE="10",
        XLA_PYTHON_CLIENT_MEM_FRACTION="0.9",
        XLA_CLIENT_MEM_FRACTION="0.9",
    )
    assert found["CUDA_VISIBLE_DEVICES"] == "GPU-00-uuid"
    assert found["XLA_CLIENT_MEM_FRACTION"] == "0.4"
    assert "XLA_PYTHON_CLIENT_MEM_FRACTION" not in found
    assert "CUDA_MPS_ACTIVE_THREAD_PERCENTAGE" not in found


@pytest.mark.parametrize(
    ("num_cores", "pool"), [(1, "1"), (2, "4"), (3, "4"), (4, "4"), (16, "16")]
)
def test_thread_pool_never_has_two_threads(num_cores: int, pool: str):
    here = machine(0, cpu_cores=tuple(range(num_cores)))
    plan = make_plan(plan_config(), reduce_config(), 8, here)
    assert environment(plan, PJRT_NPROC="2")["PJRT_NPROC"] == pool


@pytest.mark.parametrize(
    ("users", "added", "both"),
    [
        ("", "", ""),
        ("--a=1", "", "--a=1"),
        ("", "--b=2", "--b=2"),
        ("--a=1 --c", "--b=2", "--a=1 --c --b=2"),
        ("--b=true", "--b=false", "--b=true"),
    ],
)
def test_xla_flags_are_extended_and_the_users_win(users: str, added: str, both: str):
    assert extend_xla_flags(users, added) == both


@pytest.mark.parametrize(
    ("jaxlib", "accepted"),
    [
        ((0, 10, 2), True),
        ((0, 11, 0), True),
        ((0, 11, 1), False),
        ((0, 12, 0), False),
        (None, False),
    ],
)
def test_xla_flag_is_left_out_where_xla_would_abort(
    jaxlib: tuple[int, ...] | None, accepted: bool
):
    assert (cpu_environment(jaxlib) == {"XLA_FLAGS": NO_FUSION_EMITTERS}) == accepted


@pytest.mark.parametrize(("backend", "interface"), [("cpu", None), ("share", "lo")])
def test_rings_on_one_host_listen_on_its_loopback_interface(backend: str, interface: str | None):
    inherited = {"GMIJAX_WAITS": "1"}
    found = gmi_environment(planned(backend), 0, inherited, Path("/cache"), {})
    assert found.get("NCCL_SOCKET_IFNAME") == interface
    assert "GMIJAX_WAITS" not in found
    users = {"NCCL_SOCKET_IFNAME": "eth0"}
    assert users.items() <= gmi_environment(planned(backend), 0, users, Path("/c"), {}).items()


def test_inputs_are_not_changed():
    inherited, backend = dict(INHERITED), {"XLA_FLAGS": "--b=2"}
    gmi_environment(planned("cpu"), 0, inherited, Path("/cache"), backend)
    assert inherited == INHERITED
    assert backend == {"XLA_FLAGS": "--b=2"}


def test_a_priority_becomes_the_number_of_the_driver():
    found = environment(planned("mps", mps_priority=("normal", *["below_normal"] * 3)), 1)
    assert found["CUDA_MPS_CLIENT_PRIORITY"] == "1"
    assert "CUDA_MPS_CLIENT_PRIORITY" not in environment(planned("mps"))
