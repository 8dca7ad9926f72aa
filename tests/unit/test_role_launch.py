"""Bad input of `gmijax.launch`, `gmijax.plan` and `GMIManager`: one line, no process started."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import gmijax
from gmijax.errors import ConfigError
from tests.role_cases import Stuck, Talk


def two() -> Any:
    return gmijax.plan(gmis_per_gpu=2, backend="cpu")


def role_with(**attributes: object) -> Stuck:
    role = Stuck()
    vars(role).update(attributes)
    return role


@pytest.mark.parametrize(
    ("role", "options", "message"),
    [
        (Stuck, {}, r"^role=Stuck: a class; give an object, Stuck\(\.\.\.\)$"),
        (print, {}, r"^role=.*: expected a gmijax.Role, got builtin_function_or_method$"),
        ([Stuck()], {}, r"^role: 1 roles for the 2 GMIs of \[\[0,1\]\]$"),
        ([Stuck(), 3], {}, "^role=3: expected a gmijax.Role, got int$"),
        (role_with(of=threading.Lock()), {}, r"^role=Stuck: cannot be sent .*lock.* in run$"),
        (Stuck(), {"timeout_s": 0}, "^timeout_s=0: must be greater than 0$"),
        (Stuck(), {"timeout_s": "60"}, "^timeout_s='60': expected a number$"),
        (Stuck(), {"grace_s": None}, "^grace_s=None: expected a number$"),
        (Stuck(), {"pipe_mib": "2"}, "^pipe_mib='2': expected a number$"),
        (Stuck(), {"stall_timeout_s": -1.0}, "^stall_timeout_s=-1.0: must be greater than 0$"),
        (Stuck(), {"grace_s": float("inf")}, "^grace_s=inf: must be finite$"),
        (Stuck(), {"pipe_mib": 0.1}, "^pipe_mib=0.1: must be between 0.25 and 16384$"),
        (Stuck(), {"pipe_mib": float("inf")}, "^pipe_mib=inf: must be between"),
        (Stuck(), {"run_dir": "."}, r"^run.dir=\.: the run folder exists already$"),
    ],
)
def test_bad_input_of_launch(
    role: Any, options: dict[str, Any], message: str, tmp_path: Path, monkeypatch: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=message):
        gmijax.launch(two(), role, **options)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"gpus": 0}, "plan.gpus=0"),
        ({"gmis_per_gpu": 0}, "plan.gmis_per_gpu=0"),
        ({"layout": [[0], [2]]}, "GMI ids must be 0 to 1"),
        ({"gpus": "two"}, "plan.gpus=two: expected an integer or a list of integers"),
        ({"gmis_per_gpu": 1.5}, "plan.gmis_per_gpu=1.5: expected an integer"),
        ({"backend": "tpu"}, "plan.backend=tpu: expected one of auto, mps"),
        ({"backend": "cpu", "sm_percent": 50.0}, "plan.sm_percent=50"),
    ],
)
def test_bad_input_of_plan(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        gmijax.plan(**options)


def test_a_plan_of_roles_names_no_template() -> None:
    plan = two()
    assert (plan.backend, plan.strategy, plan.roles) == ("cpu", "mpr", ())
    assert not [reason for reason in plan.reasons if "template" in reason]
    assert gmijax.plan(backend="cpu").strategy == "none"


def test_the_manager_says_what_is_missing() -> None:
    manager = gmijax.GMIManager(num_gpus=2, backend="cpu")
    assert manager.add_gmi(0) is manager
    with pytest.raises(ConfigError, match="gmi=0: registered already"):
        manager.add_gmi(0)
    with pytest.raises(ConfigError, match=r"gmi=3: not registered; registered are \[0\]"):
        manager.set_gpu(3, 0)
    with pytest.raises(ConfigError, match="gpu=2: there are GPUs 0 to 1"):
        manager.set_gpu(0, 2)
    with pytest.raises(ConfigError, match="gmi=0: bound to no GPU"):
        manager.plan()
    manager.set_gpu(0, 1)
    with pytest.raises(ConfigError, match="every GPU needs at least one GMI"):
        manager.plan()
    manager.add_gmi(1).set_gpu(1, 0)
    assert manager.plan().layout.gmis_of_gpu == ((1,), (0,))
    assert manager.get_group(1, "all") == {1}
    assert manager.get_group(0, "all") == {0, 1}
    with pytest.raises(ConfigError, match=r"^allreduce: only inside a GMI"):
        manager.allreduce(np.ones(1))


@pytest.mark.parametrize("step", [-1, 1.5, "one", 2**63, None])
def test_progress_is_a_whole_number(step: Any) -> None:
    with pytest.raises(ConfigError, match=r"^step=.*: expected a whole number of at least 0$"):
        Talk(1).progress(step)
    with pytest.raises(ConfigError, match=r"^progress: only inside a GMI"):
        Talk(1).progress(np.int64(1))


def test_roles_communicate_only_in_a_gmi() -> None:
    with pytest.raises(ConfigError, match=r"^send: only inside a GMI"):
        Talk(1).send(1, 0)
    with pytest.raises(ConfigError, match=r"^rank: only inside a GMI"):
        _ = Talk(1).rank
    with pytest.raises(ConfigError, match=r"^plan=None: expected a plan of gmijax.plan"):
        gmijax.launch(None, Stuck())
