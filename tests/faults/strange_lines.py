"""Command lines as nobody should write them, for `test_override_fuzz.py`."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Iterator
from typing import Any, Literal

from command_lines import COMMANDS
from hypothesis import strategies as st

from gmijax.cli.compose import defaults
from gmijax.cli.groups import choices

_GROUPS = ("env", "algo", "plan", "search", "tuned", "run", "physics", "reduce", "channel")


def _leaves(cls: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every key of a configuration, with its type."""
    for name, kind in typing.get_type_hints(cls).items():
        options = typing.get_args(kind) or (kind,)
        trees = [option for option in options if dataclasses.is_dataclass(option)]
        for tree in trees:
            yield from _leaves(tree, f"{prefix}{name}.")
        if not trees:
            # Names and paths go through more code than numbers do.
            yield from [(prefix + name, kind)] * (4 if str in options else 1)


_OF_DOCTOR: tuple[tuple[str, Any], ...] = (("mig", str), ("gpu", int), ("cluster", str))
"""`gmijax doctor` reads its own line."""


def _keys(command: str) -> tuple[tuple[str, Any], ...]:
    """Every key that a command takes, with its type; those of a task's own too."""
    found = [leaf for cls in COMMANDS[command] for leaf in _leaves(cls)]
    if any(key.startswith("env.") for key, _ in found):
        of_task = defaults("train", ("env=ant",))
        found += [(key, type(value)) for key, value in of_task.items() if key.startswith("env.")]
    return tuple(found) or _OF_DOCTOR


def _right(kind: Any) -> st.SearchStrategy[str]:
    """Values of a type as one writes them; most are allowed."""
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if origin in (types.UnionType, typing.Union):
        return st.one_of([_right(option) for option in inner])
    if origin is Literal:
        return st.sampled_from([str(value) for value in inner])
    if origin is tuple:
        return st.lists(_right(inner[0]), max_size=4).map(lambda parts: f"[{','.join(parts)}]")
    simple: dict[Any, st.SearchStrategy[str]] = {
        bool: st.sampled_from(["true", "false", "on", "off"]),
        int: st.integers(0, 4).map(str) | st.sampled_from(["16", "64", "1024", "1e6"]),
        float: st.floats(0, 100).map(repr),
        str: st.sampled_from(["last", "done", "runs/done", "name", "ant", "jax", "tray"]),
    }
    return simple.get(kind, st.just("null"))


_DIGITS = "9" * 5000
_BELOW = st.sampled_from(["first", "0", "9", "-1", "x.y", "name", "range", "é", "[0]", ""])
_WRONG = st.sampled_from(
    [
        *("", " ", "null", "None", "nan", "-inf", ".inf", "-1", "0", "0x10", "1_0", "1e400"),
        *("-0.0", "1e300", "1e18", str(2**31), str(2**64), "1" + "0" * 400, "١٢"),
        *(_DIGITS, f"-{_DIGITS}"),
        *("'", '"', "'a", '"a\\"', "''", "a b", "a=b", "=", "==", "a:b", ":", "#", "\\", "\\\\"),
        *("[", "]", "[]", "[[]]", "[[0],[1,[2]]]", "[1,", "[null]", "[a,1,true]", "[-1]", "[0,0]"),
        *("{", "}", "{}", "{a:1}", "{1:2}", "{a:{b:[c]}}", "{null:1}", "{a:1,a:2}", "{name:ppo}"),
        *("[" * 50 + "]" * 50, "[" * 3000 + "]" * 3000, "{a:" * 900 + "1" + "}" * 900, "(" * 900),
        *("${", "}", "${}", "${seed}", "${env.name}", "${nothing}", "${.}", "${..}", "${${seed}}"),
        *("${oc.env:HOME}", "${oc.env:NO_SUCH}", "${oc.env}", "${oc.decode:'[1'}", "${oc.x:1}"),
        *("${oc.create:{a:1}}", "${oc.select:x,1}", "${now:%Y}", "${hydra:runtime.cwd}", "???"),
        *("1,2", "a,b", "choice(1,2)", "range(1,3)", "interval(0,1)", "sort(3,2)", "glob(*)"),
        *("range(0,1e9)", "range(0,100000)", "range(3,0)", "range(0,3,0)", "interval(nan,1)"),
        *("tag(log,interval(-1,1))", "interval(1,0)", "choice()", ",".join("1" * 3000), "30M"),
        *(f"[{','.join('1' * 3000)}]", "[1e400]", "[-.inf]", "{range:[nan,inf]}", "{a:{b:{}}}"),
        *("int(x)", "int(inf)", "int(nan)", "float(x)", "json_str({})", "bool(2)", "f()"),
        *("tag(a,choice(1))", "shuffle(1)", "extend_list(1)", "str([", "int({a:b})", "glob(["),
        *("\0", "a\0b", "\n", "a\nb", "'a\nb'", "\r", "\t", "\x1b[31m", "\x7f", "\x85", "\u2028"),
        *("\ud800", "\udcff", "é", "漢字", "🤖", "\u202e", "\ufeff", "\xa0", "%s", "%d%n", "{0}"),
        *("..", "/", "../..", "/dev/null", "/proc/self/mem", "/root/x", "~", "*", "a/b/c", "--"),
        *("a" * 300, "a" * 20000, "a/" * 3000, "é" * 200, "yes", "True", "!!python/object:os"),
        *("x.py", "x.py:", "x.py:f", ".py:f", "task.py:make", "task.py:1", "a'b.py:f", "\0.py:f"),
    ]
)
_ANY_TEXT = st.text(max_size=12) | st.text(
    alphabet="[]{}(),:='\"\\$#.-+~@*/ \t\n0123456789aeinfl", max_size=16
)


