"""A snapshot of the machine, so that planning is a pure function of it."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from gmijax.machine import nvidia
from gmijax.machine.host_limits import (
    UNKNOWN_HOST,
    CgroupLimits,
    HostLimits,
    detect_host,
    usable_cores,
)
from gmijax.machine.jax_settings import breaking
from gmijax.machine.mps_control import (
    DEFAULT_PIPE_DIRECTORY,
    PIPE_VARIABLE,
    MpsControl,
    find_mps_control,
)
from gmijax.machine.nvidia import Gpu, driver_version, gpu_problem, list_gpus
from gmijax.runs.cache import why_temporary

_HIDES_ALL = ("", "-1", "NoDevFiles")
"""Values of `CUDA_VISIBLE_DEVICES` that hide all GPUs on purpose."""

DAEMONS_VARIABLE = "GMIJAX_MPS_DAEMONS"
"""The MPS daemons that a sweep or pack runs for its jobs: JSON, see `Machine.daemons`."""

_OTHERS = {"kfd": "a GPU for ROCm", "accel[0-9]*": "a TPU"}


@dataclass(frozen=True)
class Machine:
    """Resources that a job may use here.

    Attributes:
      gpus: GPUs that the job may use, in order of preference.
      cpu_cores: ids of the CPU cores that a job may use: those that this process may run on, no
        more than its control group gets time for.
      mps_control: program of the MPS daemon, None where it is not installed.
      driver_version: of the NVIDIA driver, None without one.
      operator_daemon: pipe directory of a running MPS daemon that gmijax did not start.
      daemons: the same for a job of a sweep or pack, by UUID of the GPU or MIG instance.
      host: what is left of memory, threads and open files.
      gpu_problem: why there are no GPUs although NVIDIA's driver is there; None where it works,
        there is none, or the user hides all GPUs.
      selection_problem: what in `CUDA_VISIBLE_DEVICES` names no GPU of this machine; None where
        all of it does.
      warnings: what is here and is not used or cannot be, one sentence each.
    """

    gpus: tuple[Gpu, ...]
    cpu_cores: tuple[int, ...]
    mps_control: Path | None = None
    driver_version: str | None = None
    operator_daemon: Path | None = None
    daemons: Mapping[str, Path] = field(default_factory=dict)
    host: HostLimits = UNKNOWN_HOST
    gpu_problem: str | None = None
    selection_problem: str | None = None
    warnings: tuple[str, ...] = ()

    def daemon_of(self, device: str) -> Path | None:
        """Pipe directory of the daemon that runs for a device, None where a job starts its own."""
        return self.daemons.get(device, self.operator_daemon)

    @property
    def index_of_device(self) -> dict[str, int]:
        """Index of the GPU by UUID, its own or that of one of its MIG instances."""
        whole = {gpu.uuid: gpu.index for gpu in self.gpus}
        return whole | {one.uuid: gpu.index for gpu in self.gpus for one in gpu.instances}

    @property
    def capabilities(self) -> str:
        """Compute capabilities of its GPUs, in words."""
        found = sorted({gpu.compute_capability for gpu in self.gpus})
        return ", ".join(f"{major}.{minor}" for major, minor in found) or "none"

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
    daemons = _given_daemons()
    selection = _selection(daemons)
    cores = sorted(os.sched_getaffinity(0))
    listed = list_gpus()
    gpus = visible_gpus(listed, selection)
    is_hidden = selection is not None and selection.strip() in _HIDES_ALL
    mps_control = find_mps_control() if gpus else None
    daemon, daemon_warning = _operator_daemon(mps_control) if mps_control else (None, None)
    return Machine(
        gpus=gpus,
        cpu_cores=usable_cores(cores, CgroupLimits().cpu_quota(), platform.node()),
        mps_control=mps_control,
        driver_version=driver_version(),
        operator_daemon=daemon,
        daemons=_answering(mps_control, daemons) if mps_control else {},
        host=detect_host(),
        gpu_problem=None if listed or is_hidden else gpu_problem(),
        selection_problem=_selection_problem(listed, selection),
        warnings=(
            *(() if gpus else _other_accelerators()),
            *filter(None, (daemon_warning, why_temporary(), _left_out_of_gmis())),
        ),
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
    for entry in _entries(selection):
        fits = _named_parts(gpus, entry)
        if len(fits) != 1:
            break
        [part] = fits
        before = chosen[part.index].instances if part.index in chosen else ()
        if part.index in chosen and set(part.instances) <= set(before):
            break
        chosen[part.index] = part._replace(instances=(*before, *part.instances))
    return tuple(chosen.values())


def _selection(daemons: Mapping[str, Path]) -> str | None:
    """`CUDA_VISIBLE_DEVICES`, with UUIDs instead of numbers in a job of a pack.

    A daemon numbers its GPUs from 0 and its clients see those numbers, not those of nvidia-smi.
    """
    selection = os.environ.get("CUDA_VISIBLE_DEVICES")
    are_numbers = selection is not None and all(map(str.isdecimal, _entries(selection)))
    return ",".join(daemons) if daemons and are_numbers else selection


def _selection_problem(gpus: tuple[Gpu, ...], selection: str | None) -> str | None:
    """Why a selection is none of these GPUs, which CUDA does not report; None without one."""
    if selection is None or not gpus:
        return None
    for entry in _entries(selection):
        if entry in _HIDES_ALL:
            break  # All that comes after it is hidden on purpose.
        if len(fits := _named_parts(gpus, entry)) != 1:
            here = ", ".join(
                f"{gpu.index} ({', '.join((gpu.uuid, *(one.uuid for one in gpu.instances)))})"
                for gpu in gpus
            )
            what = "names several GPUs" if fits else "names no GPU"
            return f"CUDA_VISIBLE_DEVICES={selection}: {entry} {what}; GPUs here are {here}"
    return None


def _entries(selection: str) -> list[str]:
    return selection.replace(" ", "").split(",")


def _named_parts(gpus: tuple[Gpu, ...], entry: str) -> list[Gpu]:
    return [part for gpu in gpus if (part := _named_part(gpu, entry))]


def _named_part(gpu: Gpu, entry: str) -> Gpu | None:
    """The GPU, or it with one instance, if `entry` names that."""
    if entry.isdecimal():
        return gpu if gpu.index == int(entry) else None
    if entry and gpu.uuid.startswith(entry):
        return gpu
    named = tuple(one for one in gpu.instances if entry and one.uuid.startswith(entry))
    return gpu._replace(instances=named) if len(named) == 1 else None


def _operator_daemon(program: Path) -> tuple[Path | None, str | None]:
    """The pipe directory of a daemon that runs, or a warning why the one there is not used."""
    named = os.environ.get(PIPE_VARIABLE)
    directory = Path(named) if named else DEFAULT_PIPE_DIRECTORY
    # Asking where there is no directory would cost a process start on every run. Unlike
    # `Path.is_dir` this takes any text, and folders of others.
    if not os.path.isdir(directory):
        return None, None
    if not named and (owner := foreign_owner(directory)) is not None:
        return None, (
            f"warning: {directory} belongs to user {owner}, so the MPS daemon there is not used; "
            f"set {PIPE_VARIABLE}={directory} to use it"
        )
    return (directory if MpsControl(program, directory).is_answering() else None), None


def _given_daemons() -> dict[str, Path]:
    """The daemons in `DAEMONS_VARIABLE`; none if it is not valid."""
    with suppress(ValueError):
        given = json.loads(os.environ.get(DAEMONS_VARIABLE, "{}"))
        if isinstance(given, dict):
            return {str(device): Path(str(pipe)) for device, pipe in given.items()}
    return {}


def _answering(program: Path, daemons: Mapping[str, Path]) -> dict[str, Path]:
    return {
        device: pipe
        for device, pipe in daemons.items()
        if MpsControl(program, pipe).is_answering()
    }


def _left_out_of_gmis() -> str | None:
    """What a user has set for other programs that use jax."""
    settings = ", ".join(f"{key}={value}" for key, value in breaking(os.environ).items())
    if not settings:
        return None
    return f"warning: GMIs start without {settings}, with which tasks do not work"


def foreign_owner(directory: Path) -> int | None:
    """The owner of a directory that any user could have made; None if root or this user is."""
    owners = (directory.lstat().st_uid, directory.stat().st_uid)
    return next((owner for owner in owners if owner not in (0, os.geteuid())), None)


def _other_accelerators() -> Iterator[str]:
    """What else could compute here, as far as device files show."""
    for pattern, what in _OTHERS.items():
        if found := sorted(nvidia.DEVICES.glob(pattern)):
            yield f"warning: {found[0]} looks like {what}, which gmijax does not use"
