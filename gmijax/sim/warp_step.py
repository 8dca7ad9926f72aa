"""A control step of MuJoCo Warp as one call from JAX: its data stay with Warp, as one CUDA graph.

`mjx.step` hands all of MuJoCo's data, 170 arrays, from JAX to Warp and back in every physics step
(docs/decisions/sim-warp-step.md). Here JAX hands over what a world must remember and what drives
it, in one buffer, and gets back what has become of it and what the task reads.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import mujoco
import warp
from mujoco.mjx.third_party import mujoco_warp

from gmijax.config.env import RANDOMIZED_LEAVES
from gmijax.sim.impl import WarpSizes
from gmijax.types import Array, PyTree

T = TypeVar("T")

Arrays: TypeAlias = dict[str, Array]
Shapes: TypeAlias = tuple[tuple[str, tuple[int, ...]], ...]

STATE = ("qpos", "qvel", "qacc_warmstart")
"""What goes in and comes out."""

OVERFLOW = "overflow"
"""Bits that tell which buffers were too small; they always come out."""

MODEL_LEAVES = (
    *RANDOMIZED_LEAVES,
    *("body_inertia", "body_subtreemass", "body_invweight0", "dof_invweight0"),
    *("tendon_invweight0", "actuator_biasprm"),
)
"""Leaves of a model that may differ from those it was loaded with: what is drawn, and what follows
from it. All others are read once."""

_ALIGNED = 64
"""Arrays begin at multiples of so many floats: Warp's tiles load several at once."""


