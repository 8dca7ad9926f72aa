"""An environment whose functions are traced once, however many programs they are in.

To trace a step of a robot takes a second or two. A job asks for its shapes, makes first states,
and has reset and step in its training and its evaluation.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax

from gmijax.sim.interface import Env

inlined: Callable[..., Callable[..., Any]] = partial(jax.jit, inline=True)
"""Keeps what it traced; a program that calls it has its operations, not a call."""


def traced_once(env: Env) -> Env:
    """`env` with functions that keep what was traced; they give what they gave."""
    again = env.next_episode and inlined(env.next_episode)
    return env._replace(reset=inlined(env.reset), step=inlined(env.step), next_episode=again)
