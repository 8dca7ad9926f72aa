"""How large MuJoCo Warp's buffers must be for a model: from the geoms that can touch.

Where meshes or many geoms collide, all pairs together could make thousands of contacts, of which a
few dozen ever touch at once: then the buffers hold `MANY` of an environment.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from gmijax.sim.impl import WarpSizes
from gmijax.sim.many_contacts import MANY

Ints = npt.NDArray[np.int64]
_PLANE, _HFIELD, _SPHERE, _CAPSULE, _ELLIPSOID, _, _BOX, _, _SDF = range(9)
"""Types of geoms, as `mujoco.mjtGeom` numbers them."""

_EQUALITY_ROWS = {
    int(mujoco.mjtEq.mjEQ_CONNECT): 3,
    int(mujoco.mjtEq.mjEQ_WELD): 6,
    int(mujoco.mjtEq.mjEQ_JOINT): 1,
    int(mujoco.mjtEq.mjEQ_TENDON): 1,
}
"""Rows of an equality constraint; those of a flex have as many as in MuJoCo."""


class Bounds(NamedTuple):
    """What no state of an environment can exceed, and what the buffers hold.

    Attributes:
      contacts: of all pairs of geoms that may collide.
      rows: of the constraint solver, with all those contacts.
      sizes: the buffers' sizes.
    """

    contacts: int
    rows: int
    sizes: WarpSizes


def bounds_of(mj_model: mujoco.MjModel, warp_model: Any) -> Bounds:
    """Both, for a model and what `mujoco_warp.put_model` made of it."""
    others = _rows_without_contacts(mj_model)
    if mj_model.nflex:  # Contacts of their elements: nothing bounds them; Warp's own guess.
        guess = WarpSizes(512, others + 2048)
        return Bounds(*guess, guess)
    contacts, rows = _of_pairs(mj_model, warp_model)
    all_contacts, all_rows = int(contacts.sum()), int(contacts @ rows)
    if all_contacts <= MANY:
        sizes = WarpSizes(all_contacts, others + all_rows)
    else:
        most = MANY * int(rows.max())
        sizes = WarpSizes(MANY, others + min(all_rows, most))
    return Bounds(all_contacts, others + all_rows, sizes)


def _rows_without_contacts(mj_model: mujoco.MjModel) -> int:
    kinds = mj_model.eq_type
    known = all(kind in _EQUALITY_ROWS for kind in kinds)
    rows = sum(_EQUALITY_ROWS[kind] for kind in kinds) if known else int(mj_model.nemax)
    rows += int(np.count_nonzero(mj_model.dof_frictionloss))
    rows += int(np.count_nonzero(mj_model.tendon_frictionloss))
    return rows + int(mj_model.jnt_limited.sum()) + int(mj_model.tendon_limited.sum())


def _of_pairs(mj_model: mujoco.MjModel, warp_model: Any) -> tuple[Ints, Ints]:
    """Most contacts of every pair of geoms, and rows of one of them."""
    pairs = warp_model.nxn_geom_pair_filtered.numpy()
    numbers = warp_model.nxn_pairid_filtered.numpy()[:, 0]
    pairs, numbers = pairs[numbers >= -1], numbers[numbers >= -1]
    off = mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    if mj_model.opt.disableflags & off or not len(pairs):
        return np.zeros(1, int), np.ones(1, int)
    dims = _mixed_dims(mj_model, pairs)
    dims[numbers >= 0] = mj_model.pair_dim[numbers[numbers >= 0]]
    per_contact = dims if mj_model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC else 2 * (dims - 1)
    rows = np.where(dims == 1, 1, per_contact)
    types = np.sort(mj_model.geom_type[pairs], axis=1)
    contacts = [_most_contacts(first, second, mj_model) for first, second in types]
    return np.array(contacts), rows


def _mixed_dims(mj_model: mujoco.MjModel, pairs: Ints) -> Ints:
    dims, priority = mj_model.geom_condim[pairs], mj_model.geom_priority[pairs]
    first, second = priority[:, 0] > priority[:, 1], priority[:, 0] < priority[:, 1]
    return np.where(first, dims[:, 0], np.where(second, dims[:, 1], dims.max(axis=1)))


def _most_contacts(first: int, second: int, mj_model: mujoco.MjModel) -> int:
    """Contacts that Warp makes of two geoms of these types, the lower type first."""
    if second == _SDF:
        return int(mj_model.opt.sdf_initpoints)
    if second in (_PLANE, _HFIELD):
        return 0
    if first == _HFIELD:
        return 4
    if _SPHERE in (first, second) or _ELLIPSOID in (first, second):
        return 1
    if first == second == _BOX:
        return 8
    return 2 if second == _CAPSULE or (first, second) == (_CAPSULE, _BOX) else 4
