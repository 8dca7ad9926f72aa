"""`gmijax demo`: trains ball_balance briefly, plays what it has learnt, and says what to look at.

Nothing is downloaded.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Final

from gmijax.cli.compose import build, compose
from gmijax.config import PlayConfig
from gmijax.control import job
from gmijax.control.exit_codes import exit_code_of
from gmijax.deploy import playing
from gmijax.machine.snapshot import detect_machine
from gmijax.runs.folder import RunPaths

USAGE: Final = """usage: gmijax demo [key=value ...]

Trains env=ball_balance briefly in runs/, plays its last checkpoint and films it.
Takes the keys of `gmijax train`. Without num_timesteps: seconds of training on a GPU, minutes on
two CPU cores.
"""

CPU_STEPS: Final = 300_000
GPU_STEPS: Final = 3_000_000


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    if "--help" in argv or "-h" in argv:
        sys.stdout.write(USAGE)
        return 0
    return exit_code_of("demo", lambda: demo(argv))


def demo(overrides: Sequence[str]) -> None:
    """Trains with `overrides` of a short training, and plays.

    Raises:
      ConfigError: bad input, before anything was started.
      GmiFailed: a process failed.
    """
    steps = GPU_STEPS if detect_machine().gpus else CPU_STEPS
    own = {"env": "ball_balance", "num_timesteps": steps, "run.measure_throughput": "false"}
    given = {text.partition("=")[0] for text in overrides}
    short = [f"{key}={value}" for key, value in own.items() if key not in given]
    config = compose(*short, *overrides)
    result = job.train(config, show=True)
    playing.play(build("play", PlayConfig, [f"run.dir={result.run_dir}"]), show=True)
    curve = RunPaths(result.run_dir).returns_png
    films = sorted(result.run_dir.glob("play/*/*.mp4"))
    sys.stdout.write(
        f"\nreturn while it learnt: {curve if curve.exists() else 'none, no episode has ended'}\n"
        f"film: {films[-1] if films else 'none, see above'}\n"
        f"more training: gmijax train env={config.env.label}\n"
    )


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
