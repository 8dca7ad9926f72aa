"""What a training job has come to: its summary, and the lines that a user sees of it."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

from gmijax.config import TrainConfig
from gmijax.control.restarts import Restart
from gmijax.partition.plan import Plan
from gmijax.physics_health import overflow_warnings
from gmijax.results import read_metrics
from gmijax.rundir import RunPaths, read_json
from gmijax.version import __version__, versions_of

_ASYNCHRONOUS = ("pps", "ttop", "staleness", "bytes_per_s", "dropped")
"""Figures that only asynchronous training has."""

_VERSIONS = ("jax", "jaxlib", "mujoco-mjx", "flax", "optax", "orbax-checkpoint")


def summarise(
    config: TrainConfig,
    plan: Plan,
    run: RunPaths,
    status: str,
    wall_s: float,
    restarts: Sequence[Restart],
) -> dict[str, Any]:
    """The content of `summary.json`, from what the leader left or, failing that, the metrics."""
    result = read_json(run.gmi(0).result) if run.gmi(0).result.exists() else _last_known(run)
    checkpoints = sorted(run.checkpoints.glob("[0-9]*"))
    return {
        "status": status,
        "env": config.env.label,
        "algo": config.algo.name,
        "plan": {
            "backend": plan.backend,
            "layout": [list(gmis) for gmis in plan.layout.gmis_of_gpu],
            "num_envs_per_gmi": plan.num_envs_per_gmi,
            "strategy": result.get("strategy", plan.strategy),
            "intra": result.get("intra", plan.intra),
            "selection": dict(plan.selection),
            "template": plan.template,
            "roles": list(plan.roles),
        },
        "env_steps": result.get("env_steps"),
        "wall_s": wall_s,
        "train_wall_s": result.get("train_wall_s"),
        "compile_s": result.get("compile_s"),
        "env_steps_per_s": result.get("env_steps_per_s"),
        "step_per_s_sim": result.get("step_per_s_sim"),
        "step_per_s_inference": result.get("step_per_s_inference"),
        "step_per_s_train": result.get("step_per_s_train"),
        **{key: result[key] for key in _ASYNCHRONOUS if key in result},
        "final_return": result.get("final_return"),
        "overflow_steps": result.get("overflow_steps") or {},
        "checkpoint": str(checkpoints[-1]) if checkpoints else None,
        "restarts": [restart._asdict() for restart in restarts],
        "versions": {"gmijax": __version__, "python": sys.version.split()[0]}
        | versions_of(_VERSIONS),
        "device": result.get("device"),
        "impl": config.physics.impl,
    }


def _last_known(run: RunPaths) -> dict[str, Any]:
    """What the metrics say of a job that did not end by itself."""
    lines = read_metrics(run.metrics)
    if not lines:
        return {}
    return {"env_steps": lines[-1]["env_steps"], "final_return": lines[-1]["return"]}


def outcome(summary: dict[str, Any], run: RunPaths) -> str:
    """The summary in a few lines for people."""

    def rate(key: str) -> str:
        value = summary[key]
        return "-" if value is None else f"{value:,.0f}"

    final, times = summary["final_return"], len(summary["restarts"])
    return (
        f"{summary['status']}: {summary['env_steps']:,} env steps in {summary['wall_s']:.0f} s, "
        f"final return {'-' if final is None else format(final, '.2f')}"
        f"{f', started again {times} times' if times else ''}\n"
        f"env steps/s: {rate('step_per_s_sim')} simulation, "
        f"{rate('step_per_s_inference')} with inference, "
        f"{rate('step_per_s_train')} with training\n"
        f"checkpoint: {summary['checkpoint']}\nsummary: {run.summary}"
    ) + overflow_warnings(summary["overflow_steps"])
