"""Heat on a torus whose rows are split over GMIs: `python examples/stencil.py gmis=4 backend=mps`.

GMIs swap the rows at their borders. Prints microseconds per step, the same with one GMI, and the
largest difference between the two results, as one line of JSON.
"""

import json
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

import gmijax


class Heat(gmijax.Role):
    """A strip of rows; every `halo` steps those near its borders come from the neighbours."""

    def __init__(self, size, steps, halo):
        self.size, self.steps, self.halo = size, steps, halo

    def run(self):
        """Returns the strip after all steps, and microseconds per step."""
        halo, rows = self.halo, self.size // self.world_size
        up, down = (self.rank - 1) % self.world_size, (self.rank + 1) % self.world_size

        @jax.jit
        def advance(strip, above, below):
            def step(_, t):  # Wrong beyond one more row of the borders each time.
                around = sum(jnp.roll(t, by, axis) for by in (1, -1) for axis in (0, 1))
                return t + 0.2 * (around - 4 * t)

            strip = jnp.concatenate([above, strip, below])
            strip = jax.lax.fori_loop(0, halo, step, strip)[halo:-halo]
            return strip, strip[:halo], strip[-halo:]

        y = np.arange(rows)[:, None] + self.rank * rows
        strip = np.sin(1e-3 * y * np.arange(self.size)).astype(np.float32)
        top, bottom = strip[:halo], strip[-halo:]
        jax.block_until_ready(advance(strip, top, bottom))  # Compiles.
        began = self.collective(0.0) + time.perf_counter()  # All begin together.
        for _ in range(self.steps // halo):
            self.send(bottom, down)  # With one or two GMIs up is down, so the order matters.
            self.send(top, up)
            strip, top, bottom = advance(strip, self.recv(up), self.recv(down))
        return np.asarray(strip), (time.perf_counter() - began) / self.steps * 1e6


if __name__ == "__main__":
    a = {"gpus": 1, "gmis": 2, "size": 512, "steps": 400, "halo": 4, "backend": "auto"}
    a |= dict(option.split("=") for option in sys.argv[1:])
    plan = gmijax.plan(int(a["gpus"]), int(a["gmis"]), backend=a["backend"])
    heat = Heat(int(a["size"]), int(a["steps"]), int(a["halo"]))
    strips, times = zip(*gmijax.launch(plan, heat), strict=True)
    [(whole, one)] = gmijax.launch(gmijax.plan(backend=a["backend"]), heat)
    found = {"backend": plan.backend, "us_per_step": max(times), "one_us_per_step": one}
    print(json.dumps(a | found | {"difference": float(abs(np.concatenate(strips) - whole).max())}))
