"""What `gmijax pack` takes and refuses, and what its jobs get."""

from __future__ import annotations

import dataclasses
import io
import json
import re
import signal
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import pytest
from command_lines import run
from supervision import gpu, machine

import gmijax
from gmijax.cli.pack import build_pack
from gmijax.config.pack import PackConfig
from gmijax.control.console import open_console
from gmijax.errors import ConfigError
from gmijax.machine.mps_control import MEMORY_LIMIT_VARIABLE, PIPE_VARIABLE
from gmijax.machine.nvidia import GpuLoad, MigInstance
from gmijax.machine.snapshot import DAEMONS_VARIABLE, Machine
from gmijax.packs import slot_limiter
from gmijax.packs.command_job import CommandJob, require_programs
from gmijax.packs.command_kind import CommandKind, PackPaths
from gmijax.packs.failure import failure_of
from gmijax.packs.pack import PackWork
from gmijax.packs.slot_limiter import SlotLimiter
from gmijax.supervise.backends.backend import Backend
from gmijax.sweeps.children import ChildStatus, Process
from gmijax.sweeps.host import LocalHost, client_variables
from gmijax.sweeps.running import JobOutcome, Running
from gmijax.sweeps.slots import Slot, SlotPool
from gmijax.sweeps.work import Folder

COMMAND = ("true", "--seed", "{seed}")
GPU = machine(1, cpu_cores=tuple(range(16)), mps_control=Path("/usr/bin/nvidia-cuda-mps-control"))
INSTANCE = MigInstance("MIG-0", "1g.18gb", 1, 16, 16384)
DIVIDED = replace(GPU, gpus=(gpu(0, mig_enabled=True)._replace(instances=(INSTANCE,)), gpu(1)))


def commands(work: PackWork) -> list[tuple[str, ...]]:
    return [job.arguments(Path("/f")) for job in work.jobs]


def test_every_combination_of_values_is_a_job_and_values_stay_as_they_were_typed() -> None:
    work = build_pack(["seed=0,1", "lr=1e-4,003"], ["true", "--lr={lr}", "{seed}", "{run_dir}"])
    assert commands(work) == [
        ("true", f"--lr={lr}", seed, "/f") for seed in "01" for lr in ("1e-4", "003")
    ]
    assert [job.label for job in work.jobs][:2] == ["seed=0 lr=1e-4", "seed=0 lr=003"]


@pytest.mark.parametrize(
    ("words", "values"),
    [
        (["x='a,b',c"], ["a,b", "c"]),
        (["x=[64,64],[128]"], ["[64,64]", "[128]"]),
        (["x=range(0,3)"], ["0", "1", "2"]),
        (["x=7"], ["7"]),
        (["x=a b,c"], ["a b", "c"]),
    ],
)
def test_values_by_the_grammar_of_sweeps(words: list[str], values: list[str]) -> None:
    assert [one[1] for one in commands(build_pack(words, ["true", "{x}"]))] == values


