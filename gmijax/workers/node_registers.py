"""The registers of a GMI of an asynchronous job on several nodes.

In the node of the leading trainer they are in shared memory, as on one machine; agents elsewhere
exchange theirs with the leader by TCP.
"""

from __future__ import annotations

from contextlib import ExitStack

from gmijax.a3c.job_registers import JobRegisters, register_bytes
from gmijax.channels.registers import RemoteRegisters
from gmijax.collectives.nodes.rendezvous import NodeAddresses


def over_nodes(
    local: JobRegisters,
    sizes: tuple[int, int],
    nodes: NodeAddresses,
    gmi: int,
    agents: tuple[int, ...],
    leader: int,
    held: ExitStack,
) -> JobRegisters:
    """The registers as `gmi` uses them; `local` are those of its node, `sizes` as it was given.

    Raises:
      CollectiveError, ConfigError: as `Connection`.
    """
    far = {agent: nodes.calls[agent, leader] for agent in agents if (agent, leader) in nodes.calls}
    if not far or (gmi != leader and gmi not in far):
        return local
    orders, weights, report = register_bytes(*sizes)
    if gmi == leader:
        mine = RemoteRegisters(
            gmi, far, [orders, weights], [report], listens=False, secret=nodes.token
        )
        held.callback(mine.close)
        reports = (
            mine.of(agent, 0) if agent in far else local.reports[index]
            for index, agent in enumerate(agents)
        )
        return JobRegisters(mine.own(0, local.orders), mine.own(1, local.weights), tuple(reports))
    mine = RemoteRegisters(
        gmi, {leader: far[gmi]}, [report], [orders, weights], listens=True, secret=nodes.token
    )
    held.callback(mine.close)
    # An agent writes none but its own.
    return JobRegisters(mine.of(leader, 0), mine.of(leader, 1), (mine.own(0),) * len(agents))