_PATHS = st.sampled_from(
    [
        *("last", "done", "runs/done", "runs/done/checkpoints/000000001000", "1000", "01000", "7"),
        *("runs", ".", "..", "", "/", "task.py", "task.py/x", "task.py:make", "./task.py:make"),
        *("/dev/null", "/dev/null/x", "/proc/self/mem", "/proc/1/root", "/root/x", "~", "$HOME"),
        *("a" * 250, "a" * 300, "a/" * 3000, "漢" * 200, "'" + "9" * 300 + "'", f"'{_DIGITS}'"),
        *("a" * 300 + ".py:f", "'a b'", "'[x]'", "'{x}'", "'${x}'", "'\\'", "a=b", "x:y", "..."),
        *("\0", "a\nb", "\udcff", "é", "🤖", "'[bold]'", "'[/]'", "%s", "1", "1.5", "true", "[a]"),
        *("${oc.env:HOME}", "${env.name}", "${oc.env:NOT_TEXT}", "${oc.env:TWO_LINES}"),
    ]
)


def _values(kind: Any) -> st.SearchStrategy[str]:
    if str in (kind, *typing.get_args(kind)):
        return _PATHS | _WRONG | _ANY_TEXT
    return st.one_of(_right(kind), _right(kind), _WRONG, _ANY_TEXT)


@st.composite
def _overrides(draw: st.DrawFn, keys: tuple[tuple[str, Any], ...]) -> str:
    """`key=value`, with what hydra allows and what it does not."""
    key, kind = draw(st.sampled_from(keys))
    prefix = draw(st.sampled_from(["", "", "", "", "", "", "+", "++", "~", "~~", "-"]))
    shape = draw(st.integers(0, 19))
    if shape == 0:
        return f"{prefix}{key}"
    if shape == 1:
        return f"{prefix}{key}.{draw(_BELOW | _ANY_TEXT)}={draw(_right(kind) | _WRONG)}"
    if shape == 2:
        return f"{prefix}{key.rpartition('.')[0] or 'run'}={draw(_WRONG)}"
    if shape == 3:
        return f"{prefix}{key}@{draw(st.sampled_from(['', 'x', '_global_', 'a:b', '_here_']))}=1"
    if shape == 4:
        return f"{prefix}{key.replace('.', '/')}={draw(_values(kind))}"
    return f"{prefix}{key}={draw(_values(kind))}"


@st.composite
def _good(draw: st.DrawFn, keys: tuple[tuple[str, Any], ...]) -> str:
    """What may well be taken."""
    key, kind = draw(st.sampled_from(keys))
    return f"{key}={draw(_right(kind))}"


@st.composite
def _group_choices(draw: st.DrawFn) -> str:
    group = draw(st.sampled_from([*_GROUPS, "", "..", "/", "nothing", "hydra", "é", "a" * 300]))
    package = draw(st.sampled_from(["", "", "", "", "@x", "@_global_", "@", "@a@b", ":a"]))
    prefix = draw(st.sampled_from(["", "", "", "", "+", "++", "~"]))
    known = [*choices(group)] if group in _GROUPS else []
    value = draw(st.sampled_from(known) | _WRONG if known else _WRONG)
    return f"{prefix}{group}{package}={value}"


