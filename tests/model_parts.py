"""Small models, each with a part that an implementation of MJX does not simulate."""

from __future__ import annotations

from typing import NamedTuple


class Case(NamedTuple):
    """A model with a part, and the text that takes the part out.

    Attributes:
      part: the beginning of its name in `PARTS`.
      with_it: the model.
      old: what is replaced in its text...
      new: ... by this, so that it has the part no more.
      reads: what shows the difference: `qpos` or `sensordata`.
      is_ignored: MJX-JAX simulates the first model as if it were the second; else it fails.
      differs: MuJoCo in C moves otherwise without the part.
    """

    part: str
    with_it: str
    old: str
    new: str
    reads: str = "qpos"
    is_ignored: bool = True
    differs: bool = True


def _model(world: str, option: str = "", rest: str = "") -> str:
    return f"<mujoco><option {option}</option><worldbody>{world}</worldbody>{rest}</mujoco>"


def _arm(rest: str, joint: str = "", option: str = "/>") -> str:
    option = "" if option == "/>" else option
    body = (
        f'<body><joint name="a" axis="0 1 0" damping=".1" {joint}/><geom name="g" type="capsule" '
        'fromto="0 0 0 .5 0 0" size=".03" mass="1" contype="0"/></body>'
    )
    return f"<mujoco><option>{option}</option><worldbody>{body}</worldbody>{rest}</mujoco>"


def _block(option: str, geom: str = "", floor: str = "", rest: str = "") -> str:
    return (
        f'<mujoco><option gravity="3 0 -9.81" cone="elliptic" {option}/><worldbody><geom '
        f'type="plane" size="5 5 .1" {floor}/><body pos="0 0 .1"><freejoint/><geom type="box" '
        f'size=".1 .1 .1" mass="1" {geom}/><site name="s" type="sphere" size=".3"/></body>'
        f"</worldbody>{rest}</mujoco>"
    )


def _looking_down(on: str, at: str) -> str:
    return (
        f"<mujoco><asset><material name='m'/></asset><worldbody>{on}<body pos='0 0 1'>"
        "<joint type='slide' axis='1 0 0'/><geom "
        "size='.05' contype='0'/><site name='eye' euler='180 0 0'/></body></worldbody>"
        f"<sensor><rangefinder {at}/></sensor></mujoco>"
    )


_MOTOR = '<actuator><motor joint="a" gear="5" {}/></actuator>'

