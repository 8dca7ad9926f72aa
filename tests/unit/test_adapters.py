"""Environments with the interface of Brax as ours, and ours as Brax's."""

from __future__ import annotations

import sys
from importlib.machinery import ModuleSpec
from types import ModuleType, SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from brax import envs
from brax.envs.wrappers import training
from flax import struct
from mujoco import mjx
from training_jobs import POINT_TASK

from gmijax.cli.compose import compose
from gmijax.errors import ConfigError
from gmijax.learning.learner import make_learner
from gmijax.sim.adapters.brax_interface import adapt, observation
from gmijax.sim.adapters.playground import from_playground
from gmijax.sim.adapters.to_brax import BraxEnv
from gmijax.sim.interaction import action_repeat, time_limit
from gmijax.sim.interface import OVERFLOWS
from gmijax.sim.registry import make_env
from gmijax.sim.wrappers import env_keys, training_env

NUM_ENVS = 3
LENGTH = 5


class Counter:
    """Theirs, in miniature: writes into its dicts and returns plain numbers, as theirs do.

    It ends after `limit` steps, by truncation if `by_time`, and counts those of all episodes in
    `info`. An action below 0 breaks it.
    """

    action_size = 2
    dt = 0.5

    def __init__(self, limit: int = 4, by_time: bool = False) -> None:
        self.limit, self.by_time = limit, by_time

    def reset(self, rng: jax.Array) -> Any:
        rng, draw = jax.random.split(rng)
        assert rng.dtype == jnp.uint32
        info = {"rng": rng, "steps": jnp.zeros(()), "truncation": jnp.zeros(())}
        metrics = {"double": jnp.zeros(()), "pair": jnp.zeros(2)}
        obs = {"state": jax.random.uniform(draw, (3,)), "privileged_state": jnp.ones(5)}
        count: Any = jnp.zeros((), jnp.int32)
        return envs.State(count, obs, jnp.zeros(()), jnp.zeros(()), metrics, info)

    def step(self, state: Any, action: jax.Array) -> Any:
        count = state.pipeline_state + 1
        ended = count >= self.limit
        state.info["steps"] += jnp.where(action[0] < 0, jnp.nan, 1.0)
        state.info["truncation"] = ended * 1 if self.by_time else 0
        state.metrics.update(double=2.0, pair=jnp.ones(2))
        obs = {
            "state": state.obs["state"] + 1,
            "privileged_state": jnp.ones(5) * state.info["steps"],
        }
        return state.replace(
            pipeline_state=count, obs=obs, reward=jnp.sum(action), done=ended.astype(float)
        )


def unrolled(theirs: Counter, *actions: float) -> list[Any]:
    """States and outputs, the first state with None."""
    env = training_env(time_limit(adapt(theirs, name="theirs", episode_length=9), 9))
    state = jax.jit(env.init)(env.model, env_keys(jax.random.key(0), 0, NUM_ENVS))
    step = jax.jit(env.step)
    outputs: list[Any] = [(state, None)]
    for action in actions:
        state, out = step(env.model, state, jnp.full((NUM_ENVS, 2), action, jnp.float32))
        outputs.append((state, out))
    return outputs


def test_the_policy_sees_the_entry_state_and_the_value_function_all_or_both_all_entries():
    some, more = jnp.arange(2), jnp.array(5.0)
    assert observation({"b": some, "state": more, "a": some}).tolist() == [5.0]
    assert observation({"b": more, "a": some}).tolist() == [0.0, 1.0, 5.0]
    assert observation(some).dtype == jnp.float32
    privileged = {"b": jnp.array(8.0), "a": jnp.ones(1)}
    obs = {"state": some, "privileged_state": privileged}
    assert observation(obs).tolist() == [0.0, 1.0, 1.0, 8.0]
    env = adapt(Counter(), name="theirs", episode_length=9)
    assert (env.spec.obs_size, env.spec.actor_obs_size) == (8, 3)
    theirs = BraxEnv(env)
    assert theirs.observation_size == {"state": (3,), "privileged_state": (8,)}
    given: Any = theirs.reset(jax.random.key(0)).obs
    assert {name: part.shape for name, part in given.items()} == theirs.observation_size


