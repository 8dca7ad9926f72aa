"""What well-known trainers print of their progress, as regular expressions.

Each was tried on output of the named version, or written from the format strings of its source.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import suppress
from typing import Final, NamedTuple

_NUMBER: Final = r"(-?(?:\d[\d.]*(?:e[+-]?\d+)?|nan|inf))"


class Report(NamedTuple):
    """The values in a line; None for those that it does not have.

    Attributes:
      steps: of environments, so far.
      total: of these, at the end.
      rate: steps per second.
      metric: by which jobs are compared, e.g. the mean return.
    """

    steps: float | None = None
    total: float | None = None
    rate: float | None = None
    metric: float | None = None


class Family(NamedTuple):
    """How trainers of one kind print.

    Attributes:
      name: of the trainer.
      patterns: regular expressions with groups `steps`, `total`, `rate` and `metric`.
      is_average: whether the printed rate is that since the start, not that of the moment.
      is_weak: whether programs that are no trainers print so too; another family that fits
        later replaces it.
    """

    name: str
    patterns: tuple[re.Pattern[str], ...]
    is_average: bool = False
    is_weak: bool = False

    def read(self, line: str) -> Report | None:
        """The values in a line; None: it has none."""
        for pattern in self.patterns:
            if match := pattern.search(line):
                return report_of(match.groupdict())
        return None


def report_of(found: Mapping[str, str | None]) -> Report | None:
    """The values of texts that are numbers; None: none is."""
    numbers: dict[str, float] = {}
    for key, text in found.items():
        with suppress(ValueError):  # `12.5.` at the end of a sentence, or `n/a`.
            numbers[key] = float((text or "").replace(",", "").rstrip("."))
    return Report(**numbers) if numbers else None


def _family(name: str, *patterns: str, is_average: bool = False, is_weak: bool = False) -> Family:
    return Family(name, tuple(map(re.compile, patterns)), is_average, is_weak)


FAMILIES: Final = (
    _family(
        "rsl_rl, Isaac Lab, mjlab",  # 5.x
        r"^\s*Total steps:\s+(?P<steps>\d+)\s*$",
        r"^\s*Steps per second:\s+(?P<rate>[\d.]+)\s*$",
        rf"^\s*Mean reward:\s+(?P<metric>{_NUMBER})\s*$",
    ),
    _family(
        "rsl_rl",  # 2.x and 3.x
        r"^\s*Total timesteps:\s+(?P<steps>\d+)\s*$",
        r"^\s*Computation:\s+(?P<rate>[\d.]+) steps/s",
        rf"^\s*Mean reward:\s+(?P<metric>{_NUMBER})\s*$",
    ),
    _family(
        "Stable-Baselines3",
        r"^\|\s+total_timesteps\s+\|\s+(?P<steps>[\d.e+]+)\s*\|$",
        r"^\|\s+fps\s+\|\s+(?P<rate>[\d.e+]+)\s*\|$",
        rf"^\|\s+ep_rew_mean\s+\|\s+(?P<metric>{_NUMBER})\s*\|$",
        is_average=True,
    ),
    _family(
        "CleanRL",
        rf"^global_step=(?P<steps>\d+), (?:avg_)?episodic_return=\[?\s*(?P<metric>{_NUMBER})",
        r"^SPS:\s*(?P<rate>\d+)\s*$",
        is_average=True,
    ),
    _family(
        "rl_games",
        r"^fps step: [\d.]+ fps step and policy inference: [\d.]+ fps total: (?P<rate>[\d.]+) "
        r"epoch: \d+(?:/\d+)? frames: (?P<steps>\d+)(?:/(?P<total>\d+))?",
        rf"saving next best rewards:\s+\[?(?P<metric>{_NUMBER})",
    ),
    _family(
        "MuJoCo Playground's train_jax_ppo.py",
        rf"^(?P<steps>\d+): (?:mean episode )?reward=(?P<metric>{_NUMBER})\s*$",
    ),
    _family(
        "gmijax",
        r"^\d+ %  (?P<steps>[\d,]+) steps(?:  (?P<rate>[\d,]+) steps/s)?"
        rf"(?:.*?  return (?P<metric>{_NUMBER}))?",
    ),
    _family(
        "skrl (tqdm)",
        r"\s(?P<steps>\d+)/(?P<total>\d+) \[[\d:]+<[\d:?]+,\s*(?:(?P<rate>[\d.]+)it/s)?",
        is_weak=True,
    ),
)
"""The first that fits is taken, so the stricter ones come first."""
