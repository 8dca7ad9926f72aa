"""The trace of some iterations by `jax.profiler`, as `run.profile` asks for it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import jax


class IterationTrace:
    """Traces this process, its device included, from one iteration to another one.

    Args:
      wanted: the first and the last iteration, counted from 1; None: nothing is traced.
      folder: where the trace is written, in the layout of TensorBoard's profile plugin.
    """

    def __init__(self, wanted: tuple[int, int] | None, folder: Path) -> None:
        self._wanted, self._folder = wanted, folder
        self._traced: tuple[int, int] | None = None
        self._is_open = False
        self._error: str | None = None
        self._step = ExitStack()

    def begin(self, iteration: int, wait: Callable[[], None]) -> None:
        """Before an iteration; `wait` returns when the device has nothing left to do."""
        if self._wanted is None:
            return
        if iteration == self._wanted[0]:
            wait()  # Or the trace would begin with what is left of the iteration before.
            self._try(self._open)
        if self._is_open:
            self._traced = self._wanted[0], iteration
            # By this name and number the viewers find the steps.
            self._step.enter_context(
                jax.profiler.StepTraceAnnotation("iteration", step_num=iteration)
            )

    def end(self, iteration: int, wait: Callable[[], None]) -> None:
        """After an iteration has been started; arguments as of `begin`."""
        if self._wanted is not None and iteration == self._wanted[1]:
            self.close(wait)
        self._step.close()

    def close(self, wait: Callable[[], None]) -> None:
        """Writes what was traced so far, if a trace is open; `wait` as of `begin`. Idempotent."""
        if self._is_open:
            wait()  # The device may still compute the last iteration.
            self._step.close()
            self._is_open = False
            self._try(jax.profiler.stop_trace)

    def outcome(self) -> dict[str, Any]:
        """For `result.json`: `profile` with first and last iteration, folder and error.

        Empty where nothing was asked for. The iterations are None where the run never came there.
        """
        if self._wanted is None:
            return {}
        found = {"iterations": self._traced, "dir": str(self._folder), "error": self._error}
        return {"profile": found}

    def _open(self) -> None:
        self._folder.mkdir(
            exist_ok=True
        )  # Before the start: JAX ends no trace that it cannot write.
        options = jax.profiler.ProfileOptions()
        # Calls of Python are many, slow the iteration down, and say little about it.
        options.python_tracer_level = 0
        jax.profiler.start_trace(
            self._folder, create_perfetto_trace=True, profiler_options=options
        )
        self._is_open = True

    def _try(self, act: Callable[[], None]) -> None:
        """A trace that cannot be made, as on a full disk, does not end the training."""
        try:
            act()
        except Exception as error:
            self._error = str(error) or type(error).__name__
