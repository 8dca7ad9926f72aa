"""Predicts how training scales to several nodes of eight GPUs: a model, not a measurement.

`python -m benchmarks.node_scaling` prints a Markdown table for the networks of clusters, with the
cost model of reductions (`predicted_s`), bandwidths inside a node as measured on H200s
(`python -m benchmarks.reduction`), and iterations as long as they were in training on one GPU.
No machines with GPUs were there to measure any of it.
"""

from __future__ import annotations

import argparse
import sys
from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

from benchmarks.evaluation.figures import rate
from benchmarks.evaluation.writer import Calls, markdown, newest
from benchmarks.runner import exit_code
from gmijax.collectives.strategies import predicted_s
from gmijax.errors import ConfigError
from gmijax.partition.layout import Layout

GPUS_PER_NODE = 8
NUM_ENVS = 8192
"""Of each GPU, in one GMI."""

NODES = (2, 8, 64)
GBIT_PER_S = (25.0, 100.0, 400.0)
MESSAGE_US = 50.0
"""Of a message between nodes, where nothing better is known: TCP through a program's sockets."""

ENOUGH = 0.9
MOST_NODES = 1024
RATES = "tasks-warp"
PATHS = MappingProxyType({"flat": "NCCL", "mpr": "host"})
"""How a node sums: the strategy, and what the table calls it."""


class Training(NamedTuple):
    """What a task asks of the network.

    Attributes:
      num_floats: parameters of policy and value network, about.
      unroll_length: steps of an environment in an iteration.
      exchanges: in an iteration: one for each minibatch of each epoch, one for the statistics.
    """

    num_floats: int
    unroll_length: int
    exchanges: int


TRAININGS = MappingProxyType(
    {
        "ant": Training(110_000, 16, 4 * 4 + 1),
        "shadow_hand": Training(1_500_000, 8, 4 * 5 + 1),
    }
)
"""As `configs/tuned/` has them."""


