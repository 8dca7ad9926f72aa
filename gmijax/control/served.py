"""What a serving job has come to: progress while it runs, the summary after it. No jax here."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gmijax.config import ServeConfig
from gmijax.partition.plan import Plan
from gmijax.physics_health import overflow_warnings
from gmijax.results import MetricsReader, read_metrics
from gmijax.resume import CheckpointMeta
from gmijax.rundir import RunPaths, read_json
from gmijax.version import __version__


class CollectedLines:
    """The lines of all GMIs that simulate as one; for `ConsoleProgress`."""

    def __init__(self, run: RunPaths, simulators: Sequence[int], steps_before: int) -> None:
        self._readers = {gmi: MetricsReader(run.gmi(gmi).metrics) for gmi in simulators}
        self._lines: dict[int, dict[str, Any]] = {}
        self._steps_before = steps_before

    def latest(self) -> dict[str, Any] | None:
        """Sums of steps and rates and the mean return, None if nothing is new."""
        new = {gmi: line for gmi, reader in self._readers.items() if (line := reader.latest())}
        self._lines |= new
        if not new:
            return None
        lines = self._lines.values()
        returns = [line["return"] for line in lines if line["return"] is not None]
        return {
            "env_steps": self._steps_before + sum(line["env_steps"] for line in lines),
            "env_steps_per_s": sum(line["env_steps_per_s"] for line in lines),
            "return": sum(returns) / len(returns) if returns else None,
        }


def summarise(
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
        "plan": {
            "backend": plan.backend,
            "layout": [list(gmis) for gmis in plan.layout.gmis_of_gpu],
            "template": plan.template,
            "roles": list(plan.roles),
            "num_envs_per_gmi": plan.num_envs_per_gmi,
        },
        "env_steps": sum(result["env_steps"] for result in collecting),
        "wall_s": wall_s,
        "serve_wall_s": _largest(collecting, "serve_wall_s"),
        "compile_s": _largest(list(found.values()), "compile_s"),
        "env_steps_per_s": _throughput(collecting),
        # In a job that goes on, a GMI may have nothing left to collect.
        "step_per_s_inference": _total(
            [result for result in collecting if result["env_steps"]], "step_per_s_inference"
        ),
        "latency_ms": milliseconds([result.get("latency_s", []) for result in collecting]),
        "stages_ms": _stages(found.values()),
        "episodes": int(count),
        "mean_return": sum(s["return_sum"] for s in episodes) / count if count else None,
        "mean_length": sum(s["length_sum"] for s in episodes) / count if count else None,
        "diverged_steps": sum(result.get("diverged_steps") or 0 for result in collecting),
        "overflow_steps": _sums([result.get("overflow_steps") or {} for result in collecting]),
        "gmis": [_of_gmi(gmi, plan, result) for gmi, result in found.items()],
        "versions": {"gmijax": __version__, "python": sys.version.split()[0]},
        "device": next((r["device"] for r in found.values() if "device" in r), None),
        "impl": config.physics.impl,
    }


def outcome(summary: Mapping[str, Any], run: RunPaths) -> str:
    """The summary in a few lines for people."""
    lines = [
        f"{summary['status']}: {summary['env_steps']:,} env steps in {summary['wall_s']:.0f} s, "
        f"{_shown(summary['env_steps_per_s'], ',.0f')} env steps/s with all GMIs "
        f"({_shown(summary['step_per_s_inference'], ',.0f')} in the median unroll)",
        f"episodes: {summary['episodes']:,}, mean return {_shown(summary['mean_return'], '.2f')}, "
        f"mean length {_shown(summary['mean_length'], '.0f')}",
    ]
    lines += [
        f"GMI {gmi['gmi']} ({gmi['roles']}): {_shown(gmi['env_steps_per_s'], ',.0f')} env steps/s"
        for gmi in summary["gmis"]
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
            f"{output['bytes'] / 1e6:,.1f} MB in {output['dir']}"
        )
    warnings = overflow_warnings(summary["overflow_steps"])
    return "\n".join((*lines, f"summary: {run.summary}")) + warnings


def _sums(counts: Sequence[Mapping[str, float]]) -> dict[str, float]:
    names = dict.fromkeys(name for one in counts for name in one)
    return {name: sum(one.get(name, 0.0) for one in counts) for name in names}


def milliseconds(seconds: Sequence[Sequence[float]]) -> dict[str, float | int] | None:
    """Median and 99th percentile in ms over all samples, None where nothing was timed."""
    samples = [value for part in seconds for value in part]
    if not samples:
        return None
    p50, p99 = np.percentile(np.asarray(samples) * 1e3, [50, 99])
    return {"p50": float(p50), "p99": float(p99), "num": len(samples)}


def _result(run: RunPaths, gmi: int) -> dict[str, Any]:
    """What a GMI left, or what its lines say if it did not end by itself."""
    paths = run.gmi(gmi)
    if paths.result.exists():
        return read_json(paths.result)
    lines = read_metrics(paths.metrics)
    if not lines:
        return {}
    return {"env_steps": lines[-1]["env_steps"], "serve_wall_s": lines[-1]["wall_s"]}


def _of_gmi(gmi: int, plan: Plan, result: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "gmi": gmi,
        "roles": plan.roles[gmi],
        "env_steps": result.get("env_steps"),
        "env_steps_per_s": result.get("env_steps_per_s"),
        "latency_ms": milliseconds([result.get("latency_s", [])]),
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
    timed = {name: milliseconds(parts) for name, parts in samples.items()}
    return {name: times for name, times in timed.items() if times}


def _throughput(results: Sequence[Mapping[str, Any]]) -> float | None:
    """Steps of all GMIs over the time of the slowest: they begin together."""
    wall_s = _largest(results, "serve_wall_s")
    return sum(result["env_steps"] for result in results) / wall_s if wall_s else None


def _total(results: Sequence[Mapping[str, Any]], key: str) -> float | None:
    values = [result.get(key) for result in results]
    return sum(v for v in values if v is not None) if values and None not in values else None


def _largest(results: Sequence[Mapping[str, Any]], key: str) -> float | None:
    return max((result[key] for result in results if result.get(key) is not None), default=None)


def _shown(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)
