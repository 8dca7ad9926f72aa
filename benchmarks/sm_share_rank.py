"""Main of one GMI of `benchmarks.sm_shares`: is arithmetic right on this share, and how fast?"""

from __future__ import annotations

import fcntl
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from gmijax.errors import GmijaxError
from gmijax.runs.folder import read_json
from gmijax.supervise.child import ChildLink, run_gmi

LIBRARIES = ("cublaslt", "cublas", "xla")
"""Both libraries by their first choice, and XLA's own choice, which it finds by trying."""

CALLS, REPEATS = 10, 5
WAIT_S = 120.0


def main() -> int:
    """Runs this process's GMI; returns the exit code."""
    return run_gmi(_run)


def _run(link: ChildLink) -> dict[str, Any]:
    config = read_json(link.run.config)
    lock = link.run.root / "quiet.lock"
    # Comparisons of all GMIs run at once, and every measurement alone.
    with _locked(lock, fcntl.LOCK_SH):
        import jax

        link.beat("compiling", 0)
        products = [
            {"library": library, **row}
            for library in config["libraries"]
            for row in _compare(library, config["sizes"][library])
        ]
        speeds = {
            dtype: _compiled(dtype, config["speed_size"]) for dtype in ("bfloat16", "float32")
        }
        device = jax.devices()[0]
    with _locked(lock, fcntl.LOCK_EX):
        rates = {dtype: measure() for dtype, measure in speeds.items()}
    return {
        "device": str(device.device_kind),
        "num_sms": getattr(device, "core_count", None),
        "jax": jax.__version__,
        "products": products,
        "tflops": rates,
    }


def _compare(library: str, sizes: list[list[int]]) -> Iterator[dict[str, Any]]:
    from gmijax import selfcheck

    options = selfcheck.LIBRARIES.get(library, {})
    shapes = [(m, k, n) for m, k, n in sizes]
    for product in selfcheck.compare_products(shapes, compiler_options=options):
        yield {
            "precision": product.precision.name,
            "size": product.size,
            "error": min(product.error, 1e9),  # JSON has no infinity.
            "wrong": product.is_wrong,
        }


def _compiled(dtype: str, size: int) -> Callable[[], float]:
    """A measurement that is ready to go: the rate of square products by cuBLASLt in TFLOP/s."""
    import jax
    import jax.numpy as jnp

    from gmijax import selfcheck

    def chain(x: jax.Array) -> jax.Array:
        for _ in range(CALLS):  # Each needs the one before, so that none can be left out.
            x = jnp.matmul(x, x)
        return x

    run = jax.jit(chain, compiler_options=dict(selfcheck.LIBRARIES["cublaslt"]))
    # So that products are about as large as their factors.
    x = jax.random.normal(jax.random.key(0), (size, size), dtype) / size**0.5
    run(x).block_until_ready()

    def measure() -> float:
        times_s: list[float] = []
        for _ in range(REPEATS):
            started_s = time.perf_counter()
            run(x).block_until_ready()
            times_s.append(time.perf_counter() - started_s)
        return CALLS * 2 * size**3 / statistics.median(times_s) / 1e12

    return measure


@contextmanager
def _locked(path: Path, how: int) -> Iterator[None]:
    """Holds a lock of the file, shared or exclusive; gone with the process at the latest."""
    deadline_s = time.monotonic() + WAIT_S
    with path.open("a") as file:
        while True:
            try:
                fcntl.flock(file, how | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() > deadline_s:
                    raise GmijaxError(f"the others hold {path} for {WAIT_S:g} s") from None
                time.sleep(0.01)
        yield


if __name__ == "__main__":
    sys.exit(main())
