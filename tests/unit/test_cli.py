"""Command lines: what is refused, in one line and with exit code 2, and what is not."""

from __future__ import annotations

import os
import re
import shlex
from functools import partial
from pathlib import Path

import pytest
from command_lines import run

import gmijax
from gmijax.cli.command import command
from gmijax.cli.compose import compose, defaults
from gmijax.cli.grid import SweepHelp, build_sweep
from gmijax.cli.groups import choices
from gmijax.cli.help import USUAL, keys_of, print_help, topics_of
from gmijax.cli.pack import PackKeys
from gmijax.config import ExportConfig, PlayConfig, ServeConfig, TrainConfig
from gmijax.control.console import Show, open_console
from gmijax.errors import ConfigError

LONG = "a" * 300
COMMANDS = {
    **dict.fromkeys(("train", "search"), TrainConfig),
    **{"serve": ServeConfig, "sweep": SweepHelp, "pack": PackKeys},
    **{"play": PlayConfig, "export": ExportConfig},
}
A3C = "algo=a3c"
APART = "plan.serving_gpus, plan.training_gpus: GPUs [1] both act and train and others"

REFUSED: list[tuple[str, str, str]] = [
    # Keys and options that are not there.
    ("train", "env=antt", "env=antt: unknown task: did you mean ant?"),
    ("train", "env=ANT", "env=ANT: unknown task: did you mean ant?"),
    ("train", "ANT", "ANT: expected key=value; did you mean env=ant?"),
    ("TRAIN", "", "gmijax: unknown command 'TRAIN': did you mean train?"),
    ("play", "--help RUN", "--help RUN: no such topic: did you mean run?"),
    ("train", "run.resume=AUTO", "run.resume=AUTO: no such folder; did you mean auto?"),
    ("play", "run.dir=LAST", "run.dir=LAST: no such folder; did you mean last?"),
    ("train", "env=brax:ant", "unknown task: did you mean env=brax env.name=ant?"),
    ("sweep", "env=playground:Go1Getup", "did you mean env=playground env.name=Go1Getup?"),
    ("train", "algo=td3", "algo=td3: unknown algorithm: expected one of a3c, distill, ppo, sac"),
    ("train", "num_env=3", "unknown key num_env: did you mean num_envs?"),
    ("train", "algo.gamma=0.9", "unknown key algo.gamma: did you mean algo.discounting?"),
    ("train", "algo.rate=1", "unknown key algo.rate: did you mean algo.learning_rate?"),
    ("train", "run.checkpoint_interval=9", "_interval: did you mean run.checkpoint_every?"),
    ("train", "hidden_sizes=[8]", "_sizes: did you mean algo.policy_hidden_layer_sizes?"),
    ("train", "algo.num_layers=2", "_layers: did you mean algo.policy_hidden_layer_sizes?"),
    ("train", "algo.zzz=2", "unknown key algo.zzz: see --help all"),
    ("train", "algo=sac algo.entropy_cost=1", "algo.entropy_cost: it is a key of algo=ppo, a3c\n"),
    ("train", "algo.tau=1", "algo.tau: did you mean algo.target_rate, a key of algo=sac?"),
    ("train", "algo.activ=relu", "unknown key algo.activ: did you mean algo.activation?"),
    ("train", "algo.zeta=1", "unknown key algo.zeta: see --help all\n"),
    ("train", "cluster.node=1", "unknown key cluster.node: did you mean cluster.nodes?"),
    ("train", "cluster.rest=1", "unknown key cluster.rest: see --help all\n"),
    ("train", "rundir=x", "unknown key rundir: did you mean run.dir?"),
    ("train", "ent=ant", "unknown key ent: did you mean env?"),
    ("train", "--num-envs=64", "unknown option --num-envs=64; allowed: --help, --verbose, "),
    ("train", "--num-envs=64", "; did you mean num_envs=64?"),
    ("train", "--num_envs 64", "; did you mean num_envs=64?"),
    ("export", "--json run.dir=X", "--help, --verbose, --cfg job, key=value\n"),
    ("train", "env=ant --cfg", "gmijax.train: --cfg: expected --cfg job\n"),
    ("train", "--cfg env=ant", "gmijax.train: --cfg: expected --cfg job\n"),
    ("train", "--cfg all", "gmijax.train: --cfg all: expected --cfg job\n"),
    ("list-envs", "--json x", "gmijax.list_envs: unknown argument --json; allowed: --help\n"),
    ("demo", "env=ant --json", "gmijax.demo: unknown option --json; allowed: --help, key=value\n"),
    ("--json", "", "gmijax: unknown option --json; allowed: --help, --version, -sc, "),
    ("list-envs", "x", "gmijax.list_envs: unknown argument x; allowed: --help\n"),
    ("pack", "seed= -- true {seed}", "seed=: must not be empty\n"),
    ("sweep", "--seed 1 --quiet", "unknown option --seed; allowed: --help, --verbose, "),
    ("train", "seed=0,1", "(a list stands in brackets); gmijax sweep takes several"),
    ("train", "seed = 3", "seed = 3: remove the space: seed=3"),
    ("sweep", "env=ant seed= 3", "seed= 3: remove the space: seed=3"),
    ("play", "env =ant", "env =ant: remove the space: env=ant"),
    ("train", "=3 seed=4", "=3: expected key=value"),
    ("sweep", "seed=0:3", "for several: gmijax sweep seed=0,1,2 or 'seed=range(0,3)'"),
    ("train", "num_envs=8-99", "sweep num_envs=8,9,10,... or 'num_envs=range(8,100)'"),
    ("sweep", "sweep.trials=1:3", "sweep.trials=1:3: expected an integer or null\n"),
    ("train", "lr=1", "unknown key lr: did you mean algo.learning_rate?"),
    ("train", "total_timesteps=1", "unknown key total_timesteps: did you mean num_timesteps?"),
    (
        "train",
        "plan.unroll_lenght=8",
        "unknown key plan.unroll_lenght: did you mean algo.unroll_length?",
    ),
    ("play", "lr=1", "unknown key lr; allowed:"),
    ("train", "sh", "sh: expected key=value\n"),
    ("pack", "seed=0,1 sh", "sh: expected key=value; a command to run comes after --"),
    ("train", "+foo.bar=1", "unknown key foo"),
    ("train", "plan.xyzzy=1", "unknown key plan.xyzzy: see --help all"),
    ("train", "hydra.run.dir=x", "unknown key hydra.run.dir: did you mean run.dir?"),
    (
        "train",
        "--quiet",
        "unknown option --quiet; allowed: --help, --verbose, --cfg job, key=value",
    ),
    ("train", "ant", "ant: expected key=value; did you mean env=ant?"),
    ("train", "humanod", "humanod: expected key=value; did you mean env=humanoid?"),
    ("train", "a3c", "a3c: expected key=value; did you mean algo=a3c?"),
    ("train", "hepl", "hepl: expected key=value; did you mean --help?"),
    ("train", "mine.py:make", "did you mean env=mine.py:make?"),
    ("play", "last", "last: expected key=value; did you mean run.dir=last?"),
    ("train", "nothing-like-it", "nothing-like-it: expected key=value\n"),
    # Below a list, a value, a group.
    ("train", "algo.policy_hidden_layer_sizes.first=64", "unknown key algo.policy_hidden_layer_"),
    ("train", "algo.policy_hidden_layer_sizes.9=64", "_sizes.9: did you mean algo.policy_hidden"),
    ("train", "env.randomization.body_mass.range.x=1", "unknown key env.randomization.body_mass"),
    ("serve", "policy=random plan.layout.a.b=1", "unknown key plan.layout.a.b: did you mean"),
    ("train", "seed.x=1", "unknown key seed.x: did you mean seed?"),
    ("train", "algo.name=[a]", "algo.name=['a']: expected one of ppo, a3c"),
    ("train", "algo.name={a:1}", "algo.name={'a': 1}: expected one of ppo, a3c"),
    ("train", "~plan=nan", "~plan=nan: expected ~plan"),
    ("train", "~env", "~env: a job needs one; choose it with env=NAME"),
    ("train", "~env=ant", "~env=ant: a job needs one; choose it with env=NAME"),
    ("train", "~algo", "~algo: a job needs one; choose it with algo=NAME"),
    ("serve", "policy=random output.shards=1", "unknown key output.shards"),
    (
        "serve",
        "policy=random cluster.engine=ray",
        "cluster.engine: this command is for one machine",
    ),
    ("play", "vidoe=gif", "unknown key vidoe: did you mean video?"),
    ("play", "env.name=ant", "env.name: this command takes the task"),
    ("play", "env=ant", "env=ant: not needed, a run knows its task; to play the policy that"),
    ("play", "env=antt checkpoint=shipped", "env=antt: no policy of it is shipped"),
    ("export", "env=ant", "env: this command takes the task and the policy"),
    ("export", "run.env=ant", "env=ant: not needed, a run knows its task\n"),
    ("export", "run.dir=x tuned=ant_ppo", "unknown key tuned; allowed: checkpoint"),
    # Values of a wrong type, or out of range.
    ("train", "num_envs=many", "num_envs=many: expected an integer"),
    ("train", "num_timesteps=30M", "num_timesteps=30M: expected an integer; did you mean 30e6?"),
    ("train", "num_envs=2k", "num_envs=2k: expected an integer or auto; did you mean 2e3?"),
    ("train", "run.grace_s=1k", "run.grace_s=1k: expected a finite number; did you mean 1e3?"),
    ("train", "num_envs=0", "num_envs=0: must be at least 1"),
    ("train", "num_envs=3 algo.unroll_length=1", "do not divide into algo.num_minibatches=4"),
    ("train", "seed=range(1,3)", "seed=range(1,3): expected one value"),
    ("train", "plan.gpus=0,1", "plan.gpus=0,1: expected one value (a list "),
    ("train", "run=null", "run=null: expected a group of keys"),
    ("play", "run.dir=true", "run.dir=true: expected text or null"),
    ("serve", "run.dir=true", "run.dir=true: expected text or null"),
    ("train", "run.resume=false", "run.resume=false: expected text or null"),
    ("search", "run.resume=true", "run.resume=true: expected text or null"),
    ("train", "run.resume=5.5", "run.resume=5.5: expected text or null"),
    ("train", "num_envs=true", "num_envs=true: expected an integer or auto"),
    ("play", "video=true", "video=true: expected one of auto, mp4"),
    ("train", "run.dir={1:2}", "run.dir={1: 2}: expected text or null"),
    ("train", "algo.learning_rate=inf", "algo.learning_rate=inf: expected a finite number"),
    ("train", "algo.desired_kl=nan", "algo.desired_kl=nan: expected a finite number"),
    ("train", "algo.learning_rate=1", "must be between 1e-05 and 0.01 with algo.learning_rate_s"),
    ("train", "run.max_restarts=-1", "run.max_restarts=-1: must be at least 0"),
    ("train", "run.keep_checkpoints=0", "run.keep_checkpoints=0: must be at least 1"),
    ("train", "eval.every=0", "eval.every=0: must be at least 1"),
    ("train", "eval.episodes=0", "eval.episodes=0: must be at least 1"),
    ("train", f"{A3C} eval.every=100", "eval.every=100: with algo=a3c agents act all the time,"),
    ("train", "run.stop_timeout_s=0", "run.stop_timeout_s=0.0: must be greater than 0"),
    ("serve", "policy=random num_envs=0", "num_envs=0: must be at least 1"),
    ("serve", "policy=random latency_steps=-1", "latency_steps=-1: must be between"),
    ("serve", "policy=clever", "policy=clever: expected one of trained, random"),
    ("view", "env=ant", "env=ant: not needed, a run knows its task; to play the policy that"),
    ("view", "checkpoint=shipped", "of which task? Add env=TASK"),
    ("view", "num_envs=0", "num_envs=0: must be between 1 and 64"),
    ("view", "view.port=70000", "view.port=70000: must be between 0 and 65535"),
    ("view", "view.allow_origin=[hub]", "'hub' is no origin; expected e.g. https://"),
    ("view", "view.host=''", "view.host=: must not be empty"),
    *(
        (command, f"{words} run.dir=", "run.dir=: must not be empty")
        for command, words in (
            *(("train", ""), ("search", ""), ("play", ""), ("export", ""), ("view", "")),
            *(("serve", "policy=random"), ("sweep", "seed=0,1"), ("pack", "pack.copies=2")),
        )
    ),
    ("train", "run.resume=", "run.resume=: must not be empty"),
    ("train", "run.resume=auto run.name=x run.dir=''", "run.dir=: must not be empty"),
    ("train", "wandb.group=", "wandb.group=: must not be empty"),
    ("serve", "policy=random output.dir=", "output.dir=: must not be empty"),
    ("train", "algo.=1", "algo.=1: a name is missing before or after a dot of the key"),
    ("train", "run.name=../x", "run.name=../x: expected a name below runs/"),
    ("train", "run.name=.", "run.name=.: expected a name below runs/"),
    ("train", "run.name=5.5 run.resume=auto", "run.name=5.5: expected text"),
    ("serve", "policy=random run.name=/x", "run.name=/x: expected a name below runs/"),
    ("sweep", "run..dir=x", "run..dir=x: a name is missing before or after a dot of the key"),
    ("view", "run.dir=nowhere", "run.dir=nowhere: no such folder"),
    ("play", "video=avi", "video=avi: expected one of auto, mp4"),
    ("play", "num_envs=2 video_envs=3", "video_envs=3: must be between 1 and 2"),
    ("export", "format=pt", "format=pt: expected one of onnx, stablehlo, all"),
    # Tasks.
    ("train", "env=ant,ball_balance", "env=ant,ball_balance: expected one value"),
    ("train", "env.name=ant", "env.name=ant: choose the task with env=ant"),
    ("train", "env=ball_balance env.name=ant", "choose the task with env=ant"),
    ("train", "env=brax", "env.name: must be given with env=brax, e.g. env.name=ant"),
    ("train", "env=nowhere.py:make", "env=nowhere.py:make: no such file"),
    *(
        (command, f"env={name}", f"env={name}: expected PATH.py:FUNCTION, e.g. path/to/cart.py:m")
        for command in ("train", "sweep", "play", "export", "view")
        for name in ("base/config.json:make", "cart:make", "cart.pyc", "./cart")
    ),
    ("train", "env=nowhere.py", "env=nowhere.py: expected PATH.py:FUNCTION"),
    ("train", f"env={LONG}.py:f", "a.py:f: no such file"),
    ("train", "env=ant env.randomize=maybe", "env.randomize=maybe: expected one of off, on, epi"),
    ("train", "env=ant env.randomization.body_mass.range=[2,1]", "expected [lowest, highest]"),
    ("train", "env=ant env.randomization.body_mass.operation=x", "expected one of scale, add"),
    ("train", "env=ant +env.randomization.body_mas={operation:set,range:[1,2]}", "body_mass?"),
    # Plans and reductions.
    ("train", "plan.backend=mps", "plan.backend=mps"),
    ("train", "plan.backend=mig", "plan.backend=mig"),
    ("train", "plan.backend=share", "plan.backend=share"),
    ("train", "plan.backend=fpga", "expected one of auto, mps, mig, share, cpu"),
    ("train", "plan.gpus=0", "plan.gpus=0: must be at least 1"),
    ("train", "plan.gpus=1e6", "plan.gmis_per_gpu=1: makes 1000000 GMIs on 1000000 GPUs"),
    ("train", "plan.gpus=100 plan.gmis_per_gpu=11", "at most 1024 are allowed"),
    ("train", f"{A3C} plan.gpus=100 plan.serving_gmis_per_gpu=11", "at most 1024 are allowed"),
    ("train", f"{A3C} plan.training_gpus=1e9", "at most 1024 are allowed"),
    ("train", "plan.layout=[[0,2]]", "GMI ids must be 0 to 1"),
    ("train", "reduce.strategy=telepathy", "expected one of auto, paper"),
    ("train", "reduce.strategy=mrr plan.layout=[[0,1],[2]]", "cannot run on layout [[0,1],[2]]"),
    ("train", "reduce.strategy=mrr plan.gmis_per_gpu=2", "mrr: cannot run on layout [[0,1]]: its"),
    ("train", "reduce.strategy=flat plan.gmis_per_gpu=2", "NCCL before 2.30"),
    # What is changed about a task.
    ("train", "env=ant env.rewards.enrgy=1", "env.rewards.enrgy: did you mean energy?"),
    ("train", "env=anymal env.rewards.x=1", "env.rewards.x; allowed: torque, velocity, y"),
    ("train", "env=brax env.name=ant env.rewards.x=1", "x: this task has none in env.rewards"),
    *(
        (command, key, "this command takes the task and the policy as the run was trained")
        for command in ("play", "export", "view")
        for key in (
            "env.rewards.spin=-0.01",
            "env.episode_length=5",
            "env.settings.x=1",
            "algo=ppo",
        )
    ),
    ("play", "env.randomize=on", "unknown key env.randomize: did you mean randomize?"),
    ("train", "env=ant env.rewards.energy=low", "env.rewards.energy=low: expected a finite num"),
    ("train", "env=ant env.settings.goal_m=1", "unknown key env.settings.goal_m; allowed:"),
    ("train", "env=ant +env.settings.goal_m=1", "unknown key env.settings.goal_m; allowed:"),
    ("serve", "env=anymal env.settings.action_scale_rad=0 policy=random", "=0.0: must be greater"),
    ("train", "env=anymal env.settings.start_factor_min=2", "min=2.0: must be at most env.set"),
    ("train", "env=ant env.curriculum=on", "env.curriculum=on: ant has none; allowed: anymal"),
    ("train", "env.history=0", "env.history=0: must be at least 1"),
    ("train", "env.action_repeat=0", "env.action_repeat=0: must be at least 1"),
    ("serve", "policy=random plan.template=tcg_ex", "not for gmijax.serve; allowed: auto, tcg"),
    ("serve", "policy=random plan.template=tgc", "plan.template=tgc: expected one of auto, tcg"),
    # Folders and policies.
    ("train", "run.dir=.", "the run folder exists already"),
    ("train", "run.resume=nowhere", "run.resume=nowhere: no such folder"),
    ("train", "run.resume=last", "no run with a checkpoint"),
    ("train", "run.resume=auto", "run.resume=auto: needs run.dir or run.name, the folder to co"),
    ("serve", "run.dir=nowhere", "run.dir=nowhere: no such folder"),
    ("serve", "", "run.dir=last: no run with a checkpoint in runs/"),
    ("serve", "run.dir=null", "policy=trained: needs run.dir=RUN"),
    ("serve", "policy=random deterministic=true", "random actions have no mean"),
    ("play", "run.dir=nowhere", "run.dir=nowhere: no such folder"),
    ("export", "run.dir=nowhere", "run.dir=nowhere: no such folder"),
    ("export", "checkpoint=nowhere", "checkpoint=nowhere: expected the folder of a checkpoint"),
    # Searches.
    ("search", "num_envs=64 plan.gmis_per_gpu=2", "nothing to search for; make one of them auto"),
    ("search", "search.gmis_per_gpu=[2,2]", "search.gmis_per_gpu=[2, 2]: expected distinct"),
    ("search", "search.num_envs=[]", "search.num_envs=[]: expected at least one number\n"),
    ("search", "search.gmis_per_gpu=[]", "search.gmis_per_gpu=[]: expected at least one number\n"),
    ("search", "search.num_envs=[0]", "search.num_envs=0: must be at least 1"),
    ("search", "search.impls=[cuda]", "search.impls=cuda: expected one of jax, warp"),
    ("search", "search.budget_s=2", "search.budget_s=2: too small for one profile"),
    ("search", "plan.backend=mps", "plan.backend=mps"),
    (
        "search",
        "plan.template=tdg_ex",
        "not for a search (numbers that are auto); allowed: auto, tcg_ex",
    ),
    ("search", "plan.layout=[]", "plan.layout=[]: every GPU needs at least one GMI"),
    ("search", f"{A3C} plan.serving_gpus=[0,1] plan.training_gpus=[1]", APART),
    ("search", f"{A3C} plan.serving_gmis_per_gpu=3", "give search.gmis_per_gpu=[3], or"),
    ("search", f"{A3C} plan.gmis_per_gpu=4", "plan.gmis_per_gpu=4: with the decoupled template"),
    ("search", f"{A3C} plan.serving_gpus=1", "plan.training_gpus=null: there must be serving"),
    ("search", f"{A3C} plan.layout=[[0],[1]]", "plan.layout=[[0], [1]]: with the decoupled"),
    # What is hardly a command line.
    ("train", "-env=\n", "unknown option -env=\\n; allowed"),
    ("train", "\r", r"'\r': expected text without control characters"),
    ("train", "run.name=lr=3e-4", "run.name=lr=3e-4: not a value; text with such characters"),
    ("train", "run.dir=runs/(v2)", """needs quotes: "run.dir='runs/(v2)'\""""),
    ("train", "run.dir='a", """a quote is missing; text in quotes: "run.dir='a'\"\n"""),
    ("play", 'run.dir="a', """a quote is missing; text in quotes: "run.dir='a'\"\n"""),
    ("train", "run.name=a'", """a quote is missing; text in quotes: "run.name='a'\"\n"""),
    ("train", "run.dir=it's", """needs quotes: "run.dir='it\\'s'\"\n"""),
    ("play", "run.dir=a[b", """needs quotes: "run.dir='a[b'\""""),
    (
        "train",
        "run.name=ünder",
        """run.name=ünder: not a value; text with such characters needs""",
    ),
    ("train", "run.name=int([)", "run.name=int([): not a value"),
    ("train", "seed=int(x)", "seed=int(x): while evaluating 'int(x)': invalid literal"),
    ("train", "é=1", "é=1: expected key=value"),
    (
        "train",
        f"search.num_envs=[{','.join('1' * 3000)}]",
        "search.num_envs: 3000 values; at most",
    ),
    ("train", "run.name=a\nb", "expected text without control characters"),
    ("train", "run.dir=a\0b", "expected text without control characters"),
    ("train", "run.dir=\udcff", r"'run.dir=\udcff': expected text without control"),
    ("train", "+=-0.0", "+=-0.0: expected key=value"),
    ("train", f"seed={'9' * 5000}", "a number has too many digits"),
    ("train", f"seed={'[' * 3000}{']' * 3000}", "nested too deeply"),
    ("train", f"{LONG}=1", "aaa=1: File name too long"),
    ("train", f"{LONG}/x=1", "aaa/x=1: File name too long"),
    ("train", f"run.resume={LONG}", "aaa: no such folder"),
    ("train", f"run.resume=auto run.dir={LONG}", "aaa: cannot make the folder (File name too lo"),
    ("serve", f"run.dir={LONG}", "aaa: no such folder"),
    ("play", f"checkpoint={LONG}", "aaa: expected the folder of a checkpoint"),
    ("play", f"checkpoint='{'9' * 5000}'", "999: expected the folder of a checkpoint"),
]


