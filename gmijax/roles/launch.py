"""The controller of roles: from a plan and roles to what they return."""

from __future__ import annotations

import math
import numbers
import os
import pickle
import sys
import warnings
from collections.abc import Sequence
from functools import partial
from typing import Any, Final

from gmijax.channels.messenger import MIN_CAPACITY_BYTES
from gmijax.config import Timeouts
from gmijax.config.schema import require_between, require_positive
from gmijax.errors import ConfigError, GmiFailed, GmijaxError
from gmijax.machine.host_limits import require_host_capacity
from gmijax.machine.snapshot import Machine, detect_machine
from gmijax.partition.plan import Plan
from gmijax.roles import shipping
from gmijax.roles.manager import GMIManager
from gmijax.roles.role import Role
from gmijax.runs.folder import RunPaths, create_run, read_json, write_json
from gmijax.runs.names import nearby
from gmijax.supervise.child import ENV_GMI
from gmijax.supervise.job_kinds import JobKind, pipes
from gmijax.supervise.run_gmis import Launch, run_gmis

MAX_PIPE_MIB: Final = 2**14
"""Most shared memory for one pipe; larger messages travel in pieces anyway."""


def launch(
    plan: Plan | GMIManager,
    role: Role | Sequence[Role],
    *args: Any,
    timeout_s: float = 60.0,
    run_dir: str | None = None,
    pipe_mib: float = 2.0,
    start_timeout_s: float = 600.0,
    stall_timeout_s: float | None = None,
    grace_s: float = 10.0,
    device_messages: bool = True,
) -> list[Any]:
    """Runs a role in every GMI of a plan, each a process of its own, until all have ended.

    Args:
      plan: where the GMIs live; from `gmijax.plan`, or a manager with its GMIs.
      role: what every GMI runs (a copy each), or one role per GMI, in order of id.
      args: what every role's `run` gets.
      timeout_s: longest wait of a role for a message or in a collective call.
      run_dir: the run folder; None: `runs/<class>-<date>-<time>`.
      pipe_mib: shared memory for each ordered pair of GMIs that talk, MiB. Larger messages
        travel in pieces.
      start_timeout_s: longest wait for a GMI to start and take up its share.
      stall_timeout_s: a GMI without progress for this long has failed (see `Role.progress`);
        None: never.
      grace_s: time that GMIs get to end by themselves, after Ctrl-C or a failure.
      device_messages: arrays of jax stay on the GPU on their way to a GMI that shares it, where
        CUDA IPC can be had; False: all messages go through host memory.

    Returns:
      What every GMI's `run` returned, in order of id.

    Raises:
      ConfigError: bad input, before anything was started; or a role asked for a GMI or an
        operation that there is not.
      GmiFailed: a role raised, or its process ended; names the first. Its notes have the
        traceback and the run folder.
      JobInterrupted: SIGINT, SIGTERM, SIGHUP or SIGUSR1 came, and all GMIs have ended.
    """
    # Before anything else: the module of a GMI's role starts jobs without end otherwise.
    _require_no_gmi()
    plan = _plan(plan)
    roles = _roles(role, plan)
    _check_numbers(timeout_s, pipe_mib, start_timeout_s, stall_timeout_s, grace_s)
    machine = detect_machine()
    _require_capacity(plan, machine)
    config = {
        "roles": [type(each).__qualname__ for each in roles],
        "timeout_s": timeout_s,
        "start_timeout_s": start_timeout_s,
        "capacity_bytes": int(pipe_mib * 2**20),
        "device_messages": device_messages,
        "sys_path": [os.path.abspath(entry) for entry in sys.path],
    }
    run = _new_run(run_dir, plan, config, roles, args)
    timeouts = _timeouts(start_timeout_s, stall_timeout_s, grace_s)
    return _outputs(_job(plan, machine, run, timeouts, config["capacity_bytes"]))


def _outputs(job: Launch) -> list[Any]:
    """Runs the job; what every GMI's `run` returned, in order of id."""
    try:
        run_gmis(job)
        outputs = [_output(job.run, gmi) for gmi in job.plan.layout.gmis]
    except GmijaxError as error:
        _explain(error, job.run)
        raise
    return [pickle.loads(output) for output in outputs]


def _timeouts(start_timeout_s: float, stall_timeout_s: float | None, grace_s: float) -> Timeouts:
    return Timeouts(
        start_timeout_s=start_timeout_s,
        stall_timeout_s=math.inf if stall_timeout_s is None else stall_timeout_s,
        stop_timeout_s=grace_s,
        grace_s=grace_s,
    )


