"""A named training command."""

from __future__ import annotations

from typing import NamedTuple


class Case(NamedTuple):
    """One command line of `python -m gmijax.train`.

    Attributes:
      name: what tables call it.
      overrides: its hydra overrides; `{run}` in them is the number of the repeat, 0 for the first.
      gpus: how many GPUs it needs.
    """

    name: str
    overrides: tuple[str, ...]
    gpus: int = 1
