"""The pages of the reference, made from the code: keys of every command, names of the package.

Needs neither jax nor mujoco, so that the site is built without them.
"""

from __future__ import annotations

import re
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

import gmijax
from gmijax import demo, doctor, list_envs
from gmijax.cli.answers import COMMANDS
from gmijax.cli.compose import defaults
from gmijax.cli.groups import choices
from gmijax.cli.help import HelpKey, keys_of, usage_of

DOCS: Final = Path(__file__).parent

LIKE_TRAIN: Final = ("search", "sweep")
"""Commands with the keys of `train`; their pages show only what differs."""

USAGES: Final = {"demo": demo.USAGE, "list-envs": list_envs.USAGE, "doctor": doctor.USAGE}
"""What the commands without a configuration print on `--help`."""

EXAMPLES: Final[Mapping[str, str]] = {
    "train": """\
gmijax train env=ant num_timesteps=30e6
gmijax train env=ant run.dir=runs/ant run.resume=auto    # continues, or starts
gmijax train env=ant --cfg job                           # prints the configuration""",
    "search": """\
gmijax search env=ant
gmijax search env=ant 'search.impls=[jax,warp]'""",
    "sweep": """\
gmijax sweep env=ant seed=0,1,2,3 algo.learning_rate=1e-4,3e-4 run.dir=runs/rates
gmijax sweep env=ant 'seed=range(8)' sweep.jobs_per_gpu=8 sweep.pack=auto""",
    "pack": """\
gmijax pack seed=0,1,2,3 -- python train.py --seed {seed}
gmijax pack pack.copies=8 -- wandb agent ENTITY/PROJECT/ID""",
    "serve": """\
gmijax serve run.dir=last num_envs=8192 num_timesteps=50e6 output.dir=data/ant
gmijax serve env=ant policy=random""",
    "view": """\
gmijax view run.dir=last
gmijax view run.dir=runs/ant checkpoint=best num_envs=9""",
    "play": """\
gmijax play                                  # the last run
gmijax play run.dir=runs/ant checkpoint=best video_envs=4""",
    "export": """\
gmijax export run.dir=last
gmijax export run.dir=runs/ant checkpoint=best format=onnx""",
}
"""What somebody would type, at the head of each command's page."""


class Topic(NamedTuple):
    """A part of a page of keys.

    Attributes:
      title: its heading.
      guide: the document that explains the keys, below `docs/`; empty: none.
      example: a command that uses some of them, for the page of `gmijax train`.
    """

    title: str
    guide: str = ""
    example: str = ""


TOPICS: Final[Mapping[str, Topic]] = {
    "sweep": Topic("Sweep", "sweeps.md"),
    "pack": Topic("Pack", "packs.md"),
    "": Topic(
        "Size, length and seed", "", "gmijax train env=ant num_envs=4096 num_timesteps=30e6"
    ),
    "output": Topic("What is kept", "serving.md"),
    "view": Topic("The page and who may open it", "view.md"),
    "env": Topic("Task", "tasks.md", "gmijax train env=ant env.rewards.energy=-0.1"),
    "physics": Topic("Physics", "warp.md", "gmijax train env=ant physics.impl=jax"),
    "algo=ppo": Topic(
        "Learning, with `algo=ppo`",
        "learning.md",
        "gmijax train env=ant algo.learning_rate=1e-4 algo.entropy_cost=1e-3",
    ),
    "run": Topic(
        "Run folder, checkpoints and restarts",
        "long-runs.md",
        "gmijax train env=ant run.dir=runs/ant run.resume=auto run.keep_checkpoints=10",
    ),
    "eval": Topic(
        "Evaluation while training",
        "evaluation-while-training.md",
        "gmijax train env=ant eval.every=5e6 eval.video=true",
    ),
    "wandb": Topic("Weights & Biases", "long-runs.md", "gmijax train env=ant wandb.mode=offline"),
    "plan": Topic(
        "GPUs and processes", "shares.md", "gmijax train env=ant plan.gpus=2 plan.gmis_per_gpu=1"
    ),
    "reduce": Topic("Gradient reduction", "reduction.md"),
    "cluster": Topic("Several machines", "several-hosts.md"),
    "search": Topic("Search", "search.md"),
    "algo=a3c": Topic(
        "Learning, with `algo=a3c` (asynchronous)", "async.md", "gmijax train env=ant algo=a3c"
    ),
    "algo=distill": Topic(
        "Learning, with `algo=distill` (a student of a trained policy)",
        "learning.md",
        "gmijax train env=ant algo=distill algo.teacher=runs/ant",
    ),
    "algo=sac": Topic(
        "Learning, with `algo=sac` (off-policy)", "learning.md", "gmijax train env=ant algo=sac"
    ),
    "channel": Topic("Experience channels, with `algo=a3c`", "channels.md"),
}
"""Headings of keys by their group, or by what they belong to, in the order of the pages."""

