"""The summary of a training job: `summary.json`, and its lines for people."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gmijax.config import TrainConfig
from gmijax.control.console import nearby
from gmijax.control.display import clock
from gmijax.learning.physics_health import overflow_warnings
from gmijax.partition.plan import Plan
from gmijax.runs.checkpoints import CheckpointMeta, checkpoints_of
from gmijax.runs.folder import RunPaths, read_json
from gmijax.runs.history import read_metrics
from gmijax.runs.names import by_steps
from gmijax.runs.ranking import best_checkpoint
from gmijax.runs.result import TrainResult
from gmijax.version import versions_of

_VERSIONS = (
    *("gmijax", "python", "jax", "jaxlib", "mujoco-mjx"),
    *("flax", "optax", "orbax-checkpoint"),
)

EXPLORING = "(with exploration noise, mean of the latest episodes)"
"""What the return is that a job prints while it trains."""

Data = Mapping[str, Any]


def train_summary(
    config: TrainConfig,
    plan: Plan,
    run: RunPaths,
    status: str,
    wall_s: float,
    restarts: Sequence[Data],
) -> dict[str, Any]:
    """The content of `summary.json`, from what the leader left or, failing that, the metrics."""
    result = TrainResult.read(run.gmi(0).result)
    env_steps, final_return = _last_known(run, result)
    checkpoints = checkpoints_of(run.root)
    return {
        "status": status,
        "env": config.env.label,
        "algo": config.algo.name,
        "plan": {
            **plan_data(plan),
            "strategy": (result and result.strategy) or plan.strategy,
            "intra": (result and result.intra) or plan.intra,
            "inter": (result and result.inter) or plan.inter,
        },
        "env_steps": env_steps,
        "wall_s": wall_s,
        **_rates(result),
        **({} if result is None else _where_known(result, is_decoupled=config.is_decoupled)),
        "final_return": final_return,
        "eval": _evaluations(run),
        "overflow_steps": {} if result is None else dict(result.overflow_steps),
        "checkpoint": str(checkpoints[-1]) if checkpoints else None,
        "restarts": list(restarts),
        "versions": versions_of(_VERSIONS),
        "device": None if result is None else dict(result.device),
        "impl": config.physics.impl,
    }


def _rates(result: TrainResult | None) -> dict[str, float | None]:
    """Times and rates; None where the job did not end by itself."""
    return {
        "train_wall_s": result and result.train_wall_s,
        "compile_s": result and result.compile_s,
        "env_steps_per_s": result and result.env_steps_per_s,
        "step_per_s_sim": result and result.step_per_s_sim,
        "step_per_s_inference": result and result.step_per_s_inference,
        "step_per_s_train": result and result.step_per_s_train,
    }


def _where_known(result: TrainResult, *, is_decoupled: bool) -> dict[str, Any]:
    """What only some jobs have."""
    experience = {
        "pps": result.pps,
        "ttop": result.ttop,
        "staleness": result.staleness,
        "bytes_per_s": result.bytes_per_s,
    }
    others = {"start_s": result.start_s, "profile": result.profile}
    known = {key: value for key, value in others.items() if value is not None}
    return {**experience, **known} if is_decoupled else known


def _last_known(run: RunPaths, result: TrainResult | None) -> tuple[int | None, float | None]:
    """Environment steps and return, by the last metrics where the job did not end by itself."""
    if result is not None:
        return result.env_steps, result.final_return
    lines = read_metrics(run.metrics)
    return (lines[-1]["env_steps"], lines[-1].get("return")) if lines else (None, None)


def _evaluations(run: RunPaths) -> dict[str, Any] | None:
    """The last evaluation, and the best one with its checkpoint; None if there was none."""
    lines = [line for line in read_metrics(run.metrics) if line.get("eval/return") is not None]
    if not lines:
        return None
    last = {"env_steps": lines[-1]["env_steps"], "return": lines[-1]["eval/return"]}
    checkpoint = best_checkpoint(run.root)
    meta = None if checkpoint is None else CheckpointMeta.read(checkpoint)
    if meta is None or meta.eval_return is None:
        return {"last": last, "best": None}
    best = {"env_steps": meta.env_steps, "return": meta.eval_return}
    return {"last": last, "best": {**best, "checkpoint": str(checkpoint)}}


def train_outcome(summary: Data, run: RunPaths) -> str:
    """The summary in a few lines for people."""
    times, mean = len(summary["restarts"]), summary["final_return"]
    learnt = "no episode has ended"
    if mean is not None:
        learnt = f"final return {mean:.2f} {EXPLORING}"
    checkpoint = summary["checkpoint"]
    where = "none" if checkpoint is None else nearby(Path(checkpoint))
    # None where it ended in its first iteration.
    steps = "no" if summary["env_steps"] is None else f"{summary['env_steps']:,}"
    curves = f"curves: {nearby(run.returns_png)}\n" if run.returns_png.exists() else ""
    return (
        f"{summary['status']}: {steps} env steps in {clock(summary['wall_s'])}"
        f"{f', started again {times} times' if times else ''}\n{learnt}\n"
        f"{_of_rates(summary)}"
        f"{_of_evaluations(summary.get('eval'), run)}"
        f"{_of_videos(run)}"
        f"{_of_profile(summary.get('profile'))}"
        f"checkpoint: {where}\n{curves}summary: {nearby(run.summary)}"
        f"{overflow_warnings(summary['overflow_steps'])}"
    )


def next_steps(run: RunPaths) -> tuple[tuple[str, str], ...]:
    """What people do with a trained policy, see `print_next`."""
    folder = shlex.quote(nearby(run.root))
    return (("play it without exploration noise, and film it", f"gmijax play run.dir={folder}"),)


def _of_profile(found: Data | None) -> str:
    """Lines about the trace that `run.profile` asked for, or nothing."""
    if found is None:
        return ""
    if found["error"] is not None:
        return f"profile: the trace could not be written: {found['error']}\n"
    if found["iterations"] is None:
        return "profile: none, the command ended before the first iteration of run.profile\n"
    first, last = found["iterations"]
    folder = Path(found["dir"])
    traces = sorted(folder.rglob("perfetto_trace.json.gz"))
    return (
        f"profile of iterations {first} to {last}: {nearby(traces[-1] if traces else folder)}\n"
        "  open it at https://ui.perfetto.dev; how to read it: docs/speed.md\n"
    )


def _of_rates(summary: Data) -> str:
    """A line of those that were measured, or nothing."""
    names = {"sim": "simulation", "inference": "with inference", "train": "with training"}
    rates = {name: summary[f"step_per_s_{key}"] for key, name in names.items()}
    found = [f"{rate:,.0f} {name}" for name, rate in rates.items() if rate is not None]
    return f"env steps/s: {', '.join(found)}\n" if found else ""


def _of_evaluations(found: Data | None, run: RunPaths) -> str:
    """Lines, or nothing."""
    if not found:
        return ""
    how = "without" if read_json(run.config)["eval"]["deterministic"] else "with"
    last, best = found["last"], found["best"]
    text = (
        f"evaluation: return {last['return']:.2f} {how} exploration noise, after "
        f"{last['env_steps']:,} env steps\n"
    )
    if best:
        text += f"  best {best['return']:.2f}: {nearby(Path(best['checkpoint']))}\n"
    return text


def _of_videos(run: RunPaths) -> str:
    """A line, or nothing."""
    films = by_steps(run.videos, suffix=".mp4")
    return f"video: {nearby(films[-1])}\n" if films else ""


def plan_data(plan: Plan) -> dict[str, Any]:
    """What a summary has of the plan."""
    return {
        "backend": plan.backend,
        "layout": [list(gmis) for gmis in plan.layout.gmis_of_gpu],
        "nodes": plan.nodes_data(),
        "num_envs_per_gmi": plan.num_envs_per_gmi,
        "template": plan.template,
        "roles": list(plan.roles),
    }
