"""The walking test's numbers, by hand; no simulator."""

from __future__ import annotations

import dataclasses
from typing import Any

import mujoco
import numpy as np
import pytest

from gmijax.config import EnvConfig
from gmijax.config.env import ROBOTS as NAMES
from gmijax.player.joystick import ROBOTS, Ground, robot_of, with_pushes
from gmijax.player.walking import Recording, lines_of, measure
from gmijax.sim.robots import changed_settings

DT_S = 0.02
GO1 = ROBOTS["go1"]


class Field:
    """A model's field of heights, 2 m wide and 4 m long."""

    def __init__(self, heights):
        self.nhfield = 1
        self.hfield_size = np.array([[1.0, 2.0, 0.5, 1.0]])
        self.hfield_nrow, self.hfield_ncol = ([n] for n in np.shape(heights))
        self.hfield_data = np.ravel(heights)


class Flat:
    nhfield = 0


def standing(steps: int = 200, envs: int = 1) -> dict[str, Any]:
    """A robot that stands as commanded, in `measure`'s arrays."""
    qpos = np.zeros((steps, envs, 7 + 12), np.float32)
    qpos[..., 2], qpos[..., 3] = 0.3, 1
    zeros = np.zeros((steps, envs, 3), np.float32)
    false = np.zeros((steps, envs), bool)
    load = np.full((steps, envs, 12), 0.5, np.float32)
    return {
        "qpos": qpos,
        "velocity": zeros.copy(),
        "command": zeros.copy(),
        "disturbed": false.copy(),
        "load": load,
        "done": false.copy(),
    }


def walk_of(parts, model: Any = Flat):
    return measure(Recording(**parts), GO1, Ground(model), DT_S)


def test_a_robot_that_stands_as_commanded_walks():
    walk = walk_of(standing(envs=100))
    assert walk.walks is True
    assert (walk.num_envs, walk.length_s, walk.upright, walk.left) == (100, 4.0, 1.0, 0.0)
    assert walk.settled == walk.all_steps == (0.0, 0.0)
    assert (walk.load_rms, walk.load_p99, walk.jerk_rad_per_s3) == (0.5, 0.5, 0.0)
    assert "walks: yes" in lines_of(walk.as_json())[-1]


def test_fewer_than_100_environments_are_too_few_to_say():
    walk = walk_of(standing(envs=99))
    assert walk.walks is None
    assert lines_of(walk.as_json())[-1] == "  walks: too few to say (at least 100)"


def test_a_policy_does_not_walk_if_more_than_half_leave_the_field():
    flat = Field(np.zeros((2, 2)))
    parts = standing(envs=100)
    parts["qpos"][150:, :50, 0] = 9.6
    walk = walk_of(parts, flat)
    assert (walk.walks, walk.left, walk.upright) == (True, 0.5, 1.0)
    parts["qpos"][150:, 50, 0] = 9.6
    walk = walk_of(parts, flat)
    assert (walk.walks, walk.left, walk.upright) == (False, 0.51, 1.0)
    assert "left the field: 51.0% (at most 50%)" in "".join(lines_of(walk.as_json()))


def test_settings_that_are_not_the_tasks_own_are_printed():
    walk = walk_of(standing())
    assert not any("settings" in line for line in lines_of(walk.as_json()))
    settings = {
        **{"noise": 0.0, "command_forward_m_per_s": 0.3},
        # The test has the task's own pushes and no reward.
        **{"push": 1.0, "push_max_m_per_s": 9.0, "tracking_sigma": 0.5},
    }
    env = EnvConfig(suite="playground", name="go1", episode_length=None, settings=settings)
    changed = changed_settings(env)
    lines = lines_of(walk._replace(settings=changed).as_json())
    assert lines[1] == (
        "  settings that are not the task's own: noise=0, command_forward_m_per_s=0.3"
    )


def test_a_limp_robot_that_sinks_through_the_floor_has_fallen_though_the_task_goes_on():
    parts = standing(envs=100)
    parts["qpos"][100:, :2, 2] = -0.07
    walk = walk_of(parts)
    assert (walk.upright, walk.not_done, walk.walks) == (0.98, 1.0, False)
    parts = standing()
    parts["qpos"][100:, 0, 2] = -0.07
    walk = walk_of(parts)
    assert walk.falls == {"not_finite": 0, "low": 1, "tilted": 0, "done": 0}


@pytest.mark.parametrize(
    ("cause", "change"),
    [
        ("tilted", lambda parts: parts["qpos"].__setitem__((50, 0, slice(3, 5)), [0.8, 0.6])),
        ("done", lambda parts: parts["done"].__setitem__((50, 0), True)),
        ("not_finite", lambda parts: parts["qpos"].__setitem__((50, 0, 9), np.nan)),
        ("low", lambda parts: parts["qpos"].__setitem__((50, 0, 2), 0.138)),
    ],
)
def test_one_bad_step_is_a_fall_and_has_a_cause(cause, change):
    parts = standing(envs=2)
    change(parts)
    walk = walk_of(parts)
    assert walk.upright == 0.5
    assert walk.falls[cause] == sum(walk.falls.values()) == 1


def test_a_tilt_below_60_degrees_and_a_height_above_a_half_are_no_falls():
    parts = standing()
    parts["qpos"][..., 3:5] = np.cos(np.radians(29.5)), np.sin(np.radians(29.5))
    parts["qpos"][..., 2] = 0.14
    assert walk_of(parts).upright == 1.0


def test_nothing_counts_from_a_fall_on():
    parts = standing()
    parts["done"][100] = True
    parts["velocity"][100:] = 5.0
    parts["load"][100:] = 1.0
    parts["qpos"][100:, :, 7:] = 9.0
    walk = walk_of(parts)
    assert walk.all_steps == walk.settled == (0.0, 0.0)
    assert (walk.load_rms, walk.jerk_rad_per_s3) == (0.5, 0.0)