LEARNING: Final[Mapping[str, tuple[str, ...]]] = {
    "Steps and updates": (
        *("unroll_length", "num_minibatches", "num_updates_per_batch", "batch_size"),
        *("learning_rate", "learning_rate_schedule", "desired_kl", "max_grad_norm"),
    ),
    "Returns and loss": (
        *("discounting", "gae_lambda", "reward_scaling", "clipping_epsilon", "entropy_cost"),
        *("value_cost", "bound_cost", "clip_value_loss", "normalize_advantage"),
        *("recompute_advantages",),
    ),
    "Networks and exploration": (
        *("policy_hidden_layer_sizes", "value_hidden_layer_sizes", "precision"),
        *("policy_obs_key", "value_obs_key"),
        *("distribution_type", "init_noise_std", "state_dependent_std", "init_at_random_ep_len"),
    ),
    "Normalisation": (
        *("normalize_observations", "normalize_values", "obs_std_floor", "obs_outliers"),
        *("warmup_unroll", "preserve_outputs"),
    ),
}
"""Parts of `algo.*`; others stand under "Asynchronous" with `algo=a3c`, else first."""

PYTHON: Final[Mapping[str, tuple[str, ...]]] = {
    "Train and use a policy": ("compose", "train", "Result", "load_policy"),
    "Many runs": ("sweep", "SweepResult", "pack"),
    "Environments": ("task_names", "make_env", "make_vector_env"),
    "Search and serve": ("search", "serve", "Served"),
    "A class of your own in every process": ("plan", "launch", "Role", "GMIManager"),
}
"""The public names by topic."""

PYTHON_EXAMPLE: Final = """\
```python
import gmijax

config = gmijax.compose("env=ball_balance", "num_timesteps=300e3")
result = gmijax.train(config, show=True)  # returns when training has ended
policy = gmijax.load_policy(str(result.run_dir))
```

`import gmijax` loads neither JAX nor MuJoCo. A script that trains only plans and watches; the
processes that it starts do the work.
"""


def command_page(name: str) -> str:
    """The keys of a command: values, default, meaning; by topic, as Markdown."""
    keys = list(keys_of(COMMANDS[name], partial(defaults, name)))
    lines = [f"# gmijax {name}", "", f"`{usage_of(name)}`", "", "```", EXAMPLES[name], "```"]
    if name in LIKE_TRAIN:
        trains = set(keys_of(COMMANDS["train"], partial(defaults, "train")))
        keys = [key for key in keys if key not in trains]
        added = "What is added, or has another default:"
        lines += ["", f"Takes every key of [`gmijax train`](train.md). {added}"]
    else:
        lines += _choices_of(name, keys)
    return "\n".join([*lines, *_topics_of(name, keys), ""])


def _choices_of(name: str, keys: Sequence[HelpKey]) -> Iterator[str]:
    for group in dict.fromkeys(key.name.partition(".")[0] for key in keys):
        names = choices(group)
        if len(names) > 1:
            own = "; or `PATH.py:FUNCTION`, [a task of your own](../docs/custom-task.md)"
            listed = ", ".join(f"`{choice}`" for choice in names)
            yield from ("", f"`{group}=` is one of {listed}{own if group == 'env' else ''}.")
        if group == "env":
            task = f"Defaults below are those of `env={defaults(name, ())['env.name']}`."
            ask = f"`gmijax {name} env=ant --cfg job` prints those of another task."
            yield from ("", f"{task} {ask}")


