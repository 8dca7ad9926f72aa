"""A shipped model with what moves it: MJX, or MuJoCo in C. Imports jax for MJX only."""

from __future__ import annotations

from importlib import resources
from typing import TYPE_CHECKING, Any, Final

import mujoco

from gmijax.sim.impl import ON_GPU, choose_impl

if TYPE_CHECKING:
    from gmijax.sim.physics import Physics

C: Final = "c"
"""The implementation that is MuJoCo in C: one environment in numpy, for the player."""


def load_model(asset: str) -> mujoco.MjModel:
    """The model `asset` that is shipped in `gmijax/sim/assets`: its file without `.xml`."""
    text = resources.files("gmijax.sim").joinpath("assets", f"{asset}.xml").read_text()
    return mujoco.MjModel.from_xml_string(text)


def load(asset: str, *, impl: str, substeps: int, max_envs: int | None = None) -> Physics:
    """A shipped model with its simulator, of which tasks use what all of them have.

    Args:
      asset: see `load_model`.
      impl: `auto`, `jax` or `warp`, see `gmijax.sim.impl`; `c`: `gmijax.sim.c_physics`.
      substeps: physics steps per control step.
      max_envs: upper bound of environments simulated at once, None for no limit.

    Raises:
      ConfigError: `impl` cannot be had, or the model needs state that is not carried.
    """
    if impl == C:
        from gmijax.sim.c_physics import CPhysics

        sim: Any = CPhysics(load_model(asset), substeps)
        return sim
    import jax

    from gmijax.sim.physics import from_mj_model

    chosen, _ = choose_impl(impl, jax.default_backend(), asset)
    return from_mj_model(
        load_model(asset),
        impl=chosen,
        substeps=substeps,
        max_envs=max_envs,
        warp_sizes=ON_GPU.get(asset),
    )
