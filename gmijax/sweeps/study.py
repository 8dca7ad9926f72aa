"""Where the jobs of a sweep come from: a list, or an Optuna study that looks at their results."""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Generic

from gmijax.config.sweep import JobsConfig
from gmijax.errors import ConfigError
from gmijax.sweeps.any_job import J
from gmijax.sweeps.space import Interval, Space, as_text

MakeJob = Callable[[int, Mapping[str, str]], J]
_REPORTS = 100
"""Values that a pruner gets of a whole job."""

_FULL = "window_full"
"""Attribute of a trial: whether its value can be compared."""

_NOT_ALLOWED = "not_allowed"
"""Attribute of a trial: why there is no job with its values."""

_MOST_RANDOM = 10
"""Trials before TPE begins, with many of them: Optuna's default. With few, a quarter of them."""


class Study(Generic[J]):
    """Proposes jobs and gets their results (ask and tell); this one has none beside the list."""

    def next(self) -> J | None:
        """Another job; None: there is none, now or any more."""
        return None

    def is_hopeless(self, job: J) -> bool:
        """Whether a job that runs should give its slot to another one."""
        del job
        return False

    def tell(self, job: J) -> None:
        """A job has ended."""


class OptunaStudy(Study[J]):
    """Jobs as the trials of an Optuna study, which a file keeps.

    Trials of jobs that failed or were interrupted wait in the study, and so do those that a killed
    sweep left running: they are handed out again first, with their numbers.

    Args:
      settings: sampler, pruner and number of trials.
      space: what trials choose from.
      make_job: a job with such values.
      journal: the file.
      say: gets a line for every trial whose values are not allowed together.
    """

    def __init__(
        self,
        settings: JobsConfig,
        space: Space,
        make_job: MakeJob[J],
        journal: Path,
        say: Callable[[str], object],
    ) -> None:
        self._settings, self._space, self._make_job = settings, space, make_job
        self._say = say
        self._optuna = optuna = optuna_package()
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        _cut_half_a_line(journal)
        backend = optuna.storages.journal.JournalFileBackend(str(journal))
        self._storage = optuna.storages.JournalStorage(backend)
        self._study = study = optuna.create_study(
            study_name="sweep",
            storage=self._storage,
            load_if_exists=True,
            direction=settings.direction,
            pruner=_pruner(optuna, settings),
        )
        # A command that continues samples others than the first one did.
        study.sampler = _sampler(optuna, settings, settings.seed + len(study.trials))
        self._distributions = {key: _distribution(optuna, v) for key, v in space.items()}
        self._left = [trial for trial in study.trials if not trial.state.is_finished()]
        for trial in self._left:
            self._wait(trial)
        # A full disk may have kept some of its parameters from being written.
        self._left = [trial for trial in self._left if trial.params.keys() >= space.keys()]
        self._trials: dict[int, Any] = {}
        self._reported = {t.number: max(t.intermediate_values, default=0) for t in self._left}

    def earlier(self) -> list[J]:
        """The jobs of trials that have ended, the pruned ones marked as such."""
        jobs = []
        for trial in self._study.trials:
            if trial.state.is_finished() and trial.params.keys() >= self._space.keys():
                if _NOT_ALLOWED in trial.user_attrs:
                    continue
                jobs.append(self._make_job(trial.number, self._chosen(trial.params)))
                if trial.state == self._states.PRUNED:
                    jobs[-1].progress.state = "pruned"
        return jobs

    def next(self) -> J | None:
        """See `Study`. A trial whose values are not allowed together counts as one."""
        while (trial := self._next_trial()) is not None:
            try:
                job = self._make_job(trial.number, self._chosen(trial.params))
            except ConfigError as error:
                self._say(f"trial {trial.number} is left out: {error}")
                trial.set_user_attr(_NOT_ALLOWED, str(error))
                self._study.tell(trial, state=self._states.FAIL)
                continue
            self._trials[trial.number] = trial
            return job
        return None

    def _next_trial(self) -> Any:
        """One that waits, else another one; None: there are as many as wanted."""
        if self._left:
            found = self._left.pop(0)
            self._storage.set_trial_state_values(found._trial_id, self._states.RUNNING)
            return self._optuna.trial.Trial(self._study, found._trial_id)
        if self._settings.trials is None or self._num_begun() >= self._settings.trials:
            return None
        return self._study.ask(self._distributions)

    def is_hopeless(self, job: J) -> bool:
        """See `Study`."""
        trial, progress = self._trials.get(job.number), job.progress
        if trial is None:
            return False  # It has ended before, and continues for more steps.
        if not job.num_timesteps:
            return False  # Its progress is unknown.
        report = _REPORTS * progress.env_steps // job.num_timesteps
        if progress.value is None or report <= self._reported.get(job.number, 0):
            return False
        if not progress.is_full:
            return False  # It cannot be compared yet.
        self._reported[job.number] = report
        trial.report(progress.value, report)
        return trial.should_prune()

    def tell(self, job: J) -> None:
        """See `Study`."""
        progress, trial = job.progress, self._trials.get(job.number)
        value, state = progress.value, None
        if progress.state == "pruned":
            value, state = None, self._states.PRUNED
        elif progress.state != "completed":
            if trial is not None:
                self._wait(trial)  # The same sweep, run again, continues with it.
            return
        elif value is None or not self._is_comparable(job):
            value, state = None, self._states.FAIL
        self._study.tell(job.number, value, state=state, skip_if_finished=True)

    def _is_comparable(self, job: J) -> bool:
        """Whether the value of a job may stand beside those of the study.

        That of a window that is not full may as long as no other one is full.
        """
        if trial := self._trials.get(job.number):
            trial.set_user_attr(_FULL, job.progress.is_full)
        return job.progress.is_full or not any(
            trial.user_attrs.get(_FULL) for trial in self._study.trials
        )

    def _wait(self, trial: Any) -> None:
        if trial.params.keys() >= self._space.keys():
            self._storage.set_trial_state_values(trial._trial_id, self._states.WAITING)
        else:
            self._study.tell(trial.number, state=self._states.FAIL)

    def _num_begun(self) -> int:
        """Trials with parameters."""
        return sum(trial.params.keys() >= self._space.keys() for trial in self._study.trials)

    @property
    def _states(self) -> Any:
        return self._optuna.trial.TrialState

    def _chosen(self, params: Mapping[str, Any]) -> dict[str, str]:
        chosen: dict[str, str] = {}
        for key, values in self._space.items():
            found = params[key]
            chosen[key] = as_text(found, values) if isinstance(values, Interval) else found
        return chosen


