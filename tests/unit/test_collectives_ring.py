"""Rings as far as one process can show them; the rest is in the contract of reducers."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from jax.sharding import Mesh

from gmijax.collectives.ring import Ring, process_ids
from gmijax.collectives.spmd import AXIS
from gmijax.partition.layout import Layout


@pytest.mark.parametrize(
    ("gmis_of_gpu", "expected"),
    [
        (((0,), (1,)), (0, 1)),
        (((0, 1), (2, 3)), (0, 2, 1, 3)),
        (((0, 1, 2), (3, 4, 5)), (0, 2, 4, 1, 3, 5)),
        (((0, 1), (2,)), (0, 2, 1)),
        (((1, 2), (0, 3)), (1, 0, 2, 3)),
    ],
)
def test_members_of_a_ring_have_consecutive_numbers(
    gmis_of_gpu: tuple[tuple[int, ...], ...], expected: tuple[int, ...]
) -> None:
    assert process_ids(Layout(gmis_of_gpu)) == expected


def test_a_ring_of_one_scales_and_broadcasts() -> None:
    ring = Ring(Mesh(np.array(jax.local_devices()[:1]), (AXIS,)), 5)
    values = np.array([1.0, -2.5, 0.0, np.inf, 3e38], np.float32)
    buffer = jax.device_put(values)
    np.testing.assert_array_equal(ring.sum(buffer), values)
    np.testing.assert_array_equal(ring.sum(buffer, 0.25), values * np.float32(0.25))
    np.testing.assert_array_equal(ring.broadcast(buffer, source=0), values)
    assert ring.sum(buffer).devices() == set(jax.local_devices()[:1])