CASES = (
    Case(
        "actuatorgroupdisable",
        '<mujoco><option actuatorgroupdisable="1"/><worldbody><body><joint name="a" axis="0 1 0" '
        'damping=".1"/><geom type="capsule" fromto="0 0 0 .5 0 0" size=".03" mass="1"/></body>'
        '</worldbody><actuator><motor joint="a" gear="5" group="0"/><motor joint="a" gear="-5" '
        'group="1"/></actuator></mujoco>',
        ' actuatorgroupdisable="1"',
        "",
    ),
    Case(
        "rangefinders with a camera",
        _looking_down("<geom type='plane' size='5 5 .1'/>", "site='eye' data='dist point'"),
        "data='dist point'",
        "",
        "sensordata",
        is_ignored=False,
    ),
    Case(
        "no joint",
        "<mujoco><worldbody><body><geom size='.1'/></body></worldbody></mujoco>",
        "<body>",
        "<body><joint/>",
        is_ignored=False,
    ),
    Case("noslip_iterations", _block('noslip_iterations="20"'), 'noslip_iterations="20"', ""),
    Case(
        'fluidshape="ellipsoid"',
        '<mujoco><option density="1000"/><worldbody><body><freejoint/><geom type="ellipsoid" '
        'size=".2 .05 .02" mass="1" fluidshape="ellipsoid"/></body></worldbody></mujoco>',
        'fluidshape="ellipsoid"',
        "",
    ),
    Case(
        "only one of the flags",
        _arm(_MOTOR.format(""), option='<flag spring="disable"/>'),
        'damping=".1"',
        "",
    ),
    Case(
        "polynomials of stiffness",
        _arm(_MOTOR.format(""), joint='stiffness="1 20"'),
        'stiffness="1 20"',
        'stiffness="1"',
    ),
    Case(
        'actearly="true"',
        _arm(
            '<actuator><general joint="a" gainprm="5" dyntype="filter" dynprm=".05" '
            'actearly="true"/></actuator>'
        ),
        'actearly="true"',
        "",
    ),
    Case(
        "adhesion of geoms",
        _block("", geom='friction=".2" adhesion="20"', floor='friction=".2"'),
        'adhesion="20"',
        "",
    ),
    Case(
        "surfacevel of geoms",
        _block("", floor='surfacevel="1 0 0 0 0 0"'),
        'surfacevel="1 0 0 0 0 0"',
        "",
    ),
    Case(
        "rangefinders beside cylinders",
        _looking_down(
            "<geom type='cylinder' size='.5 .2'/><geom type='plane' size='5 5 .1'/>", "site='eye'"
        ),
        "<geom type='cylinder' size='.5 .2'/>",
        "",
        "sensordata",
    ),
    Case(
        "rangefinders in a model without any",
        _looking_down("<geom type='plane' size='5 5 .1'/>", "site='eye'").replace(
            "<material name='m'/>",
            "<texture name='t' type='2d' builtin='flat' width='1' height='1'/>",
        ),
        "<texture name='t' type='2d' builtin='flat' width='1' height='1'/>",
        "<material name='m'/>",
        is_ignored=False,
        differs=False,
    ),
    Case(
        "touch sensors in a cylinder",
        _block("", rest='<sensor><touch site="s"/></sensor>')
        .replace('type="sphere"', 'type="cylinder"')
        .replace('size=".3"', 'size=".3 .05" pos="0 0 .1"'),
        'type="cylinder"',
        'type="sphere"',
        "sensordata",
        is_ignored=False,
    ),
    Case(
        "tactile sensors",
        "<mujoco><asset><mesh name='m' builtin='sphere' params='1' scale='.1 .1 .1'/></asset>"
        "<worldbody><geom name='floor' type='plane' size='1 1 .1'/><body pos='0 0 .09'>"
        "<freejoint/><geom name='g' size='.1'/></body></worldbody>"
        "<sensor><tactile geom='g' mesh='m'/></sensor></mujoco>",
        "<sensor><tactile geom='g' mesh='m'/></sensor>",
        "",
        "sensordata",
        is_ignored=False,
    ),
    Case(
        'integrator="implicit"',
        _arm(_MOTOR.format(""), option='<flag eulerdamp="disable"/>').replace(
            "<option>", '<option timestep=".01" integrator="implicit">'
        ),
        'integrator="implicit"',
        "",
        is_ignored=False,
    ),
    Case(
        "plugins",
        '<mujoco><extension><plugin plugin="mujoco.pid"/></extension><worldbody><body><joint '
        'name="a" axis="0 1 0"/><geom size=".1"/></body></worldbody><actuator><plugin joint="a" '
        'plugin="mujoco.pid"><config key="kp" value="9"/></plugin></actuator></mujoco>',
        '<plugin joint="a" plugin="mujoco.pid"><config key="kp" value="9"/></plugin>',
        '<motor joint="a"/>',
        is_ignored=False,
    ),
    Case(
        "delay of actuators or sensors",
        _arm(_MOTOR.format('delay=".05" nsample="30"')),
        'delay=".05" nsample="30"',
        "",
        is_ignored=False,
    ),
    Case(
        'flag sleep="enable"',
        '<mujoco><option><flag sleep="enable"/></option><worldbody><geom type="plane" size="1 1 1"'
        '/><body pos="0 0 .1"><freejoint/><geom size=".1"/></body></worldbody></mujoco>',
        'sleep="enable"',
        'sleep="disable"',
        is_ignored=False,
        differs=False,
    ),
    Case(
        'flag override="enable"',
        _block('o_solref=".2 1"').replace(
            "</mujoco>", '<option><flag override="enable"/></option></mujoco>'
        ),
        'override="enable"',
        'override="disable"',
        is_ignored=False,
    ),
    Case(
        'flag diagexact="enable"',
        _block("").replace("</mujoco>", '<option><flag diagexact="enable"/></option></mujoco>'),
        'diagexact="enable"',
        'diagexact="disable"',
        is_ignored=False,
    ),
    Case(
        'solver="PGS"',
        _block('iterations="2" solver="PGS"'),
        'solver="PGS"',
        "",
        is_ignored=False,
    ),
)