@pytest.mark.parametrize(
    ("key", "sizes"), [("auto", [3, 8]), ("privileged_state", [3, 8]), ("state", [3, 3])]
)
def test_the_value_function_sees_what_value_obs_key_says(key: str, sizes: list[int]):
    spec = adapt(Counter(), name="theirs", episode_length=9).spec
    networks = make_learner(spec, compose(f"algo.value_obs_key={key}").algo).networks
    params = networks.init(jax.random.key(0), spec.obs_size)
    nets = (params.policy, params.value)
    assert [net["params"]["Dense_0"]["kernel"].shape[0] for net in nets] == sizes
    obs = jnp.arange(8.0)
    hidden = obs.at[3:].set(0.0)
    value, of_less = (networks.state_value(params, each) for each in (obs, hidden))
    assert (value == of_less) == (key == "state")
    np.testing.assert_array_equal(networks.output(params, obs), networks.output(params, hidden))


def test_a_value_function_cannot_see_more_where_there_is_no_more():
    spec = make_env("fast", suite="brax").spec
    make_learner(spec, compose("algo.value_obs_key=state").algo)
    message = r"^algo\.value_obs_key=privileged_state: brax/fast has no .* allowed: auto, state$"
    with pytest.raises(ConfigError, match=message):
        make_learner(spec, compose("algo.value_obs_key=privileged_state").algo)


def test_rewards_actions_and_metrics_of_an_episode():
    outputs = unrolled(Counter(), *[3.0] * 4)
    for _, out in outputs[1:]:
        assert out.reward.tolist() == [2.0] * NUM_ENVS, "actions are clipped to 1"
    assert not outputs[3][1].terminated.any()
    last = outputs[4][1]
    assert last.terminated.all()
    assert int(last.finished.count) == NUM_ENVS
    assert float(last.finished.return_sum) == NUM_ENVS * 8.0
    # As Brax's own wrapper sums them; a pair is no number that could be logged.
    assert {k: float(v) for k, v in last.finished.metric_sums.items()} == {"double": 24.0}


def test_an_environment_starts_over_where_it_began_and_keeps_their_info():
    """As with the automatic resets of Brax and Playground."""
    states = [state.env for state, _ in unrolled(Counter(), *[0.0] * 5)]
    first, before, after, then = (states[i] for i in (0, 3, 4, 5))
    assert len(np.unique(first.obs[:, 0])) == NUM_ENVS
    assert before.physics.pipeline_state.tolist() == [3] * NUM_ENVS
    assert after.physics.pipeline_state.tolist() == after.steps.tolist() == [0] * NUM_ENVS
    np.testing.assert_array_equal(after.obs, first.obs)
    np.testing.assert_array_equal(after.physics.obs["state"], first.physics.obs["state"])
    assert then.physics.pipeline_state.tolist() == [1] * NUM_ENVS
    assert then.task.info["steps"].tolist() == [5.0] * NUM_ENVS
    np.testing.assert_array_equal(then.task.info["rng"], first.task.info["rng"])


def test_an_environment_that_diverged_keeps_their_info_of_one_step_earlier():
    (state, _), (_, out), (last, _) = unrolled(Counter(), 0.0, -1.0, 0.0)[1:]
    assert state.env.task.info["steps"].tolist() == [1.0] * NUM_ENVS
    assert out.is_diverged.all()
    assert last.env.task.info["steps"].tolist() == [2.0] * NUM_ENVS


def test_no_step_computes_a_reset():
    theirs = Counter()
    env = training_env(adapt(theirs, name="theirs", episode_length=9))
    state = jax.eval_shape(env.init, env.model, env_keys(jax.random.key(0), 0, NUM_ENVS))
    theirs.reset = lambda rng: pytest.fail("a step called reset")
    jax.eval_shape(env.step, env.model, state, jnp.zeros((NUM_ENVS, 2)))


def test_their_own_time_limit_truncates():
    out = unrolled(Counter(by_time=True), *[0.0] * 4)[-1][1]
    assert out.truncated.all()
    assert not out.terminated.any()


def test_a_step_leaves_the_state_that_it_is_given_alone():
    env = adapt(Counter(), name="theirs", episode_length=9)
    state = env.reset(env.model, jax.random.key(0))
    env.step(env.model, state, jnp.zeros(2))
    assert float(state.task.info["steps"]) == 0.0


class Traced(Counter):
    """Counts how often Python goes through its functions."""

    resets = steps = 0

    def reset(self, rng: jax.Array) -> Any:
        self.resets += 1
        return super().reset(rng)

    def step(self, state: Any, action: jax.Array) -> Any:
        self.steps += 1
        return super().step(state, action)


