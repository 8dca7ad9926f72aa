"""Warns how many contacts a model can have, before minutes go into compiling for all of them."""

from __future__ import annotations

import warnings

from gmijax.sim.impl import Impl, WarpSizes

MANY = 128
"""Up to so many contacts of an environment MuJoCo Warp's buffers hold all; more give a warning."""


def warn_of_many(
    name: str, impl: Impl, contacts: int, rows: int, buffers: WarpSizes | None = None
) -> None:
    """Warns of a model that can have more contacts than `MANY`, or than the buffers hold.

    Args:
      name: the model's.
      impl: which implementation.
      contacts: all that an environment can have at once.
      rows: of constraints, with all of these.
      buffers: the sizes of MuJoCo Warp's buffers.
    """
    least = MANY if buffers is None else buffers.contacts_per_env
    if contacts <= least:
        return
    if impl == "jax" or buffers is None:
        what = "MJX-JAX computes all of them in every step, and may take many minutes to compile"
    else:
        what = (
            f"MuJoCo Warp's buffers hold {buffers.contacts_per_env:,} contacts and "
            f"{buffers.constraints_per_env:,} rows; what does not fit is left out and counted, "
            "and warp_sizes makes them larger"
        )
    warnings.warn(
        f"{name}: its geoms can make {contacts:,} contacts ({rows:,} rows of constraints) in an "
        f"environment. {what}. Most robots have a variant for MJX (an _mjx file); else let "
        "primitives collide instead of meshes",
        RuntimeWarning,
        stacklevel=4,
    )
