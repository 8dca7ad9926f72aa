"""The latest episodes of a job, over which its lines of metrics take their means."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

WINDOW_EPISODES = 100
"""Means over episodes are taken over at least this many of the latest ones."""


class EpisodeTotals(NamedTuple):
    """Sums over the episodes that ended in one iteration, as `EpisodeSums`, on the host.

    `at` is the number of environment steps that were simulated by its end.
    """

    at: float
    count: float
    return_sum: float
    length_sum: float
    term_sums: Mapping[str, float]
    metric_sums: Mapping[str, float]


class Standing(NamedTuple):
    """How well a policy does, as a checkpoint keeps it.

    Attributes:
      mean_return: over the long window, None while no episode has ended.
      is_full: whether that window is full.
      limit_steps: a time limit of all environments together, in environment steps, None where it
        is not known.
    """

    mean_return: float | None = None
    is_full: bool = False
    limit_steps: float | None = None


class EpisodeWindow:
    """Means over the latest episodes.

    There are two windows. The short one is the fewest iterations that hold WINDOW_EPISODES: it is
    quick, but what it holds depends on when episodes end. Where environments are in step, it can
    hold short episodes alone, and at the start it always does. The long one spans at least a time
    limit of every environment too, so it holds episodes of every length as often as they occur. It
    is full when it is that long without the first time limit, in which only short episodes can
    end.

    Args:
      limit_steps: a time limit of all environments together, in environment steps.
    """

    def __init__(self, limit_steps: float = 0.0) -> None:
        self._limit = limit_steps
        self._steps = self._began = self._count = 0.0
        self._ended: deque[EpisodeTotals] = deque()
        self._names: tuple[str, ...] = ()

    def add(self, episodes: Any, steps: float = 0.0) -> None:
        """Adds the `EpisodeSums` of `steps` environment steps, as numbers of the host."""
        self._steps += steps
        self._names = _names_of(episodes)
        if not episodes.count:
            return
        self._ended.append(EpisodeTotals(self._steps, *episodes))
        self._count += episodes.count
        oldest = self._ended[0]
        while (
            oldest.at <= self._steps - self._limit
            and self._count - oldest.count >= WINDOW_EPISODES
        ):
            self._count -= self._ended.popleft().count
            oldest = self._ended[0]

    def means(self) -> dict[str, float | None]:
        """`return`, `episode_length`, `reward/<term>` and `metric/<name>` of the short window.

        None while no episode has ended.
        """
        count, first = 0.0, len(self._ended)
        while first and count < WINDOW_EPISODES:
            first -= 1
            count += self._ended[first].count
        return _means(list(self._ended)[first:], self._names)

    def line(self) -> dict[str, float | None]:
        """Means of both windows, how many episodes the long one has, and if it is full."""
        means = _means(self._ended, self._names)
        long = {f"window/{name}": mean for name, mean in means.items()}
        size = {"window/episodes": self._count, "window/full": int(self.standing().is_full)}
        return {**self.means(), **size, **long}

    def standing(self) -> Standing:
        """The mean return of the long window, and whether that is full."""
        # The first time limit, and another one after it.
        is_long = self._steps >= self._began + 2 * self._limit
        is_settled = bool(self._ended) and self._ended[0].at > self._began + self._limit
        is_full = self._count >= WINDOW_EPISODES and is_long and is_settled
        return Standing(_means(self._ended, ())["return"], is_full, self._limit or None)

    def state(self) -> dict[str, Any]:
        """All of it, for a JSON file of a checkpoint."""
        ended = [one._asdict() for one in self._ended]
        return {"steps": self._steps, "began": self._began, "ended": ended}

    def restore(self, state: Mapping[str, Any], *, envs_go_on: bool) -> None:
        """Continues from what `state` returned.

        Args:
          state: of the run that this one continues, with the same task.
          envs_go_on: whether environments are where they were; else all begin an episode now.
        """
        self._steps = state["steps"]
        self._began = state["began"] if envs_go_on else self._steps
        self._ended = deque(EpisodeTotals(**one) for one in state["ended"])
        self._count = sum(one.count for one in self._ended)


def _names_of(episodes: Any) -> tuple[str, ...]:
    """Under which terms and metrics of `EpisodeSums` are logged."""
    terms = (f"reward/{name}" for name in episodes.term_sums)
    return (*terms, *(f"metric/{name}" for name in episodes.metric_sums))


def _means(
    ended: Sequence[EpisodeTotals] | deque[EpisodeTotals], names: Sequence[str]
) -> dict[str, float | None]:
    count = sum(one.count for one in ended)
    if not count:
        return dict.fromkeys(("return", "episode_length", *names))
    return {
        "return": sum(one.return_sum for one in ended) / count,
        "episode_length": sum(one.length_sum for one in ended) / count,
        **{
            f"reward/{name}": sum(one.term_sums[name] for one in ended) / count
            for name in ended[-1].term_sums
        },
        **{
            f"metric/{name}": sum(one.metric_sums[name] for one in ended) / count
            for name in ended[-1].metric_sums
        },
    }