def optuna_package() -> Any:
    """The package.

    Raises:
      ConfigError: it is not installed.
    """
    try:
        # By name, because it is not installed everywhere.
        return importlib.import_module("optuna")
    except ImportError:
        raise ConfigError(
            "samplers and pruners need the package optuna (pip install 'gmijax[sweep]')"
        ) from None


def _cut_half_a_line(journal: Path) -> None:
    """Removes what a full disk has left of a line: Optuna reads no further than that."""
    if journal.exists():
        whole = journal.read_bytes()
        if (length := whole.rfind(b"\n") + 1) < len(whole):
            os.truncate(journal, length)


def _distribution(optuna: Any, values: Any) -> Any:
    kinds = optuna.distributions
    if not isinstance(values, Interval):
        return kinds.CategoricalDistribution(values.values)
    kind = kinds.IntDistribution if values.is_integer else kinds.FloatDistribution
    return kind(values.low, values.high, log=values.is_log)


def _sampler(optuna: Any, settings: JobsConfig, seed: int) -> Any:
    samplers = optuna.samplers
    if settings.sampler == "tpe":
        random = min(_MOST_RANDOM, max(1, (settings.trials or 0) // 4))
        # Trials that still run count as bad ones, or several at once would be nearly the same.
        return samplers.TPESampler(seed=seed, n_startup_trials=random, constant_liar=True)
    return samplers.RandomSampler(seed=seed)


def _pruner(optuna: Any, settings: JobsConfig) -> Any:
    pruners = optuna.pruners
    if settings.pruner == "asha":
        return pruners.SuccessiveHalvingPruner()
    return pruners.MedianPruner() if settings.pruner == "median" else pruners.NopPruner()
