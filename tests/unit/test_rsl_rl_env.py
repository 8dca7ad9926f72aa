"""Our environments as rsl_rl steps them; skipped where it is not installed."""

from __future__ import annotations

from typing import Any

import pytest
from toy_env import point_mass_env

torch: Any = pytest.importorskip("torch")
pytest.importorskip("rsl_rl")
from gmijax.sim.adapters import to_rsl_rl  # noqa: E402

NUM_ENVS, LENGTH = 4, 5


@pytest.fixture(scope="module")
def envs() -> Any:
    return to_rsl_rl.make(point_mass_env(LENGTH), NUM_ENVS)


def test_time_outs_are_reported(envs: Any):
    start, _ = envs.reset(seed=0)
    assert start["policy"].shape == (NUM_ENVS, 2)
    for step in range(1, LENGTH + 1):
        assert envs.episode_length_buf.tolist() == [step - 1] * NUM_ENVS
        obs, reward, done, extras = envs.step(torch.zeros(NUM_ENVS, envs.num_actions))
        assert done.all() == done.any() == (step == LENGTH)
        assert (extras["time_outs"] == done).all()
        assert reward.shape == (NUM_ENVS,)
        assert (obs["policy"] == start["policy"]).all() == (step < LENGTH)
    assert envs.episode_length_buf.tolist() == [0] * NUM_ENVS
    assert envs.get_observations()["policy"] is not None


def test_first_episodes_can_be_cut(envs: Any):
    envs.reset(seed=0)
    envs.episode_length_buf = torch.tensor([0, 1, 3, 4])
    assert envs.episode_length_buf.tolist() == [0, 1, 3, 4]
    ended = []
    for _ in range(LENGTH):
        _, _, done, _ = envs.step(torch.zeros(NUM_ENVS, 1))
        ended.append(done.tolist())
    assert [[row[index] for row in ended].index(True) + 1 for index in range(4)] == [5, 4, 2, 1]


def test_what_only_the_critic_sees_is_a_group_of_its_own():
    env = point_mass_env(LENGTH)
    envs = to_rsl_rl.make(env._replace(spec=env.spec._replace(actor_obs_size=1)), NUM_ENVS)
    obs = envs.get_observations()
    assert (obs["policy"].shape, obs["critic"].shape) == ((NUM_ENVS, 1), (NUM_ENVS, 2))
