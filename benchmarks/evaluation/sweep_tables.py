"""Trainings per hour of sweeps."""

from __future__ import annotations

from benchmarks.evaluation.figures import (
    NOT_MEASURED,
    Figure,
    call_of,
    figure,
    markdown,
    results_of,
    shown,
    source,
)

SWEEPS = "sweeps-nvidia-h200"
ONE_AFTER_ANOTHER = "1 at once, auto"


def sweep_rates() -> dict[str, Figure]:
    """Trainings per hour, by the way the sweeps were run."""
    ways: dict[str, list[float]] = {}
    for run in results_of(SWEEPS).get("runs", ()):
        if run["code"] == 0:
            ways.setdefault(run["way"], []).append(run["trainings_per_hour"])
    return {way: found for way, rates in ways.items() if (found := figure(rates))}


def over_one_after_another(way: str) -> float | None:
    """Trainings per hour over those of the same trainings one after another."""
    rates = sweep_rates()
    if not {way, ONE_AFTER_ANOTHER} <= rates.keys():
        return None
    return rates[way].median / rates[ONE_AFTER_ANOTHER].median


def sweeps() -> list[str]:
    """Trainings per hour, where they were measured."""
    call = call_of(SWEEPS)
    if call is None or call.settings is None:
        return [f"Trainings per hour of a sweep: {NOT_MEASURED} (`python -m benchmarks.sweeps`)."]
    settings = ", ".join(f"`{one}`" for one in call.settings["overrides"])
    compiled = "programs compiled before" if call.settings["warm"] else "each sweep compiles"
    rows = [
        [
            way,
            str(found.repeats),
            shown(found, ".1f"),
            shown(over_one_after_another(way)),
            shown(call.results["medians"][way]["steady_steps_per_s"], ",.0f"),
        ]
        for way, found in sweep_rates().items()
    ]
    head = "at once | sweeps: | trainings per hour: | over one after another: | steps/s in all:"
    return [
        f"{call.settings['jobs']} trainings with {settings}; {compiled}.",
        "",
        *markdown(head, rows),
        *source(SWEEPS),
    ]
