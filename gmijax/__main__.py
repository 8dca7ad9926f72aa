"""`gmijax VERB ...`, the same as `python -m gmijax.VERB ...`: every command under one name."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Final

from gmijax.version import __version__

VERBS: Final[Mapping[str, str]] = MappingProxyType(
    {
        "train": "trains a policy, in one process or in several",
        "play": "evaluates a checkpoint and films it",
        "view": "shows a policy live in the browser, also during training",
        "serve": "collects experience with a trained policy or random actions",
        "search": "finds the number of environments and of processes that is fastest on a GPU",
        "sweep": "runs many training jobs, several at a time on every GPU",
        "pack": "runs any training command, several at a time on every GPU",
        "export": "writes a policy as files for robots: ONNX, StableHLO",
        "doctor": "checks what works on this machine, and says how to fix what does not",
        "list-envs": "lists the tasks",
        "demo": "plays and films a trained policy within seconds",
    }
)
"""Command -> what it does. `main(argv)` of the module of that name runs it, `-` read as `_`."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs a command; returns its exit code. Only that command's packages are imported."""
    verb, *rest = (sys.argv[1:] if argv is None else argv) or ("--help",)
    if verb == "help":
        verb, rest = (rest[0], ["--help", *rest[1:]]) if rest else ("--help", [])
    verb = verb.replace("_", "-")  # As the module is called.
    if verb in ("-h", "--help"):
        return _printed(_usage())
    if verb == "--version":
        return _printed(f"gmijax {__version__}\n")
    if verb in ("-sc", "--shell-completion"):
        from gmijax.cli.completion import complete

        return complete(rest, (*VERBS, "help"))
    if verb not in VERBS:
        from gmijax.config.schema import suggestion

        known = suggestion(verb, (*VERBS, "help"))
        what = f"unknown command {verb!r}{known}"
        if verb.startswith("-"):
            what = f"unknown option {verb}; allowed: --help, --version, -sc, or a command"
        sys.stderr.write(f"gmijax: {what}\n")
        return 2
    try:
        return importlib.import_module(f"gmijax.{verb.replace('-', '_')}").main(rest)
    except KeyboardInterrupt:  # While its packages are imported.
        sys.stderr.write(f"gmijax.{verb}: interrupted\n")
        return 130


def _printed(text: str) -> int:
    from gmijax.control.output import write_output
    from gmijax.errors import GmijaxError

    try:
        write_output(text)
    except GmijaxError as error:
        sys.stderr.write(f"gmijax: {error}\n")
        return 1
    return 0


def _usage() -> str:
    lines = [f"  {verb:<10} {what}" for verb, what in VERBS.items()]
    return "\n".join(
        (
            "usage: gmijax COMMAND [key=value ...] [--help]",
            "       gmijax help [COMMAND]",
            "       gmijax --version\n",
            *lines,
            "\nEvery command has its own --help. -v also prints why it decided what it did.",
            "Completion of commands, keys and values in bash:",
            '  eval "$(gmijax -sc install=bash)"',
            "\nStart with:\n  gmijax demo\n",
        )
    )


if __name__ == "__main__":
    sys.exit(main())