def test_errors_are_of_the_length_of_the_vector_and_root_mean_squares():
    parts = standing(envs=100)
    parts["command"][:, :50] = [0.3, 0.4, 0.2]
    walk = walk_of(parts)
    assert walk.all_steps.linear_m_per_s == pytest.approx(np.sqrt(0.25 / 2))
    assert walk.all_steps.yaw_rad_per_s == pytest.approx(np.sqrt(0.04 / 2))
    assert walk.walks is False


def test_half_a_second_after_start_push_and_new_command_errors_do_not_count():
    parts = standing()
    parts["disturbed"][100] = True
    for settling in (slice(0, 25), slice(100, 126)):
        parts["velocity"][settling] = 1.0
    walk = walk_of(parts)
    assert walk.settled == (0.0, 0.0)
    assert walk.all_steps.yaw_rad_per_s == pytest.approx(np.sqrt(51 / 200))
    parts["velocity"][126] = 1.0
    assert walk_of(parts).settled.yaw_rad_per_s == pytest.approx(np.sqrt(1 / (175 - 26)))


def test_one_that_leaves_the_field_is_neither_fall_nor_success():
    flat = Field(np.zeros((2, 2)))
    parts = standing(envs=4)
    parts["qpos"][50:, 0, 0] = -9.6  # Left, and falls beyond the edge.
    parts["qpos"][60:, 0, 2] = -19.0
    parts["qpos"][50:, 1, 2] = 0.0  # Fell, and is pushed out.
    parts["qpos"][60:, 1, 1] = 9.6
    walk = walk_of(parts, flat)
    assert (walk.left, walk.upright, walk.not_done) == (0.25, 2 / 3, 1.0)
    assert walk.falls["low"] == 1
    first = walk_of({name: part[:, :1] for name, part in parts.items()}, flat)
    assert first.upright is None
    everywhere = {name: np.repeat(part[:, :1], 100, 1) for name, part in parts.items()}
    assert walk_of(everywhere, flat).walks is False


def test_heights_are_above_the_ground_under_the_robot():
    field = Field([[0.0, 0.0], [0.0, 0.0], [1.0, 1.0]])  # Rises to 0.5 m at y = 2 m.
    ground = Ground(field)
    heights = ground.height_m(np.array([[0.0, -2.0], [0.3, 1.0], [0.0, 2.0], [0.0, 9.0]]))
    assert heights == pytest.approx([0.0, 0.25, 0.5, 0.5])
    parts = standing()
    parts["qpos"][:, 0, 1:3] = [1.0, 0.38]  # 0.13 m above it.
    assert walk_of(parts, field).falls["low"] == 1


def test_the_field_has_x_along_its_rows():
    ground = Ground(Field([[0.0, 0.5, 1.0], [0.0, 0.5, 1.0]]))
    assert ground.height_m(np.array([[-1.0, 0.7], [1.0, 0.7]])) == pytest.approx([0.0, 0.5])


def test_jerk_is_the_third_difference_of_positions():
    parts = standing(10)
    parts["qpos"][:, 0, 7:] = (np.arange(10)[:, None] * DT_S) ** 3  # Its third derivative is 6.
    assert walk_of(parts).jerk_rad_per_s3 == pytest.approx(6.0, rel=1e-2)


def test_which_tasks_have_the_test():
    def robot(suite, name):
        return robot_of(EnvConfig(suite=suite, name=name, episode_length=None))

    assert robot("playground", "G1JoystickRoughTerrain") is ROBOTS["g1"]
    assert robot("playground", "g1_rough") is ROBOTS["g1"]
    assert robot("playground", "spot") is ROBOTS["spot"]
    assert robot("playground", "Go1Getup") is None
    assert robot("gmijax", "anymal") is None


def test_every_joystick_task_has_a_robot_and_a_key_that_turns_its_pushes_on():
    for name, theirs in NAMES.items():
        env = EnvConfig(suite="playground", name=name, episode_length=None)
        robot = robot_of(env)
        assert robot is not None
        assert with_pushes(env, robot).settings == {"push": 1.0}
        key = f"{robot.pushes}.enable"
        given = dataclasses.replace(env, name=theirs, settings={key: 0.0})
        assert with_pushes(given, robot).settings == {key: 1.0}


def test_pushes_of_the_test_are_those_of_the_task_however_the_run_was_trained():
    settings = {"noise": 0.5, "push_min_m_per_s": 1.0, "push_max_m_per_s": 9.0}
    env = EnvConfig(suite="playground", name="go1", episode_length=None, settings=settings)
    assert with_pushes(env, ROBOTS["go1"]).settings == {"noise": 0.5, "push": 1.0}


def test_heights_are_where_a_ray_of_mujoco_hits_the_ground():
    text = """
    <mujoco>
      <asset><hfield name="field" nrow="4" ncol="3" size="1.0 2.0 0.5 0.1"/></asset>
      <worldbody><geom type="hfield" hfield="field"/></worldbody>
    </mujoco>
    """
    model = mujoco.MjModel.from_xml_string(text)
    model.hfield_data[:] = np.random.default_rng(0).uniform(0, 1, 12)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    ground = Ground(model)
    # At the samples; between them MuJoCo has triangles.
    for x in (-0.999, 0.0, 0.999):
        for y in (-1.999, -2 / 3, 2 / 3, 1.999):
            start, down, hit = np.array([x, y, 5]), np.array([0.0, 0, -1]), np.zeros(1, np.int32)
            distance = mujoco.mj_ray(model, data, start, down, None, 1, -1, hit)
            assert ground.height_m(start[:2]) == pytest.approx(5.0 - distance, abs=5e-3)
