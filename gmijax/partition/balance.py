"""How many GPUs act and how many train where no GPU does both (section 5.1, decoupled). No jax.

The paper divides the GPUs of an asynchronous job by hand. Here one serving and one training GPU
are measured, and the division follows: trainers learn from nothing that was not made, and nobody
makes what will not be taken, so that a job with s and t of them makes min(s acting, t learning)
environment steps a second. TTOP cannot exceed PPS.
"""

from __future__ import annotations

from typing import NamedTuple


class Split(NamedTuple):
    """What the GPUs of a job do.

    Attributes:
      serving: number of GPUs that act.
      training: number of GPUs that train.
    """

    serving: int
    training: int


def throughput(split: Split, acting_per_s: float, learning_per_s: float) -> float:
    """Environment steps a second that are acted upon and learnt from.

    Args:
      split: GPUs of each kind.
      acting_per_s: environment steps a second that one serving GPU can make.
      learning_per_s: those that one training GPU can learn from.
    """
    return min(split.serving * acting_per_s, split.training * learning_per_s)


def balance(num_gpus: int, acting_per_s: float, learning_per_s: float) -> Split:
    """The split of `num_gpus` with the highest throughput; of equals that with most serving GPUs.

    Raises:
      ValueError: fewer than two GPUs.
    """
    if num_gpus < 2:
        raise ValueError(f"num_gpus={num_gpus}: one GPU cannot be split")
    splits = [Split(num_gpus - training, training) for training in range(1, num_gpus)]
    return max(splits, key=lambda split: throughput(split, acting_per_s, learning_per_s))


def per_gpu(acting_per_s: float, learning_per_s: float) -> float:
    """Environment steps a second for each GPU of very many, of which the best part trains.

    A job with x of its GPUs training balances where (1 - x) acting = x learning.
    """
    return acting_per_s * learning_per_s / (acting_per_s + learning_per_s)
