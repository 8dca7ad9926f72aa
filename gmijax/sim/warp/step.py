"""A control step of MuJoCo Warp as one call of a JAX program.

JAX hands over what drives the environments and what they must remember, as one array, and gets
back what has become of it and what the task reads. All else of MuJoCo's data stays with Warp
(docs/decisions/sim-warp-step.md).
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import mujoco
from mujoco.mjx import warp as mjx_warp

from gmijax.sim.impl import WarpSizes
from gmijax.sim.warp.batch import (
    MODEL_LEAVES,
    MOVED,
    OVERFLOW,
    STATE,
    BufferField,
    BufferLayout,
    WarpBatch,
    lay_out,
    name_of,
)
from gmijax.sim.warp.sizes import Bounds, bounds_of
from gmijax.types import Array, PyTree

T = TypeVar("T")

Arrays: TypeAlias = dict[str, Array]


@dataclass(frozen=True, eq=False)
class WarpStep:
    """Control steps of a model, for any number of environments.

    Attributes:
      mj_model: the model.
      substeps: physics steps of a control step.
      sizes: of the buffers for contacts and constraints.
      shapes: of the arrays that MuJoCo Warp's data have for each environment, by name.
      bounds: what no state of an environment can exceed; None if not requested.
    """

    mj_model: mujoco.MjModel
    substeps: int
    sizes: WarpSizes
    shapes: Mapping[str, tuple[int, ...]]
    bounds: Bounds | None = None

    @classmethod
    def load(
        cls, mj_model: mujoco.MjModel, substeps: int, sizes: WarpSizes | None = None
    ) -> WarpStep:
        """The control step of a model; without `sizes` the buffers are as large as it needs.

        Raises:
          NotImplementedError, ValueError: MuJoCo Warp refuses the model.
        """
        warp = mjx_warp.warp
        with warp.ScopedDevice("cpu"):
            bounds = bounds_of(mj_model, mjx_warp.mujoco_warp.put_model(mj_model))
            data = mjx_warp.mujoco_warp.make_data(mj_model, nworld=1)
        shapes = {
            name: (*array.shape[1:], *getattr(array.dtype, "_shape_", ()))
            for name, array in vars(data).items()
            if isinstance(array, warp.array)
            and array.shape[:1] == (1,)
            and getattr(array.dtype, "_wp_scalar_type_", array.dtype) is warp.float32
        }
        return cls(mj_model, substeps, sizes or bounds.sizes, {**shapes, OVERFLOW: ()}, bounds)

    def __call__(
        self, model: PyTree, state: Arrays, ctrl: Array, read: Callable[[Any], T]
    ) -> tuple[Arrays, T]:
        """Moves one environment; under `jax.vmap` all of them, in one call.

        Args:
          model: an `mjx.Model`, of which `MODEL_LEAVES` count.
          state: the arrays of `STATE`, and what else is carried, by name.
          ctrl: [nu].
          read: what the task wants of the data afterwards. They have the arrays of
            `mujoco_warp.Data` that have float32 numbers for each environment.

        Returns:
          The arrays of `STATE` and `MOVED` that it was given, `OVERFLOW` [] int32, and what `read`
          returns.
        """
        wanted: list[str] = []
        jax.eval_shape(lambda: read(Readings(functools.partial(self._noted, wanted))))
        drives = {"ctrl": ctrl, **state}
        reads = tuple(dict.fromkeys(name for name in wanted if name not in drives))
        leaves = {name: getattr(model, name) for name in MODEL_LEAVES}
        given = {"ctrl": ctrl, **{n: leaf for n, leaf in leaves.items() if leaf.size}, **state}
        alone = {name: array[None] for name, array in given.items()}
        out = {name: array[0] for name, array in self._over_envs(reads)(alone).items()}
        reading = read(Readings((drives | out).__getitem__))
        return {name: out[name] for name in (*moving(state), OVERFLOW)}, reading

    def _noted(self, wanted: list[str], name: str) -> Array:
        if name not in self.shapes or name == OVERFLOW:
            raise AttributeError(f"data.{name}: MuJoCo Warp has no such array for each world")
        wanted.append(name)
        return jnp.zeros(self.shapes[name])

    def _over_envs(self, reads: tuple[str, ...]) -> Callable[[Arrays], Arrays]:
        """`launch` as a function over which `jax.vmap` makes one call of more environments."""

        @jax.custom_batching.custom_vmap
        def call(given: Arrays) -> Arrays:
            return self.launch(reads, given)

        @call.def_vmap
        def _(size: int, is_mapped: list[dict[str, bool]], given: Arrays) -> Any:
            (mapped,) = is_mapped
            count = given["qpos"].shape[int(mapped["qpos"])]
            folded = {
                name: _folded(name, array, (size, count), mapped[name])
                for name, array in given.items()
            }
            out = {name: x.reshape(size, count, *x.shape[1:]) for name, x in call(folded).items()}
            return out, dict.fromkeys(out, True)

        return call

    def launch(self, reads: tuple[str, ...], given: Arrays) -> Arrays:
        """Steps N environments.

        Args:
          reads: names of arrays of the data, beside those that it is given.
          given: arrays with a leading axis [N]; leaves that environments share have [1].
        """
        count = given["qpos"].shape[0]
        state = moving(given)
        layout = lay_out(
            tuple((name, array.shape) for name, array in given.items() if name not in state),
            tuple((name, given[name].shape) for name in state),
            tuple((name, (count, *self.shapes[name])) for name in (OVERFLOW, *reads)),
        )
        (out,) = _target(self, *(tuple(part.items()) for part in layout))(joined(layout, given))
        found = {
            name: out[field.start - layout.first_taken :][: field.size].reshape(field.shape)
            for name, field in layout.taken.items()
        }
        return found | {OVERFLOW: jax.lax.bitcast_convert_type(found[OVERFLOW], jnp.int32)}


class Readings:
    """Stands for the data where a task reads them; attributes are arrays of one environment."""

    def __init__(self, array: Callable[[str], Array]) -> None:
        self._array = array

    def __getattr__(self, name: str) -> Array:
        return self._array(name)


def moving(given: Mapping[str, Array]) -> tuple[str, ...]:
    """Names of what goes in and comes out, of what is `given`."""
    return tuple(name for name in (*STATE, *MOVED) if name in given)


def joined(layout: BufferLayout, given: Mapping[str, Array]) -> Array:
    """The part of the buffer that goes in."""
    return jnp.concatenate(
        [
            jnp.pad(given[name].reshape(-1).astype(jnp.float32), (0, field.gap))
            for name, field in layout.given.items()
        ]
    )


def _folded(name: str, array: Array, shape: tuple[int, int], is_mapped: bool) -> Array:
    """An array of K times N environments, `shape`; a leaf that all share keeps its only row."""
    if not is_mapped:
        if name in MODEL_LEAVES and array.shape[0] == 1:
            return array
        array = array[None]
    rest = array.shape[2:]
    return jnp.broadcast_to(array, (*shape, *rest)).reshape(shape[0] * shape[1], *rest)


Pieces: TypeAlias = tuple[tuple[str, BufferField], ...]


@functools.cache
def _target(source: WarpStep, given: Pieces, taken: Pieces) -> Callable[[Array], Any]:
    """What a program calls: from the part of the buffer that goes in to the one that comes out."""
    layout = BufferLayout(dict(given), dict(taken))
    batches: dict[str, WarpBatch] = {}

    def control_step(given: Any, taken: Any) -> None:
        device = given.device.alias
        if device not in batches:
            batches[device] = WarpBatch(source.mj_model, source.substeps, source.sizes, layout)
        batches[device].step(given, taken)

    vector = mjx_warp.warp.array(dtype=float)
    control_step.__annotations__ = {"given": vector, "taken": vector}
    # The name is part of a program, and all GMIs of a job must have the same program.
    control_step.__qualname__ = (
        f"control_step_{name_of(source.mj_model)}_{layout.given['qpos'].shape[0]}"
    )
    return mjx_warp.warp.jax_callable(
        control_step,
        graph_mode=mjx_warp.warp.JaxCallableGraphMode.NONE,  # `WarpBatch` has the graph.
        output_dims={"taken": layout.size - layout.first_taken},
    )
