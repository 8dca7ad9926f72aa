"""Parts of models that MJX would simulate as if they were not there."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from model_parts import CASES, Case
from mujoco import mjx

from gmijax.errors import ConfigError
from gmijax.sim.physics import from_mj_model
from gmijax.sim.plain_model import WITHOUT_EFFECT, plain
from gmijax.sim.unsimulated import PARTS, refuse_parts

_BY_NAME = {case.part: case for case in CASES}


def moved_in_c(mj_model: mujoco.MjModel, reads: str) -> np.ndarray:
    data = mujoco.MjData(mj_model)
    data.ctrl[:] = 0.5
    for _ in range(100):
        mujoco.mj_step(mj_model, data)
    return np.array(getattr(data, reads))


def test_every_part_has_a_case():
    for part in PARTS:
        assert sum(part.name.startswith(case.part) for case in CASES) == 1, part.name


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.part)
def test_a_part_that_matters_is_refused_by_name(case: Case):
    assert case.with_it.count(case.old) == 1
    (part,) = (part for part in PARTS if part.name.startswith(case.part))
    with_it = mujoco.MjModel.from_xml_string(case.with_it)
    without = mujoco.MjModel.from_xml_string(case.with_it.replace(case.old, case.new))
    for impl in part.impls:
        with pytest.raises(ConfigError) as error:
            refuse_parts(with_it, impl)
        assert str(error.value).startswith(f"model: {part.name}, which ")
        assert f"physics.impl={impl}" in str(error.value)
        refuse_parts(without, impl)
    if "warp" not in part.impls:
        refuse_parts(with_it, "warp")
    if case.differs:
        ours, other = (moved_in_c(model, case.reads) for model in (with_it, without))
        assert ours.shape != other.shape or np.abs(ours - other).max() > 1e-5


def test_what_every_model_has_is_not_refused():
    text = "<mujoco><worldbody><body><joint/><geom size='.1'/></body></worldbody></mujoco>"
    nothing = mujoco.MjModel.from_xml_string(text)
    for impl in ("jax", "warp"):
        refuse_parts(nothing, impl)
    assert plain(nothing) is nothing


_IDLE = (
    ("energy", "enable"),
    ("fwdinv", "enable"),
    ("invdiscrete", "enable"),
    ("midphase", "disable"),
    ("autoreset", "disable"),
)


@pytest.mark.parametrize(("flag", "value"), _IDLE)
def test_flags_that_change_no_step_are_taken(flag: str, value: str):
    text = (
        f'<mujoco><option><flag {flag}="{value}"/></option><worldbody><geom type="plane" size="1 '
        '1 1"/><body pos="0 0 .1"><freejoint/><geom size=".1"/></body></worldbody></mujoco>'
    )
    asked = mujoco.MjModel.from_xml_string(text)
    sim = from_mj_model(asked, impl="jax", substeps=1)
    taken = sim.mj_model
    for name, bits in WITHOUT_EFFECT:
        assert not getattr(taken.opt, name) & bits
    assert (asked.opt.enableflags, asked.opt.disableflags) != (0, 0)
    np.testing.assert_array_equal(moved_in_c(asked, "qpos"), moved_in_c(taken, "qpos"))


RESISTING = """<mujoco><option integrator="{}"/><worldbody><body><joint name="a" axis="0 1 0"
damping=".1" armature=".01"/><geom type="capsule" fromto="0 0 0 .5 0 0" size=".03" mass="1"
contype="0"/><body pos=".5 0 0"><joint name="b" axis="0 1 0"/><geom type="capsule"
fromto="0 0 0 .5 0 0" size=".03" mass="1" contype="0"/></body></body></worldbody>
<tendon><fixed name="t"><joint joint="a" coef="1"/><joint joint="b" coef="-2"/></fixed></tendon>
<actuator><motor joint="a" gear="3" {}/><motor {} gear="2" damping=".05"/></actuator></mujoco>"""


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast", "RK4"])
@pytest.mark.parametrize("more", ['damping=".2"', 'armature=".02"', 'damping=".1" armature=".1"'])
@pytest.mark.parametrize("other", ['joint="b"', 'tendon="t"', 'jointinparent="b"'])
def test_damping_and_armature_of_actuators_become_those_of_joints_and_tendons(
    integrator: str, more: str, other: str
):
    asked = mujoco.MjModel.from_xml_string(RESISTING.format(integrator, more, other))
    taken = plain(asked)
    assert not taken.actuator_damping.any()
    assert not taken.actuator_armature.any()
    for impl in ("jax", "warp"):
        refuse_parts(taken, impl)
    # Of tendons MuJoCo integrates damping implicitly, of actuators on tendons too or not.
    np.testing.assert_allclose(moved_in_c(asked, "qpos"), moved_in_c(taken, "qpos"), atol=1e-9)


def test_a_polynomial_of_an_actuators_damping_is_still_one():
    text = RESISTING.format("Euler", 'damping="1 2"', 'joint="b"')
    taken = plain(mujoco.MjModel.from_xml_string(text))
    refuse_parts(taken, "warp")
    with pytest.raises(ConfigError, match="polynomials of stiffness or damping"):
        refuse_parts(taken, "jax")


def test_a_sensor_that_nothing_would_fill_is_refused():
    text = (
        '<mujoco><worldbody><body><joint name="a" {}/><geom size=".1" contype="0"/></body>'
        '</worldbody><actuator><motor name="m" joint="a"/></actuator><sensor><actuatorpos '
        'actuator="m"/><actuatorfrc name="pull" actuator="m"/></sensor></mujoco>'
    )
    with pytest.raises(ConfigError, match=r"sensor of forces \(pull\) in a model without limits"):
        from_mj_model(mujoco.MjModel.from_xml_string(text.format("")), impl="jax", substeps=1)
    limited = mujoco.MjModel.from_xml_string(text.format('range="-180 180"'))
    from_mj_model(limited, impl="jax", substeps=1)


def test_a_rangefinder_may_be_on_a_body_with_a_cylinder():
    (case,) = (case for case in CASES if case.part == "rangefinders beside cylinders")
    own = case.with_it.replace(case.old, "").replace(
        "<site name='eye'", "<geom type='cylinder' size='.1 .1' contype='0'/><site name='eye'"
    )
    refuse_parts(mujoco.MjModel.from_xml_string(own), "jax")


def test_a_sensor_of_contacts_where_nothing_collides_is_refused():
    text = (
        '<mujoco><worldbody><geom type="plane" size="1 1 1" contype="{0}"/><body><joint range="0 9'
        '"/><geom size=".1" contype="0"/><site name="s"/></body></worldbody><sensor><touch '
        'site="s"/></sensor></mujoco>'
    )
    with pytest.raises(ConfigError, match=r"\(touch\) in a model without geoms that may collide"):
        from_mj_model(mujoco.MjModel.from_xml_string(text.format(0)), impl="jax", substeps=1)
    from_mj_model(mujoco.MjModel.from_xml_string(text.format(1)), impl="jax", substeps=1)


def moved_by_mjx(mj_model: mujoco.MjModel, reads: str) -> np.ndarray:
    model = mjx.put_model(mj_model, impl="jax")
    data = mjx.make_data(model).replace(ctrl=jnp.full(mj_model.nu, 0.5))
    many = jax.jit(lambda data: jax.lax.fori_loop(0, 100, lambda _, d: mjx.step(model, d), data))
    return np.array(getattr(many(data), reads))


@pytest.mark.slow
@pytest.mark.parametrize(
    "case", [case for case in CASES if case.is_ignored], ids=lambda case: case.part
)
def test_mjx_does_not_see_a_part_that_is_refused(case: Case):
    texts = (case.with_it, case.with_it.replace(case.old, case.new))
    models = [mujoco.MjModel.from_xml_string(text) for text in texts]
    in_c, in_mjx = (
        np.abs(np.subtract(*(moved(model, case.reads) for model in models))).max()
        for moved in (moved_in_c, moved_by_mjx)
    )
    assert in_mjx < 0.1 * in_c
