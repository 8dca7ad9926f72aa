"""Jobs on two nodes of one GPU each, and on one node with both: their commands, as data."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from benchmarks.evaluation.node_tables import ONE_NODE, TWO_NODES
from benchmarks.two_ray_nodes import RAY
from gmijax.runs.names import counted

_SOCKETS = {f"NCCL_{way}_DISABLE": "1" for way in ("P2P", "SHM", "IB")}
_SAYS = {"NCCL_DEBUG": "INFO"}


class Way(NamedTuple):
    """How nodes exchange gradients: keys, and variables, which GMIs of all nodes get."""

    overrides: tuple[str, ...] = ()
    variables: Mapping[str, str] = MappingProxyType({})
    needs_nccl: bool = False


WAYS = MappingProxyType(
    {
        ONE_NODE: Way(),
        TWO_NODES["nccl"]: Way((), _SAYS, needs_nccl=True),
        TWO_NODES["sockets"]: Way((), {**_SAYS, **_SOCKETS}, needs_nccl=True),
        TWO_NODES["tcp"]: Way(("reduce.strategy=mpr",)),
        TWO_NODES["jobs"]: Way(),
    }
)


class Case(NamedTuple):
    """A job on one node or on two.

    Attributes:
      verb: `train`, `sweep` or `pack`.
      each: GMIs, or jobs at once, on each GPU.
      way: a key of `WAYS`.
    """

    verb: str
    each: int
    way: str

    @property
    def job(self) -> str:
        """What is the same on one node and on two."""
        if self.verb == "train":
            return f"{counted(self.each, 'GMI')} on each GPU"
        return f"{self.verb}, {self.each} on each GPU"


def cases_of(
    gmis: Sequence[int], sweep: Sequence[int], pack: Sequence[int], why_not: str | None
) -> list[Case]:
    """The jobs with so many on each GPU, on one node and on two.

    What needs NCCL is left out if there is a reason against it, with a line about it.
    """
    jobs = (ONE_NODE, TWO_NODES["jobs"])
    found = [
        *(Case("train", gmis, way) for gmis in gmis for way in WAYS if way != jobs[1]),
        *(Case("sweep", each, way) for each in sweep for way in jobs),
        *(Case("pack", each, way) for each in pack for way in jobs),
    ]
    left_out = [case for case in found if why_not and WAYS[case.way].needs_nccl]
    for case in left_out:
        sys.stderr.write(f"{case.job}: {case.way}: left out: {why_not}\n")
    return [case for case in found if case not in left_out]


def words_of(
    case: Case, overrides: Sequence[str], gpus: Sequence[int], address: str, folder: Path
) -> list[str]:
    """The command of a case, without the interpreter.

    Args:
      case: what it runs.
      overrides: of a training.
      gpus: indices of both GPUs; empty: CPUs.
      address: of the cluster, as an override.
      folder: of the run.
    """
    is_one = case.way == ONE_NODE
    group = "plan" if case.verb == "train" else case.verb
    words = ["-m", f"gmijax.{case.verb}", f"run.dir={folder}"]
    if not is_one:
        words += [RAY, address, "cluster.nodes=2"]
    elif gpus:
        words.append(f"{group}.gpus=[{','.join(map(str, gpus))}]")
    if case.verb == "train":
        places = ["plan.gpus=2"] if is_one and not gpus else []
        own = (f"plan.gmis_per_gpu={case.each}", *WAYS[case.way].overrides)
        return [*words, *places, *own, *overrides]
    # Without a GPU they count on each machine.
    at_once = case.each * (2 if is_one and not gpus else 1)
    words.append(f"{group}.jobs_per_gpu={at_once}")
    if case.verb == "sweep":
        return [*words, f"seed=range({2 * case.each})", *overrides]
    # GMIs of one job each are no clients of another daemon: those of a GPU take turns.
    words += [f"pack.copies={2 * case.each}", "pack.steps=%  ([0-9,]+) steps"]
    words += ["pack.backend=share"] if gpus else []
    own = (f"plan.memory_fraction={0.8 / case.each:g}", "run.dir={run_dir}/train")
    return [*words, "--", sys.executable, "-m", "gmijax.train", *overrides, *own]
