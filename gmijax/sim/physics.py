"""The seam to MuJoCo: MJX in JAX or in Warp, behind one `load` and one `step`.

What is carried between steps is small: only what MuJoCo needs to integrate on. MJX-JAX rebuilds a
whole `mjx.Data` from it inside every control step, and MJX-Warp keeps its own, so an automatic
reset selects between a few short vectors, and checkpoints stay small.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx
from numpy.typing import NDArray

from gmijax.errors import ConfigError
from gmijax.sim import carried
from gmijax.sim.impl import Impl, WarpSizes, choose_impl
from gmijax.sim.interface import OVERFLOWS, Env, EnvSpec, EnvState
from gmijax.sim.kinematic_model import kinematic_model
from gmijax.sim.many_contacts import warn_of_many
from gmijax.sim.physics_state import PhysicsState
from gmijax.sim.plain_model import plain
from gmijax.sim.unsimulated import (
    FULL_NAMES,
    refuse_idle_sensors,
    refuse_parts,
)
from gmijax.sim.warp.batch import OVERFLOW, STATE, name_of
from gmijax.sim.warp.kernels import compile_kernels
from gmijax.sim.warp.step import WarpStep, moving
from gmijax.types import Array, PRNGKey, PyTree

T = TypeVar("T")

CONSTRAINT_BITS, LIMIT_BITS, ALL_BITS = 0x003, 0x620, 0xFFF
"""Bits of MJX-Warp's `overflow`: what did not fit, and limits that are meant: of iterations, and
of triangles of a height field below one geom, which MuJoCo in C has too."""
CONTACT_BITS = ALL_BITS & ~(CONSTRAINT_BITS | LIMIT_BITS)


def which_overflowed(bits: Array) -> Array:
    """[2] bool, which of `OVERFLOWS` were too small, by one environment's `overflow` []."""
    return (bits & jnp.array([CONTACT_BITS, CONSTRAINT_BITS])) != 0


@dataclass(frozen=True)
class Physics:
    """A loaded model and the functions that move it.

    Attributes:
      impl: which MJX implementation runs.
      mj_model: the model as MuJoCo in C has it.
      model: the model on the device; pass it, or a randomised copy, to `step`.
      substeps: physics steps per control step.
      max_envs: most environments that may be stepped at once, None for no limit.
      warp: the control step of MuJoCo Warp; None with MJX-JAX.
    """

    impl: Impl
    mj_model: mujoco.MjModel
    model: mjx.Model
    substeps: int
    max_envs: int | None = None
    warp: WarpStep | None = None

    @property
    def control_dt_s(self) -> float:
        """Seconds of simulated time per control step."""
        return self.mj_model.opt.timestep * self.substeps

    def start(self, qpos: Array, qvel: Array, **given: Array) -> PhysicsState:
        """The state of an environment at `qpos` [nq], `qvel` [nv] with no history.

        What only a physics step knows, such as sensors, is not computed: an automatic reset
        happens, under `where`, in every step of every environment.

        `given` is what the environment carries beside that, by the names of `PhysicsState`. What
        is not given stays as the model has it, but for activations, which begin at zero.

        Raises:
          ConfigError: a name or a shape that the model does not have.
        """
        overflow = None if self.impl == "jax" else jnp.zeros(len(OVERFLOWS), bool)
        rest = carried.at_start(self.mj_model, given)
        return PhysicsState(qpos, qvel, jnp.zeros_like(qvel), overflow, **rest)

    def poses(self, qpos: Array) -> tuple[Array, Array]:
        """Where all bodies are at `qpos` [nq]: for resets, which run no physics.

        Always in MJX-JAX and with the model as it was loaded: what is not read of it is never
        computed.

        Returns:
          Positions [nbody, 3] in metres and unit quaternions [nbody, 4], both in the world, as
          `xpos` and `xquat` of the data that `step` lets its caller read.
        """
        data = mjx.make_data(self.model).replace(qpos=qpos)
        data = mjx.kinematics(self.model, data)
        return data.xpos, data.xquat

    def shown(self, state: PhysicsState) -> Array:
        """[nq], or [nq + 7 nmocap] where mocap bodies move: what a picture needs."""
        if state.mocap_pos is None and state.mocap_quat is None:
            return state.qpos
        there, turned = mocap_poses(self.mj_model)
        pos = jnp.asarray(there, jnp.float32) if state.mocap_pos is None else state.mocap_pos
        quat = jnp.asarray(turned, jnp.float32) if state.mocap_quat is None else state.mocap_quat
        return jnp.concatenate([state.qpos, pos.reshape(-1), quat.reshape(-1)])

    def step(
        self,
        model: PyTree,
        state: PhysicsState,
        ctrl: Array,
        read: Callable[[mjx.Data], T] = lambda data: data.sensordata,
    ) -> tuple[PhysicsState, T]:
        """Moves one environment by one control step under `ctrl` [nu].

        With MJX-Warp `model` may differ from the loaded one in `MODEL_LEAVES` of
        `gmijax.sim.warp.batch` only, and `read` sees the arrays of the data that have float32
        numbers for each environment.

        Returns:
          The new state, and `read` of the data of the last physics step. As in MuJoCo, the
          `sensordata`, forces and body poses in it belong to the moment before that step's
          integration, `qpos` and `qvel` to the moment after it.
        """
        before = {**{name: getattr(state, name) for name in STATE}, **state.carried()}
        if missing := [name for name in carried.needed(self.mj_model) if name not in before]:
            raise ConfigError(f"sim.step: the state has no {missing[0]}, which sim.start gives")
        if self.warp is not None:
            after, reading = self.warp(model, before, ctrl, read)
            overflow = which_overflowed(after.pop(OVERFLOW))
            return state._replace(**after, overflow=overflow), reading

        def substep(data: mjx.Data, _: None) -> tuple[mjx.Data, None]:
            return mjx.step(model, data), None

        # One traced physics step: a second copy takes half as long again to compile, and was not
        # faster.
        data = mjx.make_data(self.model).replace(ctrl=ctrl, **before)
        data, _ = jax.lax.scan(substep, data, length=self.substeps)
        return state._replace(**{name: getattr(data, name) for name in moving(before)}), read(data)

    def env(
        self,
        spec: EnvSpec,
        reset: Callable[[PyTree, PRNGKey], EnvState],
        step: Callable[[PyTree, EnvState, Array], EnvState],
    ) -> Env:
        """The environment whose `EnvState.physics` is this environment's `PhysicsState`."""
        return Env(
            spec=spec,
            model=self.model,
            reset=reset,
            step=step,
            mj_model=self.mj_model,
            qpos=lambda state: self.shown(state.physics),
            max_envs=self.max_envs,
            overflow=None if self.impl == "jax" else lambda state: state.physics.overflow,
        )


