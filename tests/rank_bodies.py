"""What the ranks of a test do, each in a process of its own, with the reducer that they share."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from gmijax.collectives.interface import (
    DeviceReducer,
    FloatBuffer,
    Peers,
    Reducer,
    stays_on_device,
)
from gmijax.errors import CollectiveError
from gmijax.types import Array

Options = dict[str, Any]
TINY = {"policy_hidden_layer_sizes": (16,), "value_hidden_layer_sizes": (16,)}


def check_means(reducer: Reducer, options: Options) -> Options:
    """Compares `mean` and `all_gather` with numpy on buffers that every rank can compute."""
    digest, worst = hashlib.sha256(), 0.0
    for call in range(options["num_calls"]):
        buffers = [
            np.random.default_rng([call, rank])
            .normal(scale=10.0**call, size=options["num_floats"])
            .astype(np.float32)
            for rank in range(reducer.world_size)
        ]
        buffers[0][0] = np.nan
        buffers[-1][-1] = np.inf
        mean = reducer.mean(buffers[reducer.rank])
        digest.update(mean.tobytes())
        if stays_on_device(reducer):
            check_device(reducer, buffers[reducer.rank], mean)
        expected = np.asarray(np.mean(buffers, axis=0, dtype=np.float64))
        np.testing.assert_allclose(mean, expected, rtol=1e-5, atol=1e-6 * 10.0**call)
        assert not mean.flags.writeable
        finite = np.isfinite(expected)
        errors = np.abs(mean[finite] - expected[finite])
        worst = max(worst, float(errors.max(initial=0.0)) / 10.0**call)
        heads = [buffer[:5] for buffer in buffers]
        np.testing.assert_array_equal(reducer.all_gather(heads[reducer.rank]), heads)
    return {"digest": digest.hexdigest(), "worst": worst}


def check_device(reducer: DeviceReducer, buffer: FloatBuffer, mean: FloatBuffer) -> None:
    """The mean of a buffer on the device stays there, and is the same."""
    import jax

    on_device = reducer.mean_on_device(jax.device_put(buffer))
    assert on_device.devices() == set(jax.local_devices())
    # One behind the other, without waiting: the mean of equal buffers is the buffer itself.
    twice = reducer.run_on_device(lambda mean: mean(mean(jax.device_put(buffer))))
    np.testing.assert_allclose(twice, mean, rtol=1e-5)
    assert np.asarray(on_device).tobytes() == mean.tobytes()


def check_steps(reducer: Reducer, options: Options) -> Options:
    """Means and values of all ranks from within a program, between calls from outside it."""
    import jax
    import jax.numpy as jnp

    assert stays_on_device(reducer)
    size = options["num_floats"]

    def step(peers: Peers, _: Any, shared: Array, own: Array) -> tuple[Array, Array, Array]:
        def add_mean_rank(_: int, total: Array) -> Array:
            return peers.mean(total + peers.rank())

        ranks = peers.gather(peers.rank()[None].astype(jnp.float32))[:, 0]
        return jax.lax.fori_loop(0, 5, add_mean_rank, shared), own + 1.0, ranks

    middle = (reducer.world_size - 1) / 2
    program = reducer.spmd(step)
    if program is None:
        for call in range(3):
            mean = reducer.mean(np.full(size, reducer.rank + call, np.float32))
            np.testing.assert_allclose(mean, middle + call, rtol=1e-5)
        return {"steps_digest": None}
    shared, own = jnp.zeros(size), jnp.zeros(3)
    program.trace((), shared, own)
    program.compile()
    for call in range(1, 21):
        shared, own, ranks = program(shared, own)
        if call % 4 == 0:
            program.wait()
            np.testing.assert_allclose(shared, np.full(size, 5 * call * middle), rtol=1e-4)
            np.testing.assert_array_equal(ranks, np.arange(reducer.world_size))
            mean = reducer.mean(np.full(size, reducer.rank + call, np.float32))
            np.testing.assert_allclose(mean, middle + call, rtol=1e-5)
    program.wait()
    return {"steps_digest": hashlib.sha256(np.asarray(shared).tobytes()).hexdigest()}


def step_in_different_orders(reducer: Reducer, options: Options) -> Options:
    """The last rank comes to the two exchanges of a step in the opposite order."""
    import jax
    import jax.numpy as jnp

    assert stays_on_device(reducer)

    def step(peers: Peers, _: Any, shared: Array, own: Array) -> tuple[Array, Array, Array]:
        if reducer.rank < reducer.world_size - 1:
            mean = peers.mean(own)
            gathered = peers.gather(own + 0 * mean[0])
        else:
            gathered = peers.gather(own)
            mean = peers.mean(own + 0 * gathered[0, 0])
        return shared + mean, own + gathered[0], mean[0]

    program = reducer.spmd(step)
    assert program is not None
    shared, own = (jnp.full(options["num_floats"], 1.0 + reducer.rank) for _ in range(2))
    program.trace((), shared, own)
    program.compile()
    try:
        for _ in range(3):
            shared, own, _ = program(shared, own)
        program.wait()
    except jax.errors.JaxRuntimeError as error:  # As a GMI ends, with the error's words.
        raise CollectiveError(str(error).splitlines()[0]) from None
    return {"mean": float(shared[0])}


def check_training(reducer: Reducer, options: Options) -> Options:
    """PPO learns the same with the exchanges in its program and with the host between them."""
    import dataclasses

    import jax
    from toy_env import point_mass

    from gmijax.cli.compose import compose
    from gmijax.learning.learner import init_learner, make_learner
    from gmijax.ppo.iteration import SplitIteration, make_iteration
    from gmijax.sim.wrappers import env_keys

    env = point_mass()
    config = dataclasses.replace(
        compose().algo, unroll_length=4, num_minibatches=2, num_updates_per_batch=2, **TINY
    )
    learner = make_learner(env.spec, dataclasses.replace(config, **options["algo"]))
    keys = env_keys(jax.random.key(1), reducer.rank * 8, 8)
    whole = make_iteration(env, learner, reducer)
    assert not isinstance(whole, SplitIteration)
    found = []
    for iteration in (whole, SplitIteration(env, learner, reducer)):
        state = init_learner(learner, env.spec.obs_size, jax.random.key(0))
        envs = jax.jit(env.init)(env.model, keys)
        iteration.trace(env.model, state, envs)
        iteration.compile()
        for _ in range(3):
            state, envs, _ = iteration(state, envs)
        iteration.wait()
        found.append(jax.device_get((state.params, state.obs_moments, envs.env.obs)))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5), *found)
    shared = jax.tree.leaves(found[0][:2])
    return {"digest": hashlib.sha256(b"".join(x.tobytes() for x in shared)).hexdigest()}


def check_order(reducer: Reducer, options: Options) -> Options:
    """Makes many calls of both kinds with random pauses; every value tells its step."""
    kinds = np.random.default_rng(0).random(options["num_ordered_calls"])
    pauses = np.random.default_rng([1, reducer.rank])
    ranks = np.arange(reducer.world_size)
    for step, kind in enumerate(kinds):
        if pauses.random() < 0.1:
            time.sleep(pauses.random() * 2e-3)
        if kind < 0.5:
            buffer = np.full(options["num_floats"], 8 * step + reducer.rank, np.float32)
            mean = reducer.mean(buffer)
            if pauses.random() < 0.1:
                time.sleep(pauses.random() * 2e-3)
            # Of another step it would be wrong by 8 or more; by rounding it is wrong by 1e-4.
            assert np.abs(mean - (8 * step + ranks.mean())).max() < 0.1, step
        else:
            values = np.full(1 + step % 7, 8 * step + reducer.rank, np.float32)
            gathered = reducer.all_gather(values)
            assert (gathered == (8 * step + ranks)[:, None]).all(), step
    return {}


def call_forever(reducer: Reducer, options: Options) -> Options:
    """Calls `mean` until something happens; marks `running` after the first calls."""
    buffer = np.ones(options["num_floats"], np.float32)
    for step in range(10**9):
        reducer.mean(buffer)
        if step == 3:
            leave_mark("running", options)
    return {}


def step_forever(reducer: Reducer, options: Options) -> Options:
    """Runs a program of all ranks until something happens, as training does; with pauses."""
    import jax
    import jax.numpy as jnp

    def step(peers: Peers, _: Any, shared: Array, own: Array) -> tuple[Array, Array, Array]:
        # A millisecond or two of work, so that ends come while a device is at it.
        own = jax.lax.fori_loop(0, 300, lambda _, x: jnp.cos(x @ x), own)
        return shared + peers.mean(own[0]), own, jnp.sum(shared)

    assert stays_on_device(reducer)
    program = reducer.spmd(step)
    assert program is not None
    shared, own = jnp.zeros(64), jnp.eye(64)
    program.trace((), shared, own)
    program.compile()
    pauses = np.random.default_rng(reducer.rank)
    for call in range(10**9):
        shared, own, _ = program(shared, own)
        time.sleep(pauses.random() * 5e-3)
        reducer.all_gather(np.zeros(1, np.float32))
        if call % 7 == 6:
            program.wait()
        if call == 10:
            leave_mark("running", options)
    return {}


def check_all(reducer: Reducer, options: Options) -> Options:
    """Everything that can be checked while all ranks live; then calls until something happens."""
    found = check_means(reducer, options) | check_order(reducer, options)
    if stays_on_device(reducer):
        found |= check_steps(reducer, options)
    if options["goes_on"]:
        path = Path(options["folder"]) / f"checked_{options['rank']}"
        path.with_suffix(".part").write_text(json.dumps(found))
        path.with_suffix(".part").rename(path)
        call_forever(reducer, options)
    return found


def call_once(reducer: Reducer, options: Options) -> Options:
    """One `mean` of ones times rank + 1, after a pause; then waits until told to end."""
    leave_mark("attached", options)
    time.sleep(options.get("pause_s", 0.0))
    mean = reducer.mean(np.full(options["num_floats"], reducer.rank + 1, np.float32))
    first = float(mean[0])
    leave_mark("called", options)
    time.sleep(options.get("stay_s", 0.0))
    return {"mean": first}


def gather_once(reducer: Reducer, options: Options) -> Options:
    """One `all_gather`."""
    reducer.all_gather(np.zeros(options["num_gather"], np.float32))
    return {}


def close_at_once(reducer: Reducer, options: Options) -> Options:
    """Closes, but stays alive for a while."""
    reducer.close()
    time.sleep(options["stay_s"])
    return {}


BODIES: dict[str, Callable[[Reducer, Options], Options]] = {
    body.__name__: body
    for body in (
        *(check_all, check_means, check_order, check_steps, check_training),
        step_in_different_orders,
        *(call_forever, step_forever, call_once, gather_once, close_at_once),
    )
}


def leave_mark(mark: str, options: Options) -> None:
    """Leaves a file that `Ranks.wait_for` sees."""
    (Path(options["folder"]) / f"{mark}_{options['rank']}").touch()
