"""The paper's resource model of templates: section 5.1, Tables 4 and 5, equations 2 and 3. No jax.

The letters are the paper's: R_s, R_a, R_t the size of the dominant resource that simulator, agent
and trainer need, T_s, T_a, T_t the seconds that they take in one iteration, COM the bytes that an
iteration moves between GMIs, BW bytes a second between GMIs. `alpha` and `beta` say which part of
an agent and of a trainer one simulator needs, where several simulators share them.

Two templates are compared by their throughput: `throughput` of the one over that of the other.
The price of co-location is in R (a GMI holds the largest of its tasks all the time), the price of
separation in COM.
"""

from __future__ import annotations

from typing import NamedTuple

from gmijax.errors import ConfigError


class Task(NamedTuple):
    """One of the tasks of an iteration, as it was measured.

    Attributes:
      seconds: T, its time in one iteration.
      resource: R, SMs or memory that it needs, in any unit that is the same for all.
    """

    seconds: float
    resource: float


NOTHING = Task(0.0, 0.0)
"""The trainer of a serving job."""


def tdg_resource(simulator: Task, agent: Task, alpha: float) -> float:
    """Table 4, TDG: (T_s R_s + T_a alpha R_a) / (T_s + T_a)."""
    return tdg_ex_resource(simulator, agent, NOTHING, alpha, 0.0)


def tcg_resource(simulator: Task, agent: Task) -> float:
    """Table 4, TCG: (T_s + T_a) max(R_s, R_a) / (T_s + T_a)."""
    return max(simulator.resource, agent.resource)


def tdg_ex_resource(
    simulator: Task, agent: Task, trainer: Task, alpha: float, beta: float
) -> float:
    """Table 5, TDG_EX: (T_s R_s + T_a alpha R_a + T_t beta R_t) / (T_s + T_a + T_t).

    Raises:
      ConfigError: the tasks take no time at all.
    """
    total_s = simulator.seconds + agent.seconds + trainer.seconds
    _require_positive(total_s=total_s)
    return (
        simulator.seconds * simulator.resource
        + agent.seconds * alpha * agent.resource
        + trainer.seconds * beta * trainer.resource
    ) / total_s


def tcg_ex_resource(simulator: Task, agent: Task, trainer: Task) -> float:
    """Table 5, TCG_EX: (T_s + T_a + T_t) max(R_s, R_a, R_t) / (T_s + T_a + T_t)."""
    return max(simulator.resource, agent.resource, trainer.resource)


def throughput(all_resource: float, resource: float, work_s: float, com_s: float) -> float:
    """Equations 2 (serving) and 3 (training): iterations a second of a GPU.

    TOP = R_all / R x 1 / (T_s + T_a + T_t + COM / BW), T_t = 0 in serving.

    Args:
      all_resource: R_all, what the GPU has.
      resource: R, what one instance of the template needs.
      work_s: sum of the tasks' times.
      com_s: COM / BW, seconds of communication in one iteration.

    Raises:
      ConfigError: a resource or a time that is not positive.
    """
    _require_positive(all_resource=all_resource, resource=resource, work_s=work_s)
    return all_resource / resource / (work_s + com_s)


def penalty(colocated: float, dedicated: float) -> float:
    """How much more of the dominant resource co-location takes: R_TCG / R_TDG - 1."""
    _require_positive(dedicated=dedicated)
    return colocated / dedicated - 1.0


def serving_gain(simulator: Task, agent: Task, alpha: float, com_s: float) -> float:
    """TOP of TCG over TOP of TDG, whose communication takes `com_s` seconds an iteration."""
    work_s = simulator.seconds + agent.seconds
    together = throughput(1.0, tcg_resource(simulator, agent), work_s, 0.0)
    return together / throughput(1.0, tdg_resource(simulator, agent, alpha), work_s, com_s)


def training_gain(
    simulator: Task,
    agent: Task,
    trainer: Task,
    shares: tuple[float, float],
    com_s: tuple[float, float],
) -> float:
    """TOP of TCG_EX over TOP of TDG_EX.

    Args:
      simulator: its time and resource.
      agent: its time and resource.
      trainer: its time and resource.
      shares: alpha and beta.
      com_s: seconds of communication an iteration, of TCG_EX and of TDG_EX.
    """
    work_s = simulator.seconds + agent.seconds + trainer.seconds
    resource = tdg_ex_resource(simulator, agent, trainer, *shares)
    together = throughput(1.0, tcg_ex_resource(simulator, agent, trainer), work_s, com_s[0])
    return together / throughput(1.0, resource, work_s, com_s[1])


def _require_positive(**values: float) -> None:
    for name, value in values.items():
        if not value > 0:
            raise ConfigError(f"resource model: {name}={value!r}: must be greater than 0")
