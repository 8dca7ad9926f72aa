"""Makes the plan of a job: pure functions of the configuration and the machine."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence

from gmijax.config import BackendName, PlanConfig, ReduceConfig, TemplateName
from gmijax.errors import ConfigError
from gmijax.machine.host_limits import require_host_capacity
from gmijax.machine.nvidia import Gpu
from gmijax.machine.snapshot import Machine
from gmijax.partition.backend_choice import choose_backend, choose_gpus, require_backend
from gmijax.partition.layout import Layout
from gmijax.partition.node_layouts import (
    NodeLayout,
    divided_between_nodes,
    node_layouts,
    on_nodes,
)
from gmijax.partition.plan import Allocation, Plan
from gmijax.partition.reduction import (
    is_one_per_gpu,
    needs_ring,
    require_strategy,
    select_strategy,
    why_not_intra,
    why_not_nccl,
    why_not_strategy,
    why_not_under,
)
from gmijax.partition.shares import make_allocations
from gmijax.partition.templates import DESCRIPTIONS, TRAINER, group_of, nodes_of, roles_of

_NO_RINGS_ON_CPU = (
    "between virtual GPUs host memory is faster than any ring, ask for it with reduce.strategy={}"
)
"""Backends that take host memory where Algorithm 1 says rings, and why."""


def make_plan(
    plan: PlanConfig,
    reduce: ReduceConfig,
    num_envs: int,
    machine: Machine,
    *,
    template: TemplateName = "tcg_ex",
    trainers: Collection[int] = (),
    nodes: Mapping[str, Machine] | None = None,
) -> Plan:
    """Decides everything that is `auto` and checks the rest against the machine.

    `num_envs` is N, environments per GMI; `template` what `plan.template=auto` means; `trainers`
    are the ids of the GMIs that train, for the template `decoupled`. With `nodes`, machines by
    address, each of them gets what `plan` says, or with `decoupled` its part of `plan.layout`;
    `machine` is the first.

    Raises:
      BackendUnavailable: the wanted backend cannot be had on this machine.
      ConfigError: a value that does not fit the machine or the backend.
    """
    if nodes is None:
        require_host(*num_gmis_of(plan), plan, machine)
    layout = _layout(plan)
    reasons: list[str] = list(machine.warnings)
    chosen = template if plan.template == "auto" else plan.template
    if nodes is not None:
        layout = on_nodes(layout, chosen, nodes, reasons)
    of_nodes = node_layouts(layout, machine, nodes)
    backend = _backend(plan, of_nodes, chosen in ("tcg", "tdg"), reasons)
    roles = roles_of(chosen, layout, trainers)
    allocations, gpus = _allocations(plan, of_nodes, backend, reasons)
    if plan.template == "auto":
        reasons.append(f"template {chosen}: {DESCRIPTIONS[chosen]}")
    devices = [allocation.device for allocation in allocations]
    strategy, intra, inter = _reduction(reduce, layout, roles, backend, devices, reasons)
    return Plan(
        layout=layout,
        allocations=allocations,
        backend=backend,
        template=chosen,
        num_envs_per_gmi=num_envs,
        strategy=strategy,
        intra=intra,
        roles=roles,
        reasons=tuple(reasons),
        self_check=_self_check(plan, allocations, backend, of_nodes),
        allow_fallback=_allow_fallback(plan, gpus, backend),
        nodes=tuple(nodes or ()),
        inter=inter,
    )


def require_host(num_gmis: int, what: str, plan: PlanConfig, machine: Machine) -> None:
    """Raises ConfigError if a job, by its settings `what`, has more GMIs than the host takes."""
    on_cpu = plan.backend == "cpu" or not machine.gpus
    require_host_capacity(num_gmis, what, machine.host, len(machine.cpu_cores), on_cpu=on_cpu)


def num_gmis_of(plan: PlanConfig) -> tuple[int, str]:
    """How many GMIs a job has, and the settings that say so; before there is a layout."""
    if plan.layout is not None:
        return sum(map(len, plan.layout)), "plan.layout"
    num_gpus, each = plan.num_gpus, plan.gmis_per_gpu
    if each == "auto":
        raise ConfigError("plan.gmis_per_gpu=auto: not decided yet; expected an integer")
    gpus = f", plan.gpus={num_gpus}" if num_gpus > 1 else ""
    return num_gpus * each, f"plan.gmis_per_gpu={each}{gpus}"


def _allocations(
    plan: PlanConfig,
    of_nodes: Sequence[NodeLayout],
    backend: BackendName,
    reasons: list[str],
) -> tuple[tuple[Allocation, ...], tuple[Gpu, ...]]:
    """The share of every GMI of its machine, in order of id, and the GPUs of the job."""
    allocations: dict[int, Allocation] = {}
    chosen: list[Gpu] = []
    num_gpus = 0
    for number, node in enumerate(of_nodes):
        here, gpus = node.layout, ()
        notes = [] if number else reasons  # Reasons that hold for all nodes are given once.
        with node.named():
            if node.name is not None:
                what = f"cluster.nodes={len(of_nodes)}"
                require_host(here.num_gmis, what, plan, node.machine)
            if backend != "cpu":
                gpus = choose_gpus(plan, here, node.machine, backend, notes)
            of_node = make_allocations(plan, here, gpus, backend, node.machine, notes)
        for allocation in of_node:
            gmi, gpu = node.gmis[allocation.gmi], allocation.gpu + num_gpus
            allocations[gmi] = dataclasses.replace(allocation, gmi=gmi, gpu=gpu)
        chosen += gpus
        num_gpus += here.num_gpus
    in_order = [allocations[gmi] for gmi in sorted(allocations)]
    if plan.memory_fraction is None:
        in_order = divided_between_nodes(in_order, reasons)
    return tuple(in_order), tuple(chosen)


def _layout(plan: PlanConfig) -> Layout:
    if plan.layout is None:
        assert plan.gmis_per_gpu != "auto"
        return Layout.even(plan.num_gpus, plan.gmis_per_gpu)
    layout = Layout(plan.layout)
    if not isinstance(plan.gpus, int) and len(plan.gpus) != layout.num_gpus:
        raise ConfigError(
            f"plan.gpus={list(plan.gpus)}: plan.layout has {layout.num_gpus} GPUs, "
            f"so give {layout.num_gpus} indices or none"
        )
    return layout


def _backend(
    plan: PlanConfig, of_nodes: Sequence[NodeLayout], serves: bool, reasons: list[str]
) -> BackendName:
    """The backend of all machines."""
    if plan.backend != "auto":
        for node in of_nodes:
            with node.named():
                require_backend(plan.backend, node.machine)
        return plan.backend
    found: dict[BackendName, tuple[str, str | None]] = {}
    for node in of_nodes:
        with node.named():
            backend, why = choose_backend(plan, node.layout, node.machine, serves=serves)
        found.setdefault(backend, (why, node.name))
    if len(found) > 1 and found.keys() != {"mps", "share"}:
        differ = ", ".join(f"{backend} on {name}" for backend, (_, name) in found.items())
        raise ConfigError(f"plan.backend=auto: would be {differ}; give the one that all can have")
    backend = "share" if len(found) > 1 else next(iter(found))
    why, name = found[backend]
    where = f" (node {name})" if len(found) > 1 else ""
    reasons.append(f"backend {backend}: {why}{where}")
    return backend


def _self_check(
    plan: PlanConfig,
    allocations: Sequence[Allocation],
    backend: BackendName,
    of_nodes: Sequence[NodeLayout],
) -> bool:
    if plan.self_check != "auto":
        return plan.self_check == "on"
    # An existing daemon may cap all its clients by default, and does not report it.
    # In a job of a pack the pack's daemon counts as one of these; that costs a matrix product.
    is_theirs = backend == "mps" and any(node.machine.operator_daemon for node in of_nodes)
    return is_theirs or any((allocation.sm_percent or 100.0) < 100.0 for allocation in allocations)


def _allow_fallback(plan: PlanConfig, gpus: Sequence[Gpu], backend: BackendName) -> bool:
    takes_turns_else = plan.backend == "auto" and backend == "mps" and plan.sm_percent is None
    return takes_turns_else and all(gpu.compute_mode == "default" for gpu in gpus)


def _reduction(
    reduce: ReduceConfig,
    layout: Layout,
    roles: tuple[str, ...],
    backend: BackendName,
    devices: Sequence[str],
    reasons: list[str],
) -> tuple[str, str, str | None]:
    """How those that train average gradients, and exchange inside one GPU and between nodes."""
    training = group_of(layout, roles, TRAINER)
    if training is None:
        return "none", "host", None
    of_ranks = [training.layout.node_of(rank) for rank in range(len(training.gmis))]
    nodes = nodes_of(layout, training.gmis)
    is_split = [nodes[node] for node in of_ranks] == [layout.node_of(g) for g in training.gmis]
    if not (is_split and training.layout.is_alike):
        raise ConfigError(
            f"plan.training_gpus: of layout {layout} GMIs {list(training.gmis)} train, and nodes "
            "that train must have as many of them on as many GPUs, numbered in order of the nodes"
        )
    no_nccl = why_not_nccl(training.layout, backend, [devices[gmi] for gmi in training.gmis])
    strategy = _strategy(reduce, training.layout, backend, no_nccl, reasons)
    inter = _inter(strategy, training.layout, no_nccl, reasons)
    return strategy, _intra(strategy, backend, reasons), inter


def _strategy(
    reduce: ReduceConfig,
    layout: Layout,
    backend: BackendName,
    no_nccl: str | None,
    reasons: list[str],
) -> str:
    """How those that train, in `layout`, average gradients; `none` if there is only one."""
    is_named = reduce.strategy not in ("auto", "paper")
    if is_named:
        require_strategy(reduce.strategy, layout, backend)
    if layout.num_gmis == 1:
        reasons.append("strategy none: no gradient reduction (one GMI)")
        return "none"
    if is_named:
        return reduce.strategy
    is_one_ring = layout.num_nodes > 1 and layout.num_gmis == layout.num_gpus
    if is_one_ring and no_nccl is None and reduce.strategy == "auto":
        reasons.append("strategy flat: one GMI on each GPU of several nodes, so one ring of all")
        return "flat"
    paper, why = select_strategy(layout)
    no_ring = why_not_under(paper, layout, backend)
    if backend == "cpu" and needs_ring(paper, layout):
        no_ring = why_not_strategy(paper, layout) or _NO_RINGS_ON_CPU.format(paper)
    no_one_shot = why_not_under("one_shot", layout, backend)
    # With one GMI on each GPU one ring over all is as fast.
    wants_one_shot = no_ring is not None or not is_one_per_gpu(layout)
    wants_one_shot &= layout.of_node(0).num_gmis > 1
    wants_one_shot &= reduce.strategy == "auto"
    if wants_one_shot and no_one_shot is None:
        reasons.append(
            "strategy one_shot: GMIs that share GPUs train faster with exchanges on them; "
            f"Algorithm 1 says {paper} ({why}), as reduce.strategy=paper does"
        )
        return "one_shot"
    # Under other backends there is no memory of a GPU to share, whatever is installed.
    is_slow = wants_one_shot and backend in ("mps", "share")
    slow = f"; one_shot would train faster: {no_one_shot}" if is_slow else ""
    if no_ring is not None:
        reasons.append(f"strategy mpr: Algorithm 1 says {paper} ({why}); {no_ring}{slow}")
        return "mpr"
    reasons.append(f"strategy {paper}: {why} (Algorithm 1){slow}")
    return paper


def _inter(strategy: str, layout: Layout, no_nccl: str | None, reasons: list[str]) -> str | None:
    if layout.num_nodes == 1:
        return None
    if strategy == "mpr":
        no_nccl = no_nccl or "mpr goes through the host"
    if no_nccl is not None:
        reasons.append(f"inter tcp: nodes exchange through the host and TCP; {no_nccl}")
        return "tcp"
    reasons.append("inter nccl: rings of NCCL go from GPUs of one node to those of others")
    return "nccl"


def _intra(strategy: str, backend: BackendName, reasons: list[str]) -> str:
    if reason := why_not_intra("ipc", backend):
        if strategy != "none":
            reasons.append(
                f"intra host: GMIs of a GPU exchange through shared host memory; {reason}"
            )
        return "host"
    if strategy not in ("one_shot", "none"):
        reasons.append("intra ipc: with har GMIs of a GPU exchange through memory of the GPU")
    return "ipc"