def test_however_many_programs_have_an_environment_it_is_traced_once():
    theirs = Traced()
    unrolled(theirs, 0.0, 0.0)
    assert (theirs.resets, theirs.steps) == (1, 1)


class Seeing(Counter):
    def reset(self, rng: jax.Array) -> Any:
        return super().reset(rng).replace(obs={"pixels": jnp.zeros((4, 4, 3))})


class Growing(Counter):
    def step(self, state: Any, action: jax.Array) -> Any:
        return state.replace(info={**state.info, "rng": jnp.zeros(3, jnp.uint32)})


@pytest.mark.parametrize(
    ("theirs", "message"),
    [
        (Seeing, r"\['pixels'\] has shape \(4, 4, 3\); allowed: vectors"),
        (Growing, r"task\.info\.rng is uint32\[3\], not uint32\[2\]$"),
    ],
)
def test_pictures_and_states_that_change_are_refused(theirs: type[Counter], message: str):
    with pytest.raises(ConfigError, match=message):
        adapt(theirs(), name="theirs", episode_length=9)


def test_an_environment_of_brax_without_a_model_still_trains():
    env = make_env("fast", suite="brax", episode_length=5)
    assert env.mj_model is None
    assert (env.spec.name, env.spec.obs_size, env.spec.episode_length) == ("brax/fast", 2, 5)
    batch = training_env(env)
    state = batch.init(batch.model, env_keys(jax.random.key(0), 0, NUM_ENVS))
    for _ in range(5):
        state, out = jax.jit(batch.step)(batch.model, state, jnp.ones((NUM_ENVS, 1)))
    assert out.truncated.all()
    assert float(out.reward[0]) > 0.0


BALL_ABOVE_FLOOR = """
<mujoco>
  <worldbody>
    <geom type="plane" size="0 0 1"/>
    <body name="ball" pos="0 0 0.2"><freejoint/><geom size="0.1"/></body>
  </worldbody>
</mujoco>
"""


class WarpBall:
    """Playground's interface with MJX-Warp: a ball falls, and the episode ends on the floor."""

    action_size, dt = 1, 0.02

    heights_m, naconmax = (0.11, 0.3), 4

    def __init__(self) -> None:
        self.mj_model = mujoco.MjModel.from_xml_string(BALL_ABOVE_FLOOR)
        self._mjx_model = mjx.put_model(self.mj_model, impl="warp")

    @property
    def mjx_model(self) -> Any:
        return self._mjx_model

    def reset(self, rng: jax.Array) -> Any:
        data = mjx.make_data(self.mj_model, impl="warp", naconmax=self.naconmax, njmax=8)
        low, high = self.heights_m
        height = jax.random.uniform(rng, minval=low, maxval=high)
        data = mjx.forward(self.mjx_model, data.replace(qpos=data.qpos.at[2].set(height)))
        return State(data, data.qpos, jnp.zeros(()), jnp.zeros(()), {}, {})

    def step(self, state: Any, action: jax.Array) -> Any:
        data = mjx.step(self.mjx_model, state.data)
        has_landed = (data.qpos[2] < 0.1).astype(jnp.float32)
        return state.replace(data=data, obs=data.qpos, done=has_landed)


class WarpBalls(WarpBall):
    """All touch the floor in one step and are lifted; there is room for one contact."""

    heights_m, naconmax = (0.15, 0.15), 1

    def step(self, state: Any, action: jax.Array) -> Any:
        data = mjx.step(self.mjx_model, state.data)
        height = jnp.where(data.qpos[2] < 0.0999, 0.15, data.qpos[2])
        data = data.replace(qpos=data.qpos.at[2].set(height))
        return state.replace(data=data, obs=data.qpos)


@struct.dataclass
class State:
    """As Playground's."""

    data: Any
    obs: Any
    reward: Any
    done: Any
    metrics: Any
    info: Any