class Piece(NamedTuple):
    """An array in the buffer: its shape, worlds first, and where it begins, in floats."""

    shape: tuple[int, ...]
    start: int

    @property
    def size(self) -> int:
        """Floats."""
        return math.prod(self.shape)

    @property
    def end(self) -> int:
        """Where the next one may begin."""
        return -(-(self.start + self.size) // _ALIGNED) * _ALIGNED


class Layout(NamedTuple):
    """The buffer of N worlds: what is given, then what is taken; the state is both.

    Attributes:
      given: controls, leaves of the model, state.
      taken: state, overflow, what the task reads.
    """

    given: dict[str, Piece]
    taken: dict[str, Piece]

    @property
    def num_given(self) -> int:
        """Floats from the beginning on that are given."""
        return self.given[STATE[-1]].end

    @property
    def first_taken(self) -> int:
        """Where the part begins that is taken; it goes on to the end."""
        return self.taken[STATE[0]].start

    @property
    def size(self) -> int:
        """Floats in all."""
        return max(piece.end for piece in self.taken.values())


def lay_out(given: Shapes, taken: Shapes) -> Layout:
    """The layout of arrays with these names and shapes; `STATE` is last in one, first in other."""
    pieces: dict[str, Piece] = {}
    end = 0
    for name, shape in (*given, *(piece for piece in taken if piece[0] not in STATE)):
        pieces[name] = Piece(shape, end)
        end = pieces[name].end
    return Layout(*({name: pieces[name] for name, _ in part} for part in (given, taken)))


@dataclass(frozen=True, eq=False)
class WarpStep:
    """Control steps of a model, for any number of worlds.

    Attributes:
      mj_model: the model.
      substeps: physics steps of a control step.
      sizes: of the buffers for contacts and constraints.
      shapes: of the arrays that the data have for each world, by name.
    """

    mj_model: mujoco.MjModel
    substeps: int
    sizes: WarpSizes
    shapes: Mapping[str, tuple[int, ...]]

    @classmethod
    def load(cls, mj_model: mujoco.MjModel, substeps: int, sizes: WarpSizes) -> WarpStep:
        """Raises NotImplementedError or ValueError for a model that MuJoCo Warp refuses."""
        with warp.ScopedDevice("cpu"):
            mujoco_warp.put_model(mj_model)
            data = mujoco_warp.make_data(mj_model, nworld=1)
        arrays = {
            name: (*array.shape[1:], *getattr(array.dtype, "_shape_", ()))
            for name, array in vars(data).items()
            if isinstance(array, warp.array) and array.shape[:1] == (1,)
        }
        return cls(mj_model, substeps, sizes, arrays)

    def __call__(
        self, model: PyTree, state: Arrays, ctrl: Array, read: Callable[[Any], T]
    ) -> tuple[Arrays, T]:
        """Moves one world; under `jax.vmap` all that there are, in one call.

        Args:
          model: an `mjx.Model`, of which `MODEL_LEAVES` count.
          state: the arrays of `STATE`.
          ctrl: [nu].
          read: what the task wants of the data, which have the arrays of `mujoco_warp.Data` with
            numbers of 32 bits for each world.

        Returns:
          The state with `OVERFLOW` [] int32, and `read` of the data.
        """
        wanted: list[str] = []
        jax.eval_shape(lambda: read(Readings(functools.partial(self._noted, wanted))))
        reads = tuple(dict.fromkeys(name for name in wanted if name not in STATE))
        leaves = {name: getattr(model, name) for name in MODEL_LEAVES}
        given = {"ctrl": ctrl, **{name: leaf for name, leaf in leaves.items() if leaf.size}}
        alone = {name: array[None] for name, array in (given | state).items()}
        out = {name: array[0] for name, array in self._mapped(reads)(alone).items()}
        return {name: out[name] for name in (*STATE, OVERFLOW)}, read(Readings(out.__getitem__))

    def _noted(self, wanted: list[str], name: str) -> Array:
        if name not in self.shapes:
            raise AttributeError(f"data.{name}: MuJoCo Warp has no such array for each world")
        wanted.append(name)
        return jnp.zeros(self.shapes[name])

    def _mapped(self, reads: tuple[str, ...]) -> Callable[[Arrays], Arrays]:
        """`_launch`; a map over it makes one call of more worlds."""

        @jax.custom_batching.custom_vmap
        def launch(given: Arrays) -> Arrays:
            return self._launch(reads, given)

        @launch.def_vmap
        def _(size: int, is_mapped: list[dict[str, bool]], given: Arrays) -> Any:
            count = given["qpos"].shape[int(is_mapped[0]["qpos"])]
            out = launch(
                {
                    name: _folded(name, array, size, count, is_mapped[0][name])
                    for name, array in given.items()
                }
            )
            unfolded = {name: x.reshape(size, count, *x.shape[1:]) for name, x in out.items()}
            return unfolded, dict.fromkeys(unfolded, True)

        return launch

    def _launch(self, reads: tuple[str, ...], given: Arrays) -> Arrays:
        """Steps N worlds; arrays have a leading axis [N], leaves that worlds share [1]."""
        worlds = given["qpos"].shape[0]
        first = [name for name in given if name not in STATE]
        layout = lay_out(
            tuple((name, given[name].shape) for name in (*first, *STATE)),
            tuple((name, (worlds, *self.shapes[name])) for name in (*STATE, OVERFLOW, *reads)),
        )
        parts = [
            jnp.pad(given[name].reshape(-1), (0, piece.end - piece.start - piece.size))
            for name, piece in layout.given.items()
        ]
        (out,) = _target(self, *map(_frozen, layout))(jnp.concatenate(parts))
        found = {
            name: out[piece.start - layout.first_taken :][: piece.size].reshape(piece.shape)
            for name, piece in layout.taken.items()
        }
        return found | {OVERFLOW: jax.lax.bitcast_convert_type(found[OVERFLOW], jnp.int32)}


class Readings:
    """Stands for the data where a task reads them; every attribute is an array of one world."""

    def __init__(self, array: Callable[[str], Array]) -> None:
        self._array = array

    def __getattr__(self, name: str) -> Array:
        return self._array(name)


def _folded(name: str, array: Array, size: int, count: int, is_mapped: bool) -> Array:
    """An array of `size` times `count` worlds; of a leaf that worlds share it stays the only row."""
    if not is_mapped:
        if name in MODEL_LEAVES and array.shape[0] == 1:
            return array
        array = array[None]
    rest = array.shape[2:]
    return jnp.broadcast_to(array, (size, count, *rest)).reshape(size * count, *rest)


def _frozen(pieces: Mapping[str, Piece]) -> tuple[tuple[str, Piece], ...]:
    return tuple(pieces.items())


@functools.cache
def _target(source: WarpStep, given: Any, taken: Any) -> Callable[[Array], list[Array]]:
    """What a program calls: from the part of the buffer that is given to the one that is taken."""
    layout = Layout(dict(given), dict(taken))
    num_worlds = layout.given["qpos"].shape[0]
    worlds: list[Worlds] = []

    def control_step(given: Any, taken: Any) -> None:
        if not worlds:  # Only now Warp knows the device.
            worlds.append(Worlds(source, layout, num_worlds))
        worlds[0].step(given, taken)

    vector = warp.array(dtype=float)
    control_step.__annotations__ = {"given": vector, "taken": vector}
    # Programs contain the name, and all GMIs of a job shall have the same ones.
    name = source.mj_model.names.split(b"\0")[0].decode()
    control_step.__qualname__ = f"control_step_{name}_{num_worlds}"
    target: Callable[[Array], list[Array]] = warp.jax_callable(
        control_step,
        graph_mode=warp.JaxCallableGraphMode.NONE,  # `Worlds` has the graph.
        output_dims={"taken": layout.size - layout.first_taken},
    )
    return target


class Worlds:
    """N worlds of MuJoCo Warp on Warp's current device.

    Args:
      source: what they are worlds of.
      layout: of the buffer.
      num_worlds: N.
    """

    def __init__(self, source: WarpStep, layout: Layout, num_worlds: int) -> None:
        own = {
            name: num_worlds
            for name in MODEL_LEAVES
            if name in layout.given and layout.given[name].shape[0] == num_worlds > 1
        }
        self._model = mujoco_warp.put_model(source.mj_model, batch_sizes=own)
        # Our tasks have two to four iterations, before which no solver is done: asking whether all
        # are done, after each of them, costs a tenth of the physics.
        self._model.opt.graph_conditional = False
        # That they reach the limit is meant; Warp would print a line for each world and step.
        self._model.opt.warn_overflow = 0
        self._data = mujoco_warp.make_data(
            source.mj_model,
            nworld=num_worlds,
            naconmax=max(int(source.sizes.contacts_per_env), 1) * num_worlds,
            njmax=max(int(source.sizes.constraints_per_env), 1),
        )
        self._substeps = source.substeps
        self._buffer = warp.zeros(layout.size, dtype=float)
        for name, piece in {**layout.given, **layout.taken}.items():
            self._move(self._model if name in MODEL_LEAVES else self._data, name, piece)
        self._given = self._buffer[: layout.num_given]
        self._taken = self._buffer[layout.first_taken :]
        self._graph: Any = None

    def _move(self, owner: Any, name: str, piece: Piece) -> None:
        """Puts an array of the model or of the data into the buffer."""
        old = getattr(owner, name)
        if piece.size:
            address = self._buffer.ptr + 4 * piece.start
            new = warp.array(ptr=address, dtype=old.dtype, shape=old.shape, device=old.device)
            warp.copy(new, old)
            setattr(owner, name, new)

    def step(self, given: Any, taken: Any) -> None:
        """One control step; on a GPU its current stream gets the work."""
        warp.copy(self._given, given)
        if not self._buffer.device.is_cuda:
            self._advance()
        else:
            if self._graph is None:
                self._advance()  # Loads the kernels. Then from the start again.
                warp.copy(self._given, given)
                with warp.ScopedCapture() as capture:
                    self._advance()
                self._graph = capture.graph
            warp.capture_launch(self._graph)
        warp.copy(taken, self._taken)

    def _advance(self) -> None:
        self._data.time.zero_()
        self._data.overflow.zero_()
        for _ in range(self._substeps):
            mujoco_warp.step(self._model, self._data)
