"""Synchronous training with trainers in GMIs of their own (`tdg_ex`), as data. No jax here."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Final

from gmijax.collectives.pipe_block import create_pipes
from gmijax.partition.child import ENV_PIPES_FD
from gmijax.partition.plan import Plan

MODULE: Final = "gmijax.workers.dedicated_worker"
"""Main of every GMI, started by name."""

PIPE_BYTES: Final = 16 << 20
"""Capacity of a pipe between trainer and servant; what is larger goes in pieces."""


def is_dedicated(plan: Plan) -> bool:
    """Whether trainers have GMIs of their own, and wait for those that serve them."""
    return plan.template == "tdg_ex"


def shared_blocks(plan: Plan) -> Mapping[str, Callable[[], int]]:
    """What the GMIs of a job share, for `Launch.shared`."""
    return {ENV_PIPES_FD: partial(create_pipes, plan.layout.num_gmis, PIPE_BYTES)}
