"""The trace of some iterations by `jax.profiler`, as `run.profile` asks for it."""

from __future__ import annotations

import gzip
import json
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from threading import Thread
from typing import Any

import jax

from gmijax.runs.folder import write_bytes


class IterationTrace:
    """Traces this process, its device included, from one iteration to another one.

    All ranks of a job have one and call it in every iteration, those that do not write too: to
    wait for a device can be a step that all ranks do together.

    Args:
      wanted: the first and the last iteration, counted from 1; None: nothing is traced.
      folder: where the trace is written, in the layout of TensorBoard's profile plugin.
      is_written: whether this rank is the one that is traced.
    """

    def __init__(
        self, wanted: tuple[int, int] | None, folder: Path, *, is_written: bool = True
    ) -> None:
        self._wanted, self._folder, self._is_written = wanted, folder, is_written
        self._traced: tuple[int, int] | None = None
        self._is_open = False
        self._error: str | None = None
        self._before: dict[Path, int] = {}  # Of earlier commands.
        self._step = ExitStack()
        self._writing: Thread | None = None

    def begin(self, iteration: int, wait: Callable[[], None]) -> None:
        """Before an iteration; `wait` returns when the device has nothing left to do."""
        if self._wanted is None:
            return
        if iteration == self._wanted[0]:
            wait()  # Or the trace would begin with what is left of the iteration before.
            if self._is_written:
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
            wait()  # The device may still compute it.
            self._step.close()
            self._stop()
        self._step.close()

    def close(self) -> None:
        """Returns when all that was traced is written; the device must have nothing left to do."""
        self._step.close()
        self._stop()
        if self._writing is not None:
            self._writing.join()

    def _stop(self) -> None:
        """Ends the trace if it is open, and writes it.

        In this thread, so that nothing is launched meanwhile: a kernel that is launched while the
        tracer detaches from a GPU can fail, and then the process cannot use the GPU any more.
        """
        if self._is_open:
            self._is_open = False
            self._try(jax.profiler.stop_trace)
            if self._error is not None:
                return
            # It may take a minute, and needs no device.
            self._writing = Thread(target=self._try, args=(self._for_perfetto,), daemon=True)
            self._writing.start()

    def _for_perfetto(self) -> None:
        """Writes the events once more, as Perfetto reads them: without JAX's metadata."""
        new = [path for path, at in self._traces().items() if self._before.get(path) != at]
        if not new:
            raise FileNotFoundError(f"JAX has written no events below {self._folder}")
        trace = json.loads(gzip.decompress(new[0].read_bytes()))
        trace.pop("metadata", None)
        content = gzip.compress(json.dumps(trace).encode())
        write_bytes(new[0].with_name("perfetto_trace.json.gz"), content)

    def _traces(self) -> dict[Path, int]:
        """Files of events, and when they were written."""
        found = self._folder.glob("plugins/profile/*/*.trace.json.gz")
        return {path: path.stat().st_mtime_ns for path in found}

    def outcome(self) -> dict[str, Any] | None:
        """First and last iteration, folder and error; None where nothing was to be written.

        The iterations are None where the run never came there.
        """
        if self._wanted is None or not self._is_written:
            return None
        return {"iterations": self._traced, "dir": str(self._folder), "error": self._error}

    def _open(self) -> None:
        # First: JAX does not end a trace that it cannot write.
        self._folder.mkdir(exist_ok=True)
        self._before = self._traces()
        options = jax.profiler.ProfileOptions()
        # Calls of Python are many, slow the iteration down, and show little about it.
        options.python_tracer_level = 0
        jax.profiler.start_trace(self._folder, profiler_options=options)
        self._is_open = True

    def _try(self, act: Callable[[], None]) -> None:
        """A trace that cannot be made, as on a full disk, does not end the training."""
        try:
            act()
        except Exception as error:
            self._error = str(error) or type(error).__name__