@pytest.mark.parametrize(
    ("command", "key"),
    [*((one, "run.dir") for one in ("play", "export", "view", "serve")), ("train", "run.resume")],
)
def test_a_file_in_place_of_a_run_folder_is_refused_as_no_folder(
    command: str, key: str, tmp_path: Path
) -> None:
    (tmp_path / "policy.npz").write_text("x")
    (tmp_path / "policy").mkdir()
    done = run(command, f"{key}=policy.npz", cwd=tmp_path)
    assert done.stderr == f"gmijax.{command}: {key}=policy.npz: is not a folder\n"
    assert done.code == 2


@pytest.mark.parametrize(
    ("word", "hint"),
    [
        ("ball", "; did you mean run.dir=runs/ball?"),
        ("here", "; did you mean run.dir=here?"),
        ("ant", "; did you mean env=ant?"),
        ("..", ""),
        (LONG, ""),
    ],
)
def test_a_word_that_names_a_run_is_taken_for_it(word: str, hint: str, tmp_path: Path) -> None:
    for name in ("ball", "ant"):
        (tmp_path / "runs" / name).mkdir(parents=True)
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "config.json").write_text("{}")
    done = run("play", word, cwd=tmp_path)
    assert done.stderr == f"gmijax.play: {word}: expected key=value{hint}\n"


