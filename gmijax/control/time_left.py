"""The time that a job still takes."""

from __future__ import annotations

import time
from collections import deque
from typing import Final

_RATE_OVER_S: Final = 60.0
"""The rate is one over the latest reports in so long, and over more where they are rarer."""

_LEAST_REPORTS: Final = 4
_LEAST_S: Final = 5.0
"""Before so many reports in so long a rate is unreliable: the first iterations are different."""


class TimeLeft:
    """Follows the environment steps of a job."""

    def __init__(self) -> None:
        self._reports: deque[tuple[float, int]] = deque()

    def note(self, env_steps: int) -> None:
        """Adds the steps so far; may be called as often as one likes."""
        now_s, reports = time.monotonic(), self._reports
        if reports and env_steps == reports[-1][1]:
            return
        if reports and env_steps < reports[-1][1]:  # It was started again.
            reports.clear()
        reports.append((now_s, env_steps))
        while len(reports) > _LEAST_REPORTS and reports[1][0] < now_s - _RATE_OVER_S:
            reports.popleft()

    def seconds(self, num_timesteps: int) -> float | None:
        """Until there are so many steps; None at the end, or while no rate is reliable yet."""
        if len(self._reports) < _LEAST_REPORTS:
            return None
        (first_s, first), (last_s, last) = self._reports[0], self._reports[-1]
        if last_s - first_s < _LEAST_S or last >= num_timesteps:
            return None
        left_s = (num_timesteps - last) * (last_s - first_s) / (last - first)
        return max(0.0, left_s - (time.monotonic() - last_s))
