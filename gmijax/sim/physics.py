"""The seam to MuJoCo: MJX in JAX or in Warp, behind one `load` and one `step`.

What is carried between steps is small: only what MuJoCo needs to integrate on. A whole `mjx.Data`
is rebuilt from it inside every step, so that an automatic reset selects between a few short
vectors, checkpoints stay small, and XLA sees which intermediate results nobody reads.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx

from gmijax.errors import ConfigError
from gmijax.sim.impl import Impl, choose_impl
from gmijax.types import Array, PyTree

T = TypeVar("T")

WARP_MAX_ENVS = 16384
"""Environments that Warp's contact buffer has room for unless `make_env` is told a number."""


class PhysicsState(NamedTuple):
    """What one world must remember between steps.

    Attributes:
      qpos: [nq] float32, joint positions.
      qvel: [nv] float32, joint velocities.
      qacc_warmstart: [nv] float32, the last acceleration, where the solver starts from.
    """

    qpos: Array
    qvel: Array
    qacc_warmstart: Array


@dataclass(frozen=True)
class Physics:
    """A loaded model and the functions that move it.

    Attributes:
      impl: which MJX implementation runs.
      mj_model: the model as MuJoCo in C has it.
      model: the model on the device; pass it, or a randomised copy, to `step`.
      blank: builds the `mjx.Data` of one world at the model's reference position.
      substeps: physics steps per control step.
      max_envs: most worlds that may be stepped at once, None for no limit.
    """

    impl: Impl
    mj_model: mujoco.MjModel
    model: mjx.Model
    blank: Callable[[], mjx.Data]
    substeps: int
    max_envs: int | None = None

    @property
    def control_dt_s(self) -> float:
        """Seconds of simulated time per control step."""
        return self.mj_model.opt.timestep * self.substeps

    def start(self, qpos: Array, qvel: Array) -> PhysicsState:
        """The state of a world at `qpos` [nq], `qvel` [nv] with no history."""
        return PhysicsState(qpos, qvel, jnp.zeros_like(qvel))

    def step(
        self,
        model: PyTree,
        state: PhysicsState,
        ctrl: Array,
        read: Callable[[mjx.Data], T] = lambda data: data.sensordata,
    ) -> tuple[PhysicsState, T]:
        """Moves one world by one control step under `ctrl` [nu].

        Returns:
          The new state, and `read` of the data of the last physics step. As in MuJoCo, the
          `sensordata`, forces and body poses in it belong to the moment before that step's
          integration, `qpos` and `qvel` to the moment after it.
        """

        def substep(state: PhysicsState, _: None) -> tuple[PhysicsState, T]:
            data = mjx.step(model, self.blank().replace(ctrl=ctrl, **state._asdict()))
            return PhysicsState(data.qpos, data.qvel, data.qacc_warmstart), read(data)

        # One traced physics step, though only the last one's sensors are wanted: a second copy
        # without sensors takes half as long again to compile, and did not run faster.
        state, readings = jax.lax.scan(substep, state, length=self.substeps)
        return state, jax.tree.map(lambda reading: reading[-1], readings)


def load(asset: str, *, impl: str, substeps: int, max_envs: int | None = None) -> Physics:
    """Loads the model `asset` that is shipped in `gmijax/sim/assets`.

    Args:
      asset: name of the file without `.xml`.
      impl: `auto`, `jax` or `warp`.
      substeps: physics steps per control step.
      max_envs: upper bound of worlds simulated at once; only Warp, whose contact buffer is
        shared by all worlds, needs it. None: `WARP_MAX_ENVS`.

    Raises:
      ConfigError: `impl` cannot be had, or the model needs state that is not carried.
    """
    text = resources.files("gmijax.sim").joinpath("assets", f"{asset}.xml").read_text()
    return from_mj_model(
        mujoco.MjModel.from_xml_string(text), impl=impl, substeps=substeps, max_envs=max_envs
    )


def from_mj_model(
    mj_model: mujoco.MjModel, *, impl: str, substeps: int, max_envs: int | None = None
) -> Physics:
    """Like `load`, for a model that is already in memory."""
    if mj_model.na or mj_model.nplugin or mj_model.nhistory:
        raise ConfigError(
            f"model: {mj_model.na} activations, {mj_model.nplugin} plugins, "
            f"{mj_model.nhistory} delay samples: none of them are carried between steps; "
            "allowed are actuators without memory (motor, position, velocity)"
        )
    chosen, _ = choose_impl(impl, jax.default_backend())
    # By itself MJX takes the first device of all processes, which may be another GMI's.
    device = jax.local_devices()[0]
    model = mjx.put_model(mj_model, device=device, impl=chosen)
    if chosen == "jax":
        blank = functools.partial(mjx.make_data, model, device=device, impl=chosen)
        return Physics(chosen, mj_model, model, blank, substeps)
    # Warp prints a line per world and step when the solver meets its iteration limit. Here it is
    # meant to meet it, and printing that costs more time than simulating.
    model = model.tree_replace({"opt._impl.warn_overflow": 0})
    max_envs = max_envs or WARP_MAX_ENVS
    return Physics(chosen, mj_model, model, _warp_blank(mj_model, max_envs), substeps, max_envs)


def _warp_blank(mj_model: mujoco.MjModel, max_envs: int) -> Callable[[], mjx.Data]:
    # MJX-JAX keeps a row for every contact and constraint that can ever be, so its sizes are
    # the bounds of Warp's buffers: contacts are shared by all worlds, rows are per world.
    device = jax.local_devices()[0]
    bounds = mjx.make_data(mj_model, device=device, impl="jax")._impl
    template = mjx.make_data(
        mj_model,
        device=device,
        impl="warp",
        naconmax=max(bounds.ncon, 1) * max_envs,
        njmax=max(bounds.nefc, 1),
    )
    leaves, tree = jax.tree.flatten(template)
    # Zeros are made where they are used: as constants of the compiled program they would be
    # tens of megabytes.
    kept = [
        jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) if not jnp.any(leaf) else leaf
        for leaf in leaves
    ]

    def blank() -> mjx.Data:
        return jax.tree.unflatten(
            tree,
            [
                jnp.zeros(leaf.shape, leaf.dtype)
                if isinstance(leaf, jax.ShapeDtypeStruct)
                else leaf
                for leaf in kept
            ],
        )

    return blank
