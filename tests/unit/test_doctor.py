"""What the doctor says of faked machines, and how it takes its arguments."""

from __future__ import annotations

import dataclasses
import json
import subprocess
from pathlib import Path

import fake_nvml
import pynvml
import pytest
from fake_nvml import A100_SEVEN, H200_MIG_EMPTY, H200_MIG_OFF, Board
from rich.console import Console

from gmijax import doctor
from gmijax.control import system_info
from gmijax.control.diagnosis import Diagnosis, diagnose
from gmijax.control.system_info import REQUIRED, JaxView, SystemInfo, ask_jax, try_mps
from gmijax.machine import nvidia
from gmijax.machine.nvidia import list_gpus, nvml_problem
from gmijax.machine.snapshot import Machine

MPS = Path("/usr/bin/nvidia-cuda-mps-control")
INSTALLED = dict.fromkeys(REQUIRED, "1.0") | dict.fromkeys(
    (*("jax-cuda12-plugin", "jax-cuda13-plugin", "warp-lang"),), "1.0"
)
ONE_H200 = JaxView("gpu", ("NVIDIA H200",))


def machine_of(
    monkeypatch: pytest.MonkeyPatch, *boards: Board, control: Path | None = MPS
) -> Machine:
    fake_nvml.install(monkeypatch, *boards)
    return Machine(list_gpus(), (0, 1), control, "580.159.03" if boards else None)


def seen(machine: Machine, jax: JaxView = ONE_H200, **changes: object) -> SystemInfo:
    return SystemInfo(machine, jax, INSTALLED)._replace(**changes)


def ability(found: Diagnosis, kind: str, name: str) -> tuple[bool, str]:
    [one] = [one for one in found.abilities if (one.kind, one.name) == (kind, name)]
    return one.usable, one.why


def test_a_healthy_gpu(monkeypatch: pytest.MonkeyPatch):
    found = diagnose(seen(machine_of(monkeypatch, H200_MIG_OFF)))
    assert found.problems == ()
    assert ability(found, "backend", "mps") == (True, "daemon: an own one for each GPU")
    assert ability(found, "backend", "mig")[0] is False
    assert ability(found, "reducer", "mpr") == (True, "e.g. with layout [[0,1]]")
    assert "there is only one" in ability(found, "reducer", "mrr")[1]
    assert "humanoid" in ability(found, "physics", "warp")[1]
    found = diagnose(seen(machine_of(monkeypatch, H200_MIG_OFF), mps_error="not permitted"))
    assert ability(found, "backend", "mps") == (False, "not permitted")
    assert any("fall back to share" in note for note in found.notes)
    assert found.problems == ()


def test_a_machine_without_a_gpu_is_healthy(monkeypatch: pytest.MonkeyPatch):
    found = diagnose(seen(machine_of(monkeypatch, control=None), JaxView("cpu", ("cpu",))))
    assert found.problems == ()
    assert ability(found, "backend", "mps") == (False, "no usable NVIDIA GPU here")
    assert ability(found, "backend", "cpu") == (True, "virtual GPUs on 2 cores")
    assert ability(found, "intra", "host") == (True, "with cpu")


def test_gpus_that_nothing_can_use_are_a_problem(monkeypatch: pytest.MonkeyPatch):
    here = machine_of(monkeypatch, H200_MIG_OFF)
    no_plugin = INSTALLED | {"jax-cuda12-plugin": None, "jax-cuda13-plugin": None}
    found = diagnose(seen(here, JaxView(None, error="no cuda"), versions=no_plugin))
    assert found.problems == (
        "jax cannot use the GPUs that NVML lists: no cuda (pip install 'gmijax[cuda13]')",
    )
    found = diagnose(seen(machine_of(monkeypatch, H200_MIG_OFF, H200_MIG_OFF)))
    assert found.problems == ("jax sees 1 GPUs, and NVML lists 2",)
    found = diagnose(seen(machine_of(monkeypatch, H200_MIG_OFF, H200_MIG_EMPTY)))
    [problem] = found.problems
    assert problem.startswith("GPU 1 is in MIG mode and has no instance")


def test_instances_are_listed(monkeypatch: pytest.MonkeyPatch):
    found = diagnose(seen(machine_of(monkeypatch, A100_SEVEN)))
    assert found.problems == ()
    assert ability(found, "backend", "mig")[1] == f"GPU 0: {', '.join(['1g.10gb'] * 7)}"
    assert ability(found, "backend", "share") == (False, "all GPUs are in MIG mode")
    plain = json.loads(json.dumps(found.to_dict()))
    assert plain["gpus"][0]["instances"][6]["num_sms"] == 14


