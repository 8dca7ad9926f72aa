"""Reading a run's metrics, and the picture of its return curve."""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from gmijax.runs.folder import open_regular, write_text


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """All complete lines of a `metrics.jsonl`; none without the file."""
    return MetricsReader(path).new()


def last_env_steps(path: Path) -> int | None:
    """The environment steps of the last line of a `metrics.jsonl`; None without a line."""
    line = MetricsReader(path).latest()
    return None if line is None else line["env_steps"]


def copy_history(source: Path, target: Path, env_steps: int) -> None:
    """Copies the lines up to `env_steps`, so that a resumed run has the whole curve.

    `source` may be `target`, which is replaced as a whole.
    """
    lines = [line for line in read_metrics(source) if line["env_steps"] <= env_steps]
    write_text(target, "".join(json.dumps(line) + "\n" for line in lines))


class MetricsReader:
    """Follows a `metrics.jsonl` that grows."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._offset = 0

    def latest(self) -> dict[str, Any] | None:
        """The last complete line that came since the last call, None if there is none."""
        return next(reversed(self.new()), None)

    def new(self) -> list[dict[str, Any]]:
        """The complete lines that came since the last call; what is no line of metrics is none."""
        try:
            with open_regular(self._path) as file:
                if os.fstat(file.fileno()).st_size < self._offset:
                    self._offset = 0  # A restart has cut it.
                file.seek(self._offset)
                new = file.read()
        except OSError:
            return []
        complete = new[: new.rfind(b"\n") + 1]
        self._offset += len(complete)
        lines: list[dict[str, Any]] = []
        for text in complete.splitlines():
            # A full disk may have cut off a line, with later ones right behind it.
            with suppress(ValueError, RecursionError):
                line = json.loads(text)
                if _is_line(line):
                    lines.append(line)
        return lines


def _is_line(data: object) -> bool:
    """Whether it is what a job writes: environment steps, and numbers or nothing by name."""
    if not isinstance(data, dict):
        return False
    numbers = [value for value in data.values() if value is not None]
    return type(data.get("env_steps")) is int and all(
        type(value) in (int, float) and abs(value) <= sys.float_info.max for value in numbers
    )


def number_in(line: Mapping[str, Any], key: str) -> float | None:
    """A finite number of a line, None if it has none of this name."""
    found = line.get(key)
    return float(found) if isinstance(found, int | float) and math.isfinite(found) else None


def scalars(line: Mapping[str, float | int | None]) -> dict[str, float]:
    """The numbers of a line by the names of their curves; `env_steps` is the x axis."""
    return {
        name if "/" in name else f"train/{name}": float(value)
        for name, value in line.items()
        if value is not None and name != "env_steps"
    }


def draw_returns(metrics: Path, picture: Path, title: str) -> None:
    """Draws mean episode return over environment steps, with that of evaluations if there are any.

    Nothing where no episode has ended.
    """
    lines = read_metrics(metrics)
    training, evaluations = (
        [(line["env_steps"], line[key]) for line in lines if line.get(key) is not None]
        for key in ("return", "eval/return")
    )
    if not training and not evaluations:
        return
    # Imported here: it costs half a second that no other use of this module should pay.
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.add_subplot()
    axes.plot(*zip(*training, strict=True), label="training")
    if evaluations:
        axes.plot(*zip(*evaluations, strict=True), marker="o", label="evaluation")
        axes.legend(fontsize="small")
    axes.set(title=title, xlabel="environment steps", ylabel="mean episode return")
    axes.grid(alpha=0.3)
    figure.savefig(picture, dpi=120)
