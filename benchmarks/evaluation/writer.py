"""Writes the tables of documents: cells in Markdown, and below them what their files are from."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TypeAlias, TypeVar

from benchmarks.evaluation.figures import NOT_MEASURED, call_of, repeats_of
from benchmarks.records import Call

Rows: TypeAlias = Iterable[Sequence[str]]
MakeRows = TypeVar("MakeRows", bound=Callable[[], Rows])
MakeLines = TypeVar("MakeLines", bound=Callable[[], list[str]])

TABLES: dict[str, Callable[[], list[str]]] = {}
"""By the name that documents use: `<!-- table: NAME -->`."""


def table(
    name: str, head: str, *files: str, more: Callable[[], Iterable[str]] = tuple
) -> Callable[[MakeRows], MakeRows]:
    """Registers a function of rows as a table.

    Args:
      name: in documents.
      head: see `markdown`.
      files: of results that its figures are from.
      more: such files, where results say which.
    """

    def register(rows: MakeRows) -> MakeRows:
        TABLES[name] = lambda: [*markdown(head, [*rows()]), *source(*files, *more())]
        return rows

    return register


def lines(name: str) -> Callable[[MakeLines], MakeLines]:
    """Registers a function that writes all lines of a table itself."""

    def register(make: MakeLines) -> MakeLines:
        TABLES[name] = make
        return make

    return register


def markdown(head: str, rows: Sequence[Sequence[str]]) -> list[str]:
    """A table; the columns of `head` are divided by `|`, those of numbers end with a colon."""
    names = [name.strip() for name in head.split("|")]
    rule = ["---:" if name.endswith(":") else "---" for name in names]
    lines = [[name.removesuffix(":") for name in names], rule, *rows]
    return [f"| {' | '.join(cells)} |" for cells in lines]


def source(*files: str) -> list[str]:
    """A line for each file: with what its call was made."""
    below = [
        *(
            f"- {link(f'{file}.json')}: {origin(call)}"
            if (call := call_of(file))
            else f"- `{file}.json`: {NOT_MEASURED}"
            for file in files
        ),
    ]
    return ["", *below] if below else []


def link(file_name: str) -> str:
    """A file of results, as a page in `docs/evaluation/` points at it."""
    return f"[`{file_name}`](../../benchmarks/results/{file_name})"


def origin(call: Call) -> str:
    """Commit, date, device, driver and repeats of a call; `unknown` where the file is silent."""
    commits = [one[:10] for one in (call.commit or "unknown").split(", ")]
    parts = [f"commit {', '.join(commits)}" + (" with changes" if call.is_dirty else "")]
    parts.append(call.date[:10] if call.date else "date unknown")
    parts.append(call.device or "device unknown")
    parts += [f"driver {call.driver}"] if call.driver else []
    if repeats := sorted(set(repeats_of(call.results))):
        least, most = repeats[0], repeats[-1]
        shown = str(least) if least == most else f"{least} to {most}"
        parts.append(f"{shown} {'run' if most == 1 else 'runs'} of each case")
    return ", ".join(parts)
