"""What TensorBoard's HParams tab shows of a job: its overrides and its objective."""

from __future__ import annotations

import time

from gmijax.runs.folder import RunPaths
from gmijax.sweeps.jobs import Job

_SUFFIX = ".hparams"


def write_hparams(job: Job, run: RunPaths, objective: str) -> None:
    """Adds to the TensorBoard folder of a job that has ended, if it has a value.

    The objective is the scalar `hparam/<objective>`: the curves have tags of their own. One that
    cannot be compared (`ObjectiveValue`) has a tag of its own too.

    Raises:
      OSError: it cannot be written.
    """
    value, steps = job.progress.value, job.progress.env_steps
    if value is None or not job.overrides:
        return
    # Imported here: it costs a tenth of a second that no other use of this module should pay.
    from gmijax.runs.tensorboard import Event, EventsWriter, hparams, scalar

    tag = f"hparam/{objective}{'' if job.progress.is_full else '_window_not_full'}"
    chosen = {key: _value(text) for key, text in job.overrides.items()}
    run.tensorboard.mkdir(exist_ok=True)
    writer = EventsWriter(str(run.tensorboard / "events"), _SUFFIX)
    for summary in (*hparams(chosen, {tag: value}), scalar(tag, value)):
        writer.write_event(Event(wall_time=time.time(), step=steps, summary=summary))
    writer.close()


def _value(text: str) -> float | bool | str:
    """A value as it stands in an override; TensorBoard sorts and filters numbers as such."""
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    try:
        return float(text)
    except ValueError:
        return text
