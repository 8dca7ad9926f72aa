import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gmijax.learning.normalize import (
    OBS_CLIP,
    change_of_units,
    in_units,
    merge,
    merge_all,
    moments_of,
    moments_of_those,
    no_samples,
    normalize,
    std_of,
    with_std_floor,
    without_outliers,
)


def _samples(seed: int, count: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.normal(rng.normal(), 1.0 + rng.random(), size=(count, 4)).astype(np.float32)


@pytest.mark.parametrize("sizes", [(1,), (2, 50, 1), (1, 1, 2, 50, 50)])
def test_moments_of_parts_merge_to_the_moments_of_all(sizes: tuple[int, ...]) -> None:
    parts = [_samples(k, size) for k, size in enumerate(sizes)]
    moments = [no_samples((4,)), *(moments_of(jnp.asarray(part), 1) for part in parts)]
    merged = merge_all(jax.tree.map(lambda *x: jnp.stack(x), *moments))
    everything = np.concatenate(parts).astype(np.float64)
    np.testing.assert_allclose(merged.count, len(everything))
    np.testing.assert_allclose(merged.mean, everything.mean(0), atol=1e-4)
    np.testing.assert_allclose(
        merged.m2, ((everything - everything.mean(0)) ** 2).sum(0), rtol=1e-3, atol=1e-3
    )


def test_outliers_do_not_widen_the_statistics_but_changes_do() -> None:
    usual = jnp.asarray(_samples(0, 1000))
    moments = moments_of(usual, 1)
    wild = usual.at[3].set(1e6)
    clipped = merge(moments, moments_of(without_outliers(moments, wild), 1))
    np.testing.assert_allclose(std_of(clipped), std_of(moments), rtol=0.3)
    shifted = merge(moments, moments_of(without_outliers(moments, usual + 5.0), 1))
    exact = merge(moments, moments_of(usual + 5.0, 1))
    jax.tree.map(np.testing.assert_array_equal, shifted, exact)
    np.testing.assert_array_equal(without_outliers(no_samples((4,)), wild), wild)


def test_constant_inputs_and_outliers_stay_finite() -> None:
    moments = moments_of(jnp.ones((10, 4)), 1)
    assert np.all(std_of(moments) > 0)
    np.testing.assert_array_equal(normalize(moments, jnp.full(4, 100.0)), OBS_CLIP)


def test_an_input_that_was_constant_at_first_is_not_blinded_by_a_floor() -> None:
    constant = moments_of(jnp.zeros((10_000, 1)), 1)
    # A drawer that opens by 0.39 in one sample of a thousand.
    later = jnp.zeros((10_000, 1)).at[::1000].set(0.39)

    def seen(floor: float, value: float) -> float:
        known = with_std_floor(constant, floor)
        moments = merge(constant, moments_of(without_outliers(known, later), 1))
        return float(normalize(with_std_floor(moments, floor), jnp.array([value]))[0])

    assert seen(1e-4, 0.002) == OBS_CLIP  # Two millimetres read as all.
    assert seen(1e-2, 0.002) == pytest.approx(0.2, abs=0.02)
    assert with_std_floor(no_samples((3,)), 0.1).m2.sum() == 0.0


def test_moments_of_some_samples_are_those_of_them_alone() -> None:
    samples = jnp.asarray(_samples(0, 24)).reshape(6, 4, -1)
    chosen = jnp.asarray(np.random.default_rng(1).random((6, 4)) < 0.6)
    wild = jnp.where(chosen[..., None], samples, jnp.inf)
    jax.tree.map(
        lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-4, atol=1e-5),
        moments_of_those(chosen, wild),
        moments_of(samples[np.asarray(chosen)], 1),
    )
    nobody = moments_of_those(jnp.zeros((6, 4), bool), wild)
    assert all(float(jnp.sum(part)) == 0.0 for part in nobody)


def test_observations_pass_unchanged_without_samples() -> None:
    # Without normalisation, and until there are statistics: their unit is not known.
    obs = jnp.array([1.0, -200.0, 3e4, 0.0])
    np.testing.assert_array_equal(normalize(no_samples((4,)), obs), obs)


def test_a_change_of_units_keeps_what_moves_and_leaves_alone_what_does_not() -> None:
    samples = jax.random.normal(jax.random.key(0), (2, 50, 3)) * jnp.array([1.0, 5.0, 1e-3])
    old = moments_of(samples[0], 1)
    new = merge(old, moments_of(1.0 + 1.5 * samples[1], 1))
    scale, shift = change_of_units(old, new, least_std=0.01)
    x = samples[1]
    kept = scale * in_units(new, x) + shift
    np.testing.assert_allclose(kept[:, :2], in_units(old, x)[:, :2], rtol=1e-4, atol=1e-4)
    assert (float(scale[2]), float(shift[2])) == (1.0, 0.0)
    leapt = old._replace(m2=old.m2 * jnp.array([3.9, 4.1, 1.0]))
    scale, _ = change_of_units(old, leapt, least_std=0.01)
    assert scale.tolist()[1:] == [1.0, 1.0]
    assert float(scale[0]) == pytest.approx(3.9**0.5)
    scale, shift = change_of_units(no_samples((3,)), new, least_std=0.01)
    assert scale.tolist() == [1.0] * 3
    assert shift.tolist() == [0.0] * 3
