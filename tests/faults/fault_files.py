"""Files that were damaged or edited: what is done to which file, and which command then reads it.

Every file of what commands leave is damaged in a way that is drawn. The command must end within a
minute, well or with one line, and leave all other files as they are.
"""

from __future__ import annotations

import json
import os
import random
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

_DEEP = "[" * 100_000
_VALUES: tuple[Any, ...] = (None, True, -1, 10**30, 0.5, "", "x", [], [[]], {}, {"a": 1}, "\0/é\n")


class EditKind(NamedTuple):
    """Which file is damaged, and who reads it.

    Attributes:
      fixture: what the file belongs to, see `fault_fixtures`.
      files: a pattern in it; one of those that fit is drawn.
      reader: which command then reads it, a key of `READERS`.
      is_text: whether it holds JSON, in one line or many.
      way: how, of `_VERSIONS`; empty: it is drawn.
      code: exit code that the reader must end with; None: 0 or 2.
      says: what the reader must print.
      holds: what the file must still hold after it.
    """

    fixture: str
    files: str
    reader: str
    is_text: bool = True
    way: str = ""
    code: int | None = None
    says: str = ""
    holds: str = ""


READERS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "auto": ("train", "run.dir={run}", "run.resume=auto", "{more}"),
        "given": ("train", "run.dir={run}", "run.resume=auto", "algo.gae_lambda=0.9", "{more}"),
        "resume": ("train", "run.resume={run}", "run.dir={home}/new", "{more}"),
        "again": ("train", "run.dir={run}", "run.resume=auto", "{same}"),
        "play": ("play", "run.dir={run}", "num_envs=2", "html=off"),
        "export": ("export", "run.dir={run}", "format=stablehlo"),
        "serve": ("serve", "run.dir={run}", "num_envs=16", "unroll_length=4", "latency_steps=0",
                  "num_timesteps=64"),
        "sweep": ("sweep", "run.dir={run}", "{sweep}"),
        "collect": ("serve", "output.dir={run}", "{collect}"),
        "search": ("search", "search.store={run}", "run.dir={home}/new", "{search}"),
        "load": ("load_policy", "{file}"),
        "load_run": ("load_policy", "{run}"),
    }
)  # fmt: skip
"""The commands; `load_policy` is a program that loads a policy and acts with it."""

_META, _DATA = "checkpoints/[0-9]*/meta.json", "checkpoints/[0-9]*/*/**/*"
EDITS: Mapping[str, EditKind] = MappingProxyType(
    {
        **{
            f"edit_{name}_{reader}": EditKind("run", files, reader, is_text)
            for name, files, is_text, readers in (
                ("config", "config.json", True, ("auto", "resume", "play", "serve")),
                ("plan", "plan.json", True, ("auto", "again")),
                ("summary", "summary.json", True, ("auto", "again")),
                ("metrics", "metrics.jsonl", True, ("auto", "again")),
                ("events", "events.jsonl", True, ("auto",)),
                ("meta", _META, True, ("auto", "resume", "export", "load_run")),
                ("data", _DATA, False, ("auto", "play", "load_run")),
            )
            for reader in readers
        },
        **{
            f"edit_version_{name}_{reader}": EditKind(
                "run", "config.json", reader, True, name, code, says
            )
            for name, code, says, readers in (
                ("key", 2, "future_key", ("auto", "resume")),
                ("group", 2, "future_group", ("auto", "resume")),
                ("key", 0, "future_key", ("play", "export")),
            )
            for reader in readers
        },
        # A default that has changed since is not taken; what is given is, with a line.
        "edit_version_default": EditKind(
            "run", "config.json", "auto", way="default", code=0, holds='"gae_lambda": 0.5'
        ),
        "edit_version_given": EditKind(
            "run", "config.json", "given", way="default", code=0, says="gae_lambda"
        ),
        "edit_sweep": EditKind("sweep", "sweep.json", "sweep"),
        "edit_request": EditKind("sweep", "request.json", "sweep"),
        "edit_job": EditKind("sweep", "00[01]/*.json*", "sweep"),
        "edit_dataset": EditKind("data", "dataset.json", "collect"),
        "edit_shard": EditKind("data", "gmi_*/*", "collect"),
        "edit_store": EditKind("store", "*.json", "search"),
        "edit_stablehlo": EditKind("export", "policy.stablehlo", "load", is_text=False),
        "edit_onnx": EditKind("export", "policy.onnx", "load", is_text=False),
        "edit_metadata": EditKind("export", "policy.json", "load"),
    }
)


