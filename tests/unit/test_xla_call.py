"""Python functions that a compiled program calls."""

from __future__ import annotations

import ctypes

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gmijax.collectives.xla_call import Buffer, register


def _add_two(
    stream: int, arguments: list[Buffer], results: list[Buffer], attributes: list[int]
) -> None:
    (given,), (added, counted) = arguments, results
    assert stream == 0  # There is none on a CPU.
    assert attributes == [1, -(2**40)]  # By name.
    if len(given.shape) != 2:
        raise ValueError(f"{len(given.shape)} axes")
    size = int(np.prod(given.shape))
    values = np.ctypeslib.as_array((ctypes.c_float * size).from_address(given.address))
    np.ctypeslib.as_array((ctypes.c_float * size).from_address(added.address))[:] = values + 2
    ctypes.c_int.from_address(counted.address).value = size


@pytest.fixture(scope="module")
def name() -> str:
    register("test_add_two", _add_two)
    return "test_add_two"


def _call(name: str, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    results = jax.ShapeDtypeStruct(x.shape, x.dtype), jax.ShapeDtypeStruct((), jnp.int32)
    call = jax.ffi.ffi_call(name, results, has_side_effect=True)
    changed, counted = call(x, least=np.int64(-(2**40)), is_there=np.int64(1))
    return changed, counted


def test_a_program_calls_it_every_time_with_its_memory(name: str) -> None:
    @jax.jit
    def program(x: jax.Array) -> tuple[jax.Array, jax.Array]:
        def body(_: int, carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            added, count = _call(name, carry[0])
            return added * 2.0, carry[1] + count

        return jax.lax.fori_loop(0, 3, body, (x, jnp.zeros((), jnp.int32)))

    for _ in range(2):
        values, count = program(jnp.ones((2, 3)))
        np.testing.assert_array_equal(values, np.full((2, 3), ((1 + 2) * 2 + 2) * 2 * 2 + 4))
        assert int(count) == 18


def test_what_it_raises_fails_the_program(name: str) -> None:
    with pytest.raises(jax.errors.JaxRuntimeError, match="test_add_two: 3 axes"):
        jax.block_until_ready(jax.jit(lambda x: _call(name, x))(jnp.ones((1, 2, 3))))
    jax.block_until_ready(jax.jit(lambda x: _call(name, x))(jnp.ones((1, 2))))  # Not for ever.
