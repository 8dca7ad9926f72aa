"""How many jobs at once make the most of a GPU, found with the jobs that have to be run anyway.

One, four, eight and so on, while more raise the sum of their rates; a step too far is taken back
at once by ending the newest jobs, which have done little. Gandiva (OSDI 2018) packs on trial and
undoes it in the same way.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

GAIN: Final = 0.05
"""What more jobs must add to the sum of rates, or fewer are as good."""

_FIRST_STEP: Final = 4
"""After one. A window with two at once would cost most GPUs half of their rate."""

_WARM_REPORTS: Final = 3
"""Reports of a job that are not measured: compiling and the first updates are in them."""

_LEAST_REPORTS: Final = 6
_LEAST_WINDOW_S: Final = 20.0
_LONGEST_WINDOW_S: Final = 120.0


class JobProgress(NamedTuple):
    """How far a job is that runs.

    Attributes:
      done: steps, or the part of the whole that is done: what is summed over jobs.
      reports: how often it has reported so since it was started.
    """

    done: float
    reports: int


class MeasuredRate(NamedTuple):
    """Sum of the rates of some jobs at once.

    Attributes:
      per_s: their sum.
      error: its standard error, from the two halves of the window.
    """

    per_s: float
    error: float


class Decision(NamedTuple):
    """A change of the number at once.

    Attributes:
      target: jobs at once from now on; where more run, the newest are ended.
      why: in one line.
    """

    target: int
    why: str


class ConcurrencySearch:
    """Chooses the number of jobs at once on one GPU.

    Attributes:
      target: the number now.
      is_settled: whether it stays so.
      measured: what was measured, by number at once.

    Args:
      most: what memory, cores and the limit of clients allow; it may sink later.
      start: the number at once that is measured first.
    """

    def __init__(self, most: int, start: int = 1) -> None:
        self.most = max(1, most)
        self.target = start
        self.is_settled = self.most == 1
        self.measured: dict[int, MeasuredRate] = {}
        self._window: _RateWindow | None = None

    def look(self, now_s: float, jobs: Mapping[int, JobProgress]) -> Decision | None:
        """Updates the progress of all jobs of the GPU; returns what to change, if anything.

        Args:
          now_s: by a clock that never goes back.
          jobs: those that run, by number.
        """
        if self.is_settled or len(jobs) != self.target:
            self._window = None  # Some are still to be started, or too few are left.
            return None
        if self._window is None or not self._window.goes_on(jobs):
            is_warm = all(seen.reports >= _WARM_REPORTS for seen in jobs.values())
            self._window = _RateWindow(now_s, jobs) if is_warm else None
            return None
        found = self._window.look(now_s, jobs)
        before = self._smaller()
        if found is None or (before is not None and self._is_unclear(found, before, now_s)):
            return None
        self._window = None
        self.measured[self.target] = found
        return self._next(found, before)

    def assume(self, count: int, why: str) -> Decision:
        """So many at once until rates are there."""
        return self._go_to(min(count, self.most), why)

    def forget(self) -> None:
        """What was measured cannot be compared with what comes."""
        self.measured, self._window, self.is_settled = {}, None, self.most == 1

    def ended_early(self) -> Decision | None:
        """A job has completed before so many at once could be measured: jobs are short."""
        if self.is_settled or self.target in self.measured or self.target == self.most:
            return None
        return self._go_to(self._after(self.target), "jobs end before a rate is measured")

    def forbid(self, count: int, why: str) -> Decision | None:
        """Rules out `count` jobs at once, e.g. because one of them ran out of memory."""
        self.most = max(1, min(self.most, count - 1))
        return self.settle(self.most, why) if self.target > self.most else None

    def _next(self, found: MeasuredRate, before: MeasuredRate | None) -> Decision | None:
        count, fewer = self.target, max((k for k in self.measured if k < self.target), default=0)
        middle = (fewer + count) // 2
        is_new = before is not None and middle > fewer and middle not in self.measured
        if before is not None and not _gains(found, before):
            gain = (
                f"{count} at once make {found.per_s / before.per_s:.2f} times the rate of {fewer}"
            )
            # Between a middle and what is below it nothing is tried.
            if is_new and count == self._after(fewer):
                return self._go_to(middle, gain)
            return self.settle(fewer, gain)
        # Two at once make at most twice the rate of one, so four that make more are better.
        if before is not None and is_new and fewer == 1 and found.per_s < middle * before.per_s:
            return self._go_to(middle, self._gain(count))
        larger = min((k for k in self.measured if k > count), default=0)
        if larger and not _gains(self.measured[larger], found):
            return self.settle(count, f"{count} at once make the most")
        best = larger or count
        if best == self.most:
            return self.settle(best, f"{best} at once make the most")
        return self._go_to(self._after(best), self._gain(best))

    def _after(self, count: int) -> int:
        return min(_FIRST_STEP if count == 1 else 2 * count, self.most)

    def _gain(self, count: int) -> str:
        """What so many at once were found to make."""
        if count == 1 or 1 not in self.measured:
            return f"{self.measured[count].per_s:,.4g} a second with {count}"
        gain = self.measured[count].per_s / self.measured[1].per_s
        return f"{count} at once make {gain:.2f} times the rate of one"

    def _smaller(self) -> MeasuredRate | None:
        fewer = [k for k in self.measured if k < self.target]
        return self.measured[max(fewer)] if fewer else None

    def _is_unclear(self, found: MeasuredRate, before: MeasuredRate, now_s: float) -> bool:
        """Whether a longer window may decide otherwise."""
        assert self._window is not None
        limit = (1 + GAIN) * before.per_s
        error = 2 * (found.error**2 + before.error**2) ** 0.5
        is_close = abs(found.per_s - limit) < error
        return is_close and now_s - self._window.started_s < _LONGEST_WINDOW_S

    def _go_to(self, count: int, why: str) -> Decision:
        self.target, self._window = count, None
        return Decision(count, why)

    def settle(self, count: int, why: str) -> Decision | None:
        """So many at once from now on; None: it was so before."""
        was_settled, before = self.is_settled, self.target
        self.is_settled = True
        decision = self._go_to(count, why)
        return decision if count != before or not was_settled else None


class _RateWindow:
    """Rates of the same jobs over some time: of each between two of its reports."""

    def __init__(self, now_s: float, jobs: Mapping[int, JobProgress]) -> None:
        self.started_s = now_s
        self.jobs = set(jobs)
        self._latest = dict(jobs)
        self._points: dict[int, list[tuple[float, float]]] = {number: [] for number in jobs}

    def goes_on(self, jobs: Mapping[int, JobProgress]) -> bool:
        """Whether they are the same jobs, and none was started again."""
        return self.jobs == set(jobs) and all(
            seen.reports >= self._latest[number].reports for number, seen in jobs.items()
        )

    def look(self, now_s: float, jobs: Mapping[int, JobProgress]) -> MeasuredRate | None:
        """The sum of rates; None: not enough was seen."""
        for number, seen in jobs.items():
            if seen.reports > self._latest[number].reports:
                self._points[number].append((now_s, seen.done))
        self._latest = dict(jobs)
        least = min(map(len, self._points.values()))
        if now_s - self.started_s < _LEAST_WINDOW_S or least <= _LEAST_REPORTS:
            return None
        halves = [
            (points[: len(points) // 2 + 1], points[len(points) // 2 :])
            for points in self._points.values()
        ]
        variance = sum((_rate(first) - _rate(last)) ** 2 / 4 for first, last in halves)
        return MeasuredRate(sum(map(_rate, self._points.values())), variance**0.5)


def _gains(found: MeasuredRate, before: MeasuredRate) -> bool:
    return found.per_s >= (1 + GAIN) * before.per_s


def _rate(points: Sequence[tuple[float, float]]) -> float:
    (start_s, first), (end_s, last) = points[0], points[-1]
    return (last - first) / max(1e-9, end_s - start_s)
