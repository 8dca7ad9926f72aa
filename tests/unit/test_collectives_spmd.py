"""A step as one program, on the one device that a test has."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from gmijax.collectives.spmd import AXIS, SpmdStep

N = 4


def _step(peers, constants, shared, own):
    noise = jax.vmap(jax.random.normal)(own["key"])
    x = own["x"] * constants["scale"] + constants["offset"] + noise
    shared = shared + peers.mean(x)
    own = {**own, "x": x, "key": jax.vmap(jax.random.fold_in, (0, None))(own["key"], 1)}
    metrics = {"sum": jnp.sum(x), "count": jnp.int32(x.size), "gathered": peers.gather(x)}
    return shared, own, {**metrics, "rank": peers.rank(), "has_nan": jnp.isnan(x).any()}


def _arguments():
    constants = {
        "scale": jnp.float32(2.0),
        "offset": np.arange(N, dtype=np.float32),
        "nothing": jnp.zeros((0, 3)),
    }
    own = {
        "x": jnp.ones(N),
        "key": jax.random.split(jax.random.key(0), N),
        "nothing": jnp.zeros((N, 0), jnp.int32),
    }
    return constants, jnp.zeros(N), own


def _made(step=_step, rank: int = 3) -> SpmdStep:
    made = SpmdStep(Mesh(np.array(jax.devices()[:1]), (AXIS,)), [rank], step)
    made.trace(*_arguments())
    made.compile()
    return made


def test_it_computes_what_the_step_does() -> None:
    program = _made()
    _, shared, own = _arguments()
    shared, own, metrics = program(shared, own)
    shared, own, metrics = program(shared, own)

    class Alone:
        rank = staticmethod(lambda: 3)
        gather = staticmethod(lambda x: x[None])
        mean = staticmethod(lambda x: x)

    constants, expected, kept = _arguments()
    for _ in range(2):
        expected, kept, told = _step(Alone, constants, expected, kept)
    np.testing.assert_allclose(shared, expected, rtol=1e-6)
    np.testing.assert_allclose(own["x"], kept["x"], rtol=1e-6)
    np.testing.assert_array_equal(
        *(jax.random.key_data(tree["key"]) for tree in (own, kept)),
    )
    for name, value in told.items():
        np.testing.assert_allclose(metrics[name], value, rtol=1e-6)


def test_arrays_without_elements_come_back_as_they_went_in() -> None:
    _, own, _ = _made()(*_arguments()[1:])[0:3]
    assert own["nothing"].shape == (N, 0)
    assert own["nothing"].dtype == jnp.int32


def test_a_call_returns_when_the_one_before_is_computed() -> None:
    def slow(peers, constants, shared, own):
        power = jax.lax.fori_loop(0, 300, lambda _, x: jnp.cos(x @ x), jnp.eye(400) + own["x"][0])
        return shared + jnp.sum(power), own, jnp.sum(power) + 1

    program = _made(slow)
    shared, own, first = program(*_arguments()[1:])
    assert not first.is_ready()
    shared, own, second = program(shared, own)
    assert first.is_ready()
    assert not second.is_ready()
    program.wait()
    assert shared.is_ready()
    assert second.is_ready()


def test_metrics_keep_their_types() -> None:
    _, _, metrics = _made()(*_arguments()[1:])
    assert metrics["count"] == N
    assert metrics["count"].dtype == np.int32
    assert metrics["rank"] == 3
    assert metrics["has_nan"].dtype == bool
    assert metrics["gathered"].shape == (1, N)


def test_a_step_may_tell_nothing() -> None:
    def silent(peers, constants, shared, own):
        return (*_step(peers, constants, shared, own)[:2], ())

    assert _made(silent)(*_arguments()[1:])[2] == ()
