"""Main of a GMI that runs a role of the user's own: `python -m gmijax.roles.worker`."""

from __future__ import annotations

import pickle
import sys
from typing import TYPE_CHECKING, Any

from gmijax.channels.messenger import Messenger
from gmijax.channels.pipe_block import PipeBlock
from gmijax.collectives.host.shared_memory_group import SharedMemoryGroup
from gmijax.partition.plan import Plan
from gmijax.partition.reduction import why_not_intra
from gmijax.roles import shipping
from gmijax.roles.group import GroupReducer
from gmijax.roles.role import Gmi, enter
from gmijax.runs.folder import read_json
from gmijax.supervise.child import ENV_EXCHANGE_FD, ENV_PIPES_FD, ChildLink, required_fd, run_gmi

if TYPE_CHECKING:
    from gmijax.channels.device_arrays import DeviceBuffers


_DRAIN_S = 1.0
"""After so long a GMI that only waits for others to receive sends a heartbeat."""


def _run(link: ChildLink) -> dict[str, Any]:
    config = read_json(link.run.config)
    plan = Plan.from_dict(read_json(link.run.plan))
    # Before the role's own modules, which may use jax.
    _take_up_share(plan, link)
    block = PipeBlock(required_fd(ENV_PIPES_FD), link.gmi)
    device = _device_buffers(plan, link.gmi) if config["device_messages"] else None
    messenger = Messenger(block, config["timeout_s"], device)
    sys.path[:] = config["sys_path"]  # As where the job was started.
    role, args = pickle.loads(link.paths.role.read_bytes())

    def build(num_floats: int) -> SharedMemoryGroup:
        timeout_s = config["timeout_s"]
        return SharedMemoryGroup(
            *(required_fd(ENV_EXCHANGE_FD), link.gmi, plan.layout.num_gmis, num_floats),
            timeout_s=timeout_s,
            rendezvous_timeout_s=timeout_s,
        )

    reducer = GroupReducer(messenger, build)
    enter(Gmi(plan.layout, messenger, reducer, link))
    link.beat("ready", 0)
    output = shipping.dump(role.run(*args))
    # What was sent must be in shared memory before this process is gone, or have been received.
    messenger.flush()
    while not messenger.drain(_DRAIN_S):
        link.beat("running", 0)
    reducer.close()
    link.paths.output.write_bytes(output)
    return {"status": "completed"}


def _take_up_share(plan: Plan, link: ChildLink) -> None:
    """Opens the GPU, with jax's pool of memory; on a CPU jax is left to the role."""
    if plan.backend != "cpu":
        import jax

        from gmijax.selfcheck import check_share

        # Backends look for it once all GMIs are ready.
        jax.devices()
        check_share(plan, link.gmi)


def _device_buffers(plan: Plan, gmi: int) -> DeviceBuffers | None:
    """What keeps arrays of messages on the GPU; None where GMIs share none, or not its memory."""
    neighbours = [peer for peer in plan.layout.neighbours_of(gmi) if peer != gmi]
    if not neighbours or why_not_intra("ipc", plan.backend):
        return None
    from gmijax.channels.device_arrays import DeviceBuffers
    from gmijax.collectives.device.cuda_memory import CudaMemory

    return DeviceBuffers(neighbours, CudaMemory)


if __name__ == "__main__":
    sys.exit(run_gmi(_run))
