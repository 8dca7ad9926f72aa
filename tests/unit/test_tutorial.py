"""What the tutorial says to change in a file does what it says."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import jax
import pytest

from gmijax.sim.rewards import term_names, total_reward

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/tutorial/reward.md").read_text()
EXAMPLE = (ROOT / "examples/custom_task.py").read_text()


def blocks(heading: str) -> list[str]:
    """The Python of a section of the page."""
    section = PAGE.partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    return re.findall(r"```python\n(.*?)```", section, re.DOTALL)


def test_the_terms_that_the_page_shows_are_those_of_the_file():
    (terms,) = blocks("Other weights")
    assert terms in EXAMPLE


def test_a_term_of_ones_own_takes_the_lines_that_the_page_shows(tmp_path: Path):
    view, term, reward = blocks("A term of your own")
    changed = []
    for line in EXAMPLE.splitlines(keepends=True):
        by_start = [
            new for new in (view, reward) if line.partition("(")[0] == new.partition("(")[0]
        ]
        changed += by_start or [line]
        if line.startswith('    "effort"'):
            changed.append(term)
    file = tmp_path / "spin.py"
    file.write_text("".join(changed))
    task = runpy.run_path(str(file))
    env = task["make"](impl="jax")
    assert "spin" in env.spec.reward_terms

    def one_step(model, key):
        state = env.reset(model, key)
        return env.step(model, state, jax.numpy.zeros(1))

    jax.eval_shape(one_step, env.model, jax.random.key(0))
    fast = task["View"](jax.numpy.zeros(2), jax.numpy.array([0.0, 3.0]), jax.numpy.zeros(1))
    terms = task["TERMS"]
    assert term_names(terms)[-1] == "spin"
    assert total_reward(terms, fast)[1]["spin"] == pytest.approx(-0.009)
