"""What a reduction should cost by the paper's model (section 4.1, Table 2); no jax.

The letters are the paper's: g GPUs with t GMIs each, M_p bytes of parameters, B1 the bandwidth
between GMIs through the host, B2 the bandwidth of a ring between GPUs, both in bytes a second.
The model counts bytes only. Neither the fixed price of a message nor the broadcast at the end is
in it, so that it is a lower limit for small networks.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from gmijax.errors import ConfigError
from gmijax.partition.layout import Layout

BYTES_PER_FLOAT = 4


def mpr_s(g: int, t: int, m_p: float, b1: float, b2: float) -> float:
    """Seconds of multi-process reduction: 2 (g t - 1) M_p / (g t B1)."""
    del b2
    return 2 * (g * t - 1) * m_p / (g * t * b1)


def mrr_s(g: int, t: int, m_p: float, b1: float, b2: float) -> float:
    """Seconds of multi-ring reduction: 2 (g - 1) (t + 1) M_p / (g B2)."""
    del b1
    return 2 * (g - 1) * (t + 1) * m_p / (g * b2)


def har_s(g: int, t: int, m_p: float, b1: float, b2: float) -> float:
    """Seconds of hierarchical reduction: 2 (g - 1) M_p / (g B2) + 2 (t - 1) M_p / (t B1)."""
    return 2 * (g - 1) * m_p / (g * b2) + 2 * (t - 1) * m_p / (t * b1)


def flat_s(g: int, t: int, m_p: float, b1: float, b2: float) -> float:
    """Seconds of one ring over all GMIs: 2 (g t - 1) M_p / (g t B2).

    Not in the paper: its ring formula for g t members.
    """
    del b1
    return 2 * (g * t - 1) * m_p / (g * t * b2)


def one_shot_s(g: int, t: int, m_p: float, b1: float, b2: float) -> float:
    """Seconds of writing to every GPU: (g - 1) t M_p / B2, what leaves a GPU.

    Not in the paper. Memory of the own GPU is taken to cost nothing.
    """
    del b1
    return (g - 1) * t * m_p / b2


COSTS: Mapping[str, Callable[[int, int, float, float, float], float]] = {
    "mpr": mpr_s,
    "mrr": mrr_s,
    "har": har_s,
    "flat": flat_s,
    "one_shot": one_shot_s,
}
"""Time of every strategy, as a function of (g, t, M_p, B1, B2)."""


def predicted_s(strategy: str, layout: Layout, num_floats: int, b1: float, b2: float) -> float:
    """Seconds that one mean of `num_floats` float32 should take.

    In an uneven layout t is the number of GMIs on the fullest GPU: the others wait for it.

    Args:
      strategy: a key of `COSTS`.
      layout: where the GMIs live.
      num_floats: P.
      b1: bytes a second between GMIs through host memory.
      b2: bytes a second of a ring between GPUs.

    Raises:
      ConfigError: a bandwidth that is not positive, or another strategy.
    """
    if strategy not in COSTS:
        raise ConfigError(f"strategy={strategy}: expected one of {', '.join(COSTS)}")
    if b1 <= 0 or b2 <= 0:
        raise ConfigError(f"b1={b1:g}, b2={b2:g}: bandwidths must be positive")
    most = max(len(gmis) for gmis in layout.gmis_of_gpu)
    return COSTS[strategy](layout.num_gpus, most, num_floats * BYTES_PER_FLOAT, b1, b2)
