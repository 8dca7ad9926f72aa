"""Makes the ends of the channels of a job from its configuration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from gmijax.collectives.channel.backlog import Block, DropOldest
from gmijax.collectives.channel.compressor import Compressor
from gmijax.collectives.channel.dispenser import Dispenser
from gmijax.collectives.channel.ends import Receiver, Sender, TransferSource
from gmijax.collectives.channel.interface import ExperienceSender, Inlet, Outlet
from gmijax.collectives.channel.memory import MemoryInlet, MemoryOutlet
from gmijax.collectives.channel.migrator import Migrator
from gmijax.collectives.channel.transfer_size import TransferSize
from gmijax.collectives.channel.unichannel import UniSender, UniSource
from gmijax.collectives.device_memory import NewMemory, cuda_memory
from gmijax.collectives.pipe_block import PipeBlock, create_pipes
from gmijax.config.channel import ChannelConfig
from gmijax.errors import ConfigError

NOTES_BYTES = 2**20
"""Of a pipe of `transport=device`, which holds only where experience lies."""

OVERHEAD_BYTES = 16 * 1024
"""More than header, spec and alignment of a message take."""


@dataclass(frozen=True, kw_only=True)
class Places:
    """Who sends, who receives, and where they are.

    Attributes:
      agents: ranks that send.
      trainers: ranks that receive.
      gpu_of: index of every rank's GPU, K entries.
      addresses: with `transport=zmq`, where the trainer of a pair (agent, trainer) listens, as
        `host:port`.
    """

    agents: tuple[int, ...]
    trainers: tuple[int, ...]
    gpu_of: tuple[int, ...]
    addresses: Mapping[tuple[int, int], str] | None = None

    def __post_init__(self) -> None:
        if not self.agents or not self.trainers:
            raise ConfigError(
                f"agents {list(self.agents)}, trainers {list(self.trainers)}: channels need at "
                "least one of each"
            )


def require_channels(config: ChannelConfig, places: Places, unroll_bytes: int) -> None:
    """Checks, before a process is started, that the channels can be had.

    Args:
      config: what the user asked for.
      places: who takes part.
      unroll_bytes: of one environment's unroll, all channels.

    Raises:
      ConfigError: too little memory, or room for less than one unroll.
    """
    most = max_piece_bytes(config.capacity_bytes)
    if unroll_bytes > most:
        raise ConfigError(
            f"channel.capacity_mib={config.capacity_mib}: has room for {most} bytes at once, one "
            f"environment's unroll takes {unroll_bytes}"
        )
    pairs = len(places.agents) * len(places.trainers)
    available = available_bytes()
    if config.transport == "memory" and pairs * config.capacity_bytes > available:
        raise ConfigError(
            f"channel.capacity_mib={config.capacity_mib}: {pairs} pairs of agent and trainer "
            f"take {pairs * config.capacity_mib} MiB, available are {available // 2**20} MiB"
        )


def available_bytes() -> int:
    """Memory that this process and its children can still have."""
    lines = dict(
        line.split(":", 1)
        for line in Path("/proc/meminfo").read_text().splitlines()
        if ":" in line
    )
    free = int(lines["MemAvailable"].split()[0]) * 1024
    group = Path("/sys/fs/cgroup")
    try:
        limit = int((group / "memory.max").read_text())
        used = int((group / "memory.current").read_text())
        counts = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
    except (OSError, ValueError):  # No such group, or no limit ("max").
        return free
    # Cached files count as used, but make way.
    cached = sum(int(counts.get(key, 0)) for key in ("active_file", "inactive_file"))
    return min(free, max(0, limit - used + cached))


def max_piece_bytes(capacity_bytes: int) -> int:
    """Largest piece with channels of such capacity.

    A quarter less what a message takes besides, so that one can be written while another is read.
    """
    return capacity_bytes // 4 - OVERHEAD_BYTES


def create_channels(config: ChannelConfig, places: Places) -> int:
    """Makes the shared block of all channels (`transport=memory`); returns its descriptor."""
    return create_pipes(len(places.gpu_of), _pipe_bytes(config))


def open_sender(
    config: ChannelConfig, places: Places, rank: int, fd: int | None
) -> ExperienceSender:
    """The end of agent `rank`.

    Args:
      config: what the user asked for.
      places: who takes part.
      rank: this agent.
      fd: descriptor from `create_channels`, None with `transport=zmq`.

    Raises:
      ConfigError: something is missing.
      CollectiveError: the shared memory cannot be had, or the rank is taken.
    """
    if config.transport == "device":
        return _resident_sender(config, places, rank, fd)
    if config.transport == "zmq":
        from gmijax.collectives.channel.remote import RemoteOutlet

        outlets: list[Outlet] = [
            RemoteOutlet(_address(places, rank, peer), rank, peer, config.capacity_bytes)
            for peer in places.trainers
        ]
        return _sender(config, places, rank, outlets, None)
    block = _attach(config, places, rank, fd)
    return _sender(
        config, places, rank, [MemoryOutlet(block, peer) for peer in places.trainers], block
    )


def open_receiver(config: ChannelConfig, places: Places, rank: int, fd: int | None) -> Receiver:
    """The end of trainer `rank`; arguments and errors as `open_sender`."""
    make = UniSource if config.design == "uni" else TransferSource
    if config.transport == "zmq":
        from gmijax.collectives.channel.remote import RemoteInlet

        inlets: list[Inlet] = [
            RemoteInlet(_address(places, peer, rank), rank, peer) for peer in places.agents
        ]
        return Receiver(rank, inlets, make=make, leave=lambda: None)
    block = _attach(config, places, rank, fd)
    inlets = [MemoryInlet(block, peer) for peer in places.agents]
    if config.transport == "device":
        # jax and CUDA, which channels through the host do without.
        from gmijax.collectives.channel.resident_source import DeviceStack, ResidentSource

        return Receiver(
            rank,
            inlets,
            make=lambda inlet: ResidentSource(inlet, DEVICE_MEMORY),
            new_stack=DeviceStack,
            leave=block.close,
        )
    return Receiver(rank, inlets, make=make, leave=block.close)


def _resident_sender(
    config: ChannelConfig, places: Places, rank: int, fd: int | None
) -> ExperienceSender:
    """The end of an agent that leaves its experience on the GPU, for the trainers there."""
    from gmijax.collectives.channel.resident import ResidentSender

    block = _attach(config, places, rank, fd)
    near = [peer for peer in places.trainers if places.gpu_of[peer] == places.gpu_of[rank]]
    return ResidentSender(
        rank,
        [MemoryOutlet(block, peer) for peer in near],
        dict(enumerate(places.gpu_of)),
        config.capacity_bytes,
        DEVICE_MEMORY,
        block.close,
    )


def _sender(
    config: ChannelConfig,
    places: Places,
    rank: int,
    outlets: list[Outlet],
    block: PipeBlock | None,
) -> Sender:
    most = max_piece_bytes(config.capacity_bytes)
    gpu_of = {trainer: places.gpu_of[trainer] for trainer in places.trainers}
    migrator = Migrator(outlets, places.gpu_of[rank], gpu_of)
    if config.design == "uni":
        taker, size = UniSender(migrator), None
    else:
        fixed = None if config.transfer_kib is None else config.transfer_kib * 1024
        size = TransferSize(fixed, most)
        taker = Compressor(migrator, size, most)
    if config.when_full == "block":
        pressure = Block(taker, migrator.why_lost)
    else:
        pressure = DropOldest(taker, migrator.why_lost, config.max_waiting)
    dispenser = Dispenser(most, config.float16)
    leave = (lambda: None) if block is None else block.close
    return Sender(dispenser, taker, migrator, pressure, size, leave)


def _attach(config: ChannelConfig, places: Places, rank: int, fd: int | None) -> PipeBlock:
    if fd is None:
        raise ConfigError("channel.transport=memory: needs the channels of the job's controller")
    return PipeBlock.attach(fd, rank, len(places.gpu_of), _pipe_bytes(config))


def _pipe_bytes(config: ChannelConfig) -> int:
    return NOTES_BYTES if config.transport == "device" else config.capacity_bytes


DEVICE_MEMORY: NewMemory = cuda_memory
"""Makes the `DeviceMemory` by which agents and trainers of `transport=device` share their GPU."""


def _address(places: Places, agent: int, trainer: int) -> str:
    if places.addresses is None or (agent, trainer) not in places.addresses:
        raise ConfigError(
            f"channel.transport=zmq: needs an address for agent {agent} and trainer {trainer}"
        )
    return places.addresses[agent, trainer]
