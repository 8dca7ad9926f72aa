"""How GPUs are divided between acting and training."""

from __future__ import annotations

import pytest

from gmijax.autotune.async_workload import balance, per_gpu, throughput
from gmijax.autotune.workloads import Split


@pytest.mark.parametrize(
    ("num_gpus", "acting_per_s", "learning_per_s", "split"),
    [
        (2, 1.0, 100.0, (1, 1)),  # There must be one of each, whatever they can do.
        (2, 100.0, 1.0, (1, 1)),
        (4, 1.0, 3.0, (3, 1)),
        (4, 3.0, 1.0, (1, 3)),
        (4, 1.0, 1.0, (2, 2)),
        (8, 1.0, 3.0, (6, 2)),
        (8, 1.0, 7.0, (7, 1)),
        (8, 1.0, 100.0, (7, 1)),
        (3, 2.0, 2.0, (2, 1)),  # As good as (1, 2), with fewer training GPUs.
    ],
)
def test_the_split_with_the_highest_throughput(num_gpus, acting_per_s, learning_per_s, split):
    assert balance(num_gpus, acting_per_s, learning_per_s) == split


def test_nobody_learns_from_what_was_not_made():
    assert throughput(Split(2, 1), 10.0, 30.0) == 20.0
    assert throughput(Split(2, 1), 10.0, 15.0) == 15.0


def test_no_other_split_is_better():
    for num_gpus in range(2, 10):
        for acting_per_s in (1.0, 2.5, 40.0):
            for learning_per_s in (1.5, 4.0):
                found = balance(num_gpus, acting_per_s, learning_per_s)
                assert found.serving + found.training == num_gpus
                rate = throughput(found, acting_per_s, learning_per_s)
                # No better than what GPUs in any proportion could do.
                assert rate <= num_gpus * per_gpu(acting_per_s, learning_per_s) * (1 + 1e-9)
                for training in range(1, num_gpus):
                    other = Split(num_gpus - training, training)
                    assert throughput(other, acting_per_s, learning_per_s) <= rate


def test_per_gpu_is_what_a_balanced_job_makes():
    # 3 of 4 GPUs act: 3 x 1 = 1 x 3.
    assert 4 * per_gpu(1.0, 3.0) == pytest.approx(throughput(Split(3, 1), 1.0, 3.0))


def test_one_gpu_cannot_be_split():
    with pytest.raises(ValueError, match="num_gpus=1"):
        balance(1, 1.0, 1.0)
