"""Makes the ends of the channels of a job from its configuration."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

from gmijax.channels.batcher import Batcher, ChannelReader, Stack
from gmijax.channels.compressor import Compressor, TransferSize, read_transfer
from gmijax.channels.migrator import ChannelWriter, Migrator
from gmijax.channels.pipe import PipeReader, PipeWriter
from gmijax.channels.pipe_block import PipeBlock, create_pipes
from gmijax.channels.sender import Dispenser, MessageEncoder, Sender
from gmijax.channels.tcp_channel import RemoteReader, RemoteWriter
from gmijax.channels.unichannel import UniDecoder, UniPacker
from gmijax.collectives.device.device_memory import DeviceMemory, NewMemory
from gmijax.config.channel import ChannelConfig
from gmijax.errors import ConfigError
from gmijax.machine.host_limits import CgroupLimits

NOTES_BYTES = 2**20
"""Of a pipe of `transport=device`, which holds only where experience lies."""

OVERHEAD_BYTES = 16 * 1024
"""More than header, spec and alignment of a message take."""


def _cuda_memory() -> DeviceMemory:
    # jax and CUDA, which channels through the host do without.
    from gmijax.collectives.device.cuda_memory import CudaMemory

    return CudaMemory()


DEVICE_MEMORY: NewMemory = _cuda_memory
"""Makes the memory by which agents and trainers of `transport=device` share their GPU."""


@dataclass(frozen=True, kw_only=True)
class ChannelTopology:
    """Ranks that send and ranks that receive, and the GPU of all K.

    Attributes:
      addresses: where the trainer of a pair (agent, trainer) listens, as `host:port`, of the pairs
        on different nodes, which use TCP.
      secret: by which both ends of such a pair know each other.
    """

    agents: tuple[int, ...]
    trainers: tuple[int, ...]
    gpu_of: tuple[int, ...]
    addresses: Mapping[tuple[int, int], str] = field(default_factory=dict)
    secret: bytes = field(default=b"", repr=False)

    def __post_init__(self) -> None:
        if not self.agents or not self.trainers:
            raise ConfigError(
                f"agents {list(self.agents)}, trainers {list(self.trainers)}: channels need at "
                "least one of each"
            )


def require_memory(config: ChannelConfig, topology: ChannelTopology) -> None:
    """Raises ConfigError unless there is memory for the channels; before a process is started."""
    pairs = len(topology.agents) * len(topology.trainers)
    available = _available_mib()
    if config.transport == "memory" and pairs * config.capacity_mib > available:
        raise ConfigError(
            f"channel.capacity_mib={config.capacity_mib}: {pairs} pairs of agent and trainer "
            f"take {pairs * config.capacity_mib} MiB, available are {available} MiB"
        )


def max_piece_bytes(capacity_bytes: int) -> int:
    """Largest piece with channels of such capacity.

    A quarter less what a message takes besides, so that one can be written while another is read.
    """
    return capacity_bytes // 4 - OVERHEAD_BYTES


def create_channels(config: ChannelConfig, topology: ChannelTopology) -> int:
    """Makes the shared block of all channels (`transport=memory`); returns its descriptor."""
    pipe_bytes = NOTES_BYTES if config.transport == "device" else config.capacity_bytes
    return create_pipes(len(topology.gpu_of), pipe_bytes)


def open_sender(
    config: ChannelConfig, topology: ChannelTopology, rank: int, fd: int | None
) -> Sender:
    """The end of agent `rank`; `fd` is from `create_channels`, None if all its pairs use TCP.

    Raises:
      ConfigError: something is missing.
      CollectiveError: the shared memory cannot be had, or the rank is taken.
    """
    held, trainers = ExitStack(), topology.trainers
    near = [peer for peer in trainers if topology.gpu_of[peer] == topology.gpu_of[rank]]
    if config.transport == "device":
        return _device_sender(config, _open_block(rank, fd, held), near, held)
    writers: list[ChannelWriter] = []
    far = {trainer: at for (agent, trainer), at in topology.addresses.items() if agent == rank}
    if len(far) < len(trainers):
        block = _open_block(rank, fd, held)
        writers += [PipeWriter(block, peer) for peer in trainers if peer not in far]
    if far:
        settings = config.capacity_bytes, topology.secret
        writers += [RemoteWriter(at, rank, peer, *settings) for peer, at in far.items()]
    migrator = Migrator(writers, near)
    held.callback(migrator.close)
    most = max_piece_bytes(config.capacity_bytes)
    packer: MessageEncoder = UniPacker(migrator)
    if config.design == "multi":
        packer = Compressor(migrator, TransferSize(most), most)
    return Sender(Dispenser(rank, most), packer, migrator, on_device=False, held=held)


def open_receiver(
    config: ChannelConfig, topology: ChannelTopology, rank: int, fd: int | None
) -> Batcher:
    """The end of trainer `rank`; arguments and errors as `open_sender`."""
    held = ExitStack()
    readers: list[ChannelReader] = []
    far = {agent: at for (agent, trainer), at in topology.addresses.items() if trainer == rank}
    if len(far) < len(topology.agents):
        block = _open_block(rank, fd, held)
        readers += [PipeReader(block, peer) for peer in topology.agents if peer not in far]
    if far:
        settings = config.capacity_bytes, topology.secret
        readers += [RemoteReader(at, rank, peer, *settings) for peer, at in far.items()]
    for reader in readers:
        held.callback(reader.close)
    if config.transport == "device":
        from gmijax.channels.device_channel import DeviceStack, ResidentDecoder

        decoders = [ResidentDecoder(DEVICE_MEMORY) for _ in readers]
        for decoder in decoders:
            held.callback(decoder.close)  # Before its reader: then its agent may end.
        return Batcher(rank, list(zip(readers, decoders, strict=True)), DeviceStack, held)
    is_uni = config.design == "uni"
    sources = [(reader, UniDecoder() if is_uni else read_transfer) for reader in readers]
    return Batcher(rank, sources, Stack, held)


def _device_sender(
    config: ChannelConfig, block: PipeBlock, near: list[int], held: ExitStack
) -> Sender:
    """The end of an agent that leaves its experience on the GPU, for the trainers there."""
    from gmijax.channels.device_arrays import SentArrays
    from gmijax.channels.device_channel import DeviceWriter, ResidentPacker

    sent = SentArrays(near, DEVICE_MEMORY, config.capacity_bytes)
    migrator = Migrator([DeviceWriter(block, peer, sent) for peer in near], near)
    packer = ResidentPacker(migrator, sent)
    held.callback(packer.close)
    held.callback(migrator.close)
    dispenser = Dispenser(block.rank, max_piece_bytes=None)
    return Sender(dispenser, packer, migrator, on_device=True, held=held)


def _open_block(rank: int, fd: int | None, held: ExitStack) -> PipeBlock:
    if fd is None:
        raise ConfigError("channel.transport=memory: needs the channels of the job's controller")
    block = PipeBlock(fd, rank)
    held.callback(block.close)
    return block


def _available_mib() -> int:
    """Memory that this process and its children can still have."""
    lines = Path("/proc/meminfo").read_text().splitlines()
    free = next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable")) // 1024
    group = CgroupLimits().available_memory_mib()
    return free if group is None else min(free, int(group))
