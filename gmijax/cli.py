"""Command lines: hydra overrides in, a checked configuration out, exit codes. Only hydra user.

`key=value` overrides, `--help` (every key with its meaning), `--cfg job` (the composed
configuration). Exit codes: 0 success, 2 bad input (one line), 130 interrupted, 1 anything else.
"""

from __future__ import annotations

import dataclasses
import re
import sys
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from rich.console import Console
from rich.table import Table

from gmijax.config import TrainConfig, from_dict, suggestion, to_dict
from gmijax.errors import ConfigError, GmijaxError, JobInterrupted
from gmijax.resume import find_checkpoint
from gmijax.rundir import RunPaths, read_json

C = TypeVar("C")

EXIT_OK, EXIT_FAILED, EXIT_BAD_INPUT, EXIT_INTERRUPTED = 0, 1, 2, 130


def compose(*overrides: str) -> TrainConfig:
    """The training configuration that `python -m gmijax.train OVERRIDES` would run.

    Example:
      >>> compose("env=ant", "num_envs=512").num_envs
      512

    Raises:
      ConfigError: an unknown key, a wrong type or value.
    """
    return _build("train", TrainConfig, overrides)


def command(name: str, cls: type[C], run: Callable[[C], int], argv: Sequence[str]) -> int:
    """Runs one of the commands and turns every error into its exit code."""
    try:
        if "--help" in argv or "-h" in argv:
            _print_help(name, cls)
            return EXIT_OK
        overrides, show = _split_options(argv)
        config = _build(name, cls, overrides)
        if show:
            sys.stdout.write(OmegaConf.to_yaml(OmegaConf.create(to_dict(config))))
            return EXIT_OK
        return run(config)
    except ConfigError as error:
        _complain(name, error)
        return EXIT_BAD_INPUT
    except (JobInterrupted, KeyboardInterrupt) as error:
        _complain(name, error if str(error) else "interrupted")
        return EXIT_INTERRUPTED
    except GmijaxError as error:
        _complain(name, error)
        return EXIT_FAILED


def config_dir() -> Path:
    """The folder of YAML files: inside an installed package, or beside it in a checkout."""
    package = Path(__file__).resolve().parent
    installed = package / "configs"
    return installed if installed.is_dir() else package.parent / "configs"


def choices(group: str) -> list[str]:
    """Names of the YAML files of a group, e.g. the tasks for `env`."""
    return sorted(path.stem for path in (config_dir() / group).glob("*.yaml"))


def _build(name: str, cls: type[C], overrides: Sequence[str]) -> C:
    data = _compose_dict(name, overrides)
    resume = data["run"].get("resume") if cls is TrainConfig else None
    if resume:
        data = _on_top_of_saved(data, overrides, str(resume))
    return from_dict(cls, data)


def _compose_dict(name: str, overrides: Sequence[str]) -> dict[str, Any]:
    parsed = _parse(overrides)
    for item in parsed:
        if (options := choices(item.key_or_group)) and item.value() not in options:
            close = suggestion(str(item.value()), options)
            raise ConfigError(f"{item.key_or_group}={item.value()}: unknown{close}")
    try:
        with initialize_config_dir(str(config_dir()), version_base=None):
            config = hydra_compose(name, overrides=list(overrides))
        data = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(_one_line(name, error)) from None
    return typing.cast("dict[str, Any]", data)


def _parse(overrides: Sequence[str]) -> list[Any]:
    try:
        return OverridesParser.create().parse_overrides(list(overrides))
    except HydraException as error:
        bad = next((text for text in overrides if "=" not in text), None)
        if bad is not None:
            raise ConfigError(f"{bad}: expected key=value") from None
        raise ConfigError(" ".join(str(error).split())) from None


def _on_top_of_saved(
    data: dict[str, Any], overrides: Sequence[str], resume: str
) -> dict[str, Any]:
    """The saved configuration of the resumed run, changed where the command line says so."""
    checkpoint = find_checkpoint(resume, "run.resume")
    saved = read_json(RunPaths(checkpoint.parent.parent).config)
    saved["run"].update(dir=None, name=None)
    for item in _parse(overrides):
        path = item.key_or_group.split(".")
        source, target = data, saved
        for part in path[:-1]:
            source, target = source[part], target[part]
        target[path[-1]] = source[path[-1]]
    saved["run"]["resume"] = str(checkpoint)
    return saved


def _one_line(name: str, error: Exception) -> str:
    text = " ".join(str(error).split())
    if match := re.search(r"Key '([^']+)' is not in struct full_key: (\S+)", text):
        return f"unknown key {match[2]}{suggestion(match[2], _known_keys(name))}"
    if match := re.search(r"Could not override '([^']+)'", text):
        return f"unknown key {match[1]}{suggestion(match[1], _known_keys(name))}"
    return text


def _known_keys(name: str) -> list[str]:
    return list(_flatten(_compose_dict(name, ())))


def _flatten(data: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in data.items():
        if isinstance(value, Mapping):
            flat |= _flatten(value, f"{prefix}{key}.")
        else:
            flat[prefix + key] = value
    return flat


def _split_options(argv: Sequence[str]) -> tuple[list[str], bool]:
    arguments = [part for text in argv for part in re.split(r"^(--cfg)=", text) if part]
    show = False
    if "--cfg" in arguments:
        at = arguments.index("--cfg")
        if arguments[at + 1 : at + 2] != ["job"]:
            raise ConfigError(f"--cfg {' '.join(arguments[at + 1 : at + 2])}: allowed is job")
        del arguments[at : at + 2]
        show = True
    for text in arguments:
        if text.startswith("-"):
            raise ConfigError(f"unknown option {text}: allowed are --help, --cfg job, key=value")
    return arguments, show


def _print_help(name: str, cls: type[Any]) -> None:
    values = _flatten(_compose_dict(name, ()))
    table = Table(box=None, pad_edge=False)
    for heading in ("key", "default", "meaning"):
        table.add_column(heading, overflow="fold", no_wrap=heading == "key")
    for key, meaning, allowed in _documented(cls):
        shown = "null" if values[key] is None else str(values[key])
        table.add_row(key, shown, f"{meaning}{f' ({allowed})' if allowed else ''}")
    console = Console(width=None if sys.stdout.isatty() else 140, highlight=False, markup=False)
    console.print(f"usage: python -m gmijax.{name} [key=value ...] [--cfg job] [--help]\n")
    for group in ("env", "algo", "plan"):
        if group in {key.split(".")[0] for key in values} and choices(group):
            console.print(f"{group}= one of: {', '.join(choices(group))}")
    console.print()
    console.print(table)


def _documented(cls: type[Any], prefix: str = "") -> Iterator[tuple[str, str, str]]:
    hints = typing.get_type_hints(cls)
    for field in dataclasses.fields(cls):
        kind = hints[field.name]
        if dataclasses.is_dataclass(kind):
            yield from _documented(typing.cast(type, kind), f"{prefix}{field.name}.")
            continue
        literal = typing.get_origin(kind) is typing.Literal
        allowed = "|".join(map(str, typing.get_args(kind))) if literal else ""
        yield prefix + field.name, field.metadata["doc"], allowed


def _complain(name: str, what: object) -> None:
    notes = getattr(what, "__notes__", [])
    sys.stderr.write(f"gmijax.{name}: {'; '.join([str(what), *notes])}\n")
