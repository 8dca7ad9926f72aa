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


@pytest.mark.parametrize(("is_dead", "expected"), [(True, (1.5, -1.125)), (False, (6.0, -4.5))])
def test_a_replacement_may_keep_a_share_of_the_other_terms(
    is_dead: bool, expected: tuple[float, float]
):
    replacement = Replacement("death", jnp.array(is_dead), -2.0, keeps=0.25)
    reward, values = total_reward(TERMS, View(jnp.array(3.0)), replacement)
    assert (float(values["speed"]), float(values["cost"])) == expected
    assert float(values["death"]) == (-2.0 if is_dead else 0.0)
    assert float(reward) == sum(float(value) for value in values.values())