def damage(path: Path, kind: EditKind, draw: random.Random) -> str:
    """Damages a file, or edits it; returns in which way."""
    if kind.way:
        _VERSIONS[kind.way](path)
        return kind.way
    ways = _ANY | (_TEXT if kind.is_text else {})
    name = draw.choice(sorted(ways))
    ways[name](path, draw)
    return name


def _flip(path: Path, draw: random.Random) -> None:
    data = bytearray(path.read_bytes() or b"\0")
    for _ in range(3):
        data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
    path.write_bytes(data)


def _truncate(path: Path, draw: random.Random) -> None:
    os.truncate(path, draw.randrange(max(1, path.stat().st_size)))


def _instead(make: Callable[[Path], object]) -> Callable[[Path, random.Random], None]:
    def act(path: Path, _: random.Random) -> None:
        path.unlink()
        make(path)

    return act


def _text(text: str) -> Callable[[Path, random.Random], None]:
    return lambda path, _: (path.write_text(text), None)[1]


def _add_line(path: Path, draw: random.Random) -> None:
    with path.open("a") as file:
        file.write(draw.choice(("5\n", "[]\n", "{}\n", "null\n", '{"env_steps": "x"}\n', "{\n")))


def _edit_value(path: Path, draw: random.Random) -> None:
    """A value somewhere in it is another, or is gone."""
    lines = path.read_text().splitlines() if path.suffix == ".jsonl" else [path.read_text()]
    number = draw.randrange(len(lines))
    data = json.loads(lines[number])
    inner: Any = data
    while True:
        keys = list(inner) if isinstance(inner, dict) else list(range(len(inner)))
        key = draw.choice(keys)
        if not isinstance(inner[key], dict | list) or not inner[key] or draw.random() < 0.2:
            break
        inner = inner[key]
    if draw.random() < 0.3:
        del inner[key]
    else:
        inner[key] = draw.choice(_VALUES)
    lines[number] = json.dumps(data)
    path.write_text("\n".join(lines) + "\n")


def _as_of_another_version(group: str, key: str, value: object) -> Callable[[Path], None]:
    def act(path: Path) -> None:
        config = json.loads(path.read_text())
        config.setdefault(group, {})[key] = value
        path.write_text(json.dumps(config))

    return act


_VERSIONS: dict[str, Callable[[Path], None]] = {
    "key": _as_of_another_version("algo", "future_key", 3),
    "group": _as_of_another_version("future_group", "key", 3),
    "default": _as_of_another_version("algo", "gae_lambda", 0.5),
}

_ANY: dict[str, Callable[[Path, random.Random], None]] = {
    "flipped": _flip,
    "truncated": _truncate,
    "empty": _text(""),
    "raw": lambda path, draw: (path.write_bytes(draw.randbytes(300)), None)[1],
    "a FIFO": _instead(os.mkfifo),
    "a device": _instead(lambda path: path.symlink_to("/dev/zero")),
    "a folder": _instead(Path.mkdir),
    "a loop of links": _instead(lambda path: path.symlink_to(path.name)),
    "gone": _instead(lambda path: None),
}

_TEXT: dict[str, Callable[[Path, random.Random], None]] = {
    **{f"the text {text!r}": _text(text) for text in ("{", "[]", "{}", "5", "null", '"x"')},
    "deep": _text(_DEEP),
    "a number of 9,999 digits": _text("9" * 9999),
    "a line more": _add_line,
    "another value": _edit_value,
    "a value of another type": _edit_value,
    "a value that is gone": _edit_value,
}


def drawn_file(folder: Path, kind: EditKind, draw: random.Random) -> Path:
    """The file that is damaged."""
    found = sorted(path for path in folder.glob(kind.files) if path.is_file())
    return draw.choice([path for path in found if not path.name.startswith(".")])