def test_what_is_missing_or_broken_is_a_problem(monkeypatch: pytest.MonkeyPatch):
    here = machine_of(monkeypatch)
    found = diagnose(
        seen(
            here,
            JaxView(None, error="no module"),
            versions=INSTALLED | {"optax": None, "warp-lang": None},
            nvml_error="Driver/library version mismatch",
        )
    )
    assert found.problems == (
        "NVML is installed and does not work: Driver/library version mismatch",
        "the package optax is not installed (pip install gmijax)",
        "jax does not work: no module",
    )
    assert ability(found, "physics", "warp")[0] is False


@pytest.mark.parametrize(
    ("code", "is_problem"),
    [
        (pynvml.NVML_ERROR_LIBRARY_NOT_FOUND, False),
        (pynvml.NVML_ERROR_DRIVER_NOT_LOADED, False),
        (pynvml.NVML_ERROR_LIB_RM_VERSION_MISMATCH, True),
    ],
)
def test_an_nvml_that_is_only_absent_is_no_problem(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, code: int, is_problem: bool
):
    def fail() -> None:
        raise pynvml.NVMLError(code)

    monkeypatch.setattr(nvidia, "_DEVICES", tmp_path)
    monkeypatch.setattr(pynvml, "nvmlInit", fail)
    assert (nvml_problem() is not None) == is_problem


def test_jax_is_asked_as_a_gmi_would_be_started(monkeypatch: pytest.MonkeyPatch):
    asked: list[dict[str, str]] = []

    def run(command: list[str], *, env: dict[str, str], **_: object) -> object:
        asked.append(env)
        return subprocess.CompletedProcess(command, 0, '{"platform": "gpu", "devices": ["x"]}', "")

    monkeypatch.setattr(system_info.subprocess, "run", run)
    assert ask_jax(machine_of(monkeypatch, H200_MIG_OFF, H200_MIG_OFF)).devices == ("x",)
    ask_jax(machine_of(monkeypatch, A100_SEVEN))
    ask_jax(machine_of(monkeypatch))
    shown = [(env["CUDA_VISIBLE_DEVICES"], env["JAX_PLATFORMS"]) for env in asked]
    assert shown == [
        ("GPU-0-uuid,GPU-0-uuid", "cuda"),
        (fake_nvml.instance_uuid(0, 0), "cuda"),
        ("", "cpu"),
    ]


def test_a_jax_that_fails_or_hangs_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    program = tmp_path / "python"
    program.write_text("#!/bin/sh\necho 'RuntimeError: no cuda' >&2; exit 1\n")
    program.chmod(0o755)
    monkeypatch.setattr(system_info.sys, "executable", str(program))
    assert ask_jax(machine_of(monkeypatch)) == JaxView(None, error="RuntimeError: no cuda")
    program.write_text("#!/bin/sh\nexec sleep 60\n")
    assert ask_jax(machine_of(monkeypatch), 0.2).error == "no answer within 0.2 s"


def test_mps_is_tried_on_a_gpu_that_may_be_used(monkeypatch: pytest.MonkeyPatch):
    prohibited = H200_MIG_OFF._replace(compute_mode=pynvml.NVML_COMPUTEMODE_PROHIBITED)
    here = machine_of(monkeypatch, prohibited, H200_MIG_OFF, control=Path("/bin/false"))
    assert "failed with exit code 1" in (try_mps(here) or "")


def test_the_report_names_everything(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    found = diagnose(seen(machine_of(monkeypatch, A100_SEVEN, H200_MIG_EMPTY)))
    doctor.show(found, Console(markup=False, width=140, soft_wrap=True))
    said = capsys.readouterr().out
    for part in ("1g.10gb: 14 SMs", "MIG on", "[[0],[1]]", "problem: GPU 1", "NVIDIA H200"):
        assert part in said


def test_exit_code_says_whether_something_is_broken(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    for broken, code in ((None, 0), ("version mismatch", 1)):
        here = seen(machine_of(monkeypatch, H200_MIG_OFF), nvml_error=broken)
        monkeypatch.setattr(doctor, "look", lambda here=here: here)
        assert doctor.main(["--json"]) == code
        assert json.loads(capsys.readouterr().out)["ok"] == (code == 0)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--jsn"], "--jsn: allowed are --json, mig=SIZES"),
        (["gpu=1"], "gpu=1: only together with mig="),
        (["mig=3g", "--json"], "--json: not together with mig="),
        (["mig=3g", "cluster=auto"], "cluster=auto: not together with mig="),
        (["mig=9g"], "mig=9g: expected a list of 1g, 2g, 3g, 4g, 7g"),
        (["mig=1g", "gpu=4"], "gpu=4: no such GPU; usable are [0]"),
    ],
)
def test_bad_arguments_are_one_line_and_exit_code_two(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    said: str,
):
    here = machine_of(monkeypatch, H200_MIG_OFF)
    monkeypatch.setattr(doctor, "detect_machine", lambda: here)
    assert doctor.main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"gmijax.doctor: {said}")
    assert error.count("\n") == 1


