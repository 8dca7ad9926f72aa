"""Summaries of training and serving jobs: `summary.json`, and its lines for people. No jax."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gmijax.config import ServeConfig, TrainConfig
from gmijax.control.console import nearby
from gmijax.control.display import clock
from gmijax.learning.physics_health import overflow_warnings
from gmijax.partition.plan import Plan
from gmijax.runs.folder import RunPaths, read_json
from gmijax.runs.history import read_metrics
from gmijax.runs.names import by_steps
from gmijax.runs.result import TrainResult
from gmijax.runs.resume import CheckpointMeta, best_checkpoint, checkpoints_of
from gmijax.version import __version__, versions_of

_VERSIONS = ("jax", "jaxlib", "mujoco-mjx", "flax", "optax", "orbax-checkpoint")

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
            **_of_plan(plan),
            "strategy": (result and result.strategy) or plan.strategy,
            "intra": (result and result.intra) or plan.intra,
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
        "versions": _own_versions() | versions_of(_VERSIONS),
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
    curves = f"curves: {nearby(run.returns_png)}\n" if run.returns_png.exists() else ""
    return (
        f"{summary['status']}: {summary['env_steps']:,} env steps in {clock(summary['wall_s'])}"
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


def serve_summary(
    config: ServeConfig, plan: Plan, run: RunPaths, status: str, wall_s: float
) -> dict[str, Any]:
    """The content of `summary.json`, without what is in the output folder."""
    found = {gmi: _result(run, gmi) for gmi in plan.layout.gmis}
    collecting = [result for result in found.values() if "env_steps" in result]
    episodes = [result["episodes"] for result in collecting if result.get("episodes")]
    count = sum(sums["count"] for sums in episodes)
    return {
        "status": status,
        "env": config.env.label,
        "policy": _policy(config, found.values()),
        "plan": _of_plan(plan),
        "env_steps": sum(result["env_steps"] for result in collecting),
        "wall_s": wall_s,
        "serve_wall_s": _largest(collecting, "serve_wall_s"),
        "compile_s": _largest(list(found.values()), "compile_s"),
        "env_steps_per_s": _throughput(collecting),
        # In a job that goes on, a GMI may have nothing left to collect.
        "step_per_s_inference": _total(
            [result for result in collecting if result["env_steps"]], "step_per_s_inference"
        ),
        "latency_ms": _milliseconds([result.get("latency_s", []) for result in collecting]),
        "stages_ms": _stages(found.values()),
        "episodes": int(count),
        "mean_return": sum(s["return_sum"] for s in episodes) / count if count else None,
        "mean_length": sum(s["length_sum"] for s in episodes) / count if count else None,
        "diverged_steps": sum(result.get("diverged_steps") or 0 for result in collecting),
        "overflow_steps": _sums([result.get("overflow_steps") or {} for result in collecting]),
        "gmis": [_of_gmi(gmi, plan, result) for gmi, result in found.items()],
        "versions": _own_versions(),
        "device": next((r["device"] for r in found.values() if "device" in r), None),
        "impl": config.physics.impl,
    }


def serve_outcome(summary: Data, run: RunPaths) -> str:
    """The summary in a few lines for people."""
    of_all = " with all GMIs" if len(summary["gmis"]) > 1 else ""
    lines = [
        f"{summary['status']}: {summary['env_steps']:,} env steps in {clock(summary['wall_s'])}, "
        f"{_shown(summary['env_steps_per_s'], ',.0f')} env steps/s{of_all} "
        f"({_shown(summary['step_per_s_inference'], ',.0f')} in the median unroll)",
        f"episodes: {summary['episodes']:,}, mean return {_shown(summary['mean_return'], '.2f')}, "
        f"mean length {_shown(summary['mean_length'], '.0f')}",
    ]
    lines += [
        f"GMI {gmi['gmi']} ({gmi['roles']}): {_shown(gmi['env_steps_per_s'], ',.0f')} env steps/s"
        for gmi in (summary["gmis"] if of_all else ())
    ]
    if latency := summary["latency_ms"]:
        lines.append(
            f"latency of a step of {summary['plan']['num_envs_per_gmi']} environments: "
            f"p50 {latency['p50']:.3f} ms, p99 {latency['p99']:.3f} ms, {latency['num']} steps"
        )
    if stages := summary["stages_ms"]:
        parts = ", ".join(f"{name} {times['p50']:.3f} ms" for name, times in stages.items())
        lines.append(f"medians of its stages: {parts}")
    if output := summary["output"]:
        lines.append(
            f"experience: {output['shards']} shards, {output['env_steps']:,} env steps, "
            f"{output['bytes'] / 1e6:,.1f} MB in {nearby(Path(output['dir']))}"
        )
    warnings = overflow_warnings(summary["overflow_steps"])
    return "\n".join((*lines, f"summary: {nearby(run.summary)}")) + warnings


def _sums(counts: Sequence[Mapping[str, float]]) -> dict[str, float]:
    names = dict.fromkeys(name for one in counts for name in one)
    return {name: sum(one.get(name, 0.0) for one in counts) for name in names}


def _milliseconds(seconds: Sequence[Sequence[float]]) -> dict[str, float | int] | None:
    """Median and 99th percentile in ms over all samples, None where nothing was timed."""
    samples = [value for part in seconds for value in part]
    if not samples:
        return None
    p50, p99 = np.percentile(np.asarray(samples) * 1e3, [50, 99])
    return {"p50": float(p50), "p99": float(p99), "num": len(samples)}


def _result(run: RunPaths, gmi: int) -> dict[str, Any]:
    """Result of a GMI, or its last metrics if it did not end by itself."""
    paths = run.gmi(gmi)
    if paths.result.exists():
        return read_json(paths.result)
    lines = read_metrics(paths.metrics)
    if not lines:
        return {}
    return {"env_steps": lines[-1]["env_steps"], "serve_wall_s": lines[-1].get("wall_s")}


def _of_gmi(gmi: int, plan: Plan, result: Data) -> dict[str, Any]:
    return {
        "gmi": gmi,
        "roles": plan.roles[gmi],
        "env_steps": result.get("env_steps"),
        "env_steps_per_s": result.get("env_steps_per_s"),
        "latency_ms": _milliseconds([result.get("latency_s", [])]),
        "written": result.get("written") or None,
    }


def _policy(config: ServeConfig, results: Any) -> dict[str, Any]:
    digest = next((r["policy_digest"] for r in results if "policy_digest" in r), None)
    checkpoint = config.run.dir
    steps = CheckpointMeta.read(Path(checkpoint)).env_steps if checkpoint else None
    return {
        "kind": config.policy,
        "checkpoint": checkpoint,
        "trained_env_steps": steps,
        "deterministic": config.deterministic,
        "digest": digest,
    }


def _stages(results: Any) -> dict[str, Any]:
    """Medians and percentiles by stage, over all GMIs that went through it."""
    samples: dict[str, list[list[float]]] = {}
    for result in results:
        for name, seconds in result.get("stages_s", {}).items():
            samples.setdefault(name, []).append(seconds)
    timed = {name: _milliseconds(parts) for name, parts in samples.items()}
    return {name: times for name, times in timed.items() if times}


def _throughput(results: Sequence[Data]) -> float | None:
    """Steps of all GMIs over the time of the slowest: they begin together."""
    wall_s = _largest(results, "serve_wall_s")
    return sum(result["env_steps"] for result in results) / wall_s if wall_s else None


def _total(results: Sequence[Data], key: str) -> float | None:
    values = [result.get(key) for result in results]
    return sum(v for v in values if v is not None) if values and None not in values else None


def _largest(results: Sequence[Data], key: str) -> float | None:
    return max((result[key] for result in results if result.get(key) is not None), default=None)


def _shown(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def _of_plan(plan: Plan) -> dict[str, Any]:
    return {
        "backend": plan.backend,
        "layout": [list(gmis) for gmis in plan.layout.gmis_of_gpu],
        "nodes": plan.nodes_data(),
        "num_envs_per_gmi": plan.num_envs_per_gmi,
        "template": plan.template,
        "roles": list(plan.roles),
    }


def _own_versions() -> dict[str, str | None]:
    return {"gmijax": __version__, "python": sys.version.split()[0]}
