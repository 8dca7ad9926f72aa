"""Runs a command: its configuration, `--help`, `--cfg job`, exit codes.

Exit codes: 0 success, 2 bad input (one line), 130 interrupted, 1 anything else.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Sequence
from functools import partial
from typing import Final, TypeVar

from omegaconf import OmegaConf

from gmijax.cli.compose import build, choices, defaults
from gmijax.cli.help import print_help
from gmijax.config.schema import to_dict
from gmijax.errors import ConfigError, GmijaxError, JobInterrupted

C = TypeVar("C")

EXIT_OK: Final = 0
EXIT_FAILED: Final = 1
EXIT_BAD_INPUT: Final = 2
EXIT_INTERRUPTED: Final = 130


def command(name: str, cls: type[C], run: Callable[..., object], argv: Sequence[str]) -> int:
    """Runs one of the commands and turns every error into its exit code."""
    try:
        if "--help" in argv or "-h" in argv:
            print_help(name, cls, partial(defaults, name), choices)
            return EXIT_OK
        overrides, show = _split_options(argv)
        config = build(name, cls, overrides)
        if show:
            sys.stdout.write(OmegaConf.to_yaml(OmegaConf.create(to_dict(config))))
            return EXIT_OK
        run(config, show=True)
        return EXIT_OK
    except ConfigError as error:
        _complain(name, error)
        return EXIT_BAD_INPUT
    except (JobInterrupted, KeyboardInterrupt) as error:
        _complain(name, error if str(error) else "interrupted")
        return EXIT_INTERRUPTED
    except GmijaxError as error:
        _complain(name, error)
        return EXIT_FAILED


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


def _complain(name: str, what: object) -> None:
    notes = getattr(what, "__notes__", [])
    text = "; ".join([str(what), *notes])
    # One line, whatever is in the values that it shows.
    shown = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)
    sys.stderr.write(f"gmijax.{name}: {shown}\n")
