"""Which checkpoint of a run is the best, by evaluations, or by the returns of its training."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from gmijax.errors import ConfigError
from gmijax.runs.checkpoints import CheckpointMeta, checkpoints_of, passed_over, what_is_broken
from gmijax.runs.folder import RunPaths
from gmijax.runs.history import number_in, read_metrics


class Rank(NamedTuple):
    """What checkpoints are ranked by; the best one has the largest.

    One without an evaluation comes after all that have one. Its mean return in training counts
    after all those of full windows where its own window is not: at the start of a run it is of
    short episodes alone. Those whose meta data cannot be read come last.
    """

    is_read: bool
    is_evaluated: bool
    is_full: bool
    value: float


def ranked(checkpoints: Sequence[Path]) -> list[tuple[Rank, Path]]:
    """Checkpoints of one run with their ranks: the best first, of equals the newest.

    Without evaluations they are compared by the returns of training. Those of a window are of
    episodes that began up to two time limits before its end, with older policies. So a checkpoint
    is judged by the window that ends a time limit after it, or by the last one there is.
    """
    metas = {path: _meta_of(path) for path in checkpoints}
    lines: Sequence[Mapping[str, Any]] = ()
    if checkpoints and all(meta is None or meta.eval_return is None for meta in metas.values()):
        lines = read_metrics(RunPaths(checkpoints[0].parents[1]).metrics)
    ranks = [(_rank(meta, lines), path) for path, meta in metas.items()]
    return sorted(ranks, key=lambda one: (one[0], one[1].name), reverse=True)


def best_checkpoint(folder: Path) -> Path | None:
    """The best checkpoint of a run folder, see `choose_best`."""
    return choose_best(folder)[0]


def choose_best(folder: Path) -> tuple[Path | None, tuple[str, ...]]:
    """The best checkpoint of a run folder, see `ranked`, whose files are as they were written.

    And what was passed over for it: better ones, and those whose rank cannot be read.
    """
    best, named = None, list[str]()
    for rank, path in ranked(checkpoints_of(folder)):
        if best is not None and rank.is_read:
            continue
        if wrong := what_is_broken(path):
            named.append(passed_over(path, wrong))
        elif best is None:
            best = path.resolve()
    return best, tuple(named)


def best_evaluation(folder: Path, env_steps: int) -> float:
    """The best mean return of the evaluations of a run folder up to `env_steps`, -inf for none.

    Of those that have a checkpoint, and the best one always has.
    """
    found = [path for path in checkpoints_of(folder) if int(path.name) <= env_steps]
    return max((rank.value for rank, _ in ranked(found) if rank.is_evaluated), default=-math.inf)


def _meta_of(checkpoint: Path) -> CheckpointMeta | None:
    try:
        return CheckpointMeta.read(checkpoint)
    except ConfigError:
        return None


def _rank(meta: CheckpointMeta | None, lines: Sequence[Mapping[str, Any]]) -> Rank:
    if meta is None:
        return Rank(False, False, False, -math.inf)
    if meta.eval_return is not None:
        return Rank(True, True, True, meta.eval_return)
    is_full, mean = meta.window_full, meta.mean_return
    if meta.limit_steps is not None and (line := _a_limit_later(meta, lines)) is not None:
        is_full, mean = bool(line.get("window/full")), number_in(line, "window/return")
    return Rank(True, False, is_full, -math.inf if mean is None else mean)


def _a_limit_later(
    meta: CheckpointMeta, lines: Sequence[Mapping[str, Any]]
) -> Mapping[str, Any] | None:
    """The first line a time limit after a checkpoint, or the last one after it; None: none."""
    later = [line for line in lines if line["env_steps"] > meta.env_steps]
    wanted = meta.env_steps + (meta.limit_steps or 0.0)
    whole = (line for line in later if line["env_steps"] >= wanted)
    return next(whole, later[-1] if later else None)
