"""`gmijax list-envs`: the tasks, and whose tasks there are beside ours. Loads no jax."""

from __future__ import annotations

import ast
import importlib.util
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

from rich.table import Table

from gmijax.config.env import ROBOTS
from gmijax.control.console import open_console, print_next, training_of
from gmijax.control.exit_codes import exit_code_of
from gmijax.control.output import as_output, write_output
from gmijax.errors import ConfigError
from gmijax.machine.snapshot import detect_machine
from gmijax.sim.registry import SUITES, TASKS, missing_of
from gmijax.sim.robot_models import how_to_get, models_of

USAGE: Final = """usage: gmijax list-envs

Lists the tasks with the lengths of their observations and actions, and the suites of others.
"""


class Task(NamedTuple):
    """What is known of a task without jax; None for what its module does not have as a number."""

    name: str
    obs_size: int | None
    action_size: int | None
    episode_length: int | None
    description: str


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    if "--help" in argv or "-h" in argv:
        return exit_code_of("list_envs", lambda: write_output(USAGE))
    return exit_code_of("list_envs", lambda: _list(argv))


def _list(argv: Sequence[str]) -> None:
    if argv:
        raise ConfigError(f"unknown argument {argv[0]}; allowed: --help")
    with as_output():
        _print_tasks()


def _print_tasks() -> None:
    table = Table(box=None, pad_edge=False)
    table.add_column("env", no_wrap=True)
    for heading in ("observations", "actions", "steps"):
        table.add_column(heading, justify="right")
    table.add_column("task")
    for task in map(task_of, sorted(TASKS)):
        sizes = (task.obs_size, task.action_size, task.episode_length)
        table.add_row(task.name, *("-" if x is None else str(x) for x in sizes), task.description)
    console = open_console(show=True)
    console.print(table, soft_wrap=False)
    console.print()
    for line in suite_lines():
        console.print(line)
    print_next(console, training_of("ant", has_gpu=bool(detect_machine().gpus)))


def task_of(name: str) -> Task:
    """Reads the module of a task without running it: that would import jax."""
    spec = importlib.util.find_spec(TASKS[name])
    assert spec is not None
    assert spec.origin is not None
    module = ast.parse(Path(spec.origin).read_text())
    numbers: dict[str, int] = {}
    for node in module.body:
        match node:
            case ast.Assign(targets=[ast.Name(id=key)], value=ast.Constant(value=int(number))):
                numbers[key] = number
            case _:
                pass
    about = (ast.get_docstring(module) or "").splitlines()[0].partition(" (")[0]
    return Task(
        name,
        numbers.get("OBS_SIZE"),
        numbers.get("ACTION_SIZE"),
        numbers.get("DEFAULT_EPISODE_LENGTH"),
        about.partition(": ")[2].rstrip("."),
    )


def suite_lines() -> list[str]:
    """A line for each suite of others: how a task of it is named, or what must be installed."""
    lines = [f"env={', env='.join(ROBOTS)}: robots of MuJoCo Playground (docs/tasks.md)"]
    if absent := [robot for robot in ROBOTS if missing_of(robot)]:
        models = sorted({name for robot in absent for name in models_of(ROBOTS[robot])})
        how = missing_of("playground") or how_to_get(models)
        lines.append(f"  not installed: {', '.join(absent)}; {how}")
    lines += [
        f"env={suite} env.name=NAME: {missing_of(suite) or 'installed'}"
        for suite in SUITES
        if suite != "custom"
    ]
    return [*lines, "env=PATH.py:FUNCTION: a task of your own (docs/custom-task.md)"]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
