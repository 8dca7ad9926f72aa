"""What the doctor says of faked machines, and how it takes its arguments."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import fake_nvml
import pynvml
import pytest
from fake_nvml import A100_SEVEN, H200_MIG_EMPTY, H200_MIG_OFF, Board, machine_of
from supervision import CHECKOUT, MPS

from gmijax import doctor
from gmijax.control import system_info
from gmijax.control.console import UserConsole
from gmijax.control.diagnosis import Diagnosis, diagnose
from gmijax.control.features import EXTRAS, OpenGl, features
from gmijax.control.system_info import REQUIRED, JaxView, SystemInfo, ask_jax, try_mps
from gmijax.errors import ConfigError
from gmijax.machine import opengl

PLUGINS = ("jax-cuda12-plugin", "jax-cuda13-plugin")
INSTALLED = dict.fromkeys((*REQUIRED, *PLUGINS, "warp-lang"), "1.0")
CPU = JaxView("cpu", ("cpu",))


def system(
    monkeypatch: pytest.MonkeyPatch,
    boards: tuple[Board, ...],
    versions: dict[str, str | None] | None = None,
    control: Path | None = MPS,
    driver: str = "580.159.03",
    **changes: Any,
) -> SystemInfo:
    """With MPS, and with a jax that sees one GPU, unless `changes` say otherwise."""
    here = machine_of(monkeypatch, *boards, mps_control=control, driver_version=driver)
    found = SystemInfo(here, JaxView("gpu", ("NVIDIA H200",)), INSTALLED | (versions or {}))
    return found._replace(**changes)


def ability(found: Diagnosis, kind: str, name: str) -> tuple[bool, str]:
    [one] = [one for one in found.abilities if (one.kind, one.name) == (kind, name)]
    return one.usable, one.why


@pytest.mark.parametrize(
    ("boards", "changes", "what", "usable", "why"),
    [
        ((H200_MIG_OFF,), {}, "backend mps", True, "daemon: one of its own for each GPU"),
        ((H200_MIG_OFF,), {"mps_error": "not permitted"}, "backend mps", False, "not permitted"),
        ((H200_MIG_OFF,), {}, "backend mig", False, "no GPU is divided into MIG instances"),
        ((H200_MIG_OFF,), {}, "reducer mpr", True, "e.g. with layout [[0,1]]"),
        ((H200_MIG_OFF,), {}, "reducer mrr", False, "there is only one"),
        ((H200_MIG_OFF,), {}, "physics warp", True, "humanoid"),
        ((A100_SEVEN,), {}, "backend mig", True, f"GPU 0: {', '.join(['1g.10gb'] * 7)}"),
        ((A100_SEVEN,), {}, "backend share", False, "all GPUs are in MIG mode"),
        ((), {}, "backend mps", False, "no usable NVIDIA GPU here"),
        ((), {}, "backend cpu", True, "virtual GPUs on 2 cores"),
        ((), {}, "intra host", True, "with cpu"),
        ((), {"versions": {"warp-lang": None}}, "physics warp", False, ""),
    ],
)
def test_what_can_be_used_and_why(
    monkeypatch: pytest.MonkeyPatch,
    boards: tuple[Board, ...],
    changes: dict[str, Any],
    what: str,
    usable: bool,
    why: str,
):
    found = ability(diagnose(system(monkeypatch, boards, **changes)), *what.split())
    assert found[0] == usable
    assert why in found[1]


@pytest.mark.parametrize(
    ("boards", "changes", "problems"),
    [
        ((H200_MIG_OFF,), {}, ()),
        ((H200_MIG_OFF,), {"mps_error": "not permitted"}, ()),
        ((A100_SEVEN,), {}, ()),
        ((), {"jax": CPU}, ()),
        (
            (H200_MIG_OFF,),
            {"jax": JaxView(None, error="no cuda"), "versions": dict.fromkeys(PLUGINS)},
            ("jax cannot use the GPUs that NVML lists: no cuda (pip install 'gmijax[cuda13]')",),
        ),
        ((H200_MIG_OFF, H200_MIG_OFF), {}, ("jax sees 1 GPUs, and NVML lists 2",)),
        ((H200_MIG_OFF, H200_MIG_EMPTY), {}, ("GPU 1 is in MIG mode and has no instance",)),
        (
            (),
            {
                "jax": JaxView(None, error="no module"),
                "versions": {"optax": None},
                "nvml_error": "Driver/library version mismatch",
            },
            (
                "NVML is installed and does not work: Driver/library version mismatch",
                "the package optax is not installed (pip install gmijax)",
                "jax does not work: no module",
            ),
        ),
    ],
)
def test_what_is_broken_is_a_problem(
    monkeypatch: pytest.MonkeyPatch,
    boards: tuple[Board, ...],
    changes: dict[str, Any],
    problems: tuple[str, ...],
):
    found = diagnose(system(monkeypatch, boards, **changes)).problems
    assert len(found) == len(problems)
    assert all(text.startswith(message) for text, message in zip(found, problems, strict=True))


FAST = {"cuda-bindings": "13.5.0"}
MISSING = "their exchanges need cuda-bindings>=13, and {} (pip install 'gmijax[cuda13]')"
OLD_DRIVER = {"driver": "570.86.10"}


@pytest.mark.parametrize(
    ("versions", "changes", "note"),
    [
        (FAST, {}, None),
        ({}, {}, MISSING.format("it is not installed")),
        ({"cuda-bindings": "12.9.4"}, {}, MISSING.format("12.9.4 is installed")),
        ({"cuda-bindings": "12.9.0"}, OLD_DRIVER, "and 12.9.0 is installed (pip install"),
        ({"cuda-bindings": "12.9.1"}, OLD_DRIVER, None),
        # What jax has counts, where the driver takes both.
        ({"jax-cuda12-plugin": None}, {}, MISSING.format("it is not installed")),
        ({"jax-cuda13-plugin": None}, {}, "need cuda-bindings>=12.9.1,<13, and it is not insta"),
        (FAST, {"mps_error": "not permitted"}, "jobs fall back to share, because MPS does not st"),
        (FAST, {"control": None}, "nvidia-cuda-mps-control is not installed"),
        (FAST | {"warp-lang": None}, {}, "needs warp-lang (pip install 'gmijax[warp]')"),
        (FAST, {"wanted_warp": "1.18.0"}, "made for warp-lang 1.18.0, and 1.0 is installed"),
        (FAST, {"wanted_warp": "1.0"}, None),
        # Between instances there is no fast path to complete.
        ({}, {"boards": (A100_SEVEN,)}, None),
        ({"mujoco": "4.0.0", "mujoco-mjx": "3.17.0"}, {"boards": ()}, "3.17.0 was never tried"),
    ],
)
def test_what_is_missing_or_old_is_named_with_the_command_that_installs_it(
    monkeypatch: pytest.MonkeyPatch,
    versions: dict[str, str | None],
    changes: dict[str, Any],
    note: str | None,
):
    hardware = {"boards": (H200_MIG_OFF,), **changes}
    notes = diagnose(system(monkeypatch, versions=versions, **hardware)).notes
    assert [note in found for found in notes] == [True] if note else notes == ()


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


def test_a_jax_that_fails_or_hangs_is_reported(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    program = tmp_path / "python"
    program.write_text("#!/bin/sh\necho 'RuntimeError: no cuda' >&2; exit 1\n")
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    assert ask_jax(machine_of(monkeypatch)) == JaxView(None, error="RuntimeError: no cuda")
    program.write_text("#!/bin/sh\nexec sleep 60\n")
    monkeypatch.setattr(system_info, "PROBE_TIMEOUT_S", 0.2)
    assert ask_jax(machine_of(monkeypatch)).error == "no answer within 0.2 s"


def test_mps_is_tried_on_a_gpu_that_may_be_used(monkeypatch: pytest.MonkeyPatch):
    prohibited = H200_MIG_OFF._replace(compute_mode=pynvml.NVML_COMPUTEMODE_PROHIBITED)
    here = machine_of(monkeypatch, prohibited, H200_MIG_OFF, mps_control=Path("/bin/false"))
    assert "failed with exit code 1" in (try_mps(here) or "")


def test_the_report_names_everything(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    found = diagnose(system(monkeypatch, (A100_SEVEN, H200_MIG_EMPTY)))
    plain = json.loads(json.dumps(found.to_dict()))
    assert plain["gpus"][0]["instances"][6]["num_sms"] == 14
    doctor.show(found, UserConsole(markup=False, width=140, soft_wrap=True))
    output = capsys.readouterr().out
    for part in ("1g.10gb: 14 SMs", "MIG on", "[[0],[1]]", "problem: GPU 1", "NVIDIA H200"):
        assert part in output


def test_exit_code_says_whether_something_is_broken(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    for broken, code in ((None, 0), ("version mismatch", 1)):
        here = system(monkeypatch, (H200_MIG_OFF,), nvml_error=broken)
        monkeypatch.setattr(doctor, "inspect_system", lambda here=here: here)
        assert doctor.main(["--json"]) == code
        assert json.loads(capsys.readouterr().out)["ok"] == (code == 0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--jsn"], "--jsn: expected one of --json, --verbose, mig=SIZES"),
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
    message: str,
):
    here = machine_of(monkeypatch, H200_MIG_OFF)
    monkeypatch.setattr(doctor, "detect_machine", lambda: here)
    assert doctor.main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"gmijax.doctor: {message}")
    assert error.count("\n") == 1


def test_commands_for_a_split_are_printed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    here = machine_of(monkeypatch, fake_nvml.V100, H200_MIG_OFF)
    monkeypatch.setattr(doctor, "detect_machine", lambda: here)
    assert doctor.main(["mig=3g,2g,1g,1g"]) == 0
    output = capsys.readouterr().out
    assert "sudo nvidia-smi mig -i 1 -cgi 3g.71gb:4,2g.35gb:2,1g.18gb:1,1g.18gb:0 -C\n" in output


@pytest.mark.parametrize(
    ("name", "versions", "usable", "why"),
    [
        ("ONNX", {"jax2onnx": "1", "onnx": "1", "onnxruntime": "1"}, True, "gmijax export"),
        ("ONNX", {"onnx": "1"}, False, "pip install 'gmijax[export]'"),
        ("Optuna", {}, False, "pip install 'gmijax[sweep]'"),
        ("TensorBoard", {"tensorboard": "2.20"}, True, "tensorboard --logdir"),
        ("viewer", {"viser": None}, False, "pip install 'gmijax[view]'"),
    ],
)
def test_an_extra_works_or_has_the_line_that_mends_it(
    name: str, versions: dict[str, str | None], usable: bool, why: str
):
    [found] = [feature for feature in features(versions, None) if feature.name == name]
    assert found.usable == usable
    assert why in found.why


def test_films_say_with_what_they_are_drawn_or_what_is_missing():
    drawn, not_drawn = (next(features({}, gl)) for gl in (OpenGl("egl"), OpenGl(None, "no EGL")))
    assert drawn == ("films", True, "a picture was drawn with egl")
    assert not_drawn == ("films", False, "no EGL")


def test_an_opengl_that_hangs_does_not_draw(monkeypatch: pytest.MonkeyPatch):
    asleep = [sys.executable, "-c", "import time; time.sleep(60)"]
    monkeypatch.setattr(opengl, "command", lambda _: asleep)
    assert opengl.first_opengl(("egl",), 0.2) == (None, "no picture within 0.2 s")


def test_the_packages_of_extras_are_those_that_pip_installs():
    with (CHECKOUT / "pyproject.toml").open("rb") as file:
        brought = tomllib.load(file)["project"]["optional-dependencies"]
    for extra in EXTRAS.values():
        name = extra.install.strip("'").removeprefix("gmijax[").removesuffix("]")
        if name in brought:
            packages = {re.split(r"[>=~<;\[]", line)[0] for line in brought[name]}
            assert set(extra.packages) <= packages


def test_without_a_gpu_the_table_has_what_only_gpus_have_for_those_who_ask(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    console = UserConsole(markup=False, width=80, soft_wrap=True)
    for boards, verbose, shown in (
        ((), False, False),
        ((), True, True),
        ((H200_MIG_OFF,), False, True),
    ):
        console.is_verbose = verbose
        doctor.show(diagnose(system(monkeypatch, boards, jax=CPU)), console)
        output = capsys.readouterr().out
        assert ("\nreducer" in output) == ("\nbackend" in output) == shown
        assert "\nphysics" in output


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (
            "cluster.engine=ray: the package ray is not installed",
            "the package ray is not installed",
        ),
        ("cluster.address=auto: no cluster of Ray there (x: y)", "no cluster of Ray there (x: y)"),
    ],
)
def test_errors_of_a_cluster_name_what_was_typed(
    wrong: str, message: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(*_: object) -> None:
        raise ConfigError(wrong)

    monkeypatch.setattr("gmijax.cluster.survey.RayCluster", refuse)
    assert doctor.main(["cluster=auto"]) == 2
    assert capsys.readouterr().err == f"gmijax.doctor: cluster=auto: {message}\n"
