"""Measures the experience channels: `python -m benchmarks.channels`, without training anything.

First a count: a million unrolls through shared memory, three agents and two trainers with random
pauses. Then speed: channels against the uni-channel for the sizes of the tasks. Adds a call to
`benchmarks/results/channels-<cores>-cores.json`.

Every process runs without jax, so this needs no GPU.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any, Literal

import numpy as np

from benchmarks.channel_job import ChannelJob
from benchmarks.records import RESULTS, ResultsFile
from gmijax.collectives.channel.build import ChannelTopology
from gmijax.config.channel import ChannelConfig

SIZES = {"ant": (60, 8), "anymal": (48, 12), "franka_cabinet": (23, 9), "humanoid": (108, 21)}
"""Observations and actions of the tasks as in the paper."""

ENVS = (64, 512, 4096)
STEPS = 16
AGENTS, TRAINERS = 3, 2
FAULTS = ("missing", "doubled", "out_of_order")


def main() -> int:
    """Measures what the command line asks for; returns 0, or 1 if a count is wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--unrolls", type=int, default=1_000_000, help="to count, of all agents")
    parser.add_argument("--envs", nargs="+", type=int, default=ENVS, help="of every agent")
    parser.add_argument("--agents", type=int, default=1, help="in the measurement of speed")
    parser.add_argument("--trainers", type=int, default=1, help="in the measurement of speed")
    parser.add_argument("--transports", nargs="+", default=["memory"], choices=["memory", "zmq"])
    parser.add_argument("--mib", type=int, default=2000, help="to send in one measurement")
    parser.add_argument("--passes", type=int, default=3, help="to take the median of")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the JSON file")
    arguments = parser.parse_args()
    path = arguments.out / f"channels-{os.cpu_count()}-cores.json"
    book = ResultsFile(path, "channels", {**vars(arguments), "steps": STEPS}, device="cpu")
    exact = count(arguments.unrolls)
    sys.stdout.write(f"count: {json.dumps(exact)}\n")
    rows = []
    for transport in arguments.transports:
        for task, envs in ((task, envs) for task in SIZES for envs in arguments.envs):
            rows.append(compare(task, envs, transport, arguments))
            sys.stdout.write(line(rows[-1]) + "\n")
            with book.changing() as results:
                results.update(count=exact, rows=rows)
    sys.stdout.write(f"written: {path}\n")
    return 1 if exact["failed"] or any(exact[key] for key in FAULTS) else 0


def count(unrolls: int) -> dict[str, Any]:
    """Sends numbered unrolls, and counts what arrived."""
    envs = 100
    each = -(-unrolls // AGENTS // envs) * envs
    topology = topology_of(AGENTS, TRAINERS)
    task = {"count": each, "envs": envs, "batch": 77, "steps": 2, "pause_chance": 0.5}
    with tempfile.TemporaryDirectory() as folder:
        job = ChannelJob(Path(folder), ChannelConfig(capacity_mib=8), topology, **task)
        with job.start():
            failed = [job.result(rank, 600.0)["error"] for rank in job.ranks]
            found = {
                "unrolls": each * AGENTS,
                **dict.fromkeys(FAULTS, 0),
                "failed": [error for error in failed if error],
            }
            for agent in topology.agents:
                parts = [job.numbers(trainer, agent) for trainer in topology.trainers]
                times = np.bincount(np.concatenate(parts), minlength=each)
                found["missing"] += int((times == 0).sum())
                found["doubled"] += int((times > 1).sum())
                found["out_of_order"] += sum(int((np.diff(part) <= 0).sum()) for part in parts)
    return found


def compare(task: str, envs: int, transport: Any, arguments: Any) -> dict[str, Any]:
    """Both designs in turn, several times; medians of experiences and bytes a second."""
    found: dict[str, list[dict[str, float]]] = {"multi": [], "uni": []}
    for _ in range(arguments.passes):
        for design in ("multi", "uni"):
            found[design].append(measure(task, envs, transport, design, arguments))
    row: dict[str, Any] = {"task": task, "envs": envs, "transport": transport}
    for design, passes in found.items():
        for key in passes[0]:
            row[f"{design}_{key}"] = float(np.median([one[key] for one in passes]))
    row["speedup"] = row["multi_experiences_per_s"] / row["uni_experiences_per_s"]
    return row


def measure(
    task: str, envs: int, transport: Any, design: Literal["multi", "uni"], arguments: Any
) -> dict[str, float]:
    """One job at full speed: the trainers read, and do nothing with it."""
    obs, act = SIZES[task]
    unroll_bytes = 4 * ((STEPS + 1) * obs + STEPS * (act + 2) + 1) + STEPS
    sends = max(20, arguments.mib * 2**20 // (envs * unroll_bytes * arguments.agents))
    if design == "uni":  # A thousand are enough, and take long.
        sends = min(sends, 1000)
    config = ChannelConfig(design=design, transport=transport)
    topology = topology_of(arguments.agents, arguments.trainers)
    job_task: dict[str, Any] = {"count": sends * envs, "envs": envs, "batch": envs, "steps": STEPS}
    job_task |= {"sizes": (obs, act), "fast": True, "timeout_s": 60.0}
    with (
        tempfile.TemporaryDirectory() as folder,
        ChannelJob(Path(folder), config, topology, **job_task) as job,
    ):
        job.start(*topology.trainers).wait_for("open")
        job.start(*topology.agents)
        results = [job.result(rank, 300.0) for rank in topology.trainers]
    if any(result["error"] for result in results):
        raise RuntimeError(str(results))
    wall_s = max(result["wall_s"] for result in results)
    unrolls = sum(result["unrolls"] for result in results)
    transfers = sum(result["transfers"] for result in results)
    num_bytes = sum(result["num_bytes"] for result in results)
    return {
        "experiences_per_s": unrolls * STEPS / wall_s,
        "bytes_per_s": num_bytes / wall_s,
        "bytes_per_transfer": num_bytes / transfers,
    }


def topology_of(agents: int, trainers: int) -> ChannelTopology:
    """Agents before trainers, each on a GPU of its own."""
    ranks = range(agents + trainers)
    return ChannelTopology(
        agents=tuple(ranks[:agents]), trainers=tuple(ranks[agents:]), gpu_of=tuple(ranks)
    )


def line(row: dict[str, Any]) -> str:
    """One row for people."""
    return (
        f"{row['task']:15} {row['envs']:5} envs, {row['transport']:6}:"
        f" multi {row['multi_experiences_per_s'] / 1e6:8.2f} M experiences/s"
        f" {row['multi_bytes_per_s'] / 1e9:6.2f} GB/s"
        f" in {row['multi_bytes_per_transfer'] / 1024:6.0f} KiB,"
        f" uni {row['uni_experiences_per_s'] / 1e6:8.2f} M"
        f" {row['uni_bytes_per_s'] / 1e9:6.2f} GB/s, {row['speedup']:.2f}x"
    )


if __name__ == "__main__":
    sys.exit(main())
