"""How an administrator divides a GPU into MIG instances: placements and commands, as text.

gmijax never runs them: they need root, and the GPU must be idle. A GPU has eight slices of memory
and seven of SMs; an instance of 3g takes half of the memory and so must begin at slice 0 or 4.
A30 has four of both. https://docs.nvidia.com/datacenter/tesla/mig-user-guide/.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

from gmijax.errors import ConfigError
from gmijax.machine.nvidia import Gpu


class _Size(NamedTuple):
    """Memory slices that an instance takes, and those where it may begin."""

    memory: int
    starts: tuple[int, ...]


_EIGHTHS: Final[Mapping[int, _Size]] = {
    1: _Size(1, (0, 1, 2, 3, 4, 5, 6)),
    2: _Size(2, (0, 2, 4)),
    3: _Size(4, (0, 4)),
    4: _Size(4, (0,)),
    7: _Size(8, (0,)),
}
_QUARTERS: Final[Mapping[int, _Size]] = {
    1: _Size(1, (0, 1, 2, 3)),
    2: _Size(2, (0, 2)),
    4: _Size(4, (0,)),
}
_FOUR_SLICES: Final = re.compile(r"A30\b|RTX PRO 6000")
_MIB_PER_GIB: Final = 1024


def split_commands(gpu: Gpu, wanted: str) -> tuple[str, ...]:
    """The commands that divide `gpu` as `wanted`, e.g. `3g,2g,1g,1g`; largest instances first.

    Raises:
      ConfigError: no such sizes, or they do not fit side by side, or the GPU has no MIG.
    """
    if not gpu.mig_supported:
        raise ConfigError(f"mig={wanted}: GPU {gpu.index} ({gpu.name}) has no MIG")
    sizes = _QUARTERS if _FOUR_SLICES.search(gpu.name) else _EIGHTHS
    parts = _parse(wanted, gpu, sizes)
    starts = place_instances(parts, sizes)
    if starts is None:
        raise ConfigError(
            f"mig={wanted}: these instances do not fit side by side on GPU {gpu.index} "
            f"({gpu.name}); whole it is {max(sizes)}g"
        )
    profiles = ",".join(
        f"{_profile(part, gpu, sizes)}:{start}" for part, start in zip(parts, starts, strict=True)
    )
    commands: list[str] = []
    if not gpu.mig_enabled:
        commands.append(f"sudo nvidia-smi -i {gpu.index} -mig 1")
    elif gpu.instances:
        commands += [f"sudo nvidia-smi mig -i {gpu.index} -{what}" for what in ("dci", "dgi")]
    commands.append(f"sudo nvidia-smi mig -i {gpu.index} -cgi {profiles} -C")
    commands.append("nvidia-smi -L")
    return tuple(commands)


def place_instances(
    parts: Sequence[int],
    sizes: Mapping[int, _Size] = _EIGHTHS,
    taken: frozenset[int] = frozenset(),
) -> tuple[int, ...] | None:
    """Memory slices where instances of `parts` SM slices begin, None where they do not fit."""
    if not parts:
        return ()
    if sum(parts) > max(sizes):
        return None
    memory, starts = sizes[parts[0]]
    for start in reversed(starts):
        cells = frozenset(range(start, start + memory))
        rest = None if cells & taken else place_instances(parts[1:], sizes, taken | cells)
        if rest is not None:
            return (start, *rest)
    return None


def _parse(wanted: str, gpu: Gpu, sizes: Mapping[int, _Size]) -> tuple[int, ...]:
    parts: list[int] = []
    for text in wanted.split(","):
        match = re.fullmatch(r"(\d)g(\.\d+gb)?", text.strip())
        if match is None or int(match[1]) not in sizes:
            allowed = ", ".join(f"{size}g" for size in sizes)
            raise ConfigError(f"mig={wanted}: expected a list of {allowed}, e.g. mig=3g,2g,1g,1g")
        part = int(match[1])
        # Other profiles have as many SMs, e.g. 1g.35gb; where they fit is not known here.
        if match[2] and match[0] != (profile := _profile(part, gpu, sizes)):
            raise ConfigError(
                f"mig={wanted}: {match[0]} is not supported; {part}g of GPU {gpu.index} "
                f"({gpu.name}) is {profile}"
            )
        parts.append(part)
    return tuple(sorted(parts, reverse=True))


def _profile(part: int, gpu: Gpu, sizes: Mapping[int, _Size]) -> str:
    """NVIDIA's name: SM slices and memory, e.g. `3g.71gb` on an H200 with 141 GB."""
    whole_gb = -(-gpu.memory_mib // _MIB_PER_GIB)
    share = sizes[part].memory / max(size.memory for size in sizes.values())
    return f"{part}g.{int(whole_gb * share + 0.5)}gb"
