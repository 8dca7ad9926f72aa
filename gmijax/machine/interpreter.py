"""How every child process of gmijax is started: as a module of this very gmijax. Stdlib only.

`python -m` would put the working directory before everything else on the child's path: a file
`random.py` there would shadow Python's, and in a checkout the child would be of
another version than its parent. So a child runs the file `child_start.py` with `-P`.
"""

from __future__ import annotations

import os
import site
import sys
import sysconfig
from collections.abc import Sequence

from gmijax.machine import child_start
from gmijax.version import __version__


def command(module: str, *arguments: str) -> list[str]:
    """The command that runs a module in a fresh interpreter.

    The child's path begins as that of any interpreter does: `PYTHONPATH`, Python, installed
    packages. What else this process has on its own, such as the folder of the user's script, comes
    after all of that, so it shadows nothing.

    Args:
      module: its name.
      arguments: what it finds in `sys.argv`.
    """
    added = os.pathsep.join(added_paths(sys.path))
    start = os.path.abspath(child_start.__file__)
    return [sys.executable, "-P", start, __version__, added, module, *arguments]


def added_paths(path: Sequence[str]) -> list[str]:
    """The folders of a path that a fresh interpreter would not have by itself; absolute."""
    named = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    own = (*sysconfig.get_paths().values(), *site.getsitepackages(), site.getusersitepackages())
    known = {os.path.abspath(entry) for entry in (*named, *own) if entry}
    python = os.path.join(sysconfig.get_path("stdlib"), "")
    return [
        entry
        for entry in dict.fromkeys(map(os.path.abspath, path))
        if entry not in known and not entry.startswith(python) and os.path.isdir(entry)
        # As in PYTHONPATH, where such a folder cannot be named either.
        if os.pathsep not in entry
    ]
