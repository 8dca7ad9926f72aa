"""Runs a command: its configuration, `--help`, `--cfg job`."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import zip_longest
from typing import Any, Final

from omegaconf import OmegaConf

from gmijax.cli.compose import build, defaults
from gmijax.cli.grid import SweepHelp, build_sweep
from gmijax.cli.groups import choices
from gmijax.cli.help import print_help
from gmijax.config import ServeConfig, TrainConfig
from gmijax.config.schema import to_dict
from gmijax.control.console import open_console
from gmijax.control.exit_codes import exit_code_of
from gmijax.control.output import as_output, write_output
from gmijax.errors import ConfigError
from gmijax.sweeps.sweep import SweepWork, run_sweep

_VERBOSE: Final = ("-v", "--verbose")


def command(
    name: str,
    cls: type[Any],
    run: Callable[..., object],
    argv: Sequence[str],
    *,
    make: Callable[[Sequence[str]], Any] | None = None,
    shown: Callable[[Any], Mapping[str, Any]] = to_dict,
    must_print: bool = False,
) -> int:
    """Runs one of the commands; returns its exit code.

    Args:
      name: of the command.
      cls: its keys, as `--help` prints them.
      run: gets what `make` returned.
      argv: the command line.
      make: what the overrides stand for; None: a configuration `cls`.
      shown: what `--cfg job` prints of it.
      must_print: whether it has failed where its output cannot be written, as its answer is there.
    """

    def whole() -> None:
        if asked := [at for at, word in enumerate(argv) if word in ("--help", "-h")]:
            topic = next(iter(argv[asked[0] + 1 : asked[0] + 2]), None)
            with as_output():
                print_help(name, cls, partial(defaults, name), choices, topic)
            return
        overrides, show, verbose = _split_options(argv)
        made = build(name, cls, overrides) if make is None else make(overrides)
        if show:
            write_output(OmegaConf.to_yaml(OmegaConf.create(dict(shown(made)))))
        else:
            console = open_console(show="verbose" if verbose else True)
            console.opening = _task_nobody_chose(made, overrides)
            run(made, show=console)
            if must_print:
                console.require_printed()

    return exit_code_of(name, whole)


def sweep_command(argv: Sequence[str]) -> int:
    """Runs `gmijax.sweep`, or `gmijax.train -m`; returns its exit code."""
    return command("sweep", SweepHelp, run_sweep, argv, make=build_sweep, shown=_shown_sweep)


def _shown_sweep(work: SweepWork) -> dict[str, Any]:
    jobs = [dict(job.overrides) for job in work.jobs]
    nodes = {"cluster": to_dict(work.cluster)} if work.cluster.engine else {}
    return {"sweep": to_dict(work.settings), **nodes, "jobs": jobs}


def _task_nobody_chose(made: Any, overrides: Sequence[str]) -> str | None:
    """Names the task of a job for which neither the command line nor a run chooses one."""
    config = made.jobs[0].config if isinstance(made, SweepWork) and made.jobs else made
    if isinstance(config, TrainConfig):
        run = None if config.run.resume == "auto" else config.run.resume
    elif isinstance(config, ServeConfig):
        run = config.run.dir
    else:
        return None
    if run is not None or any(text.lstrip("+").startswith("env=") for text in overrides):
        return None
    others = "choose another with env=NAME (gmijax list-envs shows them)"
    return f"task: {config.env.label}, the default; {others}"


def _split_options(argv: Sequence[str]) -> tuple[list[str], bool, bool]:
    """The overrides; whether only the configuration is to be shown; whether reasons are, too."""
    parts = [part for text in argv for part in re.split(r"^(--cfg)=", text) if part]
    arguments = [text for text in parts if text not in _VERBOSE]
    show, verbose = False, len(arguments) < len(parts)
    if "--cfg" in arguments:
        at = arguments.index("--cfg")
        if arguments[at + 1 : at + 2] != ["job"]:
            given = [text for text in arguments[at : at + 2] if "=" not in text]
            raise ConfigError(f"{' '.join(given)}: expected --cfg job")
        del arguments[at : at + 2]
        show = True
    for text, after in zip_longest(arguments, arguments[1:], fillvalue="-"):
        if text.startswith("-"):
            key, equals, value = text.lstrip("-").partition("=")
            if not equals and not after.startswith("-") and "=" not in after:
                equals, value = "=", after  # `--num-envs 64`, as others have it.
            meant = f"; did you mean {key.replace('-', '_')}={value}?" if key and equals else ""
            allowed = "--help, --verbose, --cfg job, key=value"
            raise ConfigError(f"unknown option {text}; allowed: {allowed}{meant}")
    return arguments, show, verbose
