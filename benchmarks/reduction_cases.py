"""Suites of what the reduction of gradients costs in training. Data only."""

from __future__ import annotations

from types import MappingProxyType

from benchmarks.case import Case

_SCALES = (1, 2, 4, 8)

_WIDE = tuple(f"algo.{net}_hidden_layer_sizes=[512,512,512,256]" for net in ("policy", "value"))

_TRAINERS = ((2, 2), (2, 3), (4, 4))


def _lgr(task: str, gpus: int, gmis: int, strategy: str, *more: str) -> Case:
    """A cell of the paper's table of LGR: so many GPUs with so many trainers each."""
    return Case(
        f"{gpus}G{gmis}T {strategy}",
        (
            f"env={task}",
            "num_envs=2048",
            # A dozen iterations of the longest rollout.
            f"num_timesteps={12 * 32 * 2048 * gpus * gmis}",
            f"plan.gpus={gpus}",
            f"plan.gmis_per_gpu={gmis}",
            "plan.backend=mps",
            f"reduce.strategy={strategy}",
            "run.measure_throughput=false",
            "run.checkpoint_every=0",
            *more,
        ),
        gpus,
    )


def _scaling(gpus: int, gmis: int, strategy: str) -> Case:
    """8192 environments on every GPU: weak scaling."""
    strategy = "auto" if gpus * gmis == 1 else strategy
    return Case(
        f"{gpus} GPUs x {gmis} GMIs x {8192 // gmis}",
        (
            "env=ant",
            f"num_envs={8192 // gmis}",
            f"num_timesteps={40 * 16 * 8192 * gpus}",
            f"plan.gpus={gpus}",
            f"plan.gmis_per_gpu={gmis}",
            f"reduce.strategy={strategy}",
            "run.measure_throughput=false",
            "run.checkpoint_every=0",
        ),
        gpus,
    )


REDUCTION = MappingProxyType(
    {
        # Gradients through host memory against the best layout-aware reduction.
        **{
            f"lgr-{task}": tuple(
                _lgr(task, gpus, gmis, strategy)
                for gpus, gmis in _TRAINERS
                for strategy in ("mpr", "har")
            )
            for task in ("ant", "humanoid", "shadow_hand")
        },
        # The choice of Algorithm 1 where it is not har.
        **{
            f"lgr-{task}-mrr": (_lgr(task, 2, 2, "mrr"), _lgr(task, 4, 4, "mrr"))
            for task in ("ant", "humanoid", "shadow_hand")
        },
        # The same without rings, beside mpr in one run.
        **{
            f"lgr-{task}-one_shot": tuple(
                _lgr(task, gpus, gmis, strategy)
                for gpus, gmis in _TRAINERS
                for strategy in ("mpr", "one_shot")
            )
            for task in ("ant", "humanoid", "shadow_hand")
        },
        # Both on MJX-JAX, which needs no kernels: ant, and ant with the networks of shadow_hand.
        **{
            f"lgr-{name}-jax": tuple(
                _lgr("ant", gpus, gmis, strategy, "physics.impl=jax", *networks)
                for gpus, gmis in _TRAINERS
                for strategy in ("mpr", "one_shot")
            )
            for name, networks in (("ant", ()), ("ant-1.5M", _WIDE))
        },
        "scaling": tuple(
            _scaling(gpus, gmis, strategy)
            for gmis, strategy in ((1, "flat"), (2, "har"))
            for gpus in _SCALES
        ),
        "scaling-one_shot": tuple(
            _scaling(gpus, gmis, "one_shot") for gmis in (1, 2) for gpus in _SCALES
        ),
    }
)
"""Suite -> cases."""
