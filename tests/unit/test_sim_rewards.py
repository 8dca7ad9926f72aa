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
OF_TERMS = {"speed": 6.0, "cost": -4.5, "off": 0.0}


@pytest.mark.parametrize(
    ("dead", "terms"),
    [
        (None, OF_TERMS),
        (True, {"speed": 0.0, "cost": 0.0, "off": 0.0, "death": -2.0}),
        (False, {**OF_TERMS, "death": 0.0}),
    ],
)
def test_reward_is_the_weighted_sum_or_its_replacement(dead: bool | None, terms: dict[str, float]):
    replacement = None if dead is None else Replacement("death", jnp.array(dead), -2.0)
    reward, values = total_reward(TERMS, View(jnp.array(3.0)), replacement)
    assert {name: float(value) for name, value in values.items()} == terms
    assert float(reward) == sum(terms.values())
    assert term_names(TERMS, None if dead is None else "death") == tuple(terms)
