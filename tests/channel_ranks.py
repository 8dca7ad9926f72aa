"""Agents and trainers of the tests of channels: processes without jax.

Every unroll has a number and says so in all its values, so that a trainer sees at once whether
what it got is whole, and its list of numbers shows what was lost or came twice.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gmijax.channels import build
from gmijax.channels.batcher import Batcher
from gmijax.channels.build import ChannelTopology, open_receiver, open_sender
from gmijax.channels.experience import Array, Rollouts
from gmijax.channels.sender import Sender
from gmijax.config.channel import ChannelConfig
from gmijax.config.schema import from_dict
from gmijax.errors import CollectiveTimeout, GmijaxError, PeerLost, PipeClosed
from gmijax.supervise.child import inherited_fd

ENV_FD = "GMIJAX_CHANNELS_FD"
Options = dict[str, Any]


def numbered(agent: int, first: int, task: Options) -> dict[str, Array]:
    """A rollout of `envs` unrolls with the numbers from `first` on; exact in float32."""
    steps, envs, (obs, act) = task["steps"], task["envs"], task["sizes"]
    number = np.arange(first, first + envs, dtype=np.float32)
    step = np.arange(steps + 1, dtype=np.float32)[:, None]
    value = number + step  # [S, N]
    state = np.broadcast_to(value[:, :, None], (steps + 1, envs, obs)).copy()
    state[..., 0] = agent
    action = np.broadcast_to(-value[:-1, :, None], (steps, envs, act)).copy()
    return {
        "state": state,
        "action": action,
        "reward": value[:-1] * 2,
        "done": number % 3 + 0 * step[:-1] == 0,
        "log_prob": value[:-1] / 2,
        "bootstrap": number[None],
    }


def numbers_of(batch: Rollouts) -> npt.NDArray[np.int64]:
    """The numbers of the unrolls in a batch; AssertionError if one is torn or mixed up."""
    got = {name: np.asarray(values) for name, values in batch.experience.items()}
    number, steps = got["bootstrap"][0], len(got["reward"])
    value = number + np.arange(steps + 1, dtype=np.float32)[:, None]
    whole = {
        "state": (got["state"][..., 1:] == value[:, :, None]).all(),
        "agent": (got["state"][..., 0] == batch.agents).all(),
        "action": (got["action"] == -value[:-1, :, None]).all(),
        "reward": (got["reward"] == value[:-1] * 2).all(),
        "done": (got["done"] == (number % 3 == 0)).all(),
        "log_prob": (got["log_prob"] == value[:-1] / 2).all(),
        "version": (batch.versions == number // 1000).all(),
    }
    assert all(whole.values()), [name for name, is_whole in whole.items() if not is_whole]
    return number.astype(np.int64)


def act(sender: Sender, task: Options) -> Options:
    """Sends the unrolls, with random pauses."""
    rank, pauses = task["rank"], np.random.default_rng([task["rank"], os.getpid()])
    for number in range(0, task["count"], task["envs"]):
        experience: Any = numbered(rank, number, task)
        if sender.on_device and not task["fake_device"]:
            experience = importlib.import_module("jax").device_put(experience)
        if not sender.send(experience, number // 1000, task["timeout_s"]):
            trainers = tuple(task["topology"]["trainers"])
            raise CollectiveTimeout(rank, trainers, "send", number, task["timeout_s"])
        if pauses.random() < task["pause_chance"]:
            time.sleep(pauses.random() * 2e-3)
    sender.close()
    return {}


def learn(receiver: Batcher, task: Options) -> Options:
    """Receives until all agents have closed; writes the numbers it got, by agent, to a file."""
    got: list[npt.NDArray[np.int64]] = []
    batch_size = task["batch"]
    while True:
        try:
            batch = receiver.receive(batch_size, task["timeout_s"])
        except PipeClosed:
            if batch_size == 1:
                break
            batch_size = 1  # What is left of a batch.
            continue
        got.append(np.stack([batch.agents, numbers_of(batch)]))
        time.sleep(task["busy_s"])
    if got:
        np.save(f"{task['result']}.npy", np.concatenate(got, axis=1))
    return {"unrolls": receiver.unrolls}


def mark(name: str, task: Options) -> None:
    """Leaves a file that `ChannelJob.wait_for` sees."""
    Path(f"{task['result']}.{name}").touch()


def run(task: Options) -> Options:
    """Opens this rank's end and uses it."""
    given = dict(task["topology"])
    given["addresses"] = {(a, t): where for a, t, where in given["addresses"]}
    given["secret"] = bytes.fromhex(given["secret"])
    for key in ("agents", "trainers", "gpu_of"):
        given[key] = tuple(given[key])
    if task["fake_device"]:
        use_fake_device(task["fake_device"])
    topology, config = ChannelTopology(**given), from_dict(ChannelConfig, task["channel"])
    fd = inherited_fd(os.environ, ENV_FD)
    if task["rank"] in topology.agents:
        sender = open_sender(config, topology, task["rank"], fd)
        mark("open", task)
        return act(sender, task)
    receiver = open_receiver(config, topology, task["rank"], fd)
    mark("open", task)
    try:
        return learn(receiver, task)
    finally:
        receiver.close()


def use_fake_device(folder: str) -> None:
    """Lets experience stay on a device that is none; `folder` has `fake_device_memory`."""
    sys.path.insert(0, folder)
    build.DEVICE_MEMORY = importlib.import_module("fake_device_memory").FakeDeviceMemory


def main(task: Options) -> None:
    """One rank: uses the channels and writes what came of it."""
    try:
        result = {"error": None, **run(task)}
    except GmijaxError as error:
        peers = [error.peer] if isinstance(error, PeerLost) else []
        peers += error.missing if isinstance(error, CollectiveTimeout) else []
        result = {"error": type(error).__name__, "message": str(error), "peers": peers}
    result["ended_s"] = time.monotonic()
    path = Path(task["result"])
    path.with_suffix(".part").write_text(json.dumps(result))
    path.with_suffix(".part").rename(path)


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
