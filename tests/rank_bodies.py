"""What the ranks of a test do with their communicators, each in a process of its own."""

from __future__ import annotations

import functools
import hashlib
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from gmijax.collectives.interface import Collectives, Communicator, FloatBuffer, TracedStep
from gmijax.errors import CollectiveError
from gmijax.types import Array

Options = dict[str, Any]


def zeros(size: int) -> Array:
    """Zeros [size] on the device, without a program that makes them."""
    import jax

    return jax.device_put(np.zeros(size, np.float32))


@functools.cache
def mean_of(comm: Communicator, size: int) -> Callable[[FloatBuffer], FloatBuffer]:
    """A function that takes the mean of buffers [size] in a program, compiled once."""
    import jax

    def step(
        collectives: Collectives, _: Any, shared: Array, own: Array
    ) -> tuple[Array, Array, Any]:
        return collectives.mean(own), own, ()

    program = comm.program(step)
    program.trace((), zeros(size), zeros(size))
    program.compile()

    def call(buffer: FloatBuffer) -> FloatBuffer:
        mean, _, _ = program(zeros(size), jax.device_put(buffer))
        program.wait()
        return np.asarray(mean)

    return call


def check_means(comm: Communicator, options: Options) -> Options:
    """Compares `mean` and `all_gather` with numpy on buffers that every rank can compute."""
    digest = hashlib.sha256()
    take_mean = mean_of(comm, options["num_floats"])
    for call in range(options["num_calls"]):
        buffers = [
            np.random.default_rng([call, rank])
            .normal(scale=10.0**call, size=options["num_floats"])
            .astype(np.float32)
            for rank in range(comm.world_size)
        ]
        buffers[0][0] = np.nan
        buffers[-1][-1] = np.inf
        mean = take_mean(buffers[comm.rank])
        digest.update(mean.tobytes())
        expected = np.asarray(np.mean(buffers, axis=0, dtype=np.float64))
        np.testing.assert_allclose(mean, expected, rtol=1e-5, atol=1e-6 * 10.0**call)
        heads = [buffer[:5] for buffer in buffers]
        np.testing.assert_array_equal(comm.all_gather(heads[comm.rank]), heads)
    return {"digest": digest.hexdigest()}


@functools.cache
def several_means(comm: Communicator, size: int) -> TracedStep:
    """A program with means of [size] in a loop, and values of all ranks, compiled once."""
    import jax
    import jax.numpy as jnp

    def step(
        collectives: Collectives, _: Any, shared: Array, own: Array
    ) -> tuple[Array, Array, Array]:
        ranks = collectives.all_gather(collectives.rank()[None].astype(jnp.float32))[:, 0]

        def add_mean_rank(_: int, total: Array) -> Array:
            return collectives.mean(total + collectives.rank(), after=ranks)

        return jax.lax.fori_loop(0, 5, add_mean_rank, shared), own + 1.0, ranks

    program = comm.program(step)
    program.trace((), zeros(size), zeros(3))
    program.compile()
    return program


def check_steps(comm: Communicator, options: Options) -> Options:
    """Means and values of all ranks from within a program, between calls from outside it."""
    size, middle = options["num_floats"], (comm.world_size - 1) / 2
    program = several_means(comm, size)
    shared, own = zeros(size), zeros(3)
    for call in range(1, 21):
        shared, own, ranks = program(shared, own)
        if call % 4 == 0:
            program.wait()
            np.testing.assert_allclose(shared, np.full(size, 5 * call * middle), rtol=1e-4)
            np.testing.assert_array_equal(ranks, np.arange(comm.world_size))
            values = np.full(3, comm.rank + call, np.float32)
            np.testing.assert_array_equal(comm.all_gather(values)[:, 1] - call, ranks)
    program.wait()
    return {"steps_digest": hashlib.sha256(np.asarray(shared).tobytes()).hexdigest()}


