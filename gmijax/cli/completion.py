"""Completion in a shell: of keys by Hydra's plugins (bash, fish, zsh), of values by our own."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence

from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra

from gmijax.cli.answers import own_answers
from gmijax.cli.groups import config_dir
from gmijax.control.exit_codes import exit_code_of
from gmijax.control.output import as_output, write_output
from gmijax.errors import ConfigError


def complete(argv: Sequence[str], verbs: Iterable[str]) -> int:
    """Answers `gmijax -sc ...` as programs of Hydra do; returns the exit code.

    Args:
      argv: `install=SHELL`, which prints a script to `eval`, `uninstall=SHELL`, or what that
        script asks: `query=SHELL`, with the line typed so far in the variable COMP_LINE.
      verbs: the commands.
    """
    return exit_code_of("completion", lambda: _complete(argv, verbs))


def _complete(argv: Sequence[str], verbs: Iterable[str]) -> None:
    name = None
    if any(text.startswith("query=") for text in argv):
        # Hydra's plugins know programs without commands: they get the line without our name.
        line = os.environ.get("COMP_LINE", "").lstrip().partition(" ")[2].lstrip()
        name, separator, _ = line.partition(" ")
        if not separator:
            write_output("\n".join(verbs) + "\n")
            return
        if not (config_dir() / f"{name}.yaml").is_file():
            return  # It takes no keys.
        words = line.split()[1:] + [""] * line.endswith(" ")
        if (own := own_answers(name, words)) is not None:
            write_output("\n".join(own) + "\n")
            return
        os.environ["COMP_LINE"] = line
    with initialize_config_dir(str(config_dir()), version_base=None):
        hydra = GlobalHydra.instance().hydra
        assert hydra is not None
        try:
            with as_output():
                hydra.shell_completion(name, list(argv))
        except ValueError as error:
            raise ConfigError(f"-sc {' '.join(argv)}: {' '.join(str(error).split())}") from None
