"""Whether matrix products are right on the share of this GMI, found out when it starts.

Under some caps on SMs wrong half-precision products were reported, silently (docs/shares.md). So
every kind of product that a program may use is compared with float64 by numpy. Factors are small
integers, which all kinds hold exactly; what may differ is the rounding of the result alone.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Final, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from gmijax.errors import SelfCheckFailed
from gmijax.partition.plan import Plan


class Precision(NamedTuple):
    """One kind of matrix product."""

    name: str  # For messages.
    dtype: str  # Of both factors and of the result.
    algorithm: str  # `jax.lax.Precision` by name.
    tolerance: float  # Largest error that rounding may cause, relative to the largest result.


PRECISIONS: Final = (
    Precision("bfloat16", "bfloat16", "default", 2**-7),
    Precision("float16", "float16", "default", 2**-10),
    # On a GPU the default precision of float32 is TF32.
    Precision("tf32", "float32", "default", 2**-10),
    Precision("float32", "float32", "highest", 2**-20),
)

SIZES: Final = ((1024, 1024, 1024), (8192, 256, 128), (504, 1016, 760), (16384, 64, 256))
"""(M, K, N): at every cap where any measured product was wrong, one of these was."""

Options: TypeAlias = Mapping[str, bool | int]

LIBRARIES: Final[Mapping[str, Options]] = MappingProxyType(
    {
        library: {
            "xla_gpu_enable_cublaslt": library == "cublaslt",
            "xla_gpu_enable_triton_gemm": False,
            "xla_gpu_autotune_level": 0,
        }
        for library in ("cublaslt", "cublas")
    }
)
"""XLA's options for either library's own first choice.

That is where wrong products were reported, and it compiles at once: what XLA tries out by itself
takes it seconds a product. CPUs ignore them.
"""

_LARGEST_FACTOR: Final = 8


class Product(NamedTuple):
    """One product that was compared."""

    precision: Precision  # Which kind.
    size: tuple[int, int, int]  # (M, K, N).
    error: float  # Largest error, relative to the largest result; infinite where it is not finite.

    @property
    def is_wrong(self) -> bool:
        """Whether the error is more than rounding."""
        return not self.error <= self.precision.tolerance


def check_share(plan: Plan, gmi: int) -> float:
    """Checks this GMI's share if the plan requests it; returns the time it took in seconds.

    Raises:
      SelfCheckFailed: a product is wrong; names it, by how much, and the share.
    """
    if not plan.self_check:
        return 0.0
    started_s = time.monotonic()
    wrong = {
        library: [product for product in _compare_with(options) if product.is_wrong]
        for library, options in LIBRARIES.items()
    }
    if found := [product for products in wrong.values() for product in products]:
        allocation = plan.allocations[gmi]
        worst = max(found, key=lambda product: product.error / product.precision.tolerance)
        libraries = [library for library, products in wrong.items() if products]
        cap = (
            "no cap"
            if allocation.sm_percent is None
            else f"plan.sm_percent={allocation.sm_percent:g}"
        )
        raise SelfCheckFailed(
            f"matrix products are wrong on {allocation.device} with {cap}: "
            f"{', '.join(sorted({product.precision.name for product in found}))} "
            f"({', '.join(libraries)}); worst {_described(worst)}; choose another share, see "
            "docs/shares.md"
        )
    return time.monotonic() - started_s


def compare_products(
    sizes: Sequence[tuple[int, int, int]] | None = None, compiler_options: Options | None = None
) -> Iterator[Product]:
    """Multiplies on the default device, and compares with float64."""

    def all_kinds(factors: list[tuple[jax.Array, jax.Array]]) -> list[jax.Array]:
        # One program for all kinds: they compile at the same time.
        pairs = zip(factors, PRECISIONS, strict=True)
        return [multiply(left, right, kind) for (left, right), kind in pairs]

    compiled = jax.jit(all_kinds, compiler_options=dict(compiler_options or {}))
    draw = np.random.default_rng(0)
    for m, k, n in sizes or SIZES:
        left, right = _factor(draw, m, k), _factor(draw, k, n)
        expected = left.astype(np.float64) @ right.astype(np.float64)
        # Rounded outside of the program, which could else compute in another type than asked.
        factors = [
            (jnp.asarray(left, kind.dtype), jnp.asarray(right, kind.dtype)) for kind in PRECISIONS
        ]
        for kind, found in zip(PRECISIONS, compiled(factors), strict=True):
            yield Product(kind, (m, k, n), _error(np.asarray(found, np.float32), expected))


def _compare_with(options: Options) -> list[Product]:
    try:
        return list(compare_products(compiler_options=options))
    except jax.errors.JaxRuntimeError as error:
        if "No such compile option" not in str(error):
            raise
        return list(compare_products())  # XLA's options come and go.


def multiply(left: jax.Array, right: jax.Array, kind: Precision) -> jax.Array:
    """[M, K] x [K, N] in one kind of arithmetic."""
    return jnp.matmul(left, right, precision=kind.algorithm)


def _factor(draw: np.random.Generator, rows: int, columns: int) -> np.ndarray:
    return draw.integers(-_LARGEST_FACTOR, _LARGEST_FACTOR, (rows, columns), endpoint=True).astype(
        np.float32
    )


def _error(found: np.ndarray, expected: np.ndarray) -> float:
    if not np.isfinite(found).all():
        return float("inf")
    return float(np.abs(found - expected).max() / np.abs(expected).max())


def _described(product: Product) -> str:
    m, k, n = product.size
    return (
        f"{product.precision.name} [{m}, {k}] x [{k}, {n}] with relative error "
        f"{product.error:.2g}, the limit is {product.precision.tolerance:.2g}"
    )
