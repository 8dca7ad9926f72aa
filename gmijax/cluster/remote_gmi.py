"""GMIs on other nodes as the supervisor sees them, and the node behind them."""

from __future__ import annotations

import signal
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final, Protocol

from gmijax.clock import running_s
from gmijax.cluster.node import RemoteGmiStatus
from gmijax.errors import GmiFailed, NodeLost, ReportedError, lines_of
from gmijax.runs.folder import GmiPaths
from gmijax.supervise.watched_gmi import WatchedGmi

SILENT_S: Final = 0.5
"""Without an answer for longer, a node may be gone."""

LOST_S: Final = 60.0
"""Without an answer for longer it is; Ray reports most deaths sooner."""


class Answer(Protocol):
    """What a node was asked."""

    def is_there(self) -> bool:
        """Whether the answer has come, or will not come any more."""
        ...

    def get(self) -> Any:
        """The answer, or what the method raises; NodeLost if the node is gone."""
        ...


Ask = Callable[..., Answer]
"""Calls a method of a node by its name, with arguments."""


class RemoteNode:
    """A node as the controller sees it.

    Attributes:
      address: by which it is named in messages.
      lost: why it is gone; None while it answers.
      is_silent: whether it has not answered for a moment.

    Args:
      ask: calls a method of its actor.
      position: among the nodes of the job.
    """

    def __init__(self, ask: Ask, position: int, address: str) -> None:
        self.address = address
        self.lost: str | None = None
        self.is_silent = False
        self._ask, self._position = ask, position
        self._seen: dict[int, Any] = {}
        self._asked: Answer | None = None
        self._asked_s = 0.0

    def start(self, gmi: int, paths: GmiPaths) -> RemoteGmi:
        """Starts a GMI there.

        Raises:
          GmiFailed: it cannot be started, or the node is gone.
        """
        started = self.call("start", gmi)
        if not isinstance(started, int):
            raise GmiFailed(gmi, started or self.lost or "its node does not answer")
        return RemoteGmi(self, gmi, paths, started)

    def call(self, method: str, *arguments: Any) -> Any:
        """What a method returns or raises; None if the node is gone, or while it is being lost."""
        return None if self.lost is not None else self._answer(self._ask(method, *arguments))

    def send(self, method: str, *arguments: Any) -> None:
        """Calls a method without waiting for it; a node does one after the other."""
        if self.lost is None:
            with suppress(Exception):  # The next poll finds out.
                self._ask(method, *arguments)

    def order(self, child: int, order: str) -> None:
        """Has it do something with a GMI or another child, without waiting for that."""
        self.send("order", child, order)

    def look(self, child: int) -> Any:
        """The newest that its `poll` reported of a child; None before the first answer."""
        now_s = running_s()
        if self.lost is None and self._asked is not None and self._asked.is_there():
            seen, self._asked = self._answer(self._asked), None
            self._seen = self._seen if seen is None else seen
        if self.lost is None and self._asked is None:
            self._asked, self._asked_s = self._ask("poll"), now_s
        waited_s = now_s - self._asked_s
        self.is_silent = self.lost is None and waited_s > SILENT_S
        if self.is_silent and waited_s > LOST_S:
            self._lose(TimeoutError(f"it does not answer for {LOST_S:g} s"))
        return self._seen.get(child)

    def _answer(self, asked: Answer) -> Any:
        try:
            return asked.get()
        except NodeLost as error:
            self._lose(error)
            return None
        except Exception as error:
            self._lose(error)  # It is not asked any more while the job ends.
            raise

    def _lose(self, error: Exception) -> None:
        self.lost = f"node {self._position} ({self.address}) is gone: {lines_of(error)[-1]}"
        self.is_silent = False


class RemoteGmi(WatchedGmi):
    """A GMI on another node."""

    def __init__(self, node: RemoteNode, gmi: int, paths: GmiPaths, pid: int) -> None:
        super().__init__(gmi, paths, pid)
        self._node = node
        self._error: ReportedError | None = None
        self._log_bytes = 0

    @property
    def process_name(self) -> str:
        """See `WatchedGmi`; the number means nothing on another machine."""
        return f"{self.pid} of node {self._node.address}"

    @property
    def error(self) -> ReportedError | None:
        """See `WatchedGmi`."""
        return self._error

    @property
    def log_bytes(self) -> int:
        """See `WatchedGmi`."""
        return self._log_bytes

    def poll(self) -> int | None:
        """See `WatchedGmi`."""
        if self.exit_code is not None:
            return self.exit_code
        seen: RemoteGmiStatus | None = self._node.look(self.gmi)
        self.is_silent = self._node.is_silent
        if seen is not None:
            self._record_heartbeat(seen.beats, seen.beat)
            self._error, self._log_bytes = seen.error, seen.log_bytes
            self.exit_code = seen.exit_code
        if self.exit_code is None and self._node.lost is not None:
            # Its lifeline ends with the node's actor.
            self.exit_code = -signal.SIGKILL
            self._error = ReportedError("NodeLost", self._node.lost, "")
        return self.exit_code

    def ask_to_stop(self) -> None:
        """See `WatchedGmi`."""
        self._node.order(self.gmi, "ask_to_stop")

    def order_end(self) -> None:
        """See `WatchedGmi`."""
        self._node.order(self.gmi, "order_end")

    def request_stacks(self) -> int | None:
        """See `WatchedGmi`."""
        return None if self.is_silent else self._node.call("request_stacks", self.gmi)

    def end_as_done(self) -> None:
        """See `WatchedGmi`."""
        self._node.order(self.gmi, "end_as_done")

    def kill(self) -> None:
        """See `WatchedGmi`."""
        if self.exit_code is None:
            self._node.order(self.gmi, "kill")

    def close(self) -> None:
        """Does nothing: the node drops all lifelines when the job is over."""
