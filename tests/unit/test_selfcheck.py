"""The check of matrix products finds wrong ones, and lets right ones pass."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from supervision import machine, planned

from gmijax import selfcheck
from gmijax.errors import SelfCheckFailed
from gmijax.selfcheck import PRECISIONS, SIZES, Precision, check_share, compare_products

MEASURED = Path(__file__).parents[2] / "tests/golden/sm_caps_h200.json"
RIGHT = selfcheck.multiply
SMALL = ((64, 128, 32), (32, 64, 96))


def one_tile_missing(left: jax.Array, other: jax.Array, kind: Precision) -> jax.Array:
    """Half-precision products without the last 16 terms of one tile."""
    product = RIGHT(left, other, kind)
    if kind.dtype == "float32":
        return product
    return product.at[:16, :16].add(-RIGHT(left[:16, -16:], other[-16:, :16], kind))


def not_finite(left: jax.Array, other: jax.Array, kind: Precision) -> jax.Array:
    return RIGHT(left, other, kind).at[0, 0].set(jnp.nan)


def in_less_than_float32(left: jax.Array, other: jax.Array, kind: Precision) -> jax.Array:
    """As if float32 were computed in bfloat16."""
    product = RIGHT(left, other, kind)
    return product if kind.dtype != "float32" else jax.lax.reduce_precision(product, 8, 7)


def test_right_products_pass():
    found = list(compare_products(SMALL))
    assert [product for product in found if product.is_wrong] == []
    assert len(found) == len(SMALL) * len(PRECISIONS)
    # Rounding shows: the comparison is not with itself.
    assert max(product.error for product in found) > 2**-12


@pytest.mark.parametrize(
    ("multiply", "wrong"),
    [
        (one_tile_missing, {"bfloat16", "float16"}),
        (not_finite, {"bfloat16", "float16", "tf32", "float32"}),
        (in_less_than_float32, {"tf32", "float32"}),
    ],
)
def test_wrong_products_are_found(
    multiply: Callable[..., jax.Array], wrong: set[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(selfcheck, "multiply", multiply)
    found = list(compare_products(SMALL))
    assert {product.precision.name for product in found if product.is_wrong} == wrong


def test_a_wrong_share_is_named(monkeypatch: pytest.MonkeyPatch):
    plan = planned(machine(0), self_check="on")
    capped = dataclasses.replace(plan.allocations[0], device="GPU-0", sm_percent=33.0)
    plan = dataclasses.replace(plan, allocations=(capped,))
    monkeypatch.setattr(selfcheck, "SIZES", SMALL)
    monkeypatch.setattr(selfcheck, "multiply", one_tile_missing)
    with pytest.raises(
        SelfCheckFailed,
        match=r"wrong on GPU-0 with plan\.sm_percent=33: bfloat16, float16 \(cublaslt, cublas\); ",
    ):
        check_share(plan, 0)


def test_every_cap_that_was_measured_to_be_wrong_would_be_found():
    rows = json.loads(MEASURED.read_text())["rows"]
    wrong = {
        row["sm_percent"]: {tuple(one["size"]) for one in row["products"] if one["wrong"]}
        for row in rows
    }
    assert any(wrong.values())
    assert [cap for cap, sizes in wrong.items() if sizes and not sizes & set(SIZES)] == []


def test_options_that_xla_no_longer_has_are_left_out(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(selfcheck, "SIZES", SMALL)
    monkeypatch.setattr(selfcheck, "LIBRARIES", {"gone": {"xla_gpu_option_that_is_gone": True}})
    for self_check in ("on", "off"):
        plan = planned(machine(0), self_check=self_check)
        assert (check_share(plan, 0) > 0.0) == (self_check == "on")
