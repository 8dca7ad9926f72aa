"""A batch of environments in Warp's memory, and the buffer through which JAX steps them.

The package warp-lang is optional, and MJX has tried to import it: hence `mjx_warp.warp`.
"""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple, TypeAlias

import mujoco
from mujoco.mjx import warp as mjx_warp

from gmijax.config.env import RANDOMIZED_LEAVES
from gmijax.devices import PEAKS_BESIDE_JAX
from gmijax.sim.impl import WarpSizes

Shapes: TypeAlias = tuple[tuple[str, tuple[int, ...]], ...]
"""Names of arrays and their shapes, in order."""

STATE = ("qpos", "qvel", "qacc_warmstart")
"""Arrays of the data that every model has; they go in and come out."""

MOVED = ("act", "time", "history")
"""Those that go in and come out where they are carried (see `gmijax.sim.carried`)."""

SWITCHES = "eq_active"
"""The array of the data that is bool: what goes in as floats is copied into it."""

OVERFLOW = "overflow"
"""The array of the data with bits for buffers that were too small; it always comes out."""

MODEL_LEAVES = (
    *RANDOMIZED_LEAVES,
    *("body_inertia", "body_subtreemass", "body_invweight0", "dof_invweight0"),
    *("tendon_invweight0", "actuator_biasprm"),
)
"""Leaves of a model that may differ from the loaded one: what is drawn, and what follows from it.
They go in; all others are read once."""

_ALIGNED = 64
"""Arrays begin at multiples of so many floats: tiles of Warp load several floats at once."""

_UNASKED = 8
"""Up to so many iterations of the solver are done without asking after each of them whether all
environments have an answer: a GPU waits for that, and of two to four, as in our tasks, it saves
none."""


class BufferField(NamedTuple):
    """An array in the buffer: its shape, environments first, and where it begins, in floats."""

    shape: tuple[int, ...]
    start: int

    @property
    def size(self) -> int:
        """Floats."""
        return math.prod(self.shape)

    @property
    def gap(self) -> int:
        """Floats between its end and the next array."""
        return -self.size % _ALIGNED

    @property
    def end(self) -> int:
        """Where the next array begins."""
        return self.start + self.size + self.gap


class BufferLayout(NamedTuple):
    """The buffer of N environments: from its beginning on what goes in, to its end what comes out.

    The two parts overlap in the state.

    Attributes:
      given: controls, leaves of the model, what drives the environments, state.
      taken: state, overflow, what the task reads.
    """

    given: dict[str, BufferField]
    taken: dict[str, BufferField]

    @property
    def num_given(self) -> int:
        """Floats that go in."""
        return max(field.end for field in self.given.values())

    @property
    def first_taken(self) -> int:
        """Where the part that comes out begins."""
        return self.taken[STATE[0]].start

    @property
    def size(self) -> int:
        """Floats in all."""
        return max(field.end for field in self.taken.values())


def lay_out(given: Shapes, state: Shapes, taken: Shapes) -> BufferLayout:
    """The layout of what goes in, of what goes in and comes out, and of what comes out."""
    fields: dict[str, BufferField] = {}
    end = 0
    for name, shape in (*given, *state, *taken):
        fields[name] = BufferField(shape, end)
        end = fields[name].end
    parts = ((*given, *state), (*state, *taken))
    return BufferLayout(*({name: fields[name] for name, _ in part} for part in parts))


def name_of(mj_model: mujoco.MjModel) -> str:
    """The model's own name, which comes first of all names."""
    return mj_model.names.split(b"\0")[0].decode()


class WarpBatch:
    """N environments on Warp's current device.

    Args:
      mj_model: their model.
      substeps: physics steps of a control step.
      sizes: of the buffers for contacts and constraints.
      layout: of the buffer.

    Attributes:
      model: MuJoCo Warp's.
    """

    def __init__(
        self, mj_model: mujoco.MjModel, substeps: int, sizes: WarpSizes, layout: BufferLayout
    ) -> None:
        mujoco_warp = mjx_warp.mujoco_warp
        count = layout.given["qpos"].shape[0]
        leaves = {name: layout.given[name] for name in MODEL_LEAVES if name in layout.given}
        own = {name: count for name, field in leaves.items() if field.shape[0] == count > 1}
        self.model: Any = mujoco_warp.put_model(mj_model, batch_sizes=own)
        self.model.opt.graph_conditional = mj_model.opt.iterations > _UNASKED
        # Reaching that limit is meant; Warp would print a line for each world and step.
        self.model.opt.warn_overflow = 0
        self._data: Any = mujoco_warp.make_data(
            mj_model,
            nworld=count,
            naconmax=max(int(sizes.contacts_per_env), 1) * count,
            njmax=max(int(sizes.constraints_per_env), 1),
        )
        self._substeps = substeps
        self._buffer: Any = mjx_warp.warp.zeros(layout.size, dtype=float)
        self._switches: Any = None
        self._keeps_time = "time" in layout.given
        for name, field in {**layout.given, **layout.taken}.items():
            if name == SWITCHES:
                floats = self._buffer[field.start : field.start + field.size]
                self._switches = floats, self._data.eq_active.flatten()
            else:
                self._move(self.model if name in leaves else self._data, name, field)
        self._given: Any = self._buffer[: layout.num_given]
        self._taken: Any = self._buffer[layout.first_taken :]
        self._graph: Any = None
        if self._buffer.device.is_mempool_supported:
            count_memory(self._buffer.device.alias)

    def _move(self, owner: Any, name: str, field: BufferField) -> None:
        """Puts an array of the model or of the data into the buffer."""
        if not field.size:
            return
        old = getattr(owner, name)
        assert old.size * mjx_warp.warp.types.type_size_in_bytes(old.dtype) == 4 * field.size, name
        new = mjx_warp.warp.array(
            ptr=self._buffer.ptr + 4 * field.start,
            dtype=old.dtype,
            shape=old.shape,
            device=old.device,
        )
        mjx_warp.warp.copy(new, old)
        setattr(owner, name, new)

    def step(self, given: Any, taken: Any) -> None:
        """One control step, from one array of Warp to another; on a GPU only queued."""
        warp = mjx_warp.warp
        warp.copy(self._given, given)
        if self._graph is None and self._buffer.device.is_cuda:
            self._capture()
            warp.copy(self._given, given)
        self.advance()
        warp.copy(taken, self._taken)

    def advance(self) -> None:
        """One control step of what is in the buffer."""
        if self._graph is None:
            self._compute()
        else:
            mjx_warp.warp.capture_launch(self._graph)

    def _capture(self) -> None:
        self._compute()  # Loads all kernels.
        with mjx_warp.warp.ScopedCapture() as capture:
            self._compute()
        self._graph = capture.graph

    def _compute(self) -> None:
        if not self._keeps_time:
            self._data.time.zero_()
        if self._switches is not None:
            mjx_warp.warp.utils.array_cast(*self._switches)
        self._data.overflow.zero_()
        # Rows without a constraint are multiplied by zero, which does not help against infinity.
        self._data.efc.J.zero_()
        for _ in range(self._substeps):
            mjx_warp.mujoco_warp.step(self.model, self._data)


@functools.cache
def count_memory(device: str) -> None:
    """Adds Warp's memory to that of JAX, once for each device."""
    PEAKS_BESIDE_JAX.append(functools.partial(mjx_warp.warp.get_mempool_used_mem_high, device))
