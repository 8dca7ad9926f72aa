"""One command of each verb, as small as can be, that faults happen to."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final, NamedTuple

from fault_checks import checkpoints_of, is_whole
from training_jobs import FOREVER, POINT, STEPS

from gmijax.runs.dataset import DataPaths

CHECKPOINT_EVERY: Final = 40
SWEEP_STEPS: Final = 600 * STEPS
_TRAIN = (*POINT[:-1], "plan.backend=cpu", f"run.checkpoint_every={CHECKPOINT_EVERY}")
_GOES_ON = (*_TRAIN, FOREVER, "run.keep_checkpoints=3", "run.dir={run}", "run.resume=auto")
_PROFILES = (
    *(key for key in _TRAIN if not key.startswith(("num_envs=", "run.checkpoint"))),
    *("plan.gpus=1", "search.store={home}/store", "search.gmis_per_gpu=[1]"),
    "search.num_envs=[16,32]",
)


class Command(NamedTuple):
    """A command line and what it leaves.

    Attributes:
      verb: `gmijax.<verb>`.
      overrides: `{run}` stands for its folder, `{home}` for the one around it, `{n}` for how
        often the command was given before.
      is_endless: whether it goes on until it is asked to end.
      needs: what must be there before, a folder of `fault_fixtures`; None: nothing.
      progress: what it has finished, which must not become less.
      wrong: what is not as it must be when it has ended well.
    """

    verb: str
    overrides: tuple[str, ...]
    is_endless: bool
    needs: str | None
    progress: Callable[[Path], int]
    wrong: Callable[[Path], Iterator[str]]


def steps_saved(run: Path) -> int:
    """Of the newest checkpoint."""
    found = checkpoints_of(run)
    return int(found[-1].name) if found else 0


def _shards(data: Path) -> int:
    return len(list(DataPaths(data).finished()))


def _profiles(run: Path) -> int:
    texts = [path.read_text() for path in (run.parent / "store").glob("*.json")]
    return sum(text.count('"env_steps_per_s"') for text in texts)


def _job_steps(folder: Path) -> int:
    return sum(steps_saved(job) for job in sorted(folder.glob("[0-9][0-9][0-9]")))


def _files(folder: Path, *names: str) -> int:
    return sum(len(list(folder.glob(name))) for name in names)


def _wrong_training(run: Path) -> Iterator[str]:
    for name in ("config.json", "plan.json", "summary.json"):
        yield from _not_an_object(run / name)
    for path in checkpoints_of(run):
        if not is_whole(path):
            yield f"checkpoint {path.name} is not whole"
    lines = (run / "metrics.jsonl").read_text().splitlines()
    steps = [json.loads(line)["env_steps"] for line in lines]
    if steps != sorted(set(steps)):
        yield "metrics.jsonl has steps twice or in another order"


def _wrong_data(data: Path) -> Iterator[str]:
    import numpy as np

    for shard in DataPaths(data).finished():
        with np.load(shard.arrays) as arrays:
            if not all(np.isfinite(arrays[name]).all() for name in arrays):
                yield f"{shard.arrays} has numbers that are not finite"


def _wrong_sweep(folder: Path) -> Iterator[str]:
    yield from _not_an_object(folder / "sweep.json")
    report = json.loads((folder / "sweep.json").read_text())
    if report["status"] != "completed":
        yield f"sweep.json says {report['status']}"
    states = [(job["state"], job["env_steps"]) for job in report["jobs"]]
    if states != [("completed", SWEEP_STEPS)] * 2:
        yield f"jobs of the sweep: {states}"
    for job in sorted(folder.glob("[0-9][0-9][0-9]")):
        if steps_saved(job) != SWEEP_STEPS:
            yield f"job {job.name} has saved {steps_saved(job)} steps"


def _wrong_search(run: Path) -> Iterator[str]:
    for report in run.parent.glob(f"{run.name}[0-9]*/search.json"):
        yield from _not_an_object(report)
    if not _profiles(run):  # One that was killed is none that can run.
        yield "no profile in the store"


def _wrong_play(run: Path) -> Iterator[str]:
    for path in run.glob("play/*/returns.json"):
        yield from _not_an_object(path)
    if not list(run.glob("play/*/returns.json")):
        yield "no returns.json"


def _wrong_export(run: Path) -> Iterator[str]:
    if _files(run, "export/*/policy.json") != 1:
        yield "no policy.json"
    if not _files(run, "export/*/policy.stablehlo", "export/*/policy.onnx"):
        yield "no policy"


def _not_an_object(path: Path) -> Iterator[str]:
    try:
        if not isinstance(json.loads(path.read_text()), dict):
            yield f"{path.name} holds no object"
    except (OSError, ValueError) as error:
        yield f"{path.name}: {error}"


_A3C = (*_GOES_ON, "algo=a3c")
COMMANDS: Final[dict[str, Command]] = {
    "train": Command(
        "train", (*_GOES_ON, "plan.gpus=2"), True, None, steps_saved, _wrong_training
    ),
    "measured": Command(
        "train",
        (*_TRAIN, "plan.gpus=1", f"num_timesteps={200 * STEPS}", "run.measure_throughput=true",
         "run.dir={run}", "run.resume=auto"),
        False, None, steps_saved, _wrong_training,
    ),
    "films": Command(
        "train",
        (*("env=drawn.py:make", *_GOES_ON[1:]), "plan.gpus=1", f"eval.every={400 * STEPS}",
         "eval.episodes=2", "eval.video=1"),
        True, None, steps_saved, _wrong_training,
    ),
    "a3c": Command("train", _A3C, True, None, steps_saved, _wrong_training),
    "a3c_two": Command(
        "train", (*_A3C, "plan.training_gmis_per_gpu=2"), True, None, steps_saved, _wrong_training
    ),
    "tdg": Command(
        "train", (*_GOES_ON, "plan.gpus=1", "plan.gmis_per_gpu=2", "plan.template=tdg_ex"),
        True, None, steps_saved, _wrong_training,
    ),
    "sweep": Command(
        "sweep",
        (*_TRAIN, f"num_timesteps={SWEEP_STEPS}", "plan.gpus=1", "seed=0,1",
         "sweep.jobs_per_gpu=2", "run.dir={run}"),
        False, None, _job_steps, _wrong_sweep,
    ),
    "serve": Command(
        "serve",
        ("env=point.py:make", "policy=random", "num_envs=64", "unroll_length=200",
         "latency_steps=20", "num_timesteps=1000000000", "run.grace_s=3",
         "plan.gmis_per_gpu=2", "output.dir={run}"),
        True, None, _shards, _wrong_data,
    ),
    "search": Command(
        "search", (*_PROFILES, "run.dir={run}{n}"), False, None, _profiles, _wrong_search
    ),
    "play": Command(
        "play", ("run.dir={run}", "num_envs=4", "html=off"), False, "run",
        lambda run: _files(run, "play/*/returns.json"), _wrong_play,
    ),
    **{
        form: Command(
            "export", ("run.dir={run}", f"format={form}"), False, "run",
            lambda run: _files(run, "export/*/policy.json"), _wrong_export,
        )
        for form in ("stablehlo", "onnx")
    },
}  # fmt: skip
"""By the name that kinds of faults use."""
