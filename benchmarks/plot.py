"""Draws the return curves of suites: `python -m benchmarks.plot OUT.png ant-1gpu ...`.

The last call of every suite counts. Left over environment steps, right over wall-clock seconds of
training, where runs that shared their GPU are left out.
"""

from __future__ import annotations

import sys
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks.records import RESULTS, read_calls


def main(picture: str, suites: list[str]) -> None:
    """Draws every run of every case; the runs of a case share a colour."""
    figure = Figure(figsize=(10, 4), layout="constrained")
    FigureCanvasAgg(figure)
    over_steps, over_time = figure.subplots(1, 2, sharey=True)
    number = 0
    for suite in suites:
        results = read_calls(RESULTS / f"{suite}.json")[-1].results
        for name, case in results["cases"].items():
            done = [run for run in case["runs"] if "curve" in run]
            for k, run in enumerate(done):
                points = [point for point in run["curve"] if point[2] is not None]
                steps, seconds, returns = zip(*points, strict=True)
                style = {"color": f"C{number}", "alpha": 0.8, "label": None if k else name}
                over_steps.plot([s / 1e6 for s in steps], returns, **style)
                if "together" not in run:
                    over_time.plot(seconds, returns, **style)
            number += 1
    over_steps.set(xlabel="million environment steps", ylabel="mean episode return")
    over_time.set(xlabel="seconds of training")
    over_steps.legend()
    for axes in (over_steps, over_time):
        axes.grid(alpha=0.3)
    figure.savefig(Path(picture), dpi=110)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
