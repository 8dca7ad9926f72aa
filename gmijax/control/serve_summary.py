"""The summary of a serving job: `summary.json`, and its lines for people."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gmijax.config import ServeConfig
from gmijax.control.console import nearby
from gmijax.control.display import clock
from gmijax.control.summary import Data, plan_data
from gmijax.learning.physics_health import overflow_warnings
from gmijax.partition.plan import Plan
from gmijax.runs.checkpoints import CheckpointMeta
from gmijax.runs.folder import RunPaths, read_json
from gmijax.runs.history import read_metrics
from gmijax.version import versions_of


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
        "plan": plan_data(plan),
        "env_steps": sum(result["env_steps"] for result in collecting),
        "wall_s": wall_s,
        "serve_wall_s": _largest(collecting, "serve_wall_s"),
        "compile_s": _largest(list(found.values()), "compile_s"),
        "env_steps_per_s": _throughput(collecting),
        # In a continued job, a GMI may have nothing left to collect.
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
        "versions": versions_of(("gmijax", "python")),
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


def _of_gmi(gmi: int, plan: Plan, result: Data) -> dict[str, Any]:
    return {
        "gmi": gmi,
        "roles": plan.roles[gmi],
        "env_steps": result.get("env_steps"),
        "env_steps_per_s": result.get("env_steps_per_s"),
        "latency_ms": _milliseconds([result.get("latency_s", [])]),
        "written": result.get("written") or None,
    }


def _result(run: RunPaths, gmi: int) -> dict[str, Any]:
    """Result of a GMI, or its last metrics if it did not end by itself."""
    paths = run.gmi(gmi)
    if paths.result.exists():
        return read_json(paths.result)
    lines = read_metrics(paths.metrics)
    if not lines:
        return {}
    return {"env_steps": lines[-1]["env_steps"], "serve_wall_s": lines[-1].get("wall_s")}


def _stages(results: Any) -> dict[str, Any]:
    """Medians and percentiles by stage, over all GMIs that went through it."""
    samples: dict[str, list[list[float]]] = {}
    for result in results:
        for name, seconds in result.get("stages_s", {}).items():
            samples.setdefault(name, []).append(seconds)
    timed = {name: _milliseconds(parts) for name, parts in samples.items()}
    return {name: times for name, times in timed.items() if times}


def _milliseconds(seconds: Sequence[Sequence[float]]) -> dict[str, float | int] | None:
    """Median and 99th percentile in ms over all samples, None where nothing was timed."""
    samples = [value for part in seconds for value in part]
    if not samples:
        return None
    p50, p99 = np.percentile(np.asarray(samples) * 1e3, [50, 99])
    return {"p50": float(p50), "p99": float(p99), "num": len(samples)}


def _throughput(results: Sequence[Data]) -> float | None:
    """Steps of all GMIs over the time of the slowest: they begin together."""
    wall_s = _largest(results, "serve_wall_s")
    return sum(result["env_steps"] for result in results) / wall_s if wall_s else None


def _total(results: Sequence[Data], key: str) -> float | None:
    values = [result.get(key) for result in results]
    return sum(v for v in values if v is not None) if values and None not in values else None


def _largest(results: Sequence[Data], key: str) -> float | None:
    return max((result[key] for result in results if result.get(key) is not None), default=None)


def _sums(counts: Sequence[Mapping[str, float]]) -> dict[str, float]:
    names = dict.fromkeys(name for one in counts for name in one)
    return {name: sum(one.get(name, 0.0) for one in counts) for name in names}


def _shown(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)
