"""Writes the pages of the documentation site: the documents, and the reference of the code.

`make docs` runs it and builds the site from what it wrote in `build/docs/pages/`. Documents are
linked there, with all that they link to, at the places that they have in the repository. So their
links hold in both, and `make docs-serve` shows what is changed in them.
"""

from __future__ import annotations

import re
import shutil
import sys
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final, Literal

import gmijax
from gmijax import demo, doctor, list_envs
from gmijax.cli.compose import defaults
from gmijax.cli.grid import SweepHelp
from gmijax.cli.groups import choices
from gmijax.cli.help import Key, keys_of, usage_of
from gmijax.cli.pack import PackKeys
from gmijax.config import ExportConfig, PlayConfig, ServeConfig, TrainConfig, ViewConfig

ROOT: Final = Path(__file__).resolve().parents[1]
PAGES: Final = ROOT / "build" / "docs" / "pages"
STYLE: Final = ROOT / "docs" / "site.css"

COMMANDS: Final[Mapping[str, type[Any]]] = {
    "train": TrainConfig,
    "search": TrainConfig,
    "sweep": SweepHelp,
    "pack": PackKeys,
    "serve": ServeConfig,
    "play": PlayConfig,
    "view": ViewConfig,
    "export": ExportConfig,
}
"""The commands that take keys, and the dataclass of each."""

LIKE_TRAIN: Final = ("search", "sweep")
"""Commands with the keys of `train`; their pages show only what differs."""

USAGES: Final = {"doctor": doctor.USAGE, "list-envs": list_envs.USAGE, "demo": demo.USAGE}
"""What the commands without a configuration print on `--help`."""

LINK: Final = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")


def main() -> int:
    """Writes all pages anew; returns the exit code."""
    shutil.rmtree(PAGES, ignore_errors=True)
    link_documents(PAGES)
    (PAGES / "docs" / STYLE.name).symlink_to(STYLE)
    folder = PAGES / "reference"
    folder.mkdir()
    for name in COMMANDS:
        (folder / f"{name}.md").write_text(command_page(name))
    (folder / "other-commands.md").write_text(usages_page())
    (folder / "python.md").write_text(python_page())
    return 0


def linked_paths(text: str) -> list[str]:
    """Targets of the links of a document that are paths, without the part behind `#`."""
    prose = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    targets = [target.partition("#")[0] for target in LINK.findall(prose)]
    return [target for target in targets if target and not re.match(r"[a-z]+:", target)]


def link_documents(pages: Path) -> None:
    """Links README.md (as the first page), docs/ and all that they link to into a folder.

    A folder that is linked to gets a page with a list of its files, unless it has a README.md.

    Raises:
      FileNotFoundError: a link to a file that does not exist.
    """
    readme = ROOT / "README.md"
    waiting = [readme, *(ROOT / "docs").rglob("*.md")]
    seen = set()
    while waiting:
        path = waiting.pop()
        if path in seen:
            continue
        seen.add(path)
        place = pages / ("index.md" if path == readme else path.relative_to(ROOT))
        (place if path.is_dir() else place.parent).mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            files = sorted(file for file in path.iterdir() if file.is_file())
            if path / "README.md" not in files:
                lines = [f"- [{file.name}]({file.name})" for file in files]
                title = f"# Files in {path.relative_to(ROOT).as_posix()}"
                (place / "index.md").write_text("\n".join([title, "", *lines, ""]))
            waiting += files
            continue
        place.symlink_to(path.resolve(strict=True))
        if path.suffix == ".md":
            links = linked_paths(path.read_text())
            waiting += [(path.parent / link).resolve() for link in links]


def command_page(name: str) -> str:
    """The keys of a command: values, default, meaning; in groups, as Markdown."""
    keys = list(keys_of(COMMANDS[name], partial(defaults, name)))
    lines = [
        f"# gmijax {name}",
        "",
        f"`{usage_of(name)}`",
    ]
    if name in LIKE_TRAIN:
        trains = set(keys_of(COMMANDS["train"], partial(defaults, "train")))
        keys = [key for key in keys if key not in trains]
        added = "What is added, or has another default:"
        lines += ["", f"Takes every key of [`gmijax train`](train.md). {added}"]
    else:
        lines += _choices_of(name, keys)
    return "\n".join([*lines, *_tables(keys), ""])


def _choices_of(name: str, keys: Sequence[Key]) -> Iterator[str]:
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


def _tables(keys: Sequence[Key]) -> Iterator[str]:
    general = "Top level"
    groups: dict[str, list[Key]] = {general: []}
    for key in keys:
        group = f"`{key.name.partition('.')[0]}`" if "." in key.name else general
        heading = f"{group} with `{key.choice}`" if key.choice else group
        groups.setdefault(heading, []).append(key)
    for heading, members in groups.items():
        if not members:
            continue
        yield from (
            "",
            f"## {heading}",
            "",
            "| key | values | default | meaning |",
            "|---|---|---|---|",
        )
        for key in members:
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


def _limits(key: Key) -> str:
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
        prose_and_code[at] = re.sub(r"docs/([\w-]+\.md)", r"[\1](../docs/\1)", prose)
    return "`".join(prose_and_code)


def usages_page() -> str:
    """What the commands without a configuration say of themselves."""
    parts = [f"## gmijax {name}\n\n```text\n{usage}```\n" for name, usage in USAGES.items()]
    return "\n".join(["# Other commands\n", *parts])


def python_page() -> str:
    """The public names, each with a directive that mkdocstrings replaces by its docstring."""
    # A function may have the name of a module (`gmijax.train`), so each is named by its home.
    names = [name for name in gmijax.__all__ if not name.startswith("__")]
    homes = [f"{getattr(gmijax, name).__module__}.{name}" for name in names]
    parts = [
        f"::: {home}\n    options:\n      heading: gmijax.{name}\n      toc_label: {name}\n"
        for name, home in zip(names, homes, strict=True)
    ]
    errors = "## Exceptions\n\n::: gmijax.errors\n    options:\n      show_root_heading: false\n"
    return "\n".join(["# Python\n", "## Names of `gmijax`\n", *parts, errors])


if __name__ == "__main__":
    sys.exit(main())
