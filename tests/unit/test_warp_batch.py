"""Environments of MuJoCo Warp on a GPU, which is faked: what goes in and out, and the graph."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from fake_warp import FakeArray, FakeWarp

from gmijax.sim.impl import WarpSizes
from gmijax.sim.warp import batch
from gmijax.sim.warp.batch import OVERFLOW, STATE, BufferLayout, WarpBatch, lay_out

COUNT, SUBSTEPS = 3, 2


def layout_with(mass_rows: int) -> BufferLayout:
    each = (COUNT, 2)
    state = tuple((name, each) for name in STATE)
    given = (("ctrl", each), ("body_mass", (mass_rows, 2)))
    return lay_out(given, state, ((OVERFLOW, (COUNT,)), ("sensordata", each)))


@pytest.mark.parametrize("mass_rows", [1, COUNT])
def test_a_step_on_a_gpu_is_a_graph_from_what_is_given_to_what_is_taken(
    mass_rows: int, monkeypatch: pytest.MonkeyPatch
):
    fake = FakeWarp()
    peaks: list[object] = []
    monkeypatch.setattr(batch, "mjx_warp", fake)
    monkeypatch.setattr(batch, "PEAKS_BESIDE_JAX", peaks)
    batch.count_memory.cache_clear()
    layout = layout_with(mass_rows)
    model = SimpleNamespace(opt=SimpleNamespace(iterations=4))
    made = WarpBatch(model, SUBSTEPS, WarpSizes(5, 9), layout)
    own = {"body_mass": COUNT} if mass_rows == COUNT else {}
    assert fake.made == [{"batch_sizes": own, "nworld": COUNT, "naconmax": 15, "njmax": 9}]
    assert not made.model.opt.graph_conditional

    given, taken = np.zeros(layout.num_given, np.float32), np.empty(0)
    rng = np.random.default_rng(0)
    arrays = {name: rng.uniform(size=piece.shape) for name, piece in layout.given.items()}
    for name, piece in layout.given.items():
        given[piece.start : piece.start + piece.size] = arrays[name].ravel()
    for _ in range(3):
        taken = np.full(layout.size - layout.first_taken, np.nan, np.float32)
        made.step(FakeArray(given), FakeArray(taken))
        out = {
            name: taken[piece.start - layout.first_taken :][: piece.size].reshape(piece.shape)
            for name, piece in layout.taken.items()
        }
        moved = arrays["qpos"] + SUBSTEPS * arrays["ctrl"] * arrays["body_mass"]
        np.testing.assert_allclose(out["qpos"], moved, rtol=1e-5)
        np.testing.assert_allclose(out["qvel"], arrays["qvel"], rtol=1e-6)
        np.testing.assert_array_equal(out["sensordata"], fake.steps)
        np.testing.assert_array_equal(out[OVERFLOW], 0.0)
    # One step to load the kernels, then three launches of a graph of all substeps.
    assert (fake.launches, fake.steps) == (3, 4 * SUBSTEPS)
    assert len(peaks) == 1


@pytest.mark.parametrize(("iterations", "asks"), [(8, False), (9, True)])
def test_a_solver_with_many_iterations_asks_whether_it_is_done(
    iterations: int, asks: bool, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(batch, "mjx_warp", FakeWarp())
    monkeypatch.setattr(batch, "PEAKS_BESIDE_JAX", [])
    model = SimpleNamespace(opt=SimpleNamespace(iterations=iterations))
    made = WarpBatch(model, SUBSTEPS, WarpSizes(1, 1), layout_with(1))
    assert made.model.opt.graph_conditional is asks
