"""The base class of roles: what a GMI runs (the paper's `DRL_role`, section 3, Listing 1)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from gmijax.channels.messenger import Messenger
from gmijax.errors import ConfigError
from gmijax.partition.layout import Layout
from gmijax.roles.group import GroupReducer, Operation
from gmijax.supervise.child import ChildLink


@dataclass
class Gmi:
    """This process as one of the GMIs of a job; what the methods do, see `Role`."""

    layout: Layout
    messenger: Messenger
    reducer: GroupReducer
    link: ChildLink
    steps: int = 0

    def reduce(self, data: Any, op: Operation, group: Iterable[int] | None) -> Any:
        """See `Role.collective`."""
        result = self.reducer.reduce(self.layout.gmis if group is None else group, data, op)
        self.progress(self.steps)
        return result

    def send(self, data: Any, dst: int) -> None:
        """See `Role.send`."""
        self.messenger.send(data, dst)
        self.progress(self.steps)

    def recv(self, src: int, timeout_s: float | None) -> Any:
        """See `Role.recv`."""
        data = self.messenger.recv(src, timeout_s=timeout_s)
        self.progress(self.steps)
        return data

    def progress(self, step: int) -> None:
        """See `Role.progress`."""
        self.steps = step
        self.link.beat("running", step)


# One process is one GMI, so this is as global as the process: managers that a role's module makes
# when it is loaded must find it too.
_here: list[Gmi] = []


def enter(gmi: Gmi) -> None:
    """Makes `gmi` the one that this process is."""
    _here[:] = [gmi]


def here(what: str) -> Gmi:
    """The GMI that this process is; ConfigError if it is none, so that `what` makes no sense."""
    if not _here:
        raise ConfigError(f"{what}: only inside a GMI, in the role's run; see gmijax.launch")
    return _here[0]


class Role(ABC):
    """What a GMI runs. Write `run`; the other methods are there for it.

    As with `multiprocessing.Process`, the constructor runs where the job is started and `run` in
    the GMI: the object is pickled in between. So it may hold numbers, names and numpy arrays;
    environments and other things of jax are made in `run`. The class may be one of a module, a
    script, a notebook or a function.

    Examples:
      >>> class Average(Role):
      ...     def run(self):
      ...         return self.collective(float(self.rank))

      With `gmijax.launch(gmijax.plan(gmis_per_gpu=3), Average())` that gives [1.0, 1.0, 1.0].
    """

    @abstractmethod
    def run(self, *args: Any) -> Any:
        """The routine of the GMI; `args` are what `gmijax.launch` got after the role.

        It returns anything that can be pickled; arrays of jax come back from `launch` as numpy's.
        """

    @property
    def rank(self) -> int:
        """Id of this GMI, 0 to `world_size - 1`."""
        return here("rank").messenger.rank

    @property
    def world_size(self) -> int:
        """K, number of GMIs of the job."""
        return here("world_size").layout.num_gmis

    @property
    def gpu(self) -> int:
        """Position of this GMI's GPU in the job; 0 is its first."""
        return here("gpu").layout.gpu_of(self.rank)

    @property
    def neighbours(self) -> tuple[int, ...]:
        """The GMIs on the same GPU, this one included."""
        return here("neighbours").layout.neighbours_of(self.rank)

    @property
    def stop_requested(self) -> bool:
        """Whether the user wants the job to stop (Ctrl-C): return soon.

        GMIs see it at different times; those that exchange data agree first, for example by
        `self.collective(float(self.stop_requested), "sum") > 0`.
        """
        return here("stop_requested").link.stop_requested

    def collective(
        self, data: Any, op: Operation = "mean", group: Iterable[int] | None = None
    ) -> Any:
        """The mean or the sum of `data` over GMIs, bit-identical on all of them.

        Every GMI of the group makes the same calls in the same order, with data of the same
        nesting, shapes and dtypes. Only the operation, the dtypes and how many numbers there are
        of each are compared: numbers of another nesting or shape, but as many, are combined in
        their order.

        Args:
          data: dicts, lists, tuples, NamedTuples, dataclasses with arrays of numpy or jax and
            floats. Anything else in it stays this GMI's own.
          op: `mean` or `sum`. Integers have no mean.
          group: ids of GMIs, this one included; None: all.

        Returns:
          The same nesting with arrays of numpy.

        Raises:
          PeerLost: the process of a GMI of the group is gone.
          CollectiveTimeout: a GMI did not come in time; names it.
          CollectiveError: GMIs came with another operation, or other numbers of values.
        """
        return here("collective").reduce(data, op, group)

    def send(self, data: Any, dst: int) -> None:
        """Sends `data` to GMI `dst` without waiting; `data` may be changed at once.

        Args:
          data: anything that can be pickled; arrays (of any size) travel as raw bytes, and those
            of jax stay on the GPU on their way to a GMI that shares it.
          dst: id of a GMI. Messages from one GMI to another arrive in order.

        Raises:
          PeerLost: that GMI is gone, and an earlier message could not be delivered.
        """
        here("send").send(data, dst)

    def recv(self, src: int, timeout_s: float | None = None) -> Any:
        """Waits for the next message of GMI `src`, and returns it.

        Its arrays are this GMI's own; those of jax are jax's still where they could stay on the
        GPU, and numpy's else. With `timeout_s=None` the wait is what `gmijax.launch` was given.

        Raises:
          PeerLost: that GMI is gone, and has left no message.
          CollectiveTimeout: none came in time; names the GMI.
        """
        return here("recv").recv(src, timeout_s)

    def progress(self, step: int) -> None:
        """Reports how far this GMI is, as messages and collective calls do; cheap."""
        if not isinstance(step, int | np.integer) or not 0 <= step < 2**63:
            raise ConfigError(f"step={step!r}: expected a whole number of at least 0")
        here("progress").progress(int(step))
