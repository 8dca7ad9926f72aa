"""How environments are handed to MuJoCo Warp, without Warp: layout, maps, readings."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from gmijax.sim.impl import WarpSizes
from gmijax.sim.warp.batch import MODEL_LEAVES, OVERFLOW, STATE, lay_out
from gmijax.sim.warp.step import WarpStep

JOBS, ENVS = 2, 3
SHAPES = {**dict.fromkeys((*STATE, "ctrl"), (2,)), OVERFLOW: (), "sensordata": (4,)}


def test_arrays_of_the_buffer_are_apart_and_what_goes_in_and_comes_out_is_in_a_row():
    given = (("ctrl", (3, 1)), ("body_mass", (1, 5)))
    state = tuple((name, (3, 70)) for name in STATE)
    layout = lay_out(given, state, ((OVERFLOW, (3,)), ("xpos", (3, 5, 3))))
    pieces = {**layout.given, **layout.taken}
    assert list(pieces) == ["ctrl", "body_mass", *STATE, OVERFLOW, "xpos"]
    assert [piece.start % 64 for piece in pieces.values()] == [0] * 7
    ends = [piece.end for piece in pieces.values()]
    assert [piece.start for piece in pieces.values()] == [0, *ends[:-1]]
    assert all(piece.start + piece.size <= piece.end for piece in pieces.values())
    assert layout.num_given == layout.given["qacc_warmstart"].end == layout.taken[OVERFLOW].start
    assert layout.first_taken == layout.given["qpos"].start
    assert layout.size == layout.taken["xpos"].end


class Arithmetic(WarpStep):
    """Steps that are sums, and how many environments and rows of leaves were stepped at once."""

    seen: list[tuple[int, dict[str, int]]]

    def launch(self, reads: tuple[str, ...], given: dict[str, jax.Array]) -> dict[str, jax.Array]:
        count = given["qpos"].shape[0]
        leaves = {name: array.shape[0] for name, array in given.items() if name in MODEL_LEAVES}
        self.seen.append((count, leaves))
        mass = jnp.broadcast_to(given["body_mass"], (count, 2))
        moved = {name: given[name] + given["ctrl"] * mass for name in STATE}
        read = {name: jnp.tile(given["qpos"], (1, 2)) for name in reads}
        return {**moved, OVERFLOW: jnp.arange(count, dtype=jnp.int32), **read}


@pytest.fixture
def step() -> Arithmetic:
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    made = Arithmetic(model, 1, WarpSizes(1, 1), SHAPES)
    object.__setattr__(made, "seen", [])
    return made


def model_with(body_mass: jax.Array) -> Any:
    leaves = dict.fromkeys(MODEL_LEAVES, jnp.zeros((*body_mass.shape[:-1], 0)))
    return SimpleNamespace(**(leaves | {"body_mass": body_mass}))


@pytest.mark.parametrize(
    ("mass_shape", "rows"), [((2,), 1), ((ENVS, 2), JOBS * ENVS), ((JOBS, 1, 2), 6)]
)
def test_a_map_over_jobs_and_environments_is_one_call_of_all_environments(
    step: Arithmetic, mass_shape: tuple[int, ...], rows: int
):
    rng = np.random.default_rng(0)
    mass, ctrl = (jnp.array(rng.uniform(size=s), jnp.float32) for s in (mass_shape, (ENVS, 2)))
    state = {name: jnp.array(rng.uniform(size=(JOBS, ENVS, 2)), jnp.float32) for name in STATE}

    def one(body_mass: jax.Array, state: Any, ctrl: jax.Array) -> Any:
        return step(model_with(body_mass), state, ctrl, lambda data: data.sensordata[:2])

    of_envs = 0 if mass_shape == (ENVS, 2) else None
    of_jobs = 0 if mass_shape == (JOBS, 1, 2) else None
    mass = mass.reshape(JOBS, 2) if of_jobs == 0 else mass
    mapped = jax.vmap(jax.vmap(one, (of_envs, 0, 0)), (of_jobs, 0, None))
    moved, reading = jax.jit(mapped)(mass, state, ctrl)
    factor = mass[:, None] if of_jobs == 0 else mass
    for name in STATE:
        np.testing.assert_allclose(moved[name], state[name] + ctrl * factor, rtol=1e-6)
    assert moved[OVERFLOW].tolist() == [[0, 1, 2], [3, 4, 5]]
    np.testing.assert_array_equal(reading, state["qpos"])
    assert step.seen[-1] == (JOBS * ENVS, {"body_mass": rows})


def test_a_task_may_read_the_controls(step: Arithmetic):
    state, ctrl = {name: jnp.zeros(2) for name in STATE}, jnp.array([1.0, 2.0])
    moved, read = step(model_with(jnp.ones(2)), state, ctrl, lambda data: data.ctrl + data.qpos)
    assert moved["qpos"].tolist() == [1.0, 2.0]
    assert read.tolist() == [2.0, 4.0]


def test_what_the_data_do_not_have_for_each_environment_is_named(step: Arithmetic):
    state = {name: jnp.zeros(2) for name in STATE}
    with pytest.raises(AttributeError, match=r"^data\.contact: MuJoCo Warp has no such array"):
        step(model_with(jnp.ones(2)), state, jnp.zeros(2), lambda data: data.contact)
