"""The machines of a job: one, or the nodes of a cluster, each with its part of the layout."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import NamedTuple

from gmijax.config import TemplateName
from gmijax.config.plan import MAX_GMIS
from gmijax.errors import ConfigError
from gmijax.machine.differences import differences_in_gpus
from gmijax.machine.snapshot import Machine
from gmijax.partition.layout import Layout
from gmijax.partition.plan import Allocation


class NodeLayout(NamedTuple):
    """A machine of a job, and which GMIs it has.

    Attributes:
      name: address of a node; None in a job on one machine.
      machine: what it has.
      layout: of its GMIs, with ranks in the node instead of ids.
      gmis: their ids, in order.
    """

    name: str | None
    machine: Machine
    layout: Layout
    gmis: tuple[int, ...]

    @contextmanager
    def named(self) -> Iterator[None]:
        """Puts the node before the message of an error."""
        try:
            yield
        except ConfigError as error:
            if self.name is None:
                raise
            raise type(error)(f"node {self.name}: {error}") from None


def node_layouts(
    layout: Layout, machine: Machine, nodes: Mapping[str, Machine] | None
) -> tuple[NodeLayout, ...]:
    """This machine, or the nodes, in order; `layout` is that of the whole job."""
    if nodes is None:
        return (NodeLayout(None, machine, layout, tuple(layout.gmis)),)
    return tuple(
        NodeLayout(name, theirs, layout.of_node(node), layout.gmis_of_node[node])
        for node, (name, theirs) in enumerate(nodes.items())
    )


def on_nodes(
    layout: Layout, template: TemplateName, nodes: Mapping[str, Machine], reasons: list[str]
) -> Layout:
    """The layout of all nodes; `layout` is that of each, with `decoupled` of all together.

    Raises:
      ConfigError: more GMIs than are allowed, or GPUs that are too different.
    """
    problems, notes = differences_in_gpus(nodes)
    if problems:
        raise ConfigError(
            f"cluster.engine=ray: {problems[0]}; GMIs that learn together need the same"
        )
    reasons += [f"warning: {note}" for note in notes]
    is_whole = template == "decoupled"
    if (num_gmis := layout.num_gmis * (1 if is_whole else len(nodes))) > MAX_GMIS:
        raise ConfigError(
            f"cluster.nodes={len(nodes)}: makes {num_gmis} GMIs; at most {MAX_GMIS} are allowed"
        )
    count = f"{layout.num_gmis} GMIs " + ("on all" if is_whole else "on each")
    reasons.append(f"nodes {', '.join(nodes)}: {count} of {len(nodes)}")
    if is_whole:
        return Layout(layout.gmis_of_gpu, len(nodes))
    return layout.on_nodes(len(nodes))


def divided_between_nodes(
    allocations: Sequence[Allocation], reasons: list[str]
) -> list[Allocation]:
    """With less memory for GMIs on a GPU that several nodes have: these are one machine."""
    gpus_of: dict[str, set[int]] = {}
    for allocation in allocations:
        gpus_of.setdefault(allocation.device, set()).add(allocation.gpu)
    divided: list[Allocation] = []
    for allocation in allocations:
        fraction, owners = allocation.memory_fraction, len(gpus_of[allocation.device])
        if fraction is not None and owners > 1:
            fraction = round(fraction / owners, 4)
        divided.append(dataclasses.replace(allocation, memory_fraction=fraction))
    if divided != list(allocations):
        reasons.append("nodes of one machine have the same GPUs, and divide their memory")
    return divided
