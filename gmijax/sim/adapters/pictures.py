"""Pictures of the environments of a vector environment, in the process of the user."""

from __future__ import annotations

import jax
import numpy as np

from gmijax.errors import ConfigError
from gmijax.sim.interface import Env, EnvState
from gmijax.sim.stage import Image, Stage

_SIZE = (640, 480)


class Pictures:
    """Draws environments of `env`.

    Raises:
      ConfigError: the task has no model of MuJoCo, or OpenGL cannot be had.
    """

    def __init__(self, env: Env) -> None:
        if env.mj_model is None:
            raise ConfigError(f"render_mode=rgb_array: {env.spec.name} has no model to draw")
        try:
            self._stage = Stage(env.mj_model, _SIZE, None)
        # What is missing shows as any of half a dozen errors.
        except Exception as error:
            raise ConfigError(
                f"render_mode=rgb_array: no OpenGL ({type(error).__name__}: {error}); set "
                "MUJOCO_GL=egl (or osmesa) before Python starts"
            ) from error
        self._qpos = jax.jit(jax.vmap(env.qpos))

    def close(self) -> None:
        """Frees OpenGL; to be called while Python still runs."""
        self._stage.close()

    def of(self, state: EnvState) -> tuple[Image, ...]:
        """A picture of each of N environments."""
        # The next picture is drawn into the same memory.
        return tuple(self._stage.picture(one).copy() for one in np.asarray(self._qpos(state)))
