"""In what the nodes of a cluster differ: one wording for jobs that refuse and for the doctor."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from gmijax.machine.snapshot import Machine


def differences_in(what: str, of_nodes: Mapping[str, str | None]) -> list[str]:
    """A sentence with each value and the nodes that have it; none if all have the same."""
    having: dict[str, list[str]] = {}
    for name, value in of_nodes.items():
        having.setdefault(value or "none", []).append(name)
    if len(having) < 2:
        return []
    shown = "; ".join(f"{value} on {', '.join(names)}" for value, names in having.items())
    return [f"nodes differ in {what}: {shown}"]


def differences_in_gpus(nodes: Mapping[str, Machine]) -> tuple[list[str], list[str]]:
    """Why GMIs on these nodes cannot learn together, and what else is worth knowing.

    GPUs of another compute capability compute other bits.
    """
    with_gpus = {name: machine for name, machine in nodes.items() if machine.gpus}
    if not with_gpus:
        return [], []
    capabilities = {name: machine.capabilities for name, machine in with_gpus.items()}
    notes = differences_in("GPUs", {name: gpu_names(machine) for name, machine in nodes.items()})
    notes += differences_in("NVIDIA driver", {n: m.driver_version for n, m in nodes.items()})
    return differences_in("the compute capability of GPUs", capabilities), notes


def gpu_names(machine: Machine) -> str:
    """What GPUs a machine has, and how many of each."""
    counts = Counter(gpu.name for gpu in machine.gpus)
    return ", ".join(f"{count} x {name}" for name, count in counts.items()) or "none"
