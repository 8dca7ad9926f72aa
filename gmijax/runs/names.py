"""Names that gmijax gives to what it numbers, so that it knows its own again.

Users may put copies, notes and other things beside what gmijax writes. Only a name of
exactly the right form is counted, read, moved or deleted.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

from gmijax.errors import ConfigError

STEP_DIGITS: Final = 12

_STEPS = f"[0-9]{{{STEP_DIGITS}}}"
_NUMBER = "(?:0|[1-9][0-9]*)"


def steps_name(env_steps: int) -> str:
    """The name of what belongs to so many environment steps."""
    return f"{env_steps:0{STEP_DIGITS}d}"


def steps_of(name: str) -> int | None:
    """Inverts `steps_name`; None for any other name."""
    return int(name) if re.fullmatch(_STEPS, name) else None


def by_steps(folder: Path, *, prefix: str = "", suffix: str = "") -> list[Path]:
    """What a folder has under the names of `steps_name`, the fewest steps first.

    Args:
      folder: there is nothing in it if it does not exist.
      prefix: what stands before the digits.
      suffix: what stands behind them.

    Raises:
      ConfigError: the folder cannot be read, which must not be taken for an empty folder.
    """
    return sorted(_named(folder, re.escape(prefix) + _STEPS + re.escape(suffix)))


def gmi_folders(root: Path) -> list[Path]:
    """The folders of GMIs in a run folder; raises as `by_steps`."""
    return sorted(path for path in _named(root, f"gmi_{_NUMBER}") if path.is_dir())


def attempt_folders(gmi: Path) -> list[Path]:
    """Those of failed attempts in the folder of a GMI; raises as `by_steps`."""
    return sorted(path for path in _named(gmi, f"attempt_{_NUMBER}") if path.is_dir())


def _named(folder: Path, form: str) -> list[Path]:
    try:
        names = os.listdir(folder)
    except (FileNotFoundError, NotADirectoryError):
        return []
    except OSError as error:
        raise ConfigError(f"{nearby(folder)}: cannot be read ({error.strerror})") from None
    return [folder / name for name in names if re.fullmatch(form, name)]


def nearby(path: Path) -> str:
    """A path as it is typed from the working directory, if that is shorter."""
    with suppress(ValueError, OSError):
        return str(path.relative_to(Path.cwd()))
    return str(path)


def as_typed(program: str) -> str:
    """A program as it is typed from the working directory.

    With `./` where it would be one of PATH without.
    """
    if not os.path.isabs(program):
        return program
    short = nearby(Path(program))
    return short if os.sep in short else os.path.join(os.curdir, short)


def shortened(
    parts: Sequence[str], most: int, between: str = ", ", also: str | None = None
) -> str:
    """The first parts, and how many more there are: `a, b, and 3 more`.

    `also` stands before the last one, if that is not as between the others.
    """
    more = len(parts) - most
    end = f"{between if also is None else also}and {more} more" if more > 0 else ""
    return f"{between.join(parts[:most])}{end}"


def counted(count: int, what: str) -> str:
    """A number of things in words: `1 job`, `2,000 jobs`."""
    return f"{count:,} {what}{'' if count == 1 else 's'}"
