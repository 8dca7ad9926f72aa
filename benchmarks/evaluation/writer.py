"""Writes the tables of documents: cells in Markdown, and below them what their files are from."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from string import Formatter
from typing import Any, TypeAlias, TypeVar

from benchmarks.evaluation.evidence import Evidence, FigureText, together
from benchmarks.evaluation.figures import NOT_MEASURED, call_of, repeats_of
from benchmarks.records import Call, calls_by_date

Rows: TypeAlias = Iterable[Sequence[str]]
Calls: TypeAlias = Mapping[Any, tuple[Call, Path]]
"""The calls that a table shows, with their files, by a key that differs from call to call."""
MakeRows = TypeVar("MakeRows", bound=Callable[[], Rows])
MakeRowsOfCalls = TypeVar("MakeRowsOfCalls", bound=Callable[[Calls], Rows])
MakeLines = TypeVar("MakeLines", bound=Callable[[], list[str]])
Values: TypeAlias = Mapping[str, FigureText | Mapping[str, FigureText]]
MakeValues = TypeVar("MakeValues", bound=Callable[[], Values])

TABLES: dict[str, Callable[[], list[str]]] = {}
"""By the name that documents use: `<!-- table: NAME -->`."""

WORD_TABLES: dict[str, Callable[[], list[tuple[str, Evidence | None]]]] = {}
"""By the same name, for tables made from a text file: every line, with its figures' evidence."""


def table(
    name: str, head: str, *files: str, more: Callable[[], Iterable[str]] = tuple
) -> Callable[[MakeRows], MakeRows]:
    """Registers a function of rows as a table.

    Args:
      name: in documents.
      head: see `markdown`.
      files: of results that its figures are from.
      more: further files, found when the table is made.
    """

    def make(rows: MakeRows) -> list[str]:
        found, below = [*rows()], [*files, *more()]
        if not found or (below and not any(map(call_of, below))):
            return [NOT_MEASURED]
        return [*markdown(head, found), *source(*below)]

    def register(rows: MakeRows) -> MakeRows:
        TABLES[name] = lambda: make(rows)
        return rows

    return register


def table_of_calls(
    name: str,
    head: str,
    find: Callable[[], Calls],
    note: Callable[[Any], str] = lambda _: "",
    *,
    is_brief: bool = False,
) -> Callable[[MakeRowsOfCalls], MakeRowsOfCalls]:
    """Registers a function of the rows of some calls as a table.

    Args:
      name: in documents.
      head: see `markdown`.
      find: the calls.
      note: a remark on a call beside its file, by its key.
      is_brief: whether equal lines below the table are written once.
    """

    def register(rows: MakeRowsOfCalls) -> MakeRowsOfCalls:
        def make() -> list[str]:
            if not (found := find()):
                return [NOT_MEASURED]
            made = made_with(found, note)
            below = dict.fromkeys(made) if is_brief else made
            return [*markdown(head, [*rows(found)]), "", *below]

        TABLES[name] = make
        return rows

    return register


def newest(pattern: str, key: Callable[[Call], Any]) -> Calls:
    """The newest call of each kind, in the files of results that match."""
    return {key(call): (call, path) for call, path in calls_by_date(pattern)}


def made_with(calls: Calls, note: Callable[[Any], str] = lambda _: "") -> list[str]:
    """A line for each call: its file, the notes of its keys, and with what it was made."""
    found: dict[tuple[str, str | None], tuple[Call, list[str]]] = {}
    for key, (call, path) in calls.items():
        _, notes = found.setdefault((path.name, call.date), (call, []))
        notes += filter(None, [note(key)])
    return [line_of(file, call, "; ".join(notes)) for (file, _), (call, notes) in found.items()]


def lines(name: str) -> Callable[[MakeLines], MakeLines]:
    """Registers a function that writes all lines of a table itself."""

    def register(make: MakeLines) -> MakeLines:
        TABLES[name] = make
        return make

    return register


def word_table(name: str) -> Callable[[MakeValues], MakeValues]:
    """Registers the figures that a function returns, filled into `<name>.md`, as a table."""

    def register(make: MakeValues) -> MakeValues:
        template = Path(__file__).parent / f"{name}.md"

        def filled_lines() -> list[tuple[str, Evidence | None]]:
            values = make()
            return [_filled(line, values) for line in template.read_text().splitlines()]

        WORD_TABLES[name] = filled_lines
        TABLES[name] = lambda: [line for line, _ in WORD_TABLES[name]()]
        return make

    return register


def _filled(line: str, values: Values) -> tuple[str, Evidence | None]:
    """A line with figures in the places of their names; `{on}` is their evidence."""
    evidence = together(one.evidence for one in _named(line, values) if one.evidence)
    cells = (_filled_cell(cell, {**values, "on": evidence or ""}) for cell in line.split("|"))
    return "|".join(cells), evidence


def _filled_cell(cell: str, values: Mapping[str, Any]) -> str:
    """A filled cell; `not measured` once if all its figures are missing."""
    found = _named(cell, values)
    is_missing = found and all(one.text == NOT_MEASURED for one in found)
    return f" {NOT_MEASURED} " if is_missing else cell.format(**values)


def _named(text: str, values: Mapping[str, Any]) -> list[FigureText]:
    """The figures that a text names, but for `{on}`."""
    names = (name for _, name, *_ in Formatter().parse(text) if name and name != "on")
    return [Formatter().get_field(name, (), values)[0] for name in names]


def markdown(head: str, rows: Sequence[Sequence[str]]) -> list[str]:
    """A table; the columns of `head` are divided by `|`, those of numbers end with a colon."""
    names = [name.strip() for name in head.split("|")]
    rule = ["---:" if name.endswith(":") else "---" for name in names]
    lines = [[name.removesuffix(":") for name in names], rule, *rows]
    return [f"| {' | '.join(cells)} |" for cells in lines]


def source(*files: str) -> list[str]:
    """A line for each file: with what its call was made."""
    below = [line_of(f"{file}.json", call_of(file)) for file in files]
    return ["", *below] if below else []


def line_of(file: str, call: Call | None, note: str = "") -> str:
    """A call of a file of results, as a page in `docs/evaluation/` points at it."""
    if call is None:
        return f"- `{file}`: {NOT_MEASURED}"
    link = f"[`{file}`](../../benchmarks/results/{file})"
    return f"- {link}{', ' if note else ''}{note}: {origin(call)}"


def origin(call: Call) -> str:
    """Commit, date, device, driver and repeats of a call; `unknown` where the file has none."""
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