def test_copies_and_a_file_of_commands(tmp_path: Path) -> None:
    work = build_pack(["pack.copies=3"], ["true", "{job}"])
    assert [words[1] for words in commands(work)] == ["000", "001", "002"]
    file = tmp_path / "commands"
    file.write_text("# all of them\ntrue --name 'a b'\n\ntrue {run_dir}  # where it writes\n")
    assert commands(build_pack([f"pack.commands={file}"], [])) == [
        ("true", "--name", "a b"),
        ("true", "/f"),
    ]


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("./nosuch.sh", "./nosuch.sh"),
        ("sub/nosuch.sh", "sub/nosuch.sh"),
        ("{here}/nosuch.sh", "./nosuch.sh"),
        ("/nowhere/nosuch.sh", "/nowhere/nosuch.sh"),
        ("nosuch", "nosuch"),
    ],
)
def test_a_program_that_is_not_there_is_named_as_it_was_typed(
    command: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    command = command.replace("{here}", str(tmp_path))
    Path("cmds.txt").write_text(f"# all of them\ntrue\n\n{command} --seed 0\n{command}\n")
    what = f"{message}: no such program, or it cannot be executed"
    for work, where in (
        (build_pack([], [command]), ""),
        (build_pack(["pack.commands=cmds.txt"], []), "pack.commands=cmds.txt: line 4: "),
    ):
        with pytest.raises(ConfigError) as error:
            require_programs(work.jobs, work.ranking)
        assert str(error.value) == f"{where}{what}"


def test_keys_that_hold_text_need_no_quotes_of_hydra() -> None:
    resume = "--agent.resume True --agent.load-run .*_pack{job}$"
    words = [f"pack.resume={resume}", "pack.env.NAME=job-{job}", r"pack.metric=^R: (-?[\d.]+), x$"]
    more = ("pack.cwd=${HOME}", r'pack.steps="step": (\d+)', "pack.env.NONE=null")
    settings = build_pack([*words, *more, "pack.copies=2"], ["true"]).ranking
    assert settings.resume == resume
    assert settings.cwd == "${HOME}"
    assert settings.steps == r'"step": (\d+)'
    assert settings.env == {"NAME": "job-{job}", "NONE": None}
    assert settings.metric == r"^R: (-?[\d.]+), x$"


def test_a_value_in_quotes_may_be_empty() -> None:
    jobs = build_pack(["flag=--fast,''"], ["true", "{flag}"]).jobs
    assert [job.overrides["flag"] for job in jobs] == ["--fast", ""]


@pytest.mark.parametrize(
    ("words", "command", "message"),
    [
        ((), (), r"no command: expected gmijax pack"),
        (("seed=0,1",), ("true",), r"^seed=0,1: the command has no \{seed\}"),
        (("seed=0,1,2,3,4",), ("true",), r"^seed=0,1,2,3,\.\.\.: the command has no \{seed\}"),
        (("x=interval(0,1)",), ("true",), r"^x=interval\(0,1\): the command has no \{x\}"),
        ((), ("true", "{seed}"), r"\{seed\}: no such placeholder"),
        (("pack.resume=--x 'a",), ("true",), "pack.resume=--x 'a: No closing quotation"),
        (("seed=0,1",), ("true", "{sed}", "{seed}"), r"\{sed\}: no such placeholder.*seed"),
        (("job=0,1",), ("true", "{job}"), r"^job=0,1: every job has \{job\} of its own"),
        (("seed=0,0",), COMMAND, "a value is repeated"),
        (("seed=0", "seed=1"), COMMAND, "grid is repeated"),
        (("pack.rate=fps",), ("true",), "pack.rate=fps: has 0 groups"),
        (("pack.rate=(",), ("true",), r"pack.rate=\(: no regular expression"),
        (("pack.copies=2", "seed=0,1"), COMMAND, "^pack.copies=2: not with seed=0,1; leave one"),
        (("pack.copies=10001",), ("true",), "^pack.copies: 10,001 jobs; at most 10,000 are"),
        (("pack.commands=/nothing",), (), "pack.commands=/nothing: cannot be read"),
        (("pack.commands=/nothing", "seed=1"), (), "^pack.commands=/nothing: not with seed=1$"),
        (("pack.commands=/nothing",), ("true",), "=/nothing: not with a command after --$"),
        (("pack.resume=--load {name}",), ("true",), r"\{name\}: no such placeholder"),
        (("pack.jobs_per_gpu=0",), ("true",), "pack.jobs_per_gpu=0: must be at least 1"),
        (("pack.jobs_per_gpu=1,2",), ("true",), "expected one value"),
        (("pack.sampler=tpe", "seed=0,1"), COMMAND, "pack.sampler=tpe: needs pack.trials"),
        (("seed=interval(0,1)",), COMMAND, "use pack.sampler=random or tpe"),
    ],
)
def test_bad_input_is_refused(words: Sequence[str], command: Sequence[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        build_pack(words, command)


@pytest.mark.parametrize(
    ("words", "command"),
    [
        (["pack.commands=commands"], []),
        (["pack.copies=3"], ["true"]),
        ([], ["true"]),
    ],
)
def test_a_sampler_without_names_is_refused(
    words: list[str], command: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("commands").write_text("true\n")
    with pytest.raises(ConfigError) as error:
        build_pack([*words, "pack.sampler=random", "pack.trials=4"], command)
    message = "pack.sampler=random: there is no list or interval to draw from; allowed: grid"
    assert str(error.value) == message


def test_lists_that_are_too_long_are_not_read_to_their_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def seeds() -> Iterator[int]:
        yield from range(10_001)
        pytest.fail("read on")

    monkeypatch.setattr("sys.stdin", io.StringIO("true\n" * 10_002))
    message = "^pack.commands=-: line 10001: at most 10,000 jobs are allowed$"
    with pytest.raises(ConfigError, match=message):
        build_pack(["pack.commands=-"], [])
    with pytest.raises(ConfigError, match=r"^seed: at most 10,000 values"):
        gmijax.pack(COMMAND, {"seed": cast("Any", seeds())})


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (("--", "no-such-program"), "no-such-program: no such program"),
        (("py=true,no-such", "--", "{py}"), "no-such: no such program"),
        (("pack.cwd=/nothing", "--", "true"), "pack.cwd=/nothing: no such folder"),
        (("pack.cwd=/dev/null", "--", "true"), "pack.cwd=/dev/null: is not a folder"),
        (("pack.gpus=3", "--", "true"), "pack.gpus=3: this machine has 1 usable GPUs\n"),
        (("pack.backend=x", "--", "true"), "pack.backend=x: expected one of auto, mps, share"),
        (("pack.stall_s=0", "--", "true"), "pack.stall_s=0"),
        (("pack.x=1", "--", "true"), "unknown key pack.x"),
    ],
)
def test_nothing_is_started_for_bad_input(
    argv: Sequence[str], message: str, tmp_path: Path
) -> None:
    done = run("pack", *argv, cwd=tmp_path, machine=GPU)
    assert (done.code, done.stdout) == (2, "")
    assert message in done.stderr
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize(
    ("here", "backend", "message"),
    [
        (machine(0), "share", "no usable NVIDIA GPU here; available here: auto"),
        (machine(0), "mps", "no usable NVIDIA GPU here; available here: auto"),
        (machine(1), "mps", ".*was not found in PATH .*; available here: auto, share"),
        (
            machine(1, selection_problem="9 names no GPU"),
            "auto",
            "CUDA_VISIBLE_DEVICES=-1 goes on",
        ),
        (machine(0, gpu_problem="broken"), "auto", "CUDA_VISIBLE_DEVICES=-1 continues"),
        (DIVIDED, "mps", "is in MIG mode, and the backend is mps: choose other GPUs"),
    ],
)
def test_only_backends_of_packs_are_named(
    here: Machine, backend: str, message: str, tmp_path: Path
):
    done = run(
        "pack",
        f"pack.backend={backend}",
        "pack.gpus=[0]",
        "--",
        "true",
        cwd=tmp_path,
        machine=here,
    )
    assert done.code == 2
    assert re.search(message, done.stderr)
    assert not re.search("plan[.]|backend=(cpu|mig)|, cpu|, mig", done.stderr)


@pytest.mark.parametrize(
    ("command", "grid", "message"),
    [
        (COMMAND, {"seed": []}, "seed: an empty list"),
        (COMMAND, {"seed": iter(())}, "seed: an empty list"),
        (COMMAND, {"seed": "abc"}, "seed='abc': expected a list"),
        (COMMAND, {"seed": 5}, "seed=5: expected a list"),
        (("true", 5), None, "command: 5: expected text"),
        ("true 5", None, "command='true 5': expected a list"),
        (5, None, "command=5: expected a list"),
        ((), None, "no command: expected"),
    ],
)
def test_what_is_no_grid_is_refused_before_a_folder_is_made(
    command: Any, grid: Any, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=f"^{message}"):
        gmijax.pack(command, grid)
    assert not list(tmp_path.iterdir())


def test_the_folder_of_a_sweep_is_called_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    request = tmp_path / "all" / "request.json"
    request.parent.mkdir()
    for held, message in (
        ({"jobs": [{"seed": "0"}]}, "holds a sweep; give another folder"),
        ({"commands": [["true"]], "jobs": [{}]}, "holds another pack; give the same command"),
    ):
        request.write_text(json.dumps(held))
        with pytest.raises(ConfigError, match=message):
            gmijax.pack(COMMAND, {"seed": [0]}, run_dir="all")


def test_jobs_share_a_program_up_to_their_first_option() -> None:
    jobs = build_pack(["s=0,1"], ["true", "train", "Task-{s}", "--lr", "1"]).jobs
    assert jobs[0].program == jobs[1].program
    other = build_pack(["s=0,1"], ["true", "play", "Task-{s}"]).jobs[0]
    assert other.program != jobs[0].program


class Placed(Backend):
    """A backend with a daemon of its own, or without one."""

    def __init__(self, pipe: Path | None) -> None:
        self._pipe = pipe

    @property
    def daemons(self) -> dict[str, Path]:
        return {} if self._pipe is None else {GPU.gpus[0].uuid: self._pipe}

    def environment(self, gmi: int) -> dict[str, str]:
        del gmi
        return {PIPE_VARIABLE: str(self._pipe or "/none")}


def place_of(*words: str) -> tuple[PackWork, Slot]:
    work = build_pack(["pack.copies=2", "pack.jobs_per_gpu=2", *words], ["true"])
    with closing(LocalHost(GPU)) as host:
        (site,) = work.sites([host])
    slot = SlotPool([site]).acquire(1)
    assert slot is not None
    return work, slot


def test_a_client_of_the_own_daemon_gets_the_first_gpu_and_its_part_of_the_memory() -> None:
    _, slot = place_of()
    process = Process("job", ("true",), Path("log"), is_client=True, memory_fraction=0.5)
    found = client_variables(slot, process, Placed(Path("/pipe")), GPU)
    assert found[PIPE_VARIABLE] == "/pipe"
    # Of the daemon's one GPU; programs that take numbers alone do not know its UUID.
    assert found["CUDA_VISIBLE_DEVICES"] == "0"
    assert found[MEMORY_LIMIT_VARIABLE] == f"0={GPU.gpus[0].memory_mib // 2}M"
    # Also on a MIG instance, for trainings of ours.
    of_instance = dataclasses.replace(slot, backend="mig")
    for one in (found, client_variables(of_instance, process, Placed(Path("/pipe")), GPU)):
        assert json.loads(one[DAEMONS_VARIABLE]) == {GPU.gpus[0].uuid: "/pipe"}


def test_jobs_that_take_turns_get_the_index_of_their_gpu() -> None:
    _, slot = place_of("pack.backend=share")
    process = Process("job", ("true",), Path("log"), is_client=True, memory_fraction=0.5)
    found = client_variables(slot, process, Placed(None), GPU)
    assert found["CUDA_VISIBLE_DEVICES"] == str(GPU.gpus[0].index)
    assert found["CUDA_DEVICE_ORDER"] == "PCI_BUS_ID"
    assert MEMORY_LIMIT_VARIABLE not in found
    assert DAEMONS_VARIABLE not in found


@pytest.fixture
def kind(tmp_path: Path) -> CommandKind:
    text = {"resume": "--resume {run_dir}/last", "cwd": "{run_dir}", "stop_signal": "INT"}
    settings = PackConfig(**text, env={"NAME": "pack{job}"})
    return CommandKind(settings, PackPaths(tmp_path, "pack"), [8], [None], lambda _: 2)


def test_others_wait_for_the_first_job_of_a_program_until_one_has_reported(
    kind: CommandKind, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "cache"))
    _, slot = place_of()
    job, other = CommandJob(0, {}, ("true", "{job}")), CommandJob(1, {}, ("false",))
    start = kind.start((job,), slot)
    assert start.is_awaited
    with start.process.log.open("a") as log:
        log.write("6400: reward=12.500\n7000: reward=13.000\n")
    assert start.readers[0].new()
    assert not kind.start((job,), slot).is_awaited  # In later packs too.
    assert kind.start((other,), slot).is_awaited


def test_a_job_that_is_started_again_gets_the_words_to_resume(
    kind: CommandKind, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MKL_NUM_THREADS", "7")
    _, slot = place_of()
    job = CommandJob(3, {}, ("true", "{job}"))
    first = kind.start((job,), slot).process
    before = kind.start((job,), slot).process
    assert before.arguments == ("true", "003")  # It has not reported: nothing can be saved.
    (tmp_path / "003" / "pack" / "metrics.jsonl").write_text('{"env_steps": 1}\n')
    assert first.arguments == ("true", "003")
    assert first.cwd == str(tmp_path / "003")
    assert first.stop_signal == signal.SIGINT
    assert first.variables["NAME"] == "pack003"
    assert first.variables["OMP_NUM_THREADS"] == "4"
    assert "MKL_NUM_THREADS" not in first.variables  # The user has set it.
    again = kind.start((job,), slot).process
    assert again.arguments == ("true", "003", "--resume", f"{tmp_path}/003/last")
    assert (tmp_path / "003" / "pack" / "output.log").read_text().splitlines() == [
        "$ true 003",
        "$ true 003",
        f"$ true 003 --resume {tmp_path}/003/last",
    ]


class Ended(LocalHost):
    """A machine whose jobs have all ended with exit code 1."""

    def __init__(self) -> None:
        super().__init__(GPU)

    def look(self, child: int) -> ChildStatus:
        del child
        return ChildStatus(1)


def test_of_jobs_that_a_gpu_fault_ended_the_first_runs_alone(kind: CommandKind) -> None:
    work = build_pack(["pack.copies=4", "pack.jobs_per_gpu=4"], ["true"])
    host = Ended()
    slots = SlotPool(work.sites([host]))

    def fail(job: CommandJob) -> JobOutcome:
        slot = slots.acquire(1)
        assert slot is not None
        log = kind.start((job,), slot).process.log
        with log.open("a") as file:
            file.write("RuntimeError: CUDA error: an illegal memory access was encountered\n")
        slots.release(slot)
        return kind.outcome(Running((job,), slot, host, 0, ()), job)

    ends = [fail(job) for job in work.jobs[:3]]
    assert [end.may_be_neighbours for end in ends] == [True, False, False]
    assert [end.again is None for end in ends] == [True, False, False]
    assert not fail(work.jobs[2]).may_be_neighbours
    assert fail(work.jobs[2]).may_be_neighbours  # It has been near too often.


def test_a_job_that_finds_no_checkpoint_starts_from_its_beginning(
    kind: CommandKind, tmp_path: Path
) -> None:
    _, slot = place_of()
    job, host = CommandJob(0, {}, ("true",)), Ended()
    kind.start((job,), slot)
    (tmp_path / "000" / "pack" / "metrics.jsonl").write_text('{"env_steps": 1}\n')
    assert "--resume" in kind.start((job,), slot).process.arguments
    end = kind.outcome(Running((job,), slot, host, 0, ()), job)
    assert end.again == "from its beginning"
    assert "--resume" not in kind.start((job,), slot).process.arguments


@pytest.mark.parametrize(
    ("text", "is_memory", "is_gpu"),
    [
        ("torch.OutOfMemoryError: CUDA out of memory. Tried to allocate 2 GiB", True, False),
        ("jaxlib.XlaRuntimeError: RESOURCE_EXHAUSTED: Out of memory while", True, False),
        ("Warp CUDA error 2: out of memory", True, False),
        ("RuntimeError: CUDA error: unspecified launch failure", False, True),
        ("Warp CUDA error 700: an illegal memory access was encountered", False, True),
        ("train.py: error: unrecognized arguments: --sed", False, False),
    ],
)
def test_why_a_command_failed(text: str, is_memory: bool, is_gpu: bool, tmp_path: Path) -> None:
    log = tmp_path / "log"
    log.write_text(f"step 1\n{text}\n  at the end\n" if is_memory or is_gpu else f"{text}\n")
    found = failure_of(1, log)
    assert (found.is_out_of_memory, found.is_gpu_fault) == (is_memory, is_gpu)
    assert found.error == f"exit code 1: {text}"


def test_a_command_that_a_signal_ended_says_so(tmp_path: Path) -> None:
    assert failure_of(-9, tmp_path / "nothing").error == "ended by SIGKILL"


class Gpu(LocalHost):
    """A machine whose GPU has a given amount of memory in use."""

    def __init__(self) -> None:
        super().__init__(GPU)
        self.used_mib, self.busy = 1000.0, 0.4

    def load_of(self, device: str) -> GpuLoad:
        assert device == GPU.gpus[0].uuid
        return GpuLoad(self.used_mib, 81_000.0, self.busy)


class Clock:
    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


class Packed:
    """Jobs on one GPU whose rates depend on how many run; they never end by themselves."""

    def __init__(self, clock: Clock, rates: Sequence[float], memory_mib: float) -> None:
        self.clock, self.rates, self.memory_mib = clock, rates, memory_mib
        work = build_pack(["pack.copies=16"], ["true"])
        self.host = Gpu()
        sites = work.sites([self.host])
        self.slots = SlotPool(sites)
        self.limiter = SlotLimiter(self.slots, sites, [self.host], open_console(show=False))
        self.queue = list(work.jobs)
        self.running: list[Running[CommandJob]] = []

    def go_on(self, seconds: int) -> None:
        for _ in range(seconds):
            self.clock.now_s += 1.0
            while self.queue and (slot := self.slots.acquire(1)) is not None:
                job = self.queue.pop(0)
                one = Running((job,), slot, self.host, 0, (), started_s=self.clock.now_s)
                self.running.append(one)
            self.host.used_mib = 1000.0 + self.memory_mib * len(self.running)
            rate = self.rates[min(len(self.running), len(self.rates)) - 1] / len(self.running)
            for one in self.running:
                one.jobs[0].progress.env_steps += round(rate)
                one.jobs[0].progress.reports += 1 if rate else 0
            for one in self.limiter.look(self.running):
                self.running.remove(one)
                self.slots.release(one.slot)
                self.queue.insert(0, one.jobs[0])


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(slot_limiter, "running_s", clock)
    return clock


def test_jobs_are_added_while_they_gain_and_taken_back_when_they_do_not(clock: Clock) -> None:
    curve = [1000.0, 1900.0, 2500.0, 3100.0, 2900.0, 2700.0, 2500.0, 2300.0]
    packed = Packed(clock, curve, memory_mib=100.0)
    packed.go_on(600)
    assert len(packed.running) == 4
    assert [change["at_once"] for change in packed.limiter.decisions] == [4, 8, 6, 4]
    assert packed.limiter.decisions[1]["why"] == "4 at once make 3.10 times the rate of one"
    assert packed.limiter.decisions[-1]["why"] == "6 at once make 0.87 times the rate of 4"
    newest = max(one.started_s for one in packed.running)
    assert newest < 200.0  # The oldest went on.


def test_jobs_of_another_command_are_measured_anew(clock: Clock) -> None:
    packed = Packed(clock, [1000.0, 1010.0], memory_mib=100.0)
    packed.go_on(400)
    assert [len(packed.running), packed.limiter.decisions[-1]["at_once"]] == [1, 1]
    packed.go_on(400)
    assert packed.limiter.decisions[-1]["time_s"] < 400.0  # Of the same command: nothing new.
    packed.queue = [replace(job, command=("other",)) for job in packed.queue]
    packed.rates = [1000.0 * k for k in range(1, 17)]
    done = packed.running.pop()
    packed.slots.release(done.slot)
    packed.go_on(400)
    assert packed.limiter.decisions[-1]["at_once"] > 4


def test_memory_of_the_first_job_bounds_their_number(clock: Clock) -> None:
    packed = Packed(clock, [1000.0 * k for k in range(1, 17)], memory_mib=20_000.0)
    packed.go_on(400)
    assert len(packed.running) == 3  # Of 20,000 MiB and 15 % each in 95 % of 80,000.


def test_without_a_rate_an_idle_gpu_gets_a_second_job(clock: Clock) -> None:
    packed = Packed(clock, [0.0], memory_mib=100.0)
    packed.go_on(400)
    assert len(packed.running) == 2
    assert "no rate is found" in packed.limiter.decisions[0]["why"]
    busy = Packed(clock, [0.0], memory_mib=100.0)
    busy.host.busy = 0.9
    busy.go_on(400)
    assert len(busy.running) == 1


def test_short_jobs_are_added_without_a_measurement(clock: Clock) -> None:
    packed = Packed(clock, [1000.0] * 16, memory_mib=100.0)
    for _ in range(4):
        packed.go_on(15)
        done = packed.running.pop(0)
        done.jobs[0].progress.state = "completed"
        packed.slots.release(done.slot)
    packed.go_on(2)
    # The second that completed had begun beside three others; the first had been alone.
    assert [change["at_once"] for change in packed.limiter.decisions][:2] == [4, 8]
    assert packed.limiter.decisions[0]["why"] == "jobs end before a rate is measured"


def test_a_job_alone_on_its_gpu_may_have_all_of_it(kind: CommandKind) -> None:
    work, slot = place_of()
    job = CommandJob(0, {}, ("true",))
    assert kind.start((job,), slot).process.memory_fraction == 0.5
    with closing(LocalHost(GPU)) as host:
        alone = SlotPool(work.sites([host])).acquire(1, alone=True)
    assert alone is not None
    process = kind.start((job,), alone).process
    assert process.memory_fraction is None
    assert process.variables["OMP_NUM_THREADS"] == "8"


def test_a_rate_that_comes_late_is_measured(clock: Clock) -> None:
    packed = Packed(clock, [0.0], memory_mib=100.0)
    packed.go_on(300)
    assert len(packed.running) == 2
    packed.rates = [1000.0, 2000.0, 3000.0, 4000.0]
    packed.go_on(120)
    assert len(packed.running) >= 4


def test_a_job_that_starts_again_does_not_spoil_the_measurement(clock: Clock) -> None:
    packed = Packed(clock, [1000.0, 1900.0, 2800.0, 3700.0], memory_mib=100.0)
    packed.go_on(30)
    progress = packed.running[-1].jobs[0].progress
    progress.env_steps = progress.reports = 0
    packed.go_on(200)
    assert all(rate > 0 for one in packed.limiter.decisions for rate in one["rate_per_s"].values())
    assert len(packed.running) >= 4


def test_what_finds_no_memory_runs_again_beside_fewer(clock: Clock) -> None:
    packed = Packed(clock, [1000.0, 1900.0, 2800.0, 3700.0], memory_mib=100.0)
    packed.go_on(40)
    for fewer in (3, 2, 1):
        assert packed.limiter.forbid(packed.running[1], "exit code 1: out of memory")
        assert packed.limiter.decisions[-1]["at_once"] == fewer
    assert not packed.limiter.forbid(packed.running[0], "again")  # Fewer than one cannot run.


def test_the_report_has_names_of_variables_and_not_their_values() -> None:
    work = build_pack(["pack.env.WANDB_API_KEY=secret", "pack.copies=2"], ["true"])
    shown: dict[str, Any] = work.described()
    assert shown["pack"]["env"] == ["WANDB_API_KEY"]
    assert "secret" not in repr(work.described()) + repr(work.identity())
    assert work.folder == Folder(None, None)
