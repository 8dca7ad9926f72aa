"""The folder for what is made of a policy."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from gmijax.config import ExportConfig, PlayConfig
from gmijax.config.schema import to_dict
from gmijax.errors import ConfigError
from gmijax.runs.folder import RunPaths, make_folder, remove_temporary, write_json
from gmijax.runs.names import nearby


def prepare_output(
    root: Path, config: PlayConfig | ExportConfig, stale: Iterable[Path] = ()
) -> None:
    """Makes the folder if it is not there, with the configuration in it, and removes `stale`.

    Raises:
      ConfigError: it cannot be made or written.
    """
    make_folder(root, nearby(root))
    try:
        write_json(RunPaths(root).config, to_dict(config))
        remove_temporary(root)
        for path in stale:
            path.unlink(missing_ok=True)
    except OSError as error:
        raise ConfigError(f"cannot write to {nearby(root)} ({error.strerror})") from None