def _topics_of(command: str, keys: Sequence[HelpKey]) -> Iterator[str]:
    groups: dict[str, list[HelpKey]] = {}
    for key in keys:
        group = key.choice or (key.name.partition(".")[0] if "." in key.name else "")
        groups.setdefault(group, []).append(key)
    for group in sorted(groups, key=list(TOPICS).index):
        topic = TOPICS[group]
        yield from ("", f"## {topic.title}")
        if topic.guide:
            yield from ("", f"Guide: {guide_link(topic.guide)}.")
        if topic.example and command == "train":
            yield from ("", "```", topic.example, "```")
        if not group.startswith("algo="):
            yield from _table(groups[group])
            continue
        for title, members in _parts(groups[group]).items():
            if members:
                yield from ("", f"### {title}")
                yield from _table(members)


def _parts(keys: Sequence[HelpKey]) -> dict[str, list[HelpKey]]:
    """Keys of an algorithm, as `LEARNING` orders them."""
    by_name = {key.name.removeprefix("algo."): key for key in keys}
    parts = {
        title: [by_name.pop(name) for name in names if name in by_name]
        for title, names in LEARNING.items()
    }
    return {"Algorithm": list(by_name.values()), **parts}


def guide_link(guide: str) -> str:
    """A link to a document, titled by its heading."""
    return f"[{title_of(guide)}](../docs/{guide})"


def title_of(guide: str) -> str:
    """The heading of a document below `docs/`, up to a colon."""
    first = (DOCS / guide).read_text().partition("\n")[0]
    return first.removeprefix("# ").partition(":")[0]


def _table(keys: Sequence[HelpKey]) -> Iterator[str]:
    yield from ("", "| key | values | default | meaning |", "|---|---|---|---|")
    for key in keys:
        anchor = "-".join(filter(None, (key.name, key.choice.replace("=", "-"))))
        values = _cell(f"{_values(key.kind)}{_limits(key)}")
        name = f"`{key.name}`{{ #{anchor} }}"
        yield f"| {name} | {values} | `{key.default}` | {_cell(key.meaning)} |"


def _values(kind: Any) -> str:
    """What a key may be set to, e.g. "int or `auto`"."""
    inner = typing.get_args(kind)
    origin = typing.get_origin(kind)
    if origin is Literal:
        return ", ".join(f"`{value}`" for value in inner)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(map(_values, inner))
    if origin is tuple:
        return f"list of {_values(inner[0])}"
    if origin is not None:
        return "group of named values"
    return "`null`" if kind is type(None) else kind.__name__


def _limits(key: HelpKey) -> str:
    low, high, positive = key.limits
    if positive:
        return ", greater than 0"
    if low is not None and high is not None:
        return f", {low:.10g} to {high:.10g}"
    return "" if low is None else f", at least {low:.10g}"


def _cell(text: str) -> str:
    """Plain text as Markdown in a table; paths of documents become links."""
    prose_and_code = text.replace("|", r"\|").split("`")
    for at in range(0, len(prose_and_code), 2):
        prose = prose_and_code[at].replace("<", "&lt;").replace("*", r"\*")
        prose_and_code[at] = re.sub(r"docs/([\w-]+\.md)", lambda m: guide_link(m[1]), prose)
    return "`".join(prose_and_code)


def usages_page() -> str:
    """What the commands without a configuration say of themselves."""
    parts = [f"## gmijax {name}\n\n```text\n{usage}```\n" for name, usage in USAGES.items()]
    return "\n".join(["# Other commands\n", *parts])


def python_page() -> str:
    """The public names, each with a directive that mkdocstrings replaces by its docstring."""
    lines = ["# Python", "", PYTHON_EXAMPLE]
    for title, names in PYTHON.items():
        lines += [f"## {title}", ""]
        for name in names:
            # A function may have the name of a module (`gmijax.train`): each by its home.
            lines += [f"::: {gmijax._HOMES[name]}.{name}", "    options:"]
            lines += [f"      heading: gmijax.{name}", f"      toc_label: {name}", ""]
    lines += ["## Exceptions", "", "::: gmijax.errors", "    options:"]
    return "\n".join([*lines, "      show_root_heading: false", ""])
