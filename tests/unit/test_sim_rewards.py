from typing import NamedTuple

import jax
import jax.numpy as jnp
import pytest

from gmijax.sim.rewards import Replacement, RewardTerm, term_names, total_reward


class View(NamedTuple):
    speed: jax.Array


def never(view: View) -> jax.Array:
    raise AssertionError("a term of weight 0 was traced")


TERMS = {
    "speed": RewardTerm[View](lambda v: v.speed, 2.0),
    "cost": RewardTerm[View](lambda v: v.speed**2, -0.5),
    "off": RewardTerm[View](never, 0.0),
}


def test_reward_is_the_weighted_sum_and_weight_zero_is_not_traced():
    reward, values = total_reward(TERMS, View(jnp.array(3.0)))
    assert {name: float(value) for name, value in values.items()} == {"speed": 6.0, "cost": -4.5}
    assert float(reward) == 1.5


@pytest.mark.parametrize(("dead", "expected"), [(True, -2.0), (False, 1.5)])
def test_replacement_takes_the_place_of_all_terms(dead: bool, expected: float):
    replacement = Replacement("death", jnp.array(dead), -2.0)
    reward, values = total_reward(TERMS, View(jnp.array(3.0)), replacement)
    assert float(reward) == expected == float(sum(values.values()))
    assert float(values["death"]) == (-2.0 if dead else 0.0)


def test_names_are_those_that_are_logged():
    assert term_names(TERMS) == ("speed", "cost")
    assert term_names(TERMS, "death") == ("speed", "cost", "death")
    assert term_names({}) == ()