def step_in_different_orders(comm: Communicator, options: Options) -> Options:
    """The last rank comes to the two exchanges of a step in the opposite order."""
    import jax
    import jax.numpy as jnp

    def step(
        collectives: Collectives, _: Any, shared: Array, own: Array
    ) -> tuple[Array, Array, Array]:
        if comm.rank < comm.world_size - 1:
            mean = collectives.mean(own)
            gathered = collectives.all_gather(own + 0 * mean[0])
        else:
            gathered = collectives.all_gather(own)
            mean = collectives.mean(own + 0 * gathered[0, 0])
        return shared + mean, own + gathered[0], mean[0]

    program = comm.program(step)
    shared, own = (jnp.full(options["num_floats"], 1.0 + comm.rank) for _ in range(2))
    program.trace((), shared, own)
    program.compile()
    try:
        for _ in range(3):
            shared, own, _ = program(shared, own)
        program.wait()
    except jax.errors.JaxRuntimeError as error:  # As a GMI ends, with the error's words.
        raise CollectiveError(str(error).splitlines()[0]) from None
    return {"mean": float(shared[0])}


def check_order(comm: Communicator, options: Options) -> Options:
    """Makes many calls of both kinds with random pauses; every value holds its step."""
    kinds = np.random.default_rng(0).random(options["num_ordered_calls"])
    pauses = np.random.default_rng([1, comm.rank])
    ranks, take_mean = np.arange(comm.world_size), mean_of(comm, options["num_floats"])
    for step, kind in enumerate(kinds):
        if pauses.random() < 0.1:
            time.sleep(pauses.random() * 2e-3)
        if kind < 0.5:
            buffer = np.full(options["num_floats"], 8 * step + comm.rank, np.float32)
            mean = take_mean(buffer)
            if pauses.random() < 0.1:
                time.sleep(pauses.random() * 2e-3)
            # Of another step it would be wrong by 8 or more; by rounding it is wrong by 1e-4.
            assert np.abs(mean - (8 * step + ranks.mean())).max() < 0.1, step
        else:
            values = np.full(1 + step % 7, 8 * step + comm.rank, np.float32)
            gathered = comm.all_gather(values)
            assert (gathered == (8 * step + ranks)[:, None]).all(), step
    return {}


def call_forever(comm: Communicator, options: Options) -> Options:
    """Calls `mean` until something happens; marks `running` after the first calls."""
    buffer = np.ones(options["num_floats"], np.float32)
    take_mean = mean_of(comm, buffer.size)
    for step in range(10**9):
        take_mean(buffer)
        if step == 3:
            leave_mark("running", options)
    return {}


def step_forever(comm: Communicator, options: Options) -> Options:
    """Runs a program of all ranks until something happens, as training does; with pauses."""
    import jax
    import jax.numpy as jnp

    def step(
        collectives: Collectives, _: Any, shared: Array, own: Array
    ) -> tuple[Array, Array, Array]:
        # A millisecond or two of work, so that ends come while a device is at it.
        own = jax.lax.fori_loop(0, 300, lambda _, x: jnp.cos(x @ x), own)
        return shared + collectives.mean(own[0]), own, jnp.sum(shared)

    program = comm.program(step)
    shared, own = zeros(64), jax.device_put(np.eye(64, dtype=np.float32))
    program.trace((), shared, own)
    program.compile()
    pauses = np.random.default_rng(comm.rank)
    for call in range(10**9):
        shared, own, _ = program(shared, own)
        time.sleep(pauses.random() * 5e-3)
        comm.all_gather(np.zeros(1, np.float32))
        if call % 7 == 6:
            program.wait()
        if call == 10:
            leave_mark("running", options)
    return {}


def check_all(comm: Communicator, options: Options) -> Options:
    """Everything that can be checked while all ranks live; then calls until something happens."""
    # Before the first exchange, whose time limit alone is meant for what ranks compile.
    mean_of(comm, options["num_floats"])
    several_means(comm, options["num_floats"])
    found = check_means(comm, options) | check_order(comm, options)
    found |= check_steps(comm, options)
    if options["goes_on"]:
        path = Path(options["folder"]) / f"checked_{options['rank']}"
        path.with_suffix(".part").write_text(json.dumps(found))
        path.with_suffix(".part").rename(path)
        call_forever(comm, options)
    return found


def call_once(comm: Communicator, options: Options) -> Options:
    """One `mean` of ones times rank + 1, after a pause."""
    leave_mark("attached", options)
    time.sleep(options.get("pause_s", 0.0))
    take_mean = mean_of(comm, options["num_floats"])
    mean = take_mean(np.full(options["num_floats"], comm.rank + 1, np.float32))
    return {"mean": float(mean[0])}


def leave_mark(mark: str, options: Options) -> None:
    """Leaves a file that `Ranks.wait_for` sees."""
    (Path(options["folder"]) / f"{mark}_{options['rank']}").touch()