def mocap_poses(mj_model: mujoco.MjModel) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Positions [nmocap, 3] and quaternions [nmocap, 4] of mocap bodies as the model has them."""
    data = mujoco.MjData(mj_model)
    return data.mocap_pos.copy(), data.mocap_quat.copy()


def from_mj_model(
    mj_model: mujoco.MjModel,
    *,
    impl: str,
    substeps: int,
    max_envs: int | None = None,
    warp_sizes: WarpSizes | None = None,
) -> Physics:
    """A model with its simulator.

    Args:
      mj_model: the model.
      impl: `auto`, `jax` or `warp`.
      substeps: physics steps per control step.
      max_envs: upper bound of environments simulated at once, None for no limit.
      warp_sizes: of Warp's buffers; None: for what the model's geoms can make, up to a number of
        contacts (`gmijax.sim.warp.sizes`).

    Raises:
      ConfigError: `impl` cannot be had, or the model needs state that is not carried.
    """
    chosen, _ = choose_impl(impl, jax.default_backend())
    mj_model, name = plain(mj_model), name_of(mj_model)
    refuse_parts(mj_model, chosen)
    if chosen == "warp":
        with _refusing(mj_model, chosen):
            warp = WarpStep.load(mj_model, substeps, warp_sizes)
            model = kinematic_model(mj_model)
        if warp_sizes is None and warp.bounds is not None:
            warn_of_many(name, chosen, *warp.bounds[:2], warp.sizes)
        compile_kernels(mj_model)
        return Physics(chosen, mj_model, model, substeps, max_envs, warp)
    with _refusing(mj_model, chosen):
        model = mjx.put_model(mj_model, impl="jax")
        # It finds what `put_model` does not.
        data = jax.eval_shape(lambda: mjx.make_data(model))
    refuse_idle_sensors(mj_model, data._impl.ncon, data._impl.nefc)
    warn_of_many(name, chosen, data._impl.ncon, data._impl.nefc)
    return Physics(chosen, mj_model, model, substeps)


@contextmanager
def _refusing(mj_model: mujoco.MjModel, impl: Impl) -> Iterator[None]:
    try:
        yield
    except (NotImplementedError, ValueError) as error:
        others = "; physics.impl=warp may: MuJoCo Warp simulates more" if impl == "jax" else ""
        raise ConfigError(
            f"physics.impl={impl}: {FULL_NAMES[impl]} cannot simulate the model "
            f"{name_of(mj_model)}: {' '.join(str(error).split())}{others}"
        ) from None