def main() -> int:
    """Prints the table for the networks asked for; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.node_scaling", description=__doc__)
    parser.add_argument("--gbit-per-s", nargs="+", type=float, default=GBIT_PER_S, metavar="GBIT")
    parser.add_argument("--message-us", type=float, default=MESSAGE_US, help="time of a message")
    given = parser.parse_args()
    if given.message_us < 0:
        raise ConfigError(f"--message-us {given.message_us:g}: expected 0 or more")
    sys.stdout.write("\n".join(table(given.gbit_per_s, given.message_us)) + "\n")
    return 0


class Measured(NamedTuple):
    """What the prediction starts from.

    Attributes:
      iteration_s: seconds of an iteration of one GPU alone, by task, as its rate says.
      b1: bytes a second between GMIs through host memory.
      b2: bytes a second of a ring between the GPUs of a node.
    """

    iteration_s: Mapping[str, float]
    b1: float
    b2: float


def reductions() -> Calls:
    """The newest call of `benchmarks.reduction` on GPUs."""
    return newest("reduction-nvidia-*.json", lambda _: "newest")


def reduction_results() -> Mapping[str, Any]:
    """What it measured; nothing without a file."""
    return next((call.results for call, _ in reductions().values()), {})


def measured() -> Measured:
    """From the files of results; of one with calls on two and four GPUs, bandwidths of four.

    Raises:
      ConfigError: something is not among them.
    """
    results = reduction_results()
    found = results.get("earlier", results).get("bytes_per_s")
    if not found:
        raise ConfigError("no file of results of benchmarks.reduction has bandwidths")
    iterations = {}
    for task, training in TRAININGS.items():
        steps_per_s = rate(RATES, f"{task} warp {NUM_ENVS}")
        if steps_per_s is None:
            raise ConfigError(f"{RATES}.json has no rate of {task} with {NUM_ENVS} environments")
        iterations[task] = NUM_ENVS * training.unroll_length / steps_per_s.median
    return Measured(iterations, found["b1"], found["b2"])


def table(gbit_per_s: Sequence[float] = GBIT_PER_S, message_us: float = MESSAGE_US) -> list[str]:
    """Predicted efficiencies for both tasks, both ways inside a node, and these networks.

    Raises:
      ConfigError: a bandwidth that is not positive, or results are missing.
    """
    known, nodes = measured(), ", ".join(map(str, NODES))
    rows = [
        [f"`{task}`", f"{way}, `{strategy}`", *_cells(known, task, strategy, speed, message_us)]
        for task in TRAININGS
        for strategy, way in PATHS.items()
        for speed in gbit_per_s
    ]
    head = (
        f"task | inside a node | Gbit/s: | by bytes alone, {nodes} nodes: "
        f"| with {message_us:g} us a message: | the same, exchanges ten times as long: "
        f"| nodes from which it is below {ENOUGH}:"
    )
    return markdown(head, rows)


def _cells(
    known: Measured, task: str, strategy: str, gbit_per_s: float, message_us: float
) -> Iterator[str]:
    yield f"{gbit_per_s:g}"
    for us, times in ((0.0, 1.0), (message_us, 1.0), (message_us, 10.0)):
        network = (gbit_per_s, us, times)
        values = (efficiency(known, task, strategy, nodes, *network) for nodes in NODES)
        yield " / ".join(f"{value:.2f}" for value in values)
    first = breaks_at(known, task, strategy, gbit_per_s, message_us)
    yield f"over {MOST_NODES}" if first is None else str(first)


def efficiency(
    known: Measured,
    task: str,
    strategy: str,
    num_nodes: int,
    gbit_per_s: float,
    message_us: float,
    times: float = 1.0,
) -> float:
    """Predicted steps/s of a GPU among all over those of one GPU alone, from 0 to 1.

    A leader sends each other leader one message in each of two rounds, one after the other.

    Args:
      known: what was measured on one node.
      task: a key of `TRAININGS`.
      strategy: of a node, a key of `COSTS`.
      num_nodes: with eight GPUs each, one GMI on each.
      gbit_per_s: of each node in each direction.
      message_us: what a message costs beside its bytes.
      times: as long as the model says do exchanges take.
    """
    training, alone_s = TRAININGS[task], known.iteration_s[task]
    layout = Layout.even(GPUS_PER_NODE, 1).on_nodes(num_nodes)
    b3 = gbit_per_s * 1e9 / 8
    bytes_s = predicted_s(strategy, layout, training.num_floats, known.b1, known.b2, b3)
    messages_s = 2 * (num_nodes - 1) * message_us * 1e-6
    return alone_s / (alone_s + training.exchanges * times * (bytes_s + messages_s))


def breaks_at(
    known: Measured, task: str, strategy: str, gbit_per_s: float, message_us: float
) -> int | None:
    """The fewest nodes with an efficiency below `ENOUGH`; None if not up to `MOST_NODES`."""

    def is_below(nodes: int) -> bool:
        return efficiency(known, task, strategy, nodes, gbit_per_s, message_us) < ENOUGH

    # More nodes are never better.
    first = 1 + bisect_left(range(1, MOST_NODES + 1), True, key=is_below)
    return None if first > MOST_NODES else first


def model_fit(strategy: str) -> list[float]:
    """Measured over predicted time of means with one GMI on each GPU, alone and in chains."""
    # One GMI on a GPU: `mrr` is the one ring of `flat`, whose time the model gives twice over.
    measured_as, halved = ("mrr", 2.0) if strategy == "flat" else (strategy, 1.0)
    return [
        halved * row[key] / row["predicted_s"]
        for row in reduction_results().get("rows", ())
        if row["strategy"] == measured_as and row["layout"] in ("[[0],[1]]", "[[0],[1],[2],[3]]")
        for key in ("median_s", "chained_s")
    ]


if __name__ == "__main__":
    sys.exit(exit_code(main))