@pytest.mark.parametrize("times", [1, 2])
def test_states_of_playground_in_warp_start_over_one_by_one(times: int):
    pytest.importorskip("warp")
    env = action_repeat(from_playground(WarpBall(), name="ball"), times)
    batch = training_env(env)
    state = batch.init(batch.model, env_keys(jax.random.key(0), 0, NUM_ENVS))
    assert state.env.physics.data._impl.contact__dist.shape == (4,), "all environments share it"
    first, step, landed = state.env.obs, jax.jit(batch.step), np.zeros(NUM_ENVS, int)
    for _ in range(150 // times):
        before = state
        state, out = step(batch.model, state, jnp.zeros((NUM_ENVS, 1)))
        landed += np.asarray(out.terminated)
        assert int(out.overflowed["contact"]) == 0
        over = np.asarray(out.terminated)
        np.testing.assert_array_equal(state.env.obs[over], first[over])
        assert (state.env.obs[~over, 2] < before.env.obs[~over, 2]).all()
        assert np.isfinite(out.next_obs).all()
    assert landed.min() >= 1
    assert len(set(landed.tolist())) > 1, "the lower ones land more often"
    assert batch.overflows == OVERFLOWS


def test_an_overflow_of_playground_in_warp_is_reported_in_its_own_step_alone():
    pytest.importorskip("warp")
    env = from_playground(WarpBalls(), name="balls")
    batch = training_env(env)
    state = batch.init(batch.model, env_keys(jax.random.key(0), 0, NUM_ENVS))
    step, reported, lifted = jax.jit(batch.step), [], []
    for _ in range(60):
        before = state.env.obs[:, 2]
        state, out = step(batch.model, state, jnp.zeros((NUM_ENVS, 1)))
        reported.append(int(out.overflowed["contact"]) > 0)
        lifted.append(bool((state.env.obs[:, 2] > before).any()))
    assert sum(lifted) == 1
    np.testing.assert_array_equal(reported, lifted)


def test_an_environment_of_brax_brings_its_model_and_length():
    env = make_env("inverted_pendulum", suite="brax")
    assert env.mj_model.nq == 2
    assert env.spec.actor_obs_size is None
    assert env.spec[1:5] == (4, 1, pytest.approx(0.04), 1000)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("antt", {}, r"^env=antt: unknown task: did you mean ant\?$"),
        ("Go1", {}, r"^env=Go1: unknown task: did you mean go1\?$"),
        ("xyzzy", {}, r"^env=xyzzy: unknown task; allowed: ant, anymal, .*g1, g1_rough, go1, "),
        ("cart.txt:make", {}, r"^env=cart\.txt:make: expected PATH\.py:FUNCTION, e\.g\. path"),
        ("ant", {"episode_length": 0}, r"^env\.episode_length=0: must be at least 1$"),
        ("antt", {"suite": "brax"}, r"^env\.name=antt: Brax has .*did you mean ant\?$"),
        (
            "ant",
            {"suite": "brax", "impl": "warp"},
            r"^physics\.impl=warp: .*allowed: auto, jax",
        ),
        ("ant", {"suite": "brax", "rewards": {"a": 1}}, r"^env\.rewards\.a: not with env=brax"),
        (
            "ant",
            {"rewards": {"enrgy": 1}},
            r"^unknown key env\.rewards\.enrgy: did you mean",
        ),
        (
            "ant",
            {"settings": {"x": 1}},
            r"^unknown key env\.settings\.x; allowed: death",
        ),
        ("ant", {"curriculum": True}, "^env.curriculum=on: ant has none; allowed: anymal and"),
        ("ant", {"suite": "gym"}, "^suite=gym: expected one of gmijax, brax, playground, custom$"),
        ("ant", {"api": "gym"}, "^api=gym: expected one of gmijax, brax$"),
        ("ant", {"api": "brax", "episode_length": 3}, "give it to Brax's EpisodeWrapper"),
    ],
)
def test_what_cannot_be_made_is_an_error_of_one_line(name: str, options: Any, message: str):
    with pytest.raises(ConfigError, match=message):
        make_env(name, **options)


def test_what_playground_cannot_make_is_one_line(monkeypatch: pytest.MonkeyPatch):
    def load(name: str, config_overrides: Any) -> None:
        raise AttributeError("'MjSpec' object has no attribute 'find_body'")

    registry = SimpleNamespace(
        ALL_ENVS=("Go1Joystick", "Reacher"),
        get_default_config=lambda name: Config({"name": name}),
        load=load,
    )
    package = ModuleType("mujoco_playground")
    package.__dict__.update(__spec__=ModuleSpec(package.__name__, None), registry=registry)
    monkeypatch.setitem(sys.modules, "mujoco_playground", package)
    monkeypatch.setitem(sys.modules, "mujoco_playground._src.mjx_env", SimpleNamespace())
    with pytest.raises(ConfigError, match="did you mean Go1Joystick"):
        make_env("Go1Joystic", suite="playground")
    with pytest.raises(ConfigError, match=r"^env\.name=Reacher fails: AttributeError: 'MjSpec'"):
        make_env("Reacher", suite="playground")


