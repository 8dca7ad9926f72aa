"""From what a program prints to lines of metrics, as a run of gmijax writes them.

Rates are not taken from the printed text where it names steps: a printed rate is often the mean
since the start, which hides what a neighbour on the GPU costs. Steps are compared with the own
clock instead.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple

from gmijax.clock import running_s
from gmijax.config.pack import METRIC
from gmijax.errors import ConfigError
from gmijax.packs.event_files import EventReader
from gmijax.packs.output import OutputReader
from gmijax.packs.trainers import FAMILIES, Family, Report, report_of

_REPORTS: Final = 5
"""A rate is that over so many reports: the first update of a trainer can take 15 times longer."""


class OwnPatterns(NamedTuple):
    """Regular expressions of the user, each with one group, by what they find.

    Attributes:
      patterns: by the name of a field of `Report`.
    """

    patterns: Mapping[str, re.Pattern[str]]

    def read(self, line: str) -> Report | None:
        """The progress in a line; None: it has none."""
        found = {key: pattern.search(line) for key, pattern in self.patterns.items()}
        return report_of({key: match[1] for key, match in found.items() if match})


def own_patterns(rate: str | None, steps: str | None, metric: str | None) -> OwnPatterns | None:
    """The user's regular expressions (`pack.rate` and so on); None without any.

    Raises:
      ConfigError: one cannot be compiled, or has not one group.
    """
    given = {"rate": rate, "steps": steps, "metric": metric}
    found = {key: _compiled(key, text) for key, text in given.items() if text is not None}
    return OwnPatterns(found) if found else None


def _compiled(key: str, text: str) -> re.Pattern[str]:
    try:
        pattern = re.compile(text)
    except re.error as error:
        raise ConfigError(f"pack.{key}={text}: no regular expression: {error}") from None
    if pattern.groups != 1:
        raise ConfigError(
            f"pack.{key}={text}: has {pattern.groups} groups; expected one, around the number"
        )
    return pattern


class ProgressReader:
    """Follows the output of one job; a line of metrics for every report of steps, or of a rate.

    Attributes:
      family: how it prints; None until two lines of one family have come.

    Args:
      output: its lines.
      own: the user's expressions; they are read beside a known family, and win over it.
      started_s: when the process started, by the same clock.
      events: its TensorBoard files. Their values are the metric; their steps count where the
        output names none.
      clock: seconds.
    """

    def __init__(
        self,
        output: OutputReader,
        own: OwnPatterns | None,
        started_s: float,
        events: EventReader | None = None,
        clock: Callable[[], float] = running_s,
    ) -> None:
        self._output, self._own, self._events = output, own, events
        self._started_s, self._clock = started_s, clock
        self.family: Family | None = None
        self._hits = dict.fromkeys(FAMILIES, 0)
        self._early: list[str] = []
        self._steps = _Steps()
        self._metric: float | None = None
        self._total: float | None = None

    def new(self) -> list[dict[str, Any]]:
        """Lines of metrics that came since the last call."""
        now_s = self._clock()
        reports = [report for text in self._output.new() for report in self._reports(text)]
        if self._events is not None:
            reports = [report._replace(metric=None) for report in reports]
            reports += map(self._of_event, self._events.new())
        taken = (self._take(report, now_s) for report in reports)
        return [line for line in taken if line is not None]

    def _of_event(self, report: Report) -> Report:
        has_steps = self._own is not None or self.family is not None
        return report._replace(steps=None) if has_steps else report

    def _reports(self, text: str) -> Sequence[Report]:
        reports = self._of_family(text)
        own = None if self._own is None else self._own.read(text)
        if own is None:
            return reports
        # What the user has named wins; the rest of the line counts too.
        other = reports[-1] if reports else Report()
        both = (
            mine if mine is not None else theirs for mine, theirs in zip(own, other, strict=True)
        )
        return (*reports[:-1], Report(*both))

    def _of_family(self, text: str) -> Sequence[Report]:
        if self.family is None:
            return self._choose(text)
        if self.family.is_weak and (reports := self._choose(text)):
            self._steps, self._total = _Steps(), None
            return reports
        found = self.family.read(text)
        return () if found is None else (found,)

    def _choose(self, text: str) -> Sequence[Report]:
        """Counts which families know a line; the first with two hits is taken, and its lines."""
        hits = [
            family
            for family in FAMILIES
            if family is not self.family and family.read(text) is not None
        ]
        if not hits:
            return ()
        self._early.append(text)
        for family in hits:
            report = family.read(text)
            if report is None or (report.steps is None and report.rate is None):
                continue
            self._hits[family] += 1
            if self._hits[family] == 2:
                if self.family is None and self._events is not None:
                    self._steps = _Steps()  # Those of events may be iterations.
                self.family = family
                return [found for line in self._early if (found := family.read(line)) is not None]
        return ()

    def _take(self, report: Report, now_s: float) -> dict[str, Any] | None:
        if report.metric is not None and math.isfinite(report.metric):
            self._metric = report.metric
        if report.total is not None and math.isfinite(report.total):
            self._total = report.total
        is_average = self.family is not None and self.family.is_average
        if not all(map(math.isfinite, (report.steps or 0.0, report.rate or 0.0))):
            return None
        if report.steps is not None:
            self._steps.count(report.steps, now_s)
        elif report.rate is not None and not self._steps.are_counted:
            self._steps.add(report.rate, now_s, self._started_s if is_average else None)
        else:
            return None
        line = {"env_steps": round(self._steps.now), "env_steps_per_s": self._steps.per_s}
        if self._metric is not None:
            line[METRIC] = self._metric
        if self._total is not None:
            line["num_timesteps"] = round(self._total)
        return line


class _Steps:
    """Steps of a job by reports of steps, or else of rates."""

    def __init__(self) -> None:
        self.now = 0.0
        self.are_counted = False
        self._before = 0.0  # Of runs that the same job has made before, as W&B's agents do.
        self._own = 0.0
        self._seen: deque[tuple[float, float]] = deque(maxlen=_REPORTS)

    def count(self, steps: float, now_s: float) -> None:
        """A report of steps so far."""
        if not self.are_counted:
            self._seen.clear()
        elif steps < self._own:
            self._before += self._own
        self.are_counted, self._own = True, steps
        self._note(self._before + steps, now_s)

    def add(self, rate: float, now_s: float, since_s: float | None) -> None:
        """A report of a rate: of the moment, or the mean since `since_s`."""
        if since_s is not None:
            self._note(max(self.now, rate * (now_s - since_s)), now_s)
            return
        last_s = self._seen[-1][0] if self._seen else now_s
        self._note(self.now + rate * (now_s - last_s), now_s)

    @property
    def per_s(self) -> float:
        """Over the latest reports; 0 before there are two."""
        if len(self._seen) < 2:
            return 0.0
        (first_s, first), (last_s, last) = self._seen[0], self._seen[-1]
        return (last - first) / (last_s - first_s)

    def _note(self, steps: float, now_s: float) -> None:
        self.now = steps
        if self._seen and self._seen[-1][0] == now_s:  # Read in one look.
            self._seen.pop()
        self._seen.append((now_s, steps))
