"""`python -m gmijax.doctor`: what this machine can do for gmijax, what it cannot, and why."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from typing import Final, NamedTuple

from rich.table import Table

from gmijax.control.console import UserConsole, open_console, print_next
from gmijax.control.diagnosis import Diagnosis, diagnose
from gmijax.control.exit_codes import EXIT_FAILED, exit_code_of
from gmijax.control.output import as_output, write_output
from gmijax.control.system_info import inspect_system
from gmijax.errors import ConfigError
from gmijax.machine.mig_split import split_commands
from gmijax.machine.snapshot import Machine, detect_machine
from gmijax.version import __version__

USAGE: Final = """usage: gmijax doctor [--json] [--verbose] [--help]
       gmijax doctor mig=SIZES [gpu=INDEX]
       gmijax doctor cluster=ADDRESS [--json]

Without mig=, looks at GPUs, driver, MPS, MIG and versions, asks jax what it sees, and draws a
picture; says which backends, reducers, physics, environments and extras can be used, and what
mends the others. Without a GPU, what only GPUs have is shown with --verbose.
With mig=3g,2g,1g,1g, prints the commands with which an administrator would divide a GPU so
(gpu=INDEX as nvidia-smi lists it; else the first that can be divided). It runs none of them.
With cluster=auto (or host:port), shows the nodes of a Ray cluster, and in what they differ.
Exit codes: 0 healthy, 1 something is broken that should work, 2 bad input.
"""

_MOST_DIGITS: Final = 9
"""Of a GPU's index; Python reads no number with thousands of them."""


class DoctorOptions(NamedTuple):
    """Options of the command line."""

    as_json: bool = False
    verbose: bool = False
    mig: str | None = None
    gpu: int | None = None
    cluster: str | None = None


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    if "--help" in argv or "-h" in argv:
        return exit_code_of("doctor", lambda: write_output(USAGE))
    problems: list[str] = []
    code = exit_code_of("doctor", lambda: problems.extend(_answer(parse(argv))))
    return EXIT_FAILED if problems else code


def _answer(options: DoctorOptions) -> Sequence[str]:
    """Prints what was asked for; returns what is broken."""
    if options.mig is not None:
        write_output(split_text(options.mig, options.gpu, detect_machine()))
        return ()
    if options.cluster is not None:
        return show_nodes(options.cluster, as_json=options.as_json)
    found = diagnose(inspect_system())
    if options.as_json:
        write_output(json.dumps(found.to_dict(), indent=2) + "\n")
    else:
        with as_output():
            console = open_console(show="verbose" if options.verbose else True)
            show(found, console)
            if not found.problems:
                print_next(console, ("see a trained policy, then train one", "gmijax demo"))
    return found.problems


def parse(argv: Sequence[str]) -> DoctorOptions:
    """Raises ConfigError for what it does not know."""
    options = DoctorOptions()
    for text in argv:
        key, _, value = text.partition("=")
        if text == "--json":
            options = options._replace(as_json=True)
        elif text in ("-v", "--verbose"):
            options = options._replace(verbose=True)
        elif key == "mig" and value:
            options = options._replace(mig=value)
        elif key == "gpu" and value.isdecimal() and len(value) <= _MOST_DIGITS:
            options = options._replace(gpu=int(value))
        elif key == "cluster" and value:
            options = options._replace(cluster=value)
        else:
            raise ConfigError(
                f"{text}: expected one of --json, --verbose, mig=SIZES (e.g. mig=3g,2g,1g,1g), "
                "gpu=INDEX, cluster=ADDRESS, --help"
            )
    if options.mig is None and options.gpu is not None:
        raise ConfigError(f"gpu={options.gpu}: only together with mig=SIZES")
    if options.mig is not None and options.as_json:
        raise ConfigError("--json: not together with mig=SIZES")
    if options.mig is not None and options.cluster is not None:
        raise ConfigError(f"cluster={options.cluster}: not together with mig=SIZES")
    return options


