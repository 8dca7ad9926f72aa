"""Trains ball_balance in two GMIs from Python, and prints what came out.

`python examples/two_gmis.py [override ...]`, for example `num_timesteps=100e3`.
"""

from __future__ import annotations

import sys

import gmijax


def main() -> None:
    """Two GMIs on the first GPU, or on this machine's CPU cores where there is none."""
    config = gmijax.compose("env=ball_balance", "plan.gmis_per_gpu=2", *sys.argv[1:])
    result = gmijax.train(config, show=True)
    # None if no episode ended, which takes a few thousand steps.
    print(f"mean return {result.summary['final_return']}, files in {result.run_dir}")


if __name__ == "__main__":
    main()
