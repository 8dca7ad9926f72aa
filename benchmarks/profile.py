"""Where the time of a PPO iteration goes, from a trace of the profiler.

`python -m benchmarks.profile env=ant num_envs=8192 physics.impl=warp` runs agent, trainer,
simulator and the whole iteration, each as a program of its own in this process, and traces some
rounds of each. It says how long a round takes, how many kernels it has, how long none of them
runs, which ones take longest, and how long the products of its matrices and its bytes would take
at the rates that this device reaches by itself. With MJX-Warp it also says how long MuJoCo Warp
takes for the simulator's physics without JAX. Adds a call to
`benchmarks/results/profile-<task>-<device>.json`.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.profiler import ProfileData
from mujoco.mjx import warp as mjx_warp

from benchmarks.records import RESULTS, ResultsFile, file_name
from benchmarks.stages import Stage, stages
from gmijax import compose
from gmijax.config import PpoConfig, TrainConfig
from gmijax.learning.learner import learner_shapes
from gmijax.sim.impl import choose_impl
from gmijax.sim.physics import load
from gmijax.sim.warp.step import joined
from gmijax.sim.warp.worlds import OVERFLOW, STATE, Worlds, lay_out

WARM_UP, TIMED, TRACED = 2, 10, 2
"""Rounds of a stage: first, then timed, then traced."""

KEPT = 60
"""Kernels of a stage that the file has."""

_METADATA = re.compile(r"%?([\w.-]+) = .*metadata={[^}]*op_name=\"([^\"]*)\"")


class Kernel(NamedTuple):
    """One run of a kernel; on a CPU, of an instruction.

    Attributes:
      name: of the kernel.
      instruction: of the compiled program, which it belongs to.
      start_ns: on the clock of the trace.
      duration_ns: how long it ran.
    """

    name: str
    instruction: str
    start_ns: float
    duration_ns: float


class Rates(NamedTuple):
    """What the device reaches with nothing else to do.

    Attributes:
      flop_per_s: of products of float32 matrices, at the precision that programs use.
      bfloat16_flop_per_s: of products of bfloat16 matrices.
      byte_per_s: read and written by a copy.
    """

    flop_per_s: float
    bfloat16_flop_per_s: float
    byte_per_s: float


def main() -> int:
    """Measures and prints; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("overrides", nargs="*", help="as for `python -m gmijax.train`")
    parser.add_argument(
        "--stages", nargs="+", default=["agent", "trainer", "simulator", "iteration"]
    )
    parser.add_argument("--top", type=int, default=12, help="kernels to print of each stage")
    parser.add_argument("--out", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    config = compose(*arguments.overrides)
    assert isinstance(config.algo, PpoConfig)
    impl, _ = choose_impl(config.physics.impl, jax.default_backend(), config.env.name)
    device = jax.local_devices()[0].device_kind
    path = arguments.out / file_name(f"profile-{config.env.slug}", device)
    file = ResultsFile(path, "profile", vars(arguments), device=device)
    rates = measure_rates()
    with file.changing() as results:
        results.update(impl=impl, rates=rates._asdict(), stages={})
    for stage in stages(config, impl):
        if stage.name in arguments.stages:
            row = profile(stage, rates, products(stage.name, config, stage))
            if stage.name == "simulator" and impl == "warp":
                row["warp_alone_ms"] = warp_alone_ms(config, stage)
            with file.changing() as results:
                results["stages"][stage.name] = row
            _print(stage.name, row, arguments.top)
    sys.stdout.write(f"written: {path}\n")
    return 0


def measure_rates() -> Rates:
    """Products of 4096 x 4096 matrices, and a copy of 256 MiB; smaller on a CPU."""
    on_gpu = jax.default_backend() == "gpu"
    size, floats = (4096, 1 << 26) if on_gpu else (512, 1 << 22)
    # Its powers are itself, so numbers stay as they are.
    square, long = jnp.full((size, size), 1.0 / size), jnp.ones(floats)
    chain = jax.jit(lambda a: jax.lax.fori_loop(0, 20, lambda _, b: b @ a, a))
    copy = jax.jit(lambda x: x + 1.0)
    flop = 20 * 2.0 * size**3
    return Rates(
        flop / seconds(lambda: chain(square)),
        flop / seconds(lambda: chain(square.astype(jnp.bfloat16))),
        2 * 4 * floats / seconds(lambda: copy(long)),
    )


def seconds(run: Callable[[], Any]) -> float:
    """The shortest of ten calls, after two."""
    times = []
    for _ in range(12):
        started = time.perf_counter()
        jax.block_until_ready(run())
        times.append(time.perf_counter() - started)
    return min(times[2:])


def products(name: str, config: TrainConfig, stage: Stage) -> float:
    """Floating-point operations of the matrix products of the networks in a round.

    A sample costs two for each weight forwards, and four more backwards, but for the gradient
    with respect to the observation, which nobody wants.
    """
    algo, spec = config.algo, stage.spec
    assert isinstance(algo, PpoConfig)
    samples = config.envs_per_gmi * algo.unroll_length
    params = learner_shapes(spec, algo).params
    sizes = [
        [leaf.size for leaf in jax.tree.leaves(net) if leaf.ndim == 2]
        for net in (params.policy, params.value)
    ]
    first = spec.obs_size * (algo.policy_hidden_layer_sizes[0] + algo.value_hidden_layer_sizes[0])
    policy, value = map(sum, sizes)
    acting = 2.0 * policy * samples
    training = algo.num_updates_per_batch * samples * (6.0 * (policy + value) - 2.0 * first)
    estimates = 2 * 2.0 * value * samples
    return {"agent": acting, "trainer": training, "simulator": 0.0}.get(
        name, acting + training + estimates
    )


def profile(stage: Stage, rates: Rates, flop: float) -> dict[str, Any]:
    """What a round of the stage takes, and its kernels by the time they take."""
    state = jax.tree.map(jnp.copy, stage.state)
    compiled = jax.jit(stage.program, donate_argnums=1).lower(stage.given, state).compile()
    names = dict(_METADATA.findall(compiled.as_text() or ""))
    for _ in range(WARM_UP):
        state = compiled(stage.given, state)
    jax.block_until_ready(state)
    started = time.perf_counter()
    for _ in range(TIMED):
        state = compiled(stage.given, state)
    jax.block_until_ready(state)
    round_s = (time.perf_counter() - started) / TIMED
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            for _ in range(TRACED):
                state = compiled(stage.given, state)
            jax.block_until_ready(state)
        kernels = list(read_kernels(Path(folder)))
    cost: Any = compiled.cost_analysis() or {}
    return {
        "round_ms": round_s * 1e3,
        "kernels": len(kernels) / TRACED,
        "busy_ms": busy_ns(kernels) / TRACED / 1e6,
        "products_gflop": flop / 1e9,
        "products_ms": flop / rates.flop_per_s * 1e3,
        "products_bfloat16_ms": flop / rates.bfloat16_flop_per_s * 1e3,
        "bytes_once": cost.get("bytes accessed"),
        "longest": by_time(kernels, names),
    }


def warp_alone_ms(config: TrainConfig, stage: Stage) -> float:
    """The physics of a round by MuJoCo Warp alone: its kernels in a CUDA graph, over and over.

    As its own speed test has it, no episode ends. Worlds begin as episodes do, with random
    controls that stay.
    """
    assert isinstance(config.algo, PpoConfig)
    name, count, warp = str(config.env.name), config.envs_per_gmi, mjx_warp.warp
    physics = load(name, impl="warp", substeps=1)
    mj_model, first = physics.mj_model, stage.state.env.physics
    assert physics.warp is not None
    low, high = mj_model.actuator_ctrlrange.T
    ctrl = jax.random.uniform(jax.random.key(0), (count, mj_model.nu), minval=low, maxval=high)
    arrays = {"ctrl": ctrl, **{key: getattr(first, key) for key in STATE}}
    given = tuple((key, array.shape) for key, array in arrays.items())
    layout = lay_out(given[:1], given[1:], ((OVERFLOW, (count,)),))
    substeps = round(stage.spec.control_dt_s / mj_model.opt.timestep)
    worlds = Worlds(mj_model, substeps, physics.warp.sizes, layout)
    given_once = warp.array(np.asarray(joined(layout, arrays)))
    worlds.step(given_once, warp.zeros(layout.size - layout.first_taken))
    for rounds in (WARM_UP, TIMED):
        warp.synchronize()
        started = time.perf_counter()
        for _ in range(rounds * config.algo.unroll_length):
            worlds.advance()
        warp.synchronize()
    return (time.perf_counter() - started) / TIMED * 1e3


def read_kernels(folder: Path) -> Iterable[Kernel]:
    """All kernels in a trace; on a CPU the instructions that hold no others."""
    (path,) = folder.rglob("*.xplane.pb")
    on_gpu = jax.default_backend() == "gpu"
    for plane in ProfileData.from_file(str(path)).planes:
        if ("/device:GPU" in plane.name) != on_gpu:
            continue
        for line in plane.lines:
            if on_gpu and not line.name.startswith("Stream"):
                continue
            for event in line.events:
                about = dict(event.stats)
                instruction = str(about.get("hlo_op", ""))
                if (on_gpu or instruction) and not instruction.startswith(("while", "call")):
                    yield Kernel(event.name, instruction, event.start_ns, event.duration_ns)


def busy_ns(kernels: Iterable[Kernel]) -> float:
    """Time in which at least one kernel runs."""
    total, until = 0.0, float("-inf")
    for kernel in sorted(kernels, key=lambda k: k.start_ns):
        end = kernel.start_ns + kernel.duration_ns
        total += max(0.0, end - max(kernel.start_ns, until))
        until = max(until, end)
    return total


def by_time(kernels: Iterable[Kernel], names: dict[str, str]) -> list[dict[str, Any]]:
    """Kernels of one instruction together, the longest first; figures are of one round."""
    groups: dict[tuple[str, str], list[float]] = defaultdict(list)
    for kernel in kernels:
        groups[kernel.instruction, kernel.name].append(kernel.duration_ns)
    rows = [
        {
            "instruction": instruction,
            "kernel": name,
            "runs": len(times) / TRACED,
            "ms": sum(times) / TRACED / 1e6,
            "source": names.get(instruction, ""),
        }
        for (instruction, name), times in groups.items()
    ]
    return sorted(rows, key=lambda row: -row["ms"])[:KEPT]


def _print(name: str, row: dict[str, Any], top: int) -> None:
    alone = f"; MuJoCo Warp alone {row['warp_alone_ms']:.3f} ms" if "warp_alone_ms" in row else ""
    sys.stdout.write(
        f"{name}: {row['round_ms']:.3f} ms a round, {row['kernels']:.0f} kernels, busy "
        f"{row['busy_ms']:.3f} ms; products alone {row['products_ms']:.3f} ms, in bfloat16 "
        f"{row['products_bfloat16_ms']:.3f} ms{alone}\n"
    )
    for kernel in row["longest"][:top]:
        sys.stdout.write(
            f"  {kernel['ms']:9.3f} ms {kernel['runs']:7.0f} x {kernel['kernel'][:60]:60} "
            f"{kernel['source'][-60:]}\n"
        )


if __name__ == "__main__":
    sys.exit(main())
