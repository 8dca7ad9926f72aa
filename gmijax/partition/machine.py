"""A snapshot of the machine, so that planning is a pure function of it."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from gmijax.partition.mps_control import (
    DEFAULT_PIPE_DIRECTORY,
    PIPE_VARIABLE,
    MpsControl,
    find_mps_control,
)
from gmijax.partition.nvidia import Gpu, driver_version, list_gpus


@dataclass(frozen=True)
class Machine:
    """What a job may use here.

    Attributes:
      gpus: GPUs that the job may use, in order of preference.
      cpu_cores: ids of the CPU cores that this process may run on.
      mps_control: program of the MPS daemon, None where it is not installed.
      driver_version: of the NVIDIA driver, None without one.
      operator_daemon: pipe directory of a running MPS daemon that somebody else started.
    """

    gpus: tuple[Gpu, ...]
    cpu_cores: tuple[int, ...]
    mps_control: Path | None = None
    driver_version: str | None = None
    operator_daemon: Path | None = None

    @property
    def driver_major(self) -> int:
        """The driver's branch, e.g. 580; 0 where it is not known."""
        major = (self.driver_version or "").partition(".")[0]
        return int(major) if major.isdigit() else 0


def detect_machine() -> Machine:
    """Looks at this machine; takes well under a second and makes no GPU context.

    An inherited `CUDA_VISIBLE_DEVICES` restricts the GPUs, as a batch system that sets it
    expects; GPUs keep their indices of nvidia-smi.
    """
    gpus = visible_gpus(list_gpus(), os.environ.get("CUDA_VISIBLE_DEVICES"))
    mps_control = find_mps_control() if gpus else None
    return Machine(
        gpus=gpus,
        cpu_cores=_cpu_cores(),
        mps_control=mps_control,
        driver_version=driver_version(),
        operator_daemon=_operator_daemon(mps_control) if mps_control else None,
    )


def visible_gpus(gpus: tuple[Gpu, ...], selection: str | None) -> tuple[Gpu, ...]:
    """The GPUs that a value of `CUDA_VISIBLE_DEVICES` leaves, in its order.

    Numbers are taken for indices of nvidia-smi (as with `CUDA_DEVICE_ORDER=PCI_BUS_ID`), other
    entries for (beginnings of) UUIDs, of GPUs or of MIG instances; a GPU of which instances are
    named has only those. As in CUDA the first entry that fits nothing ends the list; None means
    no restriction, an empty value hides all GPUs.
    """
    if selection is None:
        return gpus
    chosen: dict[int, Gpu] = {}
    for entry in selection.replace(" ", "").split(","):
        fits = [part for gpu in gpus if (part := _named_part(gpu, entry))]
        if len(fits) != 1 or not _add(chosen, fits[0]):
            break
    return tuple(chosen.values())


def _named_part(gpu: Gpu, entry: str) -> Gpu | None:
    """The GPU, or it with one instance, if `entry` names that."""
    if entry.isdecimal():
        return gpu if gpu.index == int(entry) else None
    if entry and gpu.uuid.startswith(entry):
        return gpu
    named = tuple(one for one in gpu.instances if entry and one.uuid.startswith(entry))
    return gpu._replace(instances=named) if len(named) == 1 else None


def _add(chosen: dict[int, Gpu], part: Gpu) -> bool:
    """Adds a GPU, or one more instance of it; False if that is there already."""
    before = chosen.get(part.index)
    if before is not None and set(part.instances) <= set(before.instances):
        return False
    more = before.instances if before is not None else ()
    chosen[part.index] = part._replace(instances=(*more, *part.instances))
    return True


def _cpu_cores() -> tuple[int, ...]:
    if hasattr(os, "sched_getaffinity"):
        return tuple(sorted(os.sched_getaffinity(0)))
    return tuple(range(os.cpu_count() or 1))


def _operator_daemon(program: Path) -> Path | None:
    named = os.environ.get(PIPE_VARIABLE)
    directory = Path(named) if named else DEFAULT_PIPE_DIRECTORY
    # Asking where there is no directory would cost a process start on every run.
    if directory.is_dir() and MpsControl(program, directory).is_answering():
        return directory
    return None