def split_text(wanted: str, index: int | None, machine: Machine) -> str:
    """The commands that divide a GPU, with what to know about them.

    Raises:
      ConfigError: no such GPU, or one that cannot be divided so.
    """
    if not machine.gpus:
        raise ConfigError(f"mig={wanted}: no usable NVIDIA GPU here")
    if index is None:
        gpu = next((gpu for gpu in machine.gpus if gpu.mig_supported), machine.gpus[0])
    else:
        found = [gpu for gpu in machine.gpus if gpu.index == index]
        if not found:
            indices = [gpu.index for gpu in machine.gpus]
            raise ConfigError(f"gpu={index}: no such GPU; usable are {indices}")
        gpu = found[0]
    lines = [
        f"# Divides GPU {gpu.index} ({gpu.name}); no process may use it meanwhile.",
        "# If a name is refused, nvidia-smi mig -lgip lists those of this GPU.",
        *split_commands(gpu, wanted),
    ]
    return "\n".join(lines) + "\n"


def show_nodes(address: str, *, as_json: bool) -> Sequence[str]:
    """Prints the nodes of a cluster, and in what they differ; returns what is broken.

    Raises:
      ConfigError: there is no such cluster.
      NodeLost: a node is gone while it is asked.
    """
    from gmijax.cluster.survey import differences, lines_of_nodes, nodes_as_data, survey

    nodes = survey(address)
    problems, notes = differences(nodes)
    if as_json:
        data = {"ok": not problems, "nodes": nodes_as_data(nodes)}
        data |= {"problems": problems, "notes": notes}
        write_output(json.dumps(data, indent=2) + "\n")
    else:
        lines = [*lines_of_nodes(nodes), *(f"note: {note}" for note in notes)]
        lines += [f"problem: {problem}" for problem in problems]
        lines += [] if problems else ["a job can be on all of them"]
        write_output("\n".join(lines) + "\n")
    return problems


def show(found: Diagnosis, console: UserConsole) -> None:
    """Prints the diagnosis for people."""
    system = found.system
    machine = system.machine
    driver = machine.driver_version
    console.print(
        f"gmijax {__version__}, Python {sys.version.split()[0]}, {len(machine.cpu_cores)} CPU "
        f"cores, {f'NVIDIA driver {driver}' if driver else 'no NVIDIA driver'}"
    )
    for gpu in machine.gpus:
        mig = "on" if gpu.mig_enabled else "off" if gpu.mig_supported else "none"
        major, minor = gpu.compute_capability
        console.print(
            f"GPU {gpu.index}: {gpu.name}, {gpu.memory_mib} MiB, compute capability "
            f"{major}.{minor}, MIG {mig}"
        )
        for one in gpu.instances:
            console.print(f"  {one.profile}: {one.num_sms} SMs, {one.memory_mib} MiB, {one.uuid}")
    console.print(f"jax sees: {', '.join(system.jax.devices) or system.jax.error}")
    installed = [f"{name} {number}" for name, number in system.versions.items() if number]
    console.print(f"packages: {', '.join(installed)}\n", soft_wrap=False)
    console.print(_table(found, whole=bool(machine.gpus) or console.is_verbose), soft_wrap=False)
    for note in found.notes:
        console.print(f"note: {note}")
    for problem in found.problems:
        console.print(f"problem: {problem}")
    if not found.problems:
        console.print("no problems found")


_OF_GPUS: Final = ("backend", "reducer", "intra")
"""Kinds that mean little without a GPU."""


def _table(found: Diagnosis, *, whole: bool) -> Table:
    table = Table(box=None, pad_edge=False)
    for heading in ("kind", "name", "usable", "why"):
        table.add_column(heading, overflow="fold", no_wrap=heading != "why")
    for ability in found.abilities:
        if not whole and ability.kind in _OF_GPUS:
            continue
        table.add_row(ability.kind, ability.name, "yes" if ability.usable else "no", ability.why)
    return table


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
