"""Runs a command: its configuration, `--help`, `--cfg job`."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Sequence
from functools import partial
from typing import TypeVar

from omegaconf import OmegaConf

from gmijax.cli.compose import build, choices, defaults
from gmijax.cli.grid import SweepHelp, build_sweep
from gmijax.cli.help import print_help
from gmijax.config.schema import to_dict
from gmijax.control.exit_codes import exit_code_of
from gmijax.errors import ConfigError
from gmijax.sweeps.sweep import run_request

C = TypeVar("C")


def command(name: str, cls: type[C], run: Callable[..., object], argv: Sequence[str]) -> int:
    """Runs one of the commands; returns its exit code."""

    def whole() -> None:
        if "--help" in argv or "-h" in argv:
            print_help(name, cls, partial(defaults, name), choices)
            return
        overrides, show = _split_options(argv)
        config = build(name, cls, overrides)
        if show:
            sys.stdout.write(OmegaConf.to_yaml(OmegaConf.create(to_dict(config))))
        else:
            run(config, show=True)

    return exit_code_of(name, whole)


def sweep_command(argv: Sequence[str]) -> int:
    """Runs `gmijax.sweep`, or `gmijax.train -m`; returns its exit code."""

    def whole() -> None:
        if "--help" in argv or "-h" in argv:
            print_help("sweep", SweepHelp, partial(defaults, "sweep"), choices)
            return
        overrides, show = _split_options(argv)
        request = build_sweep(overrides)
        if show:
            jobs = [dict(job.overrides) for job in request.jobs]
            shown = {"sweep": to_dict(request.settings), "jobs": jobs}
            sys.stdout.write(OmegaConf.to_yaml(OmegaConf.create(shown)))
        else:
            run_request(request, show=True)

    return exit_code_of("sweep", whole)


def _split_options(argv: Sequence[str]) -> tuple[list[str], bool]:
    arguments = [part for text in argv for part in re.split(r"^(--cfg)=", text) if part]
    show = False
    if "--cfg" in arguments:
        at = arguments.index("--cfg")
        if arguments[at + 1 : at + 2] != ["job"]:
            raise ConfigError(f"--cfg {' '.join(arguments[at + 1 : at + 2])}: allowed is job")
        del arguments[at : at + 2]
        show = True
    for text in arguments:
        if text.startswith("-"):
            raise ConfigError(f"unknown option {text}: allowed are --help, --cfg job, key=value")
    return arguments, show
