"""Sizes of MuJoCo Warp's buffers, and the model that JAX has of its environments, without Warp."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from gmijax.sim.impl import WarpSizes
from gmijax.sim.kinematic_model import kinematic_model
from gmijax.sim.many_contacts import MANY, warn_of_many
from gmijax.sim.warp.batch import MODEL_LEAVES
from gmijax.sim.warp.sizes import bounds_of


def geoms(*more: str, option: str = "", rest: str = "") -> mujoco.MjModel:
    bodies = "".join(
        f"<body pos='0 0 {i}'><freejoint/><geom size='.1 .1 .1' {text}/></body>"
        for i, text in enumerate(more)
    )
    text = f"<mujoco><option {option}/><worldbody>{bodies}</worldbody>{rest}</mujoco>"
    return mujoco.MjModel.from_xml_string(text)


def in_warp(mj_model: mujoco.MjModel, *pairs: tuple[int, int], numbers: Any = None) -> Any:
    """What `put_model` says of pairs of geoms: -1 collides, -2 only has a sensor."""
    numbers = [-1] * len(pairs) if numbers is None else numbers
    given = (
        np.array(pairs, int).reshape(-1, 2),
        np.array([[n, -1] for n in numbers]).reshape(-1, 2),
    )
    names = ("nxn_geom_pair_filtered", "nxn_pairid_filtered")
    arrays = [SimpleNamespace(numpy=lambda array=array: array) for array in given]
    return SimpleNamespace(**dict(zip(names, arrays, strict=True)))


@pytest.mark.parametrize(
    ("one", "other", "contacts"),
    [
        ("type='sphere'", "type='box'", 1),
        ("type='box'", "type='ellipsoid'", 1),
        ("type='capsule'", "type='capsule'", 2),
        ("type='box'", "type='capsule'", 2),
        ("type='box'", "type='box'", 8),
        ("type='cylinder'", "type='box'", 4),
        ("type='capsule'", "type='cylinder'", 4),
    ],
)
def test_a_pair_has_room_for_all_its_contacts(one: str, other: str, contacts: int):
    mj_model = geoms(one, other)
    bounds = bounds_of(mj_model, in_warp(mj_model, (0, 1)))
    assert bounds == (contacts, 4 * contacts, WarpSizes(contacts, 4 * contacts))


@pytest.mark.parametrize(
    ("option", "condims", "rows"),
    [
        ("", "11", 1),
        ("", "13", 4),
        ("", "41", 6),
        ("", "66", 10),
        ("cone='elliptic'", "11", 1),
        ("cone='elliptic'", "16", 6),
    ],
)
def test_rows_are_those_of_the_larger_condim(option: str, condims: str, rows: int):
    mj_model = geoms(*(f"condim='{condim}'" for condim in condims), option=option)
    assert bounds_of(mj_model, in_warp(mj_model, (0, 1))).rows == rows
    mj_model.geom_priority[0] = 1
    own = int(condims[0])
    expected = own if option else max(2 * (own - 1), 1)
    assert bounds_of(mj_model, in_warp(mj_model, (0, 1))).rows == expected


def test_pairs_of_sensors_and_what_is_off_have_no_room_and_named_pairs_their_own_condim():
    pair = "<contact><pair geom1='a' geom2='b' condim='6'/></contact>"
    mj_model = geoms("name='a'", "name='b'", rest=pair)
    named = in_warp(mj_model, (0, 1), (0, 1), numbers=[0, -2])
    assert bounds_of(mj_model, named)[:2] == (1, 10)
    assert bounds_of(mj_model, in_warp(mj_model))[:2] == (0, 0)
    mj_model.opt.disableflags = mujoco.mjtDisableBit.mjDSBL_CONTACT
    assert bounds_of(mj_model, named)[:2] == (0, 0)


def test_limits_frictions_and_equalities_have_rows_of_their_own():
    text = """<mujoco><worldbody><body name="a"><joint name="j" range="-1 1" frictionloss="1"/>
    <geom size=".1"/></body><body name="b"><freejoint/><geom size=".1"/></body></worldbody>
    <tendon><fixed name="t" range="0 1" frictionloss="1"><joint joint="j" coef="1"/></fixed>
    </tendon><equality><weld body1="a" body2="b"/><connect body1="a" body2="b" anchor="0 0 0"/>
    <joint joint1="j"/></equality></mujoco>"""
    mj_model = mujoco.MjModel.from_xml_string(text)
    assert bounds_of(mj_model, in_warp(mj_model)).rows == 2 + 2 + 6 + 3 + 1


def test_thousands_of_contacts_have_room_for_some_of_them_and_are_warned_of():
    mj_model = geoms("type='box'", "type='box'", "condim='6'")
    bounds = bounds_of(mj_model, in_warp(mj_model, *[(0, 1)] * 99, (1, 2)))
    assert bounds == (793, 3178, WarpSizes(MANY, 10 * MANY))
    with pytest.warns(RuntimeWarning, match=r"hand: .* 793 contacts \(3,178 rows .* hold 128 "):
        warn_of_many("hand", "warp", *bounds)
    with pytest.warns(RuntimeWarning, match=r"hand: .* 129 contacts .* MJX-JAX computes all"):
        warn_of_many("hand", "jax", 129, 516)
    warn_of_many("hand", "jax", 128, 512)


ONLY_FOR_WARP = """<mujoco><option cone="elliptic" integrator="implicit" density="1"/><worldbody>
<geom name="floor" type="box" size="1 1 .1" condim="1"/>
<body name="a" pos=".1 .2 .5" quat="1 1 0 0">
<joint name="j" axis="0 1 0" pos="0 0 .1"/><geom name="g" type="cylinder" size=".1 .1" condim="1"
margin=".01"/><body pos="0 .3 0"><joint type="ball"/><geom size=".1"/></body></body>
<body name="cloth" pos="0 0 1"><flexcomp name="f" type="grid" count="3 3 1" spacing=".1 .1 .1"
dim="2" radius=".01"/></body></worldbody><contact><pair geom1="floor" geom2="g"/></contact>
<actuator><adhesion body="a" ctrlrange="0 1"/></actuator>
<sensor><distance geom1="floor" geom2="g" cutoff="1"/></sensor></mujoco>"""


def test_environments_of_warp_have_a_model_in_jax_that_mjx_jax_could_not_simulate():
    mj_model = mujoco.MjModel.from_xml_string(ONLY_FOR_WARP)
    model = kinematic_model(mj_model)
    for name in MODEL_LEAVES:
        np.testing.assert_allclose(getattr(model, name), getattr(mj_model, name), rtol=1e-6)
    data, qpos = mujoco.MjData(mj_model), np.array(mj_model.qpos0)
    qpos[:5] = 0.3, 0.8, 0.0, 0.6, 0.0
    data.qpos[:] = qpos
    mujoco.mj_kinematics(mj_model, data)
    start = mjx.make_data(model).replace(qpos=jnp.array(qpos))
    moved = jax.jit(mjx.kinematics)(model, start)
    np.testing.assert_allclose(moved.xpos, data.xpos, atol=1e-5)
