"""What trainers and agents publish for each other, in registers that never block.

Register 0: orders of the leading trainer. Register 1: the newest weights, with the policy's
version as tag. Then one per agent: what it has done so far. Experience travels elsewhere. On
several nodes the values also travel between them (`gmijax/workers/node_registers.py`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gmijax.channels.registers import AnyRegister, open_registers

_NO_CHECKPOINT = -1


class AgentCommand(NamedTuple):
    """What the leading trainer wants of all agents.

    To add their environments to the `checkpoint` of so many environment steps, if there is one,
    and whether to end when they have done so.
    """

    checkpoint: int | None
    is_ending: bool

    def pack(self) -> npt.NDArray[np.int64]:
        """As numbers for the register."""
        return np.array([_number(self.checkpoint), self.is_ending], np.int64)

    @classmethod
    def unpack(cls, values: npt.NDArray[np.uint8]) -> AgentCommand:
        """Inverts `pack`."""
        checkpoint, is_ending = values.view(np.int64)
        return cls(_optional(checkpoint), bool(is_ending))


class AgentReport(NamedTuple):
    """What an agent has done since its start.

    Attributes:
      checkpoint: environment steps of the latest checkpoint that it has added to, or None.
      env_steps: environment steps acted upon: predictions.
      bytes_sent: of experience.
      send_s: seconds spent on sending, with waits for space.
      wait_s: those of them in which it waited for space and had nothing to compute.
      occupancy: fraction of the space for experience that was full, after the last send.
      stats: [M] sums over all its unrolls, see `gmijax.learning.unroll.Counts`.
    """

    checkpoint: int | None
    env_steps: float
    bytes_sent: float
    send_s: float
    wait_s: float
    occupancy: float
    stats: npt.NDArray[np.float64]

    @classmethod
    def of_nothing(cls, num_stats: int) -> AgentReport:
        """That of an agent which has done nothing."""
        return cls(None, 0.0, 0.0, 0.0, 0.0, 0.0, np.zeros(num_stats))

    def pack(self) -> npt.NDArray[np.float64]:
        """As numbers for the register; environment steps are exact up to 2^53."""
        head = [_number(self.checkpoint), *self[1:-1]]
        return np.concatenate([np.array(head, np.float64), self.stats])

    @classmethod
    def unpack(cls, values: npt.NDArray[np.uint8]) -> AgentReport:
        """Inverts `pack`."""
        numbers, head = values.view(np.float64), len(cls._fields) - 1
        first, *rest = (float(x) for x in numbers[:head])
        return cls(_optional(first), *rest, stats=numbers[head:])


class JobRegisters(NamedTuple):
    """All registers of a job, see the module."""

    orders: AnyRegister
    weights: AnyRegister
    reports: tuple[AnyRegister, ...]


def register_bytes(num_weights: int, num_stats: int) -> tuple[int, int, int]:
    """Sizes of orders, weights and a report."""
    report_bytes = 8 * (len(AgentReport._fields) - 1 + num_stats)
    return 8 * len(AgentCommand._fields), 4 * num_weights, report_bytes


def open_job_registers(fd: int, num_weights: int, num_stats: int, num_agents: int) -> JobRegisters:
    """Maps the registers of a job; `fd` is from `create_registers`."""
    *shared, report_bytes = register_bytes(num_weights, num_stats)
    orders, weights, *reports = open_registers(fd, [*shared, *[report_bytes] * num_agents])
    return JobRegisters(orders, weights, tuple(reports))


def _number(checkpoint: int | None) -> int:
    return _NO_CHECKPOINT if checkpoint is None else checkpoint


def _optional(number: float) -> int | None:
    return None if number == _NO_CHECKPOINT else int(number)
