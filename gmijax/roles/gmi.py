"""What a role can do inside a GMI: talk to the others, and tell the controller how far it is."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from gmijax.collectives.group import GroupReducer, Operation
from gmijax.collectives.messenger import Messenger
from gmijax.errors import ConfigError
from gmijax.partition.child import ChildLink
from gmijax.partition.layout import Layout


class Gmi:
    """This process as one of the GMIs of a job.

    Attributes:
      layout: GPU -> GMIs.
      rank: id of this GMI.
    """

    def __init__(
        self, layout: Layout, messenger: Messenger, reducer: GroupReducer, link: ChildLink
    ) -> None:
        self.layout = layout
        self.rank = messenger.rank
        self._messenger = messenger
        self._reducer = reducer
        self._link = link
        self._steps = 0

    @property
    def stop_requested(self) -> bool:
        """Whether the controller asked for an end."""
        return self._link.stop_requested

    def reduce(self, data: Any, op: Operation, group: Iterable[int] | None) -> Any:
        """See `Role.collective`."""
        result = self._reducer.reduce(self.layout.gmis if group is None else group, data, op)
        self.progress()
        return result

    def send(self, data: Any, dst: int) -> None:
        """See `Role.send`."""
        self._messenger.send(data, dst)
        self.progress()

    def recv(self, src: int, timeout_s: float | None) -> Any:
        """See `Role.recv`."""
        data = self._messenger.recv(src, timeout_s=timeout_s)
        self.progress()
        return data

    def progress(self, step: int | None = None) -> None:
        """See `Role.progress`."""
        self._steps = self._steps if step is None else step
        self._link.beat("running", self._steps)


# One process is one GMI, so this is as global as the process: managers that a role's module makes
# when it is loaded must find it too.
_here: list[Gmi] = []


def enter(gmi: Gmi) -> None:
    """Makes `gmi` the one that this process is."""
    _here[:] = [gmi]


def here(what: str) -> Gmi:
    """The GMI that this process is.

    Raises:
      ConfigError: it is none, so that `what` makes no sense.
    """
    if not _here:
        raise ConfigError(f"{what}: only inside a GMI, in the role's run; see gmijax.launch")
    return _here[0]
