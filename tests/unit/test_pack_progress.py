"""What trainers print, read as lines of metrics."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from rich.console import Console

from gmijax.control.progress import ConsoleProgress
from gmijax.errors import ConfigError
from gmijax.packs.output import LONGEST_LINE, OutputReader
from gmijax.packs.progress import ProgressReader, own_patterns
from gmijax.packs.trainers import FAMILIES, Family, Report

SAMPLES = {
    "rsl_rl, Isaac Lab, mjlab": (
        "\x1b[1m          Learning iteration 3/100          \x1b[0m",
        "                        Total steps: 6400 ",
        "                   Steps per second: 98269 ",
        "                        Mean reward: 12.50 ",
    ),
    "rsl_rl": (
        "               Computation: 98269 steps/s (collection: 0.8s, learning 0.2s)",
        "               Mean reward: 12.50",
        "               Total timesteps: 6400",
    ),
    "Stable-Baselines3": (
        "|    ep_rew_mean          | 12.5         |",
        "|    fps                  | 98269        |",
        "|    total_timesteps      | 6400         |",
    ),
    "CleanRL": ("global_step=6400, episodic_return=[12.5]", "SPS: 98269"),
    "rl_games": (
        "fps step: 120000 fps step and policy inference: 110000 fps total: 98269 epoch: 3/100 "
        "frames: 6400/20000",
        "saving next best rewards:  [12.5]",
    ),
    "MuJoCo Playground's train_jax_ppo.py": ("6400: reward=12.500",),
    "gmijax": ("32 %  6400 steps  98,269 steps/s  return 12.50  ETA 0:42  [GMI 0 running]",),
    "skrl (tqdm)": (" 32%|###       | 6400/20000 [00:01<00:02, 98269.00it/s]",),
}


class Clock:
    """Seconds that a test moves on."""

    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return tmp_path / "log"


def append(log: Path, *lines: str) -> None:
    with log.open("a") as file:
        file.writelines(f"{line}\n" for line in lines)


def reader_of(log: Path, clock: Clock, own: Family | None = None) -> ProgressReader:
    return ProgressReader(OutputReader(log), own, 0.0, clock=clock)


@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: family.name)
def test_every_family_finds_itself_in_its_sample(family: Family, log: Path):
    clock = Clock()
    reader = reader_of(log, clock)
    append(log, *SAMPLES[family.name])
    append(log, *SAMPLES[family.name])
    lines = reader.new()
    assert reader.family is family
    assert lines[-1]["env_steps"] == 6400
    if family.name != "skrl (tqdm)":  # Prints no return.
        assert lines[-1]["metric"] == 12.5


_ASYNC = {
    **{"async/pps": 9e4, "async/ttop": 8e4, "async/staleness_mean": 1.5},
    **{"channel/occupancy": 0.5, "channel/bytes_per_s": 1.2e8},
}


@pytest.mark.parametrize(
    ("more", "rate"), [({"env_steps_per_s": 98269.0}, 98269.0), (_ASYNC, None)]
)
def test_what_gmijax_prints_is_read(more: dict[str, float], rate: float | None):
    lines, printed = [{"env_steps": 6400, "return": 12.5, **more}], io.StringIO()
    console = Console(file=printed, width=300)
    with ConsoleProgress(console, lambda: [lines.pop()] if lines else [], 20_000) as progress:
        progress.update([])
    (family,) = (family for family in FAMILIES if family.name == "gmijax")
    found = [report for line in printed.getvalue().splitlines() if (report := family.read(line))]
    assert found == [Report(steps=6400.0, rate=rate, metric=12.5)]


@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: family.name)
def test_rates_are_steps_by_the_own_clock(family: Family, log: Path):
    clock = Clock()
    reader = reader_of(log, clock)
    for number in range(8):
        clock.now_s = 10.0 * number
        append(log, *(text.replace("6400", str(6400 * number)) for text in SAMPLES[family.name]))
        lines = reader.new()
    assert lines[-1]["env_steps_per_s"] == pytest.approx(640.0)


def test_rates_alone_are_added_up(log: Path):
    clock = Clock()
    reader = reader_of(log, clock, own_patterns(r"speed (\d+)", None, None))
    for number in range(4):
        clock.now_s = 2.0 * number
        append(log, "speed 100")
        lines = reader.new()
    assert lines[-1] == {"env_steps": 600, "env_steps_per_s": 100.0}


def test_a_mean_since_the_start_is_not_taken_for_the_rate_of_the_moment(log: Path):
    clock = Clock()
    reader = reader_of(log, clock)
    # 1,000 steps/s for ten seconds, then 100: CleanRL goes on printing several hundred.
    steps = 0
    for second in range(1, 41):
        steps += 1000 if second <= 10 else 100
        clock.now_s = float(second)
        append(log, f"SPS: {steps // second}")
        lines = reader.new()
    assert lines[-1]["env_steps_per_s"] == pytest.approx(100, abs=15)


def test_steps_that_fall_are_those_of_another_run_of_the_same_job(log: Path):
    clock = Clock()
    reader = reader_of(log, clock, own_patterns(None, r"steps=(\d+)", None))
    found = []
    for steps in (100, 200, 50, 150):
        clock.now_s += 1
        append(log, f"steps={steps}")
        found.append(reader.new()[-1]["env_steps"])
    assert found == [100, 200, 250, 350]


def test_a_metric_that_is_no_number_is_left_out(log: Path):
    clock = Clock()
    reader = reader_of(log, clock, own_patterns(None, r"steps=(\d+)", r"reward=(\S+)"))
    append(log, "reward=nan", "steps=1")
    assert "metric" not in reader.new()[-1]


def test_own_expressions_are_read_beside_a_known_patterns(log: Path):
    reader = reader_of(log, Clock(), own_patterns(None, None, r"success (\d\.\d)"))
    append(log, "success 0.5", "SPS: 100", "SPS: 100")
    assert reader.new()[-1]["metric"] == 0.5


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("fps", "has 0 groups; expected one"),
        ("(a)(b)", "has 2 groups"),
        ("(", "no regular expression"),
    ],
)
def test_an_expression_needs_one_group(text: str, message: str):
    with pytest.raises(ConfigError, match=f"pack.rate=.*{message}"):
        own_patterns(text, None, None)


@pytest.mark.parametrize(
    "text", [r"\(fps\) (\d+)", r"(?:speed|fps) (\d+)", r"fps (?P<x>\d+)", r"(?i)FPS (\d+)"]
)
def test_the_group_is_found_wherever_it_stands(text: str):
    family = own_patterns(text, None, None)
    assert family is not None
    report = family.read("(fps) 12") or family.read("fps 12")
    assert report is not None
    assert report.rate == 12


def test_output_is_split_at_carriage_returns_and_freed_of_escape_codes(log: Path):
    log.write_bytes(b"\x1b[1mbold\x1b[0m\r\x1b]0;title\x07 10%\r\xff\xfe\n\nrest")
    reader = OutputReader(log)
    assert reader.new() == ["bold", " 10%", "\ufffd\ufffd"]
    with log.open("ab") as file:
        file.write(b" of it\n")
    assert reader.new() == ["rest of it"]


def test_long_lines_are_cut_and_fast_output_is_skipped(log: Path):
    log.write_bytes(b"x" * 100_000 + b"\n" + b"y" * (3 << 20) + b"\nlast\n")
    lines = OutputReader(log).new()
    assert lines[-1] == "last"
    assert max(map(len, lines)) <= LONGEST_LINE


def test_a_log_that_was_cut_is_read_from_its_start(log: Path):
    reader = OutputReader(log)
    log.write_text("one\ntwo\n")
    assert reader.new() == ["one", "two"]
    log.write_text("new\n")
    assert reader.new() == ["new"]


def test_a_text_that_is_no_number_says_nothing(log: Path) -> None:
    own = own_patterns(None, r"step (\S+)", r"reward: (-?[\d.]+)")
    reader = reader_of(log, Clock(), own)
    log.write_text("step n/a\nstep nan\nstep 1,000 reward: ...\nstep 2000 reward: 3.5.\n")
    lines = reader.new()
    assert [line["env_steps"] for line in lines] == [1000, 2000]
    assert lines[-1]["metric"] == 3.5


def test_all_own_expressions_and_the_family_read_the_same_line(log: Path) -> None:
    reader = reader_of(log, Clock(), own_patterns(None, r"step (\d+)", r"reward: (\S+)"))
    log.write_text("step 100 reward: 3.2\n")
    assert reader.new()[0]["metric"] == 3.2
    reader = reader_of(log, Clock(), own_patterns(None, None, r"episodic_return=(\S+)"))
    log.write_text("global_step=64, episodic_return=1.5\nglobal_step=128, episodic_return=2.5\n")
    assert [(one["env_steps"], one["metric"]) for one in reader.new()][-1] == (128, 2.5)


def test_a_bar_of_something_else_does_not_hide_a_trainer(log: Path) -> None:
    reader = reader_of(log, Clock())
    bar = "load: 3/10 [00:00<00:01, 5.12it/s]\n"
    log.write_text(bar * 3)
    reader.new()
    table = "|    total_timesteps | {} |\n"
    log.write_text(bar * 3 + "".join(table.format(512 * k) for k in range(1, 4)))
    steps = [line["env_steps"] for line in reader.new()]
    assert steps[-1] == 3 * 512
