"""How experience gets from agents to trainers in asynchronous training."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from gmijax.config.schema import KeyGroup, doc
from gmijax.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class ChannelConfig(KeyGroup):
    """How experience gets from agents to trainers (docs/channels.md)."""

    prefix = "channel."

    design: Literal["multi", "uni"] = doc(
        "multi: transfers by channel; uni: every step's tensors alone, the paper's baseline",
        default="multi",
    )
    transport: Literal["memory", "device"] = doc(
        "memory: shared memory of this host, and TCP between nodes; device: memory of the GPU, "
        "where every agent has a trainer on its own (CUDA IPC), on one node",
        default="memory",
    )
    capacity_mib: int = doc(
        "buffer between every agent and every trainer, MiB; a transfer may take a quarter of it",
        default=64,
        low=1,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.transport == "device" and (why := self.why_not_device()):
            raise ConfigError(f"channel.transport=device: {why}")

    def why_not_device(self) -> str | None:
        """None if these settings go with `transport=device`, else the reason."""
        if self.design != "multi":
            return f"not with channel.design={self.design}; allowed: multi"
        return None

    @property
    def capacity_bytes(self) -> int:
        """Bytes between one agent and one trainer."""
        return self.capacity_mib * 2**20