@pytest.mark.parametrize(("command", "line", "message"), REFUSED)
def test_bad_input_is_one_line_and_starts_nothing(
    command: str, line: str, message: str, tmp_path: Path
):
    done = run(command, *filter(None, line.split(" ")), cwd=tmp_path)
    assert done.code == 2, done.stderr
    assert message in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert done.stdout == ""
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("text", ["run.dir=~/x", "run.dir='~/x'", 'run.dir="~/x"'])
def test_the_home_folder_is_no_folder_of_that_name(text: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("HOME", "/home/it's (one)")
    assert compose(text).run.dir == "/home/it's (one)/x"
    assert compose("env=~/task.py:make").env.name == "/home/it's (one)/task.py:make"


@pytest.mark.parametrize(
    "value",
    [
        *("lr=3e-4,h=64", "runs/(v2)", "ünder", "it's", "a\\'b", "[1", "$HOME's", "`(x", 'a"[b'),
        *("a\\\\'b", "(it's!", "'a' b", "\\$(x)", '"a" b', "(\\"),
    ],
)
def test_text_in_quotes_is_taken_as_the_message_says(value: str):
    with pytest.raises(ConfigError, match="needs quotes: ") as refused:
        compose(f"run.name={value}")
    (quoted,) = shlex.split(str(refused.value).partition("needs quotes: ")[2])
    assert compose(quoted).run.name == value


def test_a_value_may_be_empty_or_begin_with_a_blank():
    assert compose("run.name=", "env=ant").env.name == "ant"
    assert compose("run.name= a").run.name == "a"
    with pytest.raises(ConfigError, match=r"remove the space: seed=3$"):
        compose("seed = 3")


@pytest.mark.parametrize("value", ["a\nb", os.fsdecode(b"a\xffb")])
def test_what_the_environment_has_is_text_too(value: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("A_NAME", value)
    with pytest.raises(ConfigError, match=r"^'run\.name=a.*b': expected text without"):
        compose("run.name=${oc.env:A_NAME}")


def test_a_task_may_be_named_twice_and_a_plan_may_have_1024_gmis():
    assert compose("env=ant", "env.name=ant") == compose("env=ant")
    assert compose("plan.gpus=1024").plan.gpus == 1024


@pytest.mark.parametrize(
    ("name", "line", "is_named"),
    [
        ("train", "num_envs=8", True),
        ("train", "run.resume=auto run.dir=x", True),
        ("train", "env=ball_balance", False),
        ("sweep", "seed=0,1", True),
        ("sweep", "env=ball_balance,ant", False),
        ("serve", "policy=random", True),
        ("serve", "policy=random env=ant", False),
    ],
)
def test_a_task_that_nobody_chose_is_named_first(
    name: str, line: str, is_named: bool, capsys: pytest.CaptureFixture[str]
):
    def say(_: object, *, show: Show) -> None:
        console = open_console(show=show)
        console.print("run folder: x")
        console.print("more")

    make = build_sweep if name == "sweep" else None
    assert command(name, COMMANDS[name], say, line.split(), make=make) == 0
    *first, folder, more = capsys.readouterr().out.splitlines()
    assert [folder, more] == ["run folder: x", "more"]
    named = "task: ball_balance, the default; choose another with env=NAME (gmijax list-envs shows"
    assert first == ([f"{named} them)"] if is_named else [])


def test_help_lists_every_key(capsys: pytest.CaptureFixture[str]):
    assert command("train", TrainConfig, gmijax.train, ["--help", "all"]) == 0
    output = capsys.readouterr().out
    assert "more keys" not in output
    for key in ("num_envs", "plan.gmis_per_gpu", "algo.learning_rate", "run.resume", "seed"):
        assert f"\n{key} " in output
    assert output.index("\nnum_envs ") < output.index("\nenv.name ")
    assert command("play", PlayConfig, gmijax.train, ["num_envs=4", "-h"]) == 0


def test_help_shows_the_usual_keys_or_those_of_a_topic(capsys: pytest.CaptureFixture[str]):
    assert command("train", TrainConfig, gmijax.train, ["--help"]) == 0
    output = capsys.readouterr().out
    assert len([line for line in output.splitlines() if re.match(r"[a-z_]+(\.|  )", line)]) < 30
    for key in ("num_envs", "algo.learning_rate", "run.resume", "eval.every"):
        assert f"\n{key} " in output
    assert "more keys: gmijax train --help TOPIC, of algo," in output
    assert command("train", TrainConfig, gmijax.train, ["--help", "plan"]) == 0
    output = capsys.readouterr().out
    assert "\nplan.template " in output
    assert "\nrun.dir " not in output
    assert command("train", TrainConfig, gmijax.train, ["--help", "plam"]) == 2
    assert "--help plam: no such topic: did you mean plan?" in capsys.readouterr().err


@pytest.mark.parametrize("name", COMMANDS)
@pytest.mark.parametrize("topic", [None, "all"])
def test_help_fits_eighty_columns(
    name: str,
    topic: str | None,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    monkeypatch.setenv("COLUMNS", "80")
    print_help(name, COMMANDS[name], partial(defaults, name), choices, topic)
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 80


@pytest.mark.parametrize("name", COMMANDS)
def test_every_topic_of_every_command_has_help(name: str, capsys: pytest.CaptureFixture[str]):
    for topic in topics_of(COMMANDS[name]):
        print_help(name, COMMANDS[name], partial(defaults, name), choices, topic)
        output = capsys.readouterr().out
        assert topic == "all" or f"\n{topic}." in output


def test_every_usual_key_is_one_of_a_command():
    commands = {"train": TrainConfig, "serve": ServeConfig, "sweep": SweepHelp}
    named = {
        key.name for name, cls in commands.items() for key in keys_of(cls, partial(defaults, name))
    }
    assert set(USUAL) <= named


def test_cfg_job_prints_the_composed_configuration(capsys: pytest.CaptureFixture[str]):
    line = ["--cfg", "job", "env=ant", "num_timesteps=30e6"]
    assert command("train", TrainConfig, gmijax.train, line) == 0
    output = capsys.readouterr().out
    assert "num_timesteps: 30000000" in output
    assert "name: ant" in output