def _new_run(
    run_dir: str | None,
    plan: Plan,
    config: dict[str, Any],
    roles: Sequence[Role],
    args: tuple[Any, ...],
) -> RunPaths:
    """The run folder, with what every GMI reads when it starts."""
    parcels = [_parcel(each, args) for each in roles]  # Before there is a folder: it may fail.
    run = create_run(run_dir, None, type(roles[0]).__name__.lower())
    write_json(run.plan, plan.to_dict())
    write_json(run.config, config)
    for gmi, parcel in enumerate(parcels):
        run.gmi(gmi).root.mkdir()
        run.gmi(gmi).role.write_bytes(parcel)
    return run


def _require_no_gmi() -> None:
    if ENV_GMI in os.environ:
        raise ConfigError(
            "gmijax.launch: called inside a GMI; in the file of a role, call it below "
            'if __name__ == "__main__":'
        )


def _plan(plan: Plan | GMIManager) -> Plan:
    made = plan.plan() if isinstance(plan, GMIManager) else plan
    if not isinstance(made, Plan):
        raise ConfigError(f"plan={made!r}: expected a plan of gmijax.plan, or a GMIManager")
    return made


def _require_capacity(plan: Plan, machine: Machine) -> None:
    """The plan may come from another machine, or from a time when more memory was free here."""
    num_cores, on_cpu = len(machine.cpu_cores), plan.backend == "cpu"
    require_host_capacity(plan.layout.num_gmis, "plan", machine.host, num_cores, on_cpu=on_cpu)


def _job(
    plan: Plan, machine: Machine, run: RunPaths, timeouts: Timeouts, capacity_bytes: int
) -> Launch:
    # Roles wait for each other, so they start together.
    shared = partial(pipes, capacity_bytes)
    return Launch(
        plan=plan,
        machine=machine,
        run=run,
        kind=JobKind("gmijax.roles.worker", shared=shared),
        timeouts=timeouts,
        on_warning=lambda text: warnings.warn(text, RuntimeWarning, stacklevel=2),
    )


def _roles(role: Role | Sequence[Role], plan: Plan) -> list[Role]:
    num_gmis = plan.layout.num_gmis
    if isinstance(role, type):
        raise ConfigError(f"role={role.__name__}: a class; give an object, {role.__name__}(...)")
    roles = list(role) if isinstance(role, Sequence) else [role] * num_gmis
    for each in roles:
        if not isinstance(each, Role):
            raise ConfigError(f"role={each!r}: expected a gmijax.Role, got {type(each).__name__}")
    if len(roles) != num_gmis:
        raise ConfigError(f"role: {len(roles)} roles for the {num_gmis} GMIs of {plan.layout}")
    return roles


def _check_numbers(
    timeout_s: float,
    pipe_mib: float,
    start_timeout_s: float,
    stall_timeout_s: float | None,
    grace_s: float,
) -> None:
    _require_number("pipe_mib", pipe_mib)
    require_between("pipe_mib", pipe_mib, MIN_CAPACITY_BYTES / 2**20, MAX_PIPE_MIB)
    limits = {"timeout_s": timeout_s, "start_timeout_s": start_timeout_s, "grace_s": grace_s}
    if stall_timeout_s is not None:
        limits["stall_timeout_s"] = stall_timeout_s
    for key, value in limits.items():
        _require_number(key, value)
        require_positive(key, value)
        if math.isinf(value):
            raise ConfigError(f"{key}={value!r}: must be finite")


def _require_number(key: str, value: object) -> None:
    if not isinstance(value, numbers.Real):
        raise ConfigError(f"{key}={value!r}: expected a number")


def _parcel(role: Role, args: tuple[Any, ...]) -> bytes:
    try:
        return shipping.dump((role, args))
    except Exception as error:
        # Pickling calls code of the user's, which may raise anything.
        raise ConfigError(
            f"role={type(role).__qualname__}: cannot be sent to a GMI: "
            f"{str(error).splitlines()[0] if str(error) else type(error).__name__}; it is pickled "
            "when the job starts, so make what is not plain data in run"
        ) from error


def _output(run: RunPaths, gmi: int) -> bytes:
    """What `run` returned in a GMI that ended well, pickled."""
    try:
        return run.gmi(gmi).output.read_bytes()
    except FileNotFoundError:  # A role that calls sys.exit() ends with exit code 0, too.
        raise GmiFailed(gmi, "its process ended with exit code 0 inside of run") from None


def _explain(error: GmijaxError, run: RunPaths) -> None:
    """Adds the traceback of the GMI that failed, and the run folder, to the error."""
    failed = [error.gmi] if isinstance(error, GmiFailed) else []
    if isinstance(error, ConfigError):
        failed = [
            int(path.parent.name.partition("_")[2]) for path in run.root.glob("gmi_*/error.json")
        ]
    for gmi in failed:
        try:
            error.add_note(f"in GMI {gmi}:\n{read_json(run.gmi(gmi).error)['traceback'].rstrip()}")
        except (ConfigError, KeyError, AttributeError):
            continue
    error.add_note(f"run folder: {nearby(run.root)}")