_OPTIONS = st.sampled_from(
    [
        *("--cfg", "--cfg=job", "job", "--cfg=", "--cfg=hydra", "--cfg=all", "-m", "--multirun"),
        *("--config-dir", "--config-dir=.", "--config-name=x", "-cn", "-cd", "--run", "--info"),
        *("--resolve", "--version", "--hydra-help", "--", "-", "-h", "--help", "-n"),
        *("hydra.run.dir=x", "hydra/launcher=joblib", "+hydra.x=1", "hydra.mode=RUN", "~hydra"),
        *("hydra=null", "hydra.sweeper.params=1", "+_target_=os.system", "defaults=[]"),
        *("+defaults=[env]", "_self_", "+x=1", "++x.y.z=1", "~x", "run.resume=last", "", " ", "="),
        *("run.resume=done", "run.dir=last", "env=task.py:make", "env=custom", "policy=random"),
        *("run.resume=runs/done", "run.dir=runs/done", "run.dir=runs/new", "output.dir=new"),
        *("num_envs=auto", "plan.gmis_per_gpu=auto", "algo=a3c", "algo=ppo", "checkpoint=1000"),
        *("num_envs=64", "plan.gmis_per_gpu=2", "plan.gpus=2", "num_timesteps=30e6", "seed=1"),
        *("reduce.selection=paper", "reduce.strategy=mpr", "plan.layout=[[0,1],[2]]"),
        *("run.dir=/dev/null/x", "search.store=task.py", "output.dir=task.py", "output.dir=."),
    ]
)


@st.composite
def _mutated(draw: st.DrawFn, lines: st.SearchStrategy[str]) -> str:
    """A line with a few characters left out, doubled, swapped, or others put in."""
    text = draw(lines)
    for _ in range(draw(st.integers(1, 3))):
        at = draw(st.integers(0, max(0, min(len(text), 60) - 1)))
        how = draw(st.sampled_from(["delete", "double", "swap", "insert"]))
        head, one, rest = text[:at], text[at : at + 1], text[at + 1 :]
        middle = {
            "delete": rest,
            "double": one + one + rest,
            "swap": rest[:1] + one + rest[1:],
            "insert": draw(st.characters()) + one + rest,
        }
        text = head + middle[how]
    return text


_SWEPT = (
    *("env=glob(*)", "algo.learning_rate=interval(1e-4,1e-3)", "env=ant,humanoid", "num_envs=1,2"),
    *("sweep.sampler=tpe", "sweep.trials=3", "sweep.pack=auto", "sweep.pruner=asha"),
)


_COMMAND_WORDS = (
    *(
        "true",
        "python3",
        "/bin/sh",
        "nothing-of-that-name",
        "{seed}",
        "{run_dir}",
        "{job}",
        "{sed}",
    ),
    *("{{seed}}", "{", "}", "{}", '{"a": 1}', "${HOME}", "{x.y}", "{0..3}", "--", "-c", ""),
)


@st.composite
def command_lines(draw: st.DrawFn, command: str) -> list[str]:
    """At most two strange arguments among good ones, so that all checks are reached."""
    keys = _keys(command)
    strange = _overrides(keys)
    strange |= st.one_of(
        _group_choices(), _OPTIONS, _mutated(_overrides(keys)), _ANY_TEXT, strange
    )
    argv = draw(st.lists(_good(keys), max_size=3)) + draw(st.lists(strange, max_size=2))
    if command == "serve":
        argv.insert(0, draw(st.sampled_from(["policy=random", "policy=random", "run.dir=last"])))
    if command == "sweep":
        argv.append(draw(st.sampled_from(["seed=0,1", "seed=range(0,3)", *_SWEPT])))
    if argv and draw(st.integers(0, 5)) == 0:
        argv.append(draw(st.sampled_from(argv)))
    if command == "pack":
        words = draw(st.lists(st.sampled_from(_COMMAND_WORDS) | _ANY_TEXT, max_size=3))
        return [*argv, *draw(st.sampled_from([["seed=0,1"], ["x.y=1e-4,2"], []])), "--", *words]
    return draw(st.permutations(argv)) if draw(st.booleans()) else argv
