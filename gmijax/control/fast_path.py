"""What is missing, or too old, for GMIs to train as fast as they can here, and what brings it."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Final, NamedTuple

from gmijax.control.sight import Sight, device_of
from gmijax.partition.reduction import LEAST_BINDINGS
from gmijax.sim.impl import ON_GPU

_CUDA_13_DRIVER: Final = 580
"""CUDA 13 needs a driver of this branch."""


class Range(NamedTuple):
    """Versions from `least` on, and before `below` if that is given."""

    least: tuple[int, ...]
    below: tuple[int, ...] | None = None

    def __str__(self) -> str:
        upper = f",<{_text(self.below)}" if self.below else ""
        return f">={_text(self.least)}{upper}"

    def has(self, version: str) -> bool:
        """Whether `version` is in it."""
        numbers = _numbers(version)
        return numbers >= self.least and (self.below is None or numbers < self.below)


BINDINGS: Final[Mapping[int, Range]] = MappingProxyType(
    {12: Range(LEAST_BINDINGS, (13,)), 13: Range((13,))}
)
"""Which cuda-bindings the extras `cuda12` and `cuda13` bring: earlier ones hold the GIL."""


def cuda_major(sight: Sight) -> int:
    """The CUDA that packages are to be for: what jax has, if the driver takes it."""
    if sight.machine.driver_major < _CUDA_13_DRIVER:
        return 12
    has_12, has_13 = (sight.versions.get(f"jax-cuda{cuda}-plugin") for cuda in (12, 13))
    return 12 if has_12 and not has_13 else 13


def missing_pieces(sight: Sight) -> Iterator[str]:
    """A sentence for each piece, with the command that brings it; none without a GPU."""
    usable = [gpu for gpu in sight.machine.gpus if device_of(gpu)]
    if not usable:
        return
    if any(not gpu.mig_enabled for gpu in usable):
        yield from _bindings(sight)
        if sight.machine.mps_control is None:
            yield (
                "GMIs of a GPU take turns, because nvidia-cuda-mps-control is not installed: it "
                "comes with the NVIDIA driver, into containers with its capability compute"
            )
    yield from _warp(sight)


def _bindings(sight: Sight) -> Iterator[str]:
    cuda = cuda_major(sight)
    wanted, found = BINDINGS[cuda], sight.versions.get("cuda-bindings")
    if found is not None and wanted.has(found):
        return
    state = f"{found} is installed" if found else "it is not installed"
    yield (
        "gradients of GMIs that share a GPU go through host memory: reduce.strategy=one_shot "
        f"needs cuda-bindings{wanted}, and {state} (pip install 'gmijax[cuda{cuda}]')"
    )


def _warp(sight: Sight) -> Iterator[str]:
    found, wanted = sight.versions.get("warp-lang"), sight.wanted_warp
    command = "(pip install 'gmijax[warp]')"
    if found is None:
        faster = ", ".join(sorted(task for task, how in ON_GPU.items() if how.auto == "warp"))
        yield f"MJX-Warp is the faster physics for {faster}: needs warp-lang {command}"
    elif wanted is not None and found != wanted:
        yield f"MJX-Warp was made for warp-lang {wanted}, and {found} is installed {command}"


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(number) for number in re.findall(r"\d+", version)[:3])


def _text(numbers: tuple[int, ...]) -> str:
    return ".".join(map(str, numbers))