class Config(dict[str, Any]):
    """A configuration of Playground."""

    def to_dict(self) -> dict[str, Any]:
        return dict(self)


def test_playground_as_ours():
    pytest.importorskip("mujoco_playground")
    env = make_env("CartpoleBalance", suite="playground")
    assert env.spec[:5] == ("playground/CartpoleBalance", 5, 1, 0.01, 1000)
    assert "reward/upright" in env.spec.metrics
    assert env.mj_model.nq == 2
    with pytest.raises(ConfigError, match="did you mean CartpoleBalance"):
        make_env("CartpoleBalanc", suite="playground")


class Theirs(NamedTuple):
    """Our task under Brax's wrappers, as Brax's training makes it."""

    env: Any
    step: Any
    states: list[Any]


@pytest.fixture(scope="module")
def ours(tmp_path_factory: pytest.TempPathFactory) -> Theirs:
    file = tmp_path_factory.mktemp("task") / "point.py"
    file.write_text(POINT_TASK)
    env = make_env(f"{file}:make", api="brax")
    wrapped = training.wrap(env, episode_length=LENGTH)
    keys = jax.random.split(jax.random.PRNGKey(0), NUM_ENVS)
    states = [jax.jit(wrapped.reset)(keys)]
    step = jax.jit(wrapped.step)
    for _ in range(6):
        states.append(step(states[-1], jnp.full((NUM_ENVS, 1), 0.3)))
    return Theirs(env, step, states)


def test_ours_is_an_environment_of_brax(ours: Theirs):
    env = ours.env
    assert envs.Env in type(env).mro()
    assert (env.observation_size, env.action_size, env.backend) == (2, 1, "mjx")
    assert (env.episode_length, env.dt, env.mj_model) == (20, pytest.approx(0.1), None)
    for state in ours.states:
        assert state.obs.shape == (NUM_ENVS, 2)
        assert (state.reward.shape, state.done.shape) == ((NUM_ENVS,), (NUM_ENVS,))


def test_terms_of_the_reward_are_brax_metrics_and_sum_to_it(ours: Theirs):
    for state in ours.states[1:]:
        assert set(state.metrics) == {"reward/near", "reward/effort"}
        np.testing.assert_allclose(sum(state.metrics.values()), state.reward, atol=1e-6)
    summed = ours.states[LENGTH].info["episode_metrics"]
    total = sum(np.asarray(summed[name]) for name in ours.states[LENGTH].metrics)
    np.testing.assert_allclose(total, summed["sum_reward"], rtol=1e-5)


def test_brax_truncates_ours_at_its_own_limit_and_starts_over(ours: Theirs):
    ends = [np.asarray(state.done).tolist() for state in ours.states]
    assert ends == [[0.0] * NUM_ENVS] * LENGTH + [[1.0] * NUM_ENVS, [0.0] * NUM_ENVS]
    assert ours.states[LENGTH].info["truncation"].tolist() == [1.0] * NUM_ENVS
    np.testing.assert_array_equal(ours.states[LENGTH].obs, ours.states[0].obs)
    assert ours.states[LENGTH + 1].pipeline_state.steps.tolist() == [1] * NUM_ENVS


def test_ours_keeps_the_metrics_of_brax_evaluation(ours: Theirs):
    wrapped = training.EvalWrapper(training.wrap(ours.env, episode_length=LENGTH))
    keys = jax.random.split(jax.random.PRNGKey(0), NUM_ENVS)
    first: Any = jax.eval_shape(wrapped.reset, keys)
    then: Any = jax.eval_shape(wrapped.step, first, jnp.zeros((NUM_ENVS, 1)))
    assert set(then.metrics) == {"reward", "reward/near", "reward/effort"}
    assert jax.tree.structure(then) == jax.tree.structure(first)


def test_an_end_by_the_task_is_no_truncation(ours: Theirs):
    state = ours.states[0]
    position, velocity = state.pipeline_state.physics
    thrown = state.pipeline_state._replace(physics=(position.at[0].set(9.0), velocity))
    state = ours.step(state.replace(pipeline_state=thrown), jnp.zeros((NUM_ENVS, 1)))
    assert state.done.tolist() == [1.0, 0.0, 0.0]
    assert state.info["truncation"].tolist() == [0.0] * NUM_ENVS
