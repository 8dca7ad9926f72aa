"""Backend `share`: several processes on a GPU that take turns, as the driver does by default."""

from __future__ import annotations

from collections.abc import Mapping

from gmijax.machine.mps_control import PIPE_VARIABLE
from gmijax.runs.folder import RunPaths
from gmijax.supervise.backends.backend import Backend


class ShareBackend(Backend):
    """Keeps GMIs away from any MPS daemon on the machine; XLA keeps memory fractions."""

    def environment(self, gmi: int) -> Mapping[str, str]:
        """See `Backend`."""
        del gmi
        return no_daemon(self.run)


def no_daemon(run: RunPaths) -> Mapping[str, str]:
    """Points CUDA at a directory without an MPS daemon, which it takes for "no MPS", silently.

    It is below the run folder because there nobody else can start a daemon in it.
    """
    directory = run.mps / "none"
    directory.mkdir(parents=True, exist_ok=True)
    return {PIPE_VARIABLE: str(directory)}
