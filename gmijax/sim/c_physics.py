"""One environment in MuJoCo in C and numpy, behind what tasks use of `gmijax.sim.physics.Physics`.

So the functions of a task, which run on numpy as on JAX, play it without jax. Positions and
velocities are float64 here, and all contacts count, so trajectories part from those of MJX within
a second; distributions of returns do not.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any, TypeVar

import mujoco
import numpy as np
import numpy.typing as npt

from gmijax.sim import carried
from gmijax.sim.interface import Env, EnvSpec, EnvState
from gmijax.sim.physics_state import PhysicsState

T = TypeVar("T")
Floats = npt.NDArray[np.floating[Any]]


class CPhysics:
    """A model and its one `mujoco.MjData`, which every step leaves as MuJoCo does.

    Forces in `data.xfrc_applied` and `data.qfrc_applied` act in every step until they are changed.

    Attributes:
      mj_model: the model.
      data: its data.
      substeps: physics steps per control step.
    """

    def __init__(self, mj_model: mujoco.MjModel, substeps: int) -> None:
        if missing := carried.needed(mj_model):
            raise NotImplementedError(f"MuJoCo in C: {missing[0]} is not carried")
        self.mj_model = copy.copy(mj_model)
        # MuJoCo would restart a diverged environment by itself; see `gmijax.sim.divergence`.
        self.mj_model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        # A diverged environment ends; MuJoCo would also add a line to a file in the user's folder.
        mujoco.set_mju_user_warning(lambda message: None)
        self.data = mujoco.MjData(self.mj_model)
        self.substeps = substeps

    @property
    def control_dt_s(self) -> float:
        """Seconds of simulated time per control step."""
        return self.mj_model.opt.timestep * self.substeps

    def start(self, qpos: Floats, qvel: Floats) -> PhysicsState:
        """See `Physics.start`: nothing but where bodies are is computed, sensors read zero."""
        mujoco.mj_resetData(self.mj_model, self.data)
        self.data.qpos[:], self.data.qvel[:] = qpos, qvel
        mujoco.mj_kinematics(self.mj_model, self.data)
        return self._state()

    def poses(self, qpos: Floats) -> tuple[Floats, Floats]:
        """See `Physics.poses`."""
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self.mj_model, self.data)
        return self.data.xpos.copy(), self.data.xquat.copy()

    def step(
        self,
        model: CPhysics,
        state: PhysicsState,
        ctrl: Floats,
        read: Callable[[mujoco.MjData], T] = lambda data: data.sensordata,
    ) -> tuple[PhysicsState, T]:
        """See `Physics.step`; what `read` returns may be views of the data."""
        data: Any = model.data
        data.qpos[:], data.qvel[:] = state.qpos, state.qvel
        data.qacc_warmstart[:] = state.qacc_warmstart
        data.ctrl[:] = ctrl
        mujoco.mj_step(model.mj_model, data, model.substeps)
        return model._state(), read(data)

    def env(
        self,
        spec: EnvSpec,
        reset: Callable[[Any, Any], EnvState],
        step: Callable[[Any, EnvState, Any], EnvState],
    ) -> Env:
        """See `Physics.env`; its `model` is this object."""
        return Env(
            spec=spec,
            model=self,
            reset=reset,
            step=step,
            mj_model=self.mj_model,
            qpos=lambda state: state.physics.qpos,
            max_envs=1,
        )

    def _state(self) -> PhysicsState:
        data = self.data
        return PhysicsState(data.qpos.copy(), data.qvel.copy(), data.qacc_warmstart.copy())