def test_commands_for_a_split_are_printed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    here = machine_of(monkeypatch, fake_nvml.V100, H200_MIG_OFF)
    monkeypatch.setattr(doctor, "detect_machine", lambda: here)
    assert doctor.main(["mig=3g,2g,1g,1g"]) == 0
    said = capsys.readouterr().out
    assert "sudo nvidia-smi mig -i 1 -cgi 3g.71gb:4,2g.35gb:2,1g.18gb:1,1g.18gb:0 -C\n" in said


BINDINGS_MISSING = (
    "GMIs on GPUs cannot train together: their exchanges need "
    "cuda-bindings>=13, and {} (pip install 'gmijax[cuda13]')"
)


@pytest.mark.parametrize(
    ("driver", "changes", "note"),
    [
        ("580.159.03", {}, BINDINGS_MISSING.format("it is not installed")),
        (
            "580.159.03",
            {"cuda-bindings": "12.9.4", "jax-cuda12-plugin": None},
            BINDINGS_MISSING.format("12.9.4 is installed"),
        ),
        ("580.159.03", {"cuda-bindings": "13.5.0"}, None),
        ("570.86.10", {"cuda-bindings": "12.9.0"}, "12.9.0 is installed (pip install 'gmijax[cu"),
        ("570.86.10", {"cuda-bindings": "12.9.1"}, None),
        # What jax has counts, where the driver takes both.
        (
            "580.159.03",
            {"jax-cuda13-plugin": None},
            "cuda-bindings>=12.9.1,<13, and it is not installed (pip install 'gmijax[cuda12]')",
        ),
    ],
)
def test_missing_or_old_bindings_are_told_with_the_command_that_brings_them(
    monkeypatch: pytest.MonkeyPatch, driver: str, changes: dict[str, str | None], note: str | None
):
    here = machine_of(monkeypatch, H200_MIG_OFF)
    here = dataclasses.replace(here, driver_version=driver)
    notes = diagnose(seen(here, versions=INSTALLED | changes)).notes
    assert [note in found for found in notes] == [True] if note else notes == ()


FAST = INSTALLED | {"cuda-bindings": "13.5.0"}


def test_without_mps_or_warp_the_fast_path_is_not_whole(monkeypatch: pytest.MonkeyPatch):
    no_mps = machine_of(monkeypatch, H200_MIG_OFF, control=None)
    [note] = diagnose(seen(no_mps, versions=FAST)).notes
    assert "nvidia-cuda-mps-control is not installed" in note
    here = machine_of(monkeypatch, H200_MIG_OFF)
    [note] = diagnose(seen(here, versions=FAST | {"warp-lang": None})).notes
    assert "faster physics for ant, " in note
    assert note.endswith("needs warp-lang (pip install 'gmijax[warp]')")
    [note] = diagnose(seen(here, versions=FAST, wanted_warp="1.18.0")).notes
    assert note.startswith("MJX-Warp was made for warp-lang 1.18.0, and 1.0 is installed")
    assert diagnose(seen(here, versions=FAST, wanted_warp="1.0")).notes == ()
    # Between instances there is no fast path to complete.
    assert diagnose(seen(machine_of(monkeypatch, A100_SEVEN))).notes == ()


def test_a_mujoco_that_mjx_does_not_know_is_told(monkeypatch: pytest.MonkeyPatch):
    mixed = INSTALLED | {"mujoco": "4.0.0", "mujoco-mjx": "3.17.0"}
    [note] = diagnose(seen(machine_of(monkeypatch), versions=mixed)).notes
    assert note.startswith("mujoco 4.0.0 with mujoco-mjx 3.17.0 was never tried (pip install")
